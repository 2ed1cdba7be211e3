//! Dense matrix products, Gram matrices and QR factors; the only user of `faer`.

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par};

/// Row-major product of an a×b and a b×c matrix, one thread. O(abc).
#[must_use]
pub fn multiply(left: &[f64], right: &[f64], a: usize, b: usize, c: usize) -> Vec<f64> {
    // Column-major reading of row-major storage is the transpose, so (AB)ᵀ = BᵀAᵀ needs no copy.
    let left_t = MatRef::from_column_major_slice(left, b, a);
    let right_t = MatRef::from_column_major_slice(right, c, b);
    let mut product = Mat::<f64>::zeros(c, a);
    matmul(product.as_mut(), Accum::Replace, right_t, left_t, 1.0, Par::Seq);
    let mut out = Vec::with_capacity(a * c);
    for column in product.col_iter() {
        out.extend(column.iter().copied());
    }
    out
}

/// Gram matrix of the given columns (all of one length), row-major k × k, exactly symmetric. O(k²m).
#[must_use]
pub fn gram(columns: &[&[f64]]) -> Vec<f64> {
    let k = columns.len();
    let m = columns.first().map_or(0, |c| c.len());
    let x = Mat::from_fn(m, k, |i, j| columns[j][i]);
    let mut g = Mat::<f64>::zeros(k, k);
    matmul(g.as_mut(), Accum::Replace, x.transpose(), x.as_ref(), 1.0, Par::Seq);
    let mut out = vec![0.0; k * k];
    for i in 0..k {
        for j in 0..k {
            out[i * k + j] = g[(i.min(j), i.max(j))];
        }
    }
    out
}

/// Upper-triangular factor R of the QR factorisation of the given columns, row-major k × k. O(k²m).
///
/// Needs at least as many rows as columns; shorter columns are padded with zero rows, which leaves R unchanged.
#[must_use]
pub fn triangular_factor(columns: &[Vec<f64>]) -> Vec<f64> {
    let k = columns.len();
    let m = columns.first().map_or(0, Vec::len);
    let x = Mat::from_fn(m.max(k), k, |i, j| columns[j].get(i).copied().unwrap_or(0.0));
    let qr = x.qr();
    let r = qr.thin_R();
    let mut out = vec![0.0; k * k];
    for i in 0..k {
        for j in i..k {
            out[i * k + j] = r[(i, j)];
        }
    }
    out
}

/// Adds a column to an orthonormal basis unless less than this share of it lies outside the span. O(k m).
pub fn extend_orthonormal(basis: &mut Vec<Vec<f64>>, mut column: Vec<f64>, share: f64) {
    let size = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let whole = size(&column);
    // Twice is enough (Kahan, Parlett).
    for _ in 0..2 {
        for direction in basis.iter() {
            let along: f64 = direction.iter().zip(&column).map(|(q, v)| q * v).sum();
            column.iter_mut().zip(direction).for_each(|(v, q)| *v -= along * q);
        }
    }
    let left = size(&column);
    if left > share * whole && left.is_finite() {
        column.iter_mut().for_each(|v| *v /= left);
        basis.push(column);
    }
}

/// Inner products of every left with every right column (all of one length), row-major left × right. O(left·right·m).
#[must_use]
pub fn inner_products(left: &[&[f64]], right: &[&[f64]]) -> Vec<f64> {
    let m = left.first().map_or(0, |c| c.len());
    let x = Mat::from_fn(m, left.len(), |i, j| left[j][i]);
    let y = Mat::from_fn(m, right.len(), |i, j| right[j][i]);
    let mut product = Mat::<f64>::zeros(right.len(), left.len());
    matmul(product.as_mut(), Accum::Replace, y.transpose(), x.as_ref(), 1.0, Par::Seq);
    product.col_iter().flat_map(|column| column.iter().copied().collect::<Vec<_>>()).collect()
}

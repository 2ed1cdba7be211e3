//! Dense matrix products, Gram matrices and QR factors; the only user of `faer`.

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par};

use crate::linalg::orthogonal;
use crate::parallel::{self, Stop};

/// Rows over which one product of long columns is summed, at least, and into how many such parts their rows are cut at
/// most; the parts do not depend on the threads, nor do their sums.
const PIECE: usize = 1 << 14;
const PIECES: usize = 16;
/// Columns of a Gram matrix that are multiplied with one another at a time.
const TILE: usize = 64;
/// Rows of scattered columns that are laid out for a product at a time: what fits a cache.
const LAID_OUT: usize = 1 << 10;

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

/// Gram matrix of columns that lie one behind another, and of a target as the last one: row-major, exactly symmetric.
/// O(k²m), on the threads of the pool at hand; the columns are read where they lie. What it comes to once it was told to
/// stop is of no use.
///
/// # Panics
/// Where the columns are not as long as the target.
#[must_use]
pub fn gram(columns: &[f64], target: &[f64], stop: &Stop) -> Vec<f64> {
    let m = target.len();
    let k = columns.len() / m.max(1);
    let x = MatRef::from_column_major_slice(columns, m, k);
    let y = MatRef::from_column_major_slice(target, m, 1);
    let mut tiles: Vec<(usize, MatRef<'_, f64>)> =
        (0..k).step_by(TILE).map(|first| (first, x.subcols(first, TILE.min(k - first)))).collect();
    tiles.push((k, y));
    let rows = pieces(m);
    let pairs = (0..tiles.len()).flat_map(|b| (0..=b).map(move |a| (a, b)));
    let tasks: Vec<_> = pairs.flat_map(|pair| rows.iter().map(move |&piece| (pair, piece))).collect();
    let made = parallel::map(
        tasks,
        || (),
        |(), ((a, b), (from, len))| {
            let (left, right) = (tiles[a].1.subrows(from, len), tiles[b].1.subrows(from, len));
            let mut product = Mat::<f64>::zeros(left.ncols(), right.ncols());
            if !stop.is_set() {
                matmul(product.as_mut(), Accum::Replace, left.transpose(), right, 1.0, Par::Seq);
            }
            (tiles[a].0, tiles[b].0, product)
        },
    );
    let mut out = vec![0.0; (k + 1) * (k + 1)];
    for (left, right, product) in made {
        for (j, column) in product.col_iter().enumerate() {
            for (i, value) in column.iter().enumerate().filter(|(i, _)| left + i <= right + j) {
                out[(left + i) * (k + 1) + right + j] += value;
            }
        }
    }
    for i in 0..=k {
        for j in 0..i {
            out[i * (k + 1) + j] = out[j * (k + 1) + i];
        }
    }
    out
}

/// Where so many rows are cut: first row and number of each part.
fn pieces(m: usize) -> Vec<(usize, usize)> {
    let len = m.div_ceil(PIECES).max(PIECE);
    (0..m).step_by(len).map(|from| (from, len.min(m - from))).collect()
}

/// Upper-triangular factor R of the QR factorisation of the given columns, row-major k × k. O(k²m).
///
/// Needs at least as many rows as columns; shorter columns are padded with zero rows, which leaves R unchanged.
#[must_use]
pub fn triangular_factor(columns: &[Vec<f64>]) -> Vec<f64> {
    if let Some(factor) = orthogonal::triangular_factor(columns) {
        return factor;
    }
    // Squares leave the numbers: norms are to be scaled.
    let k = columns.len();
    let m = columns.iter().map(Vec::len).max().unwrap_or(0);
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

/// Singular values of columns, as many as the lesser of their number and length, none smaller than the next.
pub struct Singular {
    /// Left vectors, each as long as the columns.
    pub left: Vec<Vec<f64>>,
    /// The values.
    pub sizes: Vec<f64>,
    /// Right vectors, each of as many numbers as there are columns.
    pub right: Vec<Vec<f64>>,
}

/// Singular values and vectors of columns of one length. O(k²m), one thread.
///
/// None where the iteration does not end, which finite numbers do not make happen.
///
/// ```
/// # fn run() -> Option<()> {
/// let found = ftlm::linalg::dense::singular(&[vec![0.0, 3.0, 0.0], vec![0.0, 0.0, -2.0]])?;
/// assert!((found.sizes[0] - 3.0).abs() < 1e-15 && (found.sizes[1] - 2.0).abs() < 1e-15);
/// assert!((found.left[0][1] * found.right[0][0] - 1.0).abs() < 1e-15);
/// # Some(())
/// # }
/// # assert!(run().is_some());
/// ```
#[must_use]
pub fn singular(columns: &[Vec<f64>]) -> Option<Singular> {
    let m = columns.first().map_or(0, Vec::len);
    let x = Mat::from_fn(m, columns.len(), |i, j| columns[j][i]);
    let found = x.thin_svd().ok()?;
    let vectors = |of: MatRef<'_, f64>| of.col_iter().map(|column| column.iter().copied().collect()).collect();
    let sizes = found.S().column_vector().iter().copied().collect();
    Some(Singular { left: vectors(found.U()), sizes, right: vectors(found.V()) })
}

/// Inner products of every left with every right column (all of one length), row-major left × right. O(left·right·m), on
/// the threads of the pool at hand. What they come to once it was told to stop is of no use.
#[must_use]
pub fn inner_products(left: &[&[f64]], right: &[&[f64]], stop: &Stop) -> Vec<f64> {
    let m = left.first().map_or(0, |c| c.len());
    let made = parallel::map(
        pieces(m),
        || (),
        |(), (from, len)| {
            let mut product = Mat::<f64>::zeros(right.len(), left.len());
            for first in (from..from + len).step_by(LAID_OUT).take_while(|_| !stop.is_set()) {
                let rows = LAID_OUT.min(from + len - first);
                let x = Mat::from_fn(rows, left.len(), |i, j| left[j][first + i]);
                let y = Mat::from_fn(rows, right.len(), |i, j| right[j][first + i]);
                matmul(product.as_mut(), Accum::Add, y.transpose(), x.as_ref(), 1.0, Par::Seq);
            }
            product
        },
    );
    let mut out = vec![0.0; left.len() * right.len()];
    for product in made {
        let values = product.col_iter().flat_map(|column| column.iter());
        out.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
    }
    out
}

//! Dense matrices: products, Gram matrices, QR factors and singular values. This is the only module that uses `faer`.

use std::ops::Range;

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par};

use crate::linalg::orthogonal;
use crate::parallel::{self, Stop};

/// Minimum number of rows in one block of a product of long columns. The blocks do not depend on the number of threads,
/// so neither do the rounding errors of the sums.
const MIN_BLOCK_ROWS: usize = 1 << 14;
/// Maximum number of row blocks of a product of long columns.
const MAX_ROW_BLOCKS: usize = 16;
/// Number of columns that are multiplied at a time in a Gram matrix product.
const GRAM_TILE_COLUMNS: usize = 64;
/// Number of rows of separately stored columns that are copied for one product. They fit in the cache.
const COPIED_BLOCK_ROWS: usize = 1 << 10;

/// Return the row-major product of an a×b and a b×c matrix, computed on one thread. O(abc).
#[must_use]
pub fn multiply(left: &[f64], right: &[f64], a: usize, b: usize, c: usize) -> Vec<f64> {
    // Row-major storage read as column-major is the transpose, so (AB)ᵀ = BᵀAᵀ needs no copy.
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

/// Return the Gram matrix of contiguous columns and, as the last column, a target. For k columns it has shape (k + 1) ×
/// (k + 1), row-major, and is exactly symmetric.
///
/// O(k²m) for m rows on the threads of the current pool. The columns are not copied. The result is invalid after a stop
/// request.
///
/// # Panics
/// If the columns are not as long as the target.
#[must_use]
pub fn gram(columns: &[f64], target: &[f64], stop: &Stop) -> Vec<f64> {
    let m = target.len();
    let k = columns.len() / m.max(1);
    let x = MatRef::from_column_major_slice(columns, m, k);
    let y = MatRef::from_column_major_slice(target, m, 1);
    let mut tiles: Vec<(usize, MatRef<'_, f64>)> = (0..k)
        .step_by(GRAM_TILE_COLUMNS)
        .map(|first| (first, x.subcols(first, GRAM_TILE_COLUMNS.min(k - first))))
        .collect();
    tiles.push((k, y));
    let rows = row_blocks(m);
    let pairs = (0..tiles.len()).flat_map(|b| (0..=b).map(move |a| (a, b)));
    let tasks: Vec<_> = pairs.flat_map(|pair| rows.iter().map(move |&block| (pair, block))).collect();
    let tiles_of_products = parallel::map(
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
    for (left, right, product) in tiles_of_products {
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

/// Return (first row, number of rows) of each row block of a product of columns with `m` rows.
fn row_blocks(m: usize) -> Vec<(usize, usize)> {
    let len = m.div_ceil(MAX_ROW_BLOCKS).max(MIN_BLOCK_ROWS);
    (0..m).step_by(len).map(|from| (from, len.min(m - from))).collect()
}

/// Return the upper-triangular factor R of the QR factorization of k columns, row-major k × k. O(k²m) for m rows.
///
/// Columns with fewer than k rows are padded with zero rows, which leaves R unchanged.
#[must_use]
pub fn triangular_factor(columns: &[Vec<f64>]) -> Vec<f64> {
    let m = columns.iter().map(Vec::len).max().unwrap_or(0);
    triangular_factor_by_blocks((columns.len(), m), |j, rows, out| {
        let end = out.len() + rows.len();
        out.extend_from_slice(columns[j].get(rows.start..rows.end.min(columns[j].len())).unwrap_or_default());
        out.resize(end, 0.0);
    })
}

/// Return the upper-triangular factor R of the QR factorization of k columns with m rows, row-major k × k. O(k²m).
///
/// The columns are computed by blocks of rows and never stored as a whole: `append_rows(j, rows, out)` appends the
/// elements `rows` of column j to `out`. It may be called more than once for the same rows.
#[must_use]
pub fn triangular_factor_by_blocks(
    (k, m): (usize, usize),
    append_rows: impl Fn(usize, Range<usize>, &mut Vec<f64>),
) -> Vec<f64> {
    if let Some(factor) = orthogonal::triangular_factor((k, m), &append_rows) {
        return factor;
    }
    // The squares are out of range, so norms must be scaled.
    let column = |j: usize| {
        let mut column = Vec::with_capacity(m.max(k));
        append_rows(j, 0..m, &mut column);
        column.resize(m.max(k), 0.0);
        column
    };
    let columns: Vec<Vec<f64>> = (0..k).map(column).collect();
    let x = Mat::from_fn(m.max(k), k, |i, j| columns[j][i]);
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

/// Singular value decomposition of a matrix, given by its columns.
#[non_exhaustive]
pub struct SingularValues {
    /// The left singular vectors, each as long as the columns.
    pub left: Vec<Vec<f64>>,
    /// Singular values in descending order. Their count is the smaller of the number and the length of the columns.
    pub values: Vec<f64>,
    /// Right singular vectors, with one element per column.
    pub right: Vec<Vec<f64>>,
}

/// Return the singular values and vectors of k columns with m rows, computed on one thread. O(k²m).
///
/// `None` if the iteration does not converge, which does not occur for finite values.
///
/// ```
/// # fn run() -> Option<()> {
/// let found = ftlm::linalg::dense::singular_values(&[vec![0.0, 3.0, 0.0], vec![0.0, 0.0, -2.0]])?;
/// assert!((found.values[0] - 3.0).abs() < 1e-15 && (found.values[1] - 2.0).abs() < 1e-15);
/// assert!((found.left[0][1] * found.right[0][0] - 1.0).abs() < 1e-15);
/// # Some(())
/// # }
/// # assert!(run().is_some());
/// ```
#[must_use]
pub fn singular_values(columns: &[Vec<f64>]) -> Option<SingularValues> {
    let m = columns.first().map_or(0, Vec::len);
    let x = Mat::from_fn(m, columns.len(), |i, j| columns[j][i]);
    let decomposition = x.thin_svd().ok()?;
    let vectors = |matrix: MatRef<'_, f64>| matrix.col_iter().map(|column| column.iter().copied().collect()).collect();
    let values = decomposition.S().column_vector().iter().copied().collect();
    Some(SingularValues { left: vectors(decomposition.U()), values, right: vectors(decomposition.V()) })
}

/// Return the least-squares solution of smallest norm for k columns with m rows. Singular values of at most
/// `relative_tolerance` times the largest count as 0. O(k²m).
///
/// `None` if the singular values cannot be computed, which does not occur for finite values.
///
/// ```
/// // The two columns are equal: each gets half of what one would get.
/// let found = ftlm::linalg::dense::minimum_norm_solution(&[vec![1.0, 1.0], vec![1.0, 1.0]], &[3.0, 1.0], 1e-12);
/// assert!(found.is_some_and(|x| x.iter().all(|v| (v - 1.0).abs() < 1e-12)));
/// ```
#[must_use]
pub fn minimum_norm_solution(columns: &[Vec<f64>], target: &[f64], relative_tolerance: f64) -> Option<Vec<f64>> {
    let column = |j: usize| columns.get(j).map_or(target, Vec::as_slice);
    let append_rows = |j: usize, rows: Range<usize>, out: &mut Vec<f64>| out.extend_from_slice(&column(j)[rows]);
    Some(minimum_norm_solution_by_blocks((columns.len(), target.len()), append_rows, relative_tolerance)?.values)
}

/// Least-squares solution of smallest norm.
#[non_exhaustive]
pub struct MinimumNormSolution {
    /// One value per column.
    pub values: Vec<f64>,
    /// Sum of the squared residuals.
    pub residual_squares: f64,
}

/// Return the least-squares solution of smallest norm as in [`minimum_norm_solution`], for columns that are computed by
/// blocks of rows as in [`triangular_factor_by_blocks`]. Column k is the target.
#[must_use]
pub fn minimum_norm_solution_by_blocks(
    (k, m): (usize, usize),
    append_rows: impl Fn(usize, Range<usize>, &mut Vec<f64>),
    relative_tolerance: f64,
) -> Option<MinimumNormSolution> {
    let factor = triangular_factor_by_blocks((k + 1, m), append_rows);
    let column = |j: usize| -> Vec<f64> { (0..=k).map(|i| factor[i * (k + 1) + j]).collect() };
    let (mut values, mut remainder) = (vec![0.0; k], column(k));
    if k == 0 {
        return Some(MinimumNormSolution { values, residual_squares: remainder[0] * remainder[0] });
    }
    let factors = singular_values(&(0..k).map(column).collect::<Vec<_>>())?;
    let threshold = relative_tolerance * factors.values.first().copied().unwrap_or(0.0);
    for ((left, value), right) in factors.left.iter().zip(&factors.values).zip(&factors.right) {
        if *value > threshold {
            let component: f64 = left.iter().zip(&remainder).map(|(u, v)| u * v).sum();
            remainder.iter_mut().zip(left).for_each(|(v, u)| *v -= component * u);
            values.iter_mut().zip(right).for_each(|(x, v)| *x += component / value * v);
        }
    }
    Some(MinimumNormSolution { values, residual_squares: remainder.iter().map(|v| v * v).sum() })
}

/// Return the inner products of every left with every right column, row-major with one row per left column. All columns
/// have equal length m.
///
/// O(left·right·m) on the threads of the current pool. The result is invalid after a stop request.
#[must_use]
pub fn inner_products(left: &[&[f64]], right: &[&[f64]], stop: &Stop) -> Vec<f64> {
    let m = left.first().map_or(0, |c| c.len());
    let blocks = parallel::map(
        row_blocks(m),
        || (),
        |(), (from, len)| {
            let mut product = Mat::<f64>::zeros(right.len(), left.len());
            for first in (from..from + len).step_by(COPIED_BLOCK_ROWS).take_while(|_| !stop.is_set()) {
                let rows = COPIED_BLOCK_ROWS.min(from + len - first);
                let x = Mat::from_fn(rows, left.len(), |i, j| left[j][first + i]);
                let y = Mat::from_fn(rows, right.len(), |i, j| right[j][first + i]);
                matmul(product.as_mut(), Accum::Add, y.transpose(), x.as_ref(), 1.0, Par::Seq);
            }
            product
        },
    );
    let mut out = vec![0.0; left.len() * right.len()];
    for product in blocks {
        let values = product.col_iter().flat_map(|column| column.iter());
        out.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
    }
    out
}

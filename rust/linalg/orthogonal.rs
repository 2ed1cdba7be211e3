//! Orthonormal bases, projections and triangular factors of matrices with long columns, by vector instructions.

use std::ops::Range;

use crate::error::Result;
use crate::parallel::{self, Stop};
use crate::simd::{dispatch_simd, dot, SimdKernel};

/// Number of rows of one block of a triangular factorization. Such a block fits in the cache.
const QR_BLOCK_ROWS: usize = 1 << 10;

/// Number of basis vectors that are projected out between two checks for a stop request.
const VECTORS_PER_STOP_CHECK: usize = 16;

/// Minimum squared norm of a column in a factorization. Smaller sums of squares lose accuracy.
const MIN_SQUARED_NORM: f64 = 1e-280;
/// Maximum squared norm of a column in a factorization. Larger sums of squares may overflow.
const MAX_SQUARED_NORM: f64 = 1e280;

/// Reduction of a triangle R with rows below it to an upper triangle, by Householder reflections. The result is false
/// if a squared norm is out of range. This task is compiled for the widest vector instructions available.
struct Reflections<'a> {
    columns: &'a mut [Vec<f64>],
}

impl SimdKernel for Reflections<'_> {
    type Output = bool;

    #[inline(always)]
    fn run(self) -> bool {
        let k = self.columns.len();
        for j in 0..k {
            let (before, later) = self.columns.split_at_mut(j + 1);
            let reflected = &mut before[j][j..];
            let square = dot(reflected, reflected);
            if square == 0.0 && reflected.iter().all(|v| *v == 0.0) {
                continue;
            }
            if !(MIN_SQUARED_NORM..=MAX_SQUARED_NORM).contains(&square) {
                return false;
            }
            let first = reflected[0];
            let diagonal = -square.sqrt().copysign(first);
            reflected[0] = first - diagonal;
            let factor = 1.0 / (diagonal * (diagonal - first));
            for column in later {
                let below = &mut column[j..];
                let component = factor * dot(reflected, below);
                for (v, w) in below.iter_mut().zip(reflected.iter()) {
                    *v -= component * w;
                }
            }
            reflected[0] = diagonal;
        }
        true
    }
}

/// Return the upper-triangular QR factor of k columns with m rows, row-major k × k, computed by blocks of rows. O(k²m).
///
/// `append_rows(j, rows, out)` appends the elements `rows` of column j to `out`. The columns are therefore never stored
/// together. `None` if a squared norm is outside [`MIN_SQUARED_NORM`] to [`MAX_SQUARED_NORM`].
pub(crate) fn triangular_factor(
    (k, m): (usize, usize),
    append_rows: impl Fn(usize, Range<usize>, &mut Vec<f64>),
) -> Option<Vec<f64>> {
    // The triangle R of the processed rows is on top, and the next rows follow below.
    let mut stacked: Vec<Vec<f64>> = vec![Vec::with_capacity(k + QR_BLOCK_ROWS.min(m)); k];
    stacked.iter_mut().for_each(|column| column.resize(k, 0.0));
    for from in (0..m).step_by(QR_BLOCK_ROWS) {
        for (j, column) in stacked.iter_mut().enumerate() {
            // A reflection leaves its vector below the triangle.
            column.truncate(k);
            column.iter_mut().skip(j + 1).for_each(|v| *v = 0.0);
            append_rows(j, from..m.min(from + QR_BLOCK_ROWS), column);
        }
        if !dispatch_simd(Reflections { columns: &mut stacked }) {
            return None;
        }
    }
    let mut out = vec![0.0; k * k];
    for i in 0..k {
        for j in i..k {
            out[i * k + j] = stacked[j][i];
        }
    }
    out.iter().all(|v| v.is_finite()).then_some(out)
}

/// Removal of the components along an orthonormal basis from a column, repeated `times` times. This task is compiled
/// for the widest vector instructions available.
struct Projection<'a> {
    basis: &'a [Vec<f64>],
    column: &'a mut [f64],
    times: usize,
}

impl SimdKernel for Projection<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        for _ in 0..self.times {
            for direction in self.basis {
                let component = dot(direction, self.column);
                for (v, q) in self.column.iter_mut().zip(direction) {
                    *v -= component * q;
                }
            }
        }
    }
}

/// Remove the components along an orthonormal basis from a column of equal length. O(k m) for k basis vectors of m
/// values.
pub fn project_out(basis: &[Vec<f64>], column: &mut [f64]) {
    dispatch_simd(Projection { basis, column, times: 1 });
}

/// Add a column to an orthonormal basis if its distance from the span exceeds `relative_tolerance` times its norm. O(k
/// m) for k basis vectors of m values.
pub fn extend_orthonormal(basis: &mut Vec<Vec<f64>>, mut column: Vec<f64>, relative_tolerance: f64) {
    let norm_before = norm(&column);
    // Two passes are enough (Kahan, Parlett).
    dispatch_simd(Projection { basis, column: &mut column, times: 2 });
    let remainder = norm(&column);
    if remainder > relative_tolerance * norm_before && remainder.is_finite() {
        column.iter_mut().for_each(|v| *v /= remainder);
        basis.push(column);
    }
}

/// Return an orthonormal basis of the span of k columns of m values. Every column has a distance of at most
/// `relative_tolerance` from the span, relative to its norm.
///
/// O(k² m) on the threads of the current pool. The column farthest from the basis is added next (pivoting). Rounding
/// errors are therefore amplified once by 1/`relative_tolerance`, not once per column. Zero columns and columns whose
/// squared norm overflows are skipped.
///
/// # Errors
/// [`crate::error::Error::Interrupted`] after a stop request.
pub(crate) fn orthonormal_basis(columns: Vec<Vec<f64>>, relative_tolerance: f64, stop: &Stop) -> Result<Vec<Vec<f64>>> {
    let normalize = |(): &mut (), mut column: Vec<f64>| {
        let size = if stop.is_set() { 0.0 } else { norm(&column) };
        let is_usable = size > 0.0 && size.is_finite();
        column.iter_mut().for_each(|v| *v /= size);
        is_usable.then_some((1.0, column))
    };
    let mut candidates: Vec<(f64, Vec<f64>)> = parallel::map(columns, || (), normalize).into_iter().flatten().collect();
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(candidates.len());
    loop {
        stop.check()?;
        let farther = |a: &usize, b: &usize| candidates[*a].0.total_cmp(&candidates[*b].0).then(b.cmp(a));
        let Some(next) = (0..candidates.len()).max_by(farther).filter(|&next| candidates[next].0 > relative_tolerance)
        else {
            return Ok(basis);
        };
        let (_, mut direction) = candidates.remove(next);
        // Two passes are enough (Kahan, Parlett).
        for block in basis.chunks(VECTORS_PER_STOP_CHECK) {
            stop.check()?;
            project_out(block, &mut direction);
        }
        let remainder = norm(&direction);
        direction.iter_mut().for_each(|v| *v /= remainder);
        basis.push(direction);
        let last = &basis[basis.len() - 1..];
        let remove_last = |(): &mut (), (remainder, mut column): (f64, Vec<f64>)| {
            // After a stop request, columns are left unprocessed, and the result is discarded.
            if stop.is_set() {
                return (remainder, column);
            }
            project_out(last, &mut column);
            (norm(&column), column)
        };
        candidates = parallel::map(candidates, || (), remove_last);
    }
}

/// Euclidean norm √Σ v² of a column. This task is compiled for the widest vector instructions available.
struct Norm<'a>(&'a [f64]);

impl SimdKernel for Norm<'_> {
    type Output = f64;

    #[inline(always)]
    fn run(self) -> f64 {
        dot(self.0, self.0).sqrt()
    }
}

/// Return the Euclidean norm of a column whose squares do not overflow.
#[must_use]
pub fn norm(column: &[f64]) -> f64 {
    dispatch_simd(Norm(column))
}

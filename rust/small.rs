//! Fixed-size solves and the recursions of the estimators; the only user of `nalgebra`.

use nalgebra::{DMatrix, DVector};

use crate::error::{Error, Result};

/// A pivot of a correlation matrix below this marks a regressor that rounding cannot tell from the others:
/// the Gram matrix of m = 2048 products carries about 1e−13.
pub const PIVOT_FLOOR: f64 = 1e-13;

/// Row-major inverse of a row-major n × n matrix.
///
/// # Errors
/// [`Error::LeadingZero`] with the determinant where it is singular.
pub fn inverse(matrix: &[f64], n: usize) -> Result<Vec<f64>> {
    if n == 1 {
        let value = matrix.first().copied().unwrap_or(0.0);
        return if value != 0.0 && value.is_finite() {
            Ok(vec![1.0 / value])
        } else {
            Err(Error::LeadingZero { leading: value })
        };
    }
    let a = DMatrix::from_row_slice(n, n, matrix);
    let determinant = a.determinant();
    match a.try_inverse() {
        Some(inverse) if inverse.iter().all(|v| v.is_finite()) => Ok(inverse.transpose().as_slice().to_vec()),
        _ => Err(Error::LeadingZero { leading: determinant }),
    }
}

/// Row-major inverse of a row-major k × k matrix whose rows and columns may differ in scale by any factor.
///
/// # Errors
/// [`Error::Singular`] where rounding cannot tell its rows apart.
pub fn scaled_inverse(matrix: &[f64], k: usize) -> Result<Vec<f64>> {
    // Rows, then columns, to unit largest element: what is then nearly singular is so whatever the units.
    let largest = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0_f64, |a, v| a.max(v.abs()));
    let mut a = DMatrix::from_row_slice(k, k, matrix);
    let rows: Vec<f64> = (0..k).map(|i| largest(&mut a.row(i).iter().copied())).collect();
    for (i, scale) in rows.iter().enumerate() {
        a.row_mut(i).unscale_mut(*scale);
    }
    let columns: Vec<f64> = (0..k).map(|j| largest(&mut a.column(j).iter().copied())).collect();
    for (j, scale) in columns.iter().enumerate() {
        a.column_mut(j).unscale_mut(*scale);
    }
    let singular = |index| Error::Singular { index, count: k };
    if let Some(bad) = rows.iter().chain(&columns).position(|s| !(*s > 0.0 && s.is_finite())) {
        return Err(singular(bad % k.max(1)));
    }
    let factor = a.full_piv_lu();
    let pivots = factor.u().diagonal();
    if let Some(bad) = pivots.iter().position(|p| p.is_nan() || p.abs() <= PIVOT_FLOOR) {
        return Err(singular(bad));
    }
    let inverse = factor.try_inverse().ok_or_else(|| singular(0))?;
    let mut out = vec![0.0; k * k];
    for i in 0..k {
        for j in 0..k {
            out[i * k + j] = inverse[(i, j)] / (columns[i] * rows[j]);
        }
    }
    Ok(out)
}

/// Which regressors a solve kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Rank {
    /// All.
    Full,
    /// These optional ones were dropped as combinations of the ones before them.
    Dropped(Vec<usize>),
}

/// Solves the symmetric positive system `gram x = rhs` (row-major k × k) by a scaled Cholesky factor, in place.
///
/// The first `needed` unknowns must be independent; later ones that are combinations of those before them are dropped
/// (their unknown is 0). `gram` and `rhs` are overwritten, `rhs` with the solution. O(k³).
///
/// # Errors
/// [`Error::Singular`] with the first dependent one of the needed unknowns.
pub fn solve_gram(gram: &mut [f64], rhs: &mut [f64], needed: usize, scale: &mut Vec<f64>) -> Result<Rank> {
    let k = rhs.len();
    scale.clear();
    scale.extend((0..k).map(|i| {
        let d = gram[i * k + i];
        if d > 0.0 && d.is_finite() {
            1.0 / d.sqrt()
        } else {
            0.0
        }
    }));
    for i in 0..k {
        for j in 0..=i {
            gram[i * k + j] *= scale[i] * scale[j];
        }
        rhs[i] *= scale[i];
    }
    let mut dropped = Vec::new();
    for i in 0..k {
        for j in 0..i {
            let mut sum = gram[i * k + j];
            for l in 0..j {
                sum -= gram[i * k + l] * gram[j * k + l];
            }
            // A dropped unknown has a zero row, and its reciprocal pivot is stored as zero.
            gram[i * k + j] = sum * gram[j * k + j];
        }
        let mut pivot = gram[i * k + i];
        for l in 0..i {
            pivot -= gram[i * k + l] * gram[i * k + l];
        }
        if pivot.is_nan() || pivot <= PIVOT_FLOOR {
            if i < needed {
                return Err(Error::Singular { index: i, count: k });
            }
            dropped.push(i);
            for l in 0..=i {
                gram[i * k + l] = 0.0;
            }
            continue;
        }
        gram[i * k + i] = 1.0 / pivot.sqrt();
    }
    for i in 0..k {
        for l in 0..i {
            rhs[i] -= gram[i * k + l] * rhs[l];
        }
        rhs[i] *= gram[i * k + i];
    }
    for i in (0..k).rev() {
        for l in i + 1..k {
            rhs[i] -= gram[l * k + i] * rhs[l];
        }
        rhs[i] *= gram[i * k + i];
    }
    for (x, s) in rhs.iter_mut().zip(scale.iter()) {
        *x *= s;
    }
    Ok(if dropped.is_empty() { Rank::Full } else { Rank::Dropped(dropped) })
}

/// Solution of a symmetric positive definite system by nalgebra's Cholesky factor: the oracle of [`solve_gram`].
#[must_use]
pub fn solve_gram_oracle(gram: &[f64], rhs: &[f64]) -> Option<Vec<f64>> {
    let k = rhs.len();
    let solution = DMatrix::from_row_slice(k, k, gram).cholesky()?.solve(&DVector::from_column_slice(rhs));
    Some(solution.as_slice().to_vec())
}

/// Solves `R x = c` for upper-triangular row-major R (k × k with row stride `stride`).
#[must_use]
pub fn back_substitute(r: &[f64], stride: usize, rhs: &[f64]) -> Vec<f64> {
    let k = rhs.len();
    let mut x = rhs.to_vec();
    for i in (0..k).rev() {
        for j in i + 1..k {
            x[i] -= r[i * stride + j] * x[j];
        }
        x[i] /= r[i * stride + i];
    }
    x
}

/// The state of recursion (44): the coefficients and the inverse covariance.
#[derive(Debug, Clone)]
pub struct Recursion {
    coefficients: DVector<f64>,
    information: DMatrix<f64>,
}

impl Recursion {
    /// Starts at coefficients `start` with covariance `prior`·I.
    #[must_use]
    pub fn new(start: &[f64], prior: f64) -> Self {
        let k = start.len();
        Self {
            coefficients: DVector::from_column_slice(start),
            information: DMatrix::from_diagonal_element(k, k, 1.0 / prior),
        }
    }

    /// One step of (44): the innovation of these rows (newest first or not: the sum does not know).
    ///
    /// # Errors
    /// [`Error::Diverged`] where the covariance is no longer positive.
    pub fn step<'a>(&mut self, rows: impl Iterator<Item = (&'a [f64], f64)> + Clone) -> Result<()> {
        let k = self.coefficients.len();
        let mut gain = DVector::zeros(k);
        for (row, output) in rows.clone() {
            let q = DVector::from_column_slice(row);
            gain += &q * (output - q.dot(&self.coefficients));
            self.information.ger(1.0, &q, &q, 1.0);
        }
        let factor = self
            .information
            .clone()
            .cholesky()
            .ok_or_else(|| Error::Diverged { what: "covariance of the recursion".into(), index: 0 })?;
        self.coefficients += factor.solve(&gain);
        Ok(())
    }

    /// Coefficients after the last step.
    #[must_use]
    pub fn coefficients(&self) -> &[f64] {
        self.coefficients.as_slice()
    }
}

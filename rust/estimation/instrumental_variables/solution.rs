//! Instrumental-variable estimation at given orders (refined IV, Young and Jakeman; fractional orders: Victor, Malti,
//! Garnier and Oustaloup, doi:10.1016/j.automatica.2012.12.006): settings, solutions and the long-run covariance.
//!
//! Least squares on the equation error is biased because a measured output enters its own regressors with its noise.
//! Instruments are free of noise, because they are computed from the inputs and the model alone. Coupled equations are
//! refined one by one and then together.

use crate::equation::{Equation, Structure};
use crate::error::{Error, Result};

/// Maximum permitted number of iterations. If more iterations are needed, the estimates usually oscillate without
/// converging.
const MAX_ITERATIONS: usize = 1000;

/// Termination criteria of the iteration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InstrumentalSettings {
    /// Maximum number of iterations.
    pub iterations: usize,
    /// Maximum relative change of a coefficient in a step at which the iteration has converged.
    pub tolerance: f64,
}

impl Default for InstrumentalSettings {
    fn default() -> Self {
        Self { iterations: 30, tolerance: 1e-7 }
    }
}

impl InstrumentalSettings {
    /// Check that the number of iterations and the tolerance are in range.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for more than 1000 iterations, and for a tolerance that is negative or not finite.
    ///
    /// ```
    /// # use ftlm::estimation::instrumental_variables::InstrumentalSettings;
    /// assert!(InstrumentalSettings::default().check().is_ok());
    /// assert!(InstrumentalSettings { iterations: 1 << 20, ..InstrumentalSettings::default() }.check().is_err());
    /// ```
    pub fn check(&self) -> Result<()> {
        let out_of_range = |name: &str, value: f64, range: &str, remedy: &str| {
            Err(Error::OutOfRange { name: name.into(), value, range: range.into(), remedy: remedy.into() })
        };
        if self.iterations > MAX_ITERATIONS {
            #[allow(clippy::cast_precision_loss)]
            let steps = self.iterations as f64;
            let remedy = "use fewer iterations; estimates that have not converged by then oscillate";
            return out_of_range(
                "iterations of instrumental variables",
                steps,
                &format!("[0, {MAX_ITERATIONS}]"),
                remedy,
            );
        }
        if !(self.tolerance >= 0.0 && self.tolerance.is_finite()) {
            let remedy = "give the relative change at which the iterations stop";
            return out_of_range("tolerance of instrumental variables", self.tolerance, "[0, ∞)", remedy);
        }
        Ok(())
    }
}

/// Coefficients of one equation: those of its terms, then those of its initial terms record by record.
pub type Solution = Vec<f64>;

/// The excluded initial terms of one equation, as pairs of record index and exponent index.
pub type ExcludedTerms = Vec<(usize, usize)>;

/// Return the equations with the given structures and the term coefficients of the solutions.
pub(super) fn equations(structures: &[Structure], solutions: &[Solution]) -> Vec<Equation> {
    let pairs = structures.iter().zip(solutions);
    pairs.map(|(s, x)| Equation { structure: s.clone(), coefficients: x[..s.terms.len()].to_vec() }).collect()
}

/// Initial terms of record `r` as pairs (exponent, coefficient), one list per equation.
pub(super) fn initial_terms(
    r: usize,
    structures: &[Structure],
    exponents: &[Vec<f64>],
    solutions: &[Solution],
) -> Vec<Vec<(f64, f64)>> {
    exponents
        .iter()
        .zip(structures)
        .zip(solutions)
        .map(|((exponents, s), x)| {
            let first = s.terms.len() + r * exponents.len();
            exponents.iter().copied().zip(x[first..].iter().copied()).collect()
        })
        .collect()
}

/// Return true if each of the first `terms` coefficients changed by at most `tolerance` relative to its magnitude.
pub(super) fn has_converged(before: &[f64], after: &[f64], terms: usize, tolerance: f64) -> bool {
    let largest = after[..terms].iter().fold(0.0_f64, |a, v| a.max(v.abs()));
    before[..terms].iter().zip(after).all(|(a, b)| (a - b).abs() <= tolerance * b.abs().max(1e-9 * largest))
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    // Four independent sums: a single one is limited by the latency of the addition.
    let mut sums = [0.0; 4];
    let (left, right) = (a.chunks_exact(4), b.chunks_exact(4));
    let tail: f64 = left.remainder().iter().zip(right.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in left.zip(right) {
        for (sum, (x, y)) in sums.iter_mut().zip(x.iter().zip(y)) {
            *sum += x * y;
        }
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + tail
}

/// Instruments of one record: columns, and for each column the index of its free coefficient.
pub(super) struct RecordInstruments {
    pub(super) columns: Vec<Vec<f64>>,
    pub(super) unknown_indices: Vec<usize>,
}

impl RecordInstruments {
    fn column_of(&self, unknown: usize) -> Option<&Vec<f64>> {
        self.unknown_indices.iter().position(|p| *p == unknown).map(|index| &self.columns[index])
    }
}

/// An instrument counts as linearly dependent on the previous ones if its component outside their span has a norm of at
/// most this fraction of its own norm.
const RANK_TOLERANCE: f64 = 1e-13;

/// Orthonormalize the instruments of all records in place.
///
/// Each of the `k` free coefficients has one instrument, which is stacked over all records. The result is the factor Q
/// of a QR factorization by the Gram–Schmidt process with reorthogonalization. The span is unchanged, so the estimate
/// is the same. The products of Q with the regressors have the condition number of the regressors. The products of the
/// original instruments with the regressors would have the square of that number.
///
/// The cost is O(records · k² m) for k free coefficients per record of m pulses.
///
/// # Errors
/// [`Error::Singular`] if an instrument depends linearly on the previous ones.
pub(super) fn orthonormalize_instruments(records: &mut [RecordInstruments], k: usize) -> Result<()> {
    let mut counts = vec![0; k];
    records.iter().flat_map(|r| &r.unknown_indices).for_each(|&unknown| counts[unknown] += 1);
    let singular = |unknown| Error::Singular { index: unknown, count: k };
    // Coefficients of a single record come first. Their columns in different records are orthogonal without
    // computation.
    for record in &mut *records {
        for index in (0..record.unknown_indices.len()).filter(|&index| counts[record.unknown_indices[index]] == 1) {
            let mut column = [std::mem::take(&mut record.columns[index])];
            let is_independent = orthonormalize_column(&mut column, |column| {
                for previous in (0..index).filter(|&previous| counts[record.unknown_indices[previous]] == 1) {
                    subtract_projection(&mut column[0], &record.columns[previous], None);
                }
            });
            if !is_independent {
                return Err(singular(record.unknown_indices[index]));
            }
            [record.columns[index]] = column;
        }
    }
    let shared_unknowns: Vec<usize> = (0..k).filter(|&unknown| counts[unknown] > 1).collect();
    for (n, &unknown) in shared_unknowns.iter().enumerate() {
        // The column of a coefficient is empty in records without it.
        let mut parts: Vec<Vec<f64>> =
            records.iter().map(|r| r.column_of(unknown).cloned().unwrap_or_default()).collect();
        let is_independent = orthonormalize_column(&mut parts, |parts| {
            for (part, record) in parts.iter_mut().zip(&*records).filter(|(part, _)| !part.is_empty()) {
                for (column, _) in record.columns.iter().zip(&record.unknown_indices).filter(|(_, p)| counts[**p] == 1)
                {
                    subtract_projection(part, column, None);
                }
            }
            for &previous in &shared_unknowns[..n] {
                let pairs = records.iter().map(|r| r.column_of(previous)).zip(&*parts);
                let component =
                    pairs.map(|(q, part)| q.filter(|_| !part.is_empty()).map_or(0.0, |q| dot(q, part))).sum();
                for (part, record) in parts.iter_mut().zip(&*records).filter(|(part, _)| !part.is_empty()) {
                    if let Some(q) = record.column_of(previous) {
                        subtract_projection(part, q, Some(component));
                    }
                }
            }
        });
        if !is_independent {
            return Err(singular(unknown));
        }
        for (record, part) in records.iter_mut().zip(parts) {
            if let Some(index) = record.unknown_indices.iter().position(|p| *p == unknown) {
                record.columns[index] = part;
            }
        }
    }
    Ok(())
}

/// Subtract `component` times a unit direction from a column. If `component` is None, it is the dot product of the two.
fn subtract_projection(column: &mut [f64], direction: &[f64], component: Option<f64>) {
    let component = component.unwrap_or_else(|| dot(direction, column));
    column.iter_mut().zip(direction).for_each(|(v, q)| *v -= component * q);
}

/// Orthogonalize a column with the function `orthogonalize`, and normalize it. The orthogonalization is repeated once
/// if it has at least halved the norm.
///
/// The column is given as one part per record. Return false if the orthogonalized column is at rounding level.
fn orthonormalize_column(parts: &mut [Vec<f64>], orthogonalize: impl Fn(&mut [Vec<f64>])) -> bool {
    let initial_norm = stacked_norm(parts);
    let (mut previous_norm, mut norm) = (initial_norm, initial_norm);
    for _ in 0..2 {
        orthogonalize(parts);
        norm = stacked_norm(parts);
        // Rounding errors along the previous columns grow by the factor by which the norm has decreased.
        if norm > 0.5 * previous_norm {
            break;
        }
        previous_norm = norm;
    }
    let scale = 1.0 / norm;
    parts.iter_mut().flatten().for_each(|v| *v *= scale);
    norm > RANK_TOLERANCE * initial_norm && scale.is_finite() && norm.is_finite()
}

fn stacked_norm(parts: &[Vec<f64>]) -> f64 {
    parts.iter().map(|p| dot(p, p)).sum::<f64>().sqrt()
}

/// Add the long-run covariance of the summed scores to the k × k row-major matrix `score_covariance`.
///
/// `scores` has one row of samples per instrument, and `unknown_indices` contains the index of each instrument in the
/// matrix. Lags have Bartlett weights (Newey and West, doi:10.2307/1913610), because filtered residuals are not white
/// if other measured outputs enter the equation.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn add_long_run_covariance(
    scores: &[Vec<f64>],
    unknown_indices: &[usize],
    score_covariance: &mut [f64],
    k: usize,
) {
    let m = scores.first().map_or(0, Vec::len);
    let lags = ((4.0 * libm::cbrt(m as f64)) as usize).min(m.saturating_sub(1));
    for (left, &a) in scores.iter().zip(unknown_indices) {
        for (right, &b) in scores.iter().zip(unknown_indices) {
            score_covariance[a * k + b] += dot(left, right);
            for lag in 1..=lags {
                let weight = 1.0 - lag as f64 / (lags + 1) as f64;
                let lag_products = dot(&left[lag..], &right[..m - lag]) + dot(&left[..m - lag], &right[lag..]);
                score_covariance[a * k + b] += weight * lag_products;
            }
        }
    }
}

//! Fit of the initial terms of a simulation to the measured samples, by least squares.

use super::richardson::{add_multiple, Rows};
use crate::error::{check_length, Error, Result};
use crate::linalg::dense::minimum_norm_solution;
use crate::linalg::orthogonal::norm;
use crate::signal::statistics::mean;

/// Singular value of the responses to initial terms, relative to the largest one, below which the responses count as
/// collinear. The joint fit uses the same value.
const COLLINEARITY_TOLERANCE: f64 = 1e-12;

/// Samples of a simulation, and its initial terms.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputSamples {
    /// Samples of each output. They are filtered if the output was measured through the sensor filter, and not finite
    /// if the simulation diverges.
    pub outputs: Vec<Vec<f64>>,
    /// Initial terms of each equation as (exponent, coefficient).
    pub initial: Vec<Vec<(f64, f64)>>,
}

/// Return the weight of an output: 1 over the standard deviation of its measured samples, or 1 if these are constant.
pub(super) fn weight(measured: &[f64]) -> f64 {
    let finite: Vec<f64> = measured.iter().copied().filter(|v| !v.is_nan()).collect();
    let level = mean(&finite);
    let deviation = mean(&finite.iter().map(|v| (v - level) * (v - level)).collect::<Vec<_>>()).sqrt();
    if deviation > 0.0 {
        1.0 / deviation
    } else {
        1.0
    }
}

/// Fit initial terms to the measured samples, and add their responses to the samples `rest_samples` of a simulation
/// from rest.
///
/// `units` holds (index of the equation, exponent) of each term, and `columns` the samples of all outputs for this term
/// with coefficient 1. With `has_level`, the level of each output is an additional term with the exponent ∞. The weight
/// of an output is the inverse of the standard deviation of its measurement. Missing samples are NaN and have weight 0.
/// If terms are collinear, the solution of minimum norm is used.
///
/// # Errors
/// [`Error::Length`] if the numbers of samples, outputs or terms differ. [`Error::Structure`] for an equation index out
/// of range.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::output_samples::fit_initial_terms;
/// let measured = vec![vec![1.0, 3.0, f64::NAN, 7.0]];
/// let ramp = vec![vec![vec![0.0, 1.0, 2.0, 3.0]]];
/// let found = fit_initial_terms(&measured, vec![vec![0.0; 4]], &[(0, 1.0)], ramp, true)?;
/// assert!(found.outputs[0].iter().zip([1.0, 3.0, 5.0, 7.0]).all(|(a, b)| (a - b).abs() < 1e-12));
/// assert!((found.initial[0][0].1 - 2.0).abs() < 1e-12 && (found.initial[0][1].1 - 1.0).abs() < 1e-12);
/// # Ok(())
/// # }
/// ```
pub fn fit_initial_terms(
    measured: &[Vec<f64>],
    rest_samples: Vec<Vec<f64>>,
    units: &[(usize, f64)],
    mut columns: Vec<Rows>,
    has_level: bool,
) -> Result<OutputSamples> {
    let (n, count) = (rest_samples.len(), rest_samples.first().map_or(0, Vec::len));
    check_length("responses to initial terms", units.len(), columns.len())?;
    for rows in columns.iter().map(Vec::as_slice).chain([measured]) {
        check_length("outputs", n, rows.len())?;
        rows.iter().try_for_each(|row| check_length("samples of an output", count, row.len()))?;
    }
    let mut units = units.to_vec();
    for i in 0..if has_level { n } else { 0 } {
        units.push((i, f64::INFINITY));
        columns.push((0..n).map(|j| vec![f64::from(u8::from(i == j)); count]).collect());
    }
    if units.iter().any(|(i, _)| *i >= n) {
        let what = format!("an initial term of an equation beyond {n}");
        return Err(Error::Structure { what, remedy: "number them from 0".into() });
    }
    let weights: Vec<f64> = measured.iter().map(|row| weight(row)).collect();
    let weight_rows = |rows: &Rows| -> Vec<f64> {
        let weight_row = |((row, sample), w): ((&Vec<f64>, &Vec<f64>), &f64)| -> Vec<f64> {
            row.iter().zip(sample).map(|(v, sample)| if sample.is_nan() { 0.0 } else { w * v }).collect()
        };
        rows.iter().zip(measured).zip(&weights).flat_map(weight_row).collect()
    };
    let differences =
        measured.iter().zip(&rest_samples).map(|(y, v)| y.iter().zip(v).map(|(y, v)| y - v).collect()).collect();
    let mut weighted_columns: Vec<Vec<f64>> = columns.iter().map(weight_rows).collect();
    let norms: Vec<f64> = weighted_columns.iter().map(|column| norm(column)).collect();
    let usable_columns: Vec<usize> = (0..norms.len()).filter(|&k| norms[k].is_finite() && norms[k] > 0.0).collect();
    let columns_of_matrix: Vec<Vec<f64>> = usable_columns
        .iter()
        .map(|&k| std::mem::take(&mut weighted_columns[k]).into_iter().map(|v| v / norms[k]).collect())
        .collect();
    let convergence_error = || Error::Internal { what: "singular values of initial terms that do not converge".into() };
    let solution = minimum_norm_solution(&columns_of_matrix, &weight_rows(&differences), COLLINEARITY_TOLERANCE)
        .ok_or_else(convergence_error)?;
    let mut values = vec![0.0; units.len()];
    for (&k, value) in usable_columns.iter().zip(solution) {
        values[k] = value / norms[k];
    }
    let (mut outputs, mut initial) = (rest_samples, vec![Vec::new(); n]);
    for ((&(i, exponent), value), column) in units.iter().zip(values).zip(&columns) {
        initial[i].push((exponent, value));
        if value != 0.0 {
            outputs.iter_mut().zip(column).for_each(|(row, v)| add_multiple(row, value, v));
        }
    }
    Ok(OutputSamples { outputs, initial })
}

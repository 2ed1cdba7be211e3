//! Covariance of the parameters of a joint fit, from its Jacobian and residuals.

use super::objective::Objective;
use super::problem::OptimizationResult;
use crate::error::{check_finite, check_length, Error, Result};
use crate::linalg::dense::{self, triangular_factor_by_blocks};
use crate::linalg::orthogonal::extend_orthonormal;
use crate::signal::statistics::{
    burg_filter, filter_autocovariances, inner, is_white, multiply_toeplitz, robust_deviation, sum, HUBER_THRESHOLD,
    WHITENESS_LAGS,
};

/// Exponent e in the number of autocovariance lags of the robust covariance, which is 4 N^e for N samples.
const LAG_POWER: f64 = 1.0 / 3.0;
/// Minimum fraction of the noise variance that is assumed to remain in the residuals of a fit.
const MIN_RESIDUAL_NOISE_RATIO: f64 = 0.2;

/// Minimum number of samples per lag of the test for white noise.
///
/// With fewer samples, the test often misses autocorrelation: it passes half of all series of 60 residuals with a
/// correlation of 0.5 between adjacent ones. The covariance is then also computed for autoregressive noise, and the
/// larger variance is used.
const MIN_SAMPLES_PER_TESTED_LAG: usize = 10;

/// Return true if there are enough residuals for the test for white noise to detect autocorrelation.
fn is_long_enough_for_test(residuals: &[f64]) -> bool {
    residuals.iter().filter(|e| !e.is_nan()).count() >= MIN_SAMPLES_PER_TESTED_LAG * WHITENESS_LAGS
}

/// Return the row-major covariance matrix of the parameters; it is robust to autocorrelated residuals.
///
/// White residuals yield the classical covariance. A parameter has an infinite variance if it has a component along a
/// direction that is not identifiable. With a robust loss, the result is the covariance of an M-estimator (Huber &
/// Ronchetti, doi:10.1002/9780470434697, §7.6). It is computed from clipped residuals, divided by the fraction of
/// residuals that are not clipped.
///
/// # Errors
/// [`Error::NotFinite`] if the Jacobian is not finite. [`Error::Length`] if the residuals have another length than its
/// rows. [`Error::Structure`] if its singular values are not found.
pub fn covariance(result: &OptimizationResult, objective: &Objective<'_>) -> Result<Vec<f64>> {
    let series: Vec<Vec<f64>> = objective.residuals(result).into_iter().flatten().collect();
    let priors = objective.problem.model.priors.len();
    let robust_weights = objective.weights.robust_weights.is_some().then(|| {
        let mut weights = objective.flat_sample_weights();
        weights.resize(weights.len() + priors, 1.0);
        weights
    });
    robust_covariance(&result.jacobian, series, robust_weights.as_deref(), priors)
}

/// Return the row-major covariance matrix of the parameters from a Jacobian and residuals.
///
/// `jacobian` has one row per parameter and includes the robust weights. Its last `priors` columns are the derivatives
/// of the residuals of priors. `series` contains the residuals of samples by run and output, without robust weights.
/// `robust_weights` contains the robust weight of each column; it is None for a squared loss.
///
/// # Errors
/// [`Error::NotFinite`] if the Jacobian is not finite. [`Error::Length`] if `robust_weights` has another length than
/// its rows, or the residuals another length than its rows without `priors`. [`Error::Structure`] if its singular
/// values are not found.
pub fn robust_covariance(
    jacobian: &[Vec<f64>],
    series: Vec<Vec<f64>>,
    robust_weights: Option<&[f64]>,
    priors: usize,
) -> Result<Vec<f64>> {
    let squares = |series: &[Vec<f64>]| {
        let finite_squares =
            |e: &Vec<f64>| sum(&e.iter().map(|v| if v.is_nan() { 0.0 } else { v * v }).collect::<Vec<_>>());
        series.iter().map(finite_squares).sum::<f64>()
    };
    let Some(robust_weights) = robust_weights else {
        return covariance_of_residuals(jacobian, &series, squares(&series), priors);
    };
    jacobian.iter().try_for_each(|row| check_length("robust weights of residuals", row.len(), robust_weights.len()))?;
    let (series, unclipped_fraction) = huber_pseudo_residuals(series, jacobian.len());
    let samples = robust_weights.len().saturating_sub(priors);
    // The curvature of the loss is that of least squares times the fraction of residuals that are not clipped.
    let unweight = |(k, (value, &robust_weight)): (usize, (&f64, &f64))| {
        let curvature = if k < samples { unclipped_fraction.sqrt() } else { 1.0 };
        curvature * value / if robust_weight > 0.0 { robust_weight } else { 1.0 }
    };
    let rows: Vec<Vec<f64>> =
        jacobian.iter().map(|row| row.iter().zip(robust_weights).enumerate().map(unweight).collect()).collect();
    covariance_of_residuals(&rows, &series, squares(&series), priors)
}

/// Pseudo-residuals of Huber's loss, and the fraction of residuals that are not clipped.
///
/// Least squares on the pseudo-residuals, with a Jacobian multiplied by the square root of the fraction, has the
/// covariance of the M-estimator.
#[allow(clippy::cast_precision_loss)]
fn huber_pseudo_residuals(mut series: Vec<Vec<f64>>, parameters: usize) -> (Vec<Vec<f64>>, f64) {
    let finite: Vec<f64> = series.iter().flatten().copied().filter(|e| !e.is_nan()).collect();
    let level = match robust_deviation(&finite) {
        0.0 => 1.0,
        level => level,
    };
    let (clip_level, count) = (HUBER_THRESHOLD * level, finite.len().max(1) as f64);
    let unclipped_fraction = (finite.iter().filter(|e| e.abs() < clip_level).count() as f64 / count).max(1.0 / count);
    // Huber's small-sample correction.
    let small_sample_factor = 1.0 + parameters as f64 / count * (1.0 - unclipped_fraction) / unclipped_fraction;
    let scale = small_sample_factor / unclipped_fraction.sqrt();
    series
        .iter_mut()
        .flatten()
        .for_each(|e| *e = if e.is_nan() { *e } else { e.clamp(-clip_level, clip_level) * scale });
    (series, unclipped_fraction)
}

/// Return the row-major covariance matrix of the parameters from a Jacobian, residuals and their sum of squares.
///
/// `jacobian` has one row per parameter. Its last `priors` columns are the derivatives of the residuals of priors,
/// which are in standard deviations of the priors. `series` contains the residuals of samples by run and output, NaN
/// for missing samples. `squares` is their sum of squares.
///
/// With priors, the result is the mean square error of the estimate, averaged over the noise and over parameters drawn
/// from the priors. For white noise, this is the linearized covariance of the posterior distribution.
///
/// The computation uses the singular values of the Jacobian with rows scaled to unit norm, because the normal equations
/// would lose half of the digits. Singular values at rounding level count as zero, and the corresponding parameter
/// directions as not identifiable. Covariances with a parameter of infinite variance are NaN. The cost is O(p² m + p m
/// log m) for p parameters and m residuals.
///
/// # Errors
/// [`Error::NotFinite`] if the Jacobian is not finite. [`Error::Length`] if its rows differ in length, or if the length
/// of autocorrelated residuals is not that of its rows without `priors`. [`Error::Structure`] if its singular values
/// are not found.
#[allow(clippy::cast_precision_loss)]
pub fn covariance_of_residuals(
    jacobian: &[Vec<f64>],
    series: &[Vec<f64>],
    squares: f64,
    priors: usize,
) -> Result<Vec<f64>> {
    let (p, count) = (jacobian.len(), jacobian.first().map_or(0, Vec::len));
    if p == 0 {
        return Ok(Vec::new());
    }
    let finite_count = series.iter().flatten().filter(|e| !e.is_nan()).count();
    let norms: Vec<f64> = jacobian
        .iter()
        .map(|row| {
            let row_norm = sum(&row.iter().map(|v| v * v).collect::<Vec<_>>()).sqrt();
            if row_norm > 0.0 {
                row_norm
            } else {
                1.0
            }
        })
        .collect();
    for row in jacobian {
        check_length("a row of a Jacobian", count, row.len())?;
        check_finite("a column", row)?;
    }
    let singular_value_error = || Error::Structure {
        what: "singular values of a Jacobian are not found".into(),
        remedy: "scale the parameters".into(),
    };
    // The triangular factor has the same singular values and right singular vectors.
    let factor = triangular_factor_by_blocks((p, count), |i, range, out| {
        out.extend(jacobian[i][range].iter().map(|v| v / norms[i]));
    });
    let factor_columns: Vec<Vec<f64>> = (0..p).map(|j| (0..p).map(|i| factor[i * p + j]).collect()).collect();
    let dense::SingularValues { values: singular_values, right, .. } =
        dense::singular_values(&factor_columns).ok_or_else(singular_value_error)?;
    let largest = singular_values.iter().copied().fold(0.0, f64::max);
    let rounding_level = f64::EPSILON * (count.max(1) as f64).sqrt() * largest;
    let significant: Vec<usize> = (0..singular_values.len()).filter(|&k| singular_values[k] > rounding_level).collect();
    // Largest angle between an identifiable and a non-identifiable direction that rounding can cause.
    let threshold =
        significant.iter().map(|&k| singular_values[k]).reduce(f64::min).map_or(0.0, |least| rounding_level / least);
    let has_unidentifiable_component = |i: usize| {
        let unidentifiable_squares = (0..singular_values.len())
            .filter(|k| singular_values[*k] <= rounding_level)
            .map(|k| right[k][i] * right[k][i]);
        unidentifiable_squares.sum::<f64>().sqrt() > threshold
    };
    let mut is_unidentifiable: Vec<bool> =
        (0..p).map(|i| significant.len() < singular_values.len() && has_unidentifiable_component(i)).collect();
    // Rows of the pseudoinverse in the singular basis: the outer factor of the sandwich covariance.
    let inverse: Vec<Vec<f64>> =
        (0..p).map(|i| significant.iter().map(|&k| right[k][i] / singular_values[k]).collect()).collect();
    let samples = count.saturating_sub(priors);
    let passes_test = series.iter().all(|e| is_white(e, WHITENESS_LAGS));
    let is_white_noise = passes_test && series.iter().all(|e| is_long_enough_for_test(e));
    // Orthonormal basis of the columns of the scaled Jacobian: its left singular vectors.
    let mut basis: Vec<Vec<f64>> = Vec::new();
    for &k in if is_white_noise && priors == 0 { &[][..] } else { &significant } {
        let mut vector = vec![0.0; count];
        for (row, (component, norm)) in jacobian.iter().zip(right[k].iter().zip(&norms)) {
            let weight = component / singular_values[k];
            vector.iter_mut().zip(row).for_each(|(v, slope)| *v += weight * (slope / norm));
        }
        extend_orthonormal(&mut basis, vector, 0.0);
    }
    let prior_basis: Vec<Vec<f64>> = basis.iter_mut().map(|vector| vector.split_off(samples)).collect();
    let prior_rows: Vec<Vec<f64>> = inverse.iter().map(|row| weighted_row_sum(row, &prior_basis, priors)).collect();
    let prior_contribution = |at: usize| inner(&prior_rows[at / p], &prior_rows[at % p]);
    // Number of parameters that the samples determine; the priors determine the others.
    let sample_degrees = p as f64 - prior_basis.iter().map(|row| inner(row, row)).sum::<f64>();
    let level = squares / (finite_count as f64 - sample_degrees).max(1.0);
    let for_white_noise: Vec<f64> = (0..p * p)
        .map(|index| level * (inner(&inverse[index / p], &inverse[index % p]) - prior_contribution(index)))
        .collect();
    let mut scaled_covariance: Vec<f64> = if is_white_noise {
        for_white_noise
    } else {
        check_length("residuals", samples, series.iter().map(Vec::len).sum())?;
        // The covariance is B M Bᵀ. B does not depend on the noise, and M is computed in the basis of the regressors.
        let sandwich = |middle: &[f64]| -> Vec<f64> {
            let middle_rows: Vec<Vec<f64>> = middle.chunks(basis.len().max(1)).map(<[f64]>::to_vec).collect();
            let products: Vec<Vec<f64>> =
                inverse.iter().map(|row| weighted_row_sum(row, &middle_rows, basis.len())).collect();
            (0..p * p).map(|index| inner(&products[index / p], &inverse[index % p])).collect()
        };
        let autoregressive = sandwich(&autoregressive_covariance(&basis, series));
        if passes_test {
            widen_covariance(for_white_noise, &autoregressive)
        } else {
            widen_covariance(autoregressive, &sandwich(&long_run_covariance(&basis, series)?))
        }
    };
    scaled_covariance.iter_mut().enumerate().for_each(|(index, value)| *value += prior_contribution(index));
    // The variance of a parameter with almost no effect can overflow.
    let mut result: Vec<f64> =
        (0..p * p).map(|index| scaled_covariance[index] / (norms[index / p] * norms[index % p])).collect();
    (0..p).for_each(|i| is_unidentifiable[i] |= !result[i * p + i].is_finite());
    for (index, value) in result.iter_mut().enumerate() {
        let (i, j) = (index / p, index % p);
        if is_unidentifiable[i] || is_unidentifiable[j] {
            *value = if i == j { f64::INFINITY } else { f64::NAN };
        }
    }
    Ok(result)
}

/// Return Σ weight · row, the weighted sum of rows with `count` elements each.
fn weighted_row_sum(weights: &[f64], rows: &[Vec<f64>], count: usize) -> Vec<f64> {
    let mut out = vec![0.0; count];
    for (weight, row) in weights.iter().zip(rows) {
        out.iter_mut().zip(row).for_each(|(v, r)| *v += weight * r);
    }
    out
}

/// Return the number of autocovariance lags for a number of samples.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn lag_count(samples: usize) -> usize {
    (4.0 * libm::pow(samples as f64, LAG_POWER)) as usize
}

/// Return the quadratic form R C Rᵀ, row-major, of rows R with the Toeplitz matrix C of the autocovariances.
fn quadratic_form(rows: &[&[f64]], covariances: &[f64]) -> Vec<f64> {
    let (p, weighted) = (rows.len(), multiply_toeplitz(rows, covariances));
    let product = |i: usize, j: usize| inner(&weighted[i], rows[j]);
    (0..p * p).map(|index| 0.5 * (product(index / p, index % p) + product(index % p, index / p))).collect()
}

/// Return the covariance of the products of an orthonormal basis of the regressors with noise that is modeled by an
/// autoregression of the residuals.
///
/// `series` contains the residuals by run and output. The result is row-major.
///
/// The regressors do not depend on the noise, so the autocovariances of the noise determine the covariance. An
/// autoregression describes them with few parameters. Sums over lags would miss slow correlations such as 0.9 per
/// sample. The fit removes the noise along `basis` from the residuals. The result is corrected for this loss, which is
/// larger if the noise has the spectrum of the regressors.
#[allow(clippy::cast_precision_loss)]
fn autoregressive_covariance(basis: &[Vec<f64>], series: &[Vec<f64>]) -> Vec<f64> {
    let mut total = vec![0.0; basis.len() * basis.len()];
    let mut start = 0;
    for residuals in series {
        let range = start..start + residuals.len();
        start = range.end;
        let count = residuals.iter().filter(|e| !e.is_nan()).count();
        if count == 0 {
            continue;
        }
        let (filter, power) = burg_filter(residuals, lag_count(count));
        let covariances = filter_autocovariances(&filter, power, residuals.len());
        if covariances[0].is_nan() || covariances[0] <= 0.0 {
            continue;
        }
        let rows: Vec<&[f64]> = basis.iter().map(|row| &row[range.clone()]).collect();
        let contribution = quadratic_form(&rows, &covariances);
        let explained = contribution.iter().step_by(basis.len() + 1).sum::<f64>() / covariances[0];
        let remainder = (1.0 - explained / count as f64).max(MIN_RESIDUAL_NOISE_RATIO);
        total.iter_mut().zip(contribution).for_each(|(sum, value)| *sum += value / remainder);
    }
    total
}

/// Scale `covariance` so that no variance is below that of `minimum`; correlations are unchanged.
fn widen_covariance(covariance: Vec<f64>, minimum: &[f64]) -> Vec<f64> {
    let p = covariance.len().isqrt();
    let scale_of = |i: usize| (minimum[i * p + i] / covariance[i * p + i].max(f64::MIN_POSITIVE)).max(1.0).sqrt();
    let scales: Vec<f64> = (0..p).map(scale_of).collect();
    covariance.iter().enumerate().map(|(at, value)| value * scales[at / p] * scales[at % p]).collect()
}

/// Return the long-run covariance of the summed scores, the middle factor of the sandwich covariance, row-major.
///
/// `jacobian` has one row per parameter. `series` contains the residuals by run and output, NaN for missing samples.
/// Lags have Bartlett weights (Newey and West, doi:10.2307/1913610). The weighted sum over lags has the form of a
/// product with a Toeplitz matrix, so it is computed as a circular convolution. The cost is O(p² m + p m log m) for p
/// parameters and m residuals.
///
/// # Errors
/// [`Error::Length`] if the residuals and the rows of the Jacobian differ in length.
#[allow(clippy::cast_precision_loss)]
pub fn long_run_covariance(jacobian: &[Vec<f64>], series: &[Vec<f64>]) -> Result<Vec<f64>> {
    let count = series.iter().map(Vec::len).sum();
    jacobian.iter().try_for_each(|row| check_length("a row of a Jacobian", count, row.len()))?;
    let mut total = vec![0.0; jacobian.len() * jacobian.len()];
    let mut start = 0;
    for residuals in series {
        let range = start..start + residuals.len();
        start = range.end;
        if residuals.is_empty() {
            continue;
        }
        let score = |(slope, e): (&f64, &f64)| if e.is_nan() { 0.0 } else { slope * e };
        let scores: Vec<Vec<f64>> =
            jacobian.iter().map(|row| row[range.clone()].iter().zip(residuals).map(score).collect()).collect();
        let rows: Vec<&[f64]> = scores.iter().map(Vec::as_slice).collect();
        let window = lag_count(residuals.len());
        let reach = window.min(residuals.len().saturating_sub(1));
        let weight = |lag: usize| match lag {
            0 => 1.0,
            lag if lag < reach => 1.0 - lag as f64 / window as f64,
            _ => 0.0,
        };
        let weights: Vec<f64> = (0..residuals.len()).map(weight).collect();
        total.iter_mut().zip(quadratic_form(&rows, &weights)).for_each(|(sum, contribution)| *sum += contribution);
    }
    Ok(total)
}

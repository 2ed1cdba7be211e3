//! The covariance that a joint fit's residuals leave.

use super::objective::Grid;
use super::problem::Attempt;
use crate::error::{check_finite, check_length, Error, Result};
use crate::linalg::dense;
use crate::signal::statistics::{coloured, covariances, inner, is_white, robust_deviation, sum, weighted, BEND, LAGS};

/// Lags of the residuals' autocovariance that the robust covariance takes in, as a power of the sample count.
const LAG_POWER: f64 = 1.0 / 3.0;
/// Least share of the noise that a fit is taken to leave in its residuals.
const LEAST_LEFT: f64 = 0.2;

/// Covariance of the parameters by rows: classical where residuals are white, robust to their colour where not.
///
/// Nothing is truncated: a parameter that takes part in a direction which the runs do not see has an infinite variance.
/// Under a robust loss it is that of an M-estimator: residuals count as far as the loss lets them, over the share of them
/// that moves with the parameters (Huber & Ronchetti, doi:10.1002/9780470434697, §7.6).
///
/// # Errors
/// Those of [`of_residuals`].
pub fn covariance(attempt: &Attempt, grid: &Grid<'_>) -> Result<Vec<f64>> {
    let series: Vec<Vec<f64>> = grid.residuals(attempt).into_iter().flatten().collect();
    let shares = grid.weights.shares.is_some().then(|| grid.every_share());
    of_fit(&attempt.jacobian, series, shares.as_deref())
}

/// The same from a Jacobian of residuals that count by shares, and residuals by run and output, whatever their shares.
///
/// # Errors
/// Those of [`of_residuals`].
pub fn of_fit(jacobian: &[Vec<f64>], series: Vec<Vec<f64>>, shares: Option<&[f64]>) -> Result<Vec<f64>> {
    let squares = |series: &[Vec<f64>]| {
        let of = |e: &Vec<f64>| sum(&e.iter().map(|v| if v.is_nan() { 0.0 } else { v * v }).collect::<Vec<_>>());
        series.iter().map(of).sum::<f64>()
    };
    let Some(shares) = shares else { return of_residuals(jacobian, &series, squares(&series)) };
    jacobian.iter().try_for_each(|row| check_length("shares of residuals", row.len(), shares.len()))?;
    let whole = |(value, &share): (&f64, &f64)| value / if share > 0.0 { share } else { 1.0 };
    let rows: Vec<Vec<f64>> = jacobian.iter().map(|row| row.iter().zip(shares).map(whole).collect()).collect();
    let series = bent(series, jacobian.len());
    of_residuals(&rows, &series, squares(&series))
}

/// Residuals as Huber's loss lets them count, so that squares of these have its covariance.
#[allow(clippy::cast_precision_loss)]
fn bent(mut series: Vec<Vec<f64>>, parameters: usize) -> Vec<Vec<f64>> {
    let known: Vec<f64> = series.iter().flatten().copied().filter(|e| !e.is_nan()).collect();
    let level = match robust_deviation(&known) {
        0.0 => 1.0,
        level => level,
    };
    let (most, count) = (BEND * level, known.len().max(1) as f64);
    let moving = (known.iter().filter(|e| e.abs() < most).count() as f64 / count).max(1.0 / count);
    // Huber's correction for few samples.
    let few = 1.0 + parameters as f64 / count * (1.0 - moving) / moving;
    series.iter_mut().flatten().for_each(|e| *e = if e.is_nan() { *e } else { e.clamp(-most, most) * few / moving });
    series
}

/// Covariance by rows from a Jacobian (a row a parameter), residuals by run and output, and the sum of their squares.
/// Residuals are no numbers where nothing was read.
///
/// By the singular values of the Jacobian, rows scaled to one length: a product with itself would hide half of the digits.
/// Singular values below rounding are zero, and the directions that belong to them unseen. Covariances with a parameter of
/// infinite variance are not numbers. O(p² m + p m log m).
///
/// # Errors
/// [`Error::NotFinite`] for the Jacobian, [`Error::Length`] where coloured residuals are not as long as it.
#[allow(clippy::cast_precision_loss)]
pub fn of_residuals(jacobian: &[Vec<f64>], series: &[Vec<f64>], squares: f64) -> Result<Vec<f64>> {
    let (p, count) = (jacobian.len(), jacobian.first().map_or(0, Vec::len));
    if p == 0 {
        return Ok(Vec::new());
    }
    let known = series.iter().flatten().filter(|e| !e.is_nan()).count();
    let lengths: Vec<f64> = jacobian
        .iter()
        .map(|row| {
            let length = sum(&row.iter().map(|v| v * v).collect::<Vec<_>>()).sqrt();
            if length > 0.0 {
                length
            } else {
                1.0
            }
        })
        .collect();
    let mut columns = Vec::with_capacity(p);
    for (row, length) in jacobian.iter().zip(&lengths) {
        check_length("a row of a Jacobian", count, row.len())?;
        check_finite("a column", row)?;
        let mut column: Vec<f64> = row.iter().map(|v| v / length).collect();
        column.resize(count.max(p), 0.0);
        columns.push(column);
    }
    let unfound = || Error::Structure {
        what: "singular values of a Jacobian are not found".into(),
        remedy: "scale the parameters".into(),
    };
    let dense::Singular { left: rows, sizes, right } = dense::singular(&columns).ok_or_else(unfound)?;
    let largest = sizes.iter().copied().fold(0.0, f64::max);
    let rounding = f64::EPSILON * (count.max(1) as f64).sqrt() * largest;
    let seen: Vec<usize> = (0..sizes.len()).filter(|&k| sizes[k] > rounding).collect();
    // How far rounding may turn a seen direction into an unseen one.
    let turned = seen.iter().map(|&k| sizes[k]).reduce(f64::min).map_or(0.0, |least| rounding / least);
    let beyond = |i: usize| {
        let lost = (0..sizes.len()).filter(|k| sizes[*k] <= rounding).map(|k| right[k][i] * right[k][i]);
        lost.sum::<f64>().sqrt() > turned
    };
    let mut unseen: Vec<bool> = (0..p).map(|i| seen.len() < sizes.len() && beyond(i)).collect();
    // Least-squares answers to unit residuals: the factors of the bread, so that no product of it is ever formed.
    let inverse: Vec<Vec<f64>> = (0..p).map(|i| seen.iter().map(|&k| right[k][i] / sizes[k]).collect()).collect();
    let middle = if series.iter().all(|e| is_white(e, LAGS)) {
        let level = squares / known.saturating_sub(p).max(1) as f64;
        (0..p * p).map(|at| level * inner(&inverse[at / p], &inverse[at % p])).collect()
    } else {
        check_length("residuals", count, series.iter().map(Vec::len).sum())?;
        let basis: Vec<&[f64]> = seen.iter().map(|&k| &rows[k][..count]).collect();
        let answers = inverse.iter().map(|row| combined(row, &basis, count)).collect::<Vec<_>>();
        wider(of_colour(&answers, &basis, series), &long_run(&answers, series)?)
    };
    // Of what moves next to nothing a variance may be beyond the numbers.
    let mut result: Vec<f64> = (0..p * p).map(|at| middle[at] / (lengths[at / p] * lengths[at % p])).collect();
    (0..p).for_each(|i| unseen[i] |= !result[i * p + i].is_finite());
    for (at, value) in result.iter_mut().enumerate() {
        let (i, j) = (at / p, at % p);
        if unseen[i] || unseen[j] {
            *value = if i == j { f64::INFINITY } else { f64::NAN };
        }
    }
    Ok(result)
}

/// Σ weight · row.
fn combined(weights: &[f64], rows: &[&[f64]], count: usize) -> Vec<f64> {
    let mut out = vec![0.0; count];
    for (weight, row) in weights.iter().zip(rows) {
        out.iter_mut().zip(*row).for_each(|(v, r)| *v += weight * r);
    }
    out
}

/// The largest whole number of lags for so many samples.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn lags(samples: usize) -> usize {
    (4.0 * libm::pow(samples as f64, LAG_POWER)) as usize
}

/// Rows times the matrix of a series' autocovariances times rows again.
fn between(rows: &[&[f64]], covariances: &[f64]) -> Vec<f64> {
    let (p, weighted) = (rows.len(), weighted(rows, covariances));
    let product = |i: usize, j: usize| inner(&weighted[i], rows[j]);
    (0..p * p).map(|at| 0.5 * (product(at / p, at % p) + product(at % p, at / p))).collect()
}

/// Covariance of least-squares answers to noise whose colour is that of an autoregression of the residuals.
///
/// What the answers are to does not depend on the noise, so its autocovariances say all. An autoregression tells them from
/// few numbers, where sums over lags lose the slow part of a colour such as 0.9 a sample. The fit has taken from the
/// residuals what noise there is in the directions of its orthonormal basis: more than its share, where the colour is that
/// of the regressors.
#[allow(clippy::cast_precision_loss)]
fn of_colour(answers: &[Vec<f64>], basis: &[&[f64]], series: &[Vec<f64>]) -> Vec<f64> {
    let mut total = vec![0.0; answers.len() * answers.len()];
    let mut at = 0;
    for residuals in series {
        let there = at..at + residuals.len();
        at = there.end;
        let known = residuals.iter().filter(|e| !e.is_nan()).count();
        if known == 0 {
            continue;
        }
        let (through, power) = coloured(&[residuals], lags(known));
        let covariances = covariances(&through, power, residuals.len());
        if covariances[0].is_nan() || covariances[0] <= 0.0 {
            continue;
        }
        let directions: Vec<&[f64]> = basis.iter().map(|row| &row[there.clone()]).collect();
        let own = weighted(&directions, &covariances);
        let taken = own.iter().zip(&directions).map(|(w, row)| inner(w, row)).sum::<f64>() / covariances[0];
        let left = (1.0 - taken / known as f64).max(LEAST_LEFT);
        let rows: Vec<&[f64]> = answers.iter().map(|row| &row[there.clone()]).collect();
        total.iter_mut().zip(between(&rows, &covariances)).for_each(|(sum, more)| *sum += more / left);
    }
    total
}

/// A covariance, widened where another one knows a larger variance.
fn wider(one: Vec<f64>, other: &[f64]) -> Vec<f64> {
    let p = one.len().isqrt();
    let stretch = |i: usize| (other[i * p + i] / one[i * p + i].max(f64::MIN_POSITIVE)).max(1.0).sqrt();
    let stretches: Vec<f64> = (0..p).map(stretch).collect();
    one.iter().enumerate().map(|(at, value)| value * stretches[at / p] * stretches[at % p]).collect()
}

/// Covariance of sums of scores with Bartlett weights: the middle of the sandwich (doi:10.2307/1913610). The weights are
/// those of a series' autocovariances, so the sum over lags is a product on a circle. O(p² m + p m log m).
///
/// # Errors
/// [`Error::Length`].
#[allow(clippy::cast_precision_loss)]
pub fn long_run(jacobian: &[Vec<f64>], series: &[Vec<f64>]) -> Result<Vec<f64>> {
    let count = series.iter().map(Vec::len).sum();
    jacobian.iter().try_for_each(|row| check_length("a row of a Jacobian", count, row.len()))?;
    let mut total = vec![0.0; jacobian.len() * jacobian.len()];
    let mut at = 0;
    for residuals in series {
        let there = at..at + residuals.len();
        at = there.end;
        if residuals.is_empty() {
            continue;
        }
        let score = |(slope, e): (&f64, &f64)| if e.is_nan() { 0.0 } else { slope * e };
        let scores: Vec<Vec<f64>> =
            jacobian.iter().map(|row| row[there.clone()].iter().zip(residuals).map(score).collect()).collect();
        let rows: Vec<&[f64]> = scores.iter().map(Vec::as_slice).collect();
        let window = lags(residuals.len());
        let reach = window.min(residuals.len().saturating_sub(1));
        let weight = |lag: usize| match lag {
            0 => 1.0,
            lag if lag < reach => 1.0 - lag as f64 / window as f64,
            _ => 0.0,
        };
        let weights: Vec<f64> = (0..residuals.len()).map(weight).collect();
        total.iter_mut().zip(between(&rows, &weights)).for_each(|(sum, more)| *sum += more);
    }
    Ok(total)
}

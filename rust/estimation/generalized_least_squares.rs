//! Estimation by generalized least squares under autoregressive noise, and the likelihood ratio of two nested
//! regressions.
//!
//! Only one-step-ahead predictions are compared. The mean of a random walk is as large as the walk itself, and would
//! look like a constant term. The prediction errors of a random walk are white.

use std::ops::Range;

use crate::error::{check_length, Error, Result};
use crate::linalg::dense::{minimum_norm_solution, triangular_factor};
use crate::parallel::Stop;
use crate::signal::statistics::inner;

/// Maximum number of alternations between the fit of the noise model and the fit of the regression.
const MAX_ALTERNATIONS: usize = 4;
/// Number of samples that the shortest run must have per lag of the autoregression.
const SAMPLES_PER_LAG: usize = 10;
/// Number of rows of lagged residuals per block of the QR factorization.
const BLOCK_ROWS: usize = 1 << 14;
/// Singular value, relative to the largest one, below which whitened regression columns count as collinear.
const RANK_TOLERANCE: f64 = 1e-10;

/// Return twice the log-likelihood ratio of two nested regressions under autoregressive noise, at least 0.
///
/// `residuals` (N samples) are regressed on the columns `nested_columns` and on the columns `full_columns`. Each set of
/// columns is orthonormal. `outputs` contains, for each output, the index range of each run in `residuals`. Each output
/// has its own autoregressive noise of at most `max_lag` lags. The noise order is first selected for each set of
/// columns separately, because an autoregression of high order can imitate a missing column. The larger of the two
/// orders then limits both final fits, so that they predict the same samples. The cost is O(k² N) for k columns or
/// lags.
///
/// # Errors
/// [`Error::Length`] if a column has another length than `residuals`, or if a range ends beyond the residuals.
/// [`Error::Internal`] if the singular values of the whitened columns do not converge. [`Error::Interrupted`] after a
/// stop request.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::estimation::generalized_least_squares::prediction_ratio;
/// use ftlm::parallel::Stop;
/// // White noise of random signs, about a mean of 0.5 and about 0.
/// let mut state = 1_u32;
/// let mut sign = || {
///     state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
///     if state >> 31 == 0 { 0.1 } else { -0.1 }
/// };
/// let noise: Vec<f64> = (0..200).map(|_| sign()).collect();
/// let shifted: Vec<f64> = noise.iter().map(|v| v + 0.5).collect();
/// let constant = vec![vec![1.0 / 200.0_f64.sqrt(); 200]];
/// let ratio = |e: &[f64]| prediction_ratio(&[], &constant, e, &[vec![0..200]], 2, &Stop::default());
/// // The 99 % quantile of chi-squared of one degree is 6.6.
/// assert!(ratio(&shifted)? > 6.6 && ratio(&noise)? < 6.6);
/// # Ok(())
/// # }
/// ```
pub fn prediction_ratio(
    nested_columns: &[Vec<f64>],
    full_columns: &[Vec<f64>],
    residuals: &[f64],
    outputs: &[Vec<Range<usize>>],
    max_lag: usize,
    stop: &Stop,
) -> Result<f64> {
    for column in nested_columns.iter().chain(full_columns) {
        check_length("column", residuals.len(), column.len())?;
    }
    if let Some(end) = outputs.iter().flatten().map(|range| range.end).find(|end| *end > residuals.len()) {
        check_length("residuals", end, residuals.len())?;
    }
    let shortest = |ranges: &Vec<Range<usize>>| ranges.iter().map(Range::len).min().unwrap_or(0);
    let limits: Vec<usize> = outputs.iter().map(|ranges| max_lag.min(shortest(ranges) / SAMPLES_PER_LAG)).collect();
    let fit = |columns, limits: &[usize]| noise_criterion(columns, residuals, outputs, limits, stop);
    let (orders, other_orders) = (fit(nested_columns, &limits)?.1, fit(full_columns, &limits)?.1);
    let max_orders: Vec<usize> = orders.into_iter().zip(other_orders).map(|(a, b)| a.max(b)).collect();
    Ok((fit(nested_columns, &max_orders)?.0 - fit(full_columns, &max_orders)?.0).max(0.0))
}

/// Return the noise criterion after regression on `columns`, summed over outputs, and the noise order of each output.
///
/// The criterion is that of [`Autoregression`]. Generalized least squares and the fit of the autoregressions alternate
/// until the criterion no longer decreases. `limits` contains the maximum noise order of each output. This maximum
/// order is also the index of the first predicted sample in each run of the output.
fn noise_criterion(
    columns: &[Vec<f64>],
    residuals: &[f64],
    outputs: &[Vec<Range<usize>>],
    limits: &[usize],
    stop: &Stop,
) -> Result<(f64, Vec<usize>)> {
    let mut coefficients: Vec<f64> = columns.iter().map(|column| inner(column, residuals)).collect();
    let (mut best, mut orders) = (f64::INFINITY, limits.to_vec());
    for _ in 0..MAX_ALTERNATIONS {
        stop.check()?;
        let mut noise = residuals.to_vec();
        columns.iter().zip(&coefficients).for_each(|(column, x)| add_multiple(&mut noise, -x, column));
        let fit = |(ranges, &max_lag): (&Vec<Range<usize>>, &usize)| {
            let series: Vec<&[f64]> = ranges.iter().map(|range| &noise[range.clone()]).collect();
            Autoregression::fit(&series, max_lag)
        };
        let fits: Vec<Autoregression> = outputs.iter().zip(limits).map(fit).collect();
        let criterion: f64 = fits.iter().map(|fit| fit.criterion).sum();
        if criterion.is_nan() || criterion >= best {
            break;
        }
        best = criterion;
        orders = fits.iter().map(Autoregression::order).collect();
        let whiten = |column: &[f64]| -> Vec<f64> {
            let models = fits.iter().zip(outputs).zip(limits);
            models
                .flat_map(|((fit, ranges), &first)| {
                    ranges.iter().flat_map(move |range| fit.whiten(&column[range.clone()], first))
                })
                .collect()
        };
        let whitened: Vec<Vec<f64>> = columns.iter().map(|column| whiten(column)).collect();
        let error = || Error::Internal { what: "singular values of whitened columns that do not converge".into() };
        coefficients = minimum_norm_solution(&whitened, &whiten(residuals), RANK_TOLERANCE).ok_or_else(error)?;
    }
    Ok((best, orders))
}

fn add_multiple(sum: &mut [f64], factor: f64, values: &[f64]) {
    sum.iter_mut().zip(values).for_each(|(sum, v)| *sum += factor * v);
}

/// Autoregressive model of a series, without a constant term.
struct Autoregression {
    /// Whitening filter 1, a₁, …, aₙ: the weights of the current sample and of the n previous ones.
    filter: Vec<f64>,
    /// Standard deviation of the one-step prediction errors, in the unit of the series.
    deviation: f64,
    /// Number of samples times the log innovation variance, plus twice the order, plus a penalty.
    criterion: f64,
}

impl Autoregression {
    /// Fit an autoregression to the series and one to their increments, and return the one with the lower criterion.
    ///
    /// The model of the increments has a root fixed at 1 (a random walk). Both models are fitted by least squares and
    /// predict the samples of each series from index `max_lag` on. The order minimizes Akaike's criterion, because
    /// white noise on a random walk needs many lags. The model of the series itself is penalized by the logarithm of
    /// the number of samples. Without this penalty, a random walk would pass for stationary noise about a mean, because
    /// an estimated root near 1 is biased downward. The series are not centered, because their mean is the quantity
    /// under test.
    #[allow(clippy::cast_precision_loss)]
    fn fit(series: &[&[f64]], max_lag: usize) -> Self {
        let size = max_lag + 1;
        let mut factor = vec![0.0; size * size];
        for values in series {
            for start in (max_lag..values.len()).step_by(BLOCK_ROWS) {
                let end = (start + BLOCK_ROWS).min(values.len());
                // The columns are the lags and then the predicted sample, so that one triangular factor contains the
                // fit of every order.
                let column = |j: usize| {
                    let lag = if j < max_lag { j + 1 } else { 0 };
                    let processed = (0..size).map(|i| factor[i * size + j]);
                    processed.chain(values[start - lag..end - lag].iter().copied()).collect()
                };
                factor = triangular_factor(&(0..size).map(column).collect::<Vec<_>>());
            }
        }
        let count: usize = series.iter().map(|values| values.len().saturating_sub(max_lag)).sum();
        let direct = Self::of_best_order(&factor, size, count, &[1.0], libm::log(count.max(1) as f64));
        if max_lag == 0 {
            return direct;
        }
        let column = |j: usize| -> Vec<f64> {
            let (first, second) = if j + 1 < max_lag { (j, j + 1) } else { (max_lag, 0) };
            (0..size).map(|i| factor[i * size + first] - factor[i * size + second]).collect()
        };
        let increments = triangular_factor(&(0..max_lag).map(column).collect::<Vec<_>>());
        let random_walk = Self::of_best_order(&increments, max_lag, count, &[1.0, -1.0], 0.0);
        if random_walk.criterion < direct.criterion {
            random_walk
        } else {
            direct
        }
    }

    /// Return the autoregression of the order that minimizes count·log(variance) + 2·order + `penalty`.
    ///
    /// `factor` is a triangular factor (size × size, row-major) whose columns are the lags and then the predicted
    /// sample. After regression on the first k lags, the residual is the last column from row k on. The series have
    /// already passed the filter `difference`. The returned filter is the product of `difference` and the estimated
    /// filter.
    #[allow(clippy::cast_precision_loss)]
    fn of_best_order(factor: &[f64], size: usize, count: usize, difference: &[f64], penalty: f64) -> Self {
        let last: Vec<f64> = (0..size).map(|i| factor[i * size + size - 1]).collect();
        let variance =
            |order: usize| (inner(&last[order..], &last[order..]) / count.max(1) as f64).max(f64::MIN_POSITIVE);
        let criterion = |order: usize| count as f64 * libm::log(variance(order)) + 2.0 * order as f64 + penalty;
        let order = (1..size).fold(0, |best, order| if criterion(order) < criterion(best) { order } else { best });
        let lags: Vec<Vec<f64>> = (0..order).map(|j| (0..order).map(|i| factor[i * size + j]).collect()).collect();
        let relative_tolerance = f64::EPSILON * order as f64;
        let coefficients =
            minimum_norm_solution(&lags, &last[..order], relative_tolerance).unwrap_or_else(|| vec![0.0; order]);
        let estimated_filter: Vec<f64> = std::iter::once(1.0).chain(coefficients.iter().map(|c| -c)).collect();
        let mut filter = vec![0.0; estimated_filter.len() + difference.len() - 1];
        difference
            .iter()
            .enumerate()
            .for_each(|(k, d)| add_multiple(&mut filter[k..k + estimated_filter.len()], *d, &estimated_filter));
        Self { filter, deviation: variance(order).sqrt(), criterion: criterion(order) }
    }

    fn order(&self) -> usize {
        self.filter.len() - 1
    }

    /// Return the prediction errors of the samples from index `first` on, divided by their standard deviation.
    fn whiten(&self, series: &[f64], first: usize) -> Vec<f64> {
        let error = |t: usize| self.filter.iter().enumerate().map(|(k, a)| a * series[t - k]).sum::<f64>();
        (first..series.len()).map(|t| error(t) / self.deviation).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filter_of_a_random_walk_has_a_root_at_one() {
        let mut state = 1_u32;
        let mut walk = vec![0.0];
        for _ in 0..500 {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            walk.push(walk[walk.len() - 1] + f64::from(state) / f64::from(u32::MAX) - 0.5);
        }
        let fit = Autoregression::fit(&[&walk], 10);
        assert!(fit.filter.iter().sum::<f64>().abs() < 1e-12);
        assert!((fit.deviation - (1.0_f64 / 12.0).sqrt()).abs() < 0.02);
        // The prediction errors of a random walk are its increments divided by their standard deviation.
        let errors = fit.whiten(&walk, 20);
        let mean_square = inner(&errors, &errors) / 481.0;
        assert!(errors.len() == 481 && (mean_square - 1.0).abs() < 0.1);
    }
}

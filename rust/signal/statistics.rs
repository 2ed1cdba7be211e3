//! Statistics of signals: robust noise level, autocovariances, whiteness test, autoregressive noise models.

use crate::fft::{plan, Bin, Workspace};
use crate::simd::{dispatch_simd, dot, SimdKernel};

/// Median absolute deviation of a normal variable, in units of its standard deviation.
pub const NORMAL_MAD_PER_SIGMA: f64 = 0.674_489_750_196_081_7;
/// Huber's threshold in standard deviations. Under normal noise, the efficiency is 95 % of that of least squares.
pub const HUBER_THRESHOLD: f64 = 1.345;
/// Quantile of the standard normal distribution at 99 %. A test with this quantile rejects 1 % of true models.
const NORMAL_99: f64 = 2.326_347_874_040_840_8;
/// Default number of lags of a whiteness test.
pub const WHITENESS_LAGS: usize = 25;
/// Maximum number of values that are added one by one in pairwise summation.
const MAX_SERIAL_SUM_VALUES: usize = 128;

/// SIMD kernel: dot product of two slices of equal length.
struct Inner<'a>(&'a [f64], &'a [f64]);

impl SimdKernel for Inner<'_> {
    type Output = f64;

    #[inline(always)]
    fn run(self) -> f64 {
        dot(self.0, self.1)
    }
}

/// Return the dot product Σ a·b of slices of equal length, with the widest vector instructions of the processor.
#[must_use]
pub fn inner(a: &[f64], b: &[f64]) -> f64 {
    dispatch_simd(Inner(a, b))
}

/// Return the sum of values by pairwise summation. Its rounding error grows with the logarithm of their number.
#[must_use]
pub fn sum(values: &[f64]) -> f64 {
    if values.len() < 8 {
        return values.iter().sum();
    }
    if values.len() > MAX_SERIAL_SUM_VALUES {
        let half = values.len() / 2 / 8 * 8;
        return sum(&values[..half]) + sum(&values[half..]);
    }
    let mut lanes = [0.0; 8];
    lanes.copy_from_slice(&values[..8]);
    let chunks = values[8..].chunks_exact(8);
    let rest = chunks.remainder();
    for chunk in chunks {
        lanes.iter_mut().zip(chunk).for_each(|(lane, value)| *lane += value);
    }
    let [a, b, c, d, e, f, g, h] = lanes;
    rest.iter().fold(((a + b) + (c + d)) + ((e + f) + (g + h)), |total, value| total + value)
}

/// Return the mean of values; NaN without values.
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn mean(values: &[f64]) -> f64 {
    sum(values) / values.len() as f64
}

/// Return the root mean square of values. Infinite on overflow, NaN without values.
#[must_use]
pub fn root_mean_square(values: &[f64]) -> f64 {
    mean(&values.iter().map(|v| v * v).collect::<Vec<_>>()).sqrt()
}

/// Return a robust standard deviation about 0, from the median of absolute values. It is insensitive to outliers, and 0
/// without values.
///
/// ```
/// let found = ftlm::signal::statistics::robust_deviation(&[1.0, -2.0, 3.0, -1000.0]);
/// assert!((found - 2.5 / ftlm::signal::statistics::NORMAL_MAD_PER_SIGMA).abs() < 1e-12);
/// ```
#[must_use]
pub fn robust_deviation(values: &[f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    median(values.iter().map(|v| v.abs()).collect()) / NORMAL_MAD_PER_SIGMA
}

/// Return the standard deviation of white noise on a smooth signal, from the median of second differences. NaN marks
/// missing samples.
#[must_use]
pub fn white_noise_deviation(samples: &[f64]) -> f64 {
    let second_differences = |samples: &[f64]| -> Vec<f64> {
        let second = samples.windows(3).map(|w| (w[2] - w[1]) - (w[1] - w[0]));
        second.filter(|difference| !difference.is_nan()).collect()
    };
    let mut differences = second_differences(samples);
    if differences.is_empty() {
        // No three neighboring samples are present. The samples that are present then count as neighbors.
        differences = second_differences(&samples.iter().copied().filter(|v| !v.is_nan()).collect::<Vec<_>>());
    }
    robust_deviation(&differences) / 6.0_f64.sqrt()
}

/// Return the median of values; NaN without values.
///
/// ```
/// assert_eq!(ftlm::signal::statistics::median(vec![3.0, 1.0, 8.0, 2.0]), 2.5);
/// ```
#[must_use]
pub fn median(mut values: Vec<f64>) -> f64 {
    let count = values.len();
    if count == 0 {
        return f64::NAN;
    }
    let (below, &mut upper, _) = values.select_nth_unstable_by(count / 2, f64::total_cmp);
    match count % 2 {
        0 => f64::midpoint(below.iter().copied().fold(f64::NEG_INFINITY, f64::max), upper),
        _ => upper,
    }
}

/// Return the autocovariances of series at lags 0 to `max_lag`, and the number of sample pairs at each lag. O(max_lag ·
/// N) for N samples.
///
/// NaN counts as a missing sample. Each series is centered on its own mean, and the results are pooled.
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn autocovariances(series: &[&[f64]], max_lag: usize) -> (Vec<f64>, Vec<f64>) {
    let (mut sums, mut pairs) = (vec![0.0; max_lag + 1], vec![0.0; max_lag + 1]);
    for values in series {
        let x = subtract_mean(values);
        let has_gaps = values.iter().any(|v| v.is_nan());
        let weights: Vec<f64> =
            if has_gaps { values.iter().map(|v| f64::from(!v.is_nan())).collect() } else { Vec::new() };
        for lag in 0..(max_lag + 1).min(x.len()) {
            sums[lag] += inner(&x[lag..], &x[..x.len() - lag]);
            pairs[lag] +=
                if has_gaps { inner(&weights[lag..], &weights[..x.len() - lag]) } else { (x.len() - lag) as f64 };
        }
    }
    sums.iter_mut().zip(&pairs).for_each(|(sum, count)| *sum /= count.max(1.0));
    (sums, pairs)
}

/// Variance of a sum of the values of a series relative to that for white noise, at least 1 (Bartlett window).
///
/// The window has 4 N^(1/3) lags. The series has no missing samples.
///
/// ```
/// let slow: Vec<f64> = (0..1000).map(|t| f64::from(t / 100 % 2)).collect();
/// assert_eq!(ftlm::signal::statistics::variance_inflation(&[1.0]), 1.0);
/// assert!(ftlm::signal::statistics::variance_inflation(&slow) > 1.5);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn variance_inflation(series: &[f64]) -> f64 {
    let lags = ((4.0 * (series.len() as f64).powf(1.0 / 3.0)) as usize).min(series.len().saturating_sub(1));
    if lags < 2 {
        return 1.0;
    }
    let (covariances, pairs) = autocovariances(&[series], lags - 1);
    let power = covariances[0] * pairs[0];
    let weighted = (1..lags).map(|lag| (1.0 - lag as f64 / lags as f64) * covariances[lag] * pairs[lag]);
    1.0_f64.max(1.0 + 2.0 * weighted.sum::<f64>() / if power > 0.0 { power } else { 1.0 })
}

/// Return a series minus its mean, with 0 at missing samples (NaN).
fn subtract_mean(values: &[f64]) -> Vec<f64> {
    let finite: Vec<f64> = values.iter().copied().filter(|v| !v.is_nan()).collect();
    let center = if finite.is_empty() { 0.0 } else { mean(&finite) };
    values.iter().map(|v| if v.is_nan() { 0.0 } else { v - center }).collect()
}

/// Return the portmanteau statistic Σ_k (Σ_t e_t e_{t−k})² / Σ_t (e_t e_{t−k})² over `lags` lags k. If the series e is
/// white noise, the statistic is chi-squared with `lags` degrees of freedom.
///
/// The variance of the noise may change within a series, because the variance at each lag is estimated from the
/// products themselves (Lobato, Nankervis and Savin, doi:10.1111/1468-2354.00106). Each series is centered on its own
/// mean, and the results are pooled. NaN counts as a missing sample.
///
/// ```
/// // Noise that changes its sign at random is white, however its size changes.
/// let mut state = 1_u32;
/// let mut sign = || {
///     state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
///     if state >> 31 == 0 { 1.0 } else { -1.0 }
/// };
/// let e: Vec<f64> = (0..2000).map(|t| sign() * if t % 100 < 10 { 1.0 } else { 0.01 }).collect();
/// assert!(ftlm::signal::statistics::portmanteau(&[&e], 25) < 44.3);
/// let slow: Vec<f64> = e.windows(2).map(|pair| pair[0] + pair[1]).collect();
/// assert!(ftlm::signal::statistics::portmanteau(&[&slow], 25) > 44.3);
/// ```
#[must_use]
pub fn portmanteau(series: &[&[f64]], lags: usize) -> f64 {
    let centered: Vec<Vec<f64>> = series.iter().map(|values| subtract_mean(values)).collect();
    let largest = centered.iter().flatten().fold(0.0_f64, |peak, v| peak.max(v.abs()));
    if largest == 0.0 {
        return 0.0;
    }
    // Division by the largest magnitude keeps fourth powers in the range of floating-point numbers.
    let centered: Vec<Vec<f64>> = centered.iter().map(|x| x.iter().map(|v| v / largest).collect()).collect();
    let squares: Vec<Vec<f64>> = centered.iter().map(|x| x.iter().map(|v| v * v).collect()).collect();
    let lag_sum = |parts: &[Vec<f64>], lag: usize| -> f64 {
        parts.iter().filter(|x| x.len() > lag).map(|x| inner(&x[lag..], &x[..x.len() - lag])).sum()
    };
    let lag_term = |lag: usize| {
        let (product, power) = (lag_sum(&centered, lag), lag_sum(&squares, lag));
        if power > 0.0 {
            product * product / power
        } else {
            0.0
        }
    };
    let longest = centered.iter().map(Vec::len).max().unwrap_or(0);
    (1..=lags.min(longest)).map(lag_term).sum()
}

/// True if a series is consistent with white noise by the [`portmanteau`] test at 1 %. Series of at most `lags` + 1
/// samples count as consistent.
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn is_white(series: &[f64], lags: usize) -> bool {
    let count = series.iter().filter(|v| !v.is_nan()).count();
    count <= lags + 1 || portmanteau(&[series], lags) <= chi_squared(lags as f64, NORMAL_99)
}

/// Return the quantile of the chi-squared distribution by the approximation of Wilson and Hilferty. `quantile` is the
/// standard normal quantile at the same probability, for example 2.326 for 99 %.
///
/// The error is at most 0.3 % from five degrees of freedom on, and at most 1 % from one degree on.
#[must_use]
pub fn chi_squared(degrees: f64, quantile: f64) -> f64 {
    let scaled_variance = 2.0 / (9.0 * degrees);
    degrees * libm::pow(1.0 - scaled_variance + quantile * scaled_variance.sqrt(), 3.0)
}

/// Minimum number of samples in the shortest run per coefficient of an autoregression.
const MIN_SAMPLES_PER_COEFFICIENT: usize = 10;
/// Minimum length of the transform for autocovariances of an autoregression. Over this length, a correlation of 0.99
/// per sample has decayed.
const MIN_TRANSFORM_LENGTH: usize = 4096;

/// Return the whitening filter 1, a₁, …, aₙ of series with a common spectrum, and the innovation variance.
///
/// The Yule–Walker equations are solved by the Levinson–Durbin recursion (doi:10.1093/biomet/47.3-4.233). Covariances
/// are pooled over the series, each about its own mean. The order n, at most `max_order`, minimizes the Bayesian
/// information criterion. NaN counts as a missing sample.
///
/// ```
/// // Every other value the opposite: x_k = −0.9 x_{k−1} + a bounded disturbance.
/// let mut x = vec![1.0];
/// (0..399_u32).for_each(|k| x.push(-0.9 * x[k as usize] + f64::from(k % 7) / 7.0 - 3.0 / 7.0));
/// let (filter, power) = ftlm::signal::statistics::whitening_filter(&[&x], 5);
/// assert!(filter.len() > 1 && power > 0.0);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn whitening_filter(series: &[&[f64]], max_order: usize) -> (Vec<f64>, f64) {
    let counts: Vec<usize> = series.iter().map(|x| x.iter().filter(|v| !v.is_nan()).count()).collect();
    let max_order = max_order.min(counts.iter().min().copied().unwrap_or(0) / MIN_SAMPLES_PER_COEFFICIENT);
    let (mut covariance, pairs) = autocovariances(series, max_order);
    let (count, sample_count) =
        (counts.iter().sum::<usize>() as f64, series.iter().map(|x| x.len()).sum::<usize>() as f64);
    for (lag, (value, &pair_count)) in covariance.iter_mut().zip(&pairs).enumerate() {
        // A lag with few pairs gets a small weight, so that the covariances belong to a positive spectrum.
        let full_count = series.iter().map(|x| x.len().saturating_sub(lag)).sum::<usize>() as f64;
        *value *= if pair_count > 0.0 { (if full_count > 0.0 { full_count } else { 1.0 }) / sample_count } else { 0.0 };
    }
    let (mut best, mut current) = (vec![1.0], vec![1.0]);
    let mut power = covariance[0];
    let mut remaining = power;
    if power.is_nan() || power <= 0.0 {
        return (best, 0.0);
    }
    let mut best_criterion = count * libm::log(power);
    for order in 1..=max_order {
        let reflection =
            -current.iter().zip(covariance[1..=order].iter().rev()).map(|(a, c)| a * c).sum::<f64>() / power;
        current.push(0.0);
        let reversed: Vec<f64> = current.iter().rev().copied().collect();
        current.iter_mut().zip(reversed).for_each(|(a, b)| *a += reflection * b);
        power *= 1.0 - reflection * reflection;
        if power.is_nan() || power <= 0.0 {
            break;
        }
        let criterion = count * libm::log(power) + order as f64 * libm::log(count);
        if criterion < best_criterion {
            (best_criterion, remaining) = (criterion, power);
            best.clone_from(&current);
        }
    }
    (best, remaining)
}

/// Return the autoregression 1, a₁, …, aₙ of a series, and the innovation variance, by Burg's method.
///
/// The series is not centered. Yule–Walker estimates shift a root near 1, such as that of a random walk, inward, and
/// thus underestimate slow correlation. Burg's estimates do not (Kay, Modern Spectral Estimation, §7.6). The order n,
/// at most `max_order`, minimizes Schwarz's criterion. NaN marks a missing sample. Pairs of samples that begin or end
/// at it are omitted.
///
/// ```
/// // The sum of ±1 is a random walk: each value predicts the next one.
/// let mut state = 1_u32;
/// let mut sign = || {
///     state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
///     if state >> 31 == 0 { 1.0 } else { -1.0 }
/// };
/// let walk: Vec<f64> = (0..1000).scan(0.0, |sum, _| { *sum += sign(); Some(*sum) }).collect();
/// let (filter, power) = ftlm::signal::statistics::burg_filter(&walk, 10);
/// assert!((filter.iter().sum::<f64>()).abs() < 0.02 && (power - 1.0).abs() < 0.05);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn burg_filter(series: &[f64], max_order: usize) -> (Vec<f64>, f64) {
    let present: Vec<bool> = series.iter().map(|v| !v.is_nan()).collect();
    let mut forward: Vec<f64> = series.iter().map(|v| if v.is_nan() { 0.0 } else { *v }).collect();
    let mut backward = forward.clone();
    let count = present.iter().filter(|v| **v).count().max(1) as f64;
    let mut power = inner(&forward, &forward) / count;
    let (mut best, mut current, mut remaining) = (vec![1.0], vec![1.0], power);
    let mut best_criterion = count * libm::log(power);
    for order in 1..=max_order.min(series.len().saturating_sub(1)) {
        let pairs = (order..series.len()).filter(|&t| present[t] && present[t - order]);
        let (cross_product, total) = pairs.fold((0.0, 0.0), |(cross_product, total), t| {
            let (forward_error, backward_error) = (forward[t], backward[t - 1]);
            (
                cross_product + forward_error * backward_error,
                total + forward_error * forward_error + backward_error * backward_error,
            )
        });
        let reflection = -2.0 * cross_product / total;
        power *= 1.0 - reflection * reflection;
        if power.is_nan() || power <= 0.0 {
            break;
        }
        for t in (order..series.len()).rev() {
            let (forward_error, backward_error) = (forward[t], backward[t - 1]);
            (forward[t], backward[t]) =
                (forward_error + reflection * backward_error, backward_error + reflection * forward_error);
        }
        current.push(0.0);
        let reversed: Vec<f64> = current.iter().rev().copied().collect();
        current.iter_mut().zip(reversed).for_each(|(a, b)| *a += reflection * b);
        let criterion = count * libm::log(power) + libm::log(count) * order as f64;
        if criterion < best_criterion {
            (best_criterion, remaining) = (criterion, power);
            best.clone_from(&current);
        }
    }
    (best, remaining)
}

/// Minimum number of samples in all runs together, per lag of each input of an ARX model.
const MIN_SAMPLES_PER_INPUT_LAG: usize = 40;
/// Minimum ratio of the residual sum of squares to the total sum of squares when a column is regressed on the previous
/// columns. A column with a smaller ratio is omitted.
const COLUMN_TOLERANCE: f64 = 1e-8;

/// ARX model e(t) = −Σ aₖ e(t − k) + Σ bₖ u(t − k) + w(t), k ≥ 1, of series e that may depend on inputs u. w are the
/// innovations.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct ArxModel {
    /// Whitening filter 1, a₁, …, aₙ of the noise, without the response to the inputs.
    pub filter: Vec<f64>,
    /// Index of the sample in each series at which the innovations start.
    pub start: usize,
    /// Innovations w of each series from sample `start` on; 0 where a sample is missing.
    pub innovations: Vec<Vec<f64>>,
    /// Number of estimated coefficients.
    pub parameters: usize,
}

/// Fit an ARX model to series with a common noise spectrum, by least squares. O((lags · inputs)² · N) for N samples.
///
/// An AR model without inputs would model the response to an input as noise. The order of the AR part, at most
/// `max_order`, minimizes the Bayesian information criterion. Inputs have lags 1 to `max_order`, or fewer if samples
/// are few. Lag 0 is omitted, because under feedback the input at lag 0 contains the current noise. NaN marks a missing
/// sample of a series. Each input has one row per series, without missing samples.
///
/// ```
/// // A sinusoid that follows an input, and noise that changes its sign at random: the filter is that of the noise.
/// let mut state = 1_u32;
/// let mut sign = || {
///     state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
///     if state >> 31 == 0 { 0.1 } else { -0.1 }
/// };
/// let u: Vec<f64> = (0..1000).map(|t| (0.1 * f64::from(t)).sin()).collect();
/// let e: Vec<f64> = u.iter().map(|u| 0.5 * u + sign()).collect();
/// let model = ftlm::signal::statistics::arx_model(&[&e], &[vec![&u]], 25);
/// let power = model.innovations[0].iter().map(|w| w * w).sum::<f64>() / model.innovations[0].len() as f64;
/// assert!(model.filter == [1.0] && (power.sqrt() - 0.1).abs() < 0.005);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn arx_model(series: &[&[f64]], inputs: &[Vec<&[f64]>], max_order: usize) -> ArxModel {
    let counts: Vec<usize> = series.iter().map(|x| x.iter().filter(|v| !v.is_nan()).count()).collect();
    let max_order = max_order.min(counts.iter().min().copied().unwrap_or(0) / MIN_SAMPLES_PER_COEFFICIENT);
    let lags = max_order.min(counts.iter().sum::<usize>() / (MIN_SAMPLES_PER_INPUT_LAG * inputs.len().max(1)));
    let start = max_order.max(lags);
    let fixed = 1 + inputs.len() * lags;
    let size = fixed + max_order + 1;
    // Series and inputs are scaled to one, so that the squares of values of any unit are in range.
    let (series, scale) = scale_to_one(series);
    let inputs: Vec<Vec<Vec<f64>>> = inputs.iter().map(|input| scale_to_one(input).0).collect();
    let fill = |run: usize, t: usize, row: &mut [f64]| {
        row[0] = 1.0;
        for (input, columns) in inputs.iter().zip(row[1..fixed].chunks_exact_mut(lags.max(1))) {
            columns.iter_mut().enumerate().for_each(|(k, value)| *value = input[run][t - 1 - k]);
        }
        // A missing sample is replaced by the mean. Otherwise a few gaps would exclude most rows.
        let value_or_zero = |value: f64| if value.is_nan() { 0.0 } else { value };
        row[fixed..size - 1]
            .iter_mut()
            .enumerate()
            .for_each(|(k, value)| *value = value_or_zero(series[run][t - 1 - k]));
        row[size - 1] = series[run][t];
        !row[size - 1].is_nan()
    };
    let (mut gram, mut row, mut rows) = (vec![vec![0.0; size]; size], vec![0.0; size], 0_usize);
    for (run, values) in series.iter().enumerate() {
        for t in start..values.len() {
            if fill(run, t, &mut row) {
                rows += 1;
                for (i, line) in gram.iter_mut().enumerate() {
                    let factor = row[i];
                    line[i..].iter_mut().zip(&row[i..]).for_each(|(sum, value)| *sum += factor * value);
                }
            }
        }
    }
    for i in 1..size {
        let (above, below) = gram.split_at_mut(i);
        above.iter().zip(&mut below[0]).for_each(|(line, value)| *value = line[i]);
    }
    let count = rows as f64;
    let mut regression = Regression::new(gram);
    (0..fixed).for_each(|column| regression.add(column));
    let mut best = (f64::INFINITY, regression.clone(), 0);
    for order in 0..=max_order {
        if order > 0 {
            regression.add(fixed + order - 1);
        }
        let power = regression.residual_power();
        if power.is_nan() || power <= 0.0 {
            break;
        }
        let criterion = count * libm::log(power) + order as f64 * libm::log(count.max(1.0));
        if criterion < best.0 {
            best = (criterion, regression.clone(), order);
        }
    }
    let (_, regression, order) = best;
    let coefficients = regression.coefficients();
    let innovations = series
        .iter()
        .enumerate()
        .map(|(run, values)| {
            let error = |t: usize| {
                let value_or_zero = fill(run, t, &mut row) && (1..=order).all(|k| !values[t - k].is_nan());
                let fitted: f64 = row.iter().zip(&coefficients).map(|(value, factor)| value * factor).sum();
                if value_or_zero {
                    scale * (row[size - 1] - fitted)
                } else {
                    0.0
                }
            };
            (start.min(values.len())..values.len()).map(error).collect()
        })
        .collect();
    let filter = std::iter::once(1.0).chain(coefficients[fixed..fixed + order].iter().map(|c| -c)).collect();
    ArxModel { filter, start, innovations, parameters: regression.selected_columns.len() }
}

/// Subtract the mean of each row, and divide all rows by the largest magnitude. Return the rows and this magnitude. NaN
/// stays NaN.
fn scale_to_one(rows: &[&[f64]]) -> (Vec<Vec<f64>>, f64) {
    let centered: Vec<Vec<f64>> = rows
        .iter()
        .map(|row| {
            subtract_mean(row).into_iter().zip(*row).map(|(v, raw)| if raw.is_nan() { f64::NAN } else { v }).collect()
        })
        .collect();
    let largest = centered.iter().flatten().fold(0.0_f64, |peak, v| peak.max(v.abs()));
    let scale = if largest > 0.0 { largest } else { 1.0 };
    (centered.into_iter().map(|row| row.into_iter().map(|v| v / scale).collect()).collect(), scale)
}

/// Stepwise regression of the last column of a Gram matrix on the other columns, by the sweep operator.
#[derive(Debug, Clone)]
struct Regression {
    gram: Vec<Vec<f64>>,
    diagonal: Vec<f64>,
    selected_columns: Vec<usize>,
}

impl Regression {
    fn new(gram: Vec<Vec<f64>>) -> Self {
        let diagonal = gram.iter().enumerate().map(|(k, line)| line[k]).collect();
        Self { gram, diagonal, selected_columns: Vec::new() }
    }

    /// Add a regression column, unless it is nearly a linear combination of the selected columns.
    fn add(&mut self, column: usize) {
        let pivot = self.gram[column][column];
        if pivot.is_nan() || pivot <= COLUMN_TOLERANCE * self.diagonal[column] {
            return;
        }
        let line: Vec<f64> = self.gram[column].iter().map(|value| value / pivot).collect();
        for (_, other) in self.gram.iter_mut().enumerate().filter(|(k, _)| *k != column) {
            let factor = other[column];
            other.iter_mut().zip(&line).for_each(|(value, entry)| *value -= factor * entry);
            other[column] = -factor / pivot;
        }
        self.gram[column] = line;
        self.gram[column][column] = 1.0 / pivot;
        self.selected_columns.push(column);
    }

    /// Return the residual sum of squares of the last column.
    fn residual_power(&self) -> f64 {
        self.gram.last().and_then(|line| line.last()).copied().unwrap_or(0.0)
    }

    /// Return the coefficient of each column except the last; 0 for columns that are not selected.
    fn coefficients(&self) -> Vec<f64> {
        let last = self.gram.len() - 1;
        let mut values = vec![0.0; last];
        self.selected_columns.iter().for_each(|&column| values[column] = self.gram[column][last]);
        values
    }
}

/// Return the autocovariances at lags 0 to `count` − 1 of an autoregression with this filter and innovation variance
/// `power`.
///
/// ```
/// let found = ftlm::signal::statistics::filter_autocovariances(&[1.0, -0.9], 1.0, 30);
/// assert!((0..30).all(|k| (found[k] * 0.19 - 0.9_f64.powi(k as i32)).abs() < 1e-9));
/// ```
#[must_use]
pub fn filter_autocovariances(filter: &[f64], power: f64, count: usize) -> Vec<f64> {
    // The transform is so long that wrapped-around covariances have decayed.
    let size = power_above(2 * count + 8 * filter.len()).max(MIN_TRANSFORM_LENGTH);
    let plan = plan(size);
    let mut time = filter.to_vec();
    time.resize(size, 0.0);
    let (mut spectrum, mut workspace) = (vec![Bin::new(0.0, 0.0); plan.bins()], Workspace::new());
    plan.transform(&mut time, &mut spectrum, &mut workspace);
    spectrum.iter_mut().for_each(|bin| *bin = Bin::new(power / bin.norm_sqr(), 0.0));
    plan.inverse(&mut spectrum, &mut time, &mut workspace);
    time.truncate(count);
    time
}

/// Return the products of rows with the symmetric Toeplitz matrix of the autocovariances. O(N log N) per row of N
/// values.
///
/// The Toeplitz matrix is embedded in a circulant matrix.
#[must_use]
pub fn multiply_toeplitz(rows: &[&[f64]], covariances: &[f64]) -> Vec<Vec<f64>> {
    let count = covariances.len();
    let size = power_above(2 * count);
    let plan = plan(size);
    let mut time = vec![0.0; size];
    time[..count].copy_from_slice(covariances);
    for lag in 1..count {
        time[size - lag] = covariances[lag];
    }
    let (mut circle, mut workspace) = (vec![Bin::new(0.0, 0.0); plan.bins()], Workspace::new());
    plan.transform(&mut time, &mut circle, &mut workspace);
    let mut spectrum = circle.clone();
    rows.iter()
        .map(|row| {
            time[..count].copy_from_slice(row);
            time[count..].fill(0.0);
            plan.transform(&mut time, &mut spectrum, &mut workspace);
            // The spectrum of an even sequence is real.
            spectrum.iter_mut().zip(&circle).for_each(|(bin, factor)| *bin *= factor.re);
            plan.inverse(&mut spectrum, &mut time, &mut workspace);
            time[..count].to_vec()
        })
        .collect()
}

/// Return the smallest power of two above a number.
fn power_above(number: usize) -> usize {
    1 << (usize::BITS - number.leading_zeros())
}

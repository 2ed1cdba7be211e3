//! Comparison of a response with a measurement, with the metrics of the paper: error (eq. 45), RMSE (eq. 46), NR (eq.
//! 47), and the fit. Correlations for residual tests.

use crate::error::{check_finite, check_length, Error, Result};
use crate::fft;

/// Metrics of one output over the M pulses of a record. y is the measurement, ŷ the response, and ȳ the mean of y.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Metrics {
    /// Sum of absolute errors Σ|y − ŷ|, eq. (45) of the paper, in the unit of the output.
    pub error: f64,
    /// Root mean square error √(Σ(y − ŷ)²/M), eq. (46) of the paper, in the unit of the output.
    pub rmse: f64,
    /// NR, the normalized error RMSE / σ(y), eq. (47) of the paper. The standard deviation σ has the divisor M, as in
    /// the tables of the paper.
    pub nr: f64,
    /// Fit 100·(1 − ‖y − ŷ‖/‖y − ȳ‖) \[%\].
    pub fit_percent: f64,
}

/// Return the metrics of residuals e = y − ŷ for a measurement y of equal length. The metrics are not finite if the
/// residuals are not.
///
/// # Errors
/// [`Error::Length`] for empty or different lengths, [`Error::NotFinite`] for a measurement that is not finite.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// let found = ftlm::signal::metrics::metrics(&[1.0, 3.0], &[0.5, -0.5])?;
/// assert_eq!((found.error, found.rmse, found.nr, found.fit_percent), (1.0, 0.5, 0.5, 50.0));
/// # Ok(())
/// # }
/// ```
#[allow(clippy::cast_precision_loss)]
pub fn metrics(measured: &[f64], residuals: &[f64]) -> Result<Metrics> {
    if measured.is_empty() {
        return Err(Error::Length { name: "measured".into(), expected: 1, found: 0 });
    }
    check_length("residuals", measured.len(), residuals.len())?;
    check_finite("measured", measured)?;
    let m = measured.len() as f64;
    let mean = measured.iter().sum::<f64>() / m;
    let deviation = measured.iter().map(|y| (y - mean) * (y - mean)).sum::<f64>();
    let error = residuals.iter().map(|e| e.abs()).sum::<f64>();
    // The squares of a diverging response overflow before the response itself.
    let largest = residuals.iter().fold(0.0_f64, |a, e| a.max(e.abs()));
    let squares = if largest > 1e150 { f64::INFINITY } else { residuals.iter().map(|e| e * e).sum::<f64>() };
    let error = if error.is_nan() { f64::INFINITY } else { error };
    let squares = if squares.is_nan() { f64::INFINITY } else { squares };
    let nr = (squares / deviation).sqrt();
    Ok(Metrics { error, rmse: (squares / m).sqrt(), nr, fit_percent: 100.0 * (1.0 - nr) })
}

/// Correlation of two signals x and y, pooled over runs.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Correlation {
    /// Correlations r(k) = corr(x(t + k), y(t)) for k = −lags … lags. They are zero if a signal is constant.
    pub values: Vec<f64>,
    /// Variance of each correlation if x and y are independent: Bartlett's Σ ρx(τ)ρy(τ)/N (doi:10.2307/2983611).
    ///
    /// The sum is truncated where the correlations of x have decayed. The variance is at least that of white noise.
    pub variance: f64,
    /// Number of lags on each side in the truncated sum of `variance`.
    pub window: usize,
}

/// Length of the truncated sum for the variance of a correlation, in correlation times (Sokal's windowing). A longer
/// sum adds only noise.
const WINDOW_CORRELATION_TIMES: f64 = 6.0;

/// Return the correlations of x with y at lags −`lags` … `lags`. The mean of each run is subtracted from its samples.
/// O(N log N) for N samples.
///
/// # Errors
/// [`Error::Length`] if x and y differ in runs or samples. [`Error::OutOfRange`] if a run has no more samples than
/// `lags`. [`Error::NotFinite`] for a sample that is not finite.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// let x = [vec![1.0, -1.0, 1.0, -1.0, 1.0, -1.0]];
/// let found = ftlm::signal::metrics::correlation(&x, &x, 1)?;
/// assert!((found.values[1] - 1.0).abs() < 1e-12 && found.values[2] < -0.8);
/// # Ok(())
/// # }
/// ```
#[allow(clippy::cast_precision_loss)]
pub fn correlation(x: &[Vec<f64>], y: &[Vec<f64>], lags: usize) -> Result<Correlation> {
    check_length("runs", x.len(), y.len())?;
    let shortest = x.iter().map(Vec::len).min().unwrap_or(0);
    for (a, b) in x.iter().zip(y) {
        check_length("samples", a.len(), b.len())?;
        check_finite("x", a)?;
        check_finite("y", b)?;
    }
    if shortest <= lags {
        return Err(Error::OutOfRange {
            name: "lags".into(),
            value: lags as f64,
            range: format!("[0, {shortest})"),
            remedy: "give longer runs or fewer lags".into(),
        });
    }
    // Correlations at lags above a quarter of a run are estimated from too few samples.
    let max_lag = lags.max(shortest / 4);
    let (cross, auto_x, auto_y) =
        (pool_covariances(x, y, max_lag), pool_covariances(x, x, max_lag), pool_covariances(y, y, max_lag));
    let (power_x, power_y) = (auto_x[max_lag], auto_y[max_lag]);
    let scale = (power_x * power_y).sqrt();
    let ratio_or_zero = |value: f64, divisor: f64| if divisor > 0.0 { value / divisor } else { 0.0 };
    let values = cross[max_lag - lags..=max_lag + lags].iter().map(|c| ratio_or_zero(*c, scale)).collect();
    let count = x.iter().map(Vec::len).sum::<usize>() as f64;
    let (mut sum, mut time, mut window) = (1.0, 1.0, 0);
    while window < shortest / 4 && (window as f64) < WINDOW_CORRELATION_TIMES * time {
        window += 1;
        let (rx, ry) =
            (ratio_or_zero(auto_x[max_lag + window], power_x), ratio_or_zero(auto_y[max_lag + window], power_y));
        sum += 2.0 * rx * ry;
        time += 2.0 * rx * rx;
    }
    // For signals with opposite oscillations, the sum of estimated correlations may vanish or be negative. White noise
    // is the lower limit.
    Ok(Correlation { values, variance: sum.max(1.0) / count, window })
}

/// Return the covariances Σ x(t + k) y(t) for k = −lags … lags, about the mean of each run, summed over runs.
fn pool_covariances(x: &[Vec<f64>], y: &[Vec<f64>], lags: usize) -> Vec<f64> {
    let mut sums = vec![0.0; 2 * lags + 1];
    for (a, b) in x.iter().zip(y) {
        let run_covariances = covariances(&subtract_mean(a), &subtract_mean(b), lags);
        sums.iter_mut().zip(run_covariances).for_each(|(s, c)| *s += c);
    }
    sums
}

#[allow(clippy::cast_precision_loss)]
fn subtract_mean(x: &[f64]) -> Vec<f64> {
    let mean = x.iter().sum::<f64>() / (x.len().max(1)) as f64;
    x.iter().map(|v| v - mean).collect()
}

/// Return the cross-covariances Σ x(t + k) y(t) for k = −lags … lags, computed by one product of spectra. Means are not
/// subtracted.
#[must_use]
pub fn covariances(x: &[f64], y: &[f64], lags: usize) -> Vec<f64> {
    let plan = fft::plan(fft::fast_length(x.len().max(y.len()) + lags + 1));
    let mut workspace = fft::Workspace::new();
    let mut spectrum_of = |signal: &[f64]| {
        let mut time = vec![0.0; plan.len()];
        time[..signal.len()].copy_from_slice(signal);
        let mut spectrum = vec![fft::Bin::new(0.0, 0.0); plan.bins()];
        plan.transform(&mut time, &mut spectrum, &mut workspace);
        spectrum
    };
    let (mut product, other) = (spectrum_of(x), spectrum_of(y));
    product.iter_mut().zip(other).for_each(|(a, b)| *a *= b.conj());
    let mut time = vec![0.0; plan.len()];
    plan.inverse(&mut product, &mut time, &mut workspace);
    let negative_lags = time[time.len() - lags..].iter();
    negative_lags.chain(&time[..=lags]).copied().collect()
}

/// Return the cross-covariances by their definition, as a reference for tests of [`covariances`]. O(N lags).
#[cfg(feature = "oracles")]
#[must_use]
pub fn covariances_naive(x: &[f64], y: &[f64], lags: usize) -> Vec<f64> {
    let sum =
        |lagged: &[f64], leading: &[f64], k: usize| lagged.iter().skip(k).zip(leading).map(|(a, b)| a * b).sum::<f64>();
    (1..=lags).rev().map(|k| sum(y, x, k)).chain((0..=lags).map(|k| sum(x, y, k))).collect()
}

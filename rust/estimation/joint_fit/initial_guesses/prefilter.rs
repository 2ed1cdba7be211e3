//! Signal bandwidth and low-pass prefilters.

use std::f64::consts::PI;
use std::sync::{Arc, Mutex, PoisonError};

use crate::equation::Filter;
use crate::error::Result;
use crate::fft::{plan, Bin, Workspace};
use crate::regressors::Record;
use crate::series;
use crate::signal::statistics::{mean, sum};

/// Maximum number of cached low-pass filters.
const MAX_CACHED_LOW_PASSES: usize = 32;

/// Key of a cached low-pass filter: bits of the cutoff frequency, number of pulses, bits of the pulse width.
type LowPassKey = (u64, usize, u64);

/// Cache of the series of second-order low-pass filters, shared by all problems of a multistart.
#[derive(Debug, Default)]
pub(super) struct LowPassCache(Mutex<Vec<(LowPassKey, Arc<Vec<f64>>)>>);

impl LowPassCache {
    /// Return a record whose signals and initial terms have passed a low-pass filter.
    ///
    /// The cutoff frequency is `cutoff` \[rad/s\]. Without one, the result is a copy of the record.
    pub(super) fn filter_record(&self, record: &Record, cutoff: Option<f64>) -> Result<Record> {
        let m = record.m();
        let low_pass = cutoff.map(|cutoff| self.low_pass_series(cutoff, m, record.step())).transpose()?;
        let signals = (0..record.len()).map(|i| record.signal(i));
        let Some(low_pass) = low_pass else {
            // Without a cutoff frequency the record is copied.
            return Record::from_rows(
                record.step(),
                signals.map(<[f64]>::to_vec).collect(),
                record.filter().map(Into::into),
            );
        };
        let filter = record.filter().map_or_else(|| low_pass.to_vec(), |f| series::multiply(&low_pass, f, m));
        Record::from_rows(record.step(), signals.map(|s| series::multiply(&low_pass, s, m)).collect(), Some(filter))
    }

    /// Return the series of a second-order low-pass filter with cutoff frequency `omega` \[rad/s\].
    ///
    /// The series has `m` pulses of width `step` \[s\].
    fn low_pass_series(&self, omega: f64, m: usize, step: f64) -> Result<Arc<Vec<f64>>> {
        let key = (omega.to_bits(), m, step.to_bits());
        {
            let mut cache = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(index) = cache.iter().position(|(k, _)| *k == key) {
                let entry = cache.remove(index);
                let series = entry.1.clone();
                cache.push(entry);
                return Ok(series);
            }
        }
        let square = omega * omega;
        let denominator = vec![(1.0, 2.0), (1.4 * omega, 1.0), (square, 0.0)];
        let filter = Arc::new(Filter { numerator: vec![(square, 0.0)], denominator }.series(m, step)?);
        let mut cache = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        cache.push((key, filter.clone()));
        if cache.len() > MAX_CACHED_LOW_PASSES {
            cache.remove(0);
        }
        Ok(filter)
    }
}

/// Fraction of the power of a signal that lies below its bandwidth.
const BANDWIDTH_POWER_RATIO: f64 = 0.9;

/// Bandwidth \[rad/s\] of a signal: the frequency below which 90 % of its power lies.
///
/// `step` is the sampling interval \[s\]. Missing samples (NaN) are interpolated. The result is NaN without samples.
/// The cost is O(N log N) for N samples.
///
/// ```
/// use ftlm::estimation::joint_fit::initial_guesses::power_frequency;
/// let wave: Vec<f64> = (0..500).map(|k| (0.1 * f64::from(k)).sin()).collect();
/// // One bin of the transform is 2π/5 rad/s.
/// assert!((power_frequency(&wave, 0.01) - 10.0).abs() < 2.6);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn power_frequency(samples: &[f64], step: f64) -> f64 {
    cumulative_power_frequency(samples, step, BANDWIDTH_POWER_RATIO)
}

/// Frequency \[rad/s\] below which this fraction of the power of the samples lies.
#[allow(clippy::cast_precision_loss)]
pub(super) fn cumulative_power_frequency(samples: &[f64], step: f64, fraction: f64) -> f64 {
    let count = samples.len();
    if count == 0 {
        return f64::NAN;
    }
    let samples = interpolate_gaps(samples);
    let center = mean(&samples);
    let (last, plan) = (count as f64 - 1.0, plan(count));
    let window = |k: usize| match count {
        1 => 1.0,
        _ => 0.5 + 0.5 * libm::cos(PI * (2.0 * k as f64 - last) / last),
    };
    let mut time: Vec<f64> = samples.iter().enumerate().map(|(k, v)| (v - center) * window(k)).collect();
    let mut spectrum = vec![Bin::new(0.0, 0.0); plan.bins()];
    plan.transform(&mut time, &mut spectrum, &mut Workspace::new());
    let power: Vec<f64> = spectrum.iter().map(Bin::norm_sqr).collect();
    let (total_power, mut power_below) = (sum(&power), 0.0);
    // A constant signal has no power; its bandwidth is the lowest frequency of the run.
    let reaches_share = |power: &f64| {
        power_below += power;
        power_below / total_power >= fraction || (power_below / total_power).is_nan()
    };
    let bin = power.iter().position(reaches_share).unwrap_or(power.len());
    2.0 * PI * bin.max(1) as f64 / (count as f64 * step)
}

/// Return the samples with missing ones (NaN) interpolated linearly, and with the nearest value at the ends.
#[allow(clippy::cast_precision_loss)]
fn interpolate_gaps(samples: &[f64]) -> Vec<f64> {
    let mut out = samples.to_vec();
    let rows_present: Vec<usize> = (0..samples.len()).filter(|&k| !samples[k].is_nan()).collect();
    let (Some(&first), Some(&last)) = (rows_present.first(), rows_present.last()) else { return out };
    out[..first].fill(samples[first]);
    out[last..].fill(samples[last]);
    for pair in rows_present.windows(2) {
        let (low, high) = (pair[0], pair[1]);
        let slope = (samples[high] - samples[low]) / (high - low) as f64;
        for (k, value) in out[low + 1..high].iter_mut().enumerate() {
            *value = slope * (k + 1) as f64 + samples[low];
        }
    }
    out
}

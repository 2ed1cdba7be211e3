//! Signals at nonuniform sample times: values between samples, jumps of a zero-order hold, exact block-pulse means.
//!
//! A signal with a zero-order hold is constant from each sample to the next. All other signals are linear between
//! samples. Sample times ascend from 0.

use std::borrow::Cow;

use super::block_pulse::{check_pulses, Intersample, PulseJump, PulseMeans};
use crate::error::{check_finite, check_length, check_step, Error, Result};

/// Distance in pulses within which a sample time counts as a pulse edge.
const EDGE_TOLERANCE_PULSES: f64 = 1e-6;
/// Tolerance for the comparison of times, as a fraction of the duration.
pub(crate) const TIME_TOLERANCE: f64 = 1e-12;

/// Samples of one signal with their times \[s\], and the behavior between samples.
#[derive(Debug, Clone)]
pub struct NonuniformSignal<'a> {
    times: Cow<'a, [f64]>,
    values: Cow<'a, [f64]>,
    intersample: Intersample,
}

impl<'a> NonuniformSignal<'a> {
    /// Signal with one value per sample time. Missing values of a linear signal are NaN.
    ///
    /// # Errors
    /// [`Error::Length`] without samples or for different numbers of times and values. [`Error::NotFinite`] or
    /// [`Error::Structure`] for times that do not ascend from 0.
    pub fn new(times: &'a [f64], values: &'a [f64], intersample: Intersample) -> Result<Self> {
        check_times(times)?;
        check_length("values at the sample times", times.len(), values.len())?;
        Ok(Self::new_unchecked(times, values, intersample))
    }

    /// Return a signal without checking its sample times, which must ascend from 0.
    pub(crate) fn new_unchecked(times: &'a [f64], values: &'a [f64], intersample: Intersample) -> Self {
        Self { times: Cow::Borrowed(times), values: Cow::Borrowed(values), intersample }
    }

    /// Return the signal after a delay \[s\]. `before` is the value before its first sample. With a negative delay, the
    /// last value is repeated at the end.
    #[must_use]
    pub fn with_delay(self, delay: f64, before: f64) -> Self {
        if delay == 0.0 {
            return self;
        }
        if delay < 0.0 {
            let (first, last) = (self.at(&[-delay])[0], self.times.len().checked_sub(1));
            let first_row = self.times.partition_point(|t| t + delay <= 0.0);
            let last_sample = last.map(|k| (self.times[k], self.values[k]));
            let shifted = self.times.iter().zip(self.values.iter()).skip(first_row).map(|(t, v)| (t + delay, *v));
            let (times, values): (Vec<f64>, Vec<f64>) =
                std::iter::once((0.0, first)).chain(shifted).chain(last_sample).unzip();
            return Self { times: times.into(), values: values.into(), ..self };
        }
        let times = std::iter::once(0.0).chain(self.times.iter().map(|t| t + delay)).collect();
        let values = std::iter::once(before).chain(self.values.iter().copied()).collect();
        Self { times, values, ..self }
    }

    /// Return exact means over `m` pulses of width `step` \[s\]. O((N + m) log m) for N samples.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for no pulse, too many pulses, or a step that is not positive. [`Error::NotFinite`] for a
    /// value that is not finite.
    ///
    /// ```
    /// # use ftlm::signal::{block_pulse::Intersample, nonuniform::NonuniformSignal};
    /// let input = NonuniformSignal::new(&[0.0, 0.5, 1.25], &[1.0, 3.0, 0.0], Intersample::Hold)?;
    /// assert_eq!(input.means(2, 1.0)?.values(), [2.0, 0.75]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[allow(clippy::cast_precision_loss)]
    pub fn means(&self, m: usize, step: f64) -> Result<PulseMeans> {
        check_pulses(m)?;
        check_step(step)?;
        check_finite("samples", &self.values)?;
        let edges: Vec<f64> = (0..=m).map(|k| k as f64 * step).collect();
        Ok(PulseMeans::new(match self.intersample {
            Intersample::Hold => self.hold_means(&edges, step),
            Intersample::Linear => self.linear_means(&edges, step),
        }))
    }

    /// Return the means of a zero-order-hold signal, without rounding error if the value is constant within a pulse.
    fn hold_means(&self, edges: &[f64], step: f64) -> Vec<f64> {
        let m = edges.len() - 1;
        let is_equal = |edge: f64, time: f64| (edge - time).abs() <= EDGE_TOLERANCE_PULSES * step;
        // A switching time within rounding of a pulse edge counts as this edge.
        let switches: Vec<f64> = (self.times.iter())
            .map(|&time| {
                let after = edges.partition_point(|edge| *edge < time).min(m);
                let nearest = if after > 0 && is_equal(edges[after - 1], time) { after - 1 } else { after };
                if is_equal(edges[nearest], time) {
                    edges[nearest]
                } else {
                    time
                }
            })
            .collect();
        let (mut means, mut row) = (Vec::with_capacity(m), 0);
        for pulse in edges.windows(2) {
            let (start, end) = (pulse[0], pulse[1]);
            let advance = |mut row: usize, time: f64| {
                while switches.get(row + 1).is_some_and(|next| *next <= time) {
                    row += 1;
                }
                row
            };
            row = advance(row, start);
            let (first, mut part_start, mut sum) = (self.values[row], start, 0.0);
            while part_start < end {
                let next = switches.get(row + 1).copied().unwrap_or(f64::INFINITY).min(end);
                sum += (self.values[row] - first) * ((next - part_start) / step);
                part_start = next;
                if part_start < end {
                    row = advance(row, part_start);
                }
            }
            means.push(first + sum);
        }
        means
    }

    fn linear_means(&self, edges: &[f64], step: f64) -> Vec<f64> {
        let (times, values) = (&self.times, &self.values);
        let mut areas = vec![0.0];
        let mut area = 0.0;
        for (t, v) in times.windows(2).zip(values.windows(2)) {
            area += 0.5 * (v[1] + v[0]) * (t[1] - t[0]);
            areas.push(area);
        }
        let integrals: Vec<f64> = (edges.iter())
            .map(|&edge| {
                let row = times.partition_point(|time| *time <= edge).saturating_sub(1);
                areas[row] + 0.5 * (values[row] + interpolate(edge, times, values)) * (edge - times[row])
            })
            .collect();
        integrals.windows(2).map(|pair| (pair[1] - pair[0]) / step).collect()
    }

    /// Return the values at given times \[s\]. At a jump of a zero-order-hold signal, this is the value after the jump.
    #[must_use]
    pub fn at(&self, times: &[f64]) -> Vec<f64> {
        let (sample_times, values) = (&self.times, &self.values);
        if self.intersample == Intersample::Linear {
            return times.iter().map(|&time| interpolate(time, sample_times, values)).collect();
        }
        // Times that differ from a switching time by rounding only count as equal to it.
        let tolerance = TIME_TOLERANCE * sample_times.last().copied().unwrap_or(0.0).max(1e-300);
        let value_before = |time: &f64| {
            values[sample_times.partition_point(|sample_time| *sample_time <= time + tolerance).saturating_sub(1)]
        };
        times.iter().map(value_before).collect()
    }

    /// Return the times \[s\] and sizes of the jumps of a zero-order-hold signal, including the initial jump from 0.
    /// None for a linear signal.
    #[must_use]
    pub fn jumps(&self) -> Option<(Vec<f64>, Vec<f64>)> {
        let mut before = 0.0;
        let sizes = self.values.iter().map(|&value| value - std::mem::replace(&mut before, value)).collect();
        (self.intersample == Intersample::Hold).then(|| (self.times.to_vec(), sizes))
    }

    /// Return the jumps of a zero-order-hold signal within `m` pulses of width `step` \[s\], without jumps at pulse
    /// edges. Empty for a linear signal.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::float_cmp)]
    pub fn pulse_jumps(&self, m: usize, step: f64) -> Vec<PulseJump> {
        if self.intersample != Intersample::Hold {
            return Vec::new();
        }
        let jump = |(values, &time): (&[f64], &f64)| {
            let position = time / step;
            let pulse = position.floor();
            let is_inside = (position - position.round()).abs() > EDGE_TOLERANCE_PULSES;
            (is_inside && values[0] != values[1]).then_some(PulseJump {
                pulse: pulse as usize,
                fraction: position - pulse,
                before: values[0],
                after: values[1],
            })
        };
        let times = self.times.iter().skip(1);
        self.values.windows(2).zip(times).filter_map(jump).filter(|jump| jump.pulse < m).collect()
    }
}

/// Return an error for sample times that do not ascend from 0.
///
/// # Errors
/// [`Error::Length`] without times, [`Error::NotFinite`] for a time that is not finite, [`Error::Structure`] for a
/// negative or descending time.
pub(crate) fn check_times(times: &[f64]) -> Result<()> {
    check_length("sample times", times.len().max(1), times.len())?;
    check_finite("sample times", times)?;
    let first_decrease = times.windows(2).position(|pair| pair[0] > pair[1]).map(|k| k + 1);
    match first_decrease.or((times[0] < 0.0).then_some(0)) {
        None => Ok(()),
        Some(row) => Err(Error::Structure {
            what: format!("sample time {row} is {} s", times[row]),
            remedy: "give increasing sample times that start at 0".into(),
        }),
    }
}

/// Interpolate samples linearly at one time. `times` is ascending. Outside of it, the first or last value is returned.
///
/// In an interval with a missing value (NaN) at one end, the result is NaN.
#[must_use]
#[allow(clippy::float_cmp)]
pub fn interpolate(time: f64, times: &[f64], values: &[f64]) -> f64 {
    let after = times.partition_point(|t| *t <= time);
    let Some(row) = after.checked_sub(1) else { return values[0] };
    if after == times.len() || times[row] == time {
        return values[row];
    }
    let slope = (values[after] - values[row]) / (times[after] - times[row]);
    slope * (time - times[row]) + values[row]
}

/// Interpolate missing uniform samples (NaN) linearly. At the ends, the nearest value is used. If all samples are
/// missing, they stay NaN.
///
/// ```
/// # use ftlm::signal::nonuniform::interpolate_gaps;
/// assert_eq!(*interpolate_gaps(&[f64::NAN, 1.0, f64::NAN, 2.0]), [1.0, 1.0, 1.5, 2.0]);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn interpolate_gaps(samples: &[f64]) -> Cow<'_, [f64]> {
    if !samples.iter().any(|v| v.is_nan()) || samples.iter().all(|v| v.is_nan()) {
        return Cow::Borrowed(samples);
    }
    let finite_samples = || samples.iter().enumerate().filter(|(_, v)| !v.is_nan());
    let rows: Vec<f64> = finite_samples().map(|(row, _)| row as f64).collect();
    let values: Vec<f64> = finite_samples().map(|(_, v)| *v).collect();
    let fill = |(row, &v): (usize, &f64)| if v.is_nan() { interpolate(row as f64, &rows, &values) } else { v };
    Cow::Owned(samples.iter().enumerate().map(fill).collect())
}

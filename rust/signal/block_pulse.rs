//! Block-pulse coefficients: means of samples over pulses, delays, and interpolation back to nonuniform sample times.
//!
//! Sample j of a signal belongs to the time t = jh, where h is the sampling interval. An input command has a zero-order
//! hold: it is constant over [jh, (j+1)h). A measured signal is linear between its samples. Estimates from samples in
//! place of pulse means would be biased.
//!
//! Four pulse means around a sample time determine the value of a smooth signal with fourth-order accuracy. This value
//! is the slope of the quartic polynomial through the integral of the signal at the five pulse edges. After a jump of a
//! zero-order-hold input, the signal is not smooth. The fractional integral I^η of a jump of size Δ at time p is Δ (t −
//! p)^η/Γ(η + 1), which has a slope discontinuity. Pulse means replace the jump by a ramp within its pulse. Both
//! responses are known exactly, so samples near a jump are corrected by their difference.

use crate::error::{check_finite, check_points, Error, Result};

/// Inter-sample behavior of a signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Intersample {
    /// Zero-order hold, for commands: constant from each sample to the next.
    Hold,
    /// First-order hold, for measured signals: linear between samples.
    Linear,
}

/// Means of one signal over equal pulses. The type distinguishes them from samples, so that conversions are explicit.
///
/// ```compile_fail,E0308
/// use ftlm::regressors::Record;
/// let samples: Vec<f64> = vec![0.0, 1.0, 3.0];
/// let record = Record::new(0.1, vec![samples], None);
/// ```
///
/// ```compile_fail,E0308
/// use ftlm::prelude::*;
/// let means = PulseMeans::new(vec![0.5, 2.0]);
/// let channel = Channel::new("y", means, Role::Output);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct PulseMeans(Vec<f64>);

impl PulseMeans {
    /// Pulse means with these values, which are not checked. [`pulse_means`] computes pulse means from samples.
    ///
    /// ```
    /// use ftlm::signal::block_pulse::PulseMeans;
    /// assert_eq!(PulseMeans::new(vec![0.5, 2.0]).values(), [0.5, 2.0]);
    /// ```
    #[must_use]
    pub fn new(values: Vec<f64>) -> Self {
        Self(values)
    }

    /// Pulse means of several signals, from their values.
    #[must_use]
    pub fn from_signals(signals: Vec<Vec<f64>>) -> Vec<Self> {
        signals.into_iter().map(Self).collect()
    }

    /// Values of the means, one per pulse.
    #[must_use]
    pub fn values(&self) -> &[f64] {
        &self.0
    }

    /// Convert to the values of the means, without a copy.
    #[must_use]
    pub fn into_vec(self) -> Vec<f64> {
        self.0
    }
}

/// Jump of a zero-order-hold signal within a pulse.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PulseJump {
    /// Index of the pulse.
    pub pulse: usize,
    /// Fraction of the pulse that precedes the jump.
    pub fraction: f64,
    /// Value before the jump.
    pub before: f64,
    /// Value after the jump.
    pub after: f64,
}

/// Return the means of a signal over `m` equal pulses of [0, (N−1)h], where N is the number of samples and h their
/// interval. O(N + m).
///
/// `m` is arbitrary. With m = N − 1, a pulse is a sampling interval. With a multiple of N − 1, a sampling interval
/// contains several pulses. With a smaller m, the means are exact averages over several sampling intervals.
///
/// # Errors
/// [`Error::Length`] for fewer than two samples. [`Error::OutOfRange`] for m = 0 or too many pulses.
/// [`Error::NotFinite`] for a sample that is not finite.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::signal::block_pulse::{pulse_means, Intersample};
/// assert_eq!(pulse_means(&[0.0, 1.0, 3.0], 2, Intersample::Linear)?.values(), [0.5, 2.0]);
/// assert_eq!(pulse_means(&[0.0, 1.0, 3.0], 2, Intersample::Hold)?.values(), [0.0, 1.0]);
/// # Ok(())
/// # }
/// ```
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn pulse_means(samples: &[f64], m: usize, intersample: Intersample) -> Result<PulseMeans> {
    let Some(intervals) = samples.len().checked_sub(1).filter(|&n| n > 0) else {
        return Err(Error::Length { name: "samples".into(), expected: 2, found: samples.len() });
    };
    check_pulses(m)?;
    check_finite("samples", samples)?;
    // Integral over interval j from its start to a fraction x of it.
    let partial = |j: usize, x: f64| match intersample {
        Intersample::Hold => samples[j] * x,
        Intersample::Linear => x * (samples[j] + 0.5 * x * (samples[j + 1] - samples[j])),
    };
    // Edge k of the pulses is at interval k·n/m. Integer quotient and remainder make edges exact.
    let edge = |k: usize| {
        let product = k as u128 * intervals as u128;
        let quotient = (product / m as u128) as usize;
        let fraction = (product % m as u128) as f64 / m as f64;
        (quotient, fraction)
    };
    let per_pulse = m as f64 / intervals as f64;
    let mut means = Vec::with_capacity(m);
    let (mut j, mut x) = edge(0);
    for k in 1..=m {
        let (next_j, next_x) = edge(k);
        let mut integral = 0.0;
        if next_j == j {
            integral += slice_integral(samples, intersample, j, x, next_x);
        } else {
            integral += if x == 0.0 { partial(j, 1.0) } else { slice_integral(samples, intersample, j, x, 1.0) };
            for i in j + 1..next_j {
                integral += partial(i, 1.0);
            }
            if next_x > 0.0 {
                integral += partial(next_j, next_x);
            }
        }
        means.push(if m == intervals { integral } else { integral * per_pulse });
        (j, x) = (next_j, next_x);
    }
    Ok(PulseMeans(means))
}

/// Return an error if the number of pulses is zero or too large.
pub(crate) fn check_pulses(m: usize) -> Result<()> {
    if m > 0 {
        return check_points("m", m);
    }
    Err(Error::OutOfRange {
        name: "m".into(),
        value: 0.0,
        range: "[1, ∞)".into(),
        remedy: "give at least one pulse".into(),
    })
}

/// Return the integral over the part of interval `j` from the fraction `a` to the fraction `b` of its length. No
/// difference of two partial integrals is formed, so no digits cancel.
fn slice_integral(samples: &[f64], intersample: Intersample, j: usize, a: f64, b: f64) -> f64 {
    match intersample {
        Intersample::Hold => samples[j] * (b - a),
        Intersample::Linear => {
            (b - a) * (samples[j] + 0.5 * (a + b) * (samples.get(j + 1).unwrap_or(&samples[j]) - samples[j]))
        }
    }
}

/// Delay samples u_j by `delay` = d + φ steps, with an integer d and 0 ≤ φ < 1: u_j ← (1−φ)·u_{j−d} + φ·u_{j−d−1}.
///
/// For a zero-order-hold input, the result contains the exact means after this delay. `before` is the value before the
/// record. With a negative delay, the last sample is repeated at the end of the record.
///
/// # Errors
/// [`Error::NotFinite`] for a delay, a sample or a value `before` that is not finite.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// assert_eq!(ftlm::signal::block_pulse::delay_samples(&[1.0, 2.0, 3.0], 1.5, 0.0)?, [0.0, 0.5, 1.5]);
/// # Ok(())
/// # }
/// ```
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
pub fn delay_samples(samples: &[f64], delay: f64, before: f64) -> Result<Vec<f64>> {
    check_finite("delay", &[delay])?;
    check_finite("samples", samples)?;
    check_finite("before", &[before])?;
    let (count, integer_delay) = (samples.len(), delay.floor());
    let fraction = delay - integer_delay;
    let integer_delay = integer_delay.clamp(-(count as f64), count as f64) as isize;
    let sample_before = |j: usize, back: isize| delayed_row(j, back).map_or(before, |i| samples[i.min(count - 1)]);
    Ok((0..count)
        .map(|j| {
            let nearer = sample_before(j, integer_delay);
            if fraction == 0.0 {
                nearer
            } else {
                (1.0 - fraction) * nearer + fraction * sample_before(j, integer_delay + 1)
            }
        })
        .collect())
}

/// Return the index of the sample that appears in row `j` after a delay by an integer number of rows. The delay may be
/// negative. None before the record.
pub(crate) fn delayed_row(j: usize, delay: isize) -> Option<usize> {
    j.checked_add_signed(delay.saturating_neg())
}

/// Return point samples at 0, h, …, mh from m pulse means. They are averages of neighboring pulses, with second-order
/// extrapolation at both ends.
#[must_use]
pub fn point_samples(means: &[f64]) -> Vec<f64> {
    let m = means.len();
    if m < 2 {
        return vec![means.first().copied().unwrap_or(0.0); m + 1];
    }
    let mut samples = Vec::with_capacity(m + 1);
    samples.push(1.5 * means[0] - 0.5 * means[1]);
    samples.extend(means.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])));
    samples.push(1.5 * means[m - 1] - 0.5 * means[m - 2]);
    samples
}

/// Number of pulse means from which one sample is interpolated.
const STENCIL_PULSES: usize = 4;
/// Number of pulses after a jump within which samples are corrected for the slope discontinuity. Beyond this range, the
/// error decreases with the square of the step, like all other errors of the scheme.
const KINK_RANGE_PULSES: f64 = 16.0;

/// Jump of a zero-order-hold signal near a sample time. All lengths are in pulses.
#[derive(Debug, Clone, Copy, PartialEq)]
struct NearbyJump {
    /// Time from the jump to the sample; negative for a jump after the sample.
    time_since_jump: f64,
    /// Index of the first pulse of the interpolation, relative to the pulse of the jump.
    first: isize,
    /// Fraction of the pulse of the jump that precedes the jump.
    fraction: f64,
    size: f64,
}

/// Nonuniform sample times on a grid of pulses, with the weights of the interpolation from pulse means.
#[derive(Debug, Clone, PartialEq)]
pub struct SampleInterpolation {
    first: Vec<usize>,
    weights: Vec<[f64; STENCIL_PULSES]>,
    positions: Vec<f64>,
}

/// Jumps of one zero-order-hold signal near each sample time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Jumps {
    starts: Vec<usize>,
    jumps: Vec<NearbyJump>,
}

impl SampleInterpolation {
    /// Build the interpolation at these positions among `m` pulses. A position is a time in pulses from the start of
    /// the first pulse.
    ///
    /// # Errors
    /// [`Error::Length`] for fewer than four pulses. [`Error::OutOfRange`] or [`Error::NotFinite`] for a position
    /// outside the pulses.
    ///
    /// ```
    /// # fn main() -> ftlm::error::Result<()> {
    /// // Means of t³ over pulses of 1 s.
    /// let means: Vec<f64> = (0..6).map(|k| 0.25 * (f64::from(k + 1).powi(4) - f64::from(k).powi(4))).collect();
    /// let interpolation = ftlm::signal::block_pulse::SampleInterpolation::new(vec![0.3, 2.5, 5.9], 6)?;
    /// let samples = interpolation.interpolate(&means);
    /// assert!(samples.iter().zip([0.3_f64, 2.5, 5.9]).all(|(y, t)| (y - t.powi(3)).abs() < 1e-9));
    /// # Ok(())
    /// # }
    /// ```
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    pub fn new(positions: Vec<f64>, m: usize) -> Result<Self> {
        if m < STENCIL_PULSES {
            return Err(Error::Length {
                name: "pulses around a nonuniform sample".into(),
                expected: STENCIL_PULSES,
                found: m,
            });
        }
        check_finite("times of nonuniform samples", &positions)?;
        if let Some(&value) = positions.iter().find(|&&p| !(0.0..=m as f64).contains(&p)) {
            let remedy = "remove samples before or after the time span of the inputs".into();
            return Err(Error::OutOfRange {
                name: "time of a nonuniform sample".into(),
                value,
                range: format!("[0, {m}]"),
                remedy,
            });
        }
        let half = STENCIL_PULSES / 2;
        let first: Vec<usize> =
            positions.iter().map(|p| ((p + 0.5) as usize).saturating_sub(half).min(m - STENCIL_PULSES)).collect();
        let weights = positions.iter().zip(&first).map(|(p, &f)| stencil(p - f as f64)).collect();
        Ok(Self { first, weights, positions })
    }

    /// Number of sample times.
    #[must_use]
    pub fn len(&self) -> usize {
        self.first.len()
    }

    /// True if there are no sample times.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.first.is_empty()
    }

    /// Return the samples of a smooth signal from its pulse means.
    #[must_use]
    pub fn interpolate(&self, means: &[f64]) -> Vec<f64> {
        let value = |(&first, weights): (&usize, &[f64; STENCIL_PULSES])| -> f64 {
            weights.iter().zip(&means[first..]).map(|(w, v)| w * v).sum()
        };
        self.first.iter().zip(&self.weights).map(value).collect()
    }

    /// Return the jumps of a zero-order-hold signal near each sample time. `positions` holds the ascending positions of
    /// the jumps in pulses, and `sizes` their sizes.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, clippy::cast_precision_loss)]
    pub fn jumps(&self, positions: &[f64], sizes: &[f64]) -> Jumps {
        let mut result = Jumps { starts: vec![0], jumps: Vec::new() };
        for (&sample_position, &first) in self.positions.iter().zip(&self.first) {
            let start = positions.partition_point(|&p| p < sample_position - KINK_RANGE_PULSES);
            let end = positions.partition_point(|&p| p < (first + STENCIL_PULSES) as f64);
            for (&p, &size) in
                positions[start..end.max(start)].iter().zip(sizes.iter().skip(start)).filter(|(_, size)| **size != 0.0)
            {
                let pulse = p.floor();
                result.jumps.push(NearbyJump {
                    time_since_jump: sample_position - p,
                    first: first as isize - pulse as isize,
                    fraction: p - pulse,
                    size,
                });
            }
            result.starts.push(result.jumps.len());
        }
        result
    }

    /// Return the corrections of the samples of the fractional integral of order `eta` of a zero-order-hold signal.
    /// Each correction is the exact response to the jumps of the signal minus the response that pulse means represent.
    /// `step` \[s\] is the pulse length.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn kink_corrections(&self, jumps: &Jumps, eta: f64, step: f64) -> Vec<f64> {
        let scale = libm::pow(step, eta);
        let (kink_scale, mean_scale) = (scale / libm::tgamma(eta + 1.0), scale / libm::tgamma(eta + 2.0));
        // Mean response over the n-th pulse after a jump at the start of a pulse.
        let longest = jumps.jumps.iter().map(|jump| jump.first).max().unwrap_or(0).max(0) + STENCIL_PULSES as isize;
        let powers: Vec<f64> = (0..=longest + 1).map(|n| libm::pow(n as f64, eta + 1.0)).collect();
        let pulse_response = |n: isize| usize::try_from(n).map_or(0.0, |n| mean_scale * (powers[n + 1] - powers[n]));
        let correction = |jump: &NearbyJump, weights: &[f64; STENCIL_PULSES]| {
            let sample = match jump.time_since_jump {
                time if time < 0.0 => 0.0,
                time if eta == 0.0 && time == 0.0 => kink_scale,
                time => kink_scale * libm::pow(time, eta),
            };
            let interpolated: f64 = (jump.first..)
                .zip(weights)
                .map(|(n, w)| w * ((1.0 - jump.fraction) * pulse_response(n) + jump.fraction * pulse_response(n - 1)))
                .sum();
            jump.size * (sample - interpolated)
        };
        let spans = jumps.starts.iter().zip(jumps.starts.iter().skip(1)).zip(&self.weights);
        spans
            .map(|((&from, &to), weights)| jumps.jumps[from..to].iter().map(|n| correction(n, weights)).sum())
            .collect()
    }
}

/// Return the weights of four pulse means for the value at x pulses from the start of the first one. They are slopes of
/// the Lagrange polynomials through the integral at the five pulse edges.
#[allow(clippy::cast_precision_loss)]
fn stencil(x: f64) -> [f64; STENCIL_PULSES] {
    let slope = |m: usize| -> f64 {
        let other_nodes: Vec<f64> = (0..=STENCIL_PULSES).filter(|&j| j != m).map(|j| j as f64).collect();
        let denominator: f64 = other_nodes.iter().map(|j| m as f64 - j).product();
        let product_without =
            |i: usize| other_nodes.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, v)| x - v).product::<f64>();
        (0..other_nodes.len()).map(product_without).sum::<f64>() / denominator
    };
    let mut weights = [0.0; STENCIL_PULSES];
    let mut sum = 0.0;
    for k in (0..STENCIL_PULSES).rev() {
        sum += slope(k + 1);
        weights[k] = sum;
    }
    weights
}

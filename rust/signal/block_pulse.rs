//! From point samples to pulse means: the inter-sample behaviour of a record, integrated exactly.
//!
//! Row j of a record holds t = jh. An input that is a command is held over [jh, (j+1)h); a measured signal is read at
//! jh and taken as linear in between. Samples taken for means bias every estimate, so this step is never skipped.

use crate::error::{check_finite, check_points, Error, Result};

/// What a signal does between two samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Intersample {
    /// Zero-order hold: row j holds until row j+1. A command.
    Hold,
    /// First-order hold: linear between rows. A measured signal.
    Linear,
}

/// Means over `m` equal pulses of [0, (N−1)h] of a signal given by N samples. O(N + m).
///
/// `m` may be any number: N−1 is the record's own grid, a multiple of it refines the grid under the same
/// inter-sample behaviour, less integrates it exactly.
///
/// # Errors
/// Fewer than two samples, m = 0 or beyond memory, a sample that is not finite.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::signal::block_pulse::{pulse_means, Intersample};
/// assert_eq!(pulse_means(&[0.0, 1.0, 3.0], 2, Intersample::Linear)?, [0.5, 2.0]);
/// assert_eq!(pulse_means(&[0.0, 1.0, 3.0], 2, Intersample::Hold)?, [0.0, 1.0]);
/// # Ok(())
/// # }
/// ```
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn pulse_means(samples: &[f64], m: usize, between: Intersample) -> Result<Vec<f64>> {
    let Some(intervals) = samples.len().checked_sub(1).filter(|&n| n > 0) else {
        return Err(Error::Length { name: "samples".into(), expected: 2, found: samples.len() });
    };
    if m == 0 {
        return Err(Error::OutOfRange {
            name: "m".into(),
            value: 0.0,
            range: "[1, ∞)".into(),
            remedy: "ask for at least one pulse".into(),
        });
    }
    check_points("m", m)?;
    check_finite("samples", samples)?;
    // Integral over interval j from its start to a fraction x of it.
    let partial = |j: usize, x: f64| match between {
        Intersample::Hold => samples[j] * x,
        Intersample::Linear => x * (samples[j] + 0.5 * x * (samples[j + 1] - samples[j])),
    };
    // Edge k of the pulses stands at interval k·n/m: whole part and remainder in integers, so that edges are exact.
    let edge = |k: usize| {
        let product = k as u128 * intervals as u128;
        let whole = (product / m as u128) as usize;
        let fraction = (product % m as u128) as f64 / m as f64;
        (whole, fraction)
    };
    let per_pulse = m as f64 / intervals as f64;
    let mut means = Vec::with_capacity(m);
    let (mut j, mut x) = edge(0);
    for k in 1..=m {
        let (next_j, next_x) = edge(k);
        let mut integral = 0.0;
        if next_j == j {
            integral += slice_integral(samples, between, j, x, next_x);
        } else {
            integral += if x == 0.0 { partial(j, 1.0) } else { slice_integral(samples, between, j, x, 1.0) };
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
    Ok(means)
}

/// Integral over interval j from fraction a to b, without the cancellation of two partial integrals.
fn slice_integral(samples: &[f64], between: Intersample, j: usize, a: f64, b: f64) -> f64 {
    match between {
        Intersample::Hold => samples[j] * (b - a),
        Intersample::Linear => {
            (b - a) * (samples[j] + 0.5 * (a + b) * (samples.get(j + 1).unwrap_or(&samples[j]) - samples[j]))
        }
    }
}

/// Samples delayed by `delay` steps (whole and fractional): u_j ← (1−φ)·u_{j−d} + φ·u_{j−d−1}.
///
/// Exact means of a held command after a delay of (d+φ)h. `before` stands for the samples before the record.
///
/// # Errors
/// A delay that is negative or not finite, a sample that is not finite.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// assert_eq!(ftlm::signal::block_pulse::delayed(&[1.0, 2.0, 3.0], 1.5, 0.0)?, [0.0, 0.5, 1.5]);
/// # Ok(())
/// # }
/// ```
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
pub fn delayed(samples: &[f64], delay: f64, before: f64) -> Result<Vec<f64>> {
    if !(delay >= 0.0 && delay.is_finite()) {
        return Err(Error::OutOfRange {
            name: "delay".into(),
            value: delay,
            range: "[0, ∞) steps".into(),
            remedy: "an input acts after it is given".into(),
        });
    }
    check_finite("samples", samples)?;
    check_finite("before", &[before])?;
    let whole = delay.floor();
    let fraction = delay - whole;
    let whole = whole.min(samples.len() as f64) as usize;
    let at = |j: usize, back: usize| j.checked_sub(back).map_or(before, |i| samples[i]);
    Ok((0..samples.len())
        .map(|j| {
            let near = at(j, whole);
            if fraction == 0.0 {
                near
            } else {
                (1.0 - fraction) * near + fraction * at(j, whole + 1)
            }
        })
        .collect())
}

/// Point samples at 0, h, …, mh from m pulse means: the mean of the pulses on either side, second-order
/// extrapolation at the two ends.
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

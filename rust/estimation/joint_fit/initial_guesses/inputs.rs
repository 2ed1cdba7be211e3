//! Starts along free delays and limits.

use super::axes::between;
use crate::error::Result;
use crate::estimation::joint_fit::format::short;
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::source::Recordings;
use crate::estimation::joint_fit::structure::Input;
use crate::estimation::output_error::InputLaw;

/// Starts along the interval of a free delay: one for this phase of the frequency below which 90 % of the power lies, and
/// at most so many over all delayed inputs.
const DELAY_PHASE: f64 = 1.0;
const DELAY_STARTS: f64 = 12.0;
/// Limits are tried at so many values from this share of the largest input.
const LIMIT_STARTS: usize = 4;
const LEAST_LIMIT: f64 = 0.1;

/// Values of free delays and limits to start from, each with where they are in words.
///
/// A fit from too far away in time ends on a wrong oscillation; a limit that no sample reaches moves nothing.
pub(super) fn points(free: &Free, source: &dyn Recordings, fastest: f64) -> Result<Vec<(Vec<f64>, String)>> {
    let inputs = &free.structure.inputs;
    let axes = inputs.iter().map(|item| axis(item, inputs.len(), source, fastest)).collect::<Result<Vec<_>>>()?;
    let mut points = vec![Vec::new()];
    for axis in axes {
        let along = |point: Vec<f64>| axis.iter().map(|v| [point.as_slice(), &[*v]].concat()).collect::<Vec<_>>();
        points = points.into_iter().flat_map(along).collect();
    }
    let words = |point: &[f64]| inputs.iter().zip(point).map(|(item, v)| at(item, *v)).collect::<Vec<_>>().join(", ");
    Ok(points.into_iter().map(|point| (words(&point), point)).map(|(words, point)| (point, words)).collect())
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn axis(item: &Input, count: usize, source: &dyn Recordings, fastest: f64) -> Result<Vec<f64>> {
    let (low, high) = item.free.bounds;
    let most = (libm::pow(DELAY_STARTS, 1.0 / count as f64) as usize).max(2);
    if item.free.law == InputLaw::Delay {
        let wanted = ((high - low) * fastest / DELAY_PHASE).ceil() as usize;
        return Ok(between(low, high, wanted.saturating_add(1).max(2).min(most)));
    }
    // What was not read is not a number, and larger than nothing.
    let samples = source.samples(item.free.signal)?;
    let largest = samples.iter().flatten().fold(0.0, |largest: f64, v| largest.max(v.abs()));
    let (least, reached) = (low.max(LEAST_LIMIT * largest), high.min(largest));
    let mut values = between(least.min(reached), reached, LIMIT_STARTS.min(most) + 1);
    values.pop();
    Ok(values)
}

/// Where a start is, in words.
fn at(item: &Input, value: f64) -> String {
    match item.free.law {
        InputLaw::Delay => format!("delay {} ms", short(1e3 * value, 3)),
        InputLaw::Saturation | InputLaw::DeadZone => format!("{} {}", item.name, short(value, 3)),
    }
}

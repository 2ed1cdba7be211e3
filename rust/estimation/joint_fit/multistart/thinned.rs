//! As many samples as starts compete on.

use crate::error::Result;
use crate::estimation::joint_fit::initial_guesses::power_frequency;
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::source::{Recordings, Sampling};
use crate::signal::statistics::mean;

/// Samples of the coarse fits that compare starts, of all runs together, and of each at least; the best ones continue on all
/// samples.
const COARSE_SAMPLES: usize = 1200;
const LEAST_SAMPLES: usize = 400;
/// So many samples become one without asking what that shows; half a turn of what holds 90 % of the power is to be as many
/// at least; a part of a record stands for it if its outputs deviate by this share of the whole's.
const THINNEST: usize = 10;
const SHOWN: f64 = 1.0;
const AS_LIVELY: f64 = 0.7;

/// A sampling of as many samples as starts compete on: what one run does not tell of where they lead, another does.
///
/// Thinned until they no longer show the motion, the samples of a long record tell no start from another: then its first
/// part is taken, if that moves as the whole does.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn thinned(free: &Free, source: &dyn Recordings) -> Result<Sampling> {
    let spans = source.spans();
    let each = (COARSE_SAMPLES / spans.len().max(1)).max(LEAST_SAMPLES);
    let outputs = free.structure.equations.iter().map(|equation| source.samples(equation.output));
    let outputs = outputs.collect::<Result<Vec<_>>>()?;
    let shortest = outputs.iter().flatten().map(|samples| samples.len().saturating_sub(1)).min().unwrap_or(0);
    let decimation = ((shortest as f64 / each as f64).round_ties_even() as usize).max(1);
    let all = Sampling { decimation, ..Sampling::default() };
    if decimation <= THINNEST {
        return Ok(all);
    }
    let turns = |runs: &Vec<Vec<f64>>| {
        let pairs = runs.iter().zip(&spans);
        pairs.map(|(samples, &(step, _))| power_frequency(samples, step) * step).fold(f64::NEG_INFINITY, f64::max)
    };
    let fastest = outputs.iter().map(turns).fold(f64::NEG_INFINITY, f64::max);
    let carried = THINNEST.max((std::f64::consts::PI / (SHOWN * fastest)) as usize);
    if carried >= decimation {
        return Ok(all);
    }
    let first = each * carried;
    let as_lively =
        |samples: &Vec<f64>| deviation(&samples[..=first.min(samples.len() - 1)]) >= AS_LIVELY * deviation(samples);
    if !outputs.iter().flatten().all(as_lively) {
        return Ok(all);
    }
    Ok(Sampling { decimation: carried, first: Some(first), ..all })
}

/// Standard deviation of what was read.
fn deviation(samples: &[f64]) -> f64 {
    let known: Vec<f64> = samples.iter().copied().filter(|v| !v.is_nan()).collect();
    let middle = mean(&known);
    mean(&known.iter().map(|v| (v - middle) * (v - middle)).collect::<Vec<_>>()).sqrt()
}

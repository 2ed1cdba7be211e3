//! A grid on which starts may compete.
//!
//! As many samples as starts compete on.

use super::halving::{distinct, near, same_optimum, same_place, Laps, FIRST_LAP, GLANCE};
use crate::error::Result;
use crate::estimation::joint_fit::initial_guesses::power_frequency;
use crate::estimation::joint_fit::objective::{Grid, FINEST};
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::problem::Runner;
use crate::estimation::joint_fit::source::{Recordings, Sampling};
use crate::signal::statistics::mean;

/// Starts that tell how fine the grid must be on which all compete.
const PIONEERS: usize = 3;
/// A coarse grid tells where starts lead if a finer one moves no number of the best by more than this share.
const MOVED: f64 = 0.1;

/// A grid on which starts may compete.
pub(super) struct Chosen<'a> {
    pub grid: Grid<'a>,
    /// The same on half the step, where it was made.
    pub half: Option<Grid<'a>>,
    /// Where the others are after a glance.
    pub glanced: Vec<Runner>,
    /// Where a few are after a lap.
    pub ran: Vec<Runner>,
}

/// A grid on which starts may compete, as far as a few tell.
///
/// A stiff equation may have no stable scheme, and so no start, on a coarse grid; and a coarse grid has optima of its own:
/// all start anew on the grid on which those few no longer move.
pub(super) fn fine_enough<'a>(laps: Laps<'_>, free: &Free, coarse: Grid<'a>, starts: &[Runner]) -> Result<Chosen<'a>> {
    let glance = |grid: &Grid<'_>, starts: &[Runner]| Ok(distinct(&laps.run(free, grid, starts, GLANCE)?, same_place));
    let mut glanced: Vec<Runner> = glance(&coarse, starts)?;
    if starts.len() <= PIONEERS || coarse.sampling.every >= FINEST {
        return Ok(Chosen { grid: coarse, half: None, glanced, ran: Vec::new() });
    }
    let (first, mut coarse) = (coarse.sampling.every, coarse);
    let mut before: Vec<(Grid<'a>, Runner)> = Vec::new();
    let mut pioneers: Vec<Runner> = glanced.iter().take(PIONEERS).cloned().collect();
    let mut half = None;
    let reached = loop {
        if coarse.sampling.every >= FINEST {
            break pioneers;
        }
        let reached = laps.run(free, &coarse, &pioneers, FIRST_LAP)?;
        let finer = coarse.finer()?;
        if let Some(best) = reached.first() {
            if !coarse.noticed(&best.attempt.place, &finer)? {
                half = Some(finer);
                break reached;
            }
            before.push((coarse, best.clone()));
        }
        (coarse, pioneers) = (finer, reached);
        if pioneers.is_empty() {
            // Where none has a scheme, others may on half the step.
            pioneers = glance(&coarse, starts)?;
            pioneers.truncate(PIONEERS);
        }
    };
    if coarse.sampling.every == first {
        glanced.drain(..PIONEERS.min(glanced.len()));
        return Ok(Chosen { grid: coarse, half, glanced, ran: reached });
    }
    let told = reached.first().map(|best| best.attempt.values());
    let alike = |(_, best): &&(Grid<'a>, Runner)| {
        told.as_ref().is_some_and(|told| near(&best.attempt.values(), told, MOVED, 0.0))
    };
    let mut starts = starts.to_vec();
    if let Some((grid, _)) = before.iter().find(alike) {
        let glanced = glance(grid, &starts)?;
        if glanced.iter().map(|runner| 1 + runner.alike.len()).sum::<usize>() == starts.len() {
            // This coarser grid has the same optimum, a little moved: of those that come to one place there one goes on.
            starts = distinct(&laps.run(free, grid, &glanced, FIRST_LAP)?, same_optimum);
        }
    }
    let glanced = glance(&coarse, &starts)?;
    Ok(Chosen { grid: coarse, half, glanced, ran: Vec::new() })
}

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

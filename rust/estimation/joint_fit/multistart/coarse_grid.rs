//! Coarse grid of the multistart: subsampled records on which candidates compete.

use super::halving::{distinct, near, same_optimum, same_place, Laps, FIRST_LAP, GLANCE};
use crate::error::Result;
use crate::estimation::joint_fit::initial_guesses::power_frequency;
use crate::estimation::joint_fit::objective::{Grid, FINEST};
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::problem::Runner;
use crate::estimation::joint_fit::source::{Recordings, Sampling};
use crate::signal::statistics::mean;

/// Number of candidates that determine the step of the coarse grid.
const PIONEERS: usize = 3;
/// Largest relative change of a parameter of the best candidate on a finer grid for which the ranking is stable.
const MOVED: f64 = 0.1;

/// Coarse grid and the candidates optimized on it so far.
pub(super) struct Chosen<'a> {
    pub grid: Grid<'a>,
    /// The grid of half the step, if it was computed.
    pub half: Option<Grid<'a>>,
    /// Remaining candidates after the prescreening.
    pub glanced: Vec<Runner>,
    /// Pilot candidates after the first budget.
    pub ran: Vec<Runner>,
}

/// Choose the coarse grid by a few pilot candidates.
///
/// A stiff equation may have no stable scheme on a coarse grid, and a coarse grid has spurious optima. The step is
/// halved until the pilot candidates no longer change; then all candidates start on that grid.
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
            // If no pilot has a stable scheme, other candidates may have one on half the step.
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
            // This coarser grid has nearly the same optimum: one candidate per optimum found there continues.
            starts = distinct(&laps.run(free, grid, &glanced, FIRST_LAP)?, same_optimum);
        }
    }
    let glanced = glance(&coarse, &starts)?;
    Ok(Chosen { grid: coarse, half, glanced, ran: Vec::new() })
}

/// Samples of the coarse fits over all runs; each run has at least [`MIN_RUN_SAMPLES`].
const COARSE_SAMPLES: usize = 1200;
const LEAST_SAMPLES: usize = 400;
/// Largest decimation without a check of the bandwidth. Above it, half a period of the frequency that contains 90 % of
/// the power needs at least [`MIN_SAMPLES_PER_HALF_PERIOD`]. The first part of a record can represent it if its outputs
/// have at least [`MIN_DEVIATION_RATIO`] of the standard deviation of the whole.
const THINNEST: usize = 10;
const SHOWN: f64 = 1.0;
const AS_LIVELY: f64 = 0.7;

/// Sampling of the runs for the multistart.
///
/// Decimation must not alias the motion. If a long record needs a larger decimation, its first part is used instead,
/// provided that it varies like the whole record.
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

/// Standard deviation of the present samples.
fn deviation(samples: &[f64]) -> f64 {
    let known: Vec<f64> = samples.iter().copied().filter(|v| !v.is_nan()).collect();
    let middle = mean(&known);
    mean(&known.iter().map(|v| (v - middle) * (v - middle)).collect::<Vec<_>>()).sqrt()
}

//! Coarse grid of the multistart: subsampled records on which candidates compete.

use super::halving::{
    are_all_close, is_same_iterate, is_same_optimum, merge_duplicates, RungExecutor, FIRST_BUDGET_EVALUATIONS,
    PRESCREEN_EVALUATIONS,
};
use crate::error::Result;
use crate::estimation::joint_fit::initial_guesses::power_frequency;
use crate::estimation::joint_fit::objective::{Objective, MAX_PULSES_PER_SAMPLE};
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::problem::Candidate;
use crate::recording::{Recordings, Sampling};
use crate::signal::statistics::mean;

/// Number of candidates that determine the step of the coarse grid.
const PILOT_CANDIDATES: usize = 3;
/// Largest relative change of a parameter of the best candidate on a finer grid for which the ranking is stable.
const MAX_PARAMETER_CHANGE_RATIO: f64 = 0.1;

/// Coarse grid and the candidates optimized on it so far.
pub(super) struct CoarseGrid<'a> {
    pub grid: Objective<'a>,
    /// The grid of half the step, if it was computed.
    pub half: Option<Objective<'a>>,
    /// Remaining candidates after the prescreening.
    pub prescreened_candidates: Vec<Candidate>,
    /// Pilot candidates after the first budget.
    pub pilots: Vec<Candidate>,
}

/// Choose the coarse grid by a few pilot candidates.
///
/// A stiff equation may have no stable scheme on a coarse grid, and a coarse grid has spurious optima. The step is
/// halved until the pilot candidates no longer change; then all candidates start on that grid.
pub(super) fn choose_coarse_grid<'a>(
    laps: RungExecutor<'_>,
    free: &ParameterSet,
    coarse: Objective<'a>,
    starts: &[Candidate],
) -> Result<CoarseGrid<'a>> {
    let glance = |grid: &Objective<'_>, starts: &[Candidate]| {
        Ok(merge_duplicates(&laps.run(free, grid, starts, PRESCREEN_EVALUATIONS)?, is_same_iterate))
    };
    let mut glanced: Vec<Candidate> = glance(&coarse, starts)?;
    if starts.len() <= PILOT_CANDIDATES || coarse.sampling.pulses_per_sample >= MAX_PULSES_PER_SAMPLE {
        return Ok(CoarseGrid { grid: coarse, half: None, prescreened_candidates: glanced, pilots: Vec::new() });
    }
    let (first, mut coarse) = (coarse.sampling.pulses_per_sample, coarse);
    let mut before: Vec<(Objective<'a>, Candidate)> = Vec::new();
    let mut pioneers: Vec<Candidate> = glanced.iter().take(PILOT_CANDIDATES).cloned().collect();
    let mut half = None;
    let reached = loop {
        if coarse.sampling.pulses_per_sample >= MAX_PULSES_PER_SAMPLE {
            break pioneers;
        }
        let reached = laps.run(free, &coarse, &pioneers, FIRST_BUDGET_EVALUATIONS)?;
        let finer = coarse.finer()?;
        if let Some(best) = reached.first() {
            if !coarse.is_refinement_significant(&best.result.iterate, &finer)? {
                half = Some(finer);
                break reached;
            }
            before.push((coarse, best.clone()));
        }
        (coarse, pioneers) = (finer, reached);
        if pioneers.is_empty() {
            // If no pilot has a stable scheme, other candidates may have one on half the step.
            pioneers = glance(&coarse, starts)?;
            pioneers.truncate(PILOT_CANDIDATES);
        }
    };
    if coarse.sampling.pulses_per_sample == first {
        glanced.drain(..PILOT_CANDIDATES.min(glanced.len()));
        return Ok(CoarseGrid { grid: coarse, half, prescreened_candidates: glanced, pilots: reached });
    }
    let told = reached.first().map(|best| best.result.values());
    let alike = |(_, best): &&(Objective<'a>, Candidate)| {
        told.as_ref().is_some_and(|told| are_all_close(&best.result.values(), told, MAX_PARAMETER_CHANGE_RATIO, 0.0))
    };
    let mut starts = starts.to_vec();
    if let Some((grid, _)) = before.iter().find(alike) {
        let glanced = glance(grid, &starts)?;
        if glanced.iter().map(|runner| 1 + runner.duplicates.len()).sum::<usize>() == starts.len() {
            // This coarser grid has nearly the same optimum: one candidate per optimum found there continues.
            starts = merge_duplicates(&laps.run(free, grid, &glanced, FIRST_BUDGET_EVALUATIONS)?, is_same_optimum);
        }
    }
    let glanced = glance(&coarse, &starts)?;
    Ok(CoarseGrid { grid: coarse, half, prescreened_candidates: glanced, pilots: Vec::new() })
}

/// Samples of the coarse fits over all runs; each run has at least [`MIN_RUN_SAMPLES`].
const MAX_COARSE_SAMPLES: usize = 1200;
const MIN_RUN_SAMPLES: usize = 400;
/// Largest decimation without a check of the bandwidth. Above it, half a period of the frequency that contains 90 % of
/// the power needs at least [`MIN_SAMPLES_PER_HALF_PERIOD`]: with fewer, the grid is refined to the samples again. The
/// first part of a record can represent it if its outputs have at least [`MIN_DEVIATION_RATIO`] of the standard
/// deviation of the whole.
const MAX_UNCHECKED_DECIMATION: usize = 10;
const MIN_SAMPLES_PER_HALF_PERIOD: f64 = 6.0;
const MIN_DEVIATION_RATIO: f64 = 0.7;

/// Sampling of the runs for the multistart.
///
/// Decimation must not alias the motion. If a long record needs a larger decimation, its first part is used instead,
/// provided that it varies like the whole record.
///
/// # Errors
/// If an output of the structure is no signal of the runs.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn coarse_sampling(free: &ParameterSet, source: &Recordings) -> Result<Sampling> {
    let spans = source.spans();
    let each = (MAX_COARSE_SAMPLES / spans.len().max(1)).max(MIN_RUN_SAMPLES);
    let outputs = output_samples(free, source)?;
    let shortest = outputs.iter().flatten().map(|samples| samples.len().saturating_sub(1)).min().unwrap_or(0);
    let decimation = ((shortest as f64 / each as f64).round_ties_even() as usize).max(1);
    let all = Sampling { decimation, ..Sampling::default() };
    if decimation <= MAX_UNCHECKED_DECIMATION {
        return Ok(all);
    }
    let turns = |runs: &Vec<&[f64]>| {
        let pairs = runs.iter().zip(&spans);
        pairs.map(|(samples, &(step, _))| power_frequency(samples, step) * step).fold(f64::NEG_INFINITY, f64::max)
    };
    let fastest = outputs.iter().map(turns).fold(f64::NEG_INFINITY, f64::max);
    let carried = ((std::f64::consts::PI / (MIN_SAMPLES_PER_HALF_PERIOD * fastest)) as usize).max(1);
    let first = each * carried;
    if carried >= decimation || !varies_like_whole(&outputs, first) {
        return Ok(all);
    }
    Ok(Sampling { decimation: carried, leading_intervals: Some(first), ..all })
}

/// Leading intervals of each run that represent long records at `count` intervals in all; None for short records.
///
/// # Errors
/// If an output of the structure is no signal of the runs.
pub fn leading_part(free: &ParameterSet, source: &Recordings, count: usize) -> Result<Option<usize>> {
    let (outputs, each) = (output_samples(free, source)?, (count / source.spans().len().max(1)).max(MIN_RUN_SAMPLES));
    let is_long = outputs.iter().flatten().all(|samples| samples.len() > 2 * each);
    Ok((is_long && varies_like_whole(&outputs, each)).then_some(each))
}

/// Samples of the outputs of all equations, by run.
fn output_samples<'a>(free: &ParameterSet, source: &'a Recordings) -> Result<Vec<Vec<&'a [f64]>>> {
    free.structure.equations.iter().map(|equation| source.samples(equation.output)).collect()
}

/// True if the outputs vary in the first intervals like in the whole record.
fn varies_like_whole(outputs: &[Vec<&[f64]>], first: usize) -> bool {
    outputs.iter().flatten().all(|samples| {
        standard_deviation(&samples[..=first.min(samples.len() - 1)])
            >= MIN_DEVIATION_RATIO * standard_deviation(samples)
    })
}

/// Standard deviation of the present samples.
fn standard_deviation(samples: &[f64]) -> f64 {
    let known: Vec<f64> = samples.iter().copied().filter(|v| !v.is_nan()).collect();
    let middle = mean(&known);
    mean(&known.iter().map(|v| (v - middle) * (v - middle)).collect::<Vec<_>>()).sqrt()
}

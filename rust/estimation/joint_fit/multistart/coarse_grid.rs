//! Coarse grid of the multistart: subsampled records on which candidates are compared.

use crate::error::Result;
use crate::estimation::joint_fit::initial_guesses::power_frequency;
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::recording::{Recordings, Sampling};
use crate::signal::statistics::mean;

/// Approximate number of samples of a coarse fit over all runs.
pub const MAX_COARSE_SAMPLES: usize = 1200;
/// Minimum number of samples of each run in a coarse fit.
const MIN_RUN_SAMPLES: usize = 400;
/// Maximum decimation factor that is used without a check of the bandwidth.
const MAX_UNCHECKED_DECIMATION: usize = 10;
/// Minimum number of samples per half period, at the bandwidth of the outputs, if the decimation factor exceeds the
/// unchecked maximum.
const MIN_SAMPLES_PER_HALF_PERIOD: f64 = 6.0;
/// Minimum ratio of the standard deviation of an output in the first part of a record to that in the whole record.
const MIN_DEVIATION_RATIO: f64 = 0.7;

/// Return the sampling of the runs for the multistart.
///
/// Decimation must not alias the signals. If a long record would need too large a decimation, its first part is used
/// instead. The outputs must vary there as much as in the whole record.
///
/// # Errors
/// [`Error::Structure`](crate::error::Error::Structure) if an output of the structure is not a signal of the runs.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn coarse_sampling(parameter_set: &ParameterSet, source: &Recordings) -> Result<Sampling> {
    let intervals_and_durations = source.intervals_and_durations();
    let samples_per_run = (MAX_COARSE_SAMPLES / intervals_and_durations.len().max(1)).max(MIN_RUN_SAMPLES);
    let outputs = output_samples(parameter_set, source)?;
    let min_intervals = outputs.iter().flatten().map(|samples| samples.len().saturating_sub(1)).min().unwrap_or(0);
    let decimation = ((min_intervals as f64 / samples_per_run as f64).round_ties_even() as usize).max(1);
    let full_sampling = Sampling { decimation, ..Sampling::default() };
    if decimation <= MAX_UNCHECKED_DECIMATION {
        return Ok(full_sampling);
    }
    let fastest_phase_step = |runs: &Vec<&[f64]>| {
        let pairs = runs.iter().zip(&intervals_and_durations);
        pairs.map(|(samples, &(step, _))| power_frequency(samples, step) * step).fold(f64::NEG_INFINITY, f64::max)
    };
    let max_phase_step = outputs.iter().map(fastest_phase_step).fold(f64::NEG_INFINITY, f64::max);
    let max_decimation = ((std::f64::consts::PI / (MIN_SAMPLES_PER_HALF_PERIOD * max_phase_step)) as usize).max(1);
    let leading_intervals = samples_per_run * max_decimation;
    if max_decimation >= decimation || !varies_like_whole(&outputs, leading_intervals) {
        return Ok(full_sampling);
    }
    Ok(Sampling { decimation: max_decimation, leading_intervals: Some(leading_intervals), ..full_sampling })
}

/// Return the number of leading sampling intervals of each run that represent a long record.
///
/// Over all runs, this is about `count` intervals. Return None if a record is short, or if its outputs vary less in
/// these intervals than in the whole record.
///
/// # Errors
/// [`Error::Structure`](crate::error::Error::Structure) if an output of the structure is not a signal of the runs.
pub fn leading_part(parameter_set: &ParameterSet, source: &Recordings, count: usize) -> Result<Option<usize>> {
    let (outputs, intervals_per_run) = (
        output_samples(parameter_set, source)?,
        (count / source.intervals_and_durations().len().max(1)).max(MIN_RUN_SAMPLES),
    );
    let is_long = outputs.iter().flatten().all(|samples| samples.len() > 2 * intervals_per_run);
    Ok((is_long && varies_like_whole(&outputs, intervals_per_run)).then_some(intervals_per_run))
}

/// Samples of the output of each equation, by run.
fn output_samples<'a>(parameter_set: &ParameterSet, source: &'a Recordings) -> Result<Vec<Vec<&'a [f64]>>> {
    parameter_set.structure.equations.iter().map(|equation| source.samples(equation.output)).collect()
}

/// Return true if every output has a similar standard deviation in the first `leading_intervals` intervals as in the
/// whole record.
fn varies_like_whole(outputs: &[Vec<&[f64]>], leading_intervals: usize) -> bool {
    outputs.iter().flatten().all(|samples| {
        standard_deviation(&samples[..=leading_intervals.min(samples.len() - 1)])
            >= MIN_DEVIATION_RATIO * standard_deviation(samples)
    })
}

/// Standard deviation of the samples that are not missing (NaN).
fn standard_deviation(samples: &[f64]) -> f64 {
    let finite: Vec<f64> = samples.iter().copied().filter(|v| !v.is_nan()).collect();
    let center = mean(&finite);
    mean(&finite.iter().map(|v| (v - center) * (v - center)).collect::<Vec<_>>()).sqrt()
}

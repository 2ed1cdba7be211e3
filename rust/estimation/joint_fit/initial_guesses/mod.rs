//! Initial guesses of joint fits: order grids on prefiltered records, delays, saturation limits, resonances.

mod integer_orders;
mod order_grid;
mod prefilter;
mod resonances;

use std::f64::consts::PI;

pub use prefilter::power_frequency;

use self::order_grid::{grid_candidates, law_candidates, linspace, natural_axes, start_axes, GridSearch};
use self::prefilter::LowPassCache;
use self::resonances::scan_candidates;
use super::format::format_general;
use super::multistart::InitialGuessSource;
use super::objective::Objective;
use super::parameter_set::ParameterSet;
use super::problem::Candidate;
use crate::error::{check_length, Error, Result};
use crate::estimation::joint_fit::structure::Input;
use crate::estimation::output_error::InputLaw;
use crate::parallel::Stop;
use crate::recording::Recordings;
use crate::regressors::Record;
use crate::signal::block_pulse::Intersample;
use crate::signal::statistics::median;

/// Maximum number of block pulses of each record from which initial guesses are computed.
const MAX_START_PULSES: usize = 1024;
/// Cutoff frequencies of the prefilters, relative to the bandwidth of the outputs; None for no prefilter.
const PREFILTER_CUTOFF_RATIOS: [Option<f64>; 2] = [Some(2.0), None];
/// Cutoff frequencies for structures with an order law, relative to the bandwidth of the outputs.
///
/// The equation error of such a structure has several minima, which depend on the cutoff.
const PREFILTER_CUTOFF_RATIOS_BY_LAW: [Option<f64>; 5] = [Some(1.0), Some(2.0), Some(4.0), Some(8.0), None];
/// Difference below which two orders count as equal.
const ORDER_TOLERANCE: f64 = 1e-9;

/// Source of initial guesses from coarse order grids, by least squares on block-pulse records of the runs.
pub struct OrderGrids<'a> {
    source: &'a Recordings,
    threads: usize,
    memory: u64,
    stop: &'a Stop,
    low_passes: LowPassCache,
}

impl<'a> OrderGrids<'a> {
    /// Return a source of initial guesses for the given runs. Each grid search uses at most `threads` threads and
    /// `memory` bytes.
    #[must_use]
    pub fn new(source: &'a Recordings, threads: usize, memory: u64, stop: &'a Stop) -> Self {
        Self { source, threads, memory, stop, low_passes: LowPassCache::default() }
    }

    /// Return initial guesses of a parameter set. If delays, saturations or dead zones are free, several values of each
    /// are tried.
    ///
    /// # Errors
    /// [`Error::Structure`] for a zero-order-hold input with an order above that of its equation, for friction, and for
    /// duplicate terms. [`Error::EmptyOrderGrid`] if no grid point satisfies the constraints. [`Error::Interrupted`]
    /// after a stop request. Also an error if the runs have no block-pulse records or if a grid search fails.
    pub fn candidates(&self, free: &ParameterSet) -> Result<Vec<Candidate>> {
        let frequencies = self.frequencies(free)?;
        if free.structure.inputs.is_empty() {
            return self.candidates_at_inputs(free, &frequencies, &[]);
        }
        let fastest = frequencies.iter().flatten().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut attempts = Vec::new();
        for (point, words) in input_points(free, self.source, fastest)? {
            for mut attempt in self.candidates_at_inputs(free, &frequencies, &point)? {
                attempt.origin = format!("{}, {words}", attempt.origin);
                attempt.result.iterate.point.inputs.clone_from(&point);
                attempts.push(attempt);
            }
        }
        Ok(attempts)
    }

    /// Bandwidth \[rad/s\] of the output of each equation, indexed by equation and run.
    fn frequencies(&self, free: &ParameterSet) -> Result<Vec<Vec<f64>>> {
        let intervals_and_durations = self.source.intervals_and_durations();
        let of = |output: usize| {
            let samples = self.source.samples(output)?;
            check_length("runs", intervals_and_durations.len(), samples.len())?;
            Ok(samples
                .iter()
                .zip(&intervals_and_durations)
                .map(|(run, (step, _))| power_frequency(run, *step))
                .collect())
        };
        free.structure.equations.iter().map(|e| of(e.output)).collect()
    }

    /// Number of block pulses per record, limited by the samples of the shortest run.
    fn pulse_count(&self, free: &ParameterSet) -> Result<usize> {
        let output = free.structure.equations.first().map_or(0, |e| e.output);
        let shortest = self.source.samples(output)?.iter().map(|run| run.len()).min().unwrap_or(0);
        Ok(MAX_START_PULSES.min(shortest.saturating_sub(1)))
    }

    /// Return candidates from order grids on prefiltered records, at given values of the free input parameters.
    ///
    /// All signals pass the prefilter, which commutes with the equation. The true coefficients are therefore unchanged,
    /// while noise above the bandwidth is removed.
    fn candidates_at_inputs(
        &self,
        free: &ParameterSet,
        frequencies: &[Vec<f64>],
        input_values: &[f64],
    ) -> Result<Vec<Candidate>> {
        self.check_hold_orders(free)?;
        let frequency = median(frequencies.concat());
        let natural = natural_axes(free);
        let grids: Vec<_> = std::iter::once(start_axes(free)).chain(natural.clone()).collect();
        let unfiltered = self.source.records(self.pulse_count(free)?, input_values)?;
        let unfiltered = self.prefilter(&unfiltered, None)?;
        let fastest = PI / unfiltered.iter().map(Record::step).fold(f64::NEG_INFINITY, f64::max);
        let inputs: Vec<bool> = self.source.inputs().iter().map(Option::is_some).collect();
        let coarse = GridSearch {
            records: &unfiltered,
            inputs: &inputs,
            initial: &free.structure.initial,
            threads: self.threads,
            memory: self.memory,
            stop: self.stop,
        };
        let mut attempts = Vec::new();
        let by_law = free.structure.has_order_law();
        let ratios = if by_law { &PREFILTER_CUTOFF_RATIOS_BY_LAW[..] } else { &PREFILTER_CUTOFF_RATIOS[..] };
        for multiple in ratios {
            self.stop.check()?;
            let corner = multiple.map(|multiple| multiple * frequency);
            if corner.is_some_and(|corner| corner >= fastest) {
                // The cutoff is above the Nyquist frequency of the pulses.
                continue;
            }
            let records = self.prefilter(&unfiltered, corner)?;
            let coarse = coarse.with_records(&records);
            let words = |corner| format!("prefilter {} rad/s", format_general(corner, 3));
            let origin = corner.map_or_else(|| "no prefilter".into(), words);
            let mut candidates_of_inputs: Vec<Candidate> = Vec::new();
            for axes in &grids {
                let more = grid_candidates(free, &coarse, axes, &origin, &candidates_of_inputs)?;
                candidates_of_inputs.extend(more);
            }
            if let Some(axes) = &natural {
                candidates_of_inputs.extend(law_candidates(free, &coarse, axes, &origin)?);
            }
            attempts.extend(candidates_of_inputs);
        }
        let scanned = scan_candidates(free, &coarse, frequencies, &attempts)?;
        attempts.extend(scanned);
        Ok(attempts)
    }

    fn prefilter(&self, records: &[Record], corner: Option<f64>) -> Result<Vec<Record>> {
        records.iter().map(|record| self.low_passes.filter_record(record, corner)).collect()
    }

    /// Return [`Error::Structure`] if the order of a zero-order-hold input exceeds that of its equation.
    ///
    /// The jumps of such an input have no derivative.
    fn check_hold_orders(&self, free: &ParameterSet) -> Result<()> {
        let (inputs, signals) = (self.source.inputs(), &free.structure.signals);
        for item in free.structure.equations.iter().filter(|e| !e.order.is_free()) {
            let alpha = item.order.constant;
            let is_held_input = |signal: usize| inputs.get(signal).copied().flatten() == Some(Intersample::Hold);
            let above = item.terms.iter().filter(|t| !t.order.is_free() && t.order.constant > alpha + ORDER_TOLERANCE);
            if let Some(term) = above.into_iter().find(|t| is_held_input(t.signal)) {
                let (order, signal) = (format_general(term.order.constant, 6), &signals[term.signal]);
                let (alpha, output) = (format_general(alpha, 6), &signals[item.output]);
                let what = format!(
                    "order {order} of {signal} is above alpha = {alpha} of {output}, and the runs have a zero-order \
                     hold for {signal}, whose jumps have no derivative"
                );
                let remedy = "reduce the order, or set intersample='foh' if the input is linear between samples".into();
                return Err(Error::Structure { what, remedy });
            }
        }
        Ok(())
    }
}

impl InitialGuessSource for OrderGrids<'_> {
    fn initial_guesses(&self, free: &ParameterSet) -> Result<Vec<Candidate>> {
        self.candidates(free)
    }

    fn for_recordings<'b>(&'b self, source: &'b Recordings) -> Box<dyn InitialGuessSource + 'b> {
        Box::new(OrderGrids::new(source, self.threads, self.memory, self.stop))
    }

    fn integer_order_optima(&self, free: &ParameterSet, grid: &Objective<'_>) -> Result<Option<Vec<Candidate>>> {
        let fastest = self.frequencies(free)?.iter().flatten().copied().fold(f64::NEG_INFINITY, f64::max);
        let delays = input_points(free, self.source, fastest)?.into_iter().map(|(point, _)| point).collect::<Vec<_>>();
        integer_orders::integer_order_optima(free, grid, &delays)
    }
}

/// Maximum phase difference \[rad\] between adjacent initial guesses of a delay, at the bandwidth of the outputs.
const MAX_DELAY_PHASE_RAD: f64 = 1.0;
/// Maximum number of combinations of initial guesses over all inputs with free parameters.
const MAX_DELAY_STARTS: f64 = 12.0;
/// Maximum number of initial guesses of a saturation or dead zone.
const MAX_LIMIT_STARTS: usize = 4;
/// Least initial guess of a saturation or dead zone, relative to the largest input magnitude.
const MIN_LIMIT_RATIO: f64 = 0.1;

/// Return initial guesses of the free delays and limits (saturations and dead zones), each with a description.
///
/// `fastest` is the highest bandwidth \[rad/s\] of an output. From a poor guess of the delay, a fit converges to a
/// local optimum that is shifted by one period of an oscillation. Initial guesses of a limit are below the largest
/// input magnitude, because a limit above all samples has no effect.
pub(super) fn input_points(free: &ParameterSet, source: &Recordings, fastest: f64) -> Result<Vec<(Vec<f64>, String)>> {
    let inputs = &free.structure.inputs;
    let axes = inputs.iter().map(|item| input_axis(item, inputs.len(), source, fastest)).collect::<Result<Vec<_>>>()?;
    let mut points = vec![Vec::new()];
    for axis in axes {
        let along = |point: Vec<f64>| axis.iter().map(|v| [point.as_slice(), &[*v]].concat()).collect::<Vec<_>>();
        points = points.into_iter().flat_map(along).collect();
    }
    let words = |point: &[f64]| {
        inputs.iter().zip(point).map(|(item, v)| describe_input(item, *v)).collect::<Vec<_>>().join(", ")
    };
    Ok(points.into_iter().map(|point| (words(&point), point)).map(|(words, point)| (point, words)).collect())
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn input_axis(item: &Input, count: usize, source: &Recordings, fastest: f64) -> Result<Vec<f64>> {
    let (low, high) = item.free.bounds;
    let most = (libm::pow(MAX_DELAY_STARTS, 1.0 / count as f64) as usize).max(2);
    if item.free.law == InputLaw::Delay {
        let axis_count = ((high - low) * fastest / MAX_DELAY_PHASE_RAD).ceil() as usize;
        return Ok(linspace(low, high, axis_count.saturating_add(1).max(2).min(most)));
    }
    // `max` ignores NaN, so missing samples are skipped.
    let samples = source.samples(item.free.signal)?;
    let largest = samples.into_iter().flatten().fold(0.0, |largest: f64, v| largest.max(v.abs()));
    let (least, reached) = (low.max(MIN_LIMIT_RATIO * largest), high.min(largest));
    let mut values = linspace(least.min(reached), reached, MAX_LIMIT_STARTS.min(most) + 1);
    values.pop();
    Ok(values)
}

/// Describe the initial guess of a delay, saturation or dead zone as text.
fn describe_input(item: &Input, value: f64) -> String {
    match item.free.law {
        InputLaw::Delay => format!("delay {} ms", format_general(1e3 * value, 3)),
        InputLaw::Saturation | InputLaw::DeadZone => format!("{} {}", item.name, format_general(value, 3)),
    }
}

//! Initial guesses of joint fits: order grids on prefiltered records, delays, saturation limits, resonances.

mod integer_orders;
mod order_grid;
mod prefilter;
mod resonances;

use std::f64::consts::PI;

pub use prefilter::power_frequency;

use self::order_grid::{grid_candidates, law_candidates, linspace, start_axes, typical_order_axes, GridSearch};
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
    pub fn candidates(&self, parameter_set: &ParameterSet) -> Result<Vec<Candidate>> {
        let frequencies = self.frequencies(parameter_set)?;
        if parameter_set.structure.inputs.is_empty() {
            return self.candidates_at_inputs(parameter_set, &frequencies, &[]);
        }
        let max_frequency = frequencies.iter().flatten().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut candidates = Vec::new();
        for (point, description) in input_points(parameter_set, self.source, max_frequency)? {
            for mut candidate in self.candidates_at_inputs(parameter_set, &frequencies, &point)? {
                candidate.origin = format!("{}, {description}", candidate.origin);
                candidate.result.iterate.point.inputs.clone_from(&point);
                candidates.push(candidate);
            }
        }
        Ok(candidates)
    }

    /// Bandwidth \[rad/s\] of the output of each equation, indexed by equation and run.
    fn frequencies(&self, parameter_set: &ParameterSet) -> Result<Vec<Vec<f64>>> {
        let intervals_and_durations = self.source.intervals_and_durations();
        let output_frequencies = |output: usize| {
            let samples = self.source.samples(output)?;
            check_length("runs", intervals_and_durations.len(), samples.len())?;
            Ok(samples
                .iter()
                .zip(&intervals_and_durations)
                .map(|(run, (step, _))| power_frequency(run, *step))
                .collect())
        };
        parameter_set.structure.equations.iter().map(|e| output_frequencies(e.output)).collect()
    }

    /// Number of block pulses per record, limited by the samples of the shortest run.
    fn pulse_count(&self, parameter_set: &ParameterSet) -> Result<usize> {
        let output = parameter_set.structure.equations.first().map_or(0, |e| e.output);
        let min_samples = self.source.samples(output)?.iter().map(|run| run.len()).min().unwrap_or(0);
        Ok(MAX_START_PULSES.min(min_samples.saturating_sub(1)))
    }

    /// Return candidates from order grids on prefiltered records, at given values of the free input parameters.
    ///
    /// All signals pass the prefilter, which commutes with the equation. The true coefficients are therefore unchanged,
    /// while noise above the bandwidth is removed.
    fn candidates_at_inputs(
        &self,
        parameter_set: &ParameterSet,
        frequencies: &[Vec<f64>],
        input_values: &[f64],
    ) -> Result<Vec<Candidate>> {
        self.check_hold_orders(parameter_set)?;
        let frequency = median(frequencies.concat());
        let typical_axes = typical_order_axes(parameter_set);
        let grids: Vec<_> = std::iter::once(start_axes(parameter_set)).chain(typical_axes.clone()).collect();
        let unfiltered = self.source.records(self.pulse_count(parameter_set)?, input_values)?;
        let unfiltered = self.prefilter(&unfiltered, None)?;
        let max_frequency = PI / unfiltered.iter().map(Record::step).fold(f64::NEG_INFINITY, f64::max);
        let inputs: Vec<bool> = self.source.inputs().iter().map(Option::is_some).collect();
        let unfiltered_search = GridSearch {
            records: &unfiltered,
            inputs: &inputs,
            initial: &parameter_set.structure.initial,
            threads: self.threads,
            memory: self.memory,
            stop: self.stop,
        };
        let mut candidates = Vec::new();
        let has_order_law = parameter_set.structure.has_order_law();
        let ratios = if has_order_law { &PREFILTER_CUTOFF_RATIOS_BY_LAW[..] } else { &PREFILTER_CUTOFF_RATIOS[..] };
        for ratio in ratios {
            self.stop.check()?;
            let cutoff = ratio.map(|ratio| ratio * frequency);
            if cutoff.is_some_and(|cutoff| cutoff >= max_frequency) {
                // The cutoff is above the Nyquist frequency of the pulses.
                continue;
            }
            let records = self.prefilter(&unfiltered, cutoff)?;
            let search = unfiltered_search.with_records(&records);
            let description = |cutoff| format!("prefilter {} rad/s", format_general(cutoff, 3));
            let origin = cutoff.map_or_else(|| "no prefilter".into(), description);
            let mut candidates_of_inputs: Vec<Candidate> = Vec::new();
            for axes in &grids {
                let grid_guesses = grid_candidates(parameter_set, &search, axes, &origin, &candidates_of_inputs)?;
                candidates_of_inputs.extend(grid_guesses);
            }
            if let Some(axes) = &typical_axes {
                candidates_of_inputs.extend(law_candidates(parameter_set, &search, axes, &origin)?);
            }
            candidates.extend(candidates_of_inputs);
        }
        let scan_guesses = scan_candidates(parameter_set, &unfiltered_search, frequencies, &candidates)?;
        candidates.extend(scan_guesses);
        Ok(candidates)
    }

    fn prefilter(&self, records: &[Record], cutoff: Option<f64>) -> Result<Vec<Record>> {
        records.iter().map(|record| self.low_passes.filter_record(record, cutoff)).collect()
    }

    /// Return [`Error::Structure`] if the order of a zero-order-hold input exceeds that of its equation.
    ///
    /// The jumps of such an input have no derivative.
    fn check_hold_orders(&self, parameter_set: &ParameterSet) -> Result<()> {
        let (inputs, signals) = (self.source.inputs(), &parameter_set.structure.signals);
        for equation in parameter_set.structure.equations.iter().filter(|e| !e.order.is_free()) {
            let alpha = equation.order.constant;
            let is_zero_order_hold = |signal: usize| inputs.get(signal).copied().flatten() == Some(Intersample::Hold);
            let excessive_terms =
                equation.terms.iter().filter(|t| !t.order.is_free() && t.order.constant > alpha + ORDER_TOLERANCE);
            if let Some(term) = excessive_terms.into_iter().find(|t| is_zero_order_hold(t.signal)) {
                let (order, signal) = (format_general(term.order.constant, 6), &signals[term.signal]);
                let (alpha, output) = (format_general(alpha, 6), &signals[equation.output]);
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
    fn initial_guesses(&self, parameter_set: &ParameterSet) -> Result<Vec<Candidate>> {
        self.candidates(parameter_set)
    }

    fn for_recordings<'b>(&'b self, source: &'b Recordings) -> Box<dyn InitialGuessSource + 'b> {
        Box::new(OrderGrids::new(source, self.threads, self.memory, self.stop))
    }

    fn integer_order_optima(
        &self,
        parameter_set: &ParameterSet,
        objective: &Objective<'_>,
    ) -> Result<Option<Vec<Candidate>>> {
        let max_frequency =
            self.frequencies(parameter_set)?.iter().flatten().copied().fold(f64::NEG_INFINITY, f64::max);
        let delays = input_points(parameter_set, self.source, max_frequency)?
            .into_iter()
            .map(|(point, _)| point)
            .collect::<Vec<_>>();
        integer_orders::integer_order_optima(parameter_set, objective, &delays)
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
/// `max_frequency` is the highest bandwidth \[rad/s\] of an output. From a poor guess of the delay, a fit converges to
/// a local optimum that is shifted by one period of an oscillation. Initial guesses of a limit are below the largest
/// input magnitude, because a limit above all samples has no effect.
pub(super) fn input_points(
    parameter_set: &ParameterSet,
    source: &Recordings,
    max_frequency: f64,
) -> Result<Vec<(Vec<f64>, String)>> {
    let inputs = &parameter_set.structure.inputs;
    let axes = inputs
        .iter()
        .map(|input| input_axis(input, inputs.len(), source, max_frequency))
        .collect::<Result<Vec<_>>>()?;
    let mut points = vec![Vec::new()];
    for axis in axes {
        let extend_point =
            |point: Vec<f64>| axis.iter().map(|v| [point.as_slice(), &[*v]].concat()).collect::<Vec<_>>();
        points = points.into_iter().flat_map(extend_point).collect();
    }
    let description = |point: &[f64]| {
        inputs.iter().zip(point).map(|(input, v)| describe_input(input, *v)).collect::<Vec<_>>().join(", ")
    };
    Ok(points
        .into_iter()
        .map(|point| (description(&point), point))
        .map(|(description, point)| (point, description))
        .collect())
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn input_axis(input: &Input, count: usize, source: &Recordings, max_frequency: f64) -> Result<Vec<f64>> {
    let (low, high) = input.parameter.bounds;
    let max_values = (libm::pow(MAX_DELAY_STARTS, 1.0 / count as f64) as usize).max(2);
    if input.parameter.law == InputLaw::Delay {
        let axis_count = ((high - low) * max_frequency / MAX_DELAY_PHASE_RAD).ceil() as usize;
        return Ok(linspace(low, high, axis_count.saturating_add(1).max(2).min(max_values)));
    }
    // `max` ignores NaN, so missing samples are skipped.
    let samples = source.samples(input.parameter.signal)?;
    let largest = samples.into_iter().flatten().fold(0.0, |largest: f64, v| largest.max(v.abs()));
    let (min_limit, max_limit) = (low.max(MIN_LIMIT_RATIO * largest), high.min(largest));
    let mut values = linspace(min_limit.min(max_limit), max_limit, MAX_LIMIT_STARTS.min(max_values) + 1);
    values.pop();
    Ok(values)
}

/// Describe the initial guess of a delay, saturation or dead zone as text.
fn describe_input(input: &Input, value: f64) -> String {
    match input.parameter.law {
        InputLaw::Delay => format!("delay {} ms", format_general(1e3 * value, 3)),
        InputLaw::Saturation | InputLaw::DeadZone => format!("{} {}", input.name, format_general(value, 3)),
    }
}

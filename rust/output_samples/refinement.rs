//! Refinement of the step until samples have converged. Each step defines a grid of block pulses. Long records are
//! simulated by superposition of responses to single samples. These responses are computed by transforms, or refined
//! only where they change.

use std::sync::Arc;

use super::initial_terms::{fit_initial_terms, OutputSamples};
use super::richardson::{add_multiple, combine, peak, relative_change, RichardsonTable, Rows};
use super::simulation::{Grid, InitialTerms, OutputSimulation, ORDER_TOLERANCE};
use crate::equation::Equation;
use crate::error::{check_memory, Error, Kind, Result};
use crate::estimation::output_error::stability::is_unstable;
use crate::fft::Bin;
use crate::fractional::starred_transform::{LaplacePoint, StarredTransform};
use crate::parallel::Stop;
use crate::recording::Role;
use crate::series;
use crate::signal::nonuniform::interpolate_gaps;

/// Number of pulses per sampling interval of the coarsest grid. With two or more pulses, a sample does not depend on a
/// jump of a zero-order-hold input at the sample time.
pub(super) const FIRST_REFINEMENT: usize = 2;
/// Ratio of the end times of successive time ranges into which responses are divided. The shortest range has at least
/// [`MIN_RANGE_INTERVALS`] sampling intervals. With this ratio, halving the step on a range costs as much as the whole
/// response on the coarser grid.
const RANGE_END_RATIO: usize = 8;
const MIN_RANGE_INTERVALS: usize = 128;
/// Pulses per sampling interval of the grids that cover whole responses. The coarsest of these grids is not used for
/// the first time range, in which responses have jumps.
const FULL_GRID_REFINEMENTS: [usize; 3] = [1, 2, 4];
const FINEST_FULL_GRID: usize = 4;
/// Maximum ratio of the peak in the second half of a response to the peak in the first half. Above it the model counts
/// as unstable, because the sum of responses would lose digits.
const MAX_GROWTH_RATIO: f64 = 1e3;

/// Bound of the error of responses that are computed by transforms, relative to the largest magnitude of the output.
const TRANSFORM_ERROR: f64 = 1e-7;
/// Frequency above which no pole may lie if responses are computed by transforms, relative to the Nyquist frequency.
const MAX_POLE_FREQUENCY_RATIO: f64 = 0.5;

/// Samples of a simulation, extrapolated to zero step.
#[derive(Debug, Clone, PartialEq)]
pub struct RefinedSamples {
    /// Samples and initial terms in the limit of zero step.
    pub samples: OutputSamples,
    /// Number of pulses per sampling interval of the finest grid of block pulses; 1 if the samples are computed by
    /// transforms, without a grid.
    pub refinement: usize,
    /// Error estimate of each output relative to its largest magnitude: the change that is expected if the step is
    /// halved again, or a bound of the error of transforms. It is infinite if fewer than three steps were simulated.
    pub change: Vec<f64>,
}

/// Options of the step refinement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refinement {
    /// Tolerance for the change of each output that is expected if the step is halved again, relative to the largest
    /// magnitude of the output. The refinement ends when no expected change exceeds the tolerance.
    pub tolerance: f64,
    /// Maximum number of block pulses of a simulation.
    pub max_pulses: usize,
    /// Minimum number of sampling intervals of a record that is simulated by superposition of responses.
    pub long_record_intervals: usize,
    /// Memory limit \[bytes\].
    pub memory: usize,
}

impl OutputSimulation {
    /// Return samples extrapolated to zero step. The step is halved until no output changes by more than the tolerance,
    /// or until the number of pulses reaches its maximum.
    ///
    /// # Errors
    /// The errors of [`OutputSimulation::samples`]. Equations that are singular at one step only are not an error.
    /// [`Error::Memory`] if the simulation with the longest step exceeds the memory limit. [`Error::Interrupted`] after
    /// a stop request.
    ///
    /// ```
    /// # use ftlm::equation::{Equation, Structure, Term};
    /// # use ftlm::output_samples::{InitialTerms, OutputSimulation, Refinement};
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
    /// # let plant = Equation::new(Structure { output: 0, order: 0.5, terms }, vec![-1.0, 1.0])?;
    /// # let u = Channel::new("u", vec![1.0; 21], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.05, None, vec![Channel::new("y", vec![0.0; 21], Role::Output), u], vec![0])?;
    /// # let simulation = OutputSimulation::new(run.into(), vec![plant], Vec::new(), None)?;
    /// // D^0.5 y = −y + u from rest, 0.5724 one second after a step.
    /// let rest = InitialTerms::Given(vec![Vec::new()]);
    /// let options = Refinement { tolerance: 1e-6, max_pulses: 1 << 16, long_record_intervals: 1 << 14, memory: 1 << 30 };
    /// let found = simulation.refine(&rest, options, &ftlm::parallel::Stop::default())?;
    /// assert!((found.samples.outputs[0][20] - 0.572_416_423_844_193).abs() < 1e-6);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn refine(&self, initial: &InitialTerms, mut options: Refinement, stop: &Stop) -> Result<RefinedSamples> {
        let (pulse, pulses) = (self.bytes_per_pulse(initial), FIRST_REFINEMENT.saturating_mul(self.recording.len()));
        let what = || format!("the {pulses} pulses of a simulation of run '{}'", self.recording.name());
        check_memory(what, pulse.saturating_mul(pulses), options.memory)?;
        options.max_pulses = options.max_pulses.min(options.memory / pulse);
        if let Some(long_samples) = refine_long_record(self, initial, options, stop)? {
            return Ok(long_samples);
        }
        let intervals = self.recording.len() - 1;
        let (mut table, mut failures, mut pulses_per_sample) = (RichardsonTable::default(), 0, FIRST_REFINEMENT);
        loop {
            stop.check()?;
            let is_last = intervals.saturating_mul(2 * pulses_per_sample) > options.max_pulses;
            let OutputSamples { outputs, initial: terms } = match self.samples(pulses_per_sample, initial) {
                // The equations are singular if a coefficient c of the output satisfies 1 = c h^α / Γ(α + 2). This can
                // be true for one step h, but not for two.
                Err(error) if error.kind() == Kind::Model && failures != 1 => self.unknown_samples(initial),
                long_samples => long_samples?,
            };
            let is_finite = outputs.iter().flatten().all(|v| v.is_finite());
            let owners = terms.iter().enumerate().flat_map(|(i, equation_terms)| equation_terms.iter().map(move |_| i));
            let values = terms.iter().flatten().map(|term| term.1).collect();
            table.add(outputs, values, &relative_change);
            let long_samples = table.estimate(&owners.collect::<Vec<_>>(), options.tolerance, &relative_change);
            let limit = long_samples.ok_or_else(|| Error::Internal { what: "no grid for the simulation".into() })?;
            // The scheme of a stiff equation may be unstable on a coarse grid. If it is unstable on two grids in
            // succession, finer grids are not tried.
            failures = if is_finite || pulses_per_sample == FIRST_REFINEMENT { 0 } else { failures + 1 };
            if is_last || failures == 2 || limit.change.iter().all(|c| *c <= options.tolerance) {
                let mut values = limit.terms.into_iter();
                let initial = terms.into_iter().map(|equation_terms| {
                    equation_terms
                        .into_iter()
                        .zip(values.by_ref())
                        .map(|((exponent, _), value)| (exponent, value))
                        .collect()
                });
                let samples = OutputSamples { outputs: limit.samples, initial: initial.collect() };
                return Ok(RefinedSamples { samples, refinement: pulses_per_sample, change: limit.change });
            }
            pulses_per_sample *= 2;
        }
    }

    /// Return the memory of a grid per pulse \[bytes\]: signals, series and spectra of the system, and responses.
    fn bytes_per_pulse(&self, initial: &InitialTerms) -> usize {
        let units = match initial {
            InitialTerms::Given(_) => 0,
            InitialTerms::Fitted { exponents, .. } | InitialTerms::UnitResponses { exponents } => {
                exponents.iter().map(Vec::len).sum()
            }
        };
        let n = self.equations.len();
        size_of::<f64>() * (2 * self.recording.channels().len() + (10 * n + 2 * units + 8) * n)
    }

    /// Return samples that are all NaN, for a grid on which the equations are singular.
    fn unknown_samples(&self, initial: &InitialTerms) -> OutputSamples {
        let count = self.times.as_ref().map_or(self.recording.len(), Vec::len);
        let n = self.equations.len();
        let blocks = match initial {
            InitialTerms::UnitResponses { exponents } => 1 + exponents.iter().map(Vec::len).sum::<usize>(),
            _ => 1,
        };
        OutputSamples { outputs: vec![vec![f64::NAN; count]; n * blocks], initial: vec![Vec::new(); n] }
    }
}

/// Simulation by superposition of responses: to every sample of the inputs, to the first samples of linear inputs, and
/// to initial terms.
struct SampleResponses<'a> {
    simulation: &'a OutputSimulation,
    /// Nonzero inputs: index of the signal, samples with saturations and dead zones applied, and true if the input is
    /// linear between samples. The first sample of a linear input has a different response from later samples.
    inputs: Vec<(usize, Vec<f64>, bool)>,
    /// (index of the equation, exponent) of each initial term.
    units: Vec<(usize, f64)>,
    stop: &'a Stop,
}

/// Time range of all responses: first sample, end, pulses per sampling interval of its finest grid, and Richardson
/// table.
struct TimeRange {
    first: usize,
    end: usize,
    refinement: usize,
    limit: RichardsonTable,
}

impl<'a> SampleResponses<'a> {
    /// Prepare the superposition of responses for a simulation; None if superposition does not apply.
    fn new(simulation: &'a OutputSimulation, units: Vec<(usize, f64)>, stop: &'a Stop) -> Option<Self> {
        let OutputSimulation { recording, equations, times, .. } = simulation;
        let is_unsupported =
            !simulation.is_linear() || recording.is_all_filtered() || recording.has_nonuniform_samples();
        if is_unsupported || times.is_some() || simulation.has_improper_term() {
            return None;
        }
        let mut inputs: Vec<(usize, Vec<f64>, bool)> = Vec::new();
        for structure in equations.iter().map(|e| &e.structure) {
            for term in &structure.terms {
                let channel = &recording.channels()[term.signal];
                if term.signal == structure.output || simulation.simulated_output(term.signal).is_some() {
                    continue;
                }
                let has_feedthrough = (term.order - structure.order).abs() <= ORDER_TOLERANCE;
                // A delayed input depends on values before the run, and direct feedthrough has a value at the last
                // sample. Neither is a response to one of its samples.
                let delay = channel.delay.unwrap_or(0.0);
                let depends_on_other_samples = delay > 0.0 && (has_feedthrough || !recording.is_at_rest);
                if channel.role == Role::Derived || delay < 0.0 || depends_on_other_samples {
                    return None;
                }
                let samples = interpolate_gaps(&recording.acting_samples(term.signal)).into_owned();
                if inputs.iter().all(|(signal, ..)| *signal != term.signal) && samples.iter().any(|v| *v != 0.0) {
                    inputs.push((term.signal, samples, !channel.is_zero_order_hold()));
                }
            }
        }
        Some(Self { simulation, inputs, units, stop })
    }

    fn outputs(&self) -> usize {
        self.simulation.equations.len()
    }

    /// Return the responses to unit input samples, to first samples and to initial terms, on a grid of
    /// `pulses_per_sample` pulses per sampling interval. Each response is a block of one row per output. It is NaN if
    /// the equations are singular on the grid.
    fn compute(&self, pulses_per_sample: usize, intervals: usize) -> Result<Rows> {
        match self.try_compute(pulses_per_sample, intervals) {
            Err(error) if error.kind() == Kind::Model => {
                let blocks = self.inputs.len() + self.first_samples().count() + self.units.len();
                Ok(vec![vec![f64::NAN; intervals + 1]; blocks * self.outputs()])
            }
            samples => samples,
        }
    }

    fn try_compute(&self, pulses_per_sample: usize, intervals: usize) -> Result<Rows> {
        let (mut rows, mut first_responses) = (Vec::new(), Vec::new());
        let rest = InitialTerms::Given(vec![Vec::new(); self.outputs()]);
        for (signal, samples, is_linear) in &self.inputs {
            self.stop.check()?;
            // The unit sample of a signal that is linear between samples is a triangle, which begins one interval
            // earlier.
            let ramp = usize::from(*is_linear);
            let mut block =
                self.unit(Some((*signal, ramp)), intervals + ramp).samples(pulses_per_sample, &rest)?.outputs;
            if *is_linear {
                for row in &mut block {
                    row.remove(0);
                }
                if samples[0] != 0.0 {
                    let full_response =
                        self.unit(Some((*signal, 0)), intervals).samples(pulses_per_sample, &rest)?.outputs;
                    first_responses.extend(combine(&full_response, &block, |w, b| w - b));
                }
            }
            rows.extend(block);
        }
        rows.extend(first_responses);
        if !self.units.is_empty() {
            self.stop.check()?;
            let zero_inputs = self.unit(None, intervals);
            let pulse_grid = Grid::new(&zero_inputs, pulses_per_sample)?;
            let (_, responses) = pulse_grid.rest_and_units(&self.units)?;
            for (unit, means) in self.units.iter().zip(responses) {
                rows.extend(pulse_grid.unit_samples(*unit, &means)?);
            }
        }
        Ok(rows)
    }

    /// Return the simulation of a run with zero initial conditions in which one sample (signal, row) is 1. With None,
    /// all samples are 0.
    fn unit(&self, sample: Option<(usize, usize)>, intervals: usize) -> OutputSimulation {
        let recording = Arc::new(self.simulation.recording.unit_recording(intervals + 1, sample));
        OutputSimulation { recording, ..self.simulation.clone() }
    }

    /// Return the responses of [`Self::compute`] without a grid, by the starred transform of each response.
    ///
    /// None for coupled equations, sensor filters, and inputs that are delayed or not zero-order holds. None also for
    /// unstable equations, and for poles that are too close to the Nyquist frequency or above it.
    fn transform(&self) -> Option<Rows> {
        let OutputSimulation { recording, equations, .. } = self.simulation;
        let is_usable = |(signal, _, is_linear): &(usize, Vec<f64>, bool)| {
            !is_linear && recording.channels()[*signal].delay.unwrap_or(0.0) == 0.0
        };
        if recording.filter.is_some()
            || (recording.is_coupled && equations.len() > 1)
            || !self.inputs.iter().all(is_usable)
            || self.units.iter().any(|unit| unit.1 < 0.0)
            || !equations.iter().all(|equation| has_smooth_aliases(equation, recording.step()))
        {
            return None;
        }
        let transform = StarredTransform::new(recording.len(), recording.step());
        let response = |equation: &Equation, start: f64, numerator: &dyn Fn(LaplacePoint) -> Bin| {
            let spectra = transform.spectra(&[start], |point, values| {
                let denominator =
                    terms_of(equation, equation.structure.output).map(|(c, eta)| point.integration(eta) * c);
                values[0] = numerator(point) / (Bin::from(1.0) - denominator.sum::<Bin>());
            });
            spectra.into_iter().map(|spectrum| transform.samples(spectrum)).next().unwrap_or_default()
        };
        let mut rows = Rows::new();
        for (signal, ..) in &self.inputs {
            for equation in equations {
                let terms: Vec<(f64, f64)> = terms_of(equation, *signal).collect();
                if *signal == equation.structure.output || terms.is_empty() {
                    rows.push(vec![0.0; recording.len()]);
                    continue;
                }
                let feedthrough: f64 = terms.iter().filter(|(_, eta)| *eta <= ORDER_TOLERANCE).map(|(c, _)| c).sum();
                // At a jump, the inverse transform gives the mean of the values before and after it.
                let mut row = response(equation, 0.5 * feedthrough, &|point| {
                    terms.iter().map(|&(c, eta)| point.integration(eta + 1.0) * c).sum()
                });
                row[0] = feedthrough;
                // A sample of a zero-order hold is a step and an opposite step one interval later.
                (1..row.len()).rev().for_each(|k| row[k] -= row[k - 1]);
                rows.push(row);
            }
        }
        for &(i, exponent) in &self.units {
            for (j, equation) in equations.iter().enumerate() {
                if i == j {
                    let gain = libm::tgamma(exponent + 1.0);
                    let mut row = response(equation, 0.0, &|point| point.integration(exponent + 1.0) * gain);
                    row[0] = f64::from(u8::from(exponent == 0.0));
                    rows.push(row);
                } else {
                    rows.push(vec![0.0; recording.len()]);
                }
            }
        }
        Some(rows)
    }

    fn first_samples(&self) -> impl Iterator<Item = f64> + '_ {
        self.inputs.iter().filter(|(_, samples, is_linear)| *is_linear && samples[0] != 0.0).map(|(_, s, _)| s[0])
    }

    /// Superpose responses whose rows start at sample `first`. Return the samples of the outputs from this sample on.
    /// `terms` holds the coefficients of the initial terms.
    fn superpose(&self, responses: &Rows, first: usize, terms: &[f64]) -> Rows {
        let (n, count) = (self.outputs(), self.simulation.recording.len() - first);
        let mut out = vec![vec![0.0; count]; n];
        for (block, (_, samples, _)) in responses.chunks(n).zip(&self.inputs) {
            for (sum, row) in out.iter_mut().zip(block).filter(|(_, row)| row.iter().any(|v| *v != 0.0)) {
                add_multiple(sum, 1.0, &series::multiply(row, &samples[..count], count));
            }
        }
        let weights = self.first_samples().chain(terms.iter().copied());
        for (block, weight) in responses.chunks(n).skip(self.inputs.len()).zip(weights) {
            out.iter_mut().zip(block).for_each(|(sum, row)| add_multiple(sum, weight, row));
        }
        out
    }

    /// Return the samples with the initial terms, whose coefficients are given or fitted to the measured samples.
    fn samples(&self, responses: &Rows, initial: &InitialTerms) -> Result<OutputSamples> {
        let n = self.outputs();
        match initial {
            InitialTerms::Given(terms) => {
                let values: Vec<f64> = terms.iter().flatten().map(|term| term.1).collect();
                Ok(OutputSamples { outputs: self.superpose(responses, 0, &values), initial: terms.clone() })
            }
            InitialTerms::UnitResponses { .. } => {
                let mut outputs = self.superpose(responses, 0, &vec![0.0; self.units.len()]);
                outputs.extend_from_slice(&responses[n * (self.inputs.len() + self.first_samples().count())..]);
                Ok(OutputSamples { outputs, initial: vec![Vec::new(); n] })
            }
            InitialTerms::Fitted { has_level, .. } => {
                let samples = self.superpose(responses, 0, &vec![0.0; self.units.len()]);
                if self.units.is_empty() && !has_level {
                    return Ok(OutputSamples { outputs: samples, initial: vec![Vec::new(); n] });
                }
                let columns = responses.chunks(n).skip(self.inputs.len() + self.first_samples().count());
                let measured = self.simulation.recording.compared_rows(FINEST_FULL_GRID)?;
                fit_initial_terms(&measured, samples, &self.units, columns.map(<[_]>::to_vec).collect(), *has_level)
            }
        }
    }
}

/// Refine the step for a long record by superposition of responses; return None if superposition does not apply.
///
/// The refinement in the result is that of the finest grid that covers the whole record.
fn refine_long_record(
    simulation: &OutputSimulation,
    initial: &InitialTerms,
    options: Refinement,
    stop: &Stop,
) -> Result<Option<RefinedSamples>> {
    let intervals = simulation.recording.len() - 1;
    if intervals < options.long_record_intervals || FINEST_FULL_GRID.saturating_mul(intervals) > options.max_pulses {
        return Ok(None);
    }
    let exponents = match initial {
        InitialTerms::Given(terms) => {
            terms.iter().map(|equation_terms| equation_terms.iter().map(|term| term.0).collect()).collect()
        }
        InitialTerms::Fitted { exponents, .. } | InitialTerms::UnitResponses { exponents } => exponents.clone(),
    };
    let Some(responses) = SampleResponses::new(simulation, simulation.unit_terms(&exponents)?, stop) else {
        return Ok(None);
    };
    if options.tolerance >= TRANSFORM_ERROR
        && let Some(rows) = responses.transform().filter(has_small_growth)
    {
        let change = vec![TRANSFORM_ERROR; responses.outputs()];
        return Ok(Some(RefinedSamples { samples: responses.samples(&rows, initial)?, refinement: 1, change }));
    }
    let rows_by_refinement =
        FULL_GRID_REFINEMENTS.iter().map(|&pulses_per_sample| responses.compute(pulses_per_sample, intervals));
    let rows_by_refinement = rows_by_refinement.collect::<Result<Vec<_>>>()?;
    if !rows_by_refinement[1..].iter().all(has_small_growth) {
        return Ok(None);
    }
    let estimate = responses.samples(&rows_by_refinement[rows_by_refinement.len() - 1], initial)?;
    let peaks: Vec<f64> = estimate.outputs.iter().map(|row| peak(row)).collect();
    let mut terms: Vec<f64> = estimate.initial.iter().flatten().filter(|t| t.0.is_finite()).map(|t| t.1).collect();
    terms.resize(responses.units.len(), 0.0);
    let measure = |first: usize, new: &Rows, old: &Rows| -> Vec<f64> {
        let difference = combine(new, old, |n, o| n - o);
        if !difference.iter().flatten().all(|v| v.is_finite()) {
            return vec![f64::INFINITY; peaks.len()];
        }
        let changes = responses.superpose(&difference, first, &terms);
        let relative_peak = |(row, size): (&Vec<f64>, &f64)| match peak(row) {
            0.0 => 0.0,
            largest => largest / if *size > 0.0 { *size } else { 1e-300 },
        };
        changes.iter().zip(&peaks).map(relative_peak).collect()
    };
    let time_slice =
        |rows: &Rows, first: usize, end: usize| rows.iter().map(|row| row[first..end].to_vec()).collect::<Rows>();
    let mut ranges = Vec::new();
    for (first, end) in time_ranges(intervals) {
        let mut limit = RichardsonTable::default();
        for rows in &rows_by_refinement[usize::from(first == 0)..] {
            limit.add(time_slice(rows, first, end), Vec::new(), &|new, old| measure(first, new, old));
        }
        ranges.push(TimeRange { first, end, refinement: FINEST_FULL_GRID, limit });
    }
    drop(rows_by_refinement);
    let (count, range_tolerance) = (ranges.len(), options.tolerance / ranges.len() as f64);
    let (limit_rows, refinement, change) = loop {
        let estimates =
            ranges.iter().map(|range| range.limit.estimate(&[], 0.0, &|new, old| measure(range.first, new, old)));
        let error = || Error::Internal { what: "no grid of a response".into() };
        let estimates = estimates.collect::<Option<Vec<_>>>().ok_or_else(error)?;
        let total_change = |i: usize| estimates.iter().filter_map(|estimate| estimate.change.get(i)).sum::<f64>();
        let change: Vec<f64> = (0..responses.outputs()).map(total_change).collect();
        let widest_range = (0..count).rev().find(|&k| {
            !estimates[k].change.iter().all(|c| *c <= range_tolerance)
                && (2 * ranges[k].refinement).saturating_mul(ranges[k].end) <= options.max_pulses
        });
        let widest_range = widest_range.filter(|_| !change.iter().all(|c| *c <= options.tolerance));
        let Some((end, pulses_per_sample)) = widest_range.map(|k| (ranges[k].end, 2 * ranges[k].refinement)) else {
            let mut limit_rows = vec![Vec::new(); estimates[0].samples.len()];
            for estimate in estimates {
                limit_rows.iter_mut().zip(estimate.samples).for_each(|(row, range_samples)| row.extend(range_samples));
            }
            break (limit_rows, ranges[count - 1].refinement, change);
        };
        stop.check()?;
        let finer = responses.compute(pulses_per_sample, end - 1)?;
        for range in ranges.iter_mut().filter(|range| range.end <= end && 2 * range.refinement == pulses_per_sample) {
            let (first, end) = (range.first, range.end);
            range.limit.add(time_slice(&finer, first, end), Vec::new(), &|new, old| measure(first, new, old));
            range.refinement = pulses_per_sample;
        }
    };
    Ok(Some(RefinedSamples { samples: responses.samples(&limit_rows, initial)?, refinement, change }))
}

/// Coefficient and integration order of each term of a signal in an equation.
fn terms_of(equation: &Equation, signal: usize) -> impl Iterator<Item = (f64, f64)> + '_ {
    let structure = &equation.structure;
    let pairs = structure.terms.iter().zip(&equation.coefficients).filter(move |(term, _)| term.signal == signal);
    pairs.map(|(term, c)| (*c, structure.order - term.order))
}

/// True if a stable equation has no poles near the Nyquist frequency or above it, so that the alias terms of its
/// transform are smooth.
fn has_smooth_aliases(equation: &Equation, step: f64) -> bool {
    let structure = &equation.structure;
    let (output, order) = (structure.output, structure.order);
    let terms: Vec<(f64, f64)> = terms_of(equation, output).map(|(c, eta)| (c, order - eta)).collect();
    let frequency = MAX_POLE_FREQUENCY_RATIO * std::f64::consts::PI / step;
    // The sum of |c| ω^−η decreases with ω. If it is below 1 here, the denominator 1 − Σ c s^−η has no zero above.
    terms_of(equation, output).all(|(_, eta)| eta > ORDER_TOLERANCE)
        && terms_of(equation, output).map(|(c, eta)| c.abs() * libm::pow(frequency, -eta)).sum::<f64>() < 1.0
        && !is_unstable(order, &terms)
}

/// Divide responses over `intervals` sampling intervals into time ranges. Return (first sample, end) of each range.
fn time_ranges(intervals: usize) -> Vec<(usize, usize)> {
    let range_ends = std::iter::successors(Some(intervals + 1), |range_end| Some(range_end / RANGE_END_RATIO));
    let mut range_ends: Vec<usize> = range_ends
        .enumerate()
        .take_while(|(k, range_end)| *k == 0 || *range_end >= MIN_RANGE_INTERVALS)
        .map(|(_, range_end)| range_end)
        .collect();
    range_ends.reverse();
    let range_starts = std::iter::once(0).chain(range_ends.iter().copied());
    range_starts.zip(range_ends.iter().copied()).collect()
}

/// True if the responses are finite and grow so little over the record that their superposition does not lose digits.
fn has_small_growth(rows: &Rows) -> bool {
    rows.iter().all(|row| {
        let (first, second) = row.split_at(row.len() / 2);
        row.iter().all(|v| v.is_finite()) && peak(second) <= MAX_GROWTH_RATIO * peak(first)
    })
}

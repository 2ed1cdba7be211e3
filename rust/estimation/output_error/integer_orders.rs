//! Exact output samples of equations of integer orders, and their derivatives.
//!
//! The equation is D^n y = Σ a_i D^i y + Σ b_j D^j u with output y and inputs u. Its denominator is A(s) = s^n − Σ a_i
//! s^i. The samples of (s^j/A) u are states of one companion form, which its matrix exponential advances from pulse to
//! pulse. This is exact for an input that is constant or linear over a pulse. A zero-order-hold input may have any
//! delay. The output is linear in b_j. Its derivative with respect to a_i is (s^i/A) y, a state of two companion forms
//! in series. Its derivative with respect to a delay is −D y. An initial term c t^e is the response of a chain of
//! integrators to an impulse, a constant or a ramp. Time is scaled by the largest coefficient, so that no element of
//! the companion form is above 1.

use std::borrow::Cow;
use std::cell::RefCell;
use std::rc::Rc;

use super::evaluation::{append, Evaluation, RANK_TOLERANCE};
use super::experiment::Experiment;
use super::parameterization::{FreeModel, InputLaw, ParameterPoint};

use crate::error::{Error, Result};
use crate::linalg::orthogonal::{extend_orthonormal, project_out};
use crate::linalg::small::spectral_radius;
use crate::signal::block_pulse::{delayed_row, Intersample};
use crate::state_space::{InputGains, Transition};

/// Difference between an order or exponent and an integer below which it counts as that integer.
const INTEGER_TOLERANCE: f64 = 1e-9;
/// Maximum order of an equation.
const MAX_ORDER: usize = 12;
/// Maximum product of the magnitude of a pole and the sampling interval, which is reached at the Nyquist frequency.
///
/// The effect of faster poles on the samples cannot be distinguished from noise.
const MAX_POLE_PHASE_RAD: f64 = std::f64::consts::PI;

/// Equations of integer orders whose inputs are zero-order holds, or linear over each pulse, in every experiment.
pub(crate) struct IntegerOrders {
    equations: Vec<EquationOrders>,
}

/// Orders of the terms of one equation.
struct EquationOrders {
    order: usize,
    /// Term index and order of each autoregressive term.
    autoregressive_terms: Vec<(usize, usize)>,
    /// Input signals, each with the term index and the order of its terms.
    inputs: Vec<(usize, Vec<(usize, usize)>)>,
}

/// Input of a companion form.
pub(crate) struct SourceInput<'a> {
    /// Values of the input: one per pulse for a zero-order hold, one per pulse edge if it is linear over each pulse.
    pub(crate) samples: Cow<'a, [f64]>,
    pub(crate) intersample: Intersample,
    /// Delay of a zero-order-hold input in pulses.
    pub(crate) delay: f64,
    /// Value of the input before the first pulse.
    pub(crate) before: f64,
}

/// Kind of a source of a companion form: an input or an initial term.
enum SourceKind {
    /// Index of the input in the equation.
    Input(usize),
    /// Impulse. Its response and the derivatives of the response represent initial terms t^e with an exponent e below
    /// the order of the equation.
    Impulse,
    /// Initial term t^e. The exponent e is the order of the equation or the order plus one.
    Power(usize),
}

/// Source of an equation, and the states of its response.
struct Source<'a> {
    kind: SourceKind,
    input: Option<SourceInput<'a>>,
    /// States at the compared samples, row-major with one row per sample.
    states: Vec<f64>,
    /// Values of the input just after the compared samples.
    values: Vec<f64>,
}

/// Companion form of the denominator A(s) of an equation, in scaled time.
pub(crate) struct Companion {
    pub(crate) order: usize,
    /// Unit of frequency \[rad/s\], the inverse of the scaled unit of time.
    scale: f64,
    /// Autoregressive coefficients in scaled time, a_i scale^(i − n).
    coefficients: Vec<f64>,
    /// Pulse width in scaled time.
    step: f64,
    /// Pulse width in seconds.
    width: f64,
    /// Cache of discretizations, shared by all experiments with this pulse width.
    discretizations: RefCell<Vec<Rc<Discretization>>>,
}

/// Key of a discretization: inter-sample behavior, fractional delay in pulses, and first system of two in series.
///
/// The inter-sample behavior is None without an input. The first system is given by its output row and direct gain.
type DiscretizationKey = (Option<Intersample>, u64, Option<(Vec<f64>, f64)>);

/// Exact discretization: transition of the states over one pulse.
struct Discretization {
    key: DiscretizationKey,
    /// Transition matrix over one pulse minus the identity, column-major.
    transition_increment: Vec<f64>,
    gains: Option<InputGains>,
}

/// Number of pulses per sample, and number of compared samples.
type SampleGrid = (usize, usize);

impl Companion {
    /// Return the companion form of s^n − Σ own_i s^i for pulses of width `step` \[s\].
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, clippy::cast_precision_loss)]
    pub(crate) fn new(coefficients: &[f64], step: f64) -> Self {
        let order = coefficients.len();
        let scale_of_term = |(i, a): (usize, &f64)| libm::pow(a.abs(), 1.0 / (order - i) as f64);
        let scale = coefficients.iter().enumerate().map(scale_of_term).fold(0.0, f64::max);
        let scale = if scale > 0.0 && scale.is_finite() { scale } else { 1.0 / step };
        let coefficients =
            coefficients.iter().enumerate().map(|(i, a)| a * scale.powi(i as i32 - order as i32)).collect();
        Self { order, scale, coefficients, step: step * scale, width: step, discretizations: RefCell::default() }
    }

    /// Return the companion form for the pulse width `step` from the cache, to which it is added if necessary.
    pub(crate) fn of_width(cache: &mut Vec<Rc<Self>>, coefficients: &[f64], step: f64) -> Rc<Self> {
        if let Some(entry_from_cache) = cache.iter().find(|c| c.width.to_bits() == step.to_bits()) {
            return entry_from_cache.clone();
        }
        cache.push(Rc::new(Self::new(coefficients, step)));
        cache[cache.len() - 1].clone()
    }

    /// Return scale^power, a power of the unit of frequency.
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
    fn power(&self, power: isize) -> f64 {
        self.scale.powi(power as i32)
    }

    /// Return the output row and the direct gain of Σ c s^j/A over the pairs (j, c) in `terms`.
    #[allow(clippy::cast_possible_wrap)]
    fn output(&self, terms: impl Iterator<Item = (usize, f64)>) -> (Vec<f64>, f64) {
        let (n, mut row, mut direct) = (self.order, vec![0.0; self.order], 0.0);
        for (j, c) in terms {
            if j < n {
                row[j] += c * self.power(j as isize - n as isize);
            } else if j == n {
                direct += c;
                row.iter_mut().zip(&self.coefficients).for_each(|(r, a)| *r += c * a);
            }
        }
        (row, direct)
    }

    /// Return the response of s^j/A to an input or impulse at the compared samples, from the states of 1/A and the
    /// input values.
    ///
    /// `j` is at most the order.
    pub(crate) fn derivative(&self, (states, values): &(Vec<f64>, Vec<f64>), j: usize) -> Vec<f64> {
        let (output_row, direct) = self.output(std::iter::once((j, 1.0)));
        let sample =
            |(row, u): (&[f64], &f64)| row.iter().zip(&output_row).map(|(x, c)| x * c).sum::<f64>() + direct * u;
        states.chunks_exact(self.order.max(1)).zip(values).map(sample).collect()
    }

    /// Return the response of 1/A to an input, or to an impulse if `input` is None.
    ///
    /// The response consists of the states at the compared samples, and the input just after each. None on overflow.
    pub(crate) fn respond(
        &self,
        input: Option<&SourceInput<'_>>,
        sampling: SampleGrid,
    ) -> Option<(Vec<f64>, Vec<f64>)> {
        let mut states = Vec::with_capacity(self.order * sampling.1);
        let mut values = Vec::with_capacity(sampling.1);
        self.visit_response(input, None, sampling, |state, value| {
            states.extend_from_slice(state);
            values.push(value);
        })?;
        states.iter().all(|v| v.is_finite()).then_some((states, values))
    }

    /// Call `visit` with the states of the response of 1/A at each compared sample, and the input just after it. None
    /// if the discretization overflows.
    ///
    /// The response is to an input, or to an impulse if `input` is None. `series_output` holds C and D of an output
    /// C x + D u. This output is the input of a second system 1/A in series, whose states are appended to those of the
    /// first.
    fn visit_response(
        &self,
        input: Option<&SourceInput<'_>>,
        series_output: Option<(&[f64], f64)>,
        sampling: SampleGrid,
        visit: impl FnMut(&[f64], f64),
    ) -> Option<()> {
        let n = self.order;
        let total = if series_output.is_some() { 2 * n } else { n };
        let fraction = input.map_or(0.0, |input| input.delay - input.delay.floor());
        let discretization = self.discretization(input.map(|input| input.intersample), fraction, series_output)?;
        let mut start = vec![0.0; total];
        if input.is_none() {
            start[n - 1] = 1.0;
        }
        discretization.advance(start, input, sampling, visit);
        Some(())
    }

    /// Return the discretization of 1/A, or of two systems 1/A in series; None on overflow.
    ///
    /// `series_output` is the output row and direct gain that connect the first system to the second. `fraction` is the
    /// fractional part of the delay in pulses.
    fn discretization(
        &self,
        intersample: Option<Intersample>,
        fraction: f64,
        series_output: Option<(&[f64], f64)>,
    ) -> Option<Rc<Discretization>> {
        let key =
            (intersample, fraction.to_bits(), series_output.map(|(output_row, direct)| (output_row.to_vec(), direct)));
        if let Some(entry_from_cache) = self.discretizations.borrow().iter().find(|d| d.key == key) {
            return Some(entry_from_cache.clone());
        }
        let n = self.order;
        let total = if series_output.is_some() { 2 * n } else { n };
        let (mut system, mut input_vector) = (vec![0.0; total * total], vec![0.0; total]);
        for first in (0..total).step_by(n.max(1)) {
            for i in 0..n {
                let row = (first + i) * total + first;
                if i + 1 < n {
                    system[row + i + 1] = self.step;
                } else {
                    system[row..row + n].iter_mut().zip(&self.coefficients).for_each(|(s, a)| *s = self.step * a);
                }
            }
        }
        input_vector[n - 1] = self.step;
        if let Some((output_row, direct)) = series_output {
            let last = (total - 1) * total;
            system[last..last + n].iter_mut().zip(output_row).for_each(|(s, c)| *s = self.step * c);
            input_vector[total - 1] = self.step * direct;
        }
        let interval = Transition::new(&system, total, 1.0)?;
        let gains = match intersample {
            None => None,
            Some(intersample) => Some(InputGains::new(&interval, &system, &input_vector, intersample, fraction)?),
        };
        // Columns are contiguous, so that the states of a step are independent sums.
        let transition_increment =
            (0..total * total).map(|k| interval.transition_increment[k % total * total + k / total]).collect();
        let discretization = Rc::new(Discretization { key, transition_increment, gains });
        self.discretizations.borrow_mut().push(discretization.clone());
        Some(discretization)
    }
}

impl Discretization {
    /// Call `visit` with the states at each compared sample and the input just after it.
    ///
    /// `state` contains the states before the first pulse.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn advance(
        &self,
        mut state: Vec<f64>,
        input: Option<&SourceInput<'_>>,
        (pulses_per_sample, count): SampleGrid,
        mut visit: impl FnMut(&[f64], f64),
    ) {
        let n = state.len();
        let lag = input.map_or(0, |input| {
            let is_fractional_delay = input.intersample == Intersample::Hold && input.delay > input.delay.floor();
            input.delay.floor().clamp(-1e15, 1e15) as isize + isize::from(is_fractional_delay)
        });
        let input_value = |k: usize| match (input, delayed_row(k, lag)) {
            (None, _) => 0.0,
            (Some(input), None) => input.before,
            (Some(input), Some(k)) => input.samples[k.min(input.samples.len() - 1)],
        };
        let mut next_state = vec![0.0; n];
        for k in 0..=count * pulses_per_sample {
            let (current_value, next_value) = (input_value(k), input_value(k + 1));
            if k > 0 && k % pulses_per_sample == 0 {
                visit(&state, current_value);
            }
            next_state.copy_from_slice(&state);
            if let Some(gains) = &self.gains {
                for ((v, a), b) in next_state.iter_mut().zip(&gains.current_gains).zip(&gains.next_gains) {
                    *v += a * current_value + b * next_value;
                }
            }
            for (column, x) in self.transition_increment.chunks_exact(n).zip(&state) {
                next_state.iter_mut().zip(column).for_each(|(v, g)| *v += g * x);
            }
            std::mem::swap(&mut state, &mut next_state);
        }
    }
}

/// Exact simulation of an equation on an experiment.
struct EquationSimulation<'a> {
    companion: Rc<Companion>,
    sources: Vec<Source<'a>>,
}

/// Exact simulation of an experiment.
pub(crate) struct ExactSimulation<'a> {
    equations: Vec<EquationSimulation<'a>>,
    /// Orthonormal basis of the weighted responses to the initial terms.
    basis: Vec<Vec<f64>>,
    /// Change of the weighted samples per unit of each linear coefficient, one list of samples each.
    effects: Vec<Vec<f64>>,
}

/// Convert an order or exponent to an integer; None if it is not a nonnegative integer.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn integer(order: f64) -> Option<usize> {
    let nearest = order.round();
    (nearest >= 0.0 && nearest <= 2.0 * MAX_ORDER as f64 && (order - nearest).abs() <= INTEGER_TOLERANCE)
        .then_some(nearest as usize)
}

#[allow(clippy::cast_precision_loss)]
fn factorial(n: usize) -> f64 {
    (1..=n).map(|k| k as f64).product()
}

impl IntegerOrders {
    /// Return the integer orders of a model at a point; None if it has no exact simulation.
    ///
    /// This is the case if an order is free or fractional, or if equations are coupled. It is also the case if an
    /// experiment has a sensor filter, nonuniform samples, or an input that is neither a zero-order hold nor linear
    /// over each pulse.
    pub(crate) fn new(model: &FreeModel, experiments: &[Experiment], point: &ParameterPoint) -> Option<Self> {
        let structures = model.structures(&point.orders);
        let is_fixed = |weights: &[f64]| {
            weights.iter().zip(&model.order_bounds).all(|(w, (low, high))| *w == 0.0 || low.to_bits() == high.to_bits())
        };
        let mut equations = Vec::with_capacity(structures.len());
        for (i, (structure, equation)) in structures.iter().zip(&model.equations).enumerate() {
            if !is_fixed(&equation.order.weights)
                || !equation.terms.iter().all(|(_, order, _)| is_fixed(&order.weights))
            {
                return None;
            }
            let order = integer(structure.order).filter(|n| (1..=MAX_ORDER).contains(n))?;
            let (mut autoregressive_terms, mut inputs) = (Vec::new(), Vec::<(usize, Vec<(usize, usize)>)>::new());
            for (k, term) in structure.terms.iter().enumerate() {
                let nu = integer(term.order)?;
                match model.output_index(i, term.signal) {
                    Some(j) if j == i && nu < order => autoregressive_terms.push((k, nu)),
                    None if nu <= order => match inputs.iter_mut().find(|(signal, _)| *signal == term.signal) {
                        Some((_, terms)) => terms.push((k, nu)),
                        None => inputs.push((term.signal, vec![(k, nu)])),
                    },
                    _ => return None,
                }
            }
            for experiment in experiments {
                let exponents = model.exponents(experiment, i, structure);
                if !exponents.iter().all(|&e| integer(e).is_some_and(|e| e <= order + 1)) {
                    return None;
                }
                let is_known_input = |&(signal, _): &(usize, Vec<(usize, usize)>)| {
                    let Some(values) = experiment.point_values.get(signal) else { return false };
                    values.is_zero_order_hold || (values.values.is_some() && model.law_of(signal).is_none())
                };
                let has_plain_samples =
                    experiment.nonuniform.is_none() && experiment.filter.is_none() && !experiment.record.is_filtered();
                if !has_plain_samples || !inputs.iter().all(is_known_input) {
                    return None;
                }
            }
            equations.push(EquationOrders { order, autoregressive_terms, inputs });
        }
        Some(Self { equations })
    }

    /// Return true if the shortest sampling interval of the experiments resolves every pole.
    pub(crate) fn is_resolved(&self, model: &FreeModel, experiments: &[Experiment], point: &ParameterPoint) -> bool {
        let shortest_interval =
            experiments.iter().map(|e| e.record.step() * e.pulses_per_sample as f64).fold(f64::INFINITY, f64::min);
        self.equations.iter().enumerate().all(|(i, _)| {
            let mut denominator: Vec<f64> =
                self.autoregressive_coefficients(model, i, point).iter().map(|a| -a).collect();
            denominator.push(1.0);
            spectral_radius(&denominator).is_some_and(|fastest| fastest * shortest_interval <= MAX_POLE_PHASE_RAD)
        })
    }

    /// Coefficients of D^0 y, …, D^(n − 1) y in equation `i` of order n.
    fn autoregressive_coefficients(&self, model: &FreeModel, i: usize, point: &ParameterPoint) -> Vec<f64> {
        let mut coefficients = vec![0.0; self.equations[i].order];
        for &(k, nu) in &self.equations[i].autoregressive_terms {
            coefficients[nu] += model.equations[i].terms[k].2.at(&point.coefficients);
        }
        coefficients
    }

    /// Return the residuals at a point, with the `linear` coefficients and the initial terms eliminated.
    ///
    /// [`Error::Diverged`] if the simulation is not finite.
    pub(crate) fn evaluate<'a>(
        &self,
        model: &FreeModel,
        experiments: &'a [Experiment],
        point: &ParameterPoint,
        linear: &[usize],
    ) -> Result<Evaluation<ExactSimulation<'a>>> {
        let structures = model.structures(&point.orders);
        let mut out = Evaluation::empty(point.clone());
        let mut residuals = Vec::with_capacity(experiments.len());
        let mut columns = Vec::with_capacity(experiments.len());
        let mut companions = vec![Vec::new(); self.equations.len()];
        for experiment in experiments {
            out.exponents = structures.iter().enumerate().map(|(i, s)| model.exponents(experiment, i, s)).collect();
            let (simulation, initial) =
                self.simulate(model, experiment, (point, linear), &out.exponents, &mut companions)?;
            let mut remainders = experiment.measured_samples();
            out.measured_norm = out.measured_norm.hypot(remainders.iter().map(|v| v * v).sum::<f64>().sqrt());
            let response = (0..self.equations.len()).flat_map(|i| simulation.response(self, model, i, point));
            let weights = (0..self.equations.len()).flat_map(|i| experiment.weights_of(i));
            remainders.iter_mut().zip(response.zip(weights)).for_each(|(e, (v, w))| *e -= w * v);
            if let Some(index) = remainders.iter().position(|e| !e.is_finite()) {
                return Err(Error::Diverged { what: "simulation".into(), index });
            }
            residuals.push(remainders);
            columns.push(initial);
            out.parts.push(simulation);
        }
        out.eliminate(linear, self.equations.len(), residuals, columns, |part| (&part.basis[..], &part.effects[..]))?;
        Ok(out)
    }

    /// Return the simulation of an experiment, and the weighted responses to its initial terms.
    ///
    /// Each response has the index of its equation, or None for a constant level of the output.
    #[allow(clippy::type_complexity)]
    fn simulate<'a>(
        &self,
        model: &FreeModel,
        experiment: &'a Experiment,
        (point, linear): (&ParameterPoint, &[usize]),
        exponents: &[Vec<f64>],
        companions: &mut [Vec<Rc<Companion>>],
    ) -> Result<(ExactSimulation<'a>, Vec<(Option<usize>, Vec<f64>)>)> {
        let (record, count) = (&experiment.record, experiment.compared_count());
        let (pulses_per_sample, step) = (experiment.pulses_per_sample, record.step());
        let outputs = self.equations.len();
        let overflow = || Error::Diverged { what: "simulation".into(), index: 0 };
        let mut equations = Vec::with_capacity(outputs);
        let (mut basis, mut columns) = (Vec::new(), Vec::new());
        let weighted_column = |i: usize, samples: &mut dyn Iterator<Item = f64>| {
            let mut column = vec![0.0; outputs * count];
            let equation_column = column[i * count..(i + 1) * count].iter_mut();
            equation_column.zip(experiment.weights_of(i).zip(samples)).for_each(|(v, (w, y))| *v = w * y);
            column
        };
        for (i, orders) in self.equations.iter().enumerate() {
            let companion =
                Companion::of_width(&mut companions[i], &self.autoregressive_coefficients(model, i, point), step);
            let mut sources = Vec::new();
            let mut add_source = |kind, input: Option<SourceInput<'a>>| -> Result<()> {
                let (states, values) =
                    companion.respond(input.as_ref(), (pulses_per_sample, count)).ok_or_else(overflow)?;
                sources.push(Source { kind, input, states, values });
                Ok(())
            };
            for (q, (signal, _)) in orders.inputs.iter().enumerate() {
                add_source(SourceKind::Input(q), Some(source_input(model, experiment, *signal, point)?))?;
            }
            let powers: Vec<usize> = exponents[i].iter().filter_map(|&e| integer(e)).collect();
            if powers.iter().any(|&e| e < orders.order) {
                add_source(SourceKind::Impulse, None)?;
            }
            for &e in powers.iter().filter(|&&e| e >= orders.order) {
                // The input is a constant, or a ramp with one value per pulse edge.
                let (intersample, length) = match e == orders.order {
                    true => (Intersample::Hold, 1),
                    false => (Intersample::Linear, record.m() + 1),
                };
                #[allow(clippy::cast_precision_loss)]
                let samples = (0..length).map(|k| if length == 1 { 1.0 } else { k as f64 * step }).collect();
                add_source(SourceKind::Power(e), Some(SourceInput { samples, intersample, delay: 0.0, before: 0.0 }))?;
            }
            let simulation = EquationSimulation { companion, sources };
            for &e in &powers {
                let mut values = vec![0.0; powers.len()];
                if let Some(index) = powers.iter().position(|&p| p == e) {
                    values[index] = 1.0;
                }
                let mut response = vec![0.0; count];
                for source in &simulation.sources {
                    if !matches!(source.kind, SourceKind::Input(_)) {
                        let (output_row, direct) = simulation.initial_output(&source.kind, &powers, &values);
                        source.add_output(&output_row, direct, &mut response);
                    }
                }
                let column = weighted_column(i, &mut response.into_iter());
                extend_orthonormal(&mut basis, column.clone(), RANK_TOLERANCE);
                columns.push((Some(i), column));
            }
            equations.push(simulation);
        }
        if model.initial.has_level() {
            for i in 0..outputs {
                let column = weighted_column(i, &mut std::iter::repeat(1.0));
                extend_orthonormal(&mut basis, column.clone(), RANK_TOLERANCE);
                columns.push((None, column));
            }
        }
        let mut simulation = ExactSimulation { equations, basis, effects: Vec::new() };
        for &j in linear {
            simulation.effects.push(simulation.input_effect(self, model, experiment, point, j));
        }
        Ok((simulation, columns))
    }

    /// Derivatives of the residuals, one row per parameter, with the initial terms projected out.
    pub(crate) fn jacobian(
        &self,
        model: &FreeModel,
        experiments: &[Experiment],
        linear: &[usize],
        evaluation: &Evaluation<ExactSimulation<'_>>,
    ) -> Result<Vec<Vec<f64>>> {
        let point = &evaluation.point;
        let (orders, coefficients) = (point.orders.len(), point.coefficients.len());
        let count = orders + coefficients + point.inputs.len();
        let mut jacobian = vec![Vec::new(); count];
        for (run, (experiment, simulation)) in experiments.iter().zip(&evaluation.parts).enumerate() {
            let responses = (0..self.equations.len())
                .map(|i| {
                    simulation.autoregressive_states(self, model, experiment, (i, point), &evaluation.initial[run])
                })
                .collect::<Option<Vec<_>>>()
                .ok_or_else(|| Error::Diverged { what: "sensitivity of the simulation".into(), index: 0 })?;
            for (parameter, out) in jacobian.iter_mut().enumerate() {
                let mut column = match parameter.checked_sub(orders) {
                    // No order is free.
                    None => vec![0.0; self.equations.len() * experiment.compared_count()],
                    Some(j) if j < coefficients => match linear.iter().position(|&l| l == j) {
                        Some(index) => simulation.effects[index].clone(),
                        None => {
                            let mut column = simulation.input_effect(self, model, experiment, point, j);
                            simulation.add_autoregressive_effect(
                                self,
                                model,
                                experiment,
                                (j, point),
                                &responses,
                                &mut column,
                            );
                            column
                        }
                    },
                    Some(j) => simulation.law_effect(self, model, experiment, point, j - coefficients)?,
                };
                project_out(&simulation.basis, &mut column);
                if column.iter().any(|v| !v.is_finite()) {
                    return Err(Error::Diverged { what: "sensitivity of the simulation".into(), index: 0 });
                }
                // Residuals are measured minus simulated samples.
                column.iter_mut().for_each(|v| *v = -*v);
                append(out, column);
            }
        }
        Ok(jacobian)
    }
}

/// Return a signal after its delay, saturation or dead zone, as the input of a companion form.
///
/// It has one mean per pulse for a zero-order hold, and one value per pulse edge if it is linear over each pulse.
pub(crate) fn source_input<'a>(
    model: &FreeModel,
    experiment: &'a Experiment,
    signal: usize,
    point: &ParameterPoint,
) -> Result<SourceInput<'a>> {
    let record = &experiment.record;
    let (means, point_values) = (record.signal(signal), &experiment.point_values[signal]);
    if let (false, Some(values)) = (point_values.is_zero_order_hold, &point_values.values) {
        let pulses_per_sample = experiment.pulses_per_sample;
        #[allow(clippy::cast_precision_loss)]
        let edge = |k: usize| {
            let (row, fraction) = (k / pulses_per_sample, (k % pulses_per_sample) as f64 / pulses_per_sample as f64);
            values[row] + if fraction > 0.0 { fraction * (values[row + 1] - values[row]) } else { 0.0 }
        };
        let samples =
            if pulses_per_sample == 1 { Cow::Borrowed(&values[..]) } else { (0..=record.m()).map(edge).collect() };
        return Ok(SourceInput { samples, intersample: Intersample::Linear, delay: 0.0, before: 0.0 });
    }
    let (mut samples, mut delay, mut before) = (Cow::Borrowed(means), 0.0, 0.0);
    if let Some(law) = model.law_of(signal) {
        if model.inputs[law].law == InputLaw::Delay {
            delay = point.inputs[law] / record.step();
            before = if model.initial.is_at_rest() { 0.0 } else { means.first().copied().unwrap_or(0.0) };
        } else {
            samples = model.apply_input_law(record, model.inputs[law], point.inputs[law])?.0.into();
        }
    }
    Ok(SourceInput { samples, intersample: Intersample::Hold, delay, before })
}

impl Source<'_> {
    /// Add `output_row`·x + `direct`·u to `samples`, where x are the states and u is the input.
    fn add_output(&self, output_row: &[f64], direct: f64, samples: &mut [f64]) {
        let rows = self.states.chunks_exact(output_row.len().max(1));
        for ((y, row), u) in samples.iter_mut().zip(rows).zip(&self.values) {
            *y += row.iter().zip(output_row).map(|(x, c)| x * c).sum::<f64>() + direct * u;
        }
    }
}

impl EquationSimulation<'_> {
    /// Output row and direct gain of the initial terms that a source of kind `kind` represents.
    ///
    /// `powers` and `values` are the exponents and coefficients of all initial terms of the equation. Terms of another
    /// kind are ignored.
    #[allow(clippy::cast_possible_wrap)]
    fn initial_output(&self, kind: &SourceKind, powers: &[usize], values: &[f64]) -> (Vec<f64>, f64) {
        let n = self.companion.order;
        let mut output_row = vec![0.0; n];
        for (&e, x) in powers.iter().zip(values) {
            match kind {
                SourceKind::Impulse if e < n => {
                    output_row[n - 1 - e] += x * factorial(e) * self.companion.power(-(e as isize));
                }
                SourceKind::Power(exponent) if *exponent == e => {
                    output_row[0] += x * factorial(e) * self.companion.power(-(n as isize));
                }
                _ => {}
            }
        }
        (output_row, 0.0)
    }
}

impl ExactSimulation<'_> {
    /// Orthonormal basis of the weighted responses to the initial terms.
    pub(crate) fn basis(&self) -> &[Vec<f64>] {
        &self.basis
    }

    /// Output row and direct gain of input `q` of equation `i`, with the given coefficient of each term.
    ///
    /// `shift` is added to the order of each term.
    fn input_output(
        &self,
        orders: &IntegerOrders,
        (i, q): (usize, usize),
        coefficient: impl Fn(usize) -> f64,
        shift: usize,
    ) -> (Vec<f64>, f64) {
        let terms = orders.equations[i].inputs[q].1.iter();
        self.equations[i].companion.output(terms.map(|&(k, nu)| (nu + shift, coefficient(k))))
    }

    /// The unweighted samples of the output of equation `i` from zero initial conditions.
    fn response(&self, orders: &IntegerOrders, model: &FreeModel, i: usize, point: &ParameterPoint) -> Vec<f64> {
        let coefficient = |k: usize| model.equations[i].terms[k].2.at(&point.coefficients);
        let mut samples = vec![0.0; self.equations[i].sources.first().map_or(0, |s| s.values.len())];
        for source in &self.equations[i].sources {
            if let SourceKind::Input(q) = source.kind {
                let (output_row, direct) = self.input_output(orders, (i, q), coefficient, 0);
                source.add_output(&output_row, direct, &mut samples);
            }
        }
        samples
    }

    /// Change of the weighted samples per unit of coefficient `j`, through the input terms.
    fn input_effect(
        &self,
        orders: &IntegerOrders,
        model: &FreeModel,
        experiment: &Experiment,
        point: &ParameterPoint,
        j: usize,
    ) -> Vec<f64> {
        let count = experiment.compared_count();
        let mut column = vec![0.0; orders.equations.len() * count];
        for (i, simulation) in self.equations.iter().enumerate() {
            let slope = |k: usize| model.equations[i].terms[k].2.slope(&point.coefficients, j);
            let equation_column = &mut column[i * count..(i + 1) * count];
            for source in &simulation.sources {
                if let SourceKind::Input(q) = source.kind
                    && orders.equations[i].inputs[q].1.iter().any(|&(k, _)| slope(k) != 0.0)
                {
                    let (output_row, direct) = self.input_output(orders, (i, q), slope, 0);
                    source.add_output(&output_row, direct, equation_column);
                }
            }
            equation_column.iter_mut().zip(experiment.weights_of(i)).for_each(|(v, w)| *v *= w);
        }
        column
    }

    /// States of y/A at the compared samples, with output y and denominator A of equation `i`; None on overflow.
    fn autoregressive_states(
        &self,
        orders: &IntegerOrders,
        model: &FreeModel,
        experiment: &Experiment,
        (i, point): (usize, &ParameterPoint),
        initial: &[Vec<f64>],
    ) -> Option<Vec<f64>> {
        let EquationSimulation { companion, sources } = &self.equations[i];
        let (n, count) = (companion.order, experiment.compared_count());
        let structures = model.structures(&point.orders);
        let exponents = model.exponents(experiment, i, &structures[i]);
        let powers: Vec<usize> = exponents.iter().filter_map(|&e| integer(e)).collect();
        let coefficient = |k: usize| model.equations[i].terms[k].2.at(&point.coefficients);
        let mut total = vec![0.0; n * count];
        for source in sources {
            let (output_row, direct) = match source.kind {
                SourceKind::Input(q) => self.input_output(orders, (i, q), coefficient, 0),
                _ => self.equations[i].initial_output(&source.kind, &powers, &initial[i]),
            };
            if direct == 0.0 && output_row.iter().all(|v| *v == 0.0) {
                continue;
            }
            let sampling = (experiment.pulses_per_sample, count);
            let mut sums = total.chunks_exact_mut(n);
            companion.visit_response(source.input.as_ref(), Some((&output_row, direct)), sampling, |state, _| {
                if let Some(sum) = sums.next() {
                    sum.iter_mut().zip(&state[n..]).for_each(|(a, b)| *a += b);
                }
            })?;
        }
        total.iter().all(|v| v.is_finite()).then_some(total)
    }

    /// Add the contribution of the autoregressive terms to the derivative with respect to coefficient `j` to `column`.
    ///
    /// `column` contains weighted samples.
    #[allow(clippy::cast_possible_wrap)]
    fn add_autoregressive_effect(
        &self,
        orders: &IntegerOrders,
        model: &FreeModel,
        experiment: &Experiment,
        (j, point): (usize, &ParameterPoint),
        responses: &[Vec<f64>],
        column: &mut [f64],
    ) {
        let count = experiment.compared_count();
        for (i, equation) in orders.equations.iter().enumerate() {
            let (companion, n) = (&self.equations[i].companion, equation.order);
            for &(k, nu) in &equation.autoregressive_terms {
                let slope = model.equations[i].terms[k].2.slope(&point.coefficients, j);
                if slope != 0.0 {
                    let gain = slope * companion.power(nu as isize - n as isize);
                    let states = responses[i].iter().skip(nu).step_by(n);
                    let equation_column = column[i * count..(i + 1) * count].iter_mut();
                    equation_column
                        .zip(experiment.weights_of(i).zip(states))
                        .for_each(|(v, (w, x))| *v += w * gain * x);
                }
            }
        }
    }

    /// Derivative of the weighted samples with respect to the free parameter of an input.
    fn law_effect(
        &self,
        orders: &IntegerOrders,
        model: &FreeModel,
        experiment: &Experiment,
        point: &ParameterPoint,
        law: usize,
    ) -> Result<Vec<f64>> {
        let (count, input) = (experiment.compared_count(), model.inputs[law]);
        let mut column = vec![0.0; orders.equations.len() * count];
        for (i, simulation) in self.equations.iter().enumerate() {
            let equation_column = &mut column[i * count..(i + 1) * count];
            let coefficient = |k: usize| model.equations[i].terms[k].2.at(&point.coefficients);
            for source in &simulation.sources {
                let SourceKind::Input(q) = source.kind else { continue };
                if orders.equations[i].inputs[q].0 != input.signal {
                    continue;
                }
                if input.law == InputLaw::Delay {
                    // The derivative is −D y. The infinite derivative of the jumps themselves is omitted.
                    let (output_row, direct) = self.input_output(orders, (i, q), |k| -coefficient(k), 1);
                    source.add_output(&output_row, direct, equation_column);
                    continue;
                }
                let slope = model.apply_input_law(&experiment.record, input, point.inputs[law])?.1;
                let slope =
                    SourceInput { samples: slope.into(), intersample: Intersample::Hold, delay: 0.0, before: 0.0 };
                let sampling = (experiment.pulses_per_sample, count);
                let (states, values) = simulation
                    .companion
                    .respond(Some(&slope), sampling)
                    .ok_or_else(|| Error::Diverged { what: "sensitivity of the simulation".into(), index: 0 })?;
                let (output_row, direct) = self.input_output(orders, (i, q), coefficient, 0);
                Source { kind: SourceKind::Impulse, input: None, states, values }.add_output(
                    &output_row,
                    direct,
                    equation_column,
                );
            }
            equation_column.iter_mut().zip(experiment.weights_of(i)).for_each(|(v, w)| *v *= w);
        }
        Ok(column)
    }
}

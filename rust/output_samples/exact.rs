//! Exact samples of models with integer orders at uniform sample times, from their state-space form.

use super::initial_terms::{fit_initial_terms, OutputSamples};
use super::richardson::Rows;
use super::simulation::{InitialTerms, OutputSimulation, Terms, ORDER_TOLERANCE};
use crate::equation::Equation;
use crate::error::{check_length, Result};
use crate::parallel::Stop;
use crate::recording::{Role, MIN_SIGNAL_PEAK};
use crate::state_space::{self, InputSignal};

impl OutputSimulation {
    /// Return exact samples of a model with integer orders. None if the model must be discretized by block pulses.
    ///
    /// Block pulses are needed for fractional orders or exponents, friction, non-linear terms, a sensor filter,
    /// nonuniform samples, free input parameters, and missing samples of inputs. They are also needed if the equations
    /// are singular or nearly singular.
    ///
    /// # Errors
    /// The errors of [`state_space::respond`], for invalid equations or samples. The errors of [`fit_initial_terms`],
    /// for initial terms that do not match the equations.
    ///
    /// ```
    /// use ftlm::equation::{Equation, Structure, Term};
    /// use ftlm::output_samples::{InitialTerms, OutputSimulation};
    /// use ftlm::recording::{Channel, Recording, Role};
    /// use ftlm::signal::block_pulse::Intersample;
    /// # fn main() -> ftlm::error::Result<()> {
    /// // D y = −y + u from y(0) = 0, and a step: 1 − e^−t.
    /// let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
    /// let plant = Equation::new(Structure { output: 0, order: 1.0, terms }, vec![-1.0, 1.0])?;
    /// let u = Channel::new("u", vec![1.0; 21], Role::Input(Intersample::Hold));
    /// let run = Recording::new("run", 0.1, None, vec![Channel::new("y", vec![0.0; 21], Role::Output), u], vec![0])?;
    /// let simulation = OutputSimulation::new(run.into(), vec![plant], Vec::new(), None)?;
    /// let rest = InitialTerms::Given(vec![Vec::new()]);
    /// let found = simulation.exact_samples(&rest, &ftlm::parallel::Stop::default())?;
    /// assert!(found.is_some_and(|found| (found.outputs[0][20] - (1.0 - (-2.0_f64).exp())).abs() < 1e-14));
    /// # Ok(())
    /// # }
    /// ```
    pub fn exact_samples(&self, initial: &InitialTerms, stop: &Stop) -> Result<Option<OutputSamples>> {
        let rest: Terms = vec![Vec::new(); self.equations.len()];
        let (exponent_list, units, has_level) = match initial {
            InitialTerms::Given(terms) => (terms, Vec::new(), false),
            InitialTerms::Fitted { exponents, has_level } => (&rest, self.unit_terms(exponents)?, *has_level),
            InitialTerms::UnitResponses { exponents } => (&rest, self.unit_terms(exponents)?, false),
        };
        check_length("initial terms", rest.len(), exponent_list.len())?;
        let exponents = exponent_list.iter().flatten().map(|term| term.0).chain(units.iter().map(|unit| unit.1));
        if !self.has_state_space() || !exponents.into_iter().all(|e| e >= 0.0 && is_integer(e)) {
            return Ok(None);
        }
        let Some(mut outputs) = self.respond(exponent_list, true, stop)? else { return Ok(None) };
        if (units.is_empty() && !has_level) || !outputs.iter().flatten().all(|v| v.is_finite()) {
            return Ok(Some(OutputSamples { outputs, initial: exponent_list.clone() }));
        }
        let unit = |&(equation, exponent): &(usize, f64)| {
            let mut terms = rest.clone();
            terms[equation].push((exponent, 1.0));
            self.respond(&terms, false, stop).transpose()
        };
        let Some(columns) = units.iter().map(unit).collect::<Option<Result<Vec<_>>>>().transpose()? else {
            return Ok(None);
        };
        if matches!(initial, InitialTerms::UnitResponses { .. }) {
            outputs.extend(columns.into_iter().flatten());
            return Ok(Some(OutputSamples { outputs, initial: rest }));
        }
        fit_initial_terms(&self.recording.compared_rows(1)?, outputs, &units, columns, has_level).map(Some)
    }

    fn has_state_space(&self) -> bool {
        let recording = &self.recording;
        let has_integer_orders =
            |e: &Equation| is_integer(e.structure.order) && e.structure.terms.iter().all(|term| is_integer(term.order));
        let has_uniform_samples =
            self.times.is_none() && !recording.has_nonuniform_samples() && recording.free_inputs.is_empty();
        let is_input_of_equation = |signal: usize| {
            let has_input = |e: &Equation| {
                e.structure.output != signal && e.structure.terms.iter().any(|term| term.signal == signal)
            };
            self.simulated_output(signal).is_none() && self.equations.iter().any(has_input)
        };
        let is_usable = |signal: usize| {
            let samples = recording.acting_samples(signal);
            let peak = samples.iter().fold(0.0, |peak: f64, v| peak.max(v.abs()));
            recording.channels()[signal].role != Role::Derived
                && (peak == 0.0 || peak >= MIN_SIGNAL_PEAK)
                && !(is_input_of_equation(signal) && samples.iter().any(|v| v.is_nan()))
        };
        self.is_linear()
            && recording.filter.is_none()
            && has_uniform_samples
            && self.equations.iter().all(has_integer_orders)
            && (0..recording.channels().len()).all(is_usable)
    }

    /// Return the samples of all outputs, with the inputs if `is_driven` and without inputs otherwise. None if there is
    /// no state-space form.
    fn respond(&self, terms: &Terms, is_driven: bool, stop: &Stop) -> Result<Option<Rows>> {
        let respond_equations = |equations: &[Equation], terms: &[Vec<(f64, f64)>]| {
            let (rows, step) = (self.recording.len(), self.recording.step());
            let is_output = |signal: usize| equations.iter().any(|e| e.structure.output == signal);
            let is_signal_of_term =
                |signal: usize| equations.iter().flat_map(|e| &e.structure.terms).any(|t| t.signal == signal);
            let signals =
                (0..self.recording.channels().len()).filter(|&s| is_driven && is_signal_of_term(s) && !is_output(s));
            let inputs: Vec<InputSignal> = signals.map(|signal| self.input(signal)).collect();
            let mut terms = terms.to_vec();
            terms.iter_mut().for_each(|equation_terms| equation_terms.sort_by(|a, b| a.0.total_cmp(&b.0)));
            let response = state_space::respond(equations, &inputs, &terms, step, rows, stop)?;
            Ok(response.map(|samples| samples.chunks(rows).map(<[f64]>::to_vec).collect::<Rows>()))
        };
        if self.recording.is_coupled {
            return respond_equations(&self.equations, terms);
        }
        let outputs = self.equations.iter().zip(terms).map(|(equation, terms)| {
            if !is_driven && terms.is_empty() {
                return Ok(Some(vec![vec![0.0; self.recording.len()]]));
            }
            respond_equations(std::slice::from_ref(equation), std::slice::from_ref(terms))
        });
        Ok(outputs.collect::<Result<Option<Vec<Rows>>>>()?.map(|rows| rows.concat()))
    }

    fn input(&self, signal: usize) -> InputSignal {
        let (channel, samples) = (&self.recording.channels()[signal], self.recording.acting_samples(signal));
        InputSignal {
            signal,
            intersample: channel.intersample(),
            delay: channel.lag() / self.recording.step(),
            before: self.recording.value_before(&samples),
            samples: samples.into_owned(),
        }
    }
}

/// True if an order is so close to an integer that differences of two such orders are integers within
/// [`ORDER_TOLERANCE`].
fn is_integer(order: f64) -> bool {
    (order - order.round()).abs() <= 0.5 * ORDER_TOLERANCE
}

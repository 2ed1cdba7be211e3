//! Output-error problem of equations with non-linear terms: residuals of all experiments and their derivatives.

use super::channels::{ForcingTerms, InputDerivative, SystemDerivatives};
use super::initial_state::{merge_powers, InitialTerm};
use super::input_continuation::InputContinuation;
use super::operators::Operators;
use super::sensitivity::{OutputDerivatives, SensitivityCache};
use super::system::NonlinearSystem;
use super::time_stepping::LinearizedRun;
use crate::equation::Equation;
use crate::error::{Error, Result};
use crate::estimation::output_error::{Experiment, FreeModel, Monomial};
use crate::expression::DerivedSignal;
use crate::friction::FrictionLaw;
use crate::parallel::Stop;
use crate::regressors::{add_impulses, split_impulses, Record};
use crate::signal::block_pulse::PulseJump;

/// Friction law with free coefficients. Each of its parameters is a multiple of one free coefficient, or constant.
#[derive(Debug, Clone, PartialEq)]
pub struct FreeFrictionLaw {
    /// Coulomb friction fc, in the unit of the highest derivative D^α y in the equation.
    pub coulomb: Monomial,
    /// Stribeck friction fs: excess of the static friction over fc.
    pub stribeck: Monomial,
    /// Stribeck velocity vs: speed at which the excess has fallen to fs/e.
    pub speed: Monomial,
}

impl FreeFrictionLaw {
    /// Return the law of Coulomb friction alone, whose friction force does not depend on speed.
    #[must_use]
    pub fn coulomb(coulomb: Monomial) -> Self {
        let constant = |factor: f64| Monomial { factor, powers: Vec::new() };
        Self { coulomb, stribeck: constant(0.0), speed: constant(1.0) }
    }

    fn monomials(&self) -> [&Monomial; 3] {
        [&self.coulomb, &self.stribeck, &self.speed]
    }

    /// Return the friction law at the given values of all free coefficients.
    pub(super) fn at(&self, coefficients: &[f64]) -> FrictionLaw {
        let [coulomb, stribeck, speed] = self.monomials().map(|monomial| monomial.at(coefficients));
        FrictionLaw { coulomb, stribeck, speed }
    }

    /// Return the derivatives of Coulomb friction, Stribeck friction and Stribeck velocity with respect to the free
    /// coefficient with index `coefficient`.
    pub(super) fn slope(&self, coefficients: &[f64], coefficient: usize) -> [f64; 3] {
        self.monomials().map(|monomial| monomial.slope(coefficients, coefficient))
    }

    /// True if a free coefficient scales the Coulomb or Stribeck friction of this law and must therefore not be
    /// negative.
    pub(super) fn is_force(&self, coefficient: usize) -> bool {
        [&self.coulomb, &self.stribeck].iter().any(|monomial| monomial.powers.iter().any(|&(i, _)| i == coefficient))
    }
}

/// Return a flag for each output: true if it passes the sensor filter before it is compared with the measurement. The
/// flags are those of the first experiment; the vector is empty without a filter.
#[must_use]
pub fn filtered_outputs(experiments: &[Experiment]) -> Vec<bool> {
    experiments.first().and_then(|e| e.filter.as_ref()).map_or_else(Vec::new, |(_, passes)| passes.clone())
}

/// Model with free parameters: equations with non-linear terms and dry friction.
#[derive(Debug, Clone, PartialEq)]
pub struct NonlinearModel {
    /// Equations, whose signals are the recorded ones, followed by the derived ones.
    pub model: FreeModel,
    /// Expressions of the derived signals, in the sequence of their signal indices.
    pub derived: Vec<DerivedSignal>,
    /// Index of each equation with dry friction, and the law F of the friction force −F(Dy) sgn(Dy) on its output y.
    pub frictions: Vec<(usize, FreeFrictionLaw)>,
    /// Flag of each output: true if it passes the sensor filter before it is compared with the measurement. All
    /// experiments must have the same flags. Empty without filters.
    pub filtered: Vec<bool>,
}

/// Step of the central differences for derivatives of initial terms, relative to max(1, |coefficient|) for a
/// coefficient and absolute for an order. Initial terms are smooth in orders and at most quadratic in coefficients.
const DIFFERENCE_STEP: f64 = 1e-5;

/// Number of first samples of a run from which the initial velocity is estimated.
const FIRST_SAMPLES: usize = 8;

/// Constant forces tried as initial guesses, relative to the breakaway force of each body. The position at which a body
/// comes to rest depends on the sign of the net force, which a local optimization does not change.
const INITIAL_FORCE_RATIOS: [f64; 2] = [0.5, -0.5];

/// Values of all free parameters.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Point {
    pub(super) orders: Vec<f64>,
    pub(super) coefficients: Vec<f64>,
    /// Values of the free input parameters: delays, saturation and dead-zone limits.
    pub(super) inputs: Vec<f64>,
    /// Initial states of each run.
    pub(super) states: Vec<Vec<f64>>,
}

impl Point {
    /// Value of the parameter with this index, in the order: orders, coefficients, input parameters; NaN if there is none.
    pub(super) fn value(&self, parameter: usize) -> f64 {
        let mut values = self.orders.iter().chain(&self.coefficients).chain(&self.inputs);
        values.nth(parameter).copied().unwrap_or(f64::NAN)
    }
}

/// Residuals with weights at a point, and intermediate results of each experiment from which their derivatives follow.
pub(super) struct Evaluation {
    pub(super) residuals: Vec<f64>,
    pub(super) size: f64,
    pub(super) parts: Vec<ExperimentLinearization>,
}

impl Evaluation {
    /// Evaluation of no experiment: no residuals.
    pub(super) fn empty() -> Self {
        Self { residuals: Vec::new(), size: 0.0, parts: Vec::new() }
    }
}

/// Parameter with respect to which a derivative is taken.
pub(super) enum Parameter {
    /// Index of a free order.
    Order(usize),
    /// Index of a free coefficient.
    Coefficient(usize),
    /// Index of the run, and index of the initial state in it.
    InitialTerm(usize, usize),
    /// Index of a free input parameter.
    Input(usize),
}

impl Parameter {
    /// Return all parameters at a point: orders, coefficients and input parameters if `with_parameters` is true,
    /// followed by the initial states of each run.
    pub(super) fn all(point: &Point, with_parameters: bool) -> Vec<Self> {
        let mut all = Vec::new();
        if with_parameters {
            all.extend((0..point.orders.len()).map(Self::Order));
            all.extend((0..point.coefficients.len()).map(Self::Coefficient));
            all.extend((0..point.inputs.len()).map(Self::Input));
        }
        let states = point.states.iter().enumerate();
        all.extend(states.flat_map(|(run, states)| (0..states.len()).map(move |state| Self::InitialTerm(run, state))));
        all
    }
}

/// Intermediate results of one experiment, from which the derivatives of its residuals follow.
pub(super) struct ExperimentLinearization {
    system: NonlinearSystem,
    record: Option<Record>,
    operators: Operators,
    run: LinearizedRun,
    /// Derivative of each input with respect to its free parameter.
    input_slopes: Vec<InputDerivative>,
}

impl NonlinearModel {
    fn system(&self, orders: &[f64], coefficients: &[f64], recorded: usize) -> NonlinearSystem {
        let terms = |k: usize| self.model.equations[k].terms.iter().map(|term| term.2.at(coefficients)).collect();
        let structures = self.model.structures(orders).into_iter().enumerate();
        NonlinearSystem {
            equations: structures.map(|(k, structure)| Equation { structure, coefficients: terms(k) }).collect(),
            derived: self.derived.clone(),
            recorded,
            coupled: self.model.coupled || !self.frictions.is_empty(),
            frictions: self.frictions.iter().map(|(equation, law)| (*equation, law.at(coefficients))).collect(),
        }
    }

    fn states(&self, orders: &[f64]) -> (Vec<InitialTerm>, Vec<Equation>) {
        let is_order_free = |i: usize, term: usize| {
            let alpha = &self.model.equations[i].order.weights;
            let term_weights = &self.model.equations[i].terms[term].1.weights;
            alpha.iter().zip(term_weights).any(|(a, w)| (a - w).abs() > 0.0)
        };
        let equations = self.system(orders, &vec![0.0; self.model.coordinates.len()], 0).equations;
        (InitialTerm::all(&equations, &self.model.initial, &self.filtered, is_order_free), equations)
    }

    /// Return the forcing of the state channels by the initial states of a run. The tuple holds the free orders, the
    /// free coefficients and the initial states.
    fn initial_forcing(
        &self,
        operators: &Operators,
        (orders, coefficients, values): (&[f64], &[f64], &[f64]),
    ) -> Result<ForcingTerms> {
        let (powers, _) = split_impulses(&self.powers(orders, coefficients, values));
        operators.initial_forcing(&self.system(orders, coefficients, usize::MAX), &powers)
    }

    /// Return the derivatives of the system of a run with respect to `parameter`.
    fn derivatives(
        &self,
        point: &Point,
        run: usize,
        part: &ExperimentLinearization,
        parameter: &Parameter,
    ) -> Result<SystemDerivatives> {
        let (values, equations) = (&point.states[run], &self.model.equations);
        let mut derivatives = SystemDerivatives {
            terms: equations.iter().map(|e| vec![(0.0, 0.0); e.terms.len() + 1]).collect(),
            forcing: ForcingTerms::default(),
            laws: Vec::new(),
            inputs: Vec::new(),
        };
        let difference = |perturbed: &dyn Fn(f64) -> (Vec<f64>, Vec<f64>), increment: f64| -> Result<ForcingTerms> {
            let forcing_at = |increment: f64| {
                let (orders, coefficients) = perturbed(increment);
                self.initial_forcing(&part.operators, (&orders, &coefficients, values))
            };
            let (mut forward, backward) = (forcing_at(increment)?, forcing_at(-increment)?);
            let slope = |forward: &mut f64, backward: f64| *forward = (*forward - backward) / (2.0 * increment);
            for (forward, backward) in forward.channels.iter_mut().zip(backward.channels) {
                forward.iter_mut().zip(backward).for_each(|(forward, backward)| slope(forward, backward));
            }
            for (forward, backward) in forward.initial_motion.iter_mut().zip(backward.initial_motion) {
                slope(&mut forward.0, backward.0);
                slope(&mut forward.1, backward.1);
            }
            Ok(forward)
        };
        let is_at_rest = values.iter().all(|x| *x == 0.0);
        match *parameter {
            Parameter::Order(j) => {
                let weight_of = |weights: &[f64]| weights.get(j).copied().unwrap_or(0.0);
                for (terms, equation) in derivatives.terms.iter_mut().zip(equations) {
                    let alpha = weight_of(&equation.order.weights);
                    let orders = equation.terms.iter().map(|t| alpha - weight_of(&t.1.weights)).chain([alpha]);
                    *terms = orders.map(|order| (0.0, order)).collect();
                }
                if !is_at_rest {
                    let shifted = |increment: f64| {
                        let mut orders = point.orders.clone();
                        orders[j] += increment;
                        (orders, point.coefficients.clone())
                    };
                    derivatives.forcing = difference(&shifted, DIFFERENCE_STEP)?;
                }
            }
            Parameter::Coefficient(j) => {
                for (terms, equation) in derivatives.terms.iter_mut().zip(equations) {
                    let coefficients = equation.terms.iter().map(|t| t.2.slope(&point.coefficients, j)).chain([0.0]);
                    *terms = coefficients.map(|coefficient| (coefficient, 0.0)).collect();
                }
                derivatives.laws = self.frictions.iter().map(|(_, law)| law.slope(&point.coefficients, j)).collect();
                if !is_at_rest {
                    let increment = DIFFERENCE_STEP * point.coefficients[j].abs().max(1.0);
                    let shifted = |increment: f64| {
                        let mut coefficients = point.coefficients.clone();
                        coefficients[j] += increment;
                        (point.orders.clone(), coefficients)
                    };
                    derivatives.forcing = difference(&shifted, increment)?;
                }
            }
            Parameter::InitialTerm(_, state) => {
                let unit: Vec<f64> = (0..values.len()).map(|k| if k == state { 1.0 } else { 0.0 }).collect();
                let perturbed = (point.orders.as_slice(), point.coefficients.as_slice(), unit.as_slice());
                derivatives.forcing = self.initial_forcing(&part.operators, perturbed)?;
            }
            Parameter::Input(k) => derivatives.inputs.push(part.input_slopes[k].clone()),
        }
        Ok(derivatives)
    }

    /// Apply saturations, dead zones and delays with the given parameters to the inputs. Return the resulting record,
    /// and the derivative of each input with respect to its parameter. The record is None without free input
    /// parameters.
    fn transform_inputs(
        &self,
        experiment: &Experiment,
        values: &[f64],
    ) -> Result<(Option<Record>, Vec<InputDerivative>)> {
        let record = &experiment.record;
        if self.model.inputs.is_empty() {
            return Ok((None, Vec::new()));
        }
        let mut signals: Vec<Vec<f64>> = (0..record.len()).map(|s| record.signal(s).to_vec()).collect();
        let mut jumps: Vec<Vec<PulseJump>> = (0..record.len()).map(|s| record.jumps(s).to_vec()).collect();
        let mut slopes = Vec::with_capacity(self.model.inputs.len());
        for (&input, &value) in self.model.inputs.iter().zip(values) {
            let signal = input.signal;
            let (means, slope) = self.model.apply_input_law(record, input, value)?;
            let mut slope = InputDerivative { signal, means: slope, jumps: Vec::new() };
            let is_hold = experiment.point_values.get(signal).is_some_and(|values| values.is_zero_order_hold);
            if is_hold && !self.frictions.is_empty() {
                (jumps[signal], slope.jumps) =
                    self.model.apply_input_law_to_jumps(record, input, value)?.into_iter().unzip();
            }
            signals[signal] = means;
            slopes.push(slope);
        }
        Ok((Some(Record::from_rows(record.step(), signals, None)?.with_jumps(jumps)?), slopes))
    }
}

impl NonlinearModel {
    /// Return an error for an inconsistent model, or for experiments that do not match it.
    ///
    /// # Errors
    /// [`Error::Length`] without experiments. [`Error::Structure`] for an index out of range, an invalid friction
    /// coefficient, nonuniform samples, or runs with different filters. A friction coefficient must be a non-negative
    /// multiple of one free coefficient. The errors of [`FreeModel::check`] occur as well.
    pub fn check(&self, experiments: &[Experiment]) -> Result<()> {
        let invalid = |what: &str, remedy: &str| Err(Error::Structure { what: what.into(), remedy: remedy.into() });
        let Some(recorded) = experiments.iter().map(|e| e.record.len()).min() else {
            return Err(Error::Length { name: "experiments".into(), expected: 1, found: 0 });
        };
        if self.derived.iter().flat_map(|d| &d.channels).any(|(signal, _)| *signal >= recorded) {
            return invalid(
                "an expression contains the number of a signal that does not exist",
                "count signals from 0",
            );
        }
        self.model.check_structure(recorded, self.derived.len())?;
        if self.frictions.iter().any(|friction| friction.0 >= self.model.equations.len()) {
            return invalid("friction is given for an equation that does not exist", "count equations from 0");
        }
        let has_valid_indices = |c: &Monomial| c.powers.iter().all(|&(i, _)| i < self.model.coordinates.len());
        let mut monomials = self.frictions.iter().flat_map(|(_, law)| law.monomials());
        if monomials.any(|n| !has_valid_indices(n) || n.powers.len() > 1 || n.factor < 0.0) {
            return invalid(
                "a friction coefficient is not a non-negative multiple of one free coefficient",
                "give one such factor",
            );
        }
        for experiment in experiments {
            self.model.check_experiment(experiment)?;
            if experiment.nonuniform.is_some() {
                let terms = if self.derived.is_empty() { "friction" } else { "non-linear terms" };
                return invalid(&format!("{terms} with samples at nonuniform times"), "resample the runs");
            }
            let applies_filter = experiment.filter.as_ref().map_or(&[][..], |(_, applies)| applies);
            if applies_filter != self.filtered {
                return invalid("experiments whose outputs pass different filters", "give all runs the same filter");
            }
        }
        self.model.initial.check()
    }

    /// True if a free coefficient scales a friction force and must therefore not be negative.
    pub(super) fn is_nonnegative(&self, coefficient: usize) -> bool {
        self.frictions.iter().any(|(_, law)| law.is_force(coefficient))
    }

    /// True if the cost has kinks, so that its gradient need not vanish at a minimum. With friction, the pulse in which
    /// a body stops or reverses changes with the parameters.
    pub(super) fn has_kinks(&self) -> bool {
        !self.frictions.is_empty()
    }

    /// Return an error if an equation is invalid at these free orders.
    pub(super) fn check_orders(&self, orders: &[f64]) -> Result<()> {
        let system = self.system(orders, &vec![0.0; self.model.coordinates.len()], usize::MAX);
        system.equations.iter().try_for_each(|e| e.structure.check(usize::MAX, |_| true))
    }

    /// Return initial guesses of the states of a run from its first samples. Each guess holds all states of the run.
    pub(super) fn state_guesses(&self, orders: &[f64], coefficients: &[f64], experiment: &Experiment) -> Vec<Vec<f64>> {
        let frictions = self.system(orders, coefficients, usize::MAX).frictions;
        state_guesses(&self.states(orders), &frictions, experiment)
    }

    /// Return the number of initial states of each run.
    pub(super) fn state_count(&self, orders: &[f64]) -> usize {
        self.states(orders).0.len()
    }

    /// Return the powers of t in the output of each equation for the initial states `values`, as (exponent,
    /// coefficient).
    pub(super) fn powers(&self, orders: &[f64], coefficients: &[f64], values: &[f64]) -> Vec<Vec<(f64, f64)>> {
        let system = self.system(orders, coefficients, usize::MAX);
        let links = system.links();
        let (states, _) = self.states(orders);
        let parts = states.iter().zip(values).flat_map(|(state, &x)| {
            state.powers(&system.equations, &links).into_iter().map(move |(i, e, c)| (i, e, x * c))
        });
        merge_powers(system.equations.len(), parts)
    }

    /// Return the weighted residuals of all experiments at a point. Return an error if a simulation overflows or has no
    /// solution, or after a stop request.
    pub(super) fn evaluate(&self, experiments: &[Experiment], point: &Point, stop: &Stop) -> Result<Evaluation> {
        let mut out = Evaluation::empty();
        for (experiment, values) in experiments.iter().zip(&point.states) {
            stop.check()?;
            let (transformed_record, input_slopes) = self.transform_inputs(experiment, &point.inputs)?;
            let record = transformed_record.as_ref().unwrap_or(&experiment.record);
            let system = self.system(&point.orders, &point.coefficients, record.len());
            // The optimizer shortens its step after this error.
            system.check().map_err(|error| Error::NotSimulable { reason: error.to_string() })?;
            let operators = Operators::new(&system, record)?;
            let mut forcing = self.initial_forcing(&operators, (&point.orders, &point.coefficients, values))?;
            operators.add_inputs(&system, record, &mut forcing);
            // With friction, the body's own reversals limit the order of convergence.
            let continuation =
                if self.frictions.is_empty() { InputContinuation::new(experiment, record) } else { None };
            let (run, end) = operators.run(&system, &forcing, continuation);
            if let Some(end) = end {
                return Err(end.error(record.step()));
            }
            let mut residuals = experiment.measured_samples();
            out.size = out.size.hypot(residuals.iter().map(|v| v * v).sum::<f64>().sqrt());
            let mut outputs = run.sources[..system.equations.len()].to_vec();
            let powers = self.powers(&point.orders, &point.coefficients, values);
            let (_, impulses) = split_impulses(&powers);
            add_impulses(&mut outputs, &impulses, record.step());
            let sampled = experiment.weighted_samples(&outputs);
            residuals.iter_mut().zip(sampled).for_each(|(e, v)| *e -= v);
            let levels = powers.iter().map(|terms| terms.iter().filter(|(e, _)| e.is_infinite()).map(|(_, v)| v).sum());
            let levels = weighted_levels(experiment, &levels.collect::<Vec<f64>>());
            residuals.iter_mut().zip(levels).for_each(|(e, v)| *e -= v);
            if run.continuation.is_some() {
                let corrections = run.sample_corrections(outputs.len(), experiment.compared_count());
                let corrections = experiment.weighted_corrections(&corrections);
                residuals.iter_mut().zip(corrections).for_each(|(e, v)| *e -= v);
            }
            if let Some(index) = residuals.iter().position(|e| !e.is_finite()) {
                return Err(Error::Diverged { what: "simulation".into(), index });
            }
            out.residuals.extend(residuals);
            out.parts.push(ExperimentLinearization {
                system,
                record: transformed_record,
                operators,
                run,
                input_slopes,
            });
        }
        Ok(out)
    }

    /// Return the derivatives of the weighted residuals, one vector for each parameter of [`Parameter::all`] with the
    /// same `with_parameters`.
    pub(super) fn jacobian(
        &self,
        experiments: &[Experiment],
        point: &Point,
        evaluation: &Evaluation,
        with_parameters: bool,
        stop: &Stop,
    ) -> Result<Vec<Vec<f64>>> {
        let all = Parameter::all(point, with_parameters);
        let states = self.states(&point.orders).0;
        let mut columns = vec![Vec::with_capacity(evaluation.residuals.len()); all.len()];
        for (index, (experiment, part)) in experiments.iter().zip(&evaluation.parts).enumerate() {
            let record = part.record.as_ref().unwrap_or(&experiment.record);
            let mut cache = SensitivityCache::new(&part.operators, &part.run);
            for (column, parameter) in columns.iter_mut().zip(&all) {
                if matches!(parameter, Parameter::InitialTerm(run, _) if *run != index) {
                    column.extend(std::iter::repeat_n(0.0, self.model.equations.len() * experiment.compared_count()));
                    continue;
                }
                stop.check()?;
                if let Parameter::InitialTerm(_, state) = parameter
                    && let Some(InitialTerm::OutputLevel(output)) = states.get(*state)
                {
                    let mut unit = vec![0.0; self.model.equations.len()];
                    unit[*output] = 1.0;
                    column.extend(weighted_levels(experiment, &unit).into_iter().map(|v| -v));
                    continue;
                }
                let slopes = match parameter {
                    // If an order has fallen below an integer, there are fewer initial terms than at the initial guess.
                    Parameter::InitialTerm(_, state) if *state >= states.len() => {
                        OutputDerivatives::of_means(vec![vec![0.0; record.m()]; self.model.equations.len()])
                    }
                    Parameter::InitialTerm(_, state) if states[*state].is_impulse() => {
                        // The transient of a filter does not enter the equations.
                        let mut slopes = vec![vec![0.0; record.m()]; self.model.equations.len()];
                        let mut impulses = vec![Vec::new(); self.model.equations.len()];
                        if let InitialTerm::Power(i, e) = states[*state] {
                            impulses[i].push((e, 1.0));
                        }
                        add_impulses(&mut slopes, &impulses, record.step());
                        OutputDerivatives::of_means(slopes)
                    }
                    _ => {
                        let derivatives = self.derivatives(point, index, part, parameter)?;
                        part.operators.sensitivity(&part.system, record, &part.run, &mut cache, &derivatives)?
                    }
                };
                // Residuals are measurement minus response.
                let mut samples = experiment.weighted_samples(&slopes.means);
                if part.run.continuation.is_some() {
                    let corrections = slopes.sample_corrections(experiment.compared_count());
                    let corrections = experiment.weighted_corrections(&corrections);
                    samples.iter_mut().zip(corrections).for_each(|(v, correction)| *v += correction);
                }
                column.extend(samples.into_iter().map(|v| -v));
            }
        }
        if columns.iter().flatten().any(|v| !v.is_finite()) {
            return Err(Error::Diverged { what: "sensitivity of the simulation".into(), index: 0 });
        }
        Ok(columns)
    }
}

/// Return the levels of the outputs at all compared samples, multiplied by the weights, with all outputs concatenated.
fn weighted_levels(experiment: &Experiment, levels: &[f64]) -> Vec<f64> {
    levels.iter().enumerate().flat_map(|(i, level)| experiment.weights_of(i).map(move |w| w * level)).collect()
}

/// Return guesses of the initial states from the first samples of a run. Every guess holds the initial positions and
/// velocities of the outputs. Further guesses add a constant force of half the breakaway force on one body, in either
/// direction. All other states are 0.
fn state_guesses(
    (states, equations): &(Vec<InitialTerm>, Vec<Equation>),
    frictions: &[(usize, FrictionLaw)],
    experiment: &Experiment,
) -> Vec<Vec<f64>> {
    let initial_motions: Vec<(f64, f64)> =
        experiment.samples.iter().map(|samples| initial_motion(samples, experiment)).collect();
    let with_force = |body: usize, force: f64| -> Vec<f64> {
        let value = |state: &InitialTerm| match *state {
            InitialTerm::Level(i) => initial_motions[i].0,
            InitialTerm::Rate(i) => initial_motions[i].1,
            InitialTerm::Offset(i, 0) if i == body => force / libm::tgamma(equations[i].structure.order + 1.0),
            _ => 0.0,
        };
        states.iter().map(value).collect()
    };
    let mut guesses = vec![with_force(0, 0.0)];
    for ratio in INITIAL_FORCE_RATIOS {
        for &(body, law) in frictions {
            let guess = with_force(body, ratio * law.breakaway());
            if guess != guesses[0] {
                guesses.push(guess);
            }
        }
    }
    guesses
}

/// Return the initial position and velocity of an output by linear regression over its first samples.
fn initial_motion(samples: &[f64], experiment: &Experiment) -> (f64, f64) {
    let first_samples = &samples[..samples.len().min(FIRST_SAMPLES)];
    #[allow(clippy::cast_precision_loss)]
    let (count, step) = (first_samples.len() as f64, experiment.record.step() * experiment.pulses_per_sample as f64);
    let middle = 0.5 * (count - 1.0);
    let mean = first_samples.iter().sum::<f64>() / count.max(1.0);
    #[allow(clippy::cast_precision_loss)]
    let (mut covariance, mut time_variance) = (0.0, 0.0);
    for (k, value) in first_samples.iter().enumerate() {
        #[allow(clippy::cast_precision_loss)]
        let x = k as f64 - middle;
        covariance += x * (value - mean);
        time_variance += x * x;
    }
    let rate = if time_variance > 0.0 { covariance / time_variance / step } else { 0.0 };
    (mean - rate * middle * step, rate)
}

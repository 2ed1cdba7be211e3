//! Output-error fit of systems with non-linear terms or friction, by the Levenberg–Marquardt method.
//!
//! Orders, coefficients, input parameters, and the initial states of each run are optimized together.

use super::model::{Evaluation, NonlinearModel, Point};
use crate::error::{check_finite, check_length, Error, Result};
use crate::estimation::optimization::damped_step::LeastSquaresProblem;
use crate::estimation::optimization::levenberg_marquardt::{minimize, MinimizationSettings, Status};
use crate::estimation::optimization::prior::minimize_with_priors;
use crate::estimation::output_error::Experiment;
use crate::linalg::orthogonal::extend_orthonormal;
use crate::parallel::Stop;

/// Initial guess of a fit.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct InitialGuess {
    /// Values of the free orders.
    pub orders: Vec<f64>,
    /// Values of the free coefficients.
    pub coefficients: Vec<f64>,
    /// Values of the free input parameters: delays, saturation and dead-zone limits.
    pub inputs: Vec<f64>,
    /// Initial states of each run. They are estimated at the initial guess if their number is not that of the model.
    pub states: Vec<Vec<f64>>,
}

/// Optimum of a fit and its diagnostics.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct NonlinearFit {
    /// Values of the free orders.
    pub orders: Vec<f64>,
    /// Values of the free coefficients.
    pub coefficients: Vec<f64>,
    /// Values of the free input parameters: delays, saturation and dead-zone limits.
    pub inputs: Vec<f64>,
    /// Initial states of each run.
    pub states: Vec<Vec<f64>>,
    /// Powers of t that the initial states add to the outputs, as (exponent, coefficient), by run and equation.
    pub initial: Vec<Vec<Vec<(f64, f64)>>>,
    /// Half the weighted sum of squared residuals.
    pub cost: f64,
    /// Residuals with weights, run after run, then one residual (mean − value)/deviation of each prior.
    pub residuals: Vec<f64>,
    /// Derivatives of the residuals with respect to orders, coefficients and input parameters, one vector each. The
    /// span of the derivatives with respect to the initial states is projected out.
    pub jacobian: Vec<Vec<f64>>,
    /// Orthonormal basis of the derivatives with respect to the initial states of all runs.
    pub state_responses: Vec<Vec<f64>>,
    /// Number of residual evaluations.
    pub evaluations: usize,
    /// Termination status.
    pub status: Status,
}

struct OutputError<'a> {
    model: &'a NonlinearModel,
    experiments: &'a [Experiment],
    stop: &'a Stop,
}

impl LeastSquaresProblem for OutputError<'_> {
    type Point = Point;
    type Evaluation = Evaluation;

    fn evaluate(&self, point: &Point) -> Result<Evaluation> {
        self.model.evaluate(self.experiments, point, self.stop)
    }

    fn residuals<'a>(&self, evaluation: &'a Evaluation) -> &'a [f64] {
        &evaluation.residuals
    }

    fn jacobian(&self, point: &Point, evaluation: &Evaluation) -> Result<Vec<Vec<f64>>> {
        self.model.jacobian(self.experiments, point, evaluation, true, self.stop)
    }

    fn apply_step(&self, point: &Point, steps: &[f64]) -> (Point, f64) {
        let mut next = point.clone();
        let mut largest_change: f64 = 0.0;
        let (orders, rest) = steps.split_at(point.orders.len());
        let (coefficients, rest) = rest.split_at(point.coefficients.len());
        let (inputs, mut states) = rest.split_at(point.inputs.len());
        for ((order, &(low, high)), step) in next.orders.iter_mut().zip(&self.model.model.order_bounds).zip(orders) {
            let before = *order;
            *order = (before + step).clamp(low, high);
            largest_change = largest_change.max((*order - before).abs());
        }
        let relative_change = |before: f64, after: f64| (after - before).abs() / before.abs().max(f64::MIN_POSITIVE);
        for (j, (value, step)) in next.coefficients.iter_mut().zip(coefficients).enumerate() {
            let before = *value;
            *value = self.model.model.coordinates[j].shift(before, *step);
            if self.model.is_nonnegative(j) {
                *value = value.max(0.0);
            }
            largest_change = largest_change.max(relative_change(before, *value));
        }
        for ((value, input), step) in next.inputs.iter_mut().zip(&self.model.model.inputs).zip(inputs) {
            let (before, (low, high)) = (*value, input.bounds);
            *value = (before + step).clamp(low, high);
            largest_change = largest_change.max((*value - before).abs() / (high - low).max(f64::MIN_POSITIVE));
        }
        for run in &mut next.states {
            let (run_steps, remaining_steps) = states.split_at(run.len());
            states = remaining_steps;
            for (value, step) in run.iter_mut().zip(run_steps) {
                largest_change = largest_change.max(relative_change(*value, *value + step));
                *value += step;
            }
        }
        (next, largest_change)
    }

    fn coordinate_derivative(&self, point: &Point, parameter: usize) -> f64 {
        parameter
            .checked_sub(point.orders.len())
            .filter(|j| *j < point.coefficients.len())
            .map_or(1.0, |j| self.model.model.coordinates[j].derivative(point.coefficients[j]))
    }

    /// Return the distances of a parameter from its lower and upper bound, infinite without a bound. Orders, input
    /// parameters and friction forces have bounds.
    fn distance_to_bounds(&self, point: &Point, parameter: usize) -> (f64, f64) {
        if let Some(order) = point.orders.get(parameter) {
            let (low, high) = self.model.model.order_bounds[parameter];
            return (order - low, high - order);
        }
        let j = parameter - point.orders.len();
        let input = j.checked_sub(point.coefficients.len());
        if let Some((value, free)) = input.and_then(|i| point.inputs.get(i).zip(self.model.model.inputs.get(i))) {
            return (value - free.bounds.0, free.bounds.1 - value);
        }
        let is_linear = self.model.model.coordinates.get(j).is_some_and(|c| c.derivative(2.0) == 1.0);
        if is_linear && self.model.is_nonnegative(j) {
            return (point.coefficients[j], f64::INFINITY);
        }
        (f64::INFINITY, f64::INFINITY)
    }

    fn has_kinks(&self, _point: &Point, _parameter: usize) -> bool {
        self.model.has_kinks()
    }

    fn signal_norm(&self, evaluation: &Evaluation) -> f64 {
        evaluation.size
    }
}

/// Least-squares problem for the initial state of one run, with all other parameters fixed.
struct InitialStateProblem<'a> {
    model: &'a NonlinearModel,
    experiment: &'a Experiment,
    orders: &'a [f64],
    coefficients: &'a [f64],
    inputs: &'a [f64],
    stop: &'a Stop,
}

impl InitialStateProblem<'_> {
    fn at(&self, states: &[f64]) -> Point {
        Point {
            orders: self.orders.to_vec(),
            coefficients: self.coefficients.to_vec(),
            inputs: self.inputs.to_vec(),
            states: vec![states.to_vec()],
        }
    }
}

impl LeastSquaresProblem for InitialStateProblem<'_> {
    type Point = Vec<f64>;
    type Evaluation = Evaluation;

    fn evaluate(&self, states: &Vec<f64>) -> Result<Evaluation> {
        self.model.evaluate(std::slice::from_ref(self.experiment), &self.at(states), self.stop)
    }

    fn residuals<'a>(&self, evaluation: &'a Evaluation) -> &'a [f64] {
        &evaluation.residuals
    }

    fn jacobian(&self, states: &Vec<f64>, evaluation: &Evaluation) -> Result<Vec<Vec<f64>>> {
        self.model.jacobian(std::slice::from_ref(self.experiment), &self.at(states), evaluation, false, self.stop)
    }

    fn apply_step(&self, states: &Vec<f64>, steps: &[f64]) -> (Vec<f64>, f64) {
        let next: Vec<f64> = states.iter().zip(steps).map(|(x, step)| x + step).collect();
        let relative_change = |(x, step): (&f64, &f64)| step.abs() / x.abs().max(f64::MIN_POSITIVE);
        (next, states.iter().zip(steps).map(relative_change).fold(0.0, f64::max))
    }

    fn has_kinks(&self, _states: &Vec<f64>, _parameter: usize) -> bool {
        self.model.has_kinks()
    }

    fn signal_norm(&self, evaluation: &Evaluation) -> f64 {
        evaluation.size
    }
}

/// Termination criteria of the estimation of an initial state.
const INITIAL_STATE_SETTINGS: MinimizationSettings = MinimizationSettings { evaluations: 30, tolerance: 1e-6 };

/// Fractions of a run, from its first sample on, to which the initial state is fitted one after another before the
/// whole run.
///
/// Over a long run, the cost has local minima in the initial state. They have a wrong phase, or a wrong number of
/// oscillations before a body sticks. Over the first fraction, the cost has one minimum.
const FIT_FRACTIONS: [f64; 3] = [0.125, 0.25, 0.5];

/// Estimate the initial state of a run, with all other parameters fixed.
///
/// Local optimizations start from guesses based on the first samples. A further optimization starts from a state that
/// is fitted to the first eighth of the run, then to the first quarter, then to the first half. The best result is
/// returned, or the first guess if all optimizations fail.
fn estimate_initial_state(
    model: &NonlinearModel,
    (orders, coefficients, inputs): (&[f64], &[f64], &[f64]),
    experiment: &Experiment,
    stop: &Stop,
) -> Result<Vec<f64>> {
    let problem = InitialStateProblem { model, experiment, orders, coefficients, inputs, stop };
    let mut guesses = model.state_guesses(orders, coefficients, experiment);
    let Some(first) = guesses.first().cloned().filter(|guess| !guess.is_empty()) else { return Ok(Vec::new()) };
    let mut extended_guess = first.clone();
    for fraction in FIT_FRACTIONS {
        let beginning =
            experiment.clone().with_weights(&experiment.weights, Some(&beginning_weights(experiment, fraction)))?;
        let beginning_problem = InitialStateProblem { experiment: &beginning, ..problem };
        match minimize(&beginning_problem, extended_guess.clone(), INITIAL_STATE_SETTINGS) {
            Ok(optimum) => extended_guess = optimum.point,
            Err(Error::Interrupted) => return Err(Error::Interrupted),
            _ => {}
        }
    }
    guesses.push(extended_guess);
    let mut best = (f64::INFINITY, first);
    for guess in guesses {
        match minimize(&problem, guess, INITIAL_STATE_SETTINGS) {
            Ok(optimum) if optimum.cost < best.0 => best = (optimum.cost, optimum.point),
            Err(Error::Interrupted) => return Err(Error::Interrupted),
            // An initial guess whose simulation fails is skipped.
            _ => {}
        }
    }
    Ok(best.1)
}

/// Return the weight of each compared sample of each output: 1 in the first fraction `fraction` of the run, 0 after it.
#[allow(clippy::cast_precision_loss)]
fn beginning_weights(experiment: &Experiment, fraction: f64) -> Vec<Vec<f64>> {
    let count = experiment.compared_count();
    let weight = |k: usize| if (k as f64) < fraction * count as f64 { 1.0 } else { 0.0 };
    vec![(0..count).map(weight).collect(); experiment.samples.len()]
}

/// Fit the parameters by weighted least squares of the output error, from an initial guess.
///
/// # Errors
/// [`Error::Diverged`] or [`Error::NoSolution`] if the simulation of the initial guess fails. [`Error::Length`] or
/// [`Error::NotFinite`] for an initial guess of the wrong length or with a value that is not finite. The errors of
/// [`NonlinearModel::check`] for an inconsistent model. [`Error::Interrupted`] after a stop request.
pub fn fit(
    model: &NonlinearModel,
    experiments: &[Experiment],
    start: &InitialGuess,
    settings: MinimizationSettings,
    stop: &Stop,
) -> Result<NonlinearFit> {
    model.check(experiments)?;
    check_length("orders", model.model.order_bounds.len(), start.orders.len())?;
    check_length("coefficients", model.model.coordinates.len(), start.coefficients.len())?;
    check_finite("orders of the initial guess", &start.orders)?;
    check_finite("coefficients of the initial guess", &start.coefficients)?;
    check_length("inputs", model.model.inputs.len(), start.inputs.len())?;
    check_finite("inputs of the initial guess", &start.inputs)?;
    let orders: Vec<f64> =
        start.orders.iter().zip(&model.model.order_bounds).map(|(o, &(low, high))| o.clamp(low, high)).collect();
    model.check_orders(&orders)?;
    let mut coefficients = start.coefficients.clone();
    for (_, value) in coefficients.iter_mut().enumerate().filter(|(j, _)| model.is_nonnegative(*j)) {
        *value = value.max(0.0);
    }
    let inputs: Vec<f64> =
        start.inputs.iter().zip(&model.model.inputs).map(|(v, i)| v.clamp(i.bounds.0, i.bounds.1)).collect();
    let count = model.state_count(&orders);
    let mut states = start.states.clone();
    if states.len() != experiments.len() || states.iter().any(|s| s.len() != count) {
        states = experiments
            .iter()
            .map(|e| estimate_initial_state(model, (&orders, &coefficients, &inputs), e, stop))
            .collect::<Result<_>>()?;
    }
    for values in &states {
        check_finite("states of the initial guess", values)?;
    }
    let problem = OutputError { model, experiments, stop };
    let start = Point { orders, coefficients, inputs, states };
    let (optimum, residuals) = minimize_with_priors(&problem, &model.model.priors, Point::value, start, settings)?;
    let parameter_count = optimum.point.orders.len() + optimum.point.coefficients.len() + optimum.point.inputs.len();
    let mut basis = Vec::new();
    for column in optimum.jacobian.iter().skip(parameter_count) {
        extend_orthonormal(&mut basis, column.clone(), DEPENDENCE_TOLERANCE);
    }
    let mut jacobian = optimum.jacobian;
    jacobian.truncate(parameter_count);
    for column in &mut jacobian {
        for direction in &basis {
            let component: f64 = direction.iter().zip(column.iter()).map(|(q, v)| q * v).sum();
            column.iter_mut().zip(direction).for_each(|(v, q)| *v -= component * q);
        }
    }
    let Point { orders, coefficients, inputs, states } = optimum.point;
    Ok(NonlinearFit {
        initial: states.iter().map(|values| model.powers(&orders, &coefficients, values)).collect(),
        orders,
        coefficients,
        inputs,
        states,
        cost: optimum.cost,
        residuals,
        jacobian,
        state_responses: basis,
        evaluations: optimum.evaluations,
        status: optimum.status,
    })
}

/// Distance of the response to an initial state from the span of the previous responses, at or below which this
/// response counts as linearly dependent. The distance is relative to the norm of the response.
const DEPENDENCE_TOLERANCE: f64 = 1e-12;

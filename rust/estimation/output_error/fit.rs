//! Output-error fit of a model to experiments from an initial guess.

use std::cell::RefCell;

use super::evaluation::Evaluation;
use super::evaluation_cache::EvaluationCache;
use super::experiment::Experiment;
use super::fractional_orders::{FractionalOrders, SampledSimulation};
use super::integer_orders::{ExactSimulation, IntegerOrders};
use super::parameterization::{Coordinate, FreeInput, FreeModel, ParameterPoint, TimeUnit};
use super::residuals::Linearization;
use crate::error::{check_finite, check_length, Error, Result};
use crate::estimation::optimization::damped_step::LeastSquaresProblem;
use crate::estimation::optimization::levenberg_marquardt::{MinimizationSettings, Status};
use crate::estimation::optimization::prior::minimize_with_priors;
use crate::parallel::Stop;

/// Optimum of an output-error fit.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct OutputErrorFit {
    /// Free orders, coefficients and input parameters.
    pub point: ParameterPoint,
    /// Half the weighted sum of squared residuals.
    pub cost: f64,
    /// Residuals (y − ŷ)/σ with measured y, simulated ŷ and noise deviation σ, ordered by record, output and sample.
    /// One residual (mean − value)/deviation of each prior follows.
    pub residuals: Vec<f64>,
    /// Derivatives of the residuals, one row per order, coefficient (in plain coordinates) and input parameter.
    ///
    /// The initial terms are projected out. Empty if only residuals were requested.
    pub jacobian: Vec<Vec<f64>>,
    /// Coefficients of the initial terms, by record and equation.
    pub initial: Vec<Vec<Vec<f64>>>,
    /// Exponents of the initial terms, by equation.
    pub exponents: Vec<Vec<f64>>,
    /// Orthonormal basis of the weighted responses to the initial terms, by record. It is computed only if at most one
    /// evaluation was allowed, and is otherwise empty.
    pub initial_responses: Vec<Vec<Vec<f64>>>,
    /// Number of residual evaluations.
    pub evaluations: usize,
    /// Reason for termination.
    pub status: Status,
}

/// Simulation method: block pulses, exact states for integer orders, or exact transforms for other orders.
enum Simulation<'a> {
    Pulses(Evaluation<Linearization>),
    Exact(Evaluation<ExactSimulation<'a>>),
    Sampled(Evaluation<SampledSimulation>),
}

impl Simulation<'_> {
    fn point(&self) -> &ParameterPoint {
        match self {
            Self::Pulses(evaluation) => &evaluation.point,
            Self::Exact(evaluation) => &evaluation.point,
            Self::Sampled(evaluation) => &evaluation.point,
        }
    }

    fn measured_norm(&self) -> f64 {
        match self {
            Self::Pulses(evaluation) => evaluation.measured_norm,
            Self::Exact(evaluation) => evaluation.measured_norm,
            Self::Sampled(evaluation) => evaluation.measured_norm,
        }
    }

    fn residuals(&self) -> &[f64] {
        match self {
            Self::Pulses(evaluation) => &evaluation.residuals,
            Self::Exact(evaluation) => &evaluation.residuals,
            Self::Sampled(evaluation) => &evaluation.residuals,
        }
    }

    /// Orthonormal basis of the weighted responses to the initial terms, by record.
    fn initial_responses(&self) -> Vec<Vec<Vec<f64>>> {
        match self {
            Self::Pulses(evaluation) => evaluation.parts.iter().map(|part| part.basis.clone()).collect(),
            Self::Exact(evaluation) => evaluation.parts.iter().map(|part| part.basis().to_vec()).collect(),
            Self::Sampled(evaluation) => evaluation.parts.iter().map(|part| part.basis.clone()).collect(),
        }
    }

    /// Coefficients of the initial terms by record and equation, and their exponents by equation.
    fn initial_terms(&self) -> (&[Vec<Vec<f64>>], &[Vec<f64>]) {
        match self {
            Self::Pulses(evaluation) => (&evaluation.initial, &evaluation.exponents),
            Self::Exact(evaluation) => (&evaluation.initial, &evaluation.exponents),
            Self::Sampled(evaluation) => (&evaluation.initial, &evaluation.exponents),
        }
    }
}

/// Nonlinear least-squares problem of the output error of a model.
struct OutputErrorProblem<'a> {
    model: &'a FreeModel,
    experiments: &'a [Experiment],
    /// Initial coefficients in the scaled unit of time.
    start: Vec<f64>,
    /// The scaled unit of time, in which steps of the coefficients are relative.
    time_unit: TimeUnit,
    /// True if a stable model must not become unstable.
    requires_stability: bool,
    /// True to allow extrapolation along valleys, which requires plain coordinates of all coefficients.
    allows_extrapolation: bool,
    /// Indices of the coefficients that are eliminated at every point.
    linear: Vec<usize>,
    /// Exact simulation if all orders are integers, else None.
    exact: Option<IntegerOrders>,
    /// Exact simulation of other orders on long records; None if it is not possible.
    sampled: Option<FractionalOrders>,
    /// True if the result of the fit contains the responses to the initial terms.
    returns_initial_responses: bool,
    /// Caches of the evaluations, by experiment.
    caches: RefCell<Vec<EvaluationCache>>,
    /// Cancellation flag.
    stop: &'a Stop,
}

impl<'a> LeastSquaresProblem for OutputErrorProblem<'a> {
    type Point = ParameterPoint;
    type Evaluation = Simulation<'a>;

    fn evaluate(&self, point: &ParameterPoint) -> Result<Simulation<'a>> {
        self.stop.check()?;
        if let Some(exact) = &self.exact {
            return exact.evaluate(self.model, self.experiments, point, &self.linear).map(Simulation::Exact);
        }
        if let Some(sampled) = &self.sampled {
            return sampled.evaluate(self.model, self.experiments, point, &self.linear).map(Simulation::Sampled);
        }
        let (linear, caches) = (&self.linear, &mut self.caches.borrow_mut());
        self.model.evaluate(self.experiments, caches, point, linear).map(Simulation::Pulses)
    }

    fn point_of_evaluation(&self, evaluation: &Simulation<'a>, _point: ParameterPoint) -> ParameterPoint {
        evaluation.point().clone()
    }

    fn is_eliminated(&self, parameter: usize) -> bool {
        parameter.checked_sub(self.model.order_bounds.len()).is_some_and(|c| self.linear.contains(&c))
    }

    fn residuals<'e>(&self, evaluation: &'e Simulation<'a>) -> &'e [f64] {
        evaluation.residuals()
    }

    fn jacobian(&self, _point: &ParameterPoint, evaluation: &Simulation<'a>) -> Result<Vec<Vec<f64>>> {
        self.stop.check()?;
        match evaluation {
            Simulation::Exact(evaluation) => match &self.exact {
                Some(exact) => exact.jacobian(self.model, self.experiments, &self.linear, evaluation),
                None => Err(Error::Internal { what: "exact samples of a model with non-integer orders".into() }),
            },
            Simulation::Sampled(evaluation) => match &self.sampled {
                Some(sampled) => sampled.jacobian(self.model, self.experiments, &self.linear, evaluation),
                None => Err(Error::Internal { what: "samples without their transforms".into() }),
            },
            Simulation::Pulses(evaluation) => {
                self.model.jacobian(self.experiments, &mut self.caches.borrow_mut(), &self.linear, evaluation)
            }
        }
    }

    fn release(&self, evaluation: &mut Simulation<'a>) {
        match evaluation {
            _ if self.returns_initial_responses => {}
            Simulation::Exact(evaluation) => evaluation.parts.clear(),
            Simulation::Sampled(evaluation) => evaluation.parts.clear(),
            Simulation::Pulses(evaluation) => evaluation.parts.clear(),
        }
    }

    fn apply_step(&self, point: &ParameterPoint, steps: &[f64]) -> (ParameterPoint, f64) {
        step_within_bounds(self.model, &self.time_unit, point, steps)
    }

    fn coordinate_derivative(&self, point: &ParameterPoint, parameter: usize) -> f64 {
        parameter.checked_sub(point.orders.len()).filter(|j| *j < point.coefficients.len()).map_or(1.0, |j| {
            let factor = self.time_unit.factor(j, &point.orders);
            self.model.coordinates[j].derivative(factor * point.coefficients[j]) / factor
        })
    }

    /// Derivatives of the coefficients with respect to an order, if the coefficients in the scaled unit of time are
    /// held constant.
    fn coupled_derivatives(&self, point: &ParameterPoint, parameter: usize) -> Vec<(usize, f64)> {
        if parameter >= point.orders.len() {
            return Vec::new();
        }
        (point.coefficients.iter().enumerate())
            .map(|(j, c)| (point.orders.len() + j, -c * self.time_unit.relative_decrease(j, parameter)))
            .filter(|(_, slope)| *slope != 0.0)
            .collect()
    }

    /// Distance of a parameter from its bounds. A coefficient is bounded only if it must keep its sign.
    fn distance_to_bounds(&self, point: &ParameterPoint, parameter: usize) -> (f64, f64) {
        let first_input = point.orders.len() + point.coefficients.len();
        let (value, (low, high)) = match (point.orders.get(parameter), parameter.checked_sub(first_input)) {
            (Some(order), _) => (*order, self.model.order_bounds[parameter]),
            (None, Some(input)) => (point.inputs[input], self.model.inputs[input].bounds),
            (None, None) => {
                let j = parameter - point.orders.len();
                let value = self.time_unit.factor(j, &point.orders) * point.coefficients[j];
                let lower_distance = self.model.coordinates[j].distance_to_bound(value, self.start[j]);
                return (lower_distance, f64::INFINITY);
            }
        };
        (value - low, high - value)
    }

    /// Return true for input parameters, because the response is piecewise linear in delays, saturations and dead
    /// zones.
    fn has_kinks(&self, point: &ParameterPoint, parameter: usize) -> bool {
        parameter >= point.orders.len() + point.coefficients.len()
    }

    fn signal_norm(&self, evaluation: &Simulation<'a>) -> f64 {
        evaluation.measured_norm()
    }

    /// Return true if the pulses or samples resolve the dynamics of each equation and, if required, the model is
    /// stable.
    ///
    /// Unresolved modes would fit noise.
    fn is_admissible(&self, point: &ParameterPoint) -> bool {
        let is_resolved = match &self.exact {
            Some(exact) => exact.is_resolved(self.model, self.experiments, point),
            None => self.model.is_resolved(self.experiments, point),
        };
        is_resolved && !(self.requires_stability && self.model.is_unstable(point))
    }

    fn allows_extrapolation(&self) -> bool {
        self.allows_extrapolation
    }

    fn starts_near_optimum(&self) -> bool {
        self.allows_extrapolation
    }
}

/// Move a point by steps in its coordinates, within bounds. Return the new point and the largest change of a parameter.
///
/// Changes of orders are absolute. Changes of coefficients are relative in the scaled unit of time. Changes of input
/// parameters are relative to the interval between their bounds.
fn step_within_bounds(
    model: &FreeModel,
    time_unit: &TimeUnit,
    point: &ParameterPoint,
    deltas: &[f64],
) -> (ParameterPoint, f64) {
    let mut next_point = point.clone();
    let mut change: f64 = 0.0;
    let (orders, rest) = deltas.split_at(point.orders.len());
    let (coefficients, inputs) = rest.split_at(point.coefficients.len());
    for ((order, &(low, high)), delta) in next_point.orders.iter_mut().zip(&model.order_bounds).zip(orders) {
        let previous = *order;
        *order = (previous + delta).clamp(low, high);
        change = change.max((*order - previous).abs());
    }
    for (j, (&coordinate, &delta)) in model.coordinates.iter().zip(coefficients).enumerate() {
        let previous = time_unit.factor(j, &point.orders) * point.coefficients[j];
        let value = coordinate.shift(previous, delta);
        next_point.coefficients[j] = value / time_unit.factor(j, &next_point.orders);
        change = change.max((value - previous).abs() / previous.abs().max(f64::MIN_POSITIVE));
    }
    for ((value, FreeInput { bounds: (low, high), .. }), delta) in
        next_point.inputs.iter_mut().zip(&model.inputs).zip(inputs)
    {
        let previous = *value;
        *value = (previous + delta).clamp(*low, *high);
        change = change.max((*value - previous).abs() / (high - low).max(f64::MIN_POSITIVE));
    }
    (next_point, change)
}

/// Fit a model to experiments by output error from an initial guess, by Levenberg–Marquardt.
///
/// The coefficients of external inputs are eliminated at every point, so their initial values and signs do not matter.
/// If at most one evaluation is allowed, the initial guess is evaluated as given.
///
/// # Errors
/// [`Error::Diverged`] if the simulation of the initial guess is not finite. [`Error::OutOfRange`] if the initial guess
/// is out of the range of its coordinates. An error if the model does not match the experiments ([`FreeModel::check`]).
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::equation::{AffineOrder, Initial};
/// use ftlm::estimation::output_error::*;
/// use ftlm::signal::block_pulse::point_samples;
/// use ftlm::regressors::Record;
/// // D^a y = c u with the truth a = 0.8, c = 3.
/// let input: Vec<f64> = (0..100).map(|k| if k % 40 < 20 { 1.0 } else { -1.0 }).collect();
/// let run = Record::new(0.05, PulseMeans::from_signals(vec![vec![0.0; 100], input]), None)?;
/// let output: Vec<f64> = run.integral(1, 0.8).iter().map(|v| 3.0 * v).collect();
/// let experiment = Experiment::new(run, 1, vec![point_samples(&output)], vec![1.0])?;
/// let model = FreeModel {
///     equations: vec![FreeEquation {
///         output: 0,
///         order: AffineOrder { constant: 0.0, weights: vec![1.0] },
///         terms: vec![(
///             1,
///             AffineOrder { constant: 0.0, weights: vec![0.0] },
///             Monomial { factor: 1.0, powers: vec![(0, 1)] },
///         )],
///     }],
///     order_bounds: vec![(0.1, 2.0)],
///     coordinates: vec![Coordinate::Logarithm],
///     inputs: vec![],
///     coupled: false,
///     priors: Vec::new(),
///     initial: Initial::Rest,
/// };
/// let start = ParameterPoint { orders: vec![1.0], coefficients: vec![1.0], inputs: vec![] };
/// let found = fit(&model, &[experiment], &start, MinimizationSettings::default())?;
/// assert!((found.point.orders[0] - 0.8).abs() < 1e-6 && (found.point.coefficients[0] - 3.0).abs() < 1e-6);
/// # Ok(())
/// # }
/// ```
pub fn fit(
    model: &FreeModel,
    experiments: &[Experiment],
    start: &ParameterPoint,
    settings: MinimizationSettings,
) -> Result<OutputErrorFit> {
    fit_until(model, experiments, start, settings, false, &Stop::default())
}

/// Fit a model as [`fit`] does, but never step from a stable model to an unstable one.
///
/// Free initial terms can cancel an unstable mode up to the end of the run. The response then depends on future inputs.
/// The stability of coupled equations is not checked.
///
/// # Errors
/// [`Error::Diverged`] if the simulation of the initial guess is not finite. [`Error::OutOfRange`] if the initial guess
/// is out of the range of its coordinates. An error if the model does not match the experiments ([`FreeModel::check`]).
pub fn fit_stable(
    model: &FreeModel,
    experiments: &[Experiment],
    start: &ParameterPoint,
    settings: MinimizationSettings,
) -> Result<OutputErrorFit> {
    fit_until(model, experiments, start, settings, true, &Stop::default())
}

/// Fit a model as [`fit`] does, or as [`fit_stable`] if `requires_stability` is true, with a cancellation flag.
///
/// # Errors
/// [`Error::Diverged`] if the simulation of the initial guess is not finite. [`Error::OutOfRange`] if the initial guess
/// is out of the range of its coordinates. An error if the model does not match the experiments ([`FreeModel::check`]).
/// [`Error::Interrupted`] after a stop request.
pub fn fit_until(
    model: &FreeModel,
    experiments: &[Experiment],
    start: &ParameterPoint,
    settings: MinimizationSettings,
    requires_stability: bool,
    stop: &Stop,
) -> Result<OutputErrorFit> {
    check_length("orders", model.order_bounds.len(), start.orders.len())?;
    check_length("coefficients", model.coordinates.len(), start.coefficients.len())?;
    check_length("inputs", model.inputs.len(), start.inputs.len())?;
    model.check(experiments)?;
    check_start(model, start)?;
    let mut point = start.clone();
    point.orders.iter_mut().zip(&model.order_bounds).for_each(|(o, &(low, high))| *o = o.clamp(low, high));
    point.inputs.iter_mut().zip(&model.inputs).for_each(|(t, d)| *t = t.clamp(d.bounds.0, d.bounds.1));
    // If at most one evaluation is allowed, no coefficient is eliminated.
    let mut linear = if settings.evaluations > 1 { model.linear_coefficients() } else { Vec::new() };
    // Variable projection would ignore a prior.
    linear.retain(|&coefficient| !model.has_prior(coefficient));
    let allows_extrapolation =
        !model.coordinates.iter().any(|c| matches!(c, Coordinate::Logarithm | Coordinate::ExcessLogarithm));
    let mut model = model.clone();
    // Logarithmic coordinates are not needed for eliminated coefficients.
    linear.iter().for_each(|&j| model.coordinates[j] = Coordinate::Plain);
    // With free input parameters, the inputs of the equations are not signals of the record and cannot be filtered
    // before.
    let prefiltered: Option<Vec<Experiment>> = match settings.evaluations > 1 && model.inputs.is_empty() {
        true => experiments.iter().map(Experiment::prefilter_signals).collect::<Result<_>>()?,
        false => None,
    };
    let experiments = prefiltered.as_deref().unwrap_or(experiments);
    let exact = IntegerOrders::new(&model, experiments, &point);
    let sampled = if exact.is_some() { None } else { FractionalOrders::new(&model, experiments, &point) };
    let needs_pulses = exact.is_none() && sampled.is_none();
    let caches =
        RefCell::new(if needs_pulses { EvaluationCache::for_experiments(experiments, stop)? } else { Vec::new() });
    let time_unit = TimeUnit::from_experiments(&model, experiments);
    let start = (point.coefficients.iter().enumerate()).map(|(j, c)| time_unit.factor(j, &point.orders) * c).collect();
    let returns_initial_responses = settings.evaluations <= 1;
    let problem = OutputErrorProblem {
        model: &model,
        experiments,
        start,
        time_unit,
        requires_stability,
        allows_extrapolation,
        linear,
        exact,
        sampled,
        returns_initial_responses,
        caches,
        stop,
    };
    let (optimum, residuals) = minimize_with_priors(&problem, &model.priors, ParameterPoint::value, point, settings)?;
    Ok(OutputErrorFit {
        point: optimum.point,
        cost: optimum.cost,
        residuals,
        jacobian: optimum.jacobian,
        initial: optimum.evaluation.initial_terms().0.to_vec(),
        exponents: optimum.evaluation.initial_terms().1.to_vec(),
        initial_responses: if returns_initial_responses { optimum.evaluation.initial_responses() } else { Vec::new() },
        evaluations: optimum.evaluations,
        status: optimum.status,
    })
}

/// Check that an initial guess is finite and in the range of its coordinates.
///
/// [`Error::OutOfRange`] or [`Error::NotFinite`] if it is not.
fn check_start(model: &FreeModel, start: &ParameterPoint) -> Result<()> {
    for (i, (&c, coordinate)) in start.coefficients.iter().zip(&model.coordinates).enumerate() {
        if !coordinate.contains(c) {
            return Err(Error::OutOfRange {
                name: format!("initial guess of coefficient {i}"),
                value: c,
                range: "its coordinate".into(),
                remedy:
                    "give a coefficient with logarithmic coordinate a value other than 0, and a ratio a value above 1"
                        .into(),
            });
        }
    }
    check_finite("orders of the initial guess", &start.orders)?;
    match start.inputs.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(index) => Err(Error::OutOfRange {
            name: format!("initial guess of the delay or limit of input {index}"),
            value: start.inputs[index],
            range: "numbers within its bounds".into(),
            remedy: "give each delay and limit a finite initial guess".into(),
        }),
    }
}

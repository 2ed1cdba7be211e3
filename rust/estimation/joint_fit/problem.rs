//! Problem of a joint fit: iterates, optimization, candidates and feasible steps.
//!
//! Equations may have friction and nonlinear terms.

use crate::equation::AffineOrder;
use crate::error::{check_length, Error, Result};
use crate::estimation::output_error::{
    fit_until, Coordinate, Experiment, FreeModel, MinimizationSettings, Monomial, ParameterPoint, Status,
};
use crate::expression::DerivedSignal;
use crate::linalg::dense;
use crate::nonlinear::{self, FreeFrictionLaw, InitialGuess, NonlinearModel};
use crate::parallel::Stop;
use crate::signal::statistics::inner;

/// Optimization problem: parameterized equations and their friction laws.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// Names of the outputs, one per equation, for messages.
    pub outputs: Vec<String>,
    /// Equations and coordinates of the optimization.
    pub model: FreeModel,
    /// Friction laws, each with the index of its equation.
    pub frictions: Vec<(usize, FreeFrictionLaw)>,
    /// Expressions that are the signals of nonlinear terms. They are numbered after the recorded signals.
    pub derived: Vec<DerivedSignal>,
}

impl Problem {
    /// Return a problem in the coordinates of the model.
    ///
    /// Stribeck velocities are positive, so their coordinates are logarithms.
    ///
    /// # Errors
    /// [`Error::Length`] if `outputs` does not have one name per equation. [`Error::Structure`] for an unknown
    /// coefficient or equation, and for crossed bounds. Also the errors of an invalid order ([`AffineOrder::check`]).
    pub fn new(outputs: Vec<String>, mut model: FreeModel, frictions: Vec<(usize, FreeFrictionLaw)>) -> Result<Self> {
        check_length("outputs", model.equations.len(), outputs.len())?;
        let coefficients = model.coordinates.len();
        let structure_error = |what: String, remedy: &str| Err(Error::Structure { what, remedy: remedy.into() });
        let has_missing_coefficient = |monomial: &Monomial| monomial.powers.iter().any(|&(i, _)| i >= coefficients);
        for equation in &model.equations {
            equation.order.check(&model.order_bounds)?;
            for (_, order, coefficient) in &equation.terms {
                order.check(&model.order_bounds)?;
                if has_missing_coefficient(coefficient) {
                    return structure_error(
                        "an equation refers to a coefficient that does not exist".into(),
                        "number them from 0",
                    );
                }
            }
        }
        for (equation, law) in &frictions {
            if *equation >= model.equations.len()
                || [&law.coulomb, &law.stribeck, &law.speed].into_iter().any(has_missing_coefficient)
            {
                let what =
                    format!("friction of equation {equation} refers to an equation or signal that does not exist");
                return structure_error(what, "number equations and coefficients from 0");
            }
        }
        let bounds = model.order_bounds.iter().copied().chain(model.inputs.iter().map(|input| input.bounds));
        if let Some((low, high)) = bounds.into_iter().find(|(low, high)| low.is_nan() || high.is_nan() || low > high) {
            return structure_error(format!("bounds {low} to {high}"), "give two increasing numbers");
        }
        for (_, law) in &frictions {
            law.speed.powers.iter().for_each(|&(j, _)| model.coordinates[j] = Coordinate::Logarithm);
        }
        Ok(Self { outputs, model, frictions, derived: Vec::new() })
    }

    /// Return the problem with derived signals, which are numbered after the recorded ones.
    #[must_use]
    pub fn with_derived(self, derived: Vec<DerivedSignal>) -> Self {
        Self { derived, ..self }
    }

    /// Return true if the simulation is linear in the coefficients of inputs and in the initial terms.
    ///
    /// This is the case without friction and without nonlinear terms.
    #[must_use]
    pub fn is_linear(&self) -> bool {
        self.frictions.is_empty() && self.derived.is_empty()
    }

    /// Number of free orders, coefficients and input parameters.
    #[must_use]
    pub fn size(&self) -> usize {
        self.model.order_bounds.len() + self.model.coordinates.len() + self.model.inputs.len()
    }

    /// Convert the values of all free parameters (orders, coefficients, input parameters) to a point.
    ///
    /// # Errors
    /// [`Error::Length`] for a number of values that differs from the number of free parameters.
    pub fn point(&self, values: &[f64]) -> Result<ParameterPoint> {
        check_length("values of the free parameters", self.size(), values.len())?;
        let (orders, rest) = values.split_at(self.model.order_bounds.len());
        let (coefficients, inputs) = rest.split_at(self.model.coordinates.len());
        Ok(ParameterPoint { orders: orders.into(), coefficients: coefficients.into(), inputs: inputs.into() })
    }

    /// Lower and upper bound of each free parameter.
    ///
    /// Friction must dissipate energy, so its coefficients have lower bounds. Other coefficients are unbounded.
    #[must_use]
    pub fn bounds(&self) -> Vec<(f64, f64)> {
        let mut coefficients = vec![(f64::NEG_INFINITY, f64::INFINITY); self.model.coordinates.len()];
        for (_, law) in &self.frictions {
            for &(j, _) in law.coulomb.powers.iter().chain(&law.stribeck.powers) {
                coefficients[j].0 = 0.0;
            }
        }
        for (_, law) in &self.frictions {
            law.speed.powers.iter().for_each(|&(j, _)| coefficients[j].0 = f64::MIN_POSITIVE);
        }
        let input_bounds = self.model.inputs.iter().map(|input| input.bounds);
        self.model.order_bounds.iter().copied().chain(coefficients).chain(input_bounds).collect()
    }

    /// Return true if an equation is unstable at a point and has free initial terms.
    ///
    /// These terms may cancel the unstable mode.
    #[must_use]
    pub fn is_unstable(&self, point: &ParameterPoint) -> bool {
        self.is_linear() && !self.model.initial.is_at_rest() && self.model.is_unstable(point)
    }

    /// Minimize the cost by the Levenberg–Marquardt method.
    ///
    /// If `requires_stability` is true, no step leads from a stable linear model to an unstable one.
    ///
    /// # Errors
    /// The error of the simulation of `start` if it fails. An error if the model does not match the experiments
    /// ([`fit_until`]; with friction or nonlinear terms [`nonlinear::fit`]). [`Error::Interrupted`] after a stop
    /// request.
    pub fn minimize(
        &self,
        experiments: &[Experiment],
        start: &Iterate,
        settings: MinimizationSettings,
        requires_stability: bool,
        stop: &Stop,
    ) -> Result<OptimizationResult> {
        if self.is_linear() {
            let optimum = fit_until(&self.model, experiments, &start.point, settings, requires_stability, stop)?;
            return Ok(OptimizationResult {
                iterate: Iterate { point: optimum.point, states: Vec::new() },
                cost: optimum.cost,
                residual_count: optimum.residuals.len(),
                residuals: optimum.residuals,
                jacobian: optimum.jacobian,
                initial: optimum.initial,
                initial_responses: optimum.initial_responses,
                evaluations: optimum.evaluations,
                status: optimum.status,
            });
        }
        let filtered = nonlinear::filtered_outputs(experiments);
        let Iterate { point: ParameterPoint { orders, coefficients, inputs }, states } = start.clone();
        let start = InitialGuess { orders, coefficients, inputs, states };
        let (model, derived, frictions) = (self.model.clone(), self.derived.clone(), self.frictions.clone());
        let model = NonlinearModel { model, derived, frictions, filtered };
        let optimum = nonlinear::fit(&model, experiments, &start, settings, stop)?;
        let basis = if settings.evaluations > 1 { &[][..] } else { &optimum.state_responses };
        let point =
            ParameterPoint { orders: optimum.orders, coefficients: optimum.coefficients, inputs: optimum.inputs };
        Ok(OptimizationResult {
            initial: optimum.states.iter().map(|states| vec![states.clone()]).collect(),
            initial_responses: responses_by_run(experiments, basis),
            iterate: Iterate { point, states: optimum.states },
            cost: optimum.cost,
            residual_count: optimum.residuals.len(),
            residuals: optimum.residuals,
            jacobian: optimum.jacobian,
            evaluations: optimum.evaluations,
            status: optimum.status,
        })
    }
}

/// Return the vectors of an orthonormal basis of responses to initial states by run, each over the residuals of its
/// run. A response to an initial state is 0 in all other runs.
fn responses_by_run(experiments: &[Experiment], basis: &[Vec<f64>]) -> Vec<Vec<Vec<f64>>> {
    let mut start = 0;
    let run_responses = |experiment: &Experiment| {
        let range = start..start + experiment.samples.len() * experiment.compared_count();
        start = range.end;
        let part = basis.iter().map(|response| response[range.clone()].to_vec());
        part.filter(|part| part.iter().any(|v| *v != 0.0)).collect()
    };
    experiments.iter().map(run_responses).collect()
}

/// Iterate of an optimization: parameters and initial states.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Iterate {
    /// Free orders, coefficients and input parameters.
    pub point: ParameterPoint,
    /// Initial states of each run if there is friction or a nonlinear term; empty if unknown.
    pub states: Vec<Vec<f64>>,
}

/// Result of an optimization.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct OptimizationResult {
    /// Final iterate.
    pub iterate: Iterate,
    /// Half the weighted sum of squared residuals.
    pub cost: f64,
    /// Number of residuals.
    pub residual_count: usize,
    /// The weighted residuals, ordered by run, then by output, then by sample. They are empty after
    /// [`Self::without_residuals`].
    pub residuals: Vec<f64>,
    /// Derivatives of the residuals, one row per parameter; empty if only residuals were requested, and after
    /// [`Self::without_residuals`].
    pub jacobian: Vec<Vec<f64>>,
    /// Coefficients of the initial terms by run and equation. With friction or nonlinear terms, initial states by run.
    pub initial: Vec<Vec<Vec<f64>>>,
    /// Orthonormal basis of the weighted responses to the initial terms, by run. It is computed only if at most one
    /// evaluation was allowed, and is otherwise empty.
    pub initial_responses: Vec<Vec<Vec<f64>>>,
    /// Number of residual evaluations.
    pub evaluations: usize,
    /// Reason for termination.
    pub status: Status,
}

impl OptimizationResult {
    /// Result before any optimization: infinite cost and no residuals.
    #[must_use]
    pub fn initial_result(iterate: Iterate) -> Self {
        let (cost, evaluations, status) = (f64::INFINITY, 0, Status::Exhausted);
        let (residuals, jacobian) = (Vec::new(), Vec::new());
        let (initial, initial_responses) = (Vec::new(), Vec::new());
        let residual_count = 0;
        Self { iterate, cost, residual_count, residuals, jacobian, initial, initial_responses, evaluations, status }
    }

    /// Return the result without residuals and Jacobian, which take most of the memory of a long record.
    #[must_use]
    pub fn without_residuals(self) -> Self {
        Self { residuals: Vec::new(), jacobian: Vec::new(), initial_responses: Vec::new(), ..self }
    }

    /// Mean square of the weighted residuals: about 1 if the weights match the noise and the model is complete.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn cost_per_residual(&self) -> f64 {
        2.0 * self.cost / self.residual_count as f64
    }

    /// Return true if the gradient vanished, except for components that point out of an active bound.
    ///
    /// An optimization that stopped at the limit of its domain has not converged.
    #[must_use]
    pub fn has_converged(&self) -> bool {
        self.status == Status::Converged
    }

    /// Values of all free parameters: orders, coefficients, input parameters.
    #[must_use]
    pub fn values(&self) -> Vec<f64> {
        let ParameterPoint { orders, coefficients, inputs } = &self.iterate.point;
        [orders.as_slice(), coefficients, inputs].concat()
    }

    /// Return the iterate with other parameter values and the same states.
    #[must_use]
    pub fn iterate_at(&self, values: &[f64]) -> Iterate {
        let point = &self.iterate.point;
        let (orders, rest) = values.split_at(point.orders.len());
        let (coefficients, inputs) = rest.split_at(point.coefficients.len());
        let point = ParameterPoint { orders: orders.into(), coefficients: coefficients.into(), inputs: inputs.into() };
        Iterate { point, states: self.iterate.states.clone() }
    }
}

/// Minimum difference between the highest order of an equation and the orders of its autoregressive terms.
const MIN_INTEGRATION_ORDER: f64 = 1e-3;
/// Rounding error of the difference of two orders, each rounded to 1e-9.
///
/// The order of an input term may equal the highest order of its equation within this tolerance.
const ORDER_ROUNDING_TOLERANCE: f64 = 2e-9;
/// Relative singular value below which the normal of a constraint counts as linearly dependent on the others.
const DIRECTION_RANK_TOLERANCE: f64 = 1e-9;

/// Affine constraint a·x + b ≥ m on the parameters x, with normal a, offset b and margin m.
struct Constraint {
    normal: Vec<f64>,
    offset: f64,
    margin: f64,
}

impl Problem {
    /// Move from the feasible point `start` toward `target` and return the last feasible point.
    ///
    /// The move ends at a bound or a constraint of the orders. The direction `target − start` is first projected on the
    /// constraints that are active at `start`, so the path may leave the straight line. All constraints are affine, so
    /// the result is exact.
    ///
    /// # Errors
    /// [`Error::Length`] for a number of values that differs from the number of free parameters.
    pub fn last_feasible_point(&self, start: &[f64], target: &[f64]) -> Result<Vec<f64>> {
        check_length("point to start from", self.size(), start.len())?;
        check_length("point to move towards", self.size(), target.len())?;
        let constraints = self.constraints();
        let distances: Vec<f64> = (constraints.iter())
            .map(|c| {
                let distances = inner(&c.normal, start) + c.offset;
                // A point that is within the margin keeps its distance from the constraint.
                (distances - c.margin.min(distances)).max(0.0)
            })
            .collect();
        let mut step: Vec<f64> = target.iter().zip(start).map(|(b, a)| b - a).collect();
        let mut active = vec![false; constraints.len()];
        loop {
            let is_blocking = |i: usize| {
                distances[i] <= ORDER_ROUNDING_TOLERANCE && inner(&constraints[i].normal, &step) < -1e-15 && !active[i]
            };
            let newly_active: Vec<usize> = (0..constraints.len()).filter(|&i| is_blocking(i)).collect();
            if newly_active.is_empty() {
                break;
            }
            newly_active.iter().for_each(|&i| active[i] = true);
            let active_constraints = constraints.iter().zip(&active).filter(|(_, active)| **active);
            let normals: Vec<Vec<f64>> = active_constraints.map(|(c, _)| c.normal.clone()).collect();
            let dense::SingularValues { left: basis, values: singular_values, .. } =
                dense::singular_values(&normals)
                    .ok_or_else(|| Error::Internal { what: "constraints of orders without a basis".into() })?;
            let full_step = step.clone();
            for (direction, _) in basis
                .iter()
                .zip(&singular_values)
                .filter(|(_, size)| **size > DIRECTION_RANK_TOLERANCE * singular_values[0])
            {
                let component = inner(direction, &full_step);
                step.iter_mut().zip(direction).for_each(|(s, d)| *s -= component * d);
            }
        }
        let mut fraction: f64 = 1.0;
        for (i, constraint) in constraints.iter().enumerate().filter(|(i, _)| !active[*i]) {
            let change = inner(&constraint.normal, &step);
            if change < 0.0 && distances[i] + change < 0.0 {
                fraction = fraction.min(distances[i] / -change);
            }
        }
        Ok(start.iter().zip(&step).map(|(a, s)| a + fraction * s).collect())
    }

    /// Highest order of a derivative of a signal in the expressions of the nonlinear terms; 0 if it has none.
    fn highest_derivative(&self, signal: usize) -> f64 {
        let channels = self.derived.iter().flat_map(|derived| &derived.channels);
        channels.filter(|channel| channel.0 == signal).fold(0.0, |highest, channel| channel.1.max(highest))
    }

    fn constraints(&self) -> Vec<Constraint> {
        let size = self.size();
        let normal_vector = |weights: &dyn Fn(usize) -> f64| (0..size).map(weights).collect::<Vec<_>>();
        let order_weight = |order: &AffineOrder, k: usize| order.weights.get(k).copied().unwrap_or(0.0);
        let mut constraints = Vec::new();
        for (i, (low, high)) in self.bounds().into_iter().enumerate() {
            let unit_normal = |sign: f64| normal_vector(&|k| if k == i { sign } else { 0.0 });
            if low.is_finite() {
                constraints.push(Constraint { normal: unit_normal(1.0), offset: -low, margin: 0.0 });
            }
            if high.is_finite() {
                constraints.push(Constraint { normal: unit_normal(-1.0), offset: high, margin: 0.0 });
            }
        }
        for equation in &self.model.equations {
            let derivative = self.highest_derivative(equation.output);
            for (signal, order, _) in &equation.terms {
                let is_autoregressive = *signal == equation.output;
                // Derivatives of an output in expressions are integrals of all terms except those of the output itself.
                let derivative_order = if is_autoregressive { 0.0 } else { derivative };
                constraints.push(Constraint {
                    normal: normal_vector(&|k| order_weight(&equation.order, k) - order_weight(order, k)),
                    offset: equation.order.constant - order.constant - derivative_order,
                    margin: if is_autoregressive { MIN_INTEGRATION_ORDER } else { ORDER_ROUNDING_TOLERANCE },
                });
                if is_autoregressive {
                    constraints.push(Constraint {
                        normal: normal_vector(&|k| order_weight(order, k)),
                        offset: order.constant,
                        margin: 0.0,
                    });
                }
            }
        }
        constraints.retain(|c| c.normal.iter().any(|v| *v != 0.0));
        constraints
    }
}

/// Candidate of the multistart: optimization result, description of its origin, and origins of merged duplicates.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Current optimization result.
    pub result: OptimizationResult,
    /// Description of its initial guess.
    pub origin: String,
    /// Origins of merged duplicates.
    pub duplicates: Vec<String>,
    /// Cost before the last optimization; infinite if there was none.
    pub cost_before: f64,
}

impl Candidate {
    /// Candidate before its first optimization.
    #[must_use]
    pub fn at(iterate: Iterate, origin: impl Into<String>) -> Self {
        let result = OptimizationResult::initial_result(iterate);
        Self { result, origin: origin.into(), duplicates: Vec::new(), cost_before: f64::INFINITY }
    }

    /// Return the candidate with a new optimization result.
    #[must_use]
    pub fn with_result(&self, result: OptimizationResult) -> Self {
        Self { result, cost_before: self.result.cost, ..self.clone() }
    }

    /// Mean square of the weighted residuals.
    #[must_use]
    pub fn cost_per_residual(&self) -> f64 {
        self.result.cost_per_residual()
    }
}

//! Nonlinear least squares with bounds by the Levenberg–Marquardt method.
//!
//! The columns of the Jacobian J are scaled to unit norm. A step follows from a QR factorization of [J | e], with the
//! residuals e and with the rows of the damping appended. A rejected step requires no Jacobian. The problem defines the
//! coordinates and bounds of its parameters. Parameters at an active bound are excluded from step and gradient. Under
//! linear inequality constraints, a step solves the damped linear problem within them.
//!
//! If Gauss–Newton predicts the decrease of the cost poorly, secant updates of the second-order part are used. Along an
//! ill-conditioned valley, several steps are extrapolated.
//!
//! Convergence means a vanishing gradient. The measure is the cosine between the residuals and every free column, as in
//! Dennis & Schnabel (doi:10.1137/1.9781611971200, §7.2) and MINPACK.

pub use super::damped_step::LeastSquaresProblem;

use super::damped_step::{Curvature, LinearizedProblem, ValleyExtrapolation, MIN_DAMPING};
use crate::error::{check_length, Error, Result};

/// Damping of the first step: close to Gauss–Newton, but safe for an initial guess that is off by some tens of percent.
const INITIAL_DAMPING: f64 = 1e-3;
/// Damping of the first step near an optimum: almost Gauss–Newton.
const INITIAL_DAMPING_NEAR_OPTIMUM: f64 = 1e-6;
/// Damping above which a step is at rounding level, so that the minimization terminates.
const MAX_DAMPING: f64 = 1e12;
/// Factor by which an accurately predicted step decreases the damping and a rejected step increases it.
const DAMPING_FACTOR: f64 = 10.0;
/// Ratio of actual to predicted decrease of the cost above which the damping is decreased.
const ACCEPTABLE_GAIN_RATIO: f64 = 0.25;
/// Rounding error of the residuals relative to the norm of the signals.
///
/// The convergence test uses it if no step decreases the cost.
const RELATIVE_ROUNDING_ERROR: f64 = 1e-10;

/// Reason for termination.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The gradient is zero up to rounding, except at active bounds.
    Converged,
    /// The budget of evaluations is exhausted.
    Exhausted,
    /// No step decreases the cost although the gradient is not zero.
    Stalled,
    /// The descent direction leaves the domain of the problem: the cost is not finite or the point is not admissible.
    DomainLimit,
}

/// Termination criteria.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MinimizationSettings {
    /// Maximum number of residual evaluations. With 0, only the residuals of the initial guess are computed.
    pub evaluations: usize,
    /// Relative decrease of the cost by a Gauss–Newton step below which the minimization has converged.
    ///
    /// It is the square of the cosine between the residuals and a column of the Jacobian.
    pub tolerance: f64,
}

impl Default for MinimizationSettings {
    fn default() -> Self {
        Self { evaluations: 100, tolerance: 1e-10 }
    }
}

/// Result of a minimization.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Minimum<P, E> {
    /// Best point.
    pub point: P,
    /// Evaluation of the best point.
    pub evaluation: E,
    /// Half the sum of squared residuals.
    pub cost: f64,
    /// Derivatives of the residuals, one vector per parameter; empty if only residuals were requested.
    pub jacobian: Vec<Vec<f64>>,
    /// Number of residual evaluations.
    pub evaluations: usize,
    /// Reason for termination.
    pub status: Status,
}

/// Half the sum of squared residuals.
fn cost(residuals: &[f64]) -> f64 {
    0.5 * residuals.iter().map(|e| e * e).sum::<f64>()
}

/// Minimize half the sum of squared residuals from an initial guess.
///
/// A step costs O(k² N) for k parameters and N residuals, in addition to the evaluations.
///
/// # Errors
/// The error of the evaluation of the initial guess. [`Error::Length`] for a column of the Jacobian that does not match
/// the residuals. At later points, any error that does not end the simulation.
///
/// ```
/// use ftlm::error::Result;
/// use ftlm::estimation::optimization::levenberg_marquardt::{minimize, MinimizationSettings};
/// use ftlm::estimation::optimization::damped_step::LeastSquaresProblem;
///
/// /// x² − 2.
/// struct Root;
///
/// impl LeastSquaresProblem for Root {
///     type Point = f64;
///     type Evaluation = [f64; 1];
///     fn evaluate(&self, x: &f64) -> Result<[f64; 1]> {
///         Ok([x * x - 2.0])
///     }
///     fn residuals<'a>(&self, evaluation: &'a [f64; 1]) -> &'a [f64] {
///         evaluation
///     }
///     fn jacobian(&self, x: &f64, _: &[f64; 1]) -> Result<Vec<Vec<f64>>> {
///         Ok(vec![vec![2.0 * x]])
///     }
///     fn apply_step(&self, x: &f64, steps: &[f64]) -> (f64, f64) {
///         (x + steps[0], steps[0].abs())
///     }
/// }
///
/// # fn main() -> Result<()> {
/// let found = minimize(&Root, 1.0, MinimizationSettings::default())?;
/// assert!((found.point - 2.0_f64.sqrt()).abs() < 1e-9);
/// # Ok(())
/// # }
/// ```
pub fn minimize<P: LeastSquaresProblem>(
    problem: &P,
    start: P::Point,
    settings: MinimizationSettings,
) -> Result<Minimum<P::Point, P::Evaluation>> {
    let mut search =
        Search { problem, settings, evaluations: 1, gain: f64::INFINITY, has_left_domain: false, fixes_kinks: false };
    let mut state = search.start(start)?;
    if settings.evaluations == 0 {
        return Ok(state.into_minimum(1, Status::Exhausted));
    }
    state.jacobian = search.checked_jacobian(&state.point, &mut state.evaluation)?;
    let mut valley = ValleyExtrapolation::new();
    loop {
        let final_status = match search.advance(&mut state)? {
            Advance::Moved(step, gain) => {
                valley.record_step(&step, gain);
                None
            }
            Advance::Ended(status) => Some(status),
        };
        if let Some(previous) = valley.outcome(state.cost, search.evaluations, final_status.is_some()) {
            state = previous;
            search.reset_progress();
            continue;
        }
        if let Some(status) = final_status {
            return Ok(state.into_minimum(search.evaluations, status));
        }
        let remaining = if problem.allows_extrapolation() { settings.evaluations - search.evaluations } else { 0 };
        if let Some(extrapolation_step) = valley.propose_step(remaining) {
            if let Some(iterate) = search.evaluate_extrapolation(&state, &extrapolation_step)? {
                let previous_cost = state.cost;
                valley.begin_trial(std::mem::replace(&mut state, iterate), previous_cost, search.evaluations);
                search.reset_progress();
            } else {
                valley.reject_trial();
            }
        }
    }
}

/// State of the iteration: point, evaluation, Jacobian, damping and curvature.
struct SearchState<P: LeastSquaresProblem> {
    point: P::Point,
    evaluation: P::Evaluation,
    cost: f64,
    jacobian: Vec<Vec<f64>>,
    is_admissible: bool,
    damping: f64,
    curvature: Curvature,
    /// Last step in coordinates, and the gradient before it.
    previous_step_and_gradient: Option<(Vec<f64>, Vec<f64>)>,
}

impl<P: LeastSquaresProblem> SearchState<P> {
    fn into_minimum(self, evaluations: usize, status: Status) -> Minimum<P::Point, P::Evaluation> {
        let Self { point, evaluation, cost, jacobian, .. } = self;
        Minimum { point, evaluation, cost, jacobian, evaluations, status }
    }
}

/// Result of one iteration: step in coordinates and relative decrease of the cost, or reason for termination.
enum Advance {
    Moved(Vec<f64>, f64),
    Ended(Status),
}

/// Settings and progress of a minimization.
struct Search<'a, P> {
    problem: &'a P,
    settings: MinimizationSettings,
    evaluations: usize,
    /// Relative decrease of the cost by the last step.
    gain: f64,
    /// True if the last trial step left the domain of the problem.
    has_left_domain: bool,
    /// True if parameters with kinks are fixed.
    fixes_kinks: bool,
}

impl<P: LeastSquaresProblem> Search<'_, P> {
    /// Return the Jacobian of an evaluation, and release the intermediate results of the latter.
    fn checked_jacobian(&self, point: &P::Point, evaluation: &mut P::Evaluation) -> Result<Vec<Vec<f64>>> {
        let jacobian = self.problem.jacobian(point, evaluation)?;
        self.problem.release(evaluation);
        let rows = self.problem.residuals(evaluation).len();
        jacobian.iter().try_for_each(|column| check_length("column of the Jacobian", rows, column.len()))?;
        Ok(jacobian)
    }

    /// Evaluate the initial guess without derivatives.
    fn start(&self, start: P::Point) -> Result<SearchState<P>> {
        let evaluation = self.problem.evaluate(&start)?;
        let point = self.problem.point_of_evaluation(&evaluation, start);
        let (cost, is_admissible) = (cost(self.problem.residuals(&evaluation)), self.problem.is_admissible(&point));
        let is_near = self.problem.starts_near_optimum();
        let damping = if is_near { INITIAL_DAMPING_NEAR_OPTIMUM } else { INITIAL_DAMPING };
        let curvature = Curvature::new(0);
        Ok(SearchState {
            point,
            evaluation,
            cost,
            jacobian: Vec::new(),
            is_admissible,
            damping,
            curvature,
            previous_step_and_gradient: None,
        })
    }

    /// Discard the gain of the last step and the flag of the domain limit.
    fn reset_progress(&mut self) {
        (self.gain, self.has_left_domain) = (f64::INFINITY, false);
    }

    /// Evaluate an extrapolation step. Return None if it leaves the domain of the problem.
    fn evaluate_extrapolation(
        &mut self,
        start: &SearchState<P>,
        extrapolation_step: &[f64],
    ) -> Result<Option<SearchState<P>>> {
        let next_point = self.problem.apply_step(&start.point, extrapolation_step).0;
        self.evaluations += 1;
        let outcome = self.start(next_point).and_then(|mut iterate| {
            iterate.jacobian = self.checked_jacobian(&iterate.point, &mut iterate.evaluation)?;
            Ok(iterate)
        });
        match outcome {
            Ok(iterate) if iterate.cost.is_finite() && (iterate.is_admissible || !start.is_admissible) => {
                Ok(Some(iterate))
            }
            Ok(_) => Ok(None),
            Err(error) if error.ends_simulation() => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Make one step that decreases the cost, or return the reason for termination.
    fn advance(&mut self, state: &mut SearchState<P>) -> Result<Advance> {
        let (problem, settings) = (self.problem, self.settings);
        // Cosine of the gradient at convergence; its square is a relative decrease of the cost.
        let gradient_tolerance = settings.tolerance.max(f64::EPSILON).sqrt();
        loop {
            if self.evaluations >= settings.evaluations {
                return Ok(Advance::Ended(Status::Exhausted));
            }
            let linear = LinearizedProblem::at(
                problem,
                &state.point,
                &state.jacobian,
                problem.residuals(&state.evaluation),
                self.fixes_kinks,
            );
            if state.curvature.is_for(state.jacobian.len()) {
                if let Some((step, gradient)) = state.previous_step_and_gradient.take() {
                    let next_gradient = linear.gradient_by_parameter();
                    let change: Vec<f64> = next_gradient.iter().zip(&gradient).map(|(a, b)| a - b).collect();
                    state.curvature.update(&step, &change, &linear.gauss_newton_product(&step));
                }
            } else {
                state.curvature = Curvature::new(state.jacobian.len());
            }
            let slope = linear.max_gradient();
            let is_flat = slope <= gradient_tolerance * linear.norm;
            let (newton, decrease) = linear.damped_step_and_decrease(MIN_DAMPING);
            let is_small_step =
                problem.apply_step(&state.point, &linear.to_coordinates(&newton)).1 <= settings.tolerance;
            // In a valley, the minimum can be far away although the gradient is small. The predicted decrease is
            // therefore checked as well.
            if is_small_step || (is_flat && (decrease <= settings.tolerance || self.gain <= settings.tolerance)) {
                return Ok(Advance::Ended(Status::Converged));
            }
            if self.gain <= settings.tolerance && self.has_left_domain {
                return Ok(Advance::Ended(Status::DomainLimit));
            }
            self.has_left_domain = false;
            match self.find_descent_step(state, &linear, (slope, is_flat))? {
                Some(advance) => return Ok(advance),
                // Fix the parameters with kinks and continue with the others.
                None => (self.fixes_kinks, state.damping, self.gain) = (true, INITIAL_DAMPING, f64::INFINITY),
            }
        }
    }

    /// Shorten the step until it decreases the cost. Return this step, or the reason for termination.
    ///
    /// Return None if parameters with kinks must be fixed first.
    fn find_descent_step(
        &mut self,
        state: &mut SearchState<P>,
        linear: &LinearizedProblem,
        (slope, is_flat): (f64, bool),
    ) -> Result<Option<Advance>> {
        let (problem, settings) = (self.problem, self.settings);
        loop {
            let curved_step =
                if state.curvature.is_used { linear.curved_step(state.damping, &state.curvature) } else { None };
            if state.curvature.is_used && curved_step.is_none() && state.damping <= MAX_DAMPING {
                state.damping *= DAMPING_FACTOR;
                continue;
            }
            let first_column = if curved_step.is_some() { linear.eliminated_count } else { 0 };
            let (step, decrease) = curved_step.unwrap_or_else(|| linear.damped_step_and_decrease(state.damping));
            let steps = linear.to_coordinates(&step);
            let (next_point, change) = problem.apply_step(&state.point, &steps);
            if change <= settings.tolerance || state.damping > MAX_DAMPING {
                // No step decreases the cost. The point has converged, or is at rounding level, at the domain limit or
                // at a kink.
                return Ok(if is_flat || slope <= RELATIVE_ROUNDING_ERROR * problem.signal_norm(&state.evaluation) {
                    Some(Advance::Ended(Status::Converged))
                } else if self.has_left_domain {
                    Some(Advance::Ended(Status::DomainLimit))
                } else if !self.fixes_kinks && (0..linear.scales.len()).any(|i| problem.has_kinks(&state.point, i)) {
                    None
                } else {
                    Some(Advance::Ended(Status::Stalled))
                });
            }
            if self.evaluations >= settings.evaluations {
                return Ok(Some(Advance::Ended(Status::Exhausted)));
            }
            self.evaluations += 1;
            let is_admissible = problem.is_admissible(&next_point);
            // A step that does not decrease the cost or overflows is shortened.
            let trial = problem.evaluate(&next_point).and_then(|mut trial_evaluation| {
                let trial_cost = cost(problem.residuals(&trial_evaluation));
                if !trial_cost.is_finite() || (state.is_admissible && !is_admissible) {
                    return Err(Error::Diverged { what: "step".into(), index: 0 });
                }
                if trial_cost >= state.cost {
                    return Ok(None);
                }
                let trial_point = problem.point_of_evaluation(&trial_evaluation, next_point.clone());
                // The linearization replaces the Jacobian of this point, which is released first: two Jacobians would
                // take most of the memory on long records.
                state.jacobian = Vec::new();
                let jacobian = self.checked_jacobian(&trial_point, &mut trial_evaluation)?;
                Ok(Some((jacobian, trial_evaluation, trial_cost, trial_point)))
            });
            match trial {
                Ok(Some((jacobian, trial_evaluation, trial_cost, next_point))) => {
                    self.gain = (state.cost - trial_cost) / state.cost.max(f64::MIN_POSITIVE);
                    (state.point, state.evaluation, state.cost, state.jacobian, state.is_admissible) =
                        (next_point, trial_evaluation, trial_cost, jacobian, is_admissible);
                    let predicted = linear.predicted_decrease(&step, first_column);
                    if !linear.is_constrained() {
                        let predicted_with_curvature = predicted - linear.curvature_change(&step, &state.curvature);
                        state.curvature.select_model(predicted, predicted_with_curvature, self.gain);
                    }
                    state.previous_step_and_gradient = Some((steps.clone(), linear.gradient_by_parameter()));
                    if self.gain >= ACCEPTABLE_GAIN_RATIO * decrease {
                        state.damping = (state.damping / DAMPING_FACTOR).max(MIN_DAMPING);
                    }
                    return Ok(Some(Advance::Moved(steps, self.gain)));
                }
                Ok(None) => self.has_left_domain = false,
                Err(error) if error.ends_simulation() => {
                    self.has_left_domain = true;
                    if state.jacobian.is_empty() {
                        // The derivatives of the trial are not finite.
                        let mut evaluation = problem.evaluate(&state.point)?;
                        state.jacobian = self.checked_jacobian(&state.point, &mut evaluation)?;
                    }
                }
                Err(error) => return Err(error),
            }
            state.damping *= DAMPING_FACTOR;
        }
    }
}

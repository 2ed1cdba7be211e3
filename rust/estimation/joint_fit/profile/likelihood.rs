//! Cost of a joint fit around its optimum: rise, refits of all parameters but one, and the cost over two parameters.

use crate::error::{check_length, Error, Result};
use crate::estimation::joint_fit::covariance::{covariance, covariance_of_residuals};
use crate::estimation::joint_fit::objective::{Objective, Weights, RELATIVE_COST_TOLERANCE};
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::problem::{Iterate, OptimizationResult};
use crate::estimation::output_error::MinimizationSettings;
use crate::linalg::dense::{self, SingularValues};
use crate::linalg::orthogonal::norm;
use crate::parallel::Stop;
use crate::recording::{Recordings, Sampling};
use crate::signal::statistics::inner;

/// Maximum number of evaluations of one refit.
pub const MAX_REFIT_EVALUATIONS: usize = 120;
/// The profile uses a grid twice as coarse if that moves the optimum by less than this many standard errors.
const MAX_OPTIMUM_SHIFT_ERRORS: f64 = 2.0;
/// The shift must also be less than this fraction of each parameter.
const MAX_OPTIMUM_SHIFT_RATIO: f64 = 1e-3;
/// Tolerance of a refit, as a fraction of the threshold.
const REFIT_TOLERANCE: f64 = 1e-4;
/// Decrease of the cost that indicates another optimum, as a fraction of the threshold.
const LOWER_OPTIMUM_MARGIN: f64 = 0.02;
/// Relative change of another parameter in one step above which power laws are also tried as initial guesses.
const POWER_LAW_MOVE_RATIO: f64 = 0.3;
/// Maximum exponent of these power laws.
const MAX_POWER_LAW_EXPONENT: f64 = 4.0;
/// Relative singular value below which a direction of the other parameters has no effect.
const SINGULAR_VALUE_TOLERANCE: f64 = 1e-12;

/// State of a fit around which the cost is evaluated.
#[derive(Debug, Clone, PartialEq)]
pub struct FitState {
    /// Estimates, extrapolated to step 0.
    pub estimate: Vec<f64>,
    /// Parameters at the optimum of the finest grid.
    pub on_grid: Vec<f64>,
    /// Weights of outputs and samples.
    pub weights: Weights,
    /// Block pulses per sampling interval of the finest grid.
    pub pulses_per_sample: usize,
    /// True if halving the step no longer moves the optimum.
    pub step_converged: bool,
    /// True if no step leads from a stable model to an unstable one.
    pub requires_stability: bool,
}

impl FitState {
    /// Objective of the fit with these pulses per sampling interval.
    fn objective<'a>(
        &self,
        (free, source, stop): (&'a ParameterSet, &'a Recordings, &'a Stop),
        pulses_per_sample: usize,
    ) -> Result<Objective<'a>> {
        check_length("values of what is free", free.problem.size(), self.estimate.len())?;
        check_length("values on the grid", free.problem.size(), self.on_grid.len())?;
        let sampling = Sampling { pulses_per_sample, ..Sampling::default() };
        Objective::new((&free.problem, source, stop), self.weights.clone(), sampling, self.requires_stability)
    }
}

/// Result of a refit.
pub enum Refit {
    /// The optimum of the other parameters.
    Optimum(OptimizationResult),
    /// An optimum with a lower cost than the fit.
    Lower(OptimizationResult),
    /// No initial guess can be simulated.
    Infeasible,
}

/// Cost of a joint fit around its optimum.
pub struct ProfileLikelihood<'a> {
    free: &'a ParameterSet,
    grid: Objective<'a>,
    /// The optimum on the grid.
    pub best: OptimizationResult,
    /// Difference between the estimate, extrapolated to step 0, and this optimum.
    pub shift: Vec<f64>,
    /// Inverse of the Hessian of the cost, row-major.
    bread: Vec<f64>,
    /// Standard errors.
    pub errors: Vec<f64>,
    /// Rise of the sum of squares at one standard error: the noise variance, widened for colored residuals.
    pub units: Vec<f64>,
    /// Parameters of the fit on its finest grid.
    on_grid: Vec<f64>,
}

impl<'a> ProfileLikelihood<'a> {
    /// Profile likelihood around the optimum that is found from the fit with at most `evaluations` evaluations.
    ///
    /// # Errors
    /// A simulation that fails at the first point, or a stop request ([`Objective::minimize`]).
    pub fn new(
        sources: (&'a ParameterSet, &'a Recordings, &'a Stop),
        fit: &FitState,
        evaluations: usize,
    ) -> Result<Self> {
        let difference = |best: &[f64]| fit.estimate.iter().zip(best).map(|(a, b)| a - b).collect();
        if fit.step_converged && fit.pulses_per_sample > 1 {
            // Half as fine a grid moved the optimum by less than its errors, and how steep it is by less still.
            let coarse = fit.objective(sources, fit.pulses_per_sample / 2);
            match coarse.and_then(|grid| Self::at(sources.0, grid, &fit.on_grid, evaluations)) {
                Err(Error::Interrupted) => return Err(Error::Interrupted),
                Ok(likelihood) if likelihood.best.has_converged() && likelihood.is_near(&fit.on_grid) => {
                    return Ok(Self { shift: difference(&likelihood.values()), ..likelihood });
                }
                _ => {}
            }
        }
        let grid = fit.objective(sources, fit.pulses_per_sample)?;
        let likelihood = Self::at(sources.0, grid, &fit.on_grid, evaluations)?;
        Ok(Self { shift: difference(&fit.on_grid), ..likelihood })
    }

    fn at(free: &'a ParameterSet, grid: Objective<'a>, values: &[f64], evaluations: usize) -> Result<Self> {
        let best = minimize(free, &grid, values, &[], (evaluations, RELATIVE_COST_TOLERANCE))?;
        let bread = covariance_of_residuals(&best.jacobian, &[], 1.0)?;
        let (spread, size) = (covariance(&best, &grid)?, values.len());
        let diagonal = |of: &[f64]| (0..size).map(|i| of[i * size + i]).collect::<Vec<f64>>();
        let (variances, curvatures) = (diagonal(&spread), diagonal(&bread));
        Ok(Self {
            free,
            grid,
            best,
            shift: vec![0.0; size],
            bread,
            errors: variances.iter().map(|v| v.sqrt()).collect(),
            units: variances.iter().zip(&curvatures).map(|(v, c)| v / c).collect(),
            on_grid: values.to_vec(),
        })
    }

    /// Profile likelihood around the optimum reached from another point.
    ///
    /// # Errors
    /// A simulation that fails at the first point, or a stop request ([`Objective::minimize`]).
    pub fn moved_to(&self, values: &[f64]) -> Result<Self> {
        let likelihood = Self::at(self.free, self.grid.clone(), values, MAX_REFIT_EVALUATIONS)?;
        Ok(Self { on_grid: self.on_grid.clone(), ..likelihood })
    }

    fn is_near(&self, values: &[f64]) -> bool {
        let near = |((a, b), error): ((f64, &f64), &f64)| {
            (a - b).abs() <= (MAX_OPTIMUM_SHIFT_ERRORS * error).max(MAX_OPTIMUM_SHIFT_RATIO * b.abs())
        };
        self.values().into_iter().zip(values).zip(&self.errors).all(near)
    }

    /// Number of free parameters.
    #[must_use]
    pub fn size(&self) -> usize {
        self.errors.len()
    }

    /// Parameters at the optimum.
    #[must_use]
    pub fn values(&self) -> Vec<f64> {
        self.best.values()
    }

    /// Half the sum of squares at the optimum.
    #[must_use]
    pub fn cost(&self) -> f64 {
        self.best.cost
    }

    /// Bounds of all free parameters.
    #[must_use]
    pub fn bounds(&self) -> Vec<(f64, f64)> {
        self.free.problem.bounds()
    }

    /// Cancellation flag.
    #[must_use]
    pub fn stop(&self) -> &'a Stop {
        self.grid.stop()
    }

    /// True if the data determine a parameter at all.
    #[must_use]
    pub fn is_identifiable(&self, i: usize) -> bool {
        [self.errors[i], self.units[i]].into_iter().all(|v| v > 0.0 && v.is_finite())
    }

    /// Rise of a sum of squares above the optimum, in standard deviations.
    #[must_use]
    pub fn rise(&self, i: usize, squares: f64) -> f64 {
        ((squares - 2.0 * self.cost()).max(0.0) / self.units[i]).sqrt()
    }

    /// True if the optimum has a lower cost than the fit on the next finer grid as well.
    ///
    /// Both are evaluated there and not refitted, because a refit could exploit the discretization error of that grid.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn is_lower_on_finer_grid(&self) -> Result<bool> {
        let cost = |grid: &Objective<'a>, values: &[f64]| -> Result<f64> {
            Ok(minimize(self.free, grid, values, &[], (0, RELATIVE_COST_TOLERANCE))?.cost)
        };
        let costs =
            self.grid.finer().and_then(|finer| Ok((cost(&finer, &self.values())?, cost(&finer, &self.on_grid)?)));
        Ok(finite(costs)?.is_some_and(|(after, before)| after < before))
    }

    /// Relative error of the Wald interval of a parameter, from one evaluation at each bound.
    ///
    /// Each bound is moved along the conditional optimum, and all other parameters follow by one linear step. Infinite
    /// if a bound violates a constraint or its simulation is not finite.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn nonlinearity(&self, i: usize, width: f64) -> Result<f64> {
        if !self.is_identifiable(i) {
            return Ok(0.0);
        }
        let (size, values, mut worst) = (self.size(), self.values(), 0.0_f64);
        let (low, high) = self.bounds()[i];
        let direction: Vec<f64> = (0..size).map(|j| self.bread[j * size + i]).collect();
        for side in [-1.0, 1.0] {
            let end = values[i] + side * width * self.errors[i];
            if !(low <= end && end <= high) {
                return Ok(f64::INFINITY);
            }
            let point = self.point_along(i, &values, &direction, end)?;
            let Some(refit_result) = finite(self.minimize_others(i, &point, 1, REFIT_TOLERANCE))? else {
                return Ok(f64::INFINITY);
            };
            let (sensitivities, _) = other_sensitivities(&refit_result, &[i])?;
            let rest = projected_residuals(&refit_result, &sensitivities);
            worst = worst.max((self.rise(i, inner(&rest, &rest)) / width - 1.0).abs());
        }
        Ok(worst)
    }

    /// Refit all other parameters at a value of one, from a nearby optimum.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn refit(&self, i: usize, value: f64, near: &OptimizationResult, evaluations: usize) -> Result<Refit> {
        let (rise, least) = (self.units[i], 2.0 * self.cost());
        let tolerance = REFIT_TOLERANCE * rise / least.max(rise);
        for point in self.refit_starts(i, value, near)? {
            let Some(refit_result) = finite(self.minimize_others(i, &point, evaluations, tolerance))? else { continue };
            let is_lower = 2.0 * refit_result.cost < least - LOWER_OPTIMUM_MARGIN * rise;
            return Ok(if is_lower { Refit::Lower(refit_result) } else { Refit::Optimum(refit_result) });
        }
        Ok(Refit::Infeasible)
    }

    /// Half the derivative of the sum of squares by one parameter; 0 on overflow.
    #[must_use]
    pub fn slope(&self, refit: &OptimizationResult, i: usize) -> f64 {
        let slope = inner(&refit.jacobian[i], &refit.residuals);
        // Near where a simulation diverges its derivatives overflow.
        if slope.is_finite() {
            slope
        } else {
            0.0
        }
    }

    /// Initial guesses with parameter `i` fixed at `value`, most promising first.
    ///
    /// The other parameters follow the tangent or stay; if the tangent moves them far, also power laws, for all parameters
    /// or for the orders only.
    /// Unbounded valleys often have the form d mu = const, d + a = const.
    fn refit_starts(&self, i: usize, value: f64, near: &OptimizationResult) -> Result<Vec<Vec<f64>>> {
        let (values, tangent) = (near.values(), tangent(near, i)?);
        let (orders, by) = (self.free.orders.len(), value - values[i]);
        let still = vec![0.0; values.len()];
        let mut points =
            vec![self.point_along(i, &values, &tangent, value)?, self.point_along(i, &values, &still, value)?];
        let far = |(t, v): (&f64, &f64)| (t * by).abs() > POWER_LAW_MOVE_RATIO * v.abs();
        if value * values[i] <= 0.0 || !tangent.iter().zip(&values).any(far) {
            return Ok(points);
        }
        let power = |(t, v): (&f64, &f64)| {
            let exponent = t * values[i] / if *v == 0.0 { 1.0 } else { *v };
            v * (value / values[i]).powf(exponent.clamp(-MAX_POWER_LAW_EXPONENT, MAX_POWER_LAW_EXPONENT))
        };
        let powers: Vec<f64> = tangent.iter().zip(&values).map(power).collect();
        let mixed = |k: usize| if k < orders { powers[k] } else { values[k] + tangent[k] * by };
        for mut towards in [powers.clone(), (0..values.len()).map(mixed).collect()] {
            towards[i] = value;
            let direction: Vec<f64> = towards.iter().zip(&values).map(|(t, v)| t - v).collect();
            points.push(self.point_along(i, &values, &direction, value)?);
        }
        let mut ranked = Vec::with_capacity(points.len());
        for point in points {
            let refit_result = finite(self.minimize_others(i, &point, 0, REFIT_TOLERANCE))?;
            ranked.push((refit_result.map_or(f64::INFINITY, |refit_result| refit_result.cost), point));
        }
        ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
        Ok(ranked.into_iter().map(|(_, point)| point).collect())
    }

    /// Point with a given value of one parameter, the others moved as far as feasible.
    fn point_along(&self, i: usize, values: &[f64], direction: &[f64], value: f64) -> Result<Vec<f64>> {
        let mut at = values.to_vec();
        at[i] = value;
        if direction[i] == 0.0 {
            return Ok(at);
        }
        let by = value - values[i];
        let mut towards: Vec<f64> = values.iter().zip(direction).map(|(v, d)| v + d / direction[i] * by).collect();
        towards[i] = value;
        let mut point = self.free.problem.last_feasible_point(&at, &towards)?;
        point[i] = value;
        Ok(point)
    }

    fn minimize_others(
        &self,
        i: usize,
        values: &[f64],
        evaluations: usize,
        tolerance: f64,
    ) -> Result<OptimizationResult> {
        minimize(self.free, &self.grid, values, &[i], (evaluations, tolerance))
    }
}

/// Cost of a joint fit over two of its parameters.
pub struct CostSurface<'a> {
    free: &'a ParameterSet,
    grid: Objective<'a>,
    best: OptimizationResult,
    pair: [usize; 2],
    /// Orthonormal basis of the sensitivities of the other parameters; None if these stay fixed.
    sensitivities: Option<Sensitivities>,
}

impl<'a> CostSurface<'a> {
    /// Surface around the optimum of the finest grid. With `refit`, all other parameters follow by one linear step.
    ///
    /// # Errors
    /// A simulation that fails at the first point, or a stop request ([`Objective::minimize`]).
    pub fn new(
        (free, source, stop): (&'a ParameterSet, &'a Recordings, &'a Stop),
        fit: &FitState,
        pair: [usize; 2],
        refit: bool,
        evaluations: usize,
    ) -> Result<Self> {
        let grid = fit.objective((free, source, stop), fit.pulses_per_sample)?;
        let best = minimize(free, &grid, &fit.estimate, &[], (evaluations, RELATIVE_COST_TOLERANCE))?;
        let sensitivities = if refit { Some(other_sensitivities(&best, &pair)?.0) } else { None };
        Ok(Self { free, grid, best, pair, sensitivities })
    }

    /// Values of one of the two parameters around the optimum, within its bounds.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn axis(&self, of: usize, half: f64, points: usize) -> Vec<f64> {
        let (at, (low, high)) = (self.best.values()[self.pair[of]], self.free.problem.bounds()[self.pair[of]]);
        let (low, high) = (low.max(at - half), high.min(at + half));
        let step = (high - low) / points.saturating_sub(1).max(1) as f64;
        (0..points).map(|k| if k + 1 == points { high } else { low + k as f64 * step }).collect()
    }

    /// Sum of squares at the optimum.
    #[must_use]
    pub fn least(&self) -> f64 {
        self.squares(&self.best)
    }

    fn squares(&self, result: &OptimizationResult) -> f64 {
        let rest = match &self.sensitivities {
            Some(sensitivities) => projected_residuals(result, sensitivities),
            None => result.residuals.clone(),
        };
        inner(&rest, &rest)
    }

    /// Return the sum of squares at each pair of parameter values, with one row per value in `second`. It is infinite
    /// if the simulation is not finite.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn scores(&self, first: &[f64], second: &[f64]) -> Result<Vec<f64>> {
        let mut scores = Vec::with_capacity(first.len() * second.len());
        for y in second {
            for x in first {
                let mut values = self.best.values();
                (values[self.pair[0]], values[self.pair[1]]) = (*x, *y);
                let result = finite(minimize(self.free, &self.grid, &values, &[], (0, RELATIVE_COST_TOLERANCE)))?;
                scores.push(result.map_or(f64::INFINITY, |result| self.squares(&result)));
            }
        }
        Ok(scores)
    }
}

/// Minimize the cost in plain coordinates, with the parameters `fixed` fixed.
fn minimize(
    free: &ParameterSet,
    grid: &Objective<'_>,
    values: &[f64],
    fixed: &[usize],
    (evaluations, tolerance): (usize, f64),
) -> Result<OptimizationResult> {
    let start = Iterate { point: free.problem.point(values)?, states: Vec::new() };
    let (problem, settings) = (free.problem_at(&start, true, fixed), MinimizationSettings { evaluations, tolerance });
    problem.minimize(grid.experiments(), &start, settings, grid.requires_stability, grid.stop())
}

/// None where a point cannot be simulated.
fn finite<T>(outcome: Result<T>) -> Result<Option<T>> {
    match outcome {
        Ok(outcome) => Ok(Some(outcome)),
        Err(Error::Interrupted) => Err(Error::Interrupted),
        Err(_) => Ok(None),
    }
}

/// Significant singular vectors and values of sensitivities with unit rows.
type Sensitivities = SingularValues;

/// Return the singular value decomposition of the sensitivities, without the parameters `without`, and the norms of the
/// rows. Rows are first scaled to norm 1.
fn other_sensitivities(result: &OptimizationResult, without: &[usize]) -> Result<(Sensitivities, Vec<f64>)> {
    let others = result.jacobian.iter().enumerate().filter(|(j, _)| !without.contains(j)).map(|(_, row)| row);
    let (mut scaled, mut lengths) = (Vec::new(), Vec::new());
    for row in others {
        // Far out, sensitivities may be so large that their squares overflow.
        let peak = row.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        let unit: Vec<f64> = row.iter().map(|v| v / if peak > 0.0 { peak } else { 1.0 }).collect();
        let length = norm(&unit).max(1.0);
        scaled.push(unit.iter().map(|v| v / length).collect());
        lengths.push(if peak > 0.0 { peak * length } else { 1.0 });
    }
    let failed = || Error::Internal { what: "sensitivities without singular values".into() };
    let mut factors = if scaled.is_empty() {
        SingularValues { left: Vec::new(), values: Vec::new(), right: Vec::new() }
    } else {
        dense::singular_values(&scaled).ok_or_else(failed)?
    };
    let largest = factors.values.iter().copied().fold(0.0, f64::max);
    let rank = factors.values.iter().filter(|size| **size > SINGULAR_VALUE_TOLERANCE * largest).count();
    factors.left.truncate(rank);
    factors.values.truncate(rank);
    factors.right.truncate(rank);
    Ok((factors, lengths))
}

/// Return the residuals after one least-squares step of the linearized parameters: the projection orthogonal to
/// `sensitivities`.
fn projected_residuals(result: &OptimizationResult, sensitivities: &Sensitivities) -> Vec<f64> {
    let mut rest = result.residuals.clone();
    for direction in &sensitivities.left {
        let along = inner(direction, &result.residuals);
        rest.iter_mut().zip(direction).for_each(|(v, d)| *v -= along * d);
    }
    rest
}

/// Direction of all parameters along the profile when one moves by 1.
fn tangent(result: &OptimizationResult, i: usize) -> Result<Vec<f64>> {
    let (SingularValues { left, values, right }, lengths) = other_sensitivities(result, &[i])?;
    let weights: Vec<f64> =
        left.iter().zip(&values).map(|(direction, size)| inner(direction, &result.jacobian[i]) / size).collect();
    let change = |j: usize| right.iter().zip(&weights).map(|(v, w)| v[j] * w).sum::<f64>();
    let mut tangent: Vec<f64> = lengths.iter().enumerate().map(|(j, length)| -change(j) / length).collect();
    tangent.insert(i, 1.0);
    Ok(tangent)
}

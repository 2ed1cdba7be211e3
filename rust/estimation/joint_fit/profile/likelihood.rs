//! Cost of a joint fit around its optimum: rise, refits with one parameter fixed, and the cost over two parameters.

use std::ops::Range;

use crate::error::{check_length, Error, Result};
use crate::estimation::joint_fit::covariance::{covariance, covariance_of_residuals};
use crate::estimation::joint_fit::objective::{Objective, Weights, RELATIVE_COST_TOLERANCE};
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::problem::{Iterate, OptimizationResult};
use crate::estimation::output_error::MinimizationSettings;
use crate::linalg::dense::{minimum_norm_solution_by_blocks, MinimumNormSolution};
use crate::linalg::orthogonal::{orthonormal_basis, project_out};
use crate::parallel::Stop;
use crate::recording::{Recordings, Sampling};
use crate::signal::statistics::inner;

/// Maximum number of evaluations of one refit.
pub const MAX_REFIT_EVALUATIONS: usize = 120;
/// Maximum shift of the optimum, in standard errors, at which the profile is computed with twice the step of the fit.
const MAX_OPTIMUM_SHIFT_ERRORS: f64 = 2.0;
/// Maximum shift of the optimum, relative to the parameter. A shift within this limit or [`MAX_OPTIMUM_SHIFT_ERRORS`]
/// is accepted.
const MAX_OPTIMUM_SHIFT_RATIO: f64 = 1e-3;
/// Convergence tolerance of a refit, as a fraction of the rise of the sum of squares at one standard error.
const REFIT_TOLERANCE: f64 = 1e-4;
/// Minimum decrease of the sum of squares that indicates another optimum, as a fraction of the rise at one standard
/// error.
const LOWER_OPTIMUM_MARGIN: f64 = 0.02;
/// Relative change of another parameter in one step above which initial guesses that follow power laws are also tried.
const POWER_LAW_MOVE_RATIO: f64 = 0.3;
/// Maximum magnitude of the exponent of a power law for initial guesses.
const MAX_POWER_LAW_EXPONENT: f64 = 4.0;
/// Relative singular value below which a direction of the other parameters counts as having no effect.
const SINGULAR_VALUE_TOLERANCE: f64 = 1e-12;

/// State of a fit around whose optimum the cost is evaluated.
#[derive(Debug, Clone, PartialEq)]
pub struct FitState {
    /// Estimates of all free parameters, extrapolated to step 0.
    pub estimate: Vec<f64>,
    /// Values of all free parameters at the optimum of the finest pulse grid.
    pub grid_optimum: Vec<f64>,
    /// Weights of outputs and samples.
    pub weights: Weights,
    /// Number of block pulses per sampling interval of the finest pulse grid.
    pub pulses_per_sample: usize,
    /// True if halving the step no longer changes the optimum significantly.
    pub step_converged: bool,
    /// True if an optimization must not move from a stable model to an unstable one.
    pub requires_stability: bool,
}

impl FitState {
    /// Return the objective of the fit with the given number of block pulses per sampling interval.
    fn objective<'a>(
        &self,
        (parameter_set, source, stop): (&'a ParameterSet, &'a Recordings, &'a Stop),
        pulses_per_sample: usize,
    ) -> Result<Objective<'a>> {
        check_length("values of the free parameters", parameter_set.problem.size(), self.estimate.len())?;
        check_length("values on the grid", parameter_set.problem.size(), self.grid_optimum.len())?;
        let sampling = Sampling { pulses_per_sample, ..Sampling::default() };
        Objective::new((&parameter_set.problem, source, stop), self.weights.clone(), sampling, self.requires_stability)
    }
}

/// Result of a refit.
pub enum Refit {
    /// Optimum of the other parameters.
    Optimum(OptimizationResult),
    /// Optimum with a lower cost than the fit.
    Lower(OptimizationResult),
    /// No initial guess of the refit can be simulated.
    Infeasible,
}

/// Cost of a joint fit around its optimum.
pub struct ProfileLikelihood<'a> {
    parameter_set: &'a ParameterSet,
    objective: Objective<'a>,
    /// Optimum at the step of the profile.
    pub optimum: OptimizationResult,
    /// Estimate, extrapolated to step 0, minus the optimum at the step of the profile, per parameter.
    pub shift: Vec<f64>,
    /// Inverse of the Gauss–Newton Hessian of the cost, row-major.
    inverse_hessian: Vec<f64>,
    /// Standard errors of all free parameters.
    pub errors: Vec<f64>,
    /// Rise of the sum of squares at one standard error of each parameter.
    ///
    /// This is the noise variance, widened for colored residuals.
    pub units: Vec<f64>,
    /// Values of all free parameters of the fit on its finest pulse grid.
    grid_optimum: Vec<f64>,
}

impl<'a> ProfileLikelihood<'a> {
    /// Return the profile likelihood around the optimum that is reached from the fit.
    ///
    /// `evaluations` is the maximum number of evaluations.
    ///
    /// # Errors
    /// The error of the simulation of the fit if it fails. [`Error::Interrupted`] after a stop request.
    pub fn new(
        sources: (&'a ParameterSet, &'a Recordings, &'a Stop),
        fit: &FitState,
        evaluations: usize,
    ) -> Result<Self> {
        let difference = |optimum: &[f64]| fit.estimate.iter().zip(optimum).map(|(a, b)| a - b).collect();
        if fit.step_converged && fit.pulses_per_sample > 1 {
            // Halving the step no longer changes the optimum. A grid half as fine changes it by less than its errors,
            // and its curvature by even less.
            let coarse = fit.objective(sources, fit.pulses_per_sample / 2);
            match coarse
                .and_then(|objective| Self::around_optimum(sources.0, objective, &fit.grid_optimum, evaluations))
            {
                Err(Error::Interrupted) => return Err(Error::Interrupted),
                Ok(likelihood) if likelihood.optimum.has_converged() && likelihood.is_near(&fit.grid_optimum) => {
                    return Ok(Self { shift: difference(&likelihood.values()), ..likelihood });
                }
                _ => {}
            }
        }
        let objective = fit.objective(sources, fit.pulses_per_sample)?;
        let likelihood = Self::around_optimum(sources.0, objective, &fit.grid_optimum, evaluations)?;
        Ok(Self { shift: difference(&fit.grid_optimum), ..likelihood })
    }

    fn around_optimum(
        parameter_set: &'a ParameterSet,
        objective: Objective<'a>,
        values: &[f64],
        evaluations: usize,
    ) -> Result<Self> {
        let optimum = minimize(parameter_set, &objective, values, &[], (evaluations, RELATIVE_COST_TOLERANCE))?;
        let inverse_hessian =
            covariance_of_residuals(&optimum.jacobian, &[], 1.0, objective.problem.model.priors.len())?;
        let (covariance_matrix, size) = (covariance(&optimum, &objective)?, values.len());
        let diagonal = |matrix: &[f64]| (0..size).map(|i| matrix[i * size + i]).collect::<Vec<f64>>();
        let (variances, curvatures) = (diagonal(&covariance_matrix), diagonal(&inverse_hessian));
        Ok(Self {
            parameter_set,
            objective,
            optimum,
            shift: vec![0.0; size],
            inverse_hessian,
            errors: variances.iter().map(|v| v.sqrt()).collect(),
            units: variances.iter().zip(&curvatures).map(|(v, c)| v / c).collect(),
            grid_optimum: values.to_vec(),
        })
    }

    /// Return the profile likelihood around the optimum that is reached from the parameter values `values`.
    ///
    /// # Errors
    /// The error of the simulation at `values` if it fails. [`Error::Interrupted`] after a stop request.
    pub fn recenter(&self, values: &[f64]) -> Result<Self> {
        let likelihood =
            Self::around_optimum(self.parameter_set, self.objective.clone(), values, MAX_REFIT_EVALUATIONS)?;
        Ok(Self { grid_optimum: self.grid_optimum.clone(), ..likelihood })
    }

    fn is_near(&self, values: &[f64]) -> bool {
        let is_close = |((a, b), error): ((f64, &f64), &f64)| {
            (a - b).abs() <= (MAX_OPTIMUM_SHIFT_ERRORS * error).max(MAX_OPTIMUM_SHIFT_RATIO * b.abs())
        };
        self.values().into_iter().zip(values).zip(&self.errors).all(is_close)
    }

    /// Number of free parameters.
    #[must_use]
    pub fn size(&self) -> usize {
        self.errors.len()
    }

    /// Values of all free parameters at the optimum.
    #[must_use]
    pub fn values(&self) -> Vec<f64> {
        self.optimum.values()
    }

    /// Half the sum of squared residuals at the optimum.
    #[must_use]
    pub fn cost(&self) -> f64 {
        self.optimum.cost
    }

    /// Lower and upper bound of each free parameter.
    #[must_use]
    pub fn bounds(&self) -> Vec<(f64, f64)> {
        self.parameter_set.problem.bounds()
    }

    /// Cancellation flag.
    #[must_use]
    pub fn stop(&self) -> &'a Stop {
        self.objective.stop()
    }

    /// Return true if the data determine parameter `i`.
    #[must_use]
    pub fn is_identifiable(&self, i: usize) -> bool {
        [self.errors[i], self.units[i]].into_iter().all(|v| v > 0.0 && v.is_finite())
    }

    /// Square root of the rise of the sum of squares `squares` above the optimum, in units of its rise at one standard
    /// error of parameter `i`.
    #[must_use]
    pub fn rise(&self, i: usize, squares: f64) -> f64 {
        ((squares - 2.0 * self.cost()).max(0.0) / self.units[i]).sqrt()
    }

    /// Return true if the optimum has a lower cost than the fit at half the step as well.
    ///
    /// Both points are evaluated at half the step and not refitted, because a refit could exploit the discretization
    /// error.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn is_lower_on_finer_grid(&self) -> Result<bool> {
        let cost = |objective: &Objective<'a>, values: &[f64]| -> Result<f64> {
            Ok(minimize(self.parameter_set, objective, values, &[], (0, RELATIVE_COST_TOLERANCE))?.cost)
        };
        let costs = self
            .objective
            .finer()
            .and_then(|finer| Ok((cost(&finer, &self.values())?, cost(&finer, &self.grid_optimum)?)));
        Ok(none_if_failed(costs)?.is_some_and(|(after, before)| after < before))
    }

    /// Relative error of the Wald interval of parameter `i` with half-width `width` in standard errors.
    ///
    /// At each bound, the other parameters follow the linearized profile and are then adjusted by one linear step. The
    /// rise of the cost there is compared with the rise that the Wald interval implies. The error is infinite if a
    /// bound violates a constraint or its simulation is not finite. It is 0 for a parameter that is not identifiable.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn nonlinearity(&self, i: usize, width: f64) -> Result<f64> {
        if !self.is_identifiable(i) {
            return Ok(0.0);
        }
        let (size, values, mut worst) = (self.size(), self.values(), 0.0_f64);
        let (low, high) = self.bounds()[i];
        let direction: Vec<f64> = (0..size).map(|j| self.inverse_hessian[j * size + i]).collect();
        for side in [-1.0, 1.0] {
            let end = values[i] + side * width * self.errors[i];
            if !(low <= end && end <= high) {
                return Ok(f64::INFINITY);
            }
            let point = self.point_along(i, &values, &direction, end)?;
            let Some(refit_result) = none_if_failed(self.minimize_others(i, &point, 1, REFIT_TOLERANCE))? else {
                return Ok(f64::INFINITY);
            };
            let squares = fit_other_sensitivities(&refit_result, i, &refit_result.residuals)?.residual_squares;
            worst = worst.max((self.rise(i, squares) / width - 1.0).abs());
        }
        Ok(worst)
    }

    /// Refit all other parameters with parameter `i` fixed at `value`, starting from a nearby optimum.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn refit(&self, i: usize, value: f64, nearby: &OptimizationResult, evaluations: usize) -> Result<Refit> {
        let (rise, minimum) = (self.units[i], 2.0 * self.cost());
        let tolerance = REFIT_TOLERANCE * rise / minimum.max(rise);
        for point in self.refit_starts(i, value, nearby)? {
            let Some(refit_result) = none_if_failed(self.minimize_others(i, &point, evaluations, tolerance))? else {
                continue;
            };
            let is_lower = 2.0 * refit_result.cost < minimum - LOWER_OPTIMUM_MARGIN * rise;
            return Ok(if is_lower { Refit::Lower(refit_result) } else { Refit::Optimum(refit_result) });
        }
        Ok(Refit::Infeasible)
    }

    /// Half the derivative of the sum of squares with respect to parameter `i`; 0 on overflow.
    #[must_use]
    pub fn slope(&self, refit: &OptimizationResult, i: usize) -> f64 {
        let slope = inner(&refit.jacobian[i], &refit.residuals);
        // Near a point at which a simulation diverges, its derivatives overflow.
        if slope.is_finite() {
            slope
        } else {
            0.0
        }
    }

    /// Return initial guesses with parameter `i` fixed at `value`, most promising first.
    ///
    /// The other parameters follow the tangent of the profile, or they are unchanged. If the tangent changes them
    /// strongly, they also follow power laws of parameter `i`, either all of them or only the orders. The reason is
    /// that unbounded valleys often have the form d·μ = const and d + a = const, for parameters d, μ and a.
    fn refit_starts(&self, i: usize, value: f64, nearby: &OptimizationResult) -> Result<Vec<Vec<f64>>> {
        let (values, tangent) = (nearby.values(), tangent(nearby, i)?);
        let (orders, change) = (self.parameter_set.orders.len(), value - values[i]);
        let no_change = vec![0.0; values.len()];
        let mut points =
            vec![self.point_along(i, &values, &tangent, value)?, self.point_along(i, &values, &no_change, value)?];
        let is_strong = |(t, v): (&f64, &f64)| (t * change).abs() > POWER_LAW_MOVE_RATIO * v.abs();
        if value * values[i] <= 0.0 || !tangent.iter().zip(&values).any(is_strong) {
            return Ok(points);
        }
        let power = |(t, v): (&f64, &f64)| {
            let exponent = t * values[i] / if *v == 0.0 { 1.0 } else { *v };
            v * (value / values[i]).powf(exponent.clamp(-MAX_POWER_LAW_EXPONENT, MAX_POWER_LAW_EXPONENT))
        };
        let powers: Vec<f64> = tangent.iter().zip(&values).map(power).collect();
        let mixed_value = |k: usize| if k < orders { powers[k] } else { values[k] + tangent[k] * change };
        for mut target in [powers.clone(), (0..values.len()).map(mixed_value).collect()] {
            target[i] = value;
            let direction: Vec<f64> = target.iter().zip(&values).map(|(t, v)| t - v).collect();
            points.push(self.point_along(i, &values, &direction, value)?);
        }
        let mut ranked = Vec::with_capacity(points.len());
        for point in points {
            let refit_result = none_if_failed(self.minimize_others(i, &point, 0, REFIT_TOLERANCE))?;
            ranked.push((refit_result.map_or(f64::INFINITY, |refit_result| refit_result.cost), point));
        }
        ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
        Ok(ranked.into_iter().map(|(_, point)| point).collect())
    }

    /// Return the point with parameter `i` at `value`, and the others moved along `direction` as far as feasible.
    fn point_along(&self, i: usize, values: &[f64], direction: &[f64], value: f64) -> Result<Vec<f64>> {
        let mut start = values.to_vec();
        start[i] = value;
        if direction[i] == 0.0 {
            return Ok(start);
        }
        let change = value - values[i];
        let mut target: Vec<f64> = values.iter().zip(direction).map(|(v, d)| v + d / direction[i] * change).collect();
        target[i] = value;
        let mut point = self.parameter_set.problem.last_feasible_point(&start, &target)?;
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
        minimize(self.parameter_set, &self.objective, values, &[i], (evaluations, tolerance))
    }
}

/// Cost of a joint fit as a function of two of its parameters.
pub struct CostSurface<'a> {
    parameter_set: &'a ParameterSet,
    objective: Objective<'a>,
    optimum: OptimizationResult,
    pair: [usize; 2],
    /// Orthonormal basis of the sensitivities of the other parameters; empty if these are fixed.
    basis: Vec<Vec<f64>>,
}

impl<'a> CostSurface<'a> {
    /// Return the cost surface of the two parameters `pair` around the optimum of the finest pulse grid.
    ///
    /// If `refit` is true, all other parameters are adjusted by one linear least-squares step at each point. Otherwise
    /// they are fixed.
    ///
    /// # Errors
    /// The error of the simulation of the fit if it fails. [`Error::Interrupted`] after a stop request.
    pub fn new(
        (parameter_set, source, stop): (&'a ParameterSet, &'a Recordings, &'a Stop),
        fit: &FitState,
        pair: [usize; 2],
        refit: bool,
        evaluations: usize,
    ) -> Result<Self> {
        let objective = fit.objective((parameter_set, source, stop), fit.pulses_per_sample)?;
        let optimum = minimize(parameter_set, &objective, &fit.estimate, &[], (evaluations, RELATIVE_COST_TOLERANCE))?;
        let other_rows = optimum.jacobian.iter().enumerate().filter(|(j, _)| refit && !pair.contains(j));
        let basis =
            orthonormal_basis(other_rows.map(|(_, row)| row.clone()).collect(), SINGULAR_VALUE_TOLERANCE, stop)?;
        Ok(Self { parameter_set, objective, optimum, pair, basis })
    }

    /// Return `point_count` evenly spaced values of one of the two parameters, `axis` = 0 or 1.
    ///
    /// They are within bounds and differ from the optimum by at most `half_width`, which has the unit of the parameter.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn axis(&self, axis: usize, half_width: f64, point_count: usize) -> Vec<f64> {
        let (center, (low, high)) =
            (self.optimum.values()[self.pair[axis]], self.parameter_set.problem.bounds()[self.pair[axis]]);
        let (low, high) = (low.max(center - half_width), high.min(center + half_width));
        let step = (high - low) / point_count.saturating_sub(1).max(1) as f64;
        (0..point_count).map(|k| if k + 1 == point_count { high } else { low + k as f64 * step }).collect()
    }

    /// Sum of squared residuals at the optimum.
    #[must_use]
    pub fn minimum(&self) -> f64 {
        self.squares(&self.optimum)
    }

    fn squares(&self, result: &OptimizationResult) -> f64 {
        let mut remaining = result.residuals.clone();
        project_out(&self.basis, &mut remaining);
        inner(&remaining, &remaining)
    }

    /// Return the sum of squares at each pair of parameter values, with one row per value in `second`.
    ///
    /// It is infinite if the simulation is not finite.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn scores(&self, first: &[f64], second: &[f64]) -> Result<Vec<f64>> {
        let mut scores = Vec::with_capacity(first.len() * second.len());
        for y in second {
            for x in first {
                let mut values = self.optimum.values();
                (values[self.pair[0]], values[self.pair[1]]) = (*x, *y);
                let result = none_if_failed(minimize(
                    self.parameter_set,
                    &self.objective,
                    &values,
                    &[],
                    (0, RELATIVE_COST_TOLERANCE),
                ))?;
                scores.push(result.map_or(f64::INFINITY, |result| self.squares(&result)));
            }
        }
        Ok(scores)
    }
}

/// Minimize the cost in plain coordinates, with the parameters `fixed` fixed.
fn minimize(
    parameter_set: &ParameterSet,
    objective: &Objective<'_>,
    values: &[f64],
    fixed: &[usize],
    (evaluations, tolerance): (usize, f64),
) -> Result<OptimizationResult> {
    let start = Iterate { point: parameter_set.problem.point(values)?, states: Vec::new() };
    let (problem, settings) =
        (parameter_set.problem_at(&start, true, fixed), MinimizationSettings { evaluations, tolerance });
    problem.minimize(objective.experiments(), &start, settings, objective.requires_stability, objective.stop())
}

/// Convert the error of a failed simulation to None. [`Error::Interrupted`] remains an error.
fn none_if_failed<T>(outcome: Result<T>) -> Result<Option<T>> {
    match outcome {
        Ok(outcome) => Ok(Some(outcome)),
        Err(Error::Interrupted) => Err(Error::Interrupted),
        Err(_) => Ok(None),
    }
}

/// Approximate a vector by the sensitivities of all parameters but parameter `i`, by least squares.
///
/// Directions in parameter space with negligible effect get the coefficient 0.
fn fit_other_sensitivities(result: &OptimizationResult, i: usize, target: &[f64]) -> Result<MinimumNormSolution> {
    let rows: Vec<&[f64]> =
        result.jacobian.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, row)| row.as_slice()).collect();
    let scale = |row: &&[f64]| {
        // Far from the optimum, sensitivities may be so large that their squares overflow.
        let peak = row.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        let unit = if peak > 0.0 { peak } else { 1.0 };
        unit * row.iter().map(|v| (v / unit).powi(2)).sum::<f64>().sqrt().max(1.0)
    };
    let scales: Vec<f64> = rows.iter().map(scale).collect();
    let append_rows = |j: usize, range: Range<usize>, out: &mut Vec<f64>| match rows.get(j) {
        Some(row) => out.extend(row[range].iter().map(|v| v / scales[j])),
        None => out.extend_from_slice(&target[range]),
    };
    let mut solution =
        minimum_norm_solution_by_blocks((rows.len(), target.len()), append_rows, SINGULAR_VALUE_TOLERANCE)
            .ok_or_else(|| Error::Internal { what: "sensitivities without singular values".into() })?;
    solution.values.iter_mut().zip(&scales).for_each(|(v, scale)| *v /= scale);
    Ok(solution)
}

/// Derivative of all parameters with respect to parameter `i` along the profile. The derivative of parameter `i` is 1.
fn tangent(result: &OptimizationResult, i: usize) -> Result<Vec<f64>> {
    let mut tangent = fit_other_sensitivities(result, i, &result.jacobian[i])?.values;
    tangent.iter_mut().for_each(|slope| *slope = -*slope);
    tangent.insert(i, 1.0);
    Ok(tangent)
}

//! Step refinement: the simulation step is halved until the estimate changes by a small part of its standard error.
//! Each step defines a grid of block pulses (pulse grid).

use super::covariance::{covariance, covariance_of_residuals};
use super::objective::{Objective, Weights, MAX_PULSES_PER_SAMPLE};
use super::parameter_set::TimeScaling;
use super::problem::{Iterate, OptimizationResult};
use super::reweighting::{fit_reweighted, Loss, RobustSummary};
use crate::error::{Error, Result};
use crate::estimation::optimization::prior::Prior;
use crate::estimation::output_error::Status;
use crate::signal::statistics::inner;

/// Maximum change of an estimate, in standard errors, at which the step refinement has converged.
const MAX_CHANGE_STANDARD_ERRORS: f64 = 0.1;
/// Increase of the negative log-likelihood per sample, due to halving the step, above which the other survivors of the
/// multistart are also fitted.
const MAX_LOG_RESIDUAL_INCREASE: f64 = 5e-4;

/// Minimum number of block pulses over all runs at which the step error of a linear model is corrected without fits on
/// finer pulse grids.
const MIN_CORRECTED_PULSES: usize = 1 << 15;
/// Maximum discretization error of a nonlinear fit before its correction, relative to the standard deviation of the
/// noise.
///
/// Standard errors of offsets, and profile-likelihood intervals, are computed on the same pulse grid without correction.
/// The discretization error widens them, because its square adds to the variance of the noise.
const MAX_NONLINEAR_STEP_ERROR: f64 = 0.1;
/// Maximum number of corrections with the same pair of finer pulse grids.
///
/// Each correction multiplies the remaining error by about the relative discretization error of the fitted pulse grid.
const MAX_CORRECTIONS: usize = 4;

/// Optimum on the finest pulse grid, and its extrapolation to zero step.
#[derive(Clone)]
pub struct Optimum<'a> {
    /// Optimum on the finest pulse grid.
    pub result: OptimizationResult,
    /// Objective on the finest pulse grid.
    pub objective: Objective<'a>,
    /// Values of all free parameters, extrapolated to zero step from two pulse grids.
    pub estimate: Vec<f64>,
    /// True if halving the step changed no estimate by more than a tenth of its standard error.
    pub step_converged: bool,
    covariance: Vec<f64>,
}

/// Optimum with its covariance, noise levels and residuals.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct OptimumStatistics {
    /// Optimum on the finest pulse grid.
    pub result: OptimizationResult,
    /// Weights of outputs and samples at the optimum.
    pub weights: Weights,
    /// Number of block pulses per sampling interval of the finest pulse grid.
    pub pulses_per_sample: usize,
    /// Values of all free parameters, extrapolated to zero step, within bounds.
    pub estimate: Vec<f64>,
    /// True if halving the step changed no estimate by more than a tenth of its standard error.
    pub step_converged: bool,
    /// Row-major covariance matrix of all free parameters.
    pub covariance: Vec<f64>,
    /// Standard deviation of the residuals of each output.
    ///
    /// With a robust loss, it follows from the median absolute residual.
    pub noise: Vec<f64>,
    /// Residuals in standard deviations of the noise, by run and output; NaN for a missing sample.
    pub residuals: Vec<Vec<Vec<f64>>>,
    /// Counts of downweighted residuals of a robust loss; None for a squared loss.
    pub robust: Option<RobustSummary>,
    /// Fraction of the information on a parameter that its prior contributes, for each prior of the problem.
    ///
    /// It is the posterior variance, computed for white noise, divided by the prior variance.
    pub prior_fractions: Vec<f64>,
}

/// Halve the step until the estimate changes by a small part of its standard error, and return the optimum.
///
/// On a coarse pulse grid, an optimization can follow a flat valley to the limit of its domain. From there, an
/// optimization on a finer pulse grid makes no progress. Then the other survivors of the multistart, `alternatives`,
/// are optimized on the finer pulse grid as well.
///
/// # Errors
/// The error of a simulation that fails. [`Error::Overflow`] if residuals overflow. [`Error::NotFinite`] if the
/// Jacobian is not finite. [`Error::Interrupted`] after a stop request.
pub fn refine_step<'a>(
    optimum: OptimizationResult,
    objective: Objective<'a>,
    loss: Loss,
    alternatives: &[Iterate],
) -> Result<Optimum<'a>> {
    let time_scaling = objective.time_scaling();
    let (mut optimum, mut objective, mut alternatives) = (optimum, objective, alternatives);
    let (mut estimate, mut has_converged, mut previous) = (optimum.values(), false, None::<OptimizationResult>);
    let mut covariance_matrix = None;
    while !has_converged && objective.sampling.pulses_per_sample < MAX_PULSES_PER_SAMPLE {
        // Residuals can shrink to the noise on a finer grid, so the weights are iterated again.
        let halved_objective = objective.finer()?;
        let start = extrapolated_start(&halved_objective, &time_scaling, &optimum, previous.as_ref())?;
        let (finer, finer_objective) = match fit_reweighted(&start, halved_objective.clone(), loss) {
            // The extrapolated start may have no finite simulation.
            Err(error) if error != Error::Interrupted => fit_reweighted(&optimum.iterate, halved_objective, loss)?,
            fit => fit?,
        };
        let has_increased = negative_log_likelihood(&finer, &finer_objective)
            > negative_log_likelihood(&optimum, &objective) + MAX_LOG_RESIDUAL_INCREASE;
        let mut finer_objective = finer_objective;
        if (finer.status == Status::DomainLimit && previous.is_none()) || (has_increased && !alternatives.is_empty()) {
            let alternative = best_alternative(&finer, &finer_objective, alternatives, loss)?;
            // The other survivors are tried only once.
            alternatives = &[];
            if let Some((alternative_result, alternative_objective)) = alternative {
                // The two grids have different optima, so they cannot be extrapolated.
                (previous, covariance_matrix) = (None, None);
                estimate = alternative_result.values();
                (optimum, objective) = (alternative_result, alternative_objective);
                continue;
            }
        }
        std::mem::swap(&mut objective, &mut finer_objective);
        let (finer_values, optimum_values) = (finer.values(), optimum.values());
        let fit = covariance(&finer, &objective)?;
        // The scheme is of second order. Richardson extrapolation of two grids yields the limit, and a third grid
        // confirms it. Optimizations that did not converge cannot be extrapolated.
        let mut limit = finer_values.clone();
        if finer.has_converged() && optimum.has_converged() {
            limit = extrapolate(&objective, &time_scaling, &finer_values, &optimum_values, 3.0)?;
        }
        has_converged = is_within_errors(&time_scaling, &limit, &estimate, (&finer_values, &fit))
            || is_within_errors(&time_scaling, &finer_values, &optimum_values, (&finer_values, &fit));
        estimate = limit;
        (previous, optimum, covariance_matrix) = (Some(optimum), finer, Some(fit));
    }
    let covariance_matrix = covariance_matrix.map_or_else(|| covariance(&optimum, &objective), Ok)?;
    let estimate = select_limit_or_optimum(&optimum, &objective, estimate, &time_scaling, has_converged)?;
    Ok(Optimum { result: optimum, objective, estimate, step_converged: has_converged, covariance: covariance_matrix })
}

/// Return the optimum in the limit of zero pulse length by deferred correction; None if this fails or would not save
/// time.
///
/// It is used for long records and for models with nonlinear terms other than friction, because both are slow to fit on
/// fine pulse grids.
///
/// At the optimum, the residuals on two finer pulse grids are extrapolated to zero pulse length. The difference between
/// this limit and the residuals on the pulse grid of `objective` hardly depends on the parameters. This difference is
/// added to the samples, and the model is fitted again on the same grid, until the estimate converges (Stetter,
/// doi:10.1007/BF01432879). The finer pulse grids are simulated without derivatives.
///
/// # Errors
/// [`Error::NotFinite`] if the Jacobian is not finite ([`covariance`]). An error if the runs cannot be sampled at a
/// shorter step. [`Error::Interrupted`] after a stop request.
pub fn correct_step<'a>(
    optimum: &OptimizationResult,
    objective: &Objective<'a>,
    loss: Loss,
) -> Result<Option<Optimum<'a>>> {
    let pulses: usize = objective.experiments().iter().map(|experiment| experiment.record.m()).sum();
    let is_smooth = objective.problem.frictions.is_empty();
    let is_slow = is_smooth && !objective.problem.is_linear();
    if !(is_slow || pulses >= MIN_CORRECTED_PULSES) || !optimum.has_converged() {
        return Ok(None);
    }
    let (mut optimum, mut objective) = (optimum.clone(), objective.clone());
    if is_slow {
        loop {
            let finer = objective.finer()?;
            let Some((_, ratio)) = limit_shifts(&optimum.iterate, &objective, &objective, &finer)? else {
                return Ok(None);
            };
            if ratio <= MAX_NONLINEAR_STEP_ERROR * MAX_NONLINEAR_STEP_ERROR {
                break;
            }
            if finer.sampling.pulses_per_sample >= MAX_PULSES_PER_SAMPLE {
                return Ok(None);
            }
            (optimum, objective) = match fit_reweighted(&optimum.iterate, finer, loss) {
                Err(Error::Interrupted) => return Err(Error::Interrupted),
                Ok(fit) if fit.0.has_converged() => fit,
                _ => return Ok(None),
            };
        }
    }
    let time_scaling = objective.time_scaling();
    let (mut current, mut current_objective, mut coarse) = (optimum.clone(), objective.clone(), objective.clone());
    while coarse.sampling.pulses_per_sample < MAX_PULSES_PER_SAMPLE {
        let fine = coarse.finer()?;
        for correction in 0..MAX_CORRECTIONS {
            let shifts = match limit_shifts(&current.iterate, &objective, &coarse, &fine)? {
                Some((shifts, ratio)) if ratio <= 1.0 => shifts,
                _ => return Ok(None),
            };
            let corrected = objective.with_weights(current_objective.weights.clone())?.with_residual_shifts(&shifts);
            let (next_result, next_objective) = match fit_reweighted(&current.iterate, corrected, loss) {
                Err(Error::Interrupted) => return Err(Error::Interrupted),
                Ok(fit) if fit.0.has_converged() => fit,
                _ => return Ok(None),
            };
            let covariance_matrix = covariance(&next_result, &next_objective)?;
            let has_converged = is_within_errors(
                &time_scaling,
                &next_result.values(),
                &current.values(),
                (&next_result.values(), &covariance_matrix),
            );
            if has_converged && correction == 0 {
                // The optimum is the same as with the previous pair of coarser grids.
                let estimate = next_result.values();
                let iterate =
                    Iterate { point: optimum.iterate.point.clone(), states: next_result.iterate.states.clone() };
                let result = OptimizationResult { iterate, ..next_result };
                let objective = next_objective;
                return Ok(Some(Optimum {
                    result,
                    objective,
                    estimate,
                    step_converged: true,
                    covariance: covariance_matrix,
                }));
            }
            (current, current_objective) = (next_result, next_objective);
            if has_converged {
                break;
            }
        }
        coarse = fine;
    }
    Ok(None)
}

/// Changes of the residuals by run, output and compared sample, in units of the outputs.
type ResidualShifts = Vec<Vec<Vec<f64>>>;

/// Return residuals extrapolated to zero step minus residuals on `objective`, in units of the outputs, and the ratio of
/// their power to that of the residuals on the grid of `fine`.
///
/// Return None if a simulation is not finite.
fn limit_shifts(
    iterate: &Iterate,
    objective: &Objective<'_>,
    coarse: &Objective<'_>,
    fine: &Objective<'_>,
) -> Result<Option<(ResidualShifts, f64)>> {
    let mut shifts = ResidualShifts::new();
    let (mut power, mut noise) = (0.0, 0.0);
    // Richardson extrapolation of a scheme of second order.
    for (objective, weight_of_grid) in [(fine, 4.0 / 3.0), (coarse, -1.0 / 3.0), (objective, -1.0)] {
        let Some(evaluation) = objective.evaluate(iterate)? else { return Ok(None) };
        let residuals = objective.residuals(&evaluation);
        if shifts.is_empty() {
            shifts = residuals.iter().map(|run| run.iter().map(|e| vec![0.0; e.len()]).collect()).collect();
        }
        for (shifts, run) in shifts.iter_mut().zip(&residuals) {
            for ((shifts, residuals), weight) in shifts.iter_mut().zip(run).zip(&objective.weights.outputs) {
                shifts.iter_mut().zip(residuals).for_each(|(sum, e)| *sum += weight_of_grid * e / weight);
                noise = if weight_of_grid > 0.0 { noise + finite_squares(residuals, 1.0) } else { noise };
            }
        }
    }
    for run in &shifts {
        power += run.iter().zip(&objective.weights.outputs).map(|(s, weight)| finite_squares(s, *weight)).sum::<f64>();
    }
    Ok(Some((shifts, if power > 0.0 { power / noise } else { 0.0 })))
}

/// Sum of the squares of all finite products of a value and `weight`.
fn finite_squares(values: &[f64], weight: f64) -> f64 {
    values.iter().map(|v| v * weight).filter(|v| v.is_finite()).map(|v| v * v).sum()
}

impl<'a> Optimum<'a> {
    /// Return a fit result as the optimum, without step refinement.
    ///
    /// # Errors
    /// [`Error::NotFinite`] if the Jacobian is not finite ([`covariance`]).
    pub fn without_refinement(result: OptimizationResult, objective: Objective<'a>) -> Result<Self> {
        let covariance = covariance(&result, &objective)?;
        Ok(Self { estimate: result.values(), step_converged: true, covariance, result, objective })
    }

    /// Convert to the statistics of the optimum, with noise levels and residuals.
    #[must_use]
    pub fn into_statistics(self) -> OptimumStatistics {
        let Self { result, objective, estimate, step_converged: has_converged, covariance } = self;
        let is_robust = objective.weights.robust_weights.is_some();
        let levels =
            if is_robust { objective.residual_scales(&result) } else { objective.residual_root_mean_squares(&result) };
        let limit_to_bounds = |(value, (low, high)): (f64, (f64, f64))| value.clamp(low, high);
        let mut residuals = objective.residuals(&result);
        for run in &mut residuals {
            // The weights equal the inverse noise levels within a tolerance only, so the residuals are scaled again.
            for (series, &level) in run.iter_mut().zip(&levels).filter(|(_, level)| **level > 0.0) {
                series.iter_mut().for_each(|e| *e /= level);
            }
        }
        OptimumStatistics {
            estimate: estimate.into_iter().zip(objective.problem.bounds()).map(limit_to_bounds).collect(),
            noise: levels.iter().zip(&objective.weights.outputs).map(|(level, weight)| level / weight).collect(),
            residuals,
            robust: is_robust.then(|| RobustSummary::from_result(&objective, &result)),
            weights: objective.weights,
            pulses_per_sample: objective.sampling.pulses_per_sample,
            prior_fractions: prior_fractions(&result, &objective.problem.model.priors),
            result,
            step_converged: has_converged,
            covariance,
        }
    }
}

/// Return the fraction of the information on its parameter that each prior contributes; NaN if not computable.
fn prior_fractions(result: &OptimizationResult, priors: &[Prior]) -> Vec<f64> {
    let size = result.jacobian.len();
    let posterior = covariance_of_residuals(&result.jacobian, &[], 1.0, priors.len()).unwrap_or_default();
    let variance = |parameter: usize| posterior.get(parameter * size + parameter).copied().unwrap_or(f64::NAN);
    priors.iter().map(|prior| variance(prior.parameter) / prior.deviation.powi(2)).collect()
}

/// Return true if two estimates differ by at most a tenth of the standard errors in scaled time.
///
/// The standard errors are those of `covariance_matrix` at the parameter values `values`.
fn is_within_errors(
    time_scaling: &TimeScaling,
    first: &[f64],
    second: &[f64],
    (values, covariance_matrix): (&[f64], &[f64]),
) -> bool {
    let pairs = time_scaling.to_scaled(first).into_iter().zip(time_scaling.to_scaled(second));
    let errors = time_scaling.standard_errors(values, covariance_matrix);
    pairs.zip(&errors).all(|((a, b), error)| (a - b).abs() <= MAX_CHANGE_STANDARD_ERRORS * error)
}

/// Extrapolate the estimates of two pulse grids to zero step: `fine` + (`fine` − `coarse`) / `divisor`.
///
/// The result is limited to feasible values.
fn extrapolate(
    objective: &Objective<'_>,
    time_scaling: &TimeScaling,
    fine: &[f64],
    coarse: &[f64],
    divisor: f64,
) -> Result<Vec<f64>> {
    let (fine, coarse) = (time_scaling.to_scaled(fine), time_scaling.to_scaled(coarse));
    let target: Vec<f64> = fine.iter().zip(&coarse).map(|(f, c)| f + (f - c) / divisor).collect();
    Ok(time_scaling.to_unscaled(&objective.problem.last_feasible_point(&fine, &target)?))
}

/// Return the initial guess of the fit at half the step.
///
/// The optimum is expected to move a quarter as far as at the last halving.
fn extrapolated_start(
    objective: &Objective<'_>,
    time_scaling: &TimeScaling,
    optimum: &OptimizationResult,
    previous: Option<&OptimizationResult>,
) -> Result<Iterate> {
    match previous {
        Some(previous) if optimum.has_converged() && previous.has_converged() => {
            Ok(optimum.iterate_at(&extrapolate(objective, time_scaling, &optimum.values(), &previous.values(), 4.0)?))
        }
        _ => Ok(optimum.iterate.clone()),
    }
}

/// Return the best fit that starts from one of `alternatives`, with converged weights; None if no such fit is better
/// than the result `stalled_result`.
///
/// `stalled_result` stopped at the limit of its domain. Unstable candidates are excluded if the objective requires
/// stability.
///
/// # Errors
/// [`Error::Interrupted`] after a stop request.
pub fn best_alternative<'a>(
    stalled_result: &OptimizationResult,
    objective: &Objective<'a>,
    alternatives: &[Iterate],
    loss: Loss,
) -> Result<Option<(OptimizationResult, Objective<'a>)>> {
    let (mut best_fit, mut lowest_level) = (None, negative_log_likelihood(stalled_result, objective));
    for other in alternatives {
        let outcome = match fit_reweighted(other, objective.clone(), loss) {
            Err(Error::Interrupted) => return Err(Error::Interrupted),
            Err(_) => continue,
            Ok(outcome) => outcome,
        };
        let level = negative_log_likelihood(&outcome.0, &outcome.1);
        if level < lowest_level
            && !(objective.requires_stability && objective.problem.is_unstable(&outcome.0.iterate.point))
        {
            (best_fit, lowest_level) = (Some(outcome), level);
        }
    }
    Ok(best_fit)
}

/// Negative log-likelihood per sample, summed over outputs, up to a constant.
fn negative_log_likelihood(result: &OptimizationResult, objective: &Objective<'_>) -> f64 {
    objective
        .residual_root_mean_squares(result)
        .iter()
        .zip(&objective.weights.outputs)
        .map(|(level, w)| libm::log(level.max(1e-300) / w))
        .sum()
}

/// Return the extrapolated estimate `limit` or the optimum `optimum` of the finest pulse grid, whichever fits better at
/// half the step.
///
/// If poorly determined parameters have a curved valley, a straight extrapolation leaves the valley. The limit is
/// returned without this comparison if the residuals hardly change between both points. It is also returned if they
/// change linearly and the step has converged.
fn select_limit_or_optimum(
    optimum: &OptimizationResult,
    objective: &Objective<'_>,
    limit: Vec<f64>,
    time_scaling: &TimeScaling,
    has_converged: bool,
) -> Result<Vec<f64>> {
    let optimum_values = optimum.values();
    let shift: Vec<f64> = time_scaling
        .to_scaled(&limit)
        .iter()
        .zip(time_scaling.to_scaled(&optimum_values))
        .map(|(a, b)| a - b)
        .collect();
    let mut change = vec![0.0; optimum.residuals.len()];
    for (parameter_change, column) in time_scaling.step(&optimum_values, &shift).iter().zip(&optimum.jacobian) {
        change.iter_mut().zip(column).for_each(|(sum, slope)| *sum += parameter_change * slope);
    }
    let euclidean_norm = |row: &[f64]| inner(row, row).sqrt();
    if inner(&change, &change) <= MAX_CHANGE_STANDARD_ERRORS * MAX_CHANGE_STANDARD_ERRORS {
        // Both points have nearly the same residuals.
        return Ok(limit);
    }
    let limit_iterate = optimum.iterate_at(&limit);
    if has_converged && let Some(evaluation) = objective.evaluate(&limit_iterate)? {
        let predicted = optimum.residuals.iter().zip(&change).map(|(e, w)| e + w);
        let deviation: Vec<f64> =
            evaluation.residuals.iter().zip(predicted).map(|(e, predicted)| e - predicted).collect();
        if euclidean_norm(&deviation) <= MAX_CHANGE_STANDARD_ERRORS * euclidean_norm(&change) {
            return Ok(limit);
        }
    }
    let finer = match objective.finer() {
        Ok(finer) => finer,
        Err(Error::Interrupted) => return Err(Error::Interrupted),
        // Neither point can be simulated on half the step.
        Err(_) => return Ok(limit),
    };
    let mut costs = [f64::INFINITY; 2];
    for (cost, iterate) in costs.iter_mut().zip([&limit_iterate, &optimum.iterate]) {
        if let Some(evaluation) = finer.evaluate(iterate)? {
            *cost = evaluation.cost;
        }
    }
    Ok(if costs[0] <= costs[1] { limit } else { optimum_values })
}

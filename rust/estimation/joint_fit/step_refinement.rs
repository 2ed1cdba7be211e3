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
/// Maximum number of corrections with the same pair of finer pulse grids.
///
/// Each correction multiplies the remaining error by about the relative discretization error of the fitted pulse grid.
const MAX_CORRECTIONS: usize = 4;

/// Optimum on the finest pulse grid, and its extrapolation to zero step.
#[derive(Clone)]
pub struct Optimum<'a> {
    /// Optimum on the finest pulse grid.
    pub attempt: OptimizationResult,
    /// Objective on the finest pulse grid.
    pub grid: Objective<'a>,
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
    pub attempt: OptimizationResult,
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
/// optimization on a finer pulse grid makes no progress. Then the other survivors of the multistart, `others`, are
/// optimized on the finer pulse grid as well.
///
/// # Errors
/// The error of a simulation that fails. [`Error::Beyond`] if residuals overflow. [`Error::NotFinite`] if the Jacobian
/// is not finite. [`Error::Interrupted`] after a stop request.
pub fn refine_step<'a>(
    best: OptimizationResult,
    grid: Objective<'a>,
    loss: Loss,
    others: &[Iterate],
) -> Result<Optimum<'a>> {
    let time_scaling = grid.time_scaling();
    let (mut best, mut grid, mut others) = (best, grid, others);
    let (mut estimate, mut has_converged, mut before) = (best.values(), false, None::<OptimizationResult>);
    let mut spread = None;
    while !has_converged && grid.sampling.pulses_per_sample < MAX_PULSES_PER_SAMPLE {
        // Residuals can shrink to the noise on a finer grid, so the weights are iterated again.
        let half = grid.finer()?;
        let start = extrapolated_start(&half, &time_scaling, &best, before.as_ref())?;
        let (finer, fine) = match fit_reweighted(&start, half.clone(), loss) {
            // The extrapolated start may have no finite simulation.
            Err(error) if error != Error::Interrupted => fit_reweighted(&best.iterate, half, loss)?,
            fit => fit?,
        };
        let has_increased =
            negative_log_likelihood(&finer, &fine) > negative_log_likelihood(&best, &grid) + MAX_LOG_RESIDUAL_INCREASE;
        let mut fine = fine;
        if (finer.status == Status::DomainLimit && before.is_none()) || (has_increased && !others.is_empty()) {
            let alternative = best_alternative(&finer, &fine, others, loss)?;
            // The other survivors are tried only once.
            others = &[];
            if let Some((other, finer_values)) = alternative {
                // The two grids have different optima, so they cannot be extrapolated.
                (before, spread) = (None, None);
                estimate = other.values();
                (best, grid) = (other, finer_values);
                continue;
            }
        }
        std::mem::swap(&mut grid, &mut fine);
        let (finer_values, own_values) = (finer.values(), best.values());
        let fit = covariance(&finer, &grid)?;
        // The scheme is of second order. Richardson extrapolation of two grids yields the limit, and a third grid
        // confirms it. Optimizations that did not converge cannot be extrapolated.
        let mut limit = finer_values.clone();
        if finer.has_converged() && best.has_converged() {
            limit = extrapolate(&grid, &time_scaling, &finer_values, &own_values, 3.0)?;
        }
        has_converged = is_within_errors(&time_scaling, &limit, &estimate, (&finer_values, &fit))
            || is_within_errors(&time_scaling, &finer_values, &own_values, (&finer_values, &fit));
        estimate = limit;
        (before, best, spread) = (Some(best), finer, Some(fit));
    }
    let spread = spread.map_or_else(|| covariance(&best, &grid), Ok)?;
    let estimate = select_limit_or_optimum(&best, &grid, estimate, &time_scaling, has_converged)?;
    Ok(Optimum { attempt: best, grid, estimate, step_converged: has_converged, covariance: spread })
}

/// Return the optimum for zero step by deferred correction; None if this fails or is not worth its overhead.
///
/// It serves long records, and nonlinear terms without friction, whose fits on fine pulse grids are slow.
///
/// At the optimum, the residuals on two finer pulse grids are extrapolated to zero step. The difference of this limit
/// from the residuals on `grid` hardly depends on the parameters. It is added to the samples, and the model is fitted
/// again on `grid` until the estimate does not change (Stetter, doi:10.1007/BF01432879). The finer pulse grids are
/// simulated without derivatives.
///
/// # Errors
/// [`Error::NotFinite`] if the Jacobian is not finite ([`covariance`]). An error if the runs cannot be sampled at a
/// shorter step. [`Error::Interrupted`] after a stop request.
pub fn correct_step<'a>(best: &OptimizationResult, grid: &Objective<'a>, loss: Loss) -> Result<Option<Optimum<'a>>> {
    let pulses: usize = grid.experiments().iter().map(|experiment| experiment.record.m()).sum();
    let is_smooth = grid.problem.frictions.is_empty();
    let is_slow = is_smooth && !grid.problem.is_linear();
    if !(is_slow || pulses >= MIN_CORRECTED_PULSES) || !best.has_converged() {
        return Ok(None);
    }
    let time_scaling = grid.time_scaling();
    let (mut place, mut own_grid, mut coarse) = (best.clone(), grid.clone(), grid.clone());
    while coarse.sampling.pulses_per_sample < MAX_PULSES_PER_SAMPLE {
        let fine = coarse.finer()?;
        for correction in 0..MAX_CORRECTIONS {
            let Some(shifts) = limit_shifts(&place.iterate, grid, &coarse, &fine)? else { return Ok(None) };
            let corrected = grid.with_weights(own_grid.weights.clone())?.with_residual_shifts(&shifts);
            let (next, next_grid) = match fit_reweighted(&place.iterate, corrected, loss) {
                Err(Error::Interrupted) => return Err(Error::Interrupted),
                Ok(fit) if fit.0.has_converged() => fit,
                _ => return Ok(None),
            };
            let spread = covariance(&next, &next_grid)?;
            let has_converged =
                is_within_errors(&time_scaling, &next.values(), &place.values(), (&next.values(), &spread));
            if has_converged && correction == 0 {
                // The optimum is the same as with the previous pair of coarser grids.
                let estimate = next.values();
                let iterate = Iterate { point: best.iterate.point.clone(), states: next.iterate.states.clone() };
                let attempt = OptimizationResult { iterate, ..next };
                let grid = next_grid;
                return Ok(Some(Optimum { attempt, grid, estimate, step_converged: true, covariance: spread }));
            }
            (place, own_grid) = (next, next_grid);
            if has_converged {
                break;
            }
        }
        coarse = fine;
    }
    Ok(None)
}

/// Return residuals extrapolated to zero step minus residuals on `grid`, in units of the outputs.
///
/// The values are indexed by run, output and sample. Return None if the differences are large relative to the noise, or
/// if a simulation is not finite.
fn limit_shifts(
    place: &Iterate,
    grid: &Objective<'_>,
    coarse: &Objective<'_>,
    fine: &Objective<'_>,
) -> Result<Option<Vec<Vec<Vec<f64>>>>> {
    let mut shifts: Vec<Vec<Vec<f64>>> = Vec::new();
    let (mut power, mut noise) = (0.0, 0.0);
    // Richardson extrapolation of a scheme of second order.
    for (objective, share) in [(fine, 4.0 / 3.0), (coarse, -1.0 / 3.0), (grid, -1.0)] {
        let Some(evaluation) = objective.evaluate(place)? else { return Ok(None) };
        let residuals = objective.residuals(&evaluation);
        if shifts.is_empty() {
            shifts = residuals.iter().map(|run| run.iter().map(|e| vec![0.0; e.len()]).collect()).collect();
        }
        for (shifts, run) in shifts.iter_mut().zip(&residuals) {
            for ((shifts, residuals), weight) in shifts.iter_mut().zip(run).zip(&objective.weights.outputs) {
                shifts.iter_mut().zip(residuals).for_each(|(sum, e)| *sum += share * e / weight);
                noise = if share > 0.0 { noise + finite_squares(residuals, 1.0) } else { noise };
            }
        }
    }
    for run in &shifts {
        power += run.iter().zip(&grid.weights.outputs).map(|(s, weight)| finite_squares(s, *weight)).sum::<f64>();
    }
    Ok((power <= noise).then_some(shifts))
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
    pub fn without_refinement(attempt: OptimizationResult, grid: Objective<'a>) -> Result<Self> {
        let covariance = covariance(&attempt, &grid)?;
        Ok(Self { estimate: attempt.values(), step_converged: true, covariance, attempt, grid })
    }

    /// Convert to the statistics of the optimum, with noise levels and residuals.
    #[must_use]
    pub fn into_statistics(self) -> OptimumStatistics {
        let Self { attempt, grid, estimate, step_converged: has_converged, covariance } = self;
        let robust = grid.weights.robust_weights.is_some();
        let levels = if robust { grid.residual_scales(&attempt) } else { grid.residual_root_mean_squares(&attempt) };
        let inside = |(value, (low, high)): (f64, (f64, f64))| value.clamp(low, high);
        let mut residuals = grid.residuals(&attempt);
        for run in &mut residuals {
            // The weights equal the inverse noise levels within a tolerance only, so the residuals are scaled again.
            for (series, &level) in run.iter_mut().zip(&levels).filter(|(_, level)| **level > 0.0) {
                series.iter_mut().for_each(|e| *e /= level);
            }
        }
        OptimumStatistics {
            estimate: estimate.into_iter().zip(grid.problem.bounds()).map(inside).collect(),
            noise: levels.iter().zip(&grid.weights.outputs).map(|(level, weight)| level / weight).collect(),
            residuals,
            robust: robust.then(|| RobustSummary::from_result(&grid, &attempt)),
            weights: grid.weights,
            pulses_per_sample: grid.sampling.pulses_per_sample,
            prior_fractions: prior_fractions(&attempt, &grid.problem.model.priors),
            attempt,
            step_converged: has_converged,
            covariance,
        }
    }
}

/// Return the fraction of the information on its parameter that each prior contributes; NaN if not computable.
fn prior_fractions(attempt: &OptimizationResult, priors: &[Prior]) -> Vec<f64> {
    let size = attempt.jacobian.len();
    let posterior = covariance_of_residuals(&attempt.jacobian, &[], 1.0, priors.len()).unwrap_or_default();
    let variance = |parameter: usize| posterior.get(parameter * size + parameter).copied().unwrap_or(f64::NAN);
    priors.iter().map(|prior| variance(prior.parameter) / prior.deviation.powi(2)).collect()
}

/// Return true if two estimates differ by at most a tenth of the standard errors in scaled time.
///
/// The standard errors are those of the covariance matrix `spread` at the parameter values `at`.
fn is_within_errors(time_scaling: &TimeScaling, one: &[f64], other: &[f64], (at, spread): (&[f64], &[f64])) -> bool {
    let pairs = time_scaling.to_scaled(one).into_iter().zip(time_scaling.to_scaled(other));
    let errors = time_scaling.standard_errors(at, spread);
    pairs.zip(&errors).all(|((a, b), error)| (a - b).abs() <= MAX_CHANGE_STANDARD_ERRORS * error)
}

/// Extrapolate the estimates of two pulse grids to zero step: add the difference `fine` − `coarse`, divided by `share`,
/// to `fine`.
///
/// The result is limited to feasible values.
fn extrapolate(
    grid: &Objective<'_>,
    time_scaling: &TimeScaling,
    fine: &[f64],
    coarse: &[f64],
    share: f64,
) -> Result<Vec<f64>> {
    let (fine, coarse) = (time_scaling.to_scaled(fine), time_scaling.to_scaled(coarse));
    let target: Vec<f64> = fine.iter().zip(&coarse).map(|(f, c)| f + (f - c) / share).collect();
    Ok(time_scaling.to_unscaled(&grid.problem.last_feasible_point(&fine, &target)?))
}

/// Return the initial guess of the fit at half the step.
///
/// The optimum is expected to move a quarter as far as at the last halving.
fn extrapolated_start(
    grid: &Objective<'_>,
    time_scaling: &TimeScaling,
    best: &OptimizationResult,
    before: Option<&OptimizationResult>,
) -> Result<Iterate> {
    match before {
        Some(before) if best.has_converged() && before.has_converged() => {
            Ok(best.iterate_at(&extrapolate(grid, time_scaling, &best.values(), &before.values(), 4.0)?))
        }
        _ => Ok(best.iterate.clone()),
    }
}

/// Return the best fit that starts from one of `others`, with converged weights; None if no such fit is better than the
/// result `stalled`.
///
/// `stalled` stopped at the limit of its domain. Unstable candidates are excluded if the objective requires stability.
///
/// # Errors
/// [`Error::Interrupted`] after a stop request.
pub fn best_alternative<'a>(
    stalled: &OptimizationResult,
    grid: &Objective<'a>,
    others: &[Iterate],
    loss: Loss,
) -> Result<Option<(OptimizationResult, Objective<'a>)>> {
    let (mut best, mut least) = (None, negative_log_likelihood(stalled, grid));
    for other in others {
        let outcome = match fit_reweighted(other, grid.clone(), loss) {
            Err(Error::Interrupted) => return Err(Error::Interrupted),
            Err(_) => continue,
            Ok(outcome) => outcome,
        };
        let level = negative_log_likelihood(&outcome.0, &outcome.1);
        if level < least && !(grid.requires_stability && grid.problem.is_unstable(&outcome.0.iterate.point)) {
            (best, least) = (Some(outcome), level);
        }
    }
    Ok(best)
}

/// Negative log-likelihood per sample, summed over outputs, up to a constant.
fn negative_log_likelihood(attempt: &OptimizationResult, grid: &Objective<'_>) -> f64 {
    grid.residual_root_mean_squares(attempt)
        .iter()
        .zip(&grid.weights.outputs)
        .map(|(level, w)| libm::log(level.max(1e-300) / w))
        .sum()
}

/// Return the extrapolated estimate `limit` or the optimum `best` of the finest pulse grid, whichever fits better at
/// half the step.
///
/// If poorly determined parameters have a curved valley, a straight extrapolation leaves the valley. The limit is
/// returned without this comparison if the residuals hardly change between both points. It is also returned if they
/// change linearly and the step has converged.
fn select_limit_or_optimum(
    best: &OptimizationResult,
    grid: &Objective<'_>,
    limit: Vec<f64>,
    time_scaling: &TimeScaling,
    has_converged: bool,
) -> Result<Vec<f64>> {
    let own_values = best.values();
    let shift: Vec<f64> =
        time_scaling.to_scaled(&limit).iter().zip(time_scaling.to_scaled(&own_values)).map(|(a, b)| a - b).collect();
    let mut change = vec![0.0; best.residuals.len()];
    for (by, column) in time_scaling.step(&own_values, &shift).iter().zip(&best.jacobian) {
        change.iter_mut().zip(column).for_each(|(sum, slope)| *sum += by * slope);
    }
    let length = |row: &[f64]| inner(row, row).sqrt();
    if inner(&change, &change) <= MAX_CHANGE_STANDARD_ERRORS * MAX_CHANGE_STANDARD_ERRORS {
        // Both points have nearly the same residuals.
        return Ok(limit);
    }
    let limit_iterate = best.iterate_at(&limit);
    if has_converged && let Some(evaluation) = grid.evaluate(&limit_iterate)? {
        let predicted = best.residuals.iter().zip(&change).map(|(e, w)| e + w);
        let deviation: Vec<f64> =
            evaluation.residuals.iter().zip(predicted).map(|(e, predicted)| e - predicted).collect();
        if length(&deviation) <= MAX_CHANGE_STANDARD_ERRORS * length(&change) {
            return Ok(limit);
        }
    }
    let finer = match grid.finer() {
        Ok(finer) => finer,
        Err(Error::Interrupted) => return Err(Error::Interrupted),
        // Neither point can be simulated on half the step.
        Err(_) => return Ok(limit),
    };
    let mut costs = [f64::INFINITY; 2];
    for (cost, place) in costs.iter_mut().zip([&limit_iterate, &best.iterate]) {
        if let Some(evaluation) = finer.evaluate(place)? {
            *cost = evaluation.cost;
        }
    }
    Ok(if costs[0] <= costs[1] { limit } else { own_values })
}

//! Iterative reweighting: noise levels of the outputs and Huber weights of the samples.
//!
//! The minimum of Huber's loss is found by iteratively reweighted least squares (doi:10.1214/aoms/1177703732,
//! doi:10.1080/03610927708827533). The scale is the median absolute residual, which is robust to outliers.

use super::objective::{Objective, Weights};
use super::problem::{Iterate, OptimizationResult};
use crate::error::{Error, Result};
use crate::signal::statistics::HUBER_THRESHOLD;

/// Magnitude of an outlier in standard deviations. Normal noise exceeds it once in two million samples.
const OUTLIER_DEVIATIONS: f64 = 5.0;
/// Change of the robust weights below which they have converged.
const ROBUST_WEIGHT_TOLERANCE: f64 = 2e-3;
/// Lower limit of a standard deviation that is a divisor.
const MIN_DEVIATION: f64 = 1e-300;

/// Loss function of the residuals.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Loss {
    /// The squared residuals (least squares).
    Squares,
    /// Huber's loss.
    Huber,
}

/// Counts of downweighted residuals and of outliers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct RobustSummary {
    /// Number of residuals beyond 1.345 standard deviations, which are downweighted. For normal noise, this is 18 % of
    /// all residuals.
    pub reduced_weight_count: usize,
    /// Number of residuals beyond five standard deviations.
    pub outliers: usize,
    /// Number of residuals, without missing samples.
    pub samples: usize,
}

impl RobustSummary {
    /// Count the downweighted residuals and the outliers at an optimum.
    #[must_use]
    pub fn from_result(objective: &Objective<'_>, result: &OptimizationResult) -> Self {
        let mut summary = Self { reduced_weight_count: 0, outliers: 0, samples: 0 };
        for (residuals, level) in objective.residuals_by_output(result).iter().zip(objective.residual_scales(result)) {
            let count_above =
                |limit: f64| residuals.iter().filter(|e| (*e / level.max(MIN_DEVIATION)).abs() > limit).count();
            summary.reduced_weight_count += count_above(HUBER_THRESHOLD);
            summary.outliers += count_above(OUTLIER_DEVIATIONS);
            summary.samples += residuals.len();
        }
        summary
    }
}

/// Square roots of Huber's weights of the compared samples, by run and output; 1 for missing samples.
///
/// `levels` contains the standard deviation of the residuals of each output.
pub(super) fn huber_weights(
    objective: &Objective<'_>,
    result: &OptimizationResult,
    levels: &[f64],
) -> Vec<Vec<Vec<f64>>> {
    let weight_root = |size: f64| if size > HUBER_THRESHOLD { (HUBER_THRESHOLD / size).sqrt() } else { 1.0 };
    let weights_of_output =
        |(e, level): (Vec<f64>, &f64)| e.iter().map(|e| weight_root(e.abs() / level.max(MIN_DEVIATION))).collect();
    let residuals_by_run = objective.residuals(result).into_iter();
    residuals_by_run.map(|run| run.into_iter().zip(levels).map(weights_of_output).collect()).collect()
}

/// Return true if two sets of robust weights agree within the tolerance, or if there are none.
pub(super) fn are_weights_equal(before: Option<&Vec<Vec<Vec<f64>>>>, after: Option<&Vec<Vec<Vec<f64>>>>) -> bool {
    let flat =
        |robust_weights: &Vec<Vec<Vec<f64>>>| robust_weights.iter().flatten().flatten().copied().collect::<Vec<_>>();
    match (before, after) {
        (None, None) => true,
        (Some(a), Some(b)) => flat(a).iter().zip(flat(b)).all(|(a, b)| (a - b).abs() <= ROBUST_WEIGHT_TOLERANCE),
        _ => false,
    }
}

/// Maximum number of evaluations of each optimization between two reweightings.
pub const EVALUATIONS_PER_REWEIGHTING: usize = 120;
/// Maximum number of reweightings with squared loss.
const MAX_REWEIGHTINGS: usize = 4;
/// Maximum number of reweightings with Huber's loss. Each reduces the error of the weights by a factor of about four.
const MAX_ROBUST_REWEIGHTINGS: usize = 15;
/// Relative deviation of a noise level from the inverse weight of its output below which the weights have converged.
const NOISE_LEVEL_TOLERANCE: f64 = 0.01;

/// Fit by iteratively reweighted least squares, until all weights match the residuals over all runs.
///
/// Return the optimum and the objective with the final weights.
///
/// # Errors
/// The error of the simulation of `start` if it fails. [`Error::Overflow`] if the residuals overflow.
/// [`Error::Interrupted`] after a stop request.
pub fn fit_reweighted<'a>(
    start: &Iterate,
    objective: Objective<'a>,
    loss: Loss,
) -> Result<(OptimizationResult, Objective<'a>)> {
    let max_reweightings = if loss == Loss::Huber { MAX_ROBUST_REWEIGHTINGS } else { MAX_REWEIGHTINGS };
    // The residuals of noise-free samples are rounding errors, so the weights have upper limits relative to the first
    // ones.
    let limits: Vec<f64> = objective.weights.outputs.iter().map(|weight| weight / f64::EPSILON).collect();
    let (mut iterate, mut objective, mut reweighting) = (start.clone(), objective, 0);
    loop {
        reweighting += 1;
        let result = objective.minimize(&iterate, EVALUATIONS_PER_REWEIGHTING)?;
        let levels = if loss == Loss::Huber {
            objective.residual_scales(&result)
        } else {
            objective.residual_root_mean_squares(&result)
        };
        if let Some(output) = levels.iter().position(|level| !level.is_finite()) {
            return Err(Error::Overflow { output: objective.problem.outputs[output].clone() });
        }
        let has_converged = levels.iter().all(|level| (level - 1.0).abs() < NOISE_LEVEL_TOLERANCE);
        let robust_weights = (loss == Loss::Huber).then(|| huber_weights(&objective, &result, &levels));
        if reweighting == max_reweightings
            || (has_converged && are_weights_equal(objective.weights.robust_weights.as_ref(), robust_weights.as_ref()))
        {
            return Ok((result, objective));
        }
        let inverse = objective.weights.outputs.iter().zip(&levels).map(|(weight, level)| weight / level);
        let outputs = inverse.zip(&limits).map(|(weight, &limit)| weight.min(limit)).collect();
        objective = objective.with_weights(Weights { outputs, robust_weights })?;
        iterate = result.iterate;
    }
}

//! Step refinement: the step is halved until the estimate changes by a small part of its standard error.

use super::covariance::covariance;
use super::objective::{Grid, Weights, FINEST};
use super::parameter_set::Clock;
use super::problem::{Attempt, Place};
use super::reweighting::{settled, Loss, Robust};
use crate::error::{Error, Result};
use crate::estimation::output_error::Status;
use crate::signal::statistics::inner;

/// Change of an estimate, or of its extrapolation to zero step, below which the refinement has converged.
const REFINED: f64 = 0.1;
/// Increase of the log residuals by halving the step above which other survivors are tried on the finer grid.
const ROSE: f64 = 5e-4;

/// Optimum on the finest grid, and its extrapolation to zero step.
#[derive(Clone)]
pub struct Optimum<'a> {
    /// The optimum of the finest grid.
    pub attempt: Attempt,
    /// That grid.
    pub grid: Grid<'a>,
    /// Parameters extrapolated to zero step from two grids.
    pub estimate: Vec<f64>,
    /// True if halving the step changed no estimate by more than a tenth of its standard error.
    pub settled: bool,
    covariance: Vec<f64>,
}

/// Optimum with its covariance, noise levels and residuals.
#[derive(Debug, Clone, PartialEq)]
pub struct Finished {
    /// The optimum of the finest grid.
    pub attempt: Attempt,
    /// Weights at the optimum.
    pub weights: Weights,
    /// Block pulses per sampling interval of that grid.
    pub every: usize,
    /// Parameters extrapolated to zero step, within bounds.
    pub estimate: Vec<f64>,
    /// True if halving the step changed no estimate by more than a tenth of its standard error.
    pub settled: bool,
    /// Row-major covariance of the parameters.
    pub covariance: Vec<f64>,
    /// Standard deviation of the residuals by output; with a robust loss from the median absolute residual.
    pub noise: Vec<f64>,
    /// Residuals in units of the noise by run and output; NaN for missing samples.
    pub residuals: Vec<Vec<Vec<f64>>>,
    /// Counts of downweighted residuals of a robust loss; None for squares.
    pub robust: Option<Robust>,
}

/// Halve the step until the estimate changes by a small part of its standard error.
///
/// On a coarse grid an optimization can follow a flat valley to the limit of its domain, where a finer grid makes no
/// progress. Then the other survivors are optimized on the finer grid as well.
///
/// # Errors
/// As [`fit_reweighted`] and [`covariance`].
pub fn refined<'a>(best: Attempt, grid: Grid<'a>, loss: Loss, others: &[Place]) -> Result<Optimum<'a>> {
    let clock = grid.clock();
    let (mut best, mut grid, mut others) = (best, grid, others);
    let (mut estimate, mut still, mut before) = (best.values(), false, None::<Attempt>);
    let mut spread = None;
    while !still && grid.sampling.every < FINEST {
        // Residuals can shrink to the noise on a finer grid, so the weights are iterated again.
        let half = grid.finer()?;
        let start = expected(&half, &clock, &best, before.as_ref())?;
        let (finer, fine) = match settled(&start, half.clone(), loss) {
            // The extrapolated start may have no finite simulation.
            Err(error) if error != Error::Interrupted => settled(&best.place, half, loss)?,
            found => found?,
        };
        let rose = likelihood(&finer, &fine) > likelihood(&best, &grid) + ROSE;
        let mut fine = fine;
        if (finer.status == Status::Wall && before.is_none()) || (rose && !others.is_empty()) {
            let freed = freed(&finer, &fine, others, loss)?;
            // The other survivors are tried once.
            others = &[];
            if let Some((other, there)) = freed {
                // The two grids have different optima, so they cannot be extrapolated.
                (before, spread) = (None, None);
                estimate = other.values();
                (best, grid) = (other, there);
                continue;
            }
        }
        std::mem::swap(&mut grid, &mut fine);
        let (there, here) = (finer.values(), best.values());
        let found = covariance(&finer, &grid)?;
        let errors = clock.errors(&there, &found);
        // The scheme is of second order: Richardson extrapolation of two grids gives the limit, a third grid confirms
        // it. Optimizations that did not converge cannot be extrapolated.
        let mut limit = there.clone();
        if finer.converged() && best.converged() {
            limit = beyond(&grid, &clock, &there, &here, 3.0)?;
        }
        let moved = |one: &[f64], other: &[f64]| {
            let ways = clock.told(one).into_iter().zip(clock.told(other));
            ways.zip(&errors).all(|((a, b), error)| (a - b).abs() <= REFINED * error)
        };
        still = moved(&limit, &estimate) || moved(&there, &here);
        estimate = limit;
        (before, best, spread) = (Some(best), finer, Some(found));
    }
    let spread = spread.map_or_else(|| covariance(&best, &grid), Ok)?;
    let estimate = nearer(&best, &grid, estimate, &clock, still)?;
    Ok(Optimum { attempt: best, grid, estimate, settled: still, covariance: spread })
}

impl<'a> Optimum<'a> {
    /// Optimum of a grid without refinement.
    ///
    /// # Errors
    /// As [`covariance`].
    pub fn unrefined(attempt: Attempt, grid: Grid<'a>) -> Result<Self> {
        let covariance = covariance(&attempt, &grid)?;
        Ok(Self { estimate: attempt.values(), settled: true, covariance, attempt, grid })
    }

    /// Compute covariance, noise levels and residuals of the optimum.
    #[must_use]
    pub fn finished(self) -> Finished {
        let Self { attempt, grid, estimate, settled, covariance } = self;
        let robust = grid.weights.shares.is_some();
        let levels = if robust { grid.scales(&attempt) } else { grid.levels(&attempt) };
        let inside = |(value, (low, high)): (f64, (f64, f64))| value.clamp(low, high);
        Finished {
            estimate: estimate.into_iter().zip(grid.problem.bounds()).map(inside).collect(),
            noise: levels.iter().zip(&grid.weights.outputs).map(|(level, weight)| level / weight).collect(),
            residuals: grid.residuals(&attempt),
            robust: robust.then(|| Robust::of(&grid, &attempt)),
            weights: grid.weights,
            every: grid.sampling.every,
            attempt,
            settled,
            covariance,
        }
    }
}

/// Extrapolate two grids beyond the finer one, by the difference divided by `share`.
fn beyond(grid: &Grid<'_>, clock: &Clock, fine: &[f64], coarse: &[f64], share: f64) -> Result<Vec<f64>> {
    let (fine, coarse) = (clock.told(fine), clock.told(coarse));
    let ahead: Vec<f64> = fine.iter().zip(&coarse).map(|(f, c)| f + (f - c) / share).collect();
    Ok(clock.untold(&grid.problem.feasible(&fine, &ahead)?))
}

/// Start on half the step: the optimum is expected to move a quarter as far as at the last halving.
fn expected(grid: &Grid<'_>, clock: &Clock, best: &Attempt, before: Option<&Attempt>) -> Result<Place> {
    match before {
        Some(before) if best.converged() && before.converged() => {
            Ok(best.at(&beyond(grid, clock, &best.values(), &before.values(), 4.0)?))
        }
        _ => Ok(best.place.clone()),
    }
}

/// Best other candidate, with converged weights, if it fits better than one stopped at the limit of its domain.
///
/// Unstable candidates are excluded if the objective requires stability.
///
/// # Errors
/// [`Error::Interrupted`].
pub fn freed<'a>(
    stuck: &Attempt,
    grid: &Grid<'a>,
    others: &[Place],
    loss: Loss,
) -> Result<Option<(Attempt, Grid<'a>)>> {
    let (mut best, mut least) = (None, likelihood(stuck, grid));
    for other in others {
        let there = match settled(other, grid.clone(), loss) {
            Err(Error::Interrupted) => return Err(Error::Interrupted),
            Err(_) => continue,
            Ok(there) => there,
        };
        let level = likelihood(&there.0, &there.1);
        if level < least && !(grid.steady && grid.problem.grows(&there.0.place.point)) {
            (best, least) = (Some(there), level);
        }
    }
    Ok(best)
}

/// Negative log-likelihood per sample, up to a constant.
fn likelihood(attempt: &Attempt, grid: &Grid<'_>) -> f64 {
    grid.levels(attempt).iter().zip(&grid.weights.outputs).map(|(level, w)| libm::log(level.max(1e-300) / w)).sum()
}

/// Select the extrapolated limit or the optimum of the finer grid, whichever fits better on half the step.
///
/// Extrapolation along a straight line leaves a flat curved valley of poorly determined parameters. If the residuals
/// are linear along the line and the grids agree, the limit is better.
fn nearer(best: &Attempt, grid: &Grid<'_>, limit: Vec<f64>, clock: &Clock, settled: bool) -> Result<Vec<f64>> {
    let here = best.values();
    let moved: Vec<f64> = clock.told(&limit).iter().zip(clock.told(&here)).map(|(a, b)| a - b).collect();
    let mut way = vec![0.0; best.residuals.len()];
    for (by, column) in clock.step(&here, &moved).iter().zip(&best.jacobian) {
        way.iter_mut().zip(column).for_each(|(sum, slope)| *sum += by * slope);
    }
    let length = |row: &[f64]| inner(row, row).sqrt();
    if inner(&way, &way) <= REFINED * REFINED {
        // Both have the same residuals.
        return Ok(limit);
    }
    let ahead = best.at(&limit);
    if settled {
        if let Some(there) = grid.evaluated(&ahead)? {
            let told = best.residuals.iter().zip(&way).map(|(e, w)| e + w);
            let bent: Vec<f64> = there.residuals.iter().zip(told).map(|(e, told)| e - told).collect();
            if length(&bent) <= REFINED * length(&way) {
                return Ok(limit);
            }
        }
    }
    let finer = match grid.finer() {
        Ok(finer) => finer,
        Err(Error::Interrupted) => return Err(Error::Interrupted),
        // Neither can be simulated on half the step.
        Err(_) => return Ok(limit),
    };
    let mut costs = [f64::INFINITY; 2];
    for (cost, place) in costs.iter_mut().zip([&ahead, &best.place]) {
        if let Some(there) = finer.evaluated(place)? {
            *cost = there.cost;
        }
    }
    Ok(if costs[0] <= costs[1] { limit } else { here })
}

//! Halving the step until that moves the estimate by little of its standard error.

use super::covariance::covariance;
use super::objective::{Grid, Weights, FINEST};
use super::parameter_set::Clock;
use super::problem::{Attempt, Place};
use super::reweighting::{settled, Loss, Robust};
use crate::error::{Error, Result};
use crate::estimation::output_error::Status;
use crate::signal::statistics::inner;

/// Refinement ends when halving the step moves no estimate, or none extrapolated to step 0, by this share of its standard
/// error.
const REFINED: f64 = 0.1;
/// Logarithm of residuals by which halving the step may raise them before other starts have their way on the finer grid.
const ROSE: f64 = 5e-4;

/// Where a fit ended on its finest grid, and its estimate at step 0.
#[derive(Clone)]
pub struct Optimum<'a> {
    /// The optimum of the finest grid.
    pub attempt: Attempt,
    /// That grid.
    pub grid: Grid<'a>,
    /// Parameters at step 0, as far as two grids tell them.
    pub estimate: Vec<f64>,
    /// Whether halving the step moved no estimate by a tenth of its standard error.
    pub settled: bool,
    covariance: Vec<f64>,
}

/// An optimum with all that describes it.
#[derive(Debug, Clone, PartialEq)]
pub struct Finished {
    /// The optimum of the finest grid.
    pub attempt: Attempt,
    /// Its weights.
    pub weights: Weights,
    /// Pulses a sample interval of that grid.
    pub every: usize,
    /// Parameters at step 0, within bounds.
    pub estimate: Vec<f64>,
    /// Whether halving the step moved no estimate by a tenth of its standard error.
    pub settled: bool,
    /// Of the parameters, by rows.
    pub covariance: Vec<f64>,
    /// Standard deviation of the residuals by output; under a robust loss from the median of their sizes.
    pub noise: Vec<f64>,
    /// Residuals over the noise by run and output; not a number where none was read.
    pub residuals: Vec<Vec<Vec<f64>>>,
    /// What a robust loss did; none for squares.
    pub robust: Option<Robust>,
}

/// Halves the step until that moves the estimate by little of its standard error.
///
/// A coarse grid may lead along a flat valley to where equations end, and there a finer one leads nowhere: then others have
/// their way on it as well.
///
/// # Errors
/// Those of [`settled`] and of [`covariance`].
pub fn refined<'a>(best: Attempt, grid: Grid<'a>, loss: Loss, others: &[Place]) -> Result<Optimum<'a>> {
    let clock = grid.clock();
    let (mut best, mut grid, mut others) = (best, grid, others);
    let (mut estimate, mut still, mut before) = (best.values(), false, None::<Attempt>);
    let mut spread = None;
    while !still && grid.sampling.every < FINEST {
        // On a finer grid residuals may shrink to their noise, so weights follow anew.
        let half = grid.finer()?;
        let start = expected(&half, &clock, &best, before.as_ref())?;
        let (finer, fine) = match settled(&start, half.clone(), loss) {
            // Where two grids point there may be no free run.
            Err(error) if error != Error::Interrupted => settled(&best.place, half, loss)?,
            found => found?,
        };
        let rose = likelihood(&finer, &fine) > likelihood(&best, &grid) + ROSE;
        let mut fine = fine;
        if (finer.status == Status::Wall && before.is_none()) || (rose && !others.is_empty()) {
            let freed = freed(&finer, &fine, others, loss)?;
            // They have had their way.
            others = &[];
            if let Some((other, there)) = freed {
                // Two grids have two optima, of which they tell nothing together.
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
        // The scheme is of second order, so two grids tell the limit (Richardson); a third tells whether that is so. Of a
        // flat valley in which neither stood still, or of two fits that a wall stopped, they tell nothing.
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
    /// An optimum of a grid that is not refined.
    ///
    /// # Errors
    /// Those of [`covariance`].
    pub fn unrefined(attempt: Attempt, grid: Grid<'a>) -> Result<Self> {
        let covariance = covariance(&attempt, &grid)?;
        Ok(Self { estimate: attempt.values(), settled: true, covariance, attempt, grid })
    }

    /// The optimum with its covariance, its noise and its residuals.
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

/// Where two grids point from the finer one, a share of the way that led there.
fn beyond(grid: &Grid<'_>, clock: &Clock, fine: &[f64], coarse: &[f64], share: f64) -> Result<Vec<f64>> {
    let (fine, coarse) = (clock.told(fine), clock.told(coarse));
    let ahead: Vec<f64> = fine.iter().zip(&coarse).map(|(f, c)| f + (f - c) / share).collect();
    Ok(clock.untold(&grid.problem.feasible(&fine, &ahead)?))
}

/// Where to begin on half the step: what moved the optimum from the last grid to this moves it a quarter as far.
fn expected(grid: &Grid<'_>, clock: &Clock, best: &Attempt, before: Option<&Attempt>) -> Result<Place> {
    match before {
        Some(before) if best.converged() && before.converged() => {
            Ok(best.at(&beyond(grid, clock, &best.values(), &before.values(), 4.0)?))
        }
        _ => Ok(best.place.clone()),
    }
}

/// Another attempt on the grid of one that a wall stopped, its weights settled, if that leaves less; none that grows where
/// the grid is steady.
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

/// Minus the logarithm of the likelihood per sample, but for a constant.
fn likelihood(attempt: &Attempt, grid: &Grid<'_>) -> f64 {
    grid.levels(attempt).iter().zip(&grid.weights.outputs).map(|(level, w)| libm::log(level.max(1e-300) / w)).sum()
}

/// What is nearer to the truth on half the step, the limit that two grids tell or the optimum of the finer one.
///
/// Along the bottom of a flat and curved valley, where numbers cannot be told apart, a straight line leads out of it. Where
/// the residuals follow it there is none, and a limit on which grids agree is nearer.
fn nearer(best: &Attempt, grid: &Grid<'_>, limit: Vec<f64>, clock: &Clock, settled: bool) -> Result<Vec<f64>> {
    let here = best.values();
    let moved: Vec<f64> = clock.told(&limit).iter().zip(clock.told(&here)).map(|(a, b)| a - b).collect();
    let mut way = vec![0.0; best.residuals.len()];
    for (by, column) in clock.step(&here, &moved).iter().zip(&best.jacobian) {
        way.iter_mut().zip(column).for_each(|(sum, slope)| *sum += by * slope);
    }
    let length = |row: &[f64]| inner(row, row).sqrt();
    if inner(&way, &way) <= REFINED * REFINED {
        // Both leave the same.
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
        // Neither has a free run there.
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

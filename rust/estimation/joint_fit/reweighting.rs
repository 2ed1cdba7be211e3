//! Huber's loss: squares for usual residuals, sizes for the others, so that a few that are far off decide nothing.
//!
//! The minimum is found by least squares with weights that follow the residuals until they stand still (doi:10.1214/aoms/
//! 1177703732, doi:10.1080/03610927708827533). The scale is the median of the sizes, which outliers do not move.
//!
//! Descents until each output weighs by its own residuals.

use super::objective::{Grid, Weights};
use super::problem::{Attempt, Place};
use crate::error::{Error, Result};
use crate::signal::statistics::BEND;

/// Residuals beyond so many deviations are outliers: of normal noise one in two millions is.
const FAR: f64 = 5.0;
/// Shares are settled when none moves by more than this.
const ROBUST_WEIGHT_TOLERANCE: f64 = 2e-3;
/// Deviations below this are none.
const TINY: f64 = 1e-300;

/// What residuals cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Loss {
    /// Their squares.
    Squares,
    /// Squares of usual ones, sizes of the others.
    Huber,
}

/// What a robust loss did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Robust {
    /// Residuals beyond 1.345 deviations, which count less; of normal noise 18 % are.
    pub lowered: usize,
    /// Those beyond five.
    pub outliers: usize,
    /// Residuals in all.
    pub samples: usize,
}

impl Robust {
    /// Counted at an optimum.
    #[must_use]
    pub fn of(grid: &Grid<'_>, attempt: &Attempt) -> Self {
        let mut counted = Self { lowered: 0, outliers: 0, samples: 0 };
        for (residuals, level) in grid.pooled(attempt).iter().zip(grid.scales(attempt)) {
            let beyond = |most: f64| residuals.iter().filter(|e| (*e / level.max(TINY)).abs() > most).count();
            counted.lowered += beyond(BEND);
            counted.outliers += beyond(FAR);
            counted.samples += residuals.len();
        }
        counted
    }
}

/// Roots of Huber's weights of the compared samples, by run and output; 1 where nothing was read.
pub(super) fn huber(grid: &Grid<'_>, attempt: &Attempt, levels: &[f64]) -> Vec<Vec<Vec<f64>>> {
    let root = |size: f64| if size > BEND { (BEND / size).sqrt() } else { 1.0 };
    let of = |(e, level): (Vec<f64>, &f64)| e.iter().map(|e| root(e.abs() / level.max(TINY))).collect();
    let parts = grid.residuals(attempt).into_iter();
    parts.map(|part| part.into_iter().zip(levels).map(of).collect()).collect()
}

/// Whether shares have settled.
pub(super) fn same(before: Option<&Vec<Vec<Vec<f64>>>>, after: Option<&Vec<Vec<Vec<f64>>>>) -> bool {
    let flat = |shares: &Vec<Vec<Vec<f64>>>| shares.iter().flatten().flatten().copied().collect::<Vec<_>>();
    match (before, after) {
        (None, None) => true,
        (Some(a), Some(b)) => flat(a).iter().zip(flat(b)).all(|(a, b)| (a - b).abs() <= ROBUST_WEIGHT_TOLERANCE),
        _ => false,
    }
}

/// Evaluations of each descent.
pub const LAST_LAP: usize = 120;
/// Descents to settled weights, and to those of a robust loss, which settle by a factor of some four each.
const ROUNDS: usize = 4;
const ROBUST_ROUNDS: usize = 15;
/// Weights are settled when no output's residuals differ from their weight by more than this share.
const NOISE_LEVEL_TOLERANCE: f64 = 0.01;

/// Descends on a grid until the weights are those of the residuals, pooled over runs, and so are robust shares.
///
/// # Errors
/// Those of [`Grid::descend`]; [`Error::Beyond`] where it ends beyond the range of numbers.
pub fn settled<'a>(start: &Place, grid: Grid<'a>, loss: Loss) -> Result<(Attempt, Grid<'a>)> {
    let rounds = if loss == Loss::Huber { ROBUST_ROUNDS } else { ROUNDS };
    let (mut place, mut grid, mut turn) = (start.clone(), grid, 0);
    loop {
        turn += 1;
        let attempt = grid.descend(&place, LAST_LAP)?;
        let levels = if loss == Loss::Huber { grid.scales(&attempt) } else { grid.levels(&attempt) };
        if let Some(beyond) = levels.iter().position(|level| !level.is_finite()) {
            return Err(Error::Beyond { output: grid.problem.outputs[beyond].clone() });
        }
        let still = levels.iter().all(|level| (level - 1.0).abs() < NOISE_LEVEL_TOLERANCE);
        let shares = (loss == Loss::Huber).then(|| huber(&grid, &attempt, &levels));
        if turn == rounds || (still && same(grid.weights.shares.as_ref(), shares.as_ref())) {
            return Ok((attempt, grid));
        }
        let outputs = grid.weights.outputs.iter().zip(&levels).map(|(w, level)| w / level.max(1e-300)).collect();
        grid = grid.reweighed(Weights { outputs, shares })?;
        place = attempt.place;
    }
}

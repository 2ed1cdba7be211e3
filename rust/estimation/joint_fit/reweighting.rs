//! Huber's loss: squares for usual residuals, sizes for the others, so that a few that are far off decide nothing.
//!
//! The minimum is found by least squares with weights that follow the residuals until they stand still (doi:10.1214/aoms/
//! 1177703732, doi:10.1080/03610927708827533). The scale is the median of the sizes, which outliers do not move.

use super::attempt::Attempt;
use super::objective::Grid;
use crate::signal::statistics::BEND;

/// Residuals beyond so many deviations are outliers: of normal noise one in two millions is.
const FAR: f64 = 5.0;
/// Shares are settled when none moves by more than this.
const SETTLED: f64 = 2e-3;
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
        (Some(a), Some(b)) => flat(a).iter().zip(flat(b)).all(|(a, b)| (a - b).abs() <= SETTLED),
        _ => false,
    }
}

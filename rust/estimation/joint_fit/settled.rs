//! Descents until each output weighs by its own residuals.

use super::attempt::{Attempt, Place};
use super::objective::{Grid, Weights};
use super::reweighting::{self, Loss};
use crate::error::{Error, Result};

/// Evaluations of each descent.
pub const LAST_LAP: usize = 120;
/// Descents to settled weights, and to those of a robust loss, which settle by a factor of some four each.
const ROUNDS: usize = 4;
const ROBUST_ROUNDS: usize = 15;
/// Weights are settled when no output's residuals differ from their weight by more than this share.
const SETTLED: f64 = 0.01;

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
        let still = levels.iter().all(|level| (level - 1.0).abs() < SETTLED);
        let shares = (loss == Loss::Huber).then(|| reweighting::huber(&grid, &attempt, &levels));
        if turn == rounds || (still && reweighting::same(grid.weights.shares.as_ref(), shares.as_ref())) {
            return Ok((attempt, grid));
        }
        let outputs = grid.weights.outputs.iter().zip(&levels).map(|(w, level)| w / level.max(1e-300)).collect();
        grid = grid.reweighed(Weights { outputs, shares })?;
        place = attempt.place;
    }
}

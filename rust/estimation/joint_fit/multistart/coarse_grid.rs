//! A grid on which starts may compete.

use super::halving::{distinct, near, same_optimum, same_place, Laps, FIRST_LAP, GLANCE};
use crate::error::Result;
use crate::estimation::joint_fit::objective::{Grid, FINEST};
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::runner::Runner;

/// Starts that tell how fine the grid must be on which all compete.
const PIONEERS: usize = 3;
/// A coarse grid tells where starts lead if a finer one moves no number of the best by more than this share.
const MOVED: f64 = 0.1;

/// A grid on which starts may compete.
pub(super) struct Chosen<'a> {
    pub grid: Grid<'a>,
    /// The same on half the step, where it was made.
    pub half: Option<Grid<'a>>,
    /// Where the others are after a glance.
    pub glanced: Vec<Runner>,
    /// Where a few are after a lap.
    pub ran: Vec<Runner>,
}

/// A grid on which starts may compete, as far as a few tell.
///
/// A stiff equation may have no stable scheme, and so no start, on a coarse grid; and a coarse grid has optima of its own:
/// all start anew on the grid on which those few no longer move.
pub(super) fn fine_enough<'a>(laps: Laps<'_>, free: &Free, coarse: Grid<'a>, starts: &[Runner]) -> Result<Chosen<'a>> {
    let glance = |grid: &Grid<'_>, starts: &[Runner]| Ok(distinct(&laps.run(free, grid, starts, GLANCE)?, same_place));
    let mut glanced: Vec<Runner> = glance(&coarse, starts)?;
    if starts.len() <= PIONEERS || coarse.sampling.every >= FINEST {
        return Ok(Chosen { grid: coarse, half: None, glanced, ran: Vec::new() });
    }
    let (first, mut coarse) = (coarse.sampling.every, coarse);
    let mut before: Vec<(Grid<'a>, Runner)> = Vec::new();
    let mut pioneers: Vec<Runner> = glanced.iter().take(PIONEERS).cloned().collect();
    let mut half = None;
    let reached = loop {
        if coarse.sampling.every >= FINEST {
            break pioneers;
        }
        let reached = laps.run(free, &coarse, &pioneers, FIRST_LAP)?;
        let finer = coarse.finer()?;
        if let Some(best) = reached.first() {
            if !coarse.noticed(&best.attempt.place, &finer)? {
                half = Some(finer);
                break reached;
            }
            before.push((coarse, best.clone()));
        }
        (coarse, pioneers) = (finer, reached);
        if pioneers.is_empty() {
            // Where none has a scheme, others may on half the step.
            pioneers = glance(&coarse, starts)?;
            pioneers.truncate(PIONEERS);
        }
    };
    if coarse.sampling.every == first {
        glanced.drain(..PIONEERS.min(glanced.len()));
        return Ok(Chosen { grid: coarse, half, glanced, ran: reached });
    }
    let told = reached.first().map(|best| best.attempt.values());
    let alike = |(_, best): &&(Grid<'a>, Runner)| {
        told.as_ref().is_some_and(|told| near(&best.attempt.values(), told, MOVED, 0.0))
    };
    let mut starts = starts.to_vec();
    if let Some((grid, _)) = before.iter().find(alike) {
        let glanced = glance(grid, &starts)?;
        if glanced.iter().map(|runner| 1 + runner.alike.len()).sum::<usize>() == starts.len() {
            // This coarser grid has the same optimum, a little moved: of those that come to one place there one goes on.
            starts = distinct(&laps.run(free, grid, &glanced, FIRST_LAP)?, same_optimum);
        }
    }
    let glanced = glance(&coarse, &starts)?;
    Ok(Chosen { grid: coarse, half, glanced, ran: Vec::new() })
}

//! Starts of bodies with friction on coarse grids.

use super::halving::{Laps, FINALISTS, FIRST_LAP, SECOND_LAP};
use crate::error::Result;
use crate::estimation::joint_fit::objective::{Grid, FINEST};
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::runner::Runner;

/// Where starts get on coarse grids, best first.
///
/// # Errors
/// Those of the source, [`crate::error::Error::Interrupted`].
pub fn on_coarse_grids(free: &Free, coarse: &Grid<'_>, starts: &[Runner], threads: usize) -> Result<Vec<Runner>> {
    let laps = Laps { starts: starts.len(), threads, told: None };
    let mut coarse = coarse.clone();
    let mut ended = laps.run(free, &coarse, starts, FIRST_LAP)?;
    while coarse.sampling.every < FINEST && ended.is_empty() {
        coarse = coarse.finer()?;
        ended = laps.run(free, &coarse, starts, FIRST_LAP)?;
    }
    ended.truncate(2 * FINALISTS);
    laps.run(free, &coarse, &ended, SECOND_LAP)
}

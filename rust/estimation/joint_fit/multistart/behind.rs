//! Those that are behind: who is still on the way goes on.

use super::halving::{Laps, FIRST_LAP, SECOND_LAP};
use crate::error::Result;
use crate::estimation::joint_fit::objective::Grid;
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::runner::Runner;

/// Behind the first, a start goes on while a lap lowers its cost by this share: what has come to rest overtakes nobody.
const ON_THE_WAY: f64 = 0.05;
/// Of those further behind than contenders are, who falls by a share in a few evaluations.
const STIR: usize = 5;
const STIRS: f64 = 0.1;

/// Where those behind end, each for as long as it is getting on, but no longer than a second lap.
pub(super) fn on_the_way(laps: Laps<'_>, free: &Free, coarse: &Grid<'_>, behind: &[Runner]) -> Result<Vec<Runner>> {
    let (mut ended, mut going) = (Vec::new(), behind.to_vec());
    for _ in 0..SECOND_LAP / FIRST_LAP {
        let mut further = Vec::new();
        for (runner, at) in going.iter().zip(laps.each(free, coarse, &going, FIRST_LAP)?) {
            let Some(at) = at else { continue };
            let gets_on = at.level() < (1.0 - ON_THE_WAY) * runner.level();
            if gets_on { &mut further } else { &mut ended }.push(at);
        }
        going = further;
    }
    ended.extend(going);
    Ok(ended)
}

/// Where those no further behind are after a few evaluations that lower their cost by a share; and the others.
pub(super) fn stirred(
    laps: Laps<'_>,
    free: &Free,
    coarse: &Grid<'_>,
    lost: &[Runner],
    farthest: f64,
) -> Result<(Vec<Runner>, Vec<Runner>)> {
    let (near, mut still): (Vec<Runner>, Vec<Runner>) = lost.iter().cloned().partition(|r| r.level() <= farthest);
    let mut moving = Vec::new();
    let ends = laps.each(free, coarse, &near, STIR)?;
    for (runner, at) in near.into_iter().zip(ends) {
        match at.filter(|at| at.level() < (1.0 - STIRS) * runner.level()) {
            Some(at) => moving.push(at),
            None => still.push(runner),
        }
    }
    Ok((moving, still))
}

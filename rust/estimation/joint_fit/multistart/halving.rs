//! Laps of runners on a grid, and which of those that ended go on.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::channel;

use crate::error::{Error, Result};
use crate::estimation::joint_fit::objective::{Grid, TOLERANCE};
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::problem::Runner;
use crate::estimation::joint_fit::progress::Listener;
use crate::estimation::output_error::{Experiment, Settings};
use crate::parallel::Stop;

/// Evaluations of every coarse fit, then of those that are ahead: one in [`RUNNERS`], but not fewer than [`FEWEST`].
pub(super) const FIRST_LAP: usize = 15;
pub(super) const SECOND_LAP: usize = 60;
pub(super) const RUNNERS: usize = 3;
pub(super) const FEWEST: usize = 8;
/// Evaluations by which those are chosen that run ahead.
pub(super) const GLANCE: usize = 2;
/// Coarse fits that continue on all samples.
pub(super) const FINALISTS: usize = 3;
/// ... unless their coarse cost exceeds the best one's by this factor; on few samples nobody as far behind goes on.
pub(super) const CONTENDER: f64 = 3.0;
/// Share of its start below which a coefficient is as good as 0: a descent that keeps its sign ends at e^-20.
const VANISHED: f64 = 1e-8;
/// Two costs closer than this share are the same optimum.
const SAME_COST: f64 = 1e-3;
/// Starts whose numbers are all as near as this share are in the same place, optima if their orders are as near as this.
const SAME_PLACE: f64 = 0.02;
/// ... and by this share of themselves: orders are of any size.
const SAME_ORDER: f64 = 1e-5;

/// Who runs how many laps at a time, and who is told.
#[derive(Clone, Copy)]
pub(super) struct Laps<'a> {
    pub starts: usize,
    pub threads: usize,
    pub told: Option<&'a Listener<'a>>,
}

impl Laps<'_> {
    /// Where the runners get with so many evaluations of a problem, best first.
    pub(super) fn run(
        &self,
        free: &Free,
        grid: &Grid<'_>,
        runners: &[Runner],
        evaluations: usize,
    ) -> Result<Vec<Runner>> {
        let ended = self.each(free, grid, runners, evaluations)?;
        Ok(sorted(ended.into_iter().flatten().collect()))
    }

    /// Where each of the runners gets; none of those whose free run is not finite.
    pub(super) fn each(
        &self,
        free: &Free,
        grid: &Grid<'_>,
        runners: &[Runner],
        evaluations: usize,
    ) -> Result<Vec<Option<Runner>>> {
        let lap = Lap { free, experiments: grid.experiments(), steady: grid.steady, evaluations, stop: grid.stop() };
        let mut done = 0;
        let mut heard = || {
            let so_far = done.min(self.starts.saturating_sub(1));
            done += 1;
            self.told.map_or(Ok(()), |told| told(so_far, self.starts))
        };
        if self.threads.min(runners.len()) <= 1 {
            let each = runners.iter().map(|runner| {
                let ended = lap.tried(runner)?;
                heard()?;
                Ok(ended)
            });
            return each.collect();
        }
        let mut ended: Vec<Option<Runner>> = vec![None; runners.len()];
        let (next, left) = (AtomicUsize::new(0), Stop::default());
        let (send, receive) = channel();
        let (lap, next, left) = (&lap, &next, &left);
        std::thread::scope(|scope| {
            let mut refused = None;
            let threads = self.threads.min(runners.len());
            for _ in 0..threads {
                let send = send.clone();
                let runs = move || {
                    while !left.is_set() {
                        let k = next.fetch_add(1, Ordering::Relaxed);
                        let Some(runner) = runners.get(k) else { return };
                        if send.send((k, lap.tried(runner))).is_err() {
                            return;
                        }
                    }
                };
                if let Err(error) = std::thread::Builder::new().spawn_scoped(scope, runs) {
                    left.set();
                    refused = Some(Error::Threads { threads, why: error.to_string() });
                    break;
                }
            }
            drop(send);
            for (k, found) in &receive {
                match found.and_then(|found| heard().map(|()| found)) {
                    Ok(found) => ended[k] = found,
                    Err(error) => {
                        left.set();
                        refused.get_or_insert(error);
                    }
                }
            }
            refused.map_or(Ok(()), Err)
        })?;
        Ok(ended)
    }
}

/// What all runners of a lap share.
struct Lap<'a> {
    free: &'a Free,
    experiments: &'a [Experiment],
    steady: bool,
    evaluations: usize,
    stop: &'a Stop,
}

impl Lap<'_> {
    /// Where a runner gets; a start whose free run is not finite is no start, and if none is left, the fit says so.
    fn tried(&self, runner: &Runner) -> Result<Option<Runner>> {
        let settings = Settings { evaluations: self.evaluations, tolerance: TOLERANCE };
        let place = &runner.attempt.place;
        let turned = self.free.turned(place, false, &[]);
        match turned.descend(self.experiments, place, settings, self.steady, self.stop) {
            Ok(attempt) => Ok(Some(without_vanished(self.free, runner, runner.moved(attempt)))),
            Err(Error::Interrupted) => Err(Error::Interrupted),
            Err(_) => Ok(None),
        }
    }
}

/// A runner with coefficients at 0 that fell towards it as far as a sign that is kept lets them.
///
/// From there they may take the other sign.
fn without_vanished(free: &Free, start: &Runner, mut ended: Runner) -> Runner {
    if free.products.is_empty() && !free.has_friction() {
        let before = &start.attempt.place.point.coefficients;
        for (value, before) in ended.attempt.place.point.coefficients.iter_mut().zip(before) {
            if value.abs() < VANISHED * before.abs() {
                *value = 0.0;
            }
        }
    }
    ended
}

/// Best first; those that cost the same as they stood.
pub(super) fn sorted(mut runners: Vec<Runner>) -> Vec<Runner> {
    runners.sort_by(|a, b| a.level().total_cmp(&b.level()));
    runners
}

/// Those that go on on all samples: the best of different optima, unless they are far behind.
#[must_use]
pub fn finalists(reached: &[Runner]) -> Vec<Runner> {
    let mut first = distinct(reached, same_optimum);
    first.truncate(FINALISTS);
    in_reach(&first)
}

/// Those of runners, best first, that are not far behind the best; on a finer grid one that is may come before another.
#[must_use]
pub fn in_reach(reached: &[Runner]) -> Vec<Runner> {
    let limit = reached.first().map_or(0.0, |best| CONTENDER * best.level());
    reached.iter().filter(|runner| runner.level() <= limit).cloned().collect()
}

/// Whether two that ended cost the same at orders that are as near.
#[must_use]
pub fn same_optimum(one: &Runner, other: &Runner) -> bool {
    let orders = |runner: &Runner| runner.attempt.place.point.orders.clone();
    (one.level() - other.level()).abs() <= SAME_COST * one.level()
        && near(&orders(other), &orders(one), SAME_ORDER, SAME_PLACE)
}

/// Whether two are at the same numbers, each as near as a share of itself: several lattices have the same rows.
#[must_use]
pub fn same_place(one: &Runner, other: &Runner) -> bool {
    near(&other.attempt.values(), &one.attempt.values(), SAME_PLACE, 0.0)
}

/// Whether each number is as near to another as a share of that and a distance.
pub(super) fn near(numbers: &[f64], others: &[f64], share: f64, distance: f64) -> bool {
    numbers.iter().zip(others).all(|(a, b)| (a - b).abs() <= distance + share * b.abs())
}

/// Runners, best first; those that are the same as an earlier one are alike to it.
#[must_use]
pub fn distinct(runners: &[Runner], same: impl Fn(&Runner, &Runner) -> bool) -> Vec<Runner> {
    let mut kept: Vec<Runner> = Vec::new();
    for runner in runners {
        match kept.iter_mut().find(|kept| same(kept, runner)) {
            None => kept.push(runner.clone()),
            Some(first) => {
                first.alike.push(runner.origin.clone());
                first.alike.extend(runner.alike.iter().cloned());
            }
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::joint_fit::problem::{Attempt, Place};
    use crate::estimation::output_error::Point;

    fn ended(level: f64, order: f64) -> Runner {
        let point = Point { orders: vec![order], coefficients: vec![1.0], inputs: Vec::new() };
        let attempt = Attempt::unrun(Place { point, states: Vec::new() });
        Runner {
            attempt: Attempt { cost: level, residuals: vec![0.0; 2], ..attempt },
            origin: String::new(),
            alike: Vec::new(),
        }
    }

    #[test]
    fn one_too_far_behind_hides_nobody_behind_it() {
        // On a finer grid the last one was last: its own level is in reach all the same.
        let reached = [ended(1.0, 0.5), ended(3.5, 1.0), ended(2.0, 1.5)];
        let orders: Vec<f64> = finalists(&reached).iter().map(|r| r.attempt.place.point.orders[0]).collect();
        assert_eq!(orders, [0.5, 1.5]);
        assert!(in_reach(&[ended(0.0, 1.0), ended(1e-9, 2.0)]).len() == 1);
    }
}

//! Successive halving: evaluation budgets, survivors and distinct optima.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::channel;

use crate::error::{Error, Result};
use crate::estimation::joint_fit::objective::{Grid, TOLERANCE};
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::problem::Runner;
use crate::estimation::joint_fit::progress::Listener;
use crate::estimation::output_error::{Experiment, Settings};
use crate::parallel::Stop;

/// Evaluations of every candidate. Then the best get [`SECOND_BUDGET_EVALUATIONS`]: one in [`CANDIDATES_PER_SURVIVOR`],
/// but at least [`MIN_SURVIVORS`].
pub(super) const FIRST_LAP: usize = 15;
pub(super) const SECOND_LAP: usize = 60;
pub(super) const RUNNERS: usize = 3;
pub(super) const FEWEST: usize = 8;
/// Evaluations of the prescreening.
pub(super) const GLANCE: usize = 2;
/// Maximum number of candidates that continue on all samples.
pub(super) const FINALISTS: usize = 3;
/// Ratio to the best coarse cost above which a candidate does not continue.
pub(super) const CONTENDER: f64 = 3.0;
/// Ratio to its initial guess below which a coefficient counts as 0: in logarithms an optimization stops at e^-20.
const VANISHED: f64 = 1e-8;
/// Relative difference of two costs below which they can belong to the same optimum.
const SAME_COST: f64 = 1e-3;
/// Relative difference of all parameters below which candidates coincide; absolute one of the orders of an optimum.
const SAME_PLACE: f64 = 0.02;
/// Relative difference of the orders of the same optimum, added to the absolute one.
const SAME_ORDER: f64 = 1e-5;

/// Executor of budgets: number of starts for the progress, threads, progress callback.
#[derive(Clone, Copy)]
pub(super) struct Laps<'a> {
    pub starts: usize,
    pub threads: usize,
    pub told: Option<&'a Listener<'a>>,
}

impl Laps<'_> {
    /// Optimize candidates with a budget of evaluations; return them best first.
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

    /// Optimize each candidate with a budget of evaluations; None if its simulation is not finite.
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

/// Common settings of the candidates of one budget.
struct Lap<'a> {
    free: &'a Free,
    experiments: &'a [Experiment],
    steady: bool,
    evaluations: usize,
    stop: &'a Stop,
}

impl Lap<'_> {
    /// Optimize one candidate; None if its simulation is not finite.
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

/// Set coefficients to 0 that vanished in logarithmic coordinates, so that they can change their sign.
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

/// Sort candidates by cost, stable for ties.
pub(super) fn sorted(mut runners: Vec<Runner>) -> Vec<Runner> {
    runners.sort_by(|a, b| a.level().total_cmp(&b.level()));
    runners
}

/// Survivors that continue on all samples: the best distinct optima within the cost ratio.
#[must_use]
pub fn finalists(reached: &[Runner]) -> Vec<Runner> {
    let mut first = distinct(reached, same_optimum);
    first.truncate(FINALISTS);
    in_reach(&first)
}

/// Candidates with a cost within [`MAX_SURVIVOR_COST_RATIO`] of the best; the input need not be sorted after the first.
#[must_use]
pub fn in_reach(reached: &[Runner]) -> Vec<Runner> {
    let limit = reached.first().map_or(0.0, |best| CONTENDER * best.level());
    reached.iter().filter(|runner| runner.level() <= limit).cloned().collect()
}

/// True if two candidates agree in cost and orders.
#[must_use]
pub fn same_optimum(one: &Runner, other: &Runner) -> bool {
    let orders = |runner: &Runner| runner.attempt.place.point.orders.clone();
    (one.level() - other.level()).abs() <= SAME_COST * one.level()
        && near(&orders(other), &orders(one), SAME_ORDER, SAME_PLACE)
}

/// True if two candidates agree in all parameters. Several order grids contain the same points.
#[must_use]
pub fn same_place(one: &Runner, other: &Runner) -> bool {
    near(&other.attempt.values(), &one.attempt.values(), SAME_PLACE, 0.0)
}

/// True if all values agree within a relative and an absolute tolerance.
pub(super) fn near(numbers: &[f64], others: &[f64], share: f64, distance: f64) -> bool {
    numbers.iter().zip(others).all(|(a, b)| (a - b).abs() <= distance + share * b.abs())
}

/// Merge candidates that duplicate an earlier one; their origins are added to it.
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
        // The order comes from a finer grid; the cost of the last one is within the ratio nevertheless.
        let reached = [ended(1.0, 0.5), ended(3.5, 1.0), ended(2.0, 1.5)];
        let orders: Vec<f64> = finalists(&reached).iter().map(|r| r.attempt.place.point.orders[0]).collect();
        assert_eq!(orders, [0.5, 1.5]);
        assert!(in_reach(&[ended(0.0, 1.0), ended(1e-9, 2.0)]).len() == 1);
    }
}

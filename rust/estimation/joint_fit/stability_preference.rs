//! Choice between an unstable optimum and a stable one: the unstable one must fit significantly better.
//!
//! With nonzero initial conditions an equation has free initial terms for each run. They can cancel an unstable mode up
//! to the end of the run, which makes the response noncausal: the output reacts before the input. No machine does that,
//! but with autocorrelated residuals such a model can fit better.

use std::collections::BTreeMap;

use super::multistart::{held as known_orders, Held};
use super::objective::Grid;
use super::parameter_set::Free;
use super::problem::{Attempt, Runner};
use super::structure::Coefficient;
use crate::error::{Error, Result};
use crate::signal::statistics::mean;

/// Number of segments of the runs whose sums of squares are compared; then the 99 % quantile of Student's t for one
/// degree of freedom less.
const STRETCHES: f64 = 20.0;
const STUDENT_99: f64 = 2.54;
/// Ratio of the residuals above which the better optimum is chosen without a test: instability can show up only at the
/// end of a run.
const FAR_LARGER: f64 = 2.0;
/// Maximum number of stable candidates of the multistart to try, and evaluations of each.
const LOOKED_AT: usize = 3;
const EVALUATIONS: usize = 60;

/// Comparison of an unstable optimum with the best stable one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Growth {
    /// True if the unstable optimum is the result, because it fits significantly better or no stable one exists.
    pub kept: bool,
    /// Relative excess of the root mean square residual of the stable one. Infinite if there is none, negative if the
    /// unstable one was no optimum.
    pub excess: f64,
    /// True if the stable one lies on the stability limit and is no local optimum.
    pub at_limit: bool,
}

/// Choose between the best optimum and a stable one; return it with its objective and the comparison.
///
/// The objective requires stability if the stable optimum is chosen.
///
/// # Errors
/// As the source, [`Error::Interrupted`].
pub fn steadied<'a>(
    free: &Free,
    best: Runner,
    grid: Grid<'a>,
    reached: &[Runner],
) -> Result<(Runner, Grid<'a>, Option<Growth>)> {
    if !grows(free, &best) {
        return Ok((best, grid, None));
    }
    let held = grid.steadily();
    let mut ends = Ends { free, grid: held.clone() }.stable(&best, reached)?;
    let unit = grid.clock();
    for one in known_orders(free) {
        // A stable optimum with one order fixed is a candidate for the full equation.
        let there = known(&one, free, &held, |runner| one.without(runner, &unit), &best, reached)?;
        if let Some(there) = there {
            let there = one.embedded(&there, free);
            ends.extend(caught(Ends { free, grid: held.clone() }.steadily(&there))?);
        }
    }
    if ends.is_empty() {
        return Ok((best, grid, Some(Growth { kept: true, excess: f64::INFINITY, at_limit: false })));
    }
    let other = Ends { free, grid: held.clone() }.nearest(&ends)?;
    let excess = if best.level() > 0.0 { (other.level() / best.level()).sqrt() - 1.0 } else { f64::INFINITY };
    if forced(&grid, &best.attempt, &other.attempt) {
        return Ok((best, grid, Some(Growth { kept: true, excess, at_limit: false })));
    }
    let at_limit = !other.attempt.converged();
    Ok((other, held, Some(Growth { kept: false, excess, at_limit })))
}

/// Stable optimum of the problem with one order fixed, if any.
fn known(
    one: &Held,
    free: &Free,
    held: &Grid<'_>,
    without: impl Fn(&Runner) -> Runner,
    best: &Runner,
    reached: &[Runner],
) -> Result<Option<Runner>> {
    debug_assert!(one.order < free.orders.len());
    let narrow = Ends { free: &one.free, grid: held.of(&one.free.problem) };
    let inside = narrow.stable(&without(best), &reached.iter().map(without).collect::<Vec<_>>())?;
    if inside.is_empty() {
        return Ok(None);
    }
    Ok(caught(narrow.nearest(&inside).map(Some))?.flatten())
}

/// Convert any error except [`Error::Interrupted`] to None.
fn caught<T>(found: Result<T>) -> Result<Option<T>> {
    match found {
        Err(Error::Interrupted) => Err(Error::Interrupted),
        found => Ok(found.ok()),
    }
}

/// True if an equation is unstable at a candidate.
fn grows(free: &Free, runner: &Runner) -> bool {
    free.problem.grows(&runner.attempt.place.point)
}

/// Names of the free autoregressive coefficients, with their fixed factors.
fn own_terms(free: &Free) -> BTreeMap<&String, f64> {
    let own = free.structure.equations.iter().flat_map(|equation| equation.own());
    own.filter_map(|term| match &term.coefficient {
        Coefficient::Free(name) => Some((name, term.factor)),
        Coefficient::Known(_) => None,
    })
    .collect()
}

/// Candidate with all autoregressive coefficients negative, which is stable up to order 2, and the changed indices.
///
/// The changed coefficients are first kept fixed while the others adapt, because the input coefficients still belong to
/// the unstable optimum.
#[must_use]
pub fn dissipative(free: &Free, runner: &Runner) -> (Runner, Vec<usize>) {
    let own = own_terms(free);
    let mut place = runner.attempt.place.clone();
    let mut turned = Vec::new();
    for (k, (name, value)) in free.coefficients.iter().zip(&mut place.point.coefficients).enumerate() {
        if own.get(name).is_some_and(|factor| *value * factor > 0.0) {
            *value = -*value;
            turned.push(free.orders.len() + k);
        }
    }
    (elsewhere(runner, place, "all own terms pulling back"), turned)
}

/// Candidates with one autoregressive coefficient at 0 each, which is first kept fixed while the others adapt.
#[must_use]
pub fn lacking(free: &Free, runner: &Runner) -> Vec<(Runner, Vec<usize>)> {
    let places = own_places(free);
    let without = |&k: &usize| {
        let mut place = runner.attempt.place.clone();
        place.point.coefficients[k] = 0.0;
        let words = format!("from {} = 0", free.coefficients[k]);
        (elsewhere(runner, place, &words), vec![free.orders.len() + k])
    };
    if places.len() > 1 {
        places.iter().map(without).collect()
    } else {
        Vec::new()
    }
}

/// Indices of the free autoregressive coefficients.
fn own_places(free: &Free) -> Vec<usize> {
    let own = own_terms(free);
    (0..free.coefficients.len()).filter(|&k| own.contains_key(&free.coefficients[k])).collect()
}

fn elsewhere(runner: &Runner, place: super::problem::Place, words: &str) -> Runner {
    let origin = format!("{}, {words}", runner.origin);
    Runner { origin, attempt: Attempt { place, ..runner.attempt.clone() }, ..runner.clone() }
}

/// Search for stable optima of a problem.
struct Ends<'f, 'g> {
    free: &'f Free,
    grid: Grid<'g>,
}

impl Ends<'_, '_> {
    fn descend(&self, start: &Runner, held: &[usize]) -> Result<Runner> {
        let place = &start.attempt.place;
        Ok(start.moved(self.grid.descend_in(&self.free.turned(place, true, held), place, EVALUATIONS)?))
    }

    /// Stable optima from stable candidates of the multistart and from modifications of the unstable optimum.
    fn stable(&self, best: &Runner, reached: &[Runner]) -> Result<Vec<Runner>> {
        let raced = reached.iter().filter(|runner| !grows(self.free, runner)).take(LOOKED_AT);
        let mut starts: Vec<(Runner, Vec<usize>)> = raced.map(|runner| (runner.clone(), Vec::new())).collect();
        starts.push(dissipative(self.free, best));
        starts.extend(lacking(self.free, best));
        let mut ends = Vec::new();
        for (start, turned) in starts.into_iter().filter(|(start, _)| !grows(self.free, start)) {
            let near = if turned.is_empty() { Ok(start) } else { self.descend(&start, &turned) };
            // Candidates without a finite simulation on this grid are skipped.
            ends.extend(caught(near.and_then(|near| self.steadily(&near)))?);
        }
        Ok(ends)
    }

    /// Minimize over stable models, along the stability limit if it is reached.
    fn steadily(&self, start: &Runner) -> Result<Runner> {
        let end = self.descend(start, &[])?;
        if end.attempt.converged() {
            return Ok(end);
        }
        self.along_limit(end)
    }

    /// Minimize along the stability limit, with one autoregressive coefficient fixed at a time.
    ///
    /// An optimization stops if a step of all parameters would be unstable, although the cost can still decrease along
    /// the limit.
    fn along_limit(&self, end: Runner) -> Result<Runner> {
        let status = end.attempt.status;
        let mut best = end.clone();
        for k in own_places(self.free) {
            let there = caught(self.descend(&end, &[self.free.orders.len() + k]))?;
            best = there.filter(|there| there.level() < best.level()).unwrap_or(best);
        }
        // With a fixed coefficient it converged in fewer parameters than the fit has.
        best.attempt.status = status;
        Ok(best)
    }

    /// Stable candidate to compare with the unstable optimum.
    ///
    /// A converged optimum is preferred over a candidate on the stability limit, unless the latter fits significantly
    /// better than all of them.
    fn nearest(&self, ends: &[Runner]) -> Result<Runner> {
        let attempts: Vec<&Attempt> = ends.iter().map(|runner| &runner.attempt).collect();
        let order = self.grid.finer()?.ranked(&attempts)?;
        let first = order.first().copied().unwrap_or(0);
        let settled = |&&i: &&usize| attempts[i].converged() && !forced(&self.grid, attempts[first], attempts[i]);
        Ok(ends[order.iter().find(settled).copied().unwrap_or(first)].clone())
    }
}

/// Vuong's test of non-nested models: true if the best fits significantly better than the other.
///
/// The mean squares over segments of the runs are compared (Vuong, doi:10.2307/1912557; for autocorrelated residuals
/// Rivers & Vuong, doi:10.1111/1368-423X.t01-1-00071).
#[must_use]
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn forced(grid: &Grid<'_>, best: &Attempt, other: &Attempt) -> bool {
    if other.level() > FAR_LARGER * FAR_LARGER * best.level() {
        return true;
    }
    let squares = |attempt: &Attempt| grid.residuals(attempt).iter().map(|run| summed(run)).collect::<Vec<_>>();
    let (ours, theirs) = (squares(best), squares(other));
    let samples: usize = theirs.iter().map(Vec::len).sum();
    let mut less = Vec::new();
    for (one, two) in theirs.iter().zip(&ours) {
        let fall: Vec<f64> = one.iter().zip(two).map(|(a, b)| a - b).collect();
        let count = (STRETCHES * fall.len() as f64 / samples as f64).round_ties_even().max(1.0) as usize;
        let (short, longer) = (fall.len() / count, fall.len() % count);
        let mut rest = fall.as_slice();
        for k in 0..count {
            let (part, others) = rest.split_at(short + usize::from(k < longer));
            rest = others;
            if !part.is_empty() {
                less.push(mean(part));
            }
        }
    }
    if less.len() < 2 {
        return true;
    }
    let (middle, count) = (mean(&less), less.len() as f64);
    let spread = less.iter().map(|v| (v - middle).powi(2)).sum::<f64>() / (count - 1.0);
    middle > STUDENT_99 * (spread / count).sqrt()
}

/// Sum of squared weighted residuals of all outputs, by sample; missing samples count 0.
fn summed(outputs: &[Vec<f64>]) -> Vec<f64> {
    let mut total = vec![0.0; outputs.first().map_or(0, Vec::len)];
    for residuals in outputs {
        let squares = residuals.iter().map(|e| if e.is_nan() { 0.0 } else { e * e });
        total.iter_mut().zip(squares).for_each(|(sum, square)| *sum += square);
    }
    total
}

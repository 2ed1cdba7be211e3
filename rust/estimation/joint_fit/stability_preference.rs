//! Optima whose free run grows: kept where the runs force them, not where one that dies away explains them as well.
//!
//! A run that starts in motion gives an equation initial terms of its own. They cost a growing mode nothing: fitted, they
//! take away all that it becomes until the end of the run, and what is left runs backwards in time. Such an equation
//! answers its inputs before they come, which no machine does, and where residuals are coloured it may well leave less.

use std::collections::BTreeMap;

use super::multistart::{held as known_orders, Held};
use super::objective::Grid;
use super::parameter_set::Free;
use super::problem::{Attempt, Runner};
use super::structure::Coefficient;
use crate::error::{Error, Result};
use crate::signal::statistics::mean;

/// Stretches of the runs whose sums of squares are compared, and the 99 % quantile of Student's t of one less.
const STRETCHES: f64 = 20.0;
const STUDENT_99: f64 = 2.54;
/// Residuals larger by this factor force what no stretch may show: a run that grows is seen at its end alone.
const FAR_LARGER: f64 = 2.0;
/// Optima of the race that are looked at, and evaluations of each.
const LOOKED_AT: usize = 3;
const EVALUATIONS: usize = 60;

/// An optimum whose free run grows beside the best one found whose free run does not.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Growth {
    /// Whether the growing one is the fit's, because the runs force it or there was no other.
    pub kept: bool,
    /// Share by which residuals of the other one are larger (root mean square); infinite where there was none, below 0
    /// where the growing one was no optimum.
    pub excess: f64,
    /// Whether the other one stands where free runs begin to grow, no optimum of its own.
    pub at_limit: bool,
}

/// The optimum to go on from, on a grid that stays where free runs die away if it does, and what was compared.
///
/// # Errors
/// Those of the source, [`Error::Interrupted`].
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
        // What the equation explains with an order known without growing, it explains with that order free.
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

/// Where the problem with one order known stands without growing, if there is such a place.
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

/// What a computation found; nothing where it ended with any error but a stop.
fn caught<T>(found: Result<T>) -> Result<Option<T>> {
    match found {
        Err(Error::Interrupted) => Err(Error::Interrupted),
        found => Ok(found.ok()),
    }
}

/// Whether the free run of an equation grows where an attempt is.
fn grows(free: &Free, runner: &Runner) -> bool {
    free.problem.grows(&runner.attempt.place.point)
}

/// Free coefficients before own terms, with the factor that they are multiplied by.
fn own_terms(free: &Free) -> BTreeMap<&String, f64> {
    let own = free.structure.equations.iter().flat_map(|equation| equation.own());
    own.filter_map(|term| match &term.coefficient {
        Coefficient::Free(name) => Some((name, term.factor)),
        Coefficient::Known(_) => None,
    })
    .collect()
}

/// The point with own terms that all pull back, whose free run dies away up to order 2, and which of them turned.
///
/// Those are held where the rest follows first: released at once, what drives would be that of the growing optimum.
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

/// The point without one own term after the other, each held at 0 where the rest follows first.
///
/// What a term less explains without growing, the whole equation explains, too.
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

/// Places of the coefficients before own terms.
fn own_places(free: &Free) -> Vec<usize> {
    let own = own_terms(free);
    (0..free.coefficients.len()).filter(|&k| own.contains_key(&free.coefficients[k])).collect()
}

fn elsewhere(runner: &Runner, place: super::problem::Place, words: &str) -> Runner {
    let origin = format!("{}, {words}", runner.origin);
    Runner { origin, attempt: Attempt { place, ..runner.attempt.clone() }, ..runner.clone() }
}

/// A problem on a grid where no descent goes to a free run that grows.
struct Ends<'f, 'g> {
    free: &'f Free,
    grid: Grid<'g>,
}

impl Ends<'_, '_> {
    fn descend(&self, start: &Runner, held: &[usize]) -> Result<Runner> {
        let place = &start.attempt.place;
        Ok(start.moved(self.grid.descend_in(&self.free.turned(place, true, held), place, EVALUATIONS)?))
    }

    /// Where attempts end whose free runs die away: those of a race, and what is nearest to a growing optimum.
    fn stable(&self, best: &Runner, reached: &[Runner]) -> Result<Vec<Runner>> {
        let raced = reached.iter().filter(|runner| !grows(self.free, runner)).take(LOOKED_AT);
        let mut starts: Vec<(Runner, Vec<usize>)> = raced.map(|runner| (runner.clone(), Vec::new())).collect();
        starts.push(dissipative(self.free, best));
        starts.extend(lacking(self.free, best));
        let mut ends = Vec::new();
        for (start, turned) in starts.into_iter().filter(|(start, _)| !grows(self.free, start)) {
            let near = if turned.is_empty() { Ok(start) } else { self.descend(&start, &turned) };
            // Some have no finite free run on this grid; the others have one.
            ends.extend(caught(near.and_then(|near| self.steadily(&near)))?);
        }
        Ok(ends)
    }

    /// Where a descent ends that goes to no free run that grows, along the limit of growth if it comes there.
    fn steadily(&self, start: &Runner) -> Result<Runner> {
        let end = self.descend(start, &[])?;
        if end.attempt.converged() {
            return Ok(end);
        }
        self.along_limit(end)
    }

    /// The lowest point beside one at the limit of growth: from there on with one own term held after the other.
    ///
    /// A descent stands where a step of all numbers would grow, though the rest may still fall along the limit.
    fn along_limit(&self, end: Runner) -> Result<Runner> {
        let status = end.attempt.status;
        let mut best = end.clone();
        for k in own_places(self.free) {
            let there = caught(self.descend(&end, &[self.free.orders.len() + k]))?;
            best = there.filter(|there| there.level() < best.level()).unwrap_or(best);
        }
        // Held, it stood still in fewer numbers than the fit has.
        best.attempt.status = status;
        Ok(best)
    }

    /// The end that a growing optimum is compared with.
    ///
    /// Where free runs begin to grow a descent stands at a wall, which is no optimum: one of those is taken instead, but
    /// for where the runs refuse all of them for the wall.
    fn nearest(&self, ends: &[Runner]) -> Result<Runner> {
        let attempts: Vec<&Attempt> = ends.iter().map(|runner| &runner.attempt).collect();
        let order = self.grid.finer()?.ranked(&attempts)?;
        let first = order.first().copied().unwrap_or(0);
        let settled = |&&i: &&usize| attempts[i].converged() && !forced(&self.grid, attempts[first], attempts[i]);
        Ok(ends[order.iter().find(settled).copied().unwrap_or(first)].clone())
    }
}

/// Whether the best point leaves less than another one by more than chance, neither of them inside the other.
///
/// The means of the squares over stretches of the runs are compared (Vuong, doi:10.2307/1912557; for coloured residuals
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

/// Squares of weighted residuals of all outputs, sample by sample; what was not read counts nothing.
fn summed(outputs: &[Vec<f64>]) -> Vec<f64> {
    let mut total = vec![0.0; outputs.first().map_or(0, Vec::len)];
    for residuals in outputs {
        let squares = residuals.iter().map(|e| if e.is_nan() { 0.0 } else { e * e });
        total.iter_mut().zip(squares).for_each(|(sum, square)| *sum += square);
    }
    total
}

//! Multistart with successive halving: candidates, budgets, promotion and submodels.

use super::coarse_grid::{fine_enough, thinned};
use super::halving::{
    distinct, finalists, in_reach, same_optimum, same_place, sorted, Laps, CONTENDER, FEWEST, FINALISTS, FIRST_LAP,
    GLANCE, RUNNERS, SECOND_LAP,
};
use super::nested_models::{held, lower_order, simpler, unlike, whole, Held, LowerOrder, Simpler, Whole};
use crate::equation::Initial;
use crate::error::{Error, Kind, Result};
use crate::estimation::joint_fit::objective::{Grid, Weights, FINEST};
use crate::estimation::joint_fit::parameter_set::{Clock, Free};
use crate::estimation::joint_fit::problem::Runner;
use crate::estimation::joint_fit::progress::Listener;
use crate::estimation::joint_fit::source::Recordings;
use crate::estimation::joint_fit::structure::{Equation, Structure};
use crate::parallel::Stop;

/// Ratio of the best cost to the noise floor above which candidates behind the best are promoted, too. Candidates up to
/// [`MAX_PROMOTION_COST_RATIO`] are promoted if they improve in a few evaluations.
const ABOVE_FLOOR: f64 = 2.0;
const FAR_BEHIND: f64 = 100.0;

/// Source of initial guesses.
pub trait Starts {
    /// Initial guesses of a problem on the runs.
    ///
    /// # Errors
    /// If its equations cannot be searched; [`Error::Interrupted`].
    fn of(&self, free: &Free) -> Result<Vec<Runner>>;
}

/// Common data of the multistarts of a problem and of its submodels.
#[derive(Clone, Copy)]
pub struct Course<'a> {
    /// The runs.
    pub source: &'a dyn Recordings,
    /// Source of initial guesses.
    pub starts: &'a dyn Starts,
    /// Cancellation flag.
    pub stop: &'a Stop,
    /// Weights of the outputs, equal relative to their standard deviations.
    pub weights: &'a [f64],
    /// Noise floor of the cost per residual.
    pub floor: f64,
    /// Number of threads; results do not depend on it.
    pub threads: usize,
    /// Progress callback of (starts done, all starts); None in a nested multistart.
    pub told: Option<&'a Listener<'a>>,
}

impl<'a> Course<'a> {
    /// Context of a nested multistart.
    fn inside(self) -> Self {
        Self { told: None, ..self }
    }

    fn clock(self, free: &Free) -> Clock {
        Clock::of(&free.problem, &self.source.spans())
    }

    fn step(self) -> f64 {
        self.source.spans().iter().fold(0.0, |step, span| span.0.max(step))
    }
}

/// Run the multistart on subsampled records; return the candidates best first.
///
/// # Errors
/// As the source, the initial guesses and the callback; [`Error::Interrupted`].
pub fn race(free: &Free, course: Course<'_>) -> Result<Vec<Runner>> {
    if free.structure.history {
        return with_history(free, course);
    }
    Ok(without_history(free, course)?.0)
}

/// Convert the error of an invalid model to None.
fn made<T>(found: Result<T>) -> Result<Option<T>> {
    match found {
        Err(error) if error.kind() == Kind::Model => Ok(None),
        found => found.map(Some),
    }
}

/// State of a multistart.
struct Run<'a> {
    free: &'a Free,
    course: Course<'a>,
    laps: Laps<'a>,
    coarse: Grid<'a>,
    /// The grid of half the step, if it was computed.
    half: Option<Grid<'a>>,
    starts: Vec<Runner>,
    /// Candidates of the full problem after the first budget.
    first: Vec<Runner>,
    /// Optima with integer orders.
    wholes: Vec<Runner>,
    reached: Vec<Runner>,
}

/// Multistart of a problem with few initial terms; return the candidates and their grid.
fn without_history<'a>(free: &'a Free, course: Course<'a>) -> Result<(Vec<Runner>, Grid<'a>)> {
    let starts = course.starts.of(free)?;
    let laps = Laps { starts: starts.len(), threads: course.threads, told: course.told };
    let weights = Weights { outputs: course.weights.to_vec(), shares: None };
    let sampling = thinned(free, course.source)?;
    let grid = Grid::new((&free.problem, course.source, course.stop), weights, sampling, false)?;
    let chosen = fine_enough(laps, free, grid, &starts)?;
    let (mut coarse, mut half) = (chosen.grid, chosen.half);
    let mut reached = chosen.ran;
    reached.extend(laps.run(free, &coarse, &chosen.glanced, FIRST_LAP)?);
    reached = sorted(reached);
    while coarse.sampling.every < FINEST {
        let finer = half.take().map_or_else(|| coarse.finer(), Ok)?;
        if let Some(best) = reached.first() {
            if !coarse.noticed(&best.attempt.place, &finer)? {
                half = Some(finer);
                break;
            }
        }
        coarse = finer;
        reached = laps.run(free, &coarse, &starts, FIRST_LAP)?;
    }
    let (first, wholes) = (reached.clone(), Vec::new());
    let mut run = Run { free, course, laps, coarse, half, starts, first, wholes, reached };
    run.inside()?;
    let told = run.laps.starts;
    let found = run.ended()?;
    if let Some(heard) = course.told {
        heard(told, told)?;
    }
    Ok(found)
}

impl<'a> Run<'a> {
    /// Add the optima of submodels as candidates: a coefficient at 0, fixed orders, or an additional fast pole.
    fn inside(&mut self) -> Result<()> {
        let Some(best) = self.reached.first() else { return Ok(()) };
        let orders = best.attempt.place.point.orders.clone();
        for less in unlike(simpler(self.free)) {
            self.simpler(&less)?;
        }
        if let Some(less) = lower_order(self.free, self.course.step()) {
            self.lower(&less)?;
        }
        for less in whole(self.free, &orders) {
            self.whole(&less)?;
        }
        let unit = self.course.clock(self.free);
        for one in held(self.free) {
            self.known(&one, &unit)?;
        }
        self.plain()
    }

    fn add(&mut self, runners: Vec<Runner>) {
        self.reached.extend(runners);
        self.reached = sorted(std::mem::take(&mut self.reached));
    }

    /// Evaluate candidates on the grid of this problem and add them.
    fn join(&mut self, runners: &[Runner]) -> Result<()> {
        let there = self.laps.run(self.free, &self.coarse, runners, 1)?;
        self.add(there);
        Ok(())
    }

    fn simpler(&mut self, less: &Simpler) -> Result<()> {
        if less.driven {
            // Input coefficients are eliminated at every iterate, also with one term less. Candidates differ in the
            // autoregressive terms only, so those of the full problem suffice.
            let first = distinct(&self.first, same_optimum);
            let from = first.iter().take(FINALISTS).chain(&self.starts);
            let runners: Vec<Runner> = from.map(|runner| less.without(runner, self.free)).collect();
            let mut runners = self.laps.run(&less.free, &self.coarse, &runners, GLANCE)?;
            runners.truncate(FINALISTS);
            let ended = self.laps.run(&less.free, &self.coarse, &runners, FIRST_LAP)?;
            return self.join(&ended.iter().take(1).map(|r| less.embedded(r, self.free)).collect::<Vec<_>>());
        }
        if is_rich(self.free) && less.free.orders.len() < self.free.orders.len() {
            // With several terms of free order, the reduced problem still has many optima and gets its own multistart.
            let ended = without_history(&less.free, self.course.inside())?.0;
            // Initial terms can change which of its optima is the best.
            let there = in_reach(&ended).into_iter().take(FEWEST).map(|runner| less.embedded(&runner, self.free));
            return self.join(&there.collect::<Vec<_>>());
        }
        let ended = self.of(&less.free, FEWEST)?;
        self.add(ended.iter().take(1).map(|runner| less.embedded(runner, self.free)).collect());
        Ok(())
    }

    fn lower(&mut self, less: &LowerOrder) -> Result<()> {
        let ended = self.of(&less.free, FEWEST)?;
        self.add(ended.iter().take(1).map(|runner| less.embedded(runner, self.free)).collect());
        Ok(())
    }

    fn whole(&mut self, less: &Whole) -> Result<()> {
        // With fixed orders most initial guesses lead to the same optimum.
        let ended = self.of(&less.free, FINALISTS)?;
        let there: Vec<Runner> = ended.iter().take(1).map(|runner| less.embedded(runner)).collect();
        self.wholes.extend(there.iter().cloned());
        self.add(there);
        Ok(())
    }

    /// Optimize a submodel from its own initial guesses; `going` of them continue.
    fn of(&self, free: &Free, going: usize) -> Result<Vec<Runner>> {
        // With integer orders two of its terms may coincide.
        let Some(starts) = made(self.course.starts.of(free))? else { return Ok(Vec::new()) };
        let mut runners = distinct(&self.laps.run(free, &self.coarse, &starts, GLANCE)?, same_place);
        runners.truncate(going);
        let ended = self.laps.run(free, &self.coarse, &runners, FIRST_LAP)?;
        self.laps.run(free, &self.coarse, &finalists(&ended), SECOND_LAP)
    }

    /// Add the optimum with one order fixed: the full problem must not fit worse.
    fn known(&mut self, one: &Held, unit: &Clock) -> Result<()> {
        let level = self.reached.first().map_or(0.0, Runner::level);
        if one.free.orders.len() == 1 && level > ABOVE_FLOOR * self.course.floor {
            // Above the noise floor a multistart with one free order is worth its cost. Bounds may leave no order grid.
            if let Some((ended, _)) = made(without_history(&one.free, self.course.inside()))? {
                let there = in_reach(&ended).into_iter().take(FINALISTS).map(|runner| one.embedded(&runner, self.free));
                return self.join(&there.collect::<Vec<_>>());
            }
        }
        // Start from the optima found so far and from those with integer orders.
        let (reached, first) = (distinct(&self.reached, same_optimum), distinct(&self.first, same_optimum));
        let near = reached.iter().take(FINALISTS).chain(first.iter().take(FINALISTS)).chain(&self.wholes);
        let runners: Vec<Runner> = near.map(|runner| one.without(runner, unit)).collect();
        let mut runners = distinct(&self.laps.run(&one.free, &self.coarse, &runners, GLANCE)?, same_place);
        runners.truncate(FINALISTS);
        let ended = self.laps.run(&one.free, &self.coarse, &runners, FIRST_LAP)?;
        self.join(&ended.iter().take(1).map(|runner| one.embedded(runner, self.free)).collect::<Vec<_>>())
    }

    /// Add the optima without offsets: offsets of the runs can hide which measured signal is the input.
    fn plain(&mut self) -> Result<()> {
        let structure = &self.free.structure;
        let plain = structure.initial.without_offset();
        if structure.coupled || plain == structure.initial {
            return Ok(());
        }
        let plain = Free::of(Structure { initial: plain, ..structure.clone() })?;
        let mut ended = race(&plain, self.course.inside())?;
        ended.truncate(FINALISTS);
        self.add(ended);
        Ok(())
    }

    /// Promote the survivors to the second budget; duplicates and candidates far behind do not continue.
    fn ended(self) -> Result<(Vec<Runner>, Grid<'a>)> {
        let (laps, free, coarse) = (self.laps, self.free, self.coarse);
        let reached = distinct(&self.reached, same_optimum);
        let (contenders, lost) = reached.split_at(in_reach(&reached).len());
        let (ahead, rest) = contenders.split_at(contenders.len().min(FEWEST.max(reached.len() / RUNNERS)));
        let (mut rest, mut lost) = (rest.to_vec(), lost.to_vec());
        let mut found = laps.run(free, &coarse, ahead, SECOND_LAP)?;
        let level = found.first().map_or(0.0, Runner::level);
        if level > ABOVE_FLOOR * self.course.floor {
            // The best cost is above the noise floor: candidates behind may still lead to a better optimum.
            rest = on_the_way(laps, free, &coarse, &rest)?;
            let farthest = FAR_BEHIND * contenders[0].level();
            let stirring;
            (stirring, lost) = stirred(laps, free, &coarse, &lost, farthest)?;
            rest.extend(on_the_way(laps, free, &coarse, &stirring)?);
        }
        found.extend(rest);
        let mut found = ranked(&coarse, self.half, found)?;
        found.extend(lost);
        Ok((found, coarse))
    }
}

/// Sort candidates by the larger of their costs on a grid and on half its step; by the former if the latter fails.
fn ranked(coarse: &Grid<'_>, half: Option<Grid<'_>>, runners: Vec<Runner>) -> Result<Vec<Runner>> {
    if runners.is_empty() {
        return Ok(runners);
    }
    let half = match half.map_or_else(|| coarse.finer(), Ok) {
        Err(Error::Interrupted) => return Err(Error::Interrupted),
        Err(_) => return Ok(sorted(runners)),
        Ok(half) => half,
    };
    let order = half.ranked(&runners.iter().map(|runner| &runner.attempt).collect::<Vec<_>>())?;
    let mut runners: Vec<Option<Runner>> = runners.into_iter().map(Some).collect();
    Ok(order.into_iter().filter_map(|i| runners[i].take()).collect())
}

/// True if an equation has several autoregressive terms of free order.
fn is_rich(free: &Free) -> bool {
    let several = |e: &Equation| e.own().filter(|term| term.order.is_free()).count() > 1;
    free.structure.equations.iter().any(several)
}

/// Multistart of a problem with many initial terms per run, which are added for the survivors only.
///
/// The initial terms move most optima by less than their distance. The survivors are ranked again after a budget with
/// all initial terms.
fn with_history(free: &Free, course: Course<'_>) -> Result<Vec<Runner>> {
    let few = free.starting(free.structure.initial.with_under(Initial::Caputo), false)?;
    let (reached, coarse) = without_history(&few, course)?;
    let (reached, coarse) = (distinct(&reached, same_optimum), coarse.of(&free.problem));
    let laps = Laps { starts: reached.len(), threads: course.threads, told: None };
    let ends = laps.each(free, &coarse, &reached, 0)?;
    let levels: Vec<f64> = ends.iter().map(|end| end.as_ref().map_or(f64::INFINITY, Runner::level)).collect();
    let mut order: Vec<usize> = (0..reached.len()).collect();
    order.sort_by(|&i, &j| levels[i].total_cmp(&levels[j]));
    let limit = order.first().map_or(0.0, |&i| CONTENDER * levels[i]);
    let going: Vec<Runner> =
        order.iter().take(FEWEST).filter(|&&i| levels[i] <= limit).map(|&i| reached[i].clone()).collect();
    let mut rest = order[going.len()..].to_vec();
    rest.sort_unstable();
    let mut ahead = ranked(&coarse, None, laps.run(free, &coarse, &going, FIRST_LAP)?)?;
    ahead.extend(rest.into_iter().map(|i| reached[i].clone()));
    Ok(distinct(&ahead, same_optimum))
}

/// Relative cost decrease per first budget below which a candidate behind the best has converged and is stopped.
const ON_THE_WAY: f64 = 0.05;
/// Evaluations in which a candidate far behind must lower its cost by [`MIN_PROMOTION_DECREASE_RATIO`] to be promoted.
const STIR: usize = 5;
const STIRS: f64 = 0.1;

/// Optimize candidates while they improve, for at most the second budget.
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

/// Split candidates up to a cost limit into those that improve in a few evaluations, and the others.
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

/// Optimize candidates on coarse grids; return them best first.
///
/// # Errors
/// As the source, [`crate::error::Error::Interrupted`].
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

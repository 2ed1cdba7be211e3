//! The race itself: who runs how far, and the problems inside a problem.
//!
//! Those that are behind: who is still on the way goes on.
//!
//! Starts of bodies with friction on coarse grids.

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

/// All get as many evaluations as those ahead where the best is above the noise by this factor; of those further behind than
/// contenders are, by no more than the second factor, who falls by a share in a few evaluations.
const ABOVE_FLOOR: f64 = 2.0;
const FAR_BEHIND: f64 = 100.0;

/// Where a race starts.
pub trait Starts {
    /// Starts of a problem on the runs.
    ///
    /// # Errors
    /// Where its equations cannot be searched, [`Error::Interrupted`].
    fn of(&self, free: &Free) -> Result<Vec<Runner>>;
}

/// What the races of a problem and of those inside it share.
#[derive(Clone, Copy)]
pub struct Course<'a> {
    /// The runs.
    pub source: &'a dyn Recordings,
    /// Where races start.
    pub starts: &'a dyn Starts,
    /// Whom to ask whether to go on.
    pub stop: &'a Stop,
    /// What each output weighs: alike, for noise decides where the optimum is, not how to get near it.
    pub weights: &'a [f64],
    /// What noise alone leaves per residual.
    pub floor: f64,
    /// Threads; no number depends on them.
    pub threads: usize,
    /// Who is told (starts done, starts in all); nobody of a race inside another.
    pub told: Option<&'a Listener<'a>>,
}

impl<'a> Course<'a> {
    /// That of a race inside this one.
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

/// Coarse fits from all starts, best first.
///
/// # Errors
/// Those of the source and of the starts, what whoever is told ends with, [`Error::Interrupted`].
pub fn race(free: &Free, course: Course<'_>) -> Result<Vec<Runner>> {
    if free.structure.history {
        return with_history(free, course);
    }
    Ok(without_history(free, course)?.0)
}

/// What a computation found; nothing where it made no equation.
fn made<T>(found: Result<T>) -> Result<Option<T>> {
    match found {
        Err(error) if error.kind() == Kind::Model => Ok(None),
        found => found.map(Some),
    }
}

/// A race under way.
struct Run<'a> {
    free: &'a Free,
    course: Course<'a>,
    laps: Laps<'a>,
    coarse: Grid<'a>,
    /// The same on half the step, where it was made.
    half: Option<Grid<'a>>,
    starts: Vec<Runner>,
    /// Where the first lap of the whole problem ended.
    first: Vec<Runner>,
    /// What whole orders reached.
    wholes: Vec<Runner>,
    reached: Vec<Runner>,
}

/// The race of a problem whose initial terms are few, and the grid on which it was.
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
    /// Whatever a simpler equation reaches, this one reaches too: it starts there with the term's coefficient at 0, or with
    /// a pole too fast to see.
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

    /// Adds runners where they are on this problem's grid.
    fn join(&mut self, runners: &[Runner]) -> Result<()> {
        let there = self.laps.run(self.free, &self.coarse, runners, 1)?;
        self.add(there);
        Ok(())
    }

    fn simpler(&mut self, less: &Simpler) -> Result<()> {
        if less.driven {
            // What drives is solved for at every point, with a term less as well: own terms alone are told apart, so where
            // the whole problem starts and ends will do, and the way goes on in the whole problem.
            let first = distinct(&self.first, same_optimum);
            let from = first.iter().take(FINALISTS).chain(&self.starts);
            let runners: Vec<Runner> = from.map(|runner| less.without(runner, self.free)).collect();
            let mut runners = self.laps.run(&less.free, &self.coarse, &runners, GLANCE)?;
            runners.truncate(FINALISTS);
            let ended = self.laps.run(&less.free, &self.coarse, &runners, FIRST_LAP)?;
            return self.join(&ended.iter().take(1).map(|r| less.embedded(r, self.free)).collect::<Vec<_>>());
        }
        if is_rich(self.free) && less.free.orders.len() < self.free.orders.len() {
            // One of several terms of free orders less is still an equation of many optima: searched like the whole.
            let ended = without_history(&less.free, self.course.inside())?.0;
            // Which of its optima is the lowest, a history may turn round.
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
        // At given orders most starts lead to one optimum.
        let ended = self.of(&less.free, FINALISTS)?;
        let there: Vec<Runner> = ended.iter().take(1).map(|runner| less.embedded(runner)).collect();
        self.wholes.extend(there.iter().cloned());
        self.add(there);
        Ok(())
    }

    /// Where a problem inside this one ends from starts of its own, so many of which go on.
    fn of(&self, free: &Free, going: usize) -> Result<Vec<Runner>> {
        // At whole orders two of its terms may have become one.
        let Some(starts) = made(self.course.starts.of(free))? else { return Ok(Vec::new()) };
        let mut runners = distinct(&self.laps.run(free, &self.coarse, &starts, GLANCE)?, same_place);
        runners.truncate(going);
        let ended = self.laps.run(free, &self.coarse, &runners, FIRST_LAP)?;
        self.laps.run(free, &self.coarse, &finalists(&ended), SECOND_LAP)
    }

    /// Nor is it to end above what it reaches with one order known.
    fn known(&mut self, one: &Held, unit: &Clock) -> Result<()> {
        let level = self.reached.first().map_or(0.0, Runner::level);
        if one.free.orders.len() == 1 && level > ABOVE_FLOOR * self.course.floor {
            // A race of one free order costs little where noise alone would leave less; bounds may leave it no lattice.
            if let Some((ended, _)) = made(without_history(&one.free, self.course.inside()))? {
                let there = in_reach(&ended).into_iter().take(FINALISTS).map(|runner| one.embedded(&runner, self.free));
                return self.join(&there.collect::<Vec<_>>());
            }
        }
        // From where it is, and from whole orders.
        let (reached, first) = (distinct(&self.reached, same_optimum), distinct(&self.first, same_optimum));
        let near = reached.iter().take(FINALISTS).chain(first.iter().take(FINALISTS)).chain(&self.wholes);
        let runners: Vec<Runner> = near.map(|runner| one.without(runner, unit)).collect();
        let mut runners = distinct(&self.laps.run(&one.free, &self.coarse, &runners, GLANCE)?, same_place);
        runners.truncate(FINALISTS);
        let ended = self.laps.run(&one.free, &self.coarse, &runners, FIRST_LAP)?;
        self.join(&ended.iter().take(1).map(|runner| one.embedded(runner, self.free)).collect::<Vec<_>>())
    }

    /// An offset of each run hides which of the measured signals drives: also from where it ends without.
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

    /// Who is ahead goes on; those that came to the same optimum as one, and those that are far behind not at all.
    fn ended(self) -> Result<(Vec<Runner>, Grid<'a>)> {
        let (laps, free, coarse) = (self.laps, self.free, self.coarse);
        let reached = distinct(&self.reached, same_optimum);
        let (contenders, lost) = reached.split_at(in_reach(&reached).len());
        let (ahead, rest) = contenders.split_at(contenders.len().min(FEWEST.max(reached.len() / RUNNERS)));
        let (mut rest, mut lost) = (rest.to_vec(), lost.to_vec());
        let mut found = laps.run(free, &coarse, ahead, SECOND_LAP)?;
        let level = found.first().map_or(0.0, Runner::level);
        if level > ABOVE_FLOOR * self.course.floor {
            // Noise alone would leave less: those behind may yet be on the way to where it does.
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

/// Runners in the order of their cost on a grid or on half its step, whichever is the larger; where that cannot be made, on
/// the grid.
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

/// Whether an equation has several own terms of free order.
fn is_rich(free: &Free) -> bool {
    let several = |e: &Equation| e.own().filter(|term| term.order.is_free()).count() > 1;
    free.structure.equations.iter().any(several)
}

/// The same of runs in motion: the terms of their history, many a run, wait for those that go on.
///
/// What a run remembers moves most optima by less than lies between two; where it does not, the order among them is that of
/// a lap with it.
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

//! One call from a structure, its runs and settings to a fit: starts, their race, weights, grids, the limit and its covariance.

use super::multistart::{finalists, race, Course, Starts};
use super::objective::{Grid, Weights, FINEST};
use super::parameter_set::Free;
use super::problem::{Attempt, Place, Runner};
use super::progress::{Listener, Pace};
use super::reweighting::{settled, Loss, LAST_LAP};
use super::source::{Recordings, Sampling};
use super::stability_preference::{steadied, Growth};
use super::step_refinement::{refined, Finished, Optimum};
use crate::error::{Error, Result};
use crate::parallel::Stop;
use crate::signal::statistics::{mean, median, robust_deviation};

/// Share of a fit's course at whose end the race is, and of what is left of that what each of its sweeps takes.
const RACED: f64 = 0.5;
const SWEEP: f64 = 0.3;
/// Residual that costs 1 in a coarse fit, as a share of an output's size.
const COARSE_SHARE: f64 = 0.01;
/// Least noise of an output, as a share of its size, and of an optimum to go on from.
const LEAST_NOISE: f64 = 1e-3;
const TINY: f64 = 1e-300;
/// Evaluations of each finalist on all samples.
const FINAL_LAP: usize = 60;

/// How large an output is, and a first guess of its noise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Size {
    /// Root of the mean of its variances on all runs.
    pub size: f64,
    /// Deviation of what is white in it.
    pub noise: f64,
}

impl Size {
    /// Of what was read of an output by run; what is no number was not.
    #[must_use]
    pub fn of(runs: &[Vec<f64>]) -> Self {
        let variance = |samples: &Vec<f64>| {
            let known: Vec<f64> = samples.iter().copied().filter(|v| !v.is_nan()).collect();
            let middle = mean(&known);
            mean(&known.iter().map(|v| (v - middle) * (v - middle)).collect::<Vec<_>>())
        };
        let size = mean(&runs.iter().map(variance).collect::<Vec<_>>()).sqrt();
        Self::guessed(size, runs)
    }

    /// From its size and what was read of it by run: second differences tell noise, but none below a share of the size.
    #[must_use]
    pub fn guessed(size: f64, runs: &[Vec<f64>]) -> Self {
        let noise = median(runs.iter().map(|samples| noise_of(samples)).collect());
        Self { size, noise: noise.max(LEAST_NOISE * size) }
    }
}

/// Deviation of white noise on a smooth signal, from the median of its second differences.
#[must_use]
pub fn noise_of(samples: &[f64]) -> f64 {
    let bends = |samples: &[f64]| -> Vec<f64> {
        let second = samples.windows(3).map(|w| (w[2] - w[1]) - (w[1] - w[0]));
        second.filter(|bend| !bend.is_nan()).collect()
    };
    let mut found = bends(samples);
    if found.is_empty() {
        // No three neighbours were read: those that were stand closest.
        found = bends(&samples.iter().copied().filter(|v| !v.is_nan()).collect::<Vec<_>>());
    }
    robust_deviation(&found) / 6.0_f64.sqrt()
}

/// What a fit starts from.
#[derive(Debug, Clone)]
pub enum Outset {
    /// The automatic starts, or where a race of them got before, and known ones beside them.
    Starts {
        /// Values of everything free, each a start.
        known: Vec<Vec<f64>>,
        /// Where a race got.
        raced: Option<Vec<Runner>>,
    },
    /// Values of everything free, the only start.
    Given(Vec<f64>),
    /// A fit of the same structure to nearly the same runs: on its grid and with its weights.
    Near {
        /// Its values of everything free.
        values: Vec<f64>,
        /// Noise of each output.
        noise: Vec<f64>,
        /// Pulses a sample interval.
        every: usize,
        /// Where the race of its starts got, if there was one.
        raced: Vec<Runner>,
    },
}

/// How a fit is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// What residuals cost; between starts squares decide.
    pub loss: Loss,
    /// Whether the grid is refined below the samples.
    pub refine: bool,
    /// Threads of the race; no number depends on them.
    pub threads: usize,
}

/// An optimum of the joint output error.
#[derive(Debug, Clone, PartialEq)]
pub struct JointFit {
    /// The optimum with all that describes it.
    pub finished: Finished,
    /// Where the starts got, best first.
    pub reached: Vec<Runner>,
    /// Where its free run grows, or another's would have: what was compared.
    pub growth: Option<Growth>,
}

/// A structure on its runs, and how large its outputs are.
#[derive(Clone, Copy)]
pub struct Sought<'a> {
    /// What is free.
    pub free: &'a Free,
    /// The runs.
    pub source: &'a dyn Recordings,
    /// Where its starts come from.
    pub starts: &'a dyn Starts,
    /// Of each output.
    pub sizes: &'a [Size],
    /// Whom to ask whether to go on.
    pub stop: &'a Stop,
}

impl<'a> Sought<'a> {
    fn grid(&self, outputs: Vec<f64>, every: usize) -> Result<Grid<'a>> {
        let sampling = Sampling { every, ..Sampling::default() };
        let weights = Weights { outputs, shares: None };
        let source: &'a dyn Recordings = self.source;
        Grid::new((&self.free.problem, source, self.stop), weights, sampling, false)
    }

    /// Every output weighing alike: noise decides where the optimum is, not how to get near it.
    ///
    /// # Errors
    /// Those of the source.
    pub fn alike(&self, every: usize) -> Result<Grid<'a>> {
        self.grid(self.sizes.iter().map(|size| 1.0 / (COARSE_SHARE * size.size)).collect(), every)
    }

    /// Where its starts get, best first; progress is (starts done, starts in all).
    ///
    /// # Errors
    /// Those of the source, of the starts and of whoever is told; [`Error::Interrupted`].
    pub fn race(&self, threads: usize, told: &Listener<'_>) -> Result<Vec<Runner>> {
        let share = |size: &Size| (size.noise / (COARSE_SHARE * size.size)).powi(2);
        let floor = mean(&self.sizes.iter().map(share).collect::<Vec<_>>());
        let weights: Vec<f64> = self.sizes.iter().map(|size| 1.0 / (COARSE_SHARE * size.size)).collect();
        let Self { source, starts, stop, .. } = *self;
        let course = Course { source, starts, stop, weights: &weights, floor, threads, told: Some(told) };
        race(self.free, course)
    }

    fn start(&self, values: &[f64], origin: &str) -> Result<Runner> {
        let place = Place { point: self.free.problem.point(values)?, states: Vec::new() };
        Ok(Runner::at(place, origin))
    }
}

/// Fits a structure on its runs by output error; none where no start has a finite free run.
///
/// # Errors
/// Those of the source and the starts; [`Error::Beyond`] where squares of residuals are no numbers; what the last contender's
/// descent ends with where none has a free run; [`Error::Interrupted`].
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::equation::Initial;
/// use ftlm::estimation::joint_fit::structure::{Coefficient, Equation, Order, Structure, Term};
/// use ftlm::estimation::joint_fit::parameter_set::Free;
/// use ftlm::estimation::joint_fit::initial_guesses::Lattices;
/// use ftlm::estimation::joint_fit::{fit, Loss, Outset, Sampled, Settings, Signal, Size, Sought};
/// use ftlm::signal::block_pulse::Intersample;
/// use ftlm::parallel::Stop;
/// // y of D y = −2 y + 3 u in exact steps, and D^alpha y = a y + b u sought.
/// let (step, mut y) = (0.05, vec![0.0]);
/// let u: Vec<f64> = (0..200).map(|k| if k % 40 < 20 { 1.0 } else { -1.0 }).collect();
/// let fall = f64::exp(-2.0 * step);
/// u.iter().for_each(|u| y.push(fall * y[y.len() - 1] + 1.5 * (1.0 - fall) * u));
/// y.pop();
/// let sizes = [Size::of(&[y.clone()])];
/// let signal = |samples, between| Signal { samples, between };
/// let run = vec![signal(y, Intersample::Linear), signal(u, Intersample::Hold)];
/// let runs = Sampled::new(step, vec![0], vec![run])?;
/// let term = |signal, name: &str| {
///     let coefficient = Coefficient::Free(name.into());
///     Term { signal, order: Order::number(0.0), coefficient, factor: 1.0 }
/// };
/// let terms = vec![term(0, "a"), term(1, "b")];
/// let sought = Equation { output: 0, order: Order::free("alpha"), terms, friction: None };
/// let signals = vec!["y".into(), "u".into()];
/// let free = Free::of(Structure::new(signals, vec![sought], Initial::Rest))?;
/// let stop = Stop::default();
/// let starts = Lattices::new(&runs, 1, 1 << 28, &stop);
/// let asked = Sought { free: &free, source: &runs, starts: &starts, sizes: &sizes, stop: &stop };
/// let settings = Settings { loss: Loss::Squares, refine: true, threads: 1 };
/// let outset = Outset::Starts { known: Vec::new(), raced: None };
/// let found = fit::fit(asked, outset, settings, &|_, _| Ok(()))?.expect("a start has a free run");
/// let [alpha, a, b] = found.finished.estimate[..] else { panic!("three numbers") };
/// assert!((alpha - 1.0).abs() < 1e-3 && (a + 2.0).abs() < 1e-2 && (b - 3.0).abs() < 1e-2);
/// # Ok(())
/// # }
/// ```
pub fn fit(sought: Sought<'_>, outset: Outset, settings: Settings, told: &Listener<'_>) -> Result<Option<JointFit>> {
    let free = sought.free;
    let mut pace = Pace::new(told);
    let (reached, contenders) = match outset {
        Outset::Near { values, noise, every, raced } => {
            let start = sought.start(&values, GIVEN)?;
            let grid = sought.grid(noise.iter().map(|noise| 1.0 / noise.max(TINY)).collect(), every)?;
            let (best, grid) = weighed(&start, grid, settings.loss)?;
            return ended(free, best, grid, raced, settings).map(Some);
        }
        Outset::Given(values) => (Vec::new(), vec![sought.start(&values, GIVEN)?]),
        Outset::Starts { known, raced } => {
            let reached = if let Some(raced) = raced {
                raced
            } else {
                let shared = std::cell::RefCell::new(&mut pace);
                sought.race(settings.threads, &|done, of| shared.borrow_mut().until(RACED, SWEEP, done, of))?
            };
            let mut contenders = finalists(&reached);
            for values in &known {
                contenders.push(sought.start(values, GIVEN)?);
            }
            (reached, contenders)
        }
    };
    let Some(first) = contenders.first() else { return Ok(None) };
    pace.at(RACED)?;
    let mut grid = sought.grid(sought.sizes.iter().map(|size| 1.0 / size.noise).collect(), 1)?;
    // Where a step passes faster than the samples see, a grid as coarse as the samples has an optimum of its own.
    while grid.sampling.every < FINEST {
        let finer = grid.finer()?;
        if !grid.noticed(&first.attempt.place, &finer)? {
            break;
        }
        grid = finer;
    }
    let mut best = winner(free, &contenders, &sought.alike(grid.sampling.every)?)?;
    if sought.sizes.len() > 1 {
        // Of one output the noise does not move the optimum.
        let place = &best.attempt.place;
        best = best.moved(grid.descend_in(&free.turned(place, false, &[]), place, LAST_LAP)?);
    }
    pace.at(0.65)?;
    let (best, grid) = weighed(&best, grid, settings.loss)?;
    pace.at(0.75)?;
    let found = ended(free, best, grid, reached, settings)?;
    pace.at(1.0)?;
    Ok(Some(found))
}

/// What the start of a fit that was given one is called.
const GIVEN: &str = "given start";

/// What a fit comes to whose weights have settled: one that dies away where it may, on grids fine enough.
fn ended(free: &Free, best: Runner, grid: Grid<'_>, reached: Vec<Runner>, settings: Settings) -> Result<JointFit> {
    let (mut best, mut grid, growth) = steadied(free, best, grid, &reached)?;
    if growth.is_some_and(|growth| !growth.kept) {
        (best, grid) = weighed(&best, grid, settings.loss)?;
    }
    let optimum = if settings.refine {
        let others: Vec<Place> = finalists(&reached).into_iter().map(|runner| runner.attempt.place).collect();
        refined(best.attempt, grid, settings.loss, &others)?
    } else {
        Optimum::unrefined(best.attempt, grid)?
    };
    Ok(JointFit { finished: optimum.finished(), reached, growth })
}

/// A runner on a grid whose weights have settled.
fn weighed<'a>(runner: &Runner, grid: Grid<'a>, loss: Loss) -> Result<(Runner, Grid<'a>)> {
    let (attempt, grid) = settled(&runner.attempt.place, grid, loss)?;
    Ok((runner.moved(attempt), grid))
}

/// The best of the contenders on all samples, every output still weighing alike.
fn winner(free: &Free, contenders: &[Runner], near: &Grid<'_>) -> Result<Runner> {
    let mut ends = Vec::new();
    let mut last = None;
    for runner in contenders {
        let place = &runner.attempt.place;
        match near.descend_in(&free.turned(place, false, &[]), place, FINAL_LAP) {
            Ok(attempt) => ends.push(runner.moved(attempt)),
            Err(Error::Interrupted) => return Err(Error::Interrupted),
            // No finite free run on this grid; the others have one.
            Err(error) => last = Some(error),
        }
    }
    let attempts: Vec<&Attempt> = ends.iter().map(|runner| &runner.attempt).collect();
    let first = match (attempts.len(), last) {
        (0, Some(error)) => return Err(error),
        (0 | 1, _) => 0,
        _ => near.finer()?.ranked(&attempts)?[0],
    };
    let best = &ends[first];
    // In logarithms it had its lap.
    let place = &best.attempt.place;
    let plain = near.descend_in(&free.turned(place, true, &[]), place, FINAL_LAP)?;
    Ok(if plain.cost <= best.attempt.cost { best.moved(plain) } else { best.clone() })
}

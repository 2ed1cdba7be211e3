//! A problem on its runs, sampled so finely, and what each output weighs.

use std::sync::Arc;

use super::problem::{Attempt, Place, Problem};
use super::source::{Sampling, Source};
use crate::error::{check_length, Error, Result};
use crate::estimation::output_error::{Experiment, Settings};
use crate::parallel::Stop;
use crate::signal::statistics::{mean, robust_deviation, root_mean_square};

/// A descent ends where a whole step would lower the cost by a smaller share than this.
pub const TOLERANCE: f64 = 1e-9;
/// Discretisation that a fit may leave, in standard deviations of the noise.
const NOTICED: f64 = 0.3;
/// Finest grid: pulses a sample interval.
pub const FINEST: usize = 16;

/// What each output weighs, 1/σ, and the shares of these weights by run and output that a robust loss leaves.
#[derive(Debug, Clone, PartialEq)]
pub struct Weights {
    /// Of each output.
    pub outputs: Vec<f64>,
    /// Of each compared sample of each output of each run; none: all count alike.
    pub shares: Option<Vec<Vec<Vec<f64>>>>,
}

/// A problem on its runs. On a steady one no descent goes from a free run that dies away to one that grows.
#[derive(Clone)]
pub struct Grid<'a> {
    /// What is free.
    pub problem: &'a Problem,
    source: &'a dyn Source,
    stop: &'a Stop,
    /// What each output weighs.
    pub weights: Weights,
    /// How finely the runs are sampled.
    pub sampling: Sampling,
    /// Whether a free run that grows is no place to go.
    pub steady: bool,
    /// What was read, by run and output, where something was not.
    read: Arc<Vec<Vec<Vec<f64>>>>,
    experiments: Arc<Vec<Experiment>>,
}

impl<'a> Grid<'a> {
    /// The runs of a source on a grid.
    ///
    /// # Errors
    /// Those of the source; [`Error::Length`] for weights or shares of another number.
    pub fn new(
        (problem, source, stop): (&'a Problem, &'a dyn Source, &'a Stop),
        weights: Weights,
        sampling: Sampling,
        steady: bool,
    ) -> Result<Self> {
        check_length("weights", problem.outputs.len(), weights.outputs.len())?;
        sampling.check()?;
        let experiments = source.experiments(sampling)?;
        stop.check()?;
        let read = Arc::new(experiments.iter().map(|e| e.shares.clone()).collect());
        let blank = Weights { outputs: Vec::new(), shares: None };
        let grid =
            Self { problem, source, stop, weights: blank, sampling, steady, read, experiments: Arc::new(experiments) };
        grid.reweighed(weights)
    }

    /// The same runs with other weights.
    ///
    /// # Errors
    /// [`Error::Length`] for shares of another number.
    pub fn reweighed(&self, weights: Weights) -> Result<Self> {
        let mut experiments = Vec::clone(&self.experiments);
        if let Some(shares) = &weights.shares {
            check_length("runs with shares", experiments.len(), shares.len())?;
        }
        for (k, experiment) in experiments.iter_mut().enumerate() {
            experiment.weights.clone_from(&weights.outputs);
            experiment.shares.clone_from(&self.read[k]);
            let Some(shares) = weights.shares.as_ref().map(|of| &of[k]) else { continue };
            check_length("outputs with shares", self.problem.outputs.len(), shares.len())?;
            if experiment.shares.is_empty() {
                experiment.shares.clone_from(shares);
            } else {
                for (row, by) in experiment.shares.iter_mut().zip(shares) {
                    check_length("shares of samples", row.len(), by.len())?;
                    row.iter_mut().zip(by).for_each(|(share, by)| *share *= by);
                }
            }
        }
        Ok(Self { weights, experiments: Arc::new(experiments), ..self.clone() })
    }

    /// The same on half the step.
    ///
    /// # Errors
    /// Those of the source.
    pub fn finer(&self) -> Result<Self> {
        let sampling = Sampling { every: 2 * self.sampling.every, ..self.sampling };
        Self::new((self.problem, self.source, self.stop), self.weights.clone(), sampling, self.steady)
    }

    /// The same runs for another problem of the same outputs.
    #[must_use]
    pub fn of(&self, problem: &'a Problem) -> Self {
        Self { problem, ..self.clone() }
    }

    /// The same where no descent goes from a free run that dies away to one that grows.
    #[must_use]
    pub fn steadily(&self) -> Self {
        Self { steady: true, ..self.clone() }
    }

    /// The runs as they are compared with.
    #[must_use]
    pub fn experiments(&self) -> &[Experiment] {
        &self.experiments
    }

    /// Where the runs come from.
    #[must_use]
    pub fn source(&self) -> &'a dyn Source {
        self.source
    }

    /// Whom to ask whether to go on.
    #[must_use]
    pub fn stop(&self) -> &'a Stop {
        self.stop
    }

    /// The unit of time of the runs.
    #[must_use]
    pub fn clock(&self) -> super::parameter_set::Clock {
        super::parameter_set::Clock::of(self.problem, &self.source.spans())
    }

    /// Levenberg–Marquardt from a place.
    ///
    /// # Errors
    /// See [`Problem::descend`].
    pub fn descend(&self, start: &Place, evaluations: usize) -> Result<Attempt> {
        let settings = Settings { evaluations, tolerance: TOLERANCE };
        self.problem.descend(&self.experiments, start, settings, self.steady, self.stop)
    }

    /// The same in the coordinates of a problem turned towards a start, see [`super::parameter_set::Free::turned`].
    ///
    /// # Errors
    /// See [`Problem::descend`].
    pub fn descend_in(&self, turned: &Problem, start: &Place, evaluations: usize) -> Result<Attempt> {
        let settings = Settings { evaluations, tolerance: TOLERANCE };
        turned.descend(&self.experiments, start, settings, self.steady, self.stop)
    }

    /// Whether halving the step moves the simulated samples by a share of the residuals that a fit would notice.
    ///
    /// What is left over is noise at least; of a structure that is not all of the machine's physics it is more.
    ///
    /// # Errors
    /// Those of the source, [`Error::Interrupted`].
    pub fn matters(&self, place: &Place) -> Result<bool> {
        self.noticed(place, &self.finer()?)
    }

    /// The same, half the step at hand.
    ///
    /// # Errors
    /// [`Error::Interrupted`].
    pub fn noticed(&self, place: &Place, finer: &Self) -> Result<bool> {
        let (Some(here), Some(there)) = (self.evaluated(place)?, finer.evaluated(place)?) else {
            // Finite on one grid and not on the other: it matters.
            return Ok(true);
        };
        let moved: Vec<f64> = there.residuals.iter().zip(&here.residuals).map(|(a, b)| (a - b).powi(2)).collect();
        let left = mean(&there.residuals.iter().map(|e| e * e).collect::<Vec<_>>()).max(1.0);
        // Squares beyond the numbers belong to a free run that one of the grids does not carry.
        Ok(!left.is_finite() || mean(&moved) > NOTICED * NOTICED * left)
    }

    /// Places of attempts in the order of their cost on the grid that they come from or on this finer one, whichever is
    /// the larger.
    ///
    /// The pulse scheme of a stiff equation has a mode that alternates from pulse to pulse. A fit may use it to follow
    /// noise, at the cost of a free run that no other grid has.
    ///
    /// # Errors
    /// [`Error::Interrupted`].
    pub fn ranked(&self, attempts: &[&Attempt]) -> Result<Vec<usize>> {
        let worse = |attempt: &&Attempt| {
            let there = self.evaluated(&attempt.place)?;
            Ok(there.map_or(f64::INFINITY, |there| attempt.level().max(there.level())))
        };
        let costs: Vec<f64> = attempts.iter().map(worse).collect::<Result<_>>()?;
        let any = costs.iter().any(|cost| cost.is_finite());
        let key = |i: usize| (if any { costs[i] } else { 0.0 }, attempts[i].level());
        let mut order: Vec<usize> = (0..attempts.len()).collect();
        order.sort_by(|&i, &j| {
            let ((a, b), (c, d)) = (key(i), key(j));
            a.total_cmp(&c).then(b.total_cmp(&d))
        });
        Ok(order)
    }

    /// A place with its residuals and its cost on this grid, without derivatives; none where it has no finite free run.
    ///
    /// # Errors
    /// [`Error::Interrupted`].
    pub fn evaluated(&self, place: &Place) -> Result<Option<Attempt>> {
        match self.descend(place, 0) {
            Ok(found) => Ok(Some(found)),
            Err(Error::Interrupted) => Err(Error::Interrupted),
            Err(_) => Ok(None),
        }
    }

    /// Shares with which the compared samples count, by run and output; none: all count alike.
    fn shares(&self) -> impl Iterator<Item = (&Experiment, usize, Option<&[f64]>)> {
        let outputs = self.problem.outputs.len();
        self.experiments.iter().flat_map(move |e| (0..outputs).map(move |i| (e, i, e.shares.get(i).map(Vec::as_slice))))
    }

    /// Residuals of an attempt over the noise by run and output, whatever their shares; not a number where none was read.
    #[must_use]
    pub fn residuals(&self, attempt: &Attempt) -> Vec<Vec<Vec<f64>>> {
        let outputs = self.problem.outputs.len();
        let (mut parts, mut rest) = (Vec::new(), attempt.residuals.as_slice());
        for (experiment, i, shares) in self.shares() {
            let (own, others) = rest.split_at(experiment.compared().min(rest.len()));
            rest = others;
            if i == 0 {
                parts.push(Vec::with_capacity(outputs));
            }
            let whole = match shares {
                None => own.to_vec(),
                Some(shares) => {
                    own.iter().zip(shares).map(|(e, &share)| e / if share > 0.0 { share } else { f64::NAN }).collect()
                }
            };
            if let Some(part) = parts.last_mut() {
                part.push(whole);
            }
        }
        parts
    }

    /// Share of every residual, as they are strung together.
    #[must_use]
    pub fn every_share(&self) -> Vec<f64> {
        let of = |(experiment, _, shares): (&Experiment, usize, Option<&[f64]>)| {
            shares.map_or_else(|| vec![1.0; experiment.compared()], <[f64]>::to_vec)
        };
        self.shares().flat_map(of).collect()
    }

    /// Weighted residuals that are there by output, all runs one after another.
    #[must_use]
    pub fn pooled(&self, attempt: &Attempt) -> Vec<Vec<f64>> {
        let parts = self.residuals(attempt);
        let of = |i: usize| parts.iter().flat_map(|part| &part[i]).copied().filter(|e| !e.is_nan()).collect();
        (0..self.problem.outputs.len()).map(of).collect()
    }

    /// Root mean square of the weighted residuals by output, over all runs; infinite beyond the numbers.
    #[must_use]
    pub fn levels(&self, attempt: &Attempt) -> Vec<f64> {
        self.pooled(attempt).iter().map(|e| root_mean_square(e)).collect()
    }

    /// Deviation of the usual residuals by output, in units of the weights; of all where half of them are none.
    #[must_use]
    pub fn scales(&self, attempt: &Attempt) -> Vec<f64> {
        let of = |e: &Vec<f64>| match robust_deviation(e) {
            0.0 => root_mean_square(e),
            deviation => deviation,
        };
        self.pooled(attempt).iter().map(of).collect()
    }
}

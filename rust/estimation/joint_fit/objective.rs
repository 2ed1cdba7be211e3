//! Objective of a joint fit: weighted residuals of a problem on sampled runs.

use std::sync::Arc;

use super::problem::{Iterate, OptimizationResult, Problem};
use crate::error::{check_length, Error, Result};
use crate::estimation::output_error::fractional_orders::FractionalOrders;
use crate::estimation::output_error::integer_orders::IntegerOrders;
use crate::estimation::output_error::{Experiment, MinimizationSettings};
use crate::parallel::Stop;
use crate::recording::{Recordings, Sampling};
use crate::signal::statistics::{mean, robust_deviation, root_mean_square};

/// Relative cost decrease, predicted for a full step, below which an optimization has converged.
pub const RELATIVE_COST_TOLERANCE: f64 = 1e-9;
/// Increase of twice the log-likelihood, predicted for a full step, below which a fit for comparison has converged.
///
/// Such a fit is only compared with other fits.
const COMPARISON_LIKELIHOOD_TOLERANCE: f64 = 2e-4;
/// Maximum acceptable discretization error, relative to the root mean square residual or to the noise, whichever is
/// larger.
const MAX_DISCRETIZATION_NOISE_RATIO: f64 = 0.3;
/// Maximum number of block pulses per sampling interval.
pub const MAX_PULSES_PER_SAMPLE: usize = 16;

/// Difference between a delay and a whole number of sampling intervals, in intervals, below which it counts as whole.
const WHOLE_DELAY_TOLERANCE: f64 = 1e-9;

/// Weights of the outputs, and robust weights of the samples.
#[derive(Debug, Clone, PartialEq)]
pub struct Weights {
    /// Weight 1/σ of each output, with its noise standard deviation σ.
    pub outputs: Vec<f64>,
    /// Robust weight of each sample that is compared with the simulation, by run and output; None for unit weights.
    pub robust_weights: Option<Vec<Vec<Vec<f64>>>>,
}

/// Objective of a joint fit: weighted residuals of a problem on sampled runs.
#[derive(Clone)]
pub struct Objective<'a> {
    /// Optimization problem.
    pub problem: &'a Problem,
    source: &'a Recordings,
    stop: &'a Stop,
    /// Weights of outputs and samples.
    pub weights: Weights,
    /// Sampling of the runs.
    pub sampling: Sampling,
    /// True if an optimization must not move from a stable model to an unstable one.
    pub requires_stability: bool,
    /// Relative decrease of the cost, predicted for a full step, below which an optimization has converged.
    tolerance: f64,
    /// Weight of each sample by run and output: 1 if present, 0 if missing. Empty without missing samples.
    sample_mask: Arc<Vec<Vec<Vec<f64>>>>,
    experiments: Arc<Vec<Experiment>>,
}

impl<'a> Objective<'a> {
    /// Return the objective of a problem on the given runs; `requires_stability` sets
    /// [`Objective::requires_stability`].
    ///
    /// # Errors
    /// An error if the runs cannot be sampled ([`Recordings::experiments`]). [`Error::Length`] for a wrong number of
    /// weights. [`Error::Interrupted`] after a stop request.
    pub fn new(
        (problem, source, stop): (&'a Problem, &'a Recordings, &'a Stop),
        weights: Weights,
        sampling: Sampling,
        requires_stability: bool,
    ) -> Result<Self> {
        check_length("weights", problem.outputs.len(), weights.outputs.len())?;
        sampling.check()?;
        let experiments = source.experiments(sampling)?;
        stop.check()?;
        let sample_mask = Arc::new(experiments.iter().map(|e| e.sample_weights.clone()).collect());
        let no_weights = Weights { outputs: Vec::new(), robust_weights: None };
        let objective = Self {
            problem,
            source,
            stop,
            weights: no_weights,
            sampling,
            requires_stability,
            tolerance: RELATIVE_COST_TOLERANCE,
            sample_mask,
            experiments: Arc::new(experiments),
        };
        objective.with_weights(weights)
    }

    /// Return the objective with other weights.
    ///
    /// # Errors
    /// [`Error::Length`] for a wrong number of robust weights.
    pub fn with_weights(&self, weights: Weights) -> Result<Self> {
        if let Some(robust_weights) = &weights.robust_weights {
            check_length("runs with robust weights", self.experiments.len(), robust_weights.len())?;
        }
        let weighted_experiment = |(k, experiment): (usize, &Experiment)| {
            let run_weights = weights.robust_weights.as_ref().map(|runs| runs[k].as_slice());
            let mut experiment = experiment.clone();
            experiment.sample_weights.clone_from(&self.sample_mask[k]);
            experiment.with_weights(&weights.outputs, run_weights)
        };
        let experiments: Vec<Experiment> =
            self.experiments.iter().enumerate().map(weighted_experiment).collect::<Result<_>>()?;
        Ok(Self { weights, experiments: Arc::new(experiments), ..self.clone() })
    }

    /// Return the objective with `shifts` added to the compared samples.
    ///
    /// `shifts` has one value per run, output and compared sample, in the unit of the output. Values that are not
    /// finite are ignored.
    #[must_use]
    pub fn with_residual_shifts(&self, shifts: &[Vec<Vec<f64>>]) -> Self {
        let mut experiments = Vec::clone(&self.experiments);
        for (experiment, shifts) in experiments.iter_mut().zip(shifts) {
            experiment.shift_samples(shifts);
        }
        Self { experiments: Arc::new(experiments), ..self.clone() }
    }

    /// Return the objective on a pulse grid with half the step.
    ///
    /// # Errors
    /// An error if the runs cannot be sampled at half the step ([`Recordings::experiments`]). [`Error::Interrupted`]
    /// after a stop request.
    pub fn finer(&self) -> Result<Self> {
        let sampling = Sampling { pulses_per_sample: 2 * self.sampling.pulses_per_sample, ..self.sampling };
        let fit_inputs = (self.problem, self.source, self.stop);
        let finer = Self::new(fit_inputs, self.weights.clone(), sampling, self.requires_stability)?;
        Ok(Self { tolerance: self.tolerance, ..finer })
    }

    /// Return the objective whose optimizations terminate as soon as the likelihood hardly increases.
    ///
    /// It serves to compare fits. If the data determine a parameter poorly, the cost has a flat valley. Early
    /// termination saves most evaluations along this valley.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn for_comparison(self) -> Self {
        let residuals: usize = self.experiments.iter().map(Experiment::compared_count).sum();
        let tolerance = COMPARISON_LIKELIHOOD_TOLERANCE / (residuals * self.problem.outputs.len()).max(1) as f64;
        Self { tolerance: tolerance.max(RELATIVE_COST_TOLERANCE), ..self }
    }

    /// Return the objective of another problem with the same outputs.
    #[must_use]
    pub fn with_problem(&self, problem: &'a Problem) -> Self {
        Self { problem, ..self.clone() }
    }

    /// Return the objective whose optimizations do not move from a stable model to an unstable one.
    #[must_use]
    pub fn with_stability_constraint(&self) -> Self {
        Self { requires_stability: true, ..self.clone() }
    }

    /// The sampled runs.
    #[must_use]
    pub fn experiments(&self) -> &[Experiment] {
        &self.experiments
    }

    /// Recordings from which the runs were sampled.
    #[must_use]
    pub fn source(&self) -> &'a Recordings {
        self.source
    }

    /// Cancellation flag.
    #[must_use]
    pub fn stop(&self) -> &'a Stop {
        self.stop
    }

    /// Time scaling of the problem on these runs.
    #[must_use]
    pub fn time_scaling(&self) -> super::parameter_set::TimeScaling {
        super::parameter_set::TimeScaling::from_runs(self.problem, &self.source.intervals_and_durations())
    }

    /// Minimize the cost by the Levenberg–Marquardt method from an initial guess.
    ///
    /// # Errors
    /// The error of the simulation of `start` if it fails. [`Error::Interrupted`] after a stop request.
    pub fn minimize(&self, start: &Iterate, evaluations: usize) -> Result<OptimizationResult> {
        let settings = MinimizationSettings { evaluations, tolerance: self.tolerance };
        self.problem.minimize(&self.experiments, start, settings, self.requires_stability, self.stop)
    }

    /// Minimize the cost in the coordinates of another problem (see `ParameterSet::problem_at`).
    ///
    /// # Errors
    /// The error of the simulation of `start` if it fails. [`Error::Interrupted`] after a stop request.
    pub fn minimize_in(&self, problem: &Problem, start: &Iterate, evaluations: usize) -> Result<OptimizationResult> {
        let settings = MinimizationSettings { evaluations, tolerance: self.tolerance };
        problem.minimize(&self.experiments, start, settings, self.requires_stability, self.stop)
    }

    /// Return true if the simulation at an iterate does not depend on the step.
    ///
    /// This requires a linear problem with exact samples: integer orders, or any orders on long records. The samples
    /// must not be decimated. Each delay must be a whole number of sampling intervals, so that no input switches within
    /// a pulse.
    #[must_use]
    pub fn is_exact(&self, iterate: &Iterate) -> bool {
        let is_whole = |delay: f64, step: f64| (delay / step - (delay / step).round()).abs() < WHOLE_DELAY_TOLERANCE;
        let runs = self.source.runs().zip(self.source.intervals_and_durations());
        self.sampling.decimation == 1
            && self.problem.is_linear()
            && runs
                .flat_map(|(run, (step, _))| run.channels().iter().map(move |c| (c.delay, step)))
                .all(|(delay, step)| delay.is_none_or(|delay| is_whole(delay, step)))
            && (IntegerOrders::new(&self.problem.model, &self.experiments, &iterate.point).is_some()
                || FractionalOrders::accepts(&self.problem.model, &self.experiments, &iterate.point))
    }

    /// Return true if halving the step changes the simulated samples significantly relative to the residuals.
    ///
    /// The change is compared with the root mean square residual, or with the noise if the noise is larger. With an
    /// incomplete structure, the residuals also contain the model error.
    ///
    /// # Errors
    /// An error if the runs cannot be sampled at half the step ([`Recordings::experiments`]). [`Error::Interrupted`]
    /// after a stop request.
    pub fn is_discretization_significant(&self, iterate: &Iterate) -> Result<bool> {
        self.is_refinement_significant(iterate, &self.finer()?)
    }

    /// Return true if the simulated samples change significantly, relative to the residuals, on the pulse grid of
    /// `finer`.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn is_refinement_significant(&self, iterate: &Iterate, finer: &Self) -> Result<bool> {
        let (Some(evaluation), Some(finer_evaluation)) = (self.evaluate(iterate)?, finer.evaluate(iterate)?) else {
            // The simulation is not finite on at least one of the grids, so the difference counts as significant.
            return Ok(true);
        };
        let changes: Vec<f64> =
            finer_evaluation.residuals.iter().zip(&evaluation.residuals).map(|(a, b)| (a - b).powi(2)).collect();
        let mean_square = mean(&finer_evaluation.residuals.iter().map(|e| e * e).collect::<Vec<_>>()).max(1.0);
        // Overflow of the squares means that the simulation diverges on one of the grids.
        Ok(!mean_square.is_finite()
            || mean(&changes) > MAX_DISCRETIZATION_NOISE_RATIO * MAX_DISCRETIZATION_NOISE_RATIO * mean_square)
    }

    /// Return the indices of results of a fit at twice this step, sorted by the larger of their costs at that step and
    /// at this one.
    ///
    /// The pulse scheme of a stiff equation can have a mode that alternates from pulse to pulse. A fit can use this
    /// mode to follow noise, but the simulation of such a fit differs at every other step.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn rank_results(&self, results: &[&OptimizationResult]) -> Result<Vec<usize>> {
        let larger_cost = |result: &&OptimizationResult| {
            let evaluation = self.evaluate(&result.iterate)?;
            Ok(evaluation
                .map_or(f64::INFINITY, |evaluation| result.cost_per_residual().max(evaluation.cost_per_residual())))
        };
        let costs: Vec<f64> = results.iter().map(larger_cost).collect::<Result<_>>()?;
        let has_finite_cost = costs.iter().any(|cost| cost.is_finite());
        let key = |i: usize| (if has_finite_cost { costs[i] } else { 0.0 }, results[i].cost_per_residual());
        let mut order: Vec<usize> = (0..results.len()).collect();
        order.sort_by(|&i, &j| {
            let ((a, b), (c, d)) = (key(i), key(j));
            a.total_cmp(&c).then(b.total_cmp(&d))
        });
        Ok(order)
    }

    /// Return the residuals and the cost of an iterate without derivatives; None if its simulation is not finite.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn evaluate(&self, iterate: &Iterate) -> Result<Option<OptimizationResult>> {
        match self.minimize(iterate, 0) {
            Ok(evaluation) => Ok(Some(evaluation)),
            Err(Error::Interrupted) => Err(Error::Interrupted),
            Err(_) => Ok(None),
        }
    }

    /// Iterate over runs and outputs: run, index of the output, and weights of its compared samples.
    ///
    /// The weights are None if all are 1.
    fn sample_weights(&self) -> impl Iterator<Item = (&Experiment, usize, Option<&[f64]>)> {
        let outputs = self.problem.outputs.len();
        self.experiments
            .iter()
            .flat_map(move |e| (0..outputs).map(move |i| (e, i, e.sample_weights.get(i).map(Vec::as_slice))))
    }

    /// Return the residuals in standard deviations of the noise, by run and output.
    ///
    /// Robust weights are not applied. The residual of a missing sample is NaN.
    #[must_use]
    pub fn residuals(&self, result: &OptimizationResult) -> Vec<Vec<Vec<f64>>> {
        let outputs = self.problem.outputs.len();
        let (mut residuals_by_run, mut remaining_residuals) = (Vec::new(), result.residuals.as_slice());
        for (experiment, i, sample_weights) in self.sample_weights() {
            let (series, remaining) =
                remaining_residuals.split_at(experiment.compared_count().min(remaining_residuals.len()));
            remaining_residuals = remaining;
            if i == 0 {
                residuals_by_run.push(Vec::with_capacity(outputs));
            }
            let unweighted = match sample_weights {
                None => series.to_vec(),
                Some(sample_weights) => series
                    .iter()
                    .zip(sample_weights)
                    .map(|(e, &weight)| e / if weight > 0.0 { weight } else { f64::NAN })
                    .collect(),
            };
            if let Some(run) = residuals_by_run.last_mut() {
                run.push(unweighted);
            }
        }
        residuals_by_run
    }

    /// Return the robust weight of every residual, in the sequence of the residual vector.
    #[must_use]
    pub fn flat_sample_weights(&self) -> Vec<f64> {
        let weights_or_ones = |(experiment, _, sample_weights): (&Experiment, usize, Option<&[f64]>)| {
            sample_weights.map_or_else(|| vec![1.0; experiment.compared_count()], <[f64]>::to_vec)
        };
        self.sample_weights().flat_map(weights_or_ones).collect()
    }

    /// Return the residuals of each output in standard deviations of the noise, with all runs concatenated.
    ///
    /// Missing samples are omitted, and robust weights are not applied.
    #[must_use]
    pub fn residuals_by_output(&self, result: &OptimizationResult) -> Vec<Vec<f64>> {
        let residuals_by_run = self.residuals(result);
        let output_residuals =
            |i: usize| residuals_by_run.iter().flat_map(|run| &run[i]).copied().filter(|e| !e.is_nan()).collect();
        (0..self.problem.outputs.len()).map(output_residuals).collect()
    }

    /// Root mean square of the residuals of each output in noise standard deviations; infinite on overflow.
    #[must_use]
    pub fn residual_root_mean_squares(&self, result: &OptimizationResult) -> Vec<f64> {
        self.residuals_by_output(result).iter().map(|e| root_mean_square(e)).collect()
    }

    /// Robust standard deviation of the residuals of each output, in noise standard deviations.
    ///
    /// If more than half of the residuals are zero, it is the root mean square of all residuals.
    #[must_use]
    pub fn residual_scales(&self, result: &OptimizationResult) -> Vec<f64> {
        let scale = |e: &Vec<f64>| match robust_deviation(e) {
            0.0 => root_mean_square(e),
            deviation => deviation,
        };
        self.residuals_by_output(result).iter().map(scale).collect()
    }
}

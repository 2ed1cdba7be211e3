//! Joint fit of a structure to runs: initial guesses, multistart, reweighting, step refinement and covariance.

use std::collections::BTreeMap;

use super::initial_guesses::OrderGrids;
use super::multistart::{
    leading_part, run_friction_multistart, run_multistart, run_nonlinear_multistart, select_survivors,
    split_unfinished, InitialGuessSource, MultistartContext, FIRST_BUDGET_EVALUATIONS, SELECTION_INTERVALS,
};
use super::objective::{Objective, Weights, MAX_PULSES_PER_SAMPLE};
use super::parameter_set::ParameterSet;
use super::problem::{Candidate, Iterate, OptimizationResult};
use super::progress::{FitProgress, ProgressListener};
use super::reweighting::{fit_reweighted, Loss, EVALUATIONS_PER_REWEIGHTING};
use super::stability_preference::{prefer_stable, StabilityComparison};
use super::step_refinement::{correct_step, refine_step, Optimum, OptimumStatistics};
use super::structure::{ParametricEquation, ParametricStructure};
use crate::equation::Initial;
use crate::error::{Error, Result};
use crate::parallel::Stop;
use crate::recording::{Recording, Recordings, Sampling};
use crate::regressors::BANK_LIMIT;
use crate::signal::statistics::{mean, median, white_noise_deviation};

/// Fraction of the progress of a fit that is complete after its multistart.
const MULTISTART_PROGRESS_FRACTION: f64 = 0.5;
/// Fraction of the remaining multistart progress that each sweep over the candidates completes.
const SWEEP_PROGRESS_FRACTION: f64 = 0.3;
/// Noise standard deviation assumed in a coarse fit, relative to the standard deviation of the output.
const COARSE_RESIDUAL_RATIO: f64 = 0.01;
/// Minimum of the estimated noise standard deviation, relative to the standard deviation of the output.
const MIN_NOISE_RATIO: f64 = 1e-3;
/// Minimum noise standard deviation in a warm start, which avoids a division by zero.
const MIN_NOISE_DEVIATION: f64 = 1e-300;
/// Maximum number of evaluations of each survivor of the multistart in the fit on all samples, or on the first part of
/// a long record.
const MAX_FINAL_EVALUATIONS: usize = 60;
/// Maximum ratio of the cost per residual on all samples to that on the first part of the runs.
///
/// If it is exceeded, the other survivors are also evaluated on all samples.
const MAX_COST_RATIO: f64 = 2.0;

/// Standard deviation of an output, and an estimate of its noise standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutputScale {
    /// Standard deviation of the output: root of the mean variance over all runs.
    pub deviation: f64,
    /// The estimated standard deviation of the white noise of the output.
    pub noise: f64,
}

impl OutputScale {
    /// Return the scale of an output from its samples, one list per run; NaN marks missing samples.
    #[must_use]
    pub fn from_runs(runs: &[Vec<f64>]) -> Self {
        let variance = |samples: &Vec<f64>| {
            let finite: Vec<f64> = samples.iter().copied().filter(|v| !v.is_nan()).collect();
            let center = mean(&finite);
            mean(&finite.iter().map(|v| (v - center) * (v - center)).collect::<Vec<_>>())
        };
        let scale = mean(&runs.iter().map(variance).collect::<Vec<_>>()).sqrt();
        Self::from_deviation(scale, runs)
    }

    /// Return the scale of each output of the runs.
    ///
    /// # Errors
    /// [`Error::Structure`] for an output that does not exist.
    pub fn from_recordings(source: &Recordings) -> Result<Vec<Self>> {
        let compared: Vec<Vec<Vec<f64>>> = source.runs().map(Recording::recorded_rows).collect();
        let outputs = source.runs().next().map_or(&[][..], Recording::outputs);
        let scale = |(k, &output): (usize, &usize)| {
            let uniform: Vec<Vec<f64>> = source.samples(output)?.into_iter().map(<[f64]>::to_vec).collect();
            let compared: Vec<Vec<f64>> = compared.iter().map(|rows| rows[k].clone()).collect();
            Ok(Self::from_deviation(Self::from_runs(&uniform).deviation, &compared))
        };
        outputs.iter().enumerate().map(scale).collect()
    }

    /// Return the scale of an output with the given standard deviation from its samples, one list per run.
    ///
    /// The noise level is estimated from second differences of the samples, and is at least 10⁻³ of `deviation`.
    #[must_use]
    pub fn from_deviation(deviation: f64, runs: &[Vec<f64>]) -> Self {
        let noise = median(runs.iter().map(|samples| white_noise_deviation(samples)).collect());
        Self { deviation, noise: noise.max(MIN_NOISE_RATIO * deviation) }
    }
}

/// Initial guesses of a fit: multistart, one initial guess, or warm start.
#[derive(Debug, Clone)]
pub enum Initialization {
    /// Multistart from the given initial guesses and from automatic ones. The candidates of an earlier multistart can
    /// replace the automatic ones.
    Multistart {
        /// The given initial guesses, each with the values of all free parameters.
        given_guesses: Vec<Vec<f64>>,
        /// Candidates of an earlier multistart. None runs a new multistart.
        candidates: Option<Vec<Candidate>>,
    },
    /// A single initial guess: values of all free parameters.
    InitialGuess(Vec<f64>),
    /// Warm start from a fit of the same structure to similar runs, with the simulation step and the weights of that
    /// fit.
    WarmStart {
        /// Values of all free parameters.
        values: Vec<f64>,
        /// Noise standard deviation of each output.
        noise: Vec<f64>,
        /// Block pulses per sampling interval.
        pulses_per_sample: usize,
        /// Candidates of the multistart of that fit; empty if there was none.
        candidates: Vec<Candidate>,
    },
}

/// Settings of a fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// Loss function of the residuals. The multistart compares sums of squares.
    pub loss: Loss,
    /// True to refine the step of the simulation below the sampling interval.
    ///
    /// If false, the fit is meant for comparison with other fits. Its optimization terminates as soon as the likelihood
    /// hardly increases.
    pub refine: bool,
    /// Number of threads of the multistart. Results do not depend on it.
    pub threads: usize,
}

/// Optimum of the joint output error of all runs.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct JointFit {
    /// Optimum and its statistics.
    pub optimum: OptimumStatistics,
    /// Candidates of the multistart, best first.
    pub candidates: Vec<Candidate>,
    /// Comparison of the best optimum with a stable one; None if the best optimum is stable.
    pub stability: Option<StabilityComparison>,
}

/// Fit problem: free parameters, runs, source of initial guesses and output scales.
#[derive(Clone, Copy)]
pub struct FitProblem<'a> {
    /// Set of free parameters.
    pub parameter_set: &'a ParameterSet,
    /// Runs that are fitted together.
    pub source: &'a Recordings,
    /// Source of initial guesses.
    pub guess_source: &'a dyn InitialGuessSource,
    /// Scales of the outputs, one per output.
    pub scales: &'a [OutputScale],
    /// Cancellation flag.
    pub stop: &'a Stop,
}

impl<'a> FitProblem<'a> {
    /// Return the objective with weights `outputs`.
    ///
    /// Unless `refine` is true, the objective has the looser convergence tolerance of fits that are only compared with
    /// other fits.
    fn objective(&self, outputs: Vec<f64>, sampling: Sampling, refine: bool) -> Result<Objective<'a>> {
        let weights = Weights { outputs, robust_weights: None };
        let source: &'a Recordings = self.source;
        let objective = Objective::new((&self.parameter_set.problem, source, self.stop), weights, sampling, false)?;
        Ok(if refine { objective } else { objective.for_comparison() })
    }

    /// Return equal weights of all outputs relative to their standard deviations.
    ///
    /// The optimum depends on the noise levels, but a search far from the optimum does not need them.
    fn equal_weights(&self) -> Vec<f64> {
        self.scales.iter().map(|scale| 1.0 / (COARSE_RESIDUAL_RATIO * scale.deviation)).collect()
    }

    /// Mean square of the weighted residuals if they are white noise alone, with equal weights of the outputs.
    fn noise_floor(&self) -> f64 {
        let noise_ratio = |scale: &OutputScale| (scale.noise / (COARSE_RESIDUAL_RATIO * scale.deviation)).powi(2);
        mean(&self.scales.iter().map(noise_ratio).collect::<Vec<_>>())
    }

    /// Run the multistart and return its candidates, best first.
    ///
    /// # Errors
    /// An error if the runs cannot be sampled or the initial guesses cannot be computed. The error of the progress
    /// listener if it returns one. [`Error::Interrupted`] after a stop request.
    pub fn run_multistart(&self, threads: usize, progress: &mut FitProgress<'_>) -> Result<Vec<Candidate>> {
        let noise_floor = self.noise_floor();
        let weights = self.equal_weights();
        let shared_progress = std::cell::RefCell::new(progress);
        let listener = |count, total| {
            shared_progress.borrow_mut().advance_within(
                MULTISTART_PROGRESS_FRACTION,
                SWEEP_PROGRESS_FRACTION,
                count,
                total,
            )
        };
        let Self { source, guess_source, stop, .. } = *self;
        let context = MultistartContext {
            source,
            guess_source,
            stop,
            weights: &weights,
            noise_floor,
            threads,
            listener: Some(&listener),
        };
        let multistart = match &self.parameter_set.problem {
            problem if !problem.derived.is_empty() => run_nonlinear_multistart,
            problem if !problem.frictions.is_empty() => run_friction_multistart,
            _ => run_multistart,
        };
        multistart(self.parameter_set, context)
    }

    fn start(&self, values: &[f64], origin: &str) -> Result<Candidate> {
        let iterate = Iterate { point: self.parameter_set.problem.point(values)?, states: Vec::new() };
        Ok(Candidate::at(iterate, origin))
    }
}

/// The estimated orders and coefficients of equations by name, and the fit that yields them.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct EquationFit {
    /// Estimates by parameter name.
    pub values: BTreeMap<String, f64>,
    /// Fit. Its parameters are in the sequence of [`ParameterSet::names`].
    pub fit: JointFit,
}

/// Fit equations by output error to runs with zero initial conditions.
///
/// The fit uses a squared loss, automatic initial guesses, a refined step and one thread.
///
/// # Errors
/// [`Error::Diverged`] if no initial guess has a finite simulation. [`Error::Structure`] if the equations or runs are
/// invalid. [`Error::Overflow`] if squares of residuals overflow.
pub fn fit_equations(runs: Vec<Recording>, equations: Vec<ParametricEquation>) -> Result<EquationFit> {
    let runs = Recordings::new(runs)?;
    let signals =
        runs.runs().next().into_iter().flat_map(Recording::channels).map(|channel| channel.name.clone()).collect();
    let scales = equations
        .iter()
        .map(|equation| {
            let samples: Vec<Vec<f64>> = runs.samples(equation.output)?.into_iter().map(<[f64]>::to_vec).collect();
            Ok(OutputScale::from_runs(&samples))
        })
        .collect::<Result<Vec<_>>>()?;
    let parameter_set = ParameterSet::from_structure(ParametricStructure::new(signals, equations, Initial::Rest))?;
    let stop = Stop::default();
    let guess_source = OrderGrids::new(&runs, 1, BANK_LIMIT, &stop);
    let problem = FitProblem {
        parameter_set: &parameter_set,
        source: &runs,
        guess_source: &guess_source,
        scales: &scales,
        stop: &stop,
    };
    let settings = Settings { loss: Loss::Squares, refine: true, threads: 1 };
    let fit =
        fit(problem, Initialization::Multistart { given_guesses: Vec::new(), candidates: None }, settings, &|_, _| {
            Ok(())
        })?
        .ok_or_else(|| Error::Diverged { what: "simulation of every initial guess".into(), index: 0 })?;
    Ok(EquationFit { values: parameter_set.names().cloned().zip(fit.optimum.estimate.iter().copied()).collect(), fit })
}

/// Fit a structure to runs by output error. Return None if no initial guess has a finite simulation.
///
/// # Errors
/// An error if the runs cannot be sampled or the initial guesses cannot be computed. The error of the progress listener
/// if it returns one. [`Error::Overflow`] if squares of residuals overflow. The error of the last survivor if no
/// survivor of the multistart can be simulated. [`Error::Interrupted`] after a stop request.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::equation::Initial;
/// use ftlm::estimation::joint_fit::structure::{Coefficient, ParametricEquation, Order, ParametricStructure, ParametricTerm};
/// use ftlm::estimation::joint_fit::parameter_set::ParameterSet;
/// use ftlm::estimation::joint_fit::initial_guesses::OrderGrids;
/// use ftlm::estimation::joint_fit::{fit, FitProblem, Initialization, Loss, OutputScale, Settings};
/// use ftlm::parallel::Stop;
/// use ftlm::recording::{Channel, Recording, Recordings, Role};
/// use ftlm::signal::block_pulse::Intersample;
/// // Data of D y = −2 y + 3 u in exact steps, fitted by D^alpha y = a y + b u.
/// let (step, mut y) = (0.05, vec![0.0]);
/// let u: Vec<f64> = (0..200).map(|k| if k % 40 < 20 { 1.0 } else { -1.0 }).collect();
/// let fall = f64::exp(-2.0 * step);
/// u.iter().for_each(|u| y.push(fall * y[y.len() - 1] + 1.5 * (1.0 - fall) * u));
/// y.pop();
/// let scales = [OutputScale::from_runs(&[y.clone()])];
/// let (y, u) = (Channel::new("y", y, Role::Output), Channel::new("u", u, Role::Input(Intersample::Hold)));
/// let runs = Recordings::new(vec![Recording::new("run", step, None, vec![y, u], vec![0])?])?;
/// let term = |signal, name: &str| {
///     let coefficient = Coefficient::Free(name.into());
///     ParametricTerm { signal, order: Order::number(0.0), coefficient, factor: 1.0 }
/// };
/// let terms = vec![term(0, "a"), term(1, "b")];
/// let equation = ParametricEquation { output: 0, order: Order::free("alpha"), terms, friction: None };
/// let signals = vec!["y".into(), "u".into()];
/// let parameter_set = ParameterSet::from_structure(ParametricStructure::new(signals, vec![equation], Initial::Rest))?;
/// let stop = Stop::default();
/// let guess_source = OrderGrids::new(&runs, 1, 1 << 28, &stop);
/// let (parameter_set, guess_source, scales) = (&parameter_set, &guess_source, &scales[..]);
/// let problem = FitProblem { parameter_set, source: &runs, guess_source, scales, stop: &stop };
/// let settings = Settings { loss: Loss::Squares, refine: true, threads: 1 };
/// let initialization = Initialization::Multistart { given_guesses: Vec::new(), candidates: None };
/// // None if no initial guess has a finite simulation.
/// let joint_fit = fit::fit(problem, initialization, settings, &|_, _| Ok(()))?;
/// let estimate = joint_fit.map_or_else(Vec::new, |fit| fit.optimum.estimate);
/// assert_eq!(estimate.len(), 3);
/// assert!(estimate.iter().zip([1.0, -2.0, 3.0]).all(|(value, truth)| (value - truth).abs() < 1e-2));
/// # Ok(())
/// # }
/// ```
pub fn fit(
    problem: FitProblem<'_>,
    initialization: Initialization,
    settings: Settings,
    listener: &ProgressListener<'_>,
) -> Result<Option<JointFit>> {
    let parameter_set = problem.parameter_set;
    let mut progress = FitProgress::new(listener);
    let (candidates, survivors) = match initialization {
        Initialization::WarmStart { values, noise, pulses_per_sample, candidates } => {
            let start = problem.start(&values, GIVEN_START_ORIGIN)?;
            let sampling = Sampling { pulses_per_sample, ..Sampling::default() };
            let weights = noise.iter().map(|noise| 1.0 / noise.max(MIN_NOISE_DEVIATION)).collect();
            let objective = problem.objective(weights, sampling, settings.refine)?;
            let (best_candidate, objective) = reweight_candidate(&start, objective, settings.loss)?;
            return finish_fit(parameter_set, best_candidate, objective, candidates, settings).map(Some);
        }
        Initialization::InitialGuess(values) => (Vec::new(), vec![problem.start(&values, GIVEN_START_ORIGIN)?]),
        Initialization::Multistart { given_guesses, candidates } => {
            let candidates = match candidates {
                Some(candidates) => candidates,
                None => problem.run_multistart(settings.threads, &mut progress)?,
            };
            let mut survivors = select_survivors(&candidates);
            for values in &given_guesses {
                survivors.push(problem.start(values, GIVEN_START_ORIGIN)?);
            }
            (candidates, survivors)
        }
    };
    let Some(first) = survivors.first() else { return Ok(None) };
    progress.advance_to(MULTISTART_PROGRESS_FRACTION)?;
    let weights = problem.scales.iter().map(|size| 1.0 / size.noise).collect();
    let mut objective = problem.objective(weights, Sampling::default(), settings.refine)?;
    // If a response is faster than the sampling interval, a grid of that step has a spurious optimum.
    while objective.sampling.pulses_per_sample < MAX_PULSES_PER_SAMPLE && !objective.is_exact(&first.result.iterate) {
        let finer = objective.finer()?;
        if !objective.is_refinement_significant(&first.result.iterate, &finer)? {
            break;
        }
        objective = finer;
    }
    let mut best_candidate = select_on_part(problem, &survivors, &objective, settings.refine)?;
    if problem.scales.len() > 1 {
        // With a single output, the optimum does not depend on the noise level.
        let iterate = &best_candidate.result.iterate;
        best_candidate = best_candidate.with_result(objective.minimize_in(
            &parameter_set.problem_at(iterate, false, &[]),
            iterate,
            EVALUATIONS_PER_REWEIGHTING,
        )?);
    }
    progress.advance_to(0.65)?;
    let (best_candidate, objective) = reweight_candidate(&best_candidate, objective, settings.loss)?;
    progress.advance_to(0.75)?;
    let final_fit = finish_fit(parameter_set, best_candidate, objective, candidates, settings)?;
    progress.advance_to(1.0)?;
    Ok(Some(final_fit))
}

/// Origin label of a given initial guess.
const GIVEN_START_ORIGIN: &str = "given start";

/// Finish a fit whose weights have converged.
///
/// A stable optimum may replace an unstable one. Then the step is refined, and the statistics are computed.
fn finish_fit(
    parameter_set: &ParameterSet,
    best_candidate: Candidate,
    objective: Objective<'_>,
    candidates: Vec<Candidate>,
    settings: Settings,
) -> Result<JointFit> {
    let (mut best_candidate, mut objective, stability) =
        prefer_stable(parameter_set, best_candidate, objective, &candidates)?;
    if stability.is_some_and(|stability| !stability.keeps_unstable) {
        (best_candidate, objective) = reweight_candidate(&best_candidate, objective, settings.loss)?;
    }
    let optimum = if !settings.refine || objective.is_exact(&best_candidate.result.iterate) {
        Optimum::without_refinement(best_candidate.result, objective)?
    } else if let Some(corrected) = correct_step(&best_candidate.result, &objective, settings.loss)? {
        corrected
    } else {
        let alternatives: Vec<Iterate> =
            select_survivors(&candidates).into_iter().map(|candidate| candidate.result.iterate).collect();
        refine_step(best_candidate.result, objective, settings.loss, &alternatives)?
    };
    Ok(JointFit { optimum: optimum.into_statistics(), candidates, stability })
}

/// Fit a candidate by iteratively reweighted least squares until the weights converge.
///
/// Return the fitted candidate and the objective with the final weights.
fn reweight_candidate<'a>(
    candidate: &Candidate,
    objective: Objective<'a>,
    loss: Loss,
) -> Result<(Candidate, Objective<'a>)> {
    let (result, objective) = fit_reweighted(&candidate.result.iterate, objective, loss)?;
    Ok((candidate.with_result(result), objective))
}

/// Return the best survivor of the multistart, fitted to all samples.
///
/// For long records, the survivor is selected on their first part and then fitted to all samples. If that fit fails,
/// the selection is repeated on all samples. It is also repeated if the cost per residual is much higher than on the
/// first part and another survivor has a lower cost on all samples.
fn select_on_part(
    problem: FitProblem<'_>,
    survivors: &[Candidate],
    objective: &Objective<'_>,
    refine: bool,
) -> Result<Candidate> {
    let full_objective = objective.with_weights(Weights { outputs: problem.equal_weights(), robust_weights: None })?;
    if let Some(intervals) = leading_part(problem.parameter_set, problem.source, SELECTION_INTERVALS)? {
        let sampling = Sampling { leading_intervals: Some(intervals), ..objective.sampling };
        let part_objective = problem.objective(problem.equal_weights(), sampling, refine)?;
        let selection = select_best_candidate(problem, survivors, &part_objective).and_then(|best_candidate| {
            let iterate = &best_candidate.result.iterate;
            let problem = problem.parameter_set.problem_at(iterate, true, &[]);
            let result = full_objective.minimize_in(&problem, iterate, MAX_FINAL_EVALUATIONS)?;
            Ok((best_candidate.cost_per_residual(), best_candidate.with_result(result)))
        });
        // On all samples, the simulation of the winner may overflow, or be much worse than that of another survivor.
        match selection {
            Err(Error::Interrupted) => return Err(Error::Interrupted),
            Ok((part_cost, best_candidate)) => {
                let has_increased = best_candidate.cost_per_residual() > MAX_COST_RATIO * part_cost;
                if !has_increased || !has_better_candidate(&best_candidate, survivors, &full_objective)? {
                    return Ok(best_candidate);
                }
            }
            Err(_) => {}
        }
    }
    select_best_candidate(problem, survivors, &full_objective)
}

/// Return true if a candidate, without further optimization, has a lower cost on `objective` than `best_candidate`.
fn has_better_candidate(
    best_candidate: &Candidate,
    candidates: &[Candidate],
    objective: &Objective<'_>,
) -> Result<bool> {
    for candidate in candidates {
        if objective
            .evaluate(&candidate.result.iterate)?
            .is_some_and(|evaluation| evaluation.cost < best_candidate.result.cost)
        {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Fit each survivor on `objective` and return the best one.
fn select_best_candidate(
    problem: FitProblem<'_>,
    survivors: &[Candidate],
    objective: &Objective<'_>,
) -> Result<Candidate> {
    let parameter_set = problem.parameter_set;
    let fit = |candidate: &Candidate, evaluations| {
        let iterate = &candidate.result.iterate;
        objective.minimize_in(&parameter_set.problem_at(iterate, false, &[]), iterate, evaluations)
    };
    let mut short_fits = Vec::new();
    let mut last_error = None;
    for candidate in survivors {
        match fit(candidate, FIRST_BUDGET_EVALUATIONS) {
            Ok(result) => short_fits.push(candidate.with_result(result.without_residuals())),
            Err(Error::Interrupted) => return Err(Error::Interrupted),
            // This survivor has no finite simulation on this grid. Other survivors may have one.
            Err(error) => last_error = Some(error),
        }
    }
    let (unfinished, mut finished) = split_unfinished(short_fits, problem.noise_floor());
    for candidate in unfinished {
        match fit(&candidate, MAX_FINAL_EVALUATIONS) {
            Ok(result) => finished.push(candidate.with_result(result.without_residuals())),
            Err(Error::Interrupted) => return Err(Error::Interrupted),
            Err(_) => finished.push(candidate),
        }
    }
    let results: Vec<&OptimizationResult> = finished.iter().map(|candidate| &candidate.result).collect();
    let first_index = match (results.len(), last_error) {
        (0, Some(error)) => return Err(error),
        (0 | 1, _) => 0,
        _ => objective.finer()?.rank_results(&results)?[0],
    };
    let best_candidate = &finished[first_index];
    // The previous fits use logarithmic coordinates. The best one is continued in plain coordinates.
    let iterate = &best_candidate.result.iterate;
    let plain_result =
        objective.minimize_in(&parameter_set.problem_at(iterate, true, &[]), iterate, MAX_FINAL_EVALUATIONS)?;
    Ok(if plain_result.cost <= best_candidate.result.cost {
        best_candidate.with_result(plain_result)
    } else {
        best_candidate.clone()
    })
}

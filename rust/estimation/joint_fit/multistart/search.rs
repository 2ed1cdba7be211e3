//! Multistart with successive halving: candidates, budgets, promotion and submodels.

use super::coarse_grid::{coarse_sampling, leading_part};
use super::halving::{
    competitive_candidates, is_same_iterate, is_same_optimum, merge_duplicates, select_survivors, sort_by_cost,
    split_by_prospect, split_unfinished, RungExecutor, FIRST_BUDGET_EVALUATIONS, MAX_FINAL_SURVIVORS,
    MAX_SURVIVOR_COST_RATIO, PRESCREEN_EVALUATIONS, SECOND_BUDGET_EVALUATIONS, SUBMODEL_SURVIVORS,
};
use super::nested_models::{
    fixed_order_problems, integer_order_problems, reduced_problems, FixedOrderProblem, ReducedProblem,
};
use crate::equation::Initial;
use crate::error::{Error, Kind, Result};
use crate::estimation::joint_fit::objective::{Objective, Weights, MAX_PULSES_PER_SAMPLE};
use crate::estimation::joint_fit::parameter_set::{ParameterSet, TimeScaling};
use crate::estimation::joint_fit::problem::Candidate;
use crate::estimation::joint_fit::progress::ProgressListener;
use crate::estimation::joint_fit::structure::ParametricStructure;
use crate::parallel::Stop;
use crate::recording::{Recordings, Sampling};

/// Ratio of the best cost per residual to the noise floor up to which a fit counts as having reached the noise.
///
/// If no candidate reaches the noise, further initial guesses are computed.
pub(super) const NOISE_FLOOR_FACTOR: f64 = 2.0;
/// Approximate number of sampling intervals, over all runs, to which initial guesses of problems of integer orders are
/// fitted.
const INITIAL_GUESS_INTERVALS: usize = 2000;
/// Number of leading intervals of a long record, over all runs, to which submodels and survivors are fitted.
pub const SELECTION_INTERVALS: usize = 6000;

/// Source of initial guesses.
pub trait InitialGuessSource {
    /// Return initial guesses of a parameter set on the runs.
    ///
    /// # Errors
    /// An error if the orders of the equations cannot be searched. [`Error::Interrupted`] after a stop request.
    fn initial_guesses(&self, free: &ParameterSet) -> Result<Vec<Candidate>>;

    /// Return a source of initial guesses for other recordings.
    fn for_recordings<'b>(&'b self, source: &'b Recordings) -> Box<dyn InitialGuessSource + 'b>;

    /// Return the optima of a problem of integer orders on the samples of `_grid`; None for other problems.
    ///
    /// # Errors
    /// An error if the equations cannot be searched. [`Error::Interrupted`] after a stop request.
    fn integer_order_optima(&self, _free: &ParameterSet, _grid: &Objective<'_>) -> Result<Option<Vec<Candidate>>> {
        Ok(None)
    }
}

/// Common data of the multistarts of a problem and of its submodels.
#[derive(Clone, Copy)]
pub struct MultistartContext<'a> {
    /// Runs that are fitted.
    pub source: &'a Recordings,
    /// Source of initial guesses.
    pub starts: &'a dyn InitialGuessSource,
    /// Cancellation flag.
    pub stop: &'a Stop,
    /// Weights of the outputs, which are equal relative to the standard deviations of the outputs.
    pub weights: &'a [f64],
    /// Cost per residual of noise alone.
    pub floor: f64,
    /// Number of threads. Results do not depend on it.
    pub threads: usize,
    /// Progress callback with the numbers of finished and of all starts; None in a nested multistart.
    pub listener: Option<&'a ProgressListener<'a>>,
}

impl<'a> MultistartContext<'a> {
    /// Context of a nested multistart, which does not report progress.
    fn for_submodel(self) -> Self {
        Self { listener: None, ..self }
    }

    fn time_scaling(self, free: &ParameterSet) -> TimeScaling {
        TimeScaling::from_runs(&free.problem, &self.source.intervals_and_durations())
    }
}

/// Run the multistart on subsampled records and return the candidates, best first.
///
/// # Errors
/// An error if the runs cannot be sampled or the initial guesses cannot be computed. The error of the progress listener
/// if it returns one. [`Error::Interrupted`] after a stop request.
pub fn run_multistart(free: &ParameterSet, context: MultistartContext<'_>) -> Result<Vec<Candidate>> {
    if let Some(candidates) = integer_order_multistart(free, context, None)? {
        return Ok(candidates);
    }
    if free.structure.history {
        return multistart_with_history(free, context);
    }
    Ok(multistart_without_history(free, context)?.0)
}

/// Return the optima of a problem of integer orders, best first; None for other problems.
///
/// The fit uses the first `leading_intervals` intervals of each run, or all samples if it is None.
fn integer_order_multistart(
    free: &ParameterSet,
    context: MultistartContext<'_>,
    leading_intervals: Option<usize>,
) -> Result<Option<Vec<Candidate>>> {
    if !free.orders.is_empty() || !free.problem.is_linear() {
        return Ok(None);
    }
    let objective = |sampling| {
        let weights = Weights { outputs: context.weights.to_vec(), robust_weights: None };
        Objective::new((&free.problem, context.source, context.stop), weights, sampling, false)
    };
    let grid = objective(Sampling { leading_intervals, ..Sampling::default() })?;
    let mut starts = Vec::new();
    for sampling in guess_samplings(free, context.source, leading_intervals)? {
        starts.extend(context.starts.integer_order_optima(free, &objective(sampling)?)?.unwrap_or_default());
    }
    let executor = RungExecutor { starts: starts.len(), threads: context.threads, listener: context.listener };
    let mut starts = merge_duplicates(&executor.run(free, &grid, &starts, PRESCREEN_EVALUATIONS)?, is_same_iterate);
    if starts.is_empty() {
        let Some(optima) = context.starts.integer_order_optima(free, &grid)? else { return Ok(None) };
        starts = optima;
    }
    let executor = RungExecutor { starts: starts.len(), ..executor };
    let candidates = executor.run(free, &grid, &starts, SECOND_BUDGET_EVALUATIONS)?;
    Ok((!candidates.is_empty()).then_some(candidates))
}

/// Return the samplings on which initial guesses of integer orders are found.
///
/// For a long record, there are two samplings: the first part of the record for fast poles and delays, and the whole
/// record, decimated, for slow poles. For a short record, the list is empty, because all samples are used.
fn guess_samplings(
    free: &ParameterSet,
    source: &Recordings,
    leading_intervals: Option<usize>,
) -> Result<Vec<Sampling>> {
    let Some(first) = leading_part(free, source, INITIAL_GUESS_INTERVALS)? else { return Ok(Vec::new()) };
    let intervals = source.runs().iter().map(|run| run.len().saturating_sub(1)).min().unwrap_or(0);
    let decimation = leading_intervals.unwrap_or(usize::MAX).min(intervals) / first;
    if decimation < 2 {
        return Ok(Vec::new());
    }
    let leading = Sampling { leading_intervals: Some(first), ..Sampling::default() };
    Ok(vec![leading, Sampling { leading_intervals, decimation, ..Sampling::default() }])
}

/// Convert the error of an invalid model ([`Kind::Model`]) to None.
pub(super) fn none_if_invalid_model<T>(outcome: Result<T>) -> Result<Option<T>> {
    match outcome {
        Err(error) if error.kind() == Kind::Model => Ok(None),
        outcome => outcome.map(Some),
    }
}

/// State of a multistart.
struct MultistartState<'a> {
    free: &'a ParameterSet,
    context: MultistartContext<'a>,
    executor: RungExecutor<'a>,
    coarse: Objective<'a>,
    /// Objective on a pulse grid with half the step; None if it was not needed.
    half: Option<Objective<'a>>,
    starts: Vec<Candidate>,
    /// Candidates of the full problem after the first budget.
    first: Vec<Candidate>,
    /// Optima with integer orders, embedded in the full problem.
    integer_order_optima: Vec<Candidate>,
    candidates: Vec<Candidate>,
}

/// Run the multistart of a problem with few initial terms.
///
/// Return the candidates, best first, and the objective on which they were optimized.
fn multistart_without_history<'a>(
    free: &'a ParameterSet,
    context: MultistartContext<'a>,
) -> Result<(Vec<Candidate>, Objective<'a>)> {
    let mut starts = context.starts.initial_guesses(free)?;
    let weights = Weights { outputs: context.weights.to_vec(), robust_weights: None };
    let sampling = coarse_sampling(free, context.source)?;
    let coarse = Objective::new((&free.problem, context.source, context.stop), weights, sampling, false)?;
    let integer_order_optima = integer_order_optima(free, context, &coarse, &starts)?;
    starts.extend(integer_order_optima.iter().cloned());
    let executor = RungExecutor { starts: starts.len(), threads: context.threads, listener: context.listener };
    let (first, candidates, half) = (Vec::new(), Vec::new(), None);
    let mut run =
        MultistartState { free, context, executor, coarse, half, starts, first, integer_order_optima, candidates };
    run.optimize_starts()?;
    run.add_nested_models()?;
    let total = run.executor.starts;
    let candidates = run.promote_survivors()?;
    if let Some(report_progress) = context.listener {
        report_progress(total, total)?;
    }
    Ok(candidates)
}

/// Return the best candidate of each submodel of integer orders, embedded in the full problem.
///
/// The submodels are those of [`integer_order_problems`] near the orders of the first initial guess.
fn integer_order_optima(
    free: &ParameterSet,
    context: MultistartContext<'_>,
    coarse: &Objective<'_>,
    starts: &[Candidate],
) -> Result<Vec<Candidate>> {
    let usual = free.integer_orders();
    let orders = starts.first().map_or(&usual, |start| &start.result.iterate.point.orders);
    let mut candidates = Vec::new();
    for less in integer_order_problems(free, orders) {
        // With fixed orders, most initial guesses lead to the same optimum.
        let ended = optimize_submodel(&less.free, context, coarse, MAX_FINAL_SURVIVORS, f64::INFINITY)?;
        candidates.extend(ended.iter().take(1).map(|candidate| less.embed(candidate)));
    }
    Ok(candidates)
}

/// Optimize a submodel from its initial guesses and return its optima, best first.
///
/// The best `survivor_count` guesses continue after the prescreening. `level` is the cost per residual of the full
/// problem. The best optimum, and every optimum whose cost is near `level`, get the second budget. For integer orders,
/// the leading intervals of long records suffice. The result is empty if the submodel is invalid, such as with two
/// equal terms.
fn optimize_submodel(
    free: &ParameterSet,
    context: MultistartContext<'_>,
    coarse: &Objective<'_>,
    survivor_count: usize,
    level: f64,
) -> Result<Vec<Candidate>> {
    let part = leading_part(free, context.source, SELECTION_INTERVALS)?;
    if let Some(candidates) = integer_order_multistart(free, context.for_submodel(), part)? {
        return Ok(candidates);
    }
    let Some(starts) = none_if_invalid_model(context.starts.initial_guesses(free))? else { return Ok(Vec::new()) };
    let executor = RungExecutor { starts: starts.len(), threads: context.threads, listener: None };
    let mut candidates =
        merge_duplicates(&executor.run(free, coarse, &starts, PRESCREEN_EVALUATIONS)?, is_same_iterate);
    candidates.truncate(survivor_count);
    let ended = executor.run(free, coarse, &candidates, FIRST_BUDGET_EVALUATIONS)?;
    let mut survivors = select_survivors(&ended);
    let competitive = |candidate: &Candidate| candidate.cost_per_residual() <= MAX_SURVIVOR_COST_RATIO * level;
    survivors.truncate(survivors.iter().filter(|candidate| competitive(candidate)).count().max(1));
    executor.run(free, coarse, &survivors, SECOND_BUDGET_EVALUATIONS)
}

impl<'a> MultistartState<'a> {
    /// Optimize all initial guesses with a step that is short enough for the best candidate.
    ///
    /// With a long step, the simulation of a stiff equation may be unstable, and the cost has spurious optima. The step
    /// is halved until this no longer changes the simulation of the best candidate significantly. Optima of integer
    /// orders are initial guesses at each step.
    fn optimize_starts(&mut self) -> Result<()> {
        let mut starts = self.starts.clone();
        loop {
            let screened = self.executor.run(self.free, &self.coarse, &starts, PRESCREEN_EVALUATIONS)?;
            let mut screened = merge_duplicates(&screened, is_same_iterate);
            if self.coarse.sampling.pulses_per_sample > 1 {
                // Nearly all candidates were already optimized on the coarser grid.
                screened.truncate(competitive_candidates(&screened).len().max(SUBMODEL_SURVIVORS));
            }
            self.candidates = self.executor.run(self.free, &self.coarse, &screened, FIRST_BUDGET_EVALUATIONS)?;
            self.first.clone_from(&self.candidates);
            if self.coarse.sampling.pulses_per_sample >= MAX_PULSES_PER_SAMPLE {
                return Ok(());
            }
            let finer = self.coarse.finer()?;
            if let Some(best) = self.candidates.first() {
                if !self.coarse.is_refinement_significant(&best.result.iterate, &finer)? {
                    self.half = Some(finer);
                    return Ok(());
                }
                starts = merge_duplicates(&self.candidates, is_same_optimum);
                starts.extend(self.integer_order_optima.iter().cloned());
            }
            self.coarse = finer;
        }
    }

    /// Add the optima of submodels as candidates: with one term removed, with one fixed order, and without offsets.
    fn add_nested_models(&mut self) -> Result<()> {
        if self.candidates.is_empty() {
            return Ok(());
        }
        for less in reduced_problems(self.free) {
            self.add_reduced_model(&less)?;
        }
        let unit = self.context.time_scaling(self.free);
        for one in fixed_order_problems(self.free) {
            self.add_fixed_order_model(&one, &unit)?;
        }
        self.add_model_without_offset()
    }

    fn add(&mut self, candidates: Vec<Candidate>) {
        self.candidates.extend(candidates);
        self.candidates = sort_by_cost(std::mem::take(&mut self.candidates));
    }

    /// Evaluate candidates with the full problem on the subsampled records, and add them to the candidates of the
    /// multistart.
    fn evaluate_and_add(&mut self, candidates: &[Candidate]) -> Result<()> {
        let evaluated = self.executor.run(self.free, &self.coarse, candidates, 1)?;
        self.add(evaluated);
        Ok(())
    }

    fn add_reduced_model(&mut self, less: &ReducedProblem) -> Result<()> {
        if less.keeps_signals {
            // Input coefficients are eliminated at every iterate, also with one term less. Candidates therefore differ
            // in the autoregressive terms only, and those of the full problem suffice.
            let first = merge_duplicates(&self.first, is_same_optimum);
            let from = first.iter().take(MAX_FINAL_SURVIVORS).chain(&self.starts);
            let candidates: Vec<Candidate> = from.map(|candidate| less.restrict(candidate, self.free)).collect();
            let mut candidates = self.executor.run(&less.free, &self.coarse, &candidates, PRESCREEN_EVALUATIONS)?;
            candidates.truncate(MAX_FINAL_SURVIVORS);
            let ended = self.executor.run(&less.free, &self.coarse, &candidates, FIRST_BUDGET_EVALUATIONS)?;
            return self.evaluate_and_add(&ended.iter().take(1).map(|r| less.embed(r, self.free)).collect::<Vec<_>>());
        }
        let level = self.candidates.first().map_or(f64::INFINITY, Candidate::cost_per_residual);
        let ended = optimize_submodel(&less.free, self.context, &self.coarse, SUBMODEL_SURVIVORS, level)?;
        self.evaluate_and_add(&ended.iter().take(1).map(|r| less.embed(r, self.free)).collect::<Vec<_>>())
    }

    /// Add the optimum with one order fixed as a candidate, so that the full problem does not fit worse than this
    /// submodel.
    fn add_fixed_order_model(&mut self, one: &FixedOrderProblem, unit: &TimeScaling) -> Result<()> {
        let level = self.candidates.first().map_or(0.0, Candidate::cost_per_residual);
        if one.free.orders.len() == 1 && level > NOISE_FLOOR_FACTOR * self.context.floor {
            // Within its bounds, the submodel may have no order grid.
            if let Some((ended, _)) =
                none_if_invalid_model(multistart_without_history(&one.free, self.context.for_submodel()))?
            {
                let embedded = competitive_candidates(&ended).into_iter().take(MAX_FINAL_SURVIVORS);
                let embedded = embedded.map(|candidate| one.embed(&candidate, self.free));
                return self.evaluate_and_add(&embedded.collect::<Vec<_>>());
            }
        }
        // Start from the optima found so far and from those with integer orders.
        let (reached, first) =
            (merge_duplicates(&self.candidates, is_same_optimum), merge_duplicates(&self.first, is_same_optimum));
        let sources = reached
            .iter()
            .take(MAX_FINAL_SURVIVORS)
            .chain(first.iter().take(MAX_FINAL_SURVIVORS))
            .chain(&self.integer_order_optima);
        let candidates: Vec<Candidate> = sources.map(|candidate| one.restrict(candidate, unit)).collect();
        let mut candidates = merge_duplicates(
            &self.executor.run(&one.free, &self.coarse, &candidates, PRESCREEN_EVALUATIONS)?,
            is_same_iterate,
        );
        candidates.truncate(MAX_FINAL_SURVIVORS);
        let ended = self.executor.run(&one.free, &self.coarse, &candidates, FIRST_BUDGET_EVALUATIONS)?;
        self.evaluate_and_add(
            &ended.iter().take(1).map(|candidate| one.embed(candidate, self.free)).collect::<Vec<_>>(),
        )
    }

    /// Add the optima of the model without offsets.
    ///
    /// With a free offset per run, a fit may converge to an optimum that does not use the true input.
    fn add_model_without_offset(&mut self) -> Result<()> {
        let structure = &self.free.structure;
        let plain = structure.initial.without_offset();
        if structure.coupled || plain == structure.initial {
            return Ok(());
        }
        let plain = ParameterSet::from_structure(ParametricStructure { initial: plain, ..structure.clone() })?;
        let mut ended = run_multistart(&plain, self.context.for_submodel())?;
        ended.truncate(MAX_FINAL_SURVIVORS);
        self.add(ended);
        Ok(())
    }

    /// Continue the survivors, and rank them before the other candidates. Unfinished survivors get the second budget.
    ///
    /// Return the candidates and the objective on which they were optimized.
    fn promote_survivors(self) -> Result<(Vec<Candidate>, Objective<'a>)> {
        let reached = merge_duplicates(&self.candidates, is_same_optimum);
        let (survivors, rest) = reached.split_at(competitive_candidates(&reached).len());
        let budget = FIRST_BUDGET_EVALUATIONS + SECOND_BUDGET_EVALUATIONS;
        let (survivors, mut candidates) = split_by_prospect(survivors.to_vec(), budget);
        let short = self.executor.run(self.free, &self.coarse, &survivors, FIRST_BUDGET_EVALUATIONS)?;
        let (near, ended) = split_by_prospect(short, SECOND_BUDGET_EVALUATIONS);
        candidates.extend(ended);
        let (unfinished, ended) = split_unfinished(near, self.context.floor);
        candidates.extend(ended);
        candidates.extend(self.executor.run(self.free, &self.coarse, &unfinished, SECOND_BUDGET_EVALUATIONS)?);
        let mut candidates = rank_candidates(&self.coarse, self.half, sort_by_cost(candidates))?;
        candidates.extend_from_slice(rest);
        Ok((candidates, self.coarse))
    }
}

/// Sort candidates by the larger of their costs at the step of `coarse` and at half that step.
///
/// If they cannot be sampled at half the step, sort them by their cost on `coarse`.
fn rank_candidates(
    coarse: &Objective<'_>,
    half: Option<Objective<'_>>,
    candidates: Vec<Candidate>,
) -> Result<Vec<Candidate>> {
    if candidates.is_empty() {
        return Ok(candidates);
    }
    let half = match half.map_or_else(|| coarse.finer(), Ok) {
        Err(Error::Interrupted) => return Err(Error::Interrupted),
        Err(_) => return Ok(sort_by_cost(candidates)),
        Ok(half) => half,
    };
    let order = half.rank_results(&candidates.iter().map(|candidate| &candidate.result).collect::<Vec<_>>())?;
    let mut candidates: Vec<Option<Candidate>> = candidates.into_iter().map(Some).collect();
    Ok(order.into_iter().filter_map(|i| candidates[i].take()).collect())
}

/// Run the multistart of a problem with many initial terms per run, and return the candidates, best first.
///
/// The initial terms are added for the survivors only, because they shift most optima by less than the distance between
/// two optima. The survivors are ranked again after a budget with all initial terms.
fn multistart_with_history(free: &ParameterSet, context: MultistartContext<'_>) -> Result<Vec<Candidate>> {
    let few = free.with_initial_terms(free.structure.initial.with_base(Initial::Caputo), false)?;
    let (reached, coarse) = multistart_without_history(&few, context)?;
    let (reached, coarse) = (merge_duplicates(&reached, is_same_optimum), coarse.with_problem(&free.problem));
    let executor = RungExecutor { starts: reached.len(), threads: context.threads, listener: None };
    let ends = executor.run_each(free, &coarse, &reached, 0)?;
    let levels: Vec<f64> =
        ends.iter().map(|end| end.as_ref().map_or(f64::INFINITY, Candidate::cost_per_residual)).collect();
    let mut order: Vec<usize> = (0..reached.len()).collect();
    order.sort_by(|&i, &j| levels[i].total_cmp(&levels[j]));
    let limit = order.first().map_or(0.0, |&i| MAX_SURVIVOR_COST_RATIO * levels[i]);
    let selected: Vec<Candidate> =
        order.iter().take(SUBMODEL_SURVIVORS).filter(|&&i| levels[i] <= limit).map(|&i| reached[i].clone()).collect();
    let mut rest = order[selected.len()..].to_vec();
    rest.sort_unstable();
    let mut leaders =
        rank_candidates(&coarse, None, executor.run(free, &coarse, &selected, FIRST_BUDGET_EVALUATIONS)?)?;
    leaders.extend(rest.into_iter().map(|i| reached[i].clone()));
    Ok(merge_duplicates(&leaders, is_same_optimum))
}

/// Optimize candidates on subsampled records and return the best ones, best first.
///
/// The step is halved as long as no candidate has a finite simulation.
///
/// # Errors
/// An error if the runs cannot be sampled at a shorter step. [`crate::error::Error::Interrupted`] after a stop request.
pub(super) fn optimize_on_coarse_grids(
    free: &ParameterSet,
    coarse: &Objective<'_>,
    starts: &[Candidate],
    threads: usize,
) -> Result<Vec<Candidate>> {
    let executor = RungExecutor { starts: starts.len(), threads, listener: None };
    let mut coarse = coarse.clone();
    let mut ended = executor.run(free, &coarse, starts, FIRST_BUDGET_EVALUATIONS)?;
    while coarse.sampling.pulses_per_sample < MAX_PULSES_PER_SAMPLE && ended.is_empty() {
        coarse = coarse.finer()?;
        ended = executor.run(free, &coarse, starts, FIRST_BUDGET_EVALUATIONS)?;
    }
    ended.truncate(2 * MAX_FINAL_SURVIVORS);
    executor.run(free, &coarse, &ended, SECOND_BUDGET_EVALUATIONS)
}

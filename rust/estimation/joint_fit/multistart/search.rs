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
    fn initial_guesses(&self, parameter_set: &ParameterSet) -> Result<Vec<Candidate>>;

    /// Return a source of initial guesses for other recordings.
    fn for_recordings<'b>(&'b self, source: &'b Recordings) -> Box<dyn InitialGuessSource + 'b>;

    /// Return the optima of a problem of integer orders on the samples of `_objective`; None for other problems.
    ///
    /// # Errors
    /// An error if the equations cannot be searched. [`Error::Interrupted`] after a stop request.
    fn integer_order_optima(
        &self,
        _parameter_set: &ParameterSet,
        _objective: &Objective<'_>,
    ) -> Result<Option<Vec<Candidate>>> {
        Ok(None)
    }
}

/// Common data of the multistarts of a problem and of its submodels.
#[derive(Clone, Copy)]
pub struct MultistartContext<'a> {
    /// Runs that are fitted.
    pub source: &'a Recordings,
    /// Source of initial guesses.
    pub guess_source: &'a dyn InitialGuessSource,
    /// Cancellation flag.
    pub stop: &'a Stop,
    /// Weights of the outputs, which are equal relative to the standard deviations of the outputs.
    pub weights: &'a [f64],
    /// Cost per residual of noise alone.
    pub noise_floor: f64,
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

    fn time_scaling(self, parameter_set: &ParameterSet) -> TimeScaling {
        TimeScaling::from_runs(&parameter_set.problem, &self.source.intervals_and_durations())
    }
}

/// Run the multistart on subsampled records and return the candidates, best first.
///
/// # Errors
/// An error if the runs cannot be sampled or the initial guesses cannot be computed. The error of the progress listener
/// if it returns one. [`Error::Interrupted`] after a stop request.
pub fn run_multistart(parameter_set: &ParameterSet, context: MultistartContext<'_>) -> Result<Vec<Candidate>> {
    if let Some(candidates) = integer_order_multistart(parameter_set, context, None)? {
        return Ok(candidates);
    }
    if parameter_set.structure.history {
        return multistart_with_history(parameter_set, context);
    }
    Ok(multistart_without_history(parameter_set, context)?.0)
}

/// Return the optima of a problem of integer orders, best first; None for other problems.
///
/// The fit uses the first `leading_intervals` intervals of each run, or all samples if it is None.
fn integer_order_multistart(
    parameter_set: &ParameterSet,
    context: MultistartContext<'_>,
    leading_intervals: Option<usize>,
) -> Result<Option<Vec<Candidate>>> {
    if !parameter_set.orders.is_empty() || !parameter_set.problem.is_linear() {
        return Ok(None);
    }
    let objective_on = |sampling| {
        let weights = Weights { outputs: context.weights.to_vec(), robust_weights: None };
        Objective::new((&parameter_set.problem, context.source, context.stop), weights, sampling, false)
    };
    let objective = objective_on(Sampling { leading_intervals, ..Sampling::default() })?;
    let mut starts = Vec::new();
    for sampling in guess_samplings(parameter_set, context.source, leading_intervals)? {
        starts.extend(
            context.guess_source.integer_order_optima(parameter_set, &objective_on(sampling)?)?.unwrap_or_default(),
        );
    }
    let executor = RungExecutor { start_count: starts.len(), threads: context.threads, listener: context.listener };
    let mut starts =
        merge_duplicates(&executor.run(parameter_set, &objective, &starts, PRESCREEN_EVALUATIONS)?, is_same_iterate);
    if starts.is_empty() {
        let Some(optima) = context.guess_source.integer_order_optima(parameter_set, &objective)? else {
            return Ok(None);
        };
        starts = optima;
    }
    let executor = RungExecutor { start_count: starts.len(), ..executor };
    let candidates = executor.run(parameter_set, &objective, &starts, SECOND_BUDGET_EVALUATIONS)?;
    Ok((!candidates.is_empty()).then_some(candidates))
}

/// Return the samplings on which initial guesses of integer orders are found.
///
/// For a long record, there are two samplings: the first part of the record for fast poles and delays, and the whole
/// record, decimated, for slow poles. For a short record, the list is empty, because all samples are used.
fn guess_samplings(
    parameter_set: &ParameterSet,
    source: &Recordings,
    leading_intervals: Option<usize>,
) -> Result<Vec<Sampling>> {
    let Some(leading_intervals_of_guess) = leading_part(parameter_set, source, INITIAL_GUESS_INTERVALS)? else {
        return Ok(Vec::new());
    };
    let intervals = source.runs().map(|run| run.len().saturating_sub(1)).min().unwrap_or(0);
    let decimation = leading_intervals.unwrap_or(usize::MAX).min(intervals) / leading_intervals_of_guess;
    if decimation < 2 {
        return Ok(Vec::new());
    }
    let leading_sampling = Sampling { leading_intervals: Some(leading_intervals_of_guess), ..Sampling::default() };
    Ok(vec![leading_sampling, Sampling { leading_intervals, decimation, ..Sampling::default() }])
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
    parameter_set: &'a ParameterSet,
    context: MultistartContext<'a>,
    executor: RungExecutor<'a>,
    coarse_objective: Objective<'a>,
    /// Objective on a pulse grid with half the step; None if it was not needed.
    halved_objective: Option<Objective<'a>>,
    starts: Vec<Candidate>,
    /// Candidates of the full problem after the first budget.
    first_budget_candidates: Vec<Candidate>,
    /// Optima with integer orders, embedded in the full problem.
    integer_order_optima: Vec<Candidate>,
    candidates: Vec<Candidate>,
}

/// Run the multistart of a problem with few initial terms.
///
/// Return the candidates, best first, and the objective on which they were optimized.
fn multistart_without_history<'a>(
    parameter_set: &'a ParameterSet,
    context: MultistartContext<'a>,
) -> Result<(Vec<Candidate>, Objective<'a>)> {
    let mut starts = context.guess_source.initial_guesses(parameter_set)?;
    let weights = Weights { outputs: context.weights.to_vec(), robust_weights: None };
    let sampling = coarse_sampling(parameter_set, context.source)?;
    let coarse_objective =
        Objective::new((&parameter_set.problem, context.source, context.stop), weights, sampling, false)?;
    let integer_order_optima = integer_order_optima(parameter_set, context, &coarse_objective, &starts)?;
    starts.extend(integer_order_optima.iter().cloned());
    let executor = RungExecutor { start_count: starts.len(), threads: context.threads, listener: context.listener };
    let (first_budget_candidates, candidates, halved_objective) = (Vec::new(), Vec::new(), None);
    let mut state = MultistartState {
        parameter_set,
        context,
        executor,
        coarse_objective,
        halved_objective,
        starts,
        first_budget_candidates,
        integer_order_optima,
        candidates,
    };
    state.optimize_starts()?;
    state.add_nested_models()?;
    let total = state.executor.start_count;
    let candidates = state.promote_survivors()?;
    if let Some(report_progress) = context.listener {
        report_progress(total, total)?;
    }
    Ok(candidates)
}

/// Return the best candidate of each submodel of integer orders, embedded in the full problem.
///
/// The submodels are those of [`integer_order_problems`] near the orders of the first initial guess.
fn integer_order_optima(
    parameter_set: &ParameterSet,
    context: MultistartContext<'_>,
    coarse_objective: &Objective<'_>,
    starts: &[Candidate],
) -> Result<Vec<Candidate>> {
    let default_orders = parameter_set.integer_orders();
    let orders = starts.first().map_or(&default_orders, |start| &start.result.iterate.point.orders);
    let mut candidates = Vec::new();
    for submodel in integer_order_problems(parameter_set, orders) {
        // With fixed orders, most initial guesses lead to the same optimum.
        let results =
            optimize_submodel(&submodel.parameter_set, context, coarse_objective, MAX_FINAL_SURVIVORS, f64::INFINITY)?;
        candidates.extend(results.iter().take(1).map(|candidate| submodel.embed(candidate)));
    }
    Ok(candidates)
}

/// Optimize a submodel from its initial guesses and return its optima, best first.
///
/// The best `survivor_count` guesses continue after the prescreening. `cost_level` is the cost per residual of the full
/// problem. The best optimum, and every optimum whose cost is near `cost_level`, get the second budget. For integer
/// orders, the leading intervals of long records suffice. The result is empty if the submodel is invalid, such as with
/// two equal terms.
fn optimize_submodel(
    parameter_set: &ParameterSet,
    context: MultistartContext<'_>,
    coarse_objective: &Objective<'_>,
    survivor_count: usize,
    cost_level: f64,
) -> Result<Vec<Candidate>> {
    let part = leading_part(parameter_set, context.source, SELECTION_INTERVALS)?;
    if let Some(candidates) = integer_order_multistart(parameter_set, context.for_submodel(), part)? {
        return Ok(candidates);
    }
    let Some(starts) = none_if_invalid_model(context.guess_source.initial_guesses(parameter_set))? else {
        return Ok(Vec::new());
    };
    let executor = RungExecutor { start_count: starts.len(), threads: context.threads, listener: None };
    let mut candidates = merge_duplicates(
        &executor.run(parameter_set, coarse_objective, &starts, PRESCREEN_EVALUATIONS)?,
        is_same_iterate,
    );
    candidates.truncate(survivor_count);
    let results = executor.run(parameter_set, coarse_objective, &candidates, FIRST_BUDGET_EVALUATIONS)?;
    let mut survivors = select_survivors(&results);
    let is_competitive = |candidate: &Candidate| candidate.cost_per_residual() <= MAX_SURVIVOR_COST_RATIO * cost_level;
    survivors.truncate(survivors.iter().filter(|candidate| is_competitive(candidate)).count().max(1));
    executor.run(parameter_set, coarse_objective, &survivors, SECOND_BUDGET_EVALUATIONS)
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
            let prescreened =
                self.executor.run(self.parameter_set, &self.coarse_objective, &starts, PRESCREEN_EVALUATIONS)?;
            let mut prescreened = merge_duplicates(&prescreened, is_same_iterate);
            if self.coarse_objective.sampling.pulses_per_sample > 1 {
                // Nearly all candidates were already optimized on the coarser grid.
                prescreened.truncate(competitive_candidates(&prescreened).len().max(SUBMODEL_SURVIVORS));
            }
            self.candidates = self.executor.run(
                self.parameter_set,
                &self.coarse_objective,
                &prescreened,
                FIRST_BUDGET_EVALUATIONS,
            )?;
            self.first_budget_candidates.clone_from(&self.candidates);
            if self.coarse_objective.sampling.pulses_per_sample >= MAX_PULSES_PER_SAMPLE {
                return Ok(());
            }
            let finer = self.coarse_objective.finer()?;
            if let Some(best_candidate) = self.candidates.first() {
                if !self.coarse_objective.is_refinement_significant(&best_candidate.result.iterate, &finer)? {
                    self.halved_objective = Some(finer);
                    return Ok(());
                }
                starts = merge_duplicates(&self.candidates, is_same_optimum);
                starts.extend(self.integer_order_optima.iter().cloned());
            }
            self.coarse_objective = finer;
        }
    }

    /// Add the optima of submodels as candidates: with one term removed, with one fixed order, and without offsets.
    fn add_nested_models(&mut self) -> Result<()> {
        if self.candidates.is_empty() {
            return Ok(());
        }
        for submodel in reduced_problems(self.parameter_set) {
            self.add_reduced_model(&submodel)?;
        }
        let time_scaling = self.context.time_scaling(self.parameter_set);
        for submodel in fixed_order_problems(self.parameter_set) {
            self.add_fixed_order_model(&submodel, &time_scaling)?;
        }
        self.add_model_without_offset()
    }

    fn add(&mut self, candidates: Vec<Candidate>) {
        self.candidates.extend(candidates);
        self.candidates = sort_by_cost(std::mem::take(&mut self.candidates));
    }

    /// Evaluate candidates with the full problem on the subsampled records, and add them to the candidates of the
    /// multistart.
    fn evaluate_and_add(&mut self, candidates: impl IntoIterator<Item = Candidate>) -> Result<()> {
        let candidates: Vec<Candidate> = candidates.into_iter().collect();
        let results = self.executor.run(self.parameter_set, &self.coarse_objective, &candidates, 1)?;
        self.add(results);
        Ok(())
    }

    fn add_reduced_model(&mut self, submodel: &ReducedProblem) -> Result<()> {
        if submodel.keeps_signals {
            // Input coefficients are eliminated at every iterate, also with one term less. Candidates therefore differ
            // in the autoregressive terms only, and those of the full problem suffice.
            let first_budget_candidates = merge_duplicates(&self.first_budget_candidates, is_same_optimum);
            let candidates_with_start = first_budget_candidates.iter().take(MAX_FINAL_SURVIVORS).chain(&self.starts);
            let candidates: Vec<Candidate> =
                candidates_with_start.map(|candidate| submodel.restrict(candidate, self.parameter_set)).collect();
            let best = self.best_optimum(&submodel.parameter_set, &candidates)?;
            return self.evaluate_and_add(best.map(|best| submodel.embed(&best, self.parameter_set)));
        }
        let cost_level = self.candidates.first().map_or(f64::INFINITY, Candidate::cost_per_residual);
        let results = optimize_submodel(
            &submodel.parameter_set,
            self.context,
            &self.coarse_objective,
            SUBMODEL_SURVIVORS,
            cost_level,
        )?;
        self.evaluate_and_add(results.first().map(|best| submodel.embed(best, self.parameter_set)))
    }

    /// Add the optimum with one order fixed as a candidate, so that the full problem does not fit worse than this
    /// submodel.
    fn add_fixed_order_model(&mut self, submodel: &FixedOrderProblem, time_scaling: &TimeScaling) -> Result<()> {
        let cost_level = self.candidates.first().map_or(0.0, Candidate::cost_per_residual);
        if submodel.parameter_set.orders.len() == 1 && cost_level > NOISE_FLOOR_FACTOR * self.context.noise_floor {
            // Within its bounds, the submodel may have no order grid.
            if let Some((results, _)) =
                none_if_invalid_model(multistart_without_history(&submodel.parameter_set, self.context.for_submodel()))?
            {
                let full_set = self.parameter_set;
                let embedded_candidates = competitive_candidates(&results).into_iter().take(MAX_FINAL_SURVIVORS);
                return self
                    .evaluate_and_add(embedded_candidates.map(|candidate| submodel.embed(&candidate, full_set)));
            }
        }
        // Start from the optima found so far and from those with integer orders.
        let (distinct_candidates, first) = (
            merge_duplicates(&self.candidates, is_same_optimum),
            merge_duplicates(&self.first_budget_candidates, is_same_optimum),
        );
        let sources = distinct_candidates
            .iter()
            .take(MAX_FINAL_SURVIVORS)
            .chain(first.iter().take(MAX_FINAL_SURVIVORS))
            .chain(&self.integer_order_optima);
        let candidates: Vec<Candidate> = sources.map(|candidate| submodel.restrict(candidate, time_scaling)).collect();
        let best = self.best_optimum(&submodel.parameter_set, &candidates)?;
        self.evaluate_and_add(best.map(|best| submodel.embed(&best, self.parameter_set)))
    }

    /// Optimize a submodel from the given candidates with the first budget, and return its best optimum.
    fn best_optimum(&self, submodel: &ParameterSet, candidates: &[Candidate]) -> Result<Option<Candidate>> {
        let run = |candidates: &[Candidate], evaluations: usize| {
            self.executor.run(submodel, &self.coarse_objective, candidates, evaluations)
        };
        let mut survivors = merge_duplicates(&run(candidates, PRESCREEN_EVALUATIONS)?, is_same_iterate);
        survivors.truncate(MAX_FINAL_SURVIVORS);
        Ok(run(&survivors, FIRST_BUDGET_EVALUATIONS)?.into_iter().next())
    }

    /// Add the optima of the model without offsets.
    ///
    /// With a free offset per run, a fit may converge to an optimum that does not use the true input.
    fn add_model_without_offset(&mut self) -> Result<()> {
        let structure = &self.parameter_set.structure;
        let initial_without_offset = structure.initial.without_offset();
        if structure.coupled || initial_without_offset == structure.initial {
            return Ok(());
        }
        let set_without_offset =
            ParameterSet::from_structure(ParametricStructure { initial: initial_without_offset, ..structure.clone() })?;
        let mut results = run_multistart(&set_without_offset, self.context.for_submodel())?;
        results.truncate(MAX_FINAL_SURVIVORS);
        self.add(results);
        Ok(())
    }

    /// Continue the survivors, and rank them before the other candidates. Unfinished survivors get the second budget.
    ///
    /// Return the candidates and the objective on which they were optimized.
    fn promote_survivors(self) -> Result<(Vec<Candidate>, Objective<'a>)> {
        let distinct_candidates = merge_duplicates(&self.candidates, is_same_optimum);
        let (survivors, remaining) = distinct_candidates.split_at(competitive_candidates(&distinct_candidates).len());
        let budget = FIRST_BUDGET_EVALUATIONS + SECOND_BUDGET_EVALUATIONS;
        let (survivors, mut candidates) = split_by_prospect(survivors.to_vec(), budget);
        let short_fits =
            self.executor.run(self.parameter_set, &self.coarse_objective, &survivors, FIRST_BUDGET_EVALUATIONS)?;
        let (promising, results) = split_by_prospect(short_fits, SECOND_BUDGET_EVALUATIONS);
        candidates.extend(results);
        let (unfinished, results) = split_unfinished(promising, self.context.noise_floor);
        candidates.extend(results);
        candidates.extend(self.executor.run(
            self.parameter_set,
            &self.coarse_objective,
            &unfinished,
            SECOND_BUDGET_EVALUATIONS,
        )?);
        let mut candidates = rank_candidates(&self.coarse_objective, self.halved_objective, sort_by_cost(candidates))?;
        candidates.extend_from_slice(remaining);
        Ok((candidates, self.coarse_objective))
    }
}

/// Sort candidates by the larger of their costs at the step of `coarse_objective` and at half that step.
///
/// If they cannot be sampled at half the step, sort them by their cost on `coarse_objective`.
fn rank_candidates(
    coarse_objective: &Objective<'_>,
    halved_objective: Option<Objective<'_>>,
    candidates: Vec<Candidate>,
) -> Result<Vec<Candidate>> {
    if candidates.is_empty() {
        return Ok(candidates);
    }
    let halved_objective = match halved_objective.map_or_else(|| coarse_objective.finer(), Ok) {
        Err(Error::Interrupted) => return Err(Error::Interrupted),
        Err(_) => return Ok(sort_by_cost(candidates)),
        Ok(halved_objective) => halved_objective,
    };
    let order =
        halved_objective.rank_results(&candidates.iter().map(|candidate| &candidate.result).collect::<Vec<_>>())?;
    let mut candidates: Vec<Option<Candidate>> = candidates.into_iter().map(Some).collect();
    Ok(order.into_iter().filter_map(|i| candidates[i].take()).collect())
}

/// Run the multistart of a problem with many initial terms per run, and return the candidates, best first.
///
/// The initial terms are added for the survivors only, because they shift most optima by less than the distance between
/// two optima. The survivors are ranked again after a budget with all initial terms.
fn multistart_with_history(parameter_set: &ParameterSet, context: MultistartContext<'_>) -> Result<Vec<Candidate>> {
    let few_terms_set =
        parameter_set.with_initial_terms(parameter_set.structure.initial.with_base(Initial::Caputo), false)?;
    let (caputo_candidates, coarse_objective) = multistart_without_history(&few_terms_set, context)?;
    let (caputo_candidates, coarse_objective) =
        (merge_duplicates(&caputo_candidates, is_same_optimum), coarse_objective.with_problem(&parameter_set.problem));
    let executor = RungExecutor { start_count: caputo_candidates.len(), threads: context.threads, listener: None };
    let evaluations = executor.run_each(parameter_set, &coarse_objective, &caputo_candidates, 0)?;
    let cost_levels: Vec<f64> = evaluations
        .iter()
        .map(|evaluation| evaluation.as_ref().map_or(f64::INFINITY, Candidate::cost_per_residual))
        .collect();
    let mut order: Vec<usize> = (0..caputo_candidates.len()).collect();
    order.sort_by(|&i, &j| cost_levels[i].total_cmp(&cost_levels[j]));
    let cost_limit = order.first().map_or(0.0, |&i| MAX_SURVIVOR_COST_RATIO * cost_levels[i]);
    let selected: Vec<Candidate> = order
        .iter()
        .take(SUBMODEL_SURVIVORS)
        .filter(|&&i| cost_levels[i] <= cost_limit)
        .map(|&i| caputo_candidates[i].clone())
        .collect();
    let mut remaining = order[selected.len()..].to_vec();
    remaining.sort_unstable();
    let mut ranked = rank_candidates(
        &coarse_objective,
        None,
        executor.run(parameter_set, &coarse_objective, &selected, FIRST_BUDGET_EVALUATIONS)?,
    )?;
    ranked.extend(remaining.into_iter().map(|i| caputo_candidates[i].clone()));
    Ok(merge_duplicates(&ranked, is_same_optimum))
}

/// Optimize candidates on subsampled records and return the best ones, best first.
///
/// The step is halved as long as no candidate has a finite simulation.
///
/// # Errors
/// An error if the runs cannot be sampled at a shorter step. [`crate::error::Error::Interrupted`] after a stop request.
pub(super) fn optimize_on_coarse_grids(
    parameter_set: &ParameterSet,
    coarse_objective: &Objective<'_>,
    starts: &[Candidate],
    threads: usize,
) -> Result<Vec<Candidate>> {
    let executor = RungExecutor { start_count: starts.len(), threads, listener: None };
    let mut coarse_objective = coarse_objective.clone();
    let mut results = executor.run(parameter_set, &coarse_objective, starts, FIRST_BUDGET_EVALUATIONS)?;
    while coarse_objective.sampling.pulses_per_sample < MAX_PULSES_PER_SAMPLE && results.is_empty() {
        coarse_objective = coarse_objective.finer()?;
        results = executor.run(parameter_set, &coarse_objective, starts, FIRST_BUDGET_EVALUATIONS)?;
    }
    results.truncate(2 * MAX_FINAL_SURVIVORS);
    executor.run(parameter_set, &coarse_objective, &results, SECOND_BUDGET_EVALUATIONS)
}

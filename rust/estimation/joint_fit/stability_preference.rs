//! Choice between an unstable optimum and a stable one: the unstable one must fit significantly better.
//!
//! With nonzero initial conditions, an equation has free initial terms for each run. They can cancel an unstable mode
//! up to the end of the run. The response is then noncausal: the output reacts before the input. No machine does that,
//! but with autocorrelated residuals such a model can fit better.

use std::collections::BTreeMap;

use super::multistart::{fixed_order_problems, select_survivors, sort_by_cost, FIRST_BUDGET_EVALUATIONS};
use super::objective::Objective;
use super::parameter_set::ParameterSet;
use super::problem::{Candidate, OptimizationResult};
use super::structure::Coefficient;
use crate::error::{Error, Result};
use crate::signal::statistics::mean;

/// Number of segments of the runs whose mean squared residuals are compared.
const COMPARISON_SEGMENTS: f64 = 20.0;
/// 99 % quantile of Student's t distribution with [`COMPARISON_SEGMENTS`] − 1 degrees of freedom.
const STUDENT_T_QUANTILE_99: f64 = 2.54;
/// Ratio of the root mean square residuals above which the better optimum is chosen without a test.
///
/// Without this rule, an instability in the last segment alone would not be significant.
const DECISIVE_RESIDUAL_RATIO: f64 = 2.0;
/// Maximum number of stable candidates of the multistart from which the search for a stable optimum starts.
const MAX_STABLE_CANDIDATES: usize = 3;
/// Maximum number of evaluations of each stable candidate that continues after a short fit.
const EVALUATIONS_PER_CANDIDATE: usize = 60;

/// Comparison of an unstable optimum with the best stable one.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct StabilityComparison {
    /// True if the unstable optimum is the result, because it fits significantly better or no stable one exists.
    pub keeps_unstable: bool,
    /// Relative excess of the root mean square residual of the stable optimum over that of the unstable one.
    ///
    /// It is infinite without a stable optimum, and negative if the stable one fits better.
    pub residual_excess: f64,
    /// True if the stable optimum has not converged, usually because it lies on the stability limit.
    pub at_stability_limit: bool,
}

/// Choose between the best optimum, if it is unstable, and a stable one.
///
/// Return the chosen optimum, its objective and the comparison. The comparison is None if the best optimum is stable.
/// The objective requires stability if the stable optimum is chosen. `multistart_candidates` contains the candidates of
/// the multistart.
///
/// # Errors
/// An error if the runs cannot be sampled at half the step. [`Error::Interrupted`] after a stop request.
pub fn prefer_stable<'a>(
    parameter_set: &ParameterSet,
    unstable_optimum: Candidate,
    objective: Objective<'a>,
    multistart_candidates: &[Candidate],
) -> Result<(Candidate, Objective<'a>, Option<StabilityComparison>)> {
    if !is_unstable(parameter_set, &unstable_optimum) {
        return Ok((unstable_optimum, objective, None));
    }
    let constrained_objective = objective.with_stability_constraint();
    let search = StableSearch { parameter_set, objective: constrained_objective.clone() };
    let mut first = search.short_fits(&unstable_optimum, multistart_candidates)?;
    let unit = objective.time_scaling();
    for fixed_order in fixed_order_problems(parameter_set) {
        // A stable optimum with one order fixed is a candidate for the full problem. The optima of the multistart with
        // one order fixed are in `multistart_candidates` already.
        let fixed_order_search = StableSearch {
            parameter_set: &fixed_order.parameter_set,
            objective: constrained_objective.with_problem(&fixed_order.parameter_set.problem),
        };
        let fits = fixed_order_search.short_fits(&fixed_order.restrict(&unstable_optimum, &unit), &[])?;
        first.extend(fits.iter().map(|fit| fixed_order.embed(fit, parameter_set)));
    }
    let mut stable_candidates = Vec::new();
    for survivor in select_survivors(&sort_by_cost(first)) {
        stable_candidates.extend(ignore_failure(search.minimize(&survivor, &[], EVALUATIONS_PER_CANDIDATE))?);
    }
    let mut stable_candidates = sort_by_cost(stable_candidates);
    if let Some(at_limit_candidate) = stable_candidates.iter_mut().find(|stable| !stable.result.has_converged()) {
        *at_limit_candidate = search.minimize_along_limit(at_limit_candidate)?;
    }
    if stable_candidates.is_empty() {
        return Ok((
            unstable_optimum,
            objective,
            Some(StabilityComparison {
                keeps_unstable: true,
                residual_excess: f64::INFINITY,
                at_stability_limit: false,
            }),
        ));
    }
    let stable_optimum = search.select_optimum(&stable_candidates)?;
    let excess = if unstable_optimum.cost_per_residual() > 0.0 {
        (stable_optimum.cost_per_residual() / unstable_optimum.cost_per_residual()).sqrt() - 1.0
    } else {
        f64::INFINITY
    };
    if is_significantly_better(&objective, &unstable_optimum.result, &stable_optimum.result) {
        return Ok((
            unstable_optimum,
            objective,
            Some(StabilityComparison { keeps_unstable: true, residual_excess: excess, at_stability_limit: false }),
        ));
    }
    let at_limit = !stable_optimum.result.has_converged();
    Ok((
        stable_optimum,
        constrained_objective,
        Some(StabilityComparison { keeps_unstable: false, residual_excess: excess, at_stability_limit: at_limit }),
    ))
}

/// Convert any error except [`Error::Interrupted`] to None.
fn ignore_failure<T>(outcome: Result<T>) -> Result<Option<T>> {
    match outcome {
        Err(Error::Interrupted) => Err(Error::Interrupted),
        outcome => Ok(outcome.ok()),
    }
}

/// Return true if an equation is unstable at a candidate.
fn is_unstable(parameter_set: &ParameterSet, candidate: &Candidate) -> bool {
    parameter_set.problem.is_unstable(&candidate.result.iterate.point)
}

/// The known factor of each free autoregressive coefficient in its term, by name of the coefficient.
fn autoregressive_factors(parameter_set: &ParameterSet) -> BTreeMap<&String, f64> {
    let factors = parameter_set.structure.equations.iter().flat_map(|equation| equation.autoregressive_terms());
    factors
        .filter_map(|term| match &term.coefficient {
            Coefficient::Free(name) => Some((name, term.factor)),
            Coefficient::Fixed(_) => None,
        })
        .collect()
}

/// Return the candidate with the coefficients of all its autoregressive terms made negative, and the parameter indices
/// of the changed coefficients.
///
/// These terms are on the right-hand side, so equations of an order up to 2 are then stable. In a fit, the changed
/// coefficients should first be fixed while the others adapt. The input coefficients still belong to the unstable
/// optimum.
#[must_use]
pub fn dissipative_candidate(parameter_set: &ParameterSet, candidate: &Candidate) -> (Candidate, Vec<usize>) {
    let factors = autoregressive_factors(parameter_set);
    let mut iterate = candidate.result.iterate.clone();
    let mut changed = Vec::new();
    for (k, (name, value)) in parameter_set.coefficients.iter().zip(&mut iterate.point.coefficients).enumerate() {
        if factors.get(name).is_some_and(|factor| *value * factor > 0.0) {
            *value = -*value;
            changed.push(parameter_set.orders.len() + k);
        }
    }
    (candidate_at(candidate, iterate, "stable signs of the coefficients"), changed)
}

/// Return one candidate per autoregressive coefficient, with that coefficient at 0, and its parameter index.
///
/// In a fit, the coefficient should first be fixed while the others adapt. The result is empty if there is only one
/// autoregressive coefficient.
#[must_use]
pub fn candidates_without_term(parameter_set: &ParameterSet, candidate: &Candidate) -> Vec<(Candidate, Vec<usize>)> {
    let indices = autoregressive_indices(parameter_set);
    let without_coefficient = |&k: &usize| {
        let mut iterate = candidate.result.iterate.clone();
        iterate.point.coefficients[k] = 0.0;
        let description = format!("from {} = 0", parameter_set.coefficients[k]);
        (candidate_at(candidate, iterate, &description), vec![parameter_set.orders.len() + k])
    };
    if indices.len() > 1 {
        indices.iter().map(without_coefficient).collect()
    } else {
        Vec::new()
    }
}

/// Indices of the free autoregressive coefficients among the free coefficients.
fn autoregressive_indices(parameter_set: &ParameterSet) -> Vec<usize> {
    let factors = autoregressive_factors(parameter_set);
    (0..parameter_set.coefficients.len()).filter(|&k| factors.contains_key(&parameter_set.coefficients[k])).collect()
}

fn candidate_at(candidate: &Candidate, iterate: super::problem::Iterate, description: &str) -> Candidate {
    let origin = format!("{}, {description}", candidate.origin);
    Candidate { origin, result: OptimizationResult { iterate, ..candidate.result.clone() }, ..candidate.clone() }
}

/// Search for stable optima of a problem.
struct StableSearch<'f, 'g> {
    parameter_set: &'f ParameterSet,
    objective: Objective<'g>,
}

impl StableSearch<'_, '_> {
    fn minimize(&self, start: &Candidate, fixed: &[usize], evaluations: usize) -> Result<Candidate> {
        let iterate = &start.result.iterate;
        let problem = self.parameter_set.problem_at(iterate, true, fixed);
        Ok(start.with_result(self.objective.minimize_in(&problem, iterate, evaluations)?))
    }

    /// Fit briefly from stable candidates of the multistart and from modifications of the unstable optimum.
    fn short_fits(&self, unstable_optimum: &Candidate, multistart_candidates: &[Candidate]) -> Result<Vec<Candidate>> {
        let stable = multistart_candidates
            .iter()
            .filter(|candidate| !is_unstable(self.parameter_set, candidate))
            .take(MAX_STABLE_CANDIDATES);
        let mut starts: Vec<(Candidate, Vec<usize>)> =
            stable.map(|candidate| (candidate.clone(), Vec::new())).collect();
        starts.push(dissipative_candidate(self.parameter_set, unstable_optimum));
        starts.extend(candidates_without_term(self.parameter_set, unstable_optimum));
        let mut fits = Vec::new();
        for (start, changed) in starts.into_iter().filter(|(start, _)| !is_unstable(self.parameter_set, start)) {
            let fit_with_fixed = |fixed: &[usize]| self.minimize(&start, fixed, FIRST_BUDGET_EVALUATIONS);
            let adapted = if changed.is_empty() { Ok(start.clone()) } else { fit_with_fixed(&changed) };
            // Candidates without a finite simulation on this grid are skipped.
            fits.extend(ignore_failure(
                adapted.and_then(|adapted| self.minimize(&adapted, &[], FIRST_BUDGET_EVALUATIONS)),
            )?);
        }
        Ok(fits)
    }

    /// Continue from `stopped_candidate` along the stability limit, and return the best result.
    ///
    /// The optimization of all parameters stopped at this candidate because its next step would be unstable. The cost
    /// can still decrease along the limit. Each autoregressive coefficient in turn is therefore fixed at its value in
    /// the candidate, and the cost is minimized over the other parameters.
    fn minimize_along_limit(&self, stopped_candidate: &Candidate) -> Result<Candidate> {
        let status = stopped_candidate.result.status;
        let mut best_candidate = stopped_candidate.clone();
        for k in autoregressive_indices(self.parameter_set) {
            let fixed = [self.parameter_set.orders.len() + k];
            let optimum = ignore_failure(self.minimize(stopped_candidate, &fixed, EVALUATIONS_PER_CANDIDATE))?;
            best_candidate = optimum
                .filter(|optimum| optimum.cost_per_residual() < best_candidate.cost_per_residual())
                .unwrap_or(best_candidate);
        }
        // Convergence with one coefficient fixed does not imply convergence of all parameters.
        best_candidate.result.status = status;
        Ok(best_candidate)
    }

    /// Select the stable candidate that is compared with the unstable optimum.
    ///
    /// A converged optimum is preferred over a candidate on the stability limit. The exception is a candidate that fits
    /// significantly better than all converged optima.
    fn select_optimum(&self, stable_candidates: &[Candidate]) -> Result<Candidate> {
        let results: Vec<&OptimizationResult> = stable_candidates.iter().map(|candidate| &candidate.result).collect();
        let order = self.objective.finer()?.rank_results(&results)?;
        let first = order.first().copied().unwrap_or(0);
        let is_preferred = |&&i: &&usize| {
            results[i].has_converged() && !is_significantly_better(&self.objective, results[first], results[i])
        };
        Ok(stable_candidates[order.iter().find(is_preferred).copied().unwrap_or(first)].clone())
    }
}

/// Return true if `better_result` fits significantly better than `worse_result`, by Vuong's test.
///
/// The test compares the mean squares over segments of the runs (Vuong, doi:10.2307/1912557; for autocorrelated
/// residuals Rivers & Vuong, doi:10.1111/1368-423X.t01-1-00071). If there are fewer than two segments, no test is
/// possible, and the result is true.
#[must_use]
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn is_significantly_better(
    objective: &Objective<'_>,
    better_result: &OptimizationResult,
    worse_result: &OptimizationResult,
) -> bool {
    if worse_result.cost_per_residual()
        > DECISIVE_RESIDUAL_RATIO * DECISIVE_RESIDUAL_RATIO * better_result.cost_per_residual()
    {
        return true;
    }
    let squares_of_result = |result: &OptimizationResult| {
        objective.residuals(result).iter().map(|run| squares_by_sample(run)).collect::<Vec<_>>()
    };
    let (best_squares, other_squares) = (squares_of_result(better_result), squares_of_result(worse_result));
    let samples: usize = other_squares.iter().map(Vec::len).sum();
    let mut decreases = Vec::new();
    for (stable_run, unstable_run) in other_squares.iter().zip(&best_squares) {
        let decrease: Vec<f64> = stable_run.iter().zip(unstable_run).map(|(a, b)| a - b).collect();
        let count = (COMPARISON_SEGMENTS * decrease.len() as f64 / samples as f64).round_ties_even().max(1.0) as usize;
        let (segment_length, longer_segments) = (decrease.len() / count, decrease.len() % count);
        let mut remaining = decrease.as_slice();
        for k in 0..count {
            let (segment, tail) = remaining.split_at(segment_length + usize::from(k < longer_segments));
            remaining = tail;
            if !segment.is_empty() {
                decreases.push(mean(segment));
            }
        }
    }
    if decreases.len() < 2 {
        return true;
    }
    let (mean_decrease, count) = (mean(&decreases), decreases.len() as f64);
    let variance = decreases.iter().map(|v| (v - mean_decrease).powi(2)).sum::<f64>() / (count - 1.0);
    mean_decrease > STUDENT_T_QUANTILE_99 * (variance / count).sqrt()
}

/// Sum of squared weighted residuals over all outputs, by sample. A missing sample contributes 0.
fn squares_by_sample(outputs: &[Vec<f64>]) -> Vec<f64> {
    let mut total = vec![0.0; outputs.first().map_or(0, Vec::len)];
    for residuals in outputs {
        let squares = residuals.iter().map(|e| if e.is_nan() { 0.0 } else { e * e });
        total.iter_mut().zip(squares).for_each(|(sum, square)| *sum += square);
    }
    total
}

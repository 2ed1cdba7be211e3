//! Choice between an unstable optimum and a stable one: the unstable one must fit significantly better.
//!
//! With nonzero initial conditions, an equation has free initial terms for each run. They can cancel an unstable mode
//! up to the end of the run. The response is then noncausal: the output reacts before the input. No machine does that,
//! but with autocorrelated residuals such a model can fit better.

use std::collections::BTreeMap;

use super::multistart::{
    fixed_order_problems as known_orders, select_survivors, sort_by_cost, FIRST_BUDGET_EVALUATIONS,
};
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
/// The objective requires stability if the stable optimum is chosen. `reached` contains the candidates of the
/// multistart.
///
/// # Errors
/// An error if the runs cannot be sampled at half the step. [`Error::Interrupted`] after a stop request.
pub fn prefer_stable<'a>(
    free: &ParameterSet,
    best: Candidate,
    grid: Objective<'a>,
    reached: &[Candidate],
) -> Result<(Candidate, Objective<'a>, Option<StabilityComparison>)> {
    if !is_unstable(free, &best) {
        return Ok((best, grid, None));
    }
    let constrained = grid.with_stability_constraint();
    let search = StableSearch { free, grid: constrained.clone() };
    let mut first = search.short_fits(&best, reached)?;
    let unit = grid.time_scaling();
    for one in known_orders(free) {
        // A stable optimum with one order fixed is a candidate for the full problem. The optima of the multistart with
        // one order fixed are in `reached` already.
        let narrow = StableSearch { free: &one.free, grid: constrained.with_problem(&one.free.problem) };
        let fits = narrow.short_fits(&one.restrict(&best, &unit), &[])?;
        first.extend(fits.iter().map(|fit| one.embed(fit, free)));
    }
    let mut ends = Vec::new();
    for near in select_survivors(&sort_by_cost(first)) {
        ends.extend(ignore_failure(search.minimize(&near, &[], EVALUATIONS_PER_CANDIDATE))?);
    }
    let mut ends = sort_by_cost(ends);
    if let Some(limited) = ends.iter_mut().find(|end| !end.result.has_converged()) {
        *limited = search.minimize_along_limit(limited)?;
    }
    if ends.is_empty() {
        return Ok((
            best,
            grid,
            Some(StabilityComparison {
                keeps_unstable: true,
                residual_excess: f64::INFINITY,
                at_stability_limit: false,
            }),
        ));
    }
    let other = search.select_optimum(&ends)?;
    let excess = if best.cost_per_residual() > 0.0 {
        (other.cost_per_residual() / best.cost_per_residual()).sqrt() - 1.0
    } else {
        f64::INFINITY
    };
    if is_significantly_better(&grid, &best.result, &other.result) {
        return Ok((
            best,
            grid,
            Some(StabilityComparison { keeps_unstable: true, residual_excess: excess, at_stability_limit: false }),
        ));
    }
    let at_limit = !other.result.has_converged();
    Ok((
        other,
        constrained,
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
fn is_unstable(free: &ParameterSet, candidate: &Candidate) -> bool {
    free.problem.is_unstable(&candidate.result.iterate.point)
}

/// The known factor of each free autoregressive coefficient in its term, by name of the coefficient.
fn autoregressive_factors(free: &ParameterSet) -> BTreeMap<&String, f64> {
    let own = free.structure.equations.iter().flat_map(|equation| equation.autoregressive_terms());
    own.filter_map(|term| match &term.coefficient {
        Coefficient::Free(name) => Some((name, term.factor)),
        Coefficient::Known(_) => None,
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
pub fn dissipative_candidate(free: &ParameterSet, candidate: &Candidate) -> (Candidate, Vec<usize>) {
    let own = autoregressive_factors(free);
    let mut place = candidate.result.iterate.clone();
    let mut changed = Vec::new();
    for (k, (name, value)) in free.coefficients.iter().zip(&mut place.point.coefficients).enumerate() {
        if own.get(name).is_some_and(|factor| *value * factor > 0.0) {
            *value = -*value;
            changed.push(free.orders.len() + k);
        }
    }
    (candidate_at(candidate, place, "stable signs of the coefficients"), changed)
}

/// Return one candidate per autoregressive coefficient, with that coefficient at 0, and its parameter index.
///
/// In a fit, the coefficient should first be fixed while the others adapt. The result is empty if there is only one
/// autoregressive coefficient.
#[must_use]
pub fn candidates_without_term(free: &ParameterSet, candidate: &Candidate) -> Vec<(Candidate, Vec<usize>)> {
    let places = autoregressive_indices(free);
    let without = |&k: &usize| {
        let mut place = candidate.result.iterate.clone();
        place.point.coefficients[k] = 0.0;
        let words = format!("from {} = 0", free.coefficients[k]);
        (candidate_at(candidate, place, &words), vec![free.orders.len() + k])
    };
    if places.len() > 1 {
        places.iter().map(without).collect()
    } else {
        Vec::new()
    }
}

/// Indices of the free autoregressive coefficients among the free coefficients.
fn autoregressive_indices(free: &ParameterSet) -> Vec<usize> {
    let own = autoregressive_factors(free);
    (0..free.coefficients.len()).filter(|&k| own.contains_key(&free.coefficients[k])).collect()
}

fn candidate_at(candidate: &Candidate, place: super::problem::Iterate, words: &str) -> Candidate {
    let origin = format!("{}, {words}", candidate.origin);
    Candidate { origin, result: OptimizationResult { iterate: place, ..candidate.result.clone() }, ..candidate.clone() }
}

/// Search for stable optima of a problem.
struct StableSearch<'f, 'g> {
    free: &'f ParameterSet,
    grid: Objective<'g>,
}

impl StableSearch<'_, '_> {
    fn minimize(&self, start: &Candidate, fixed: &[usize], evaluations: usize) -> Result<Candidate> {
        let place = &start.result.iterate;
        let problem = self.free.problem_at(place, true, fixed);
        Ok(start.with_result(self.grid.minimize_in(&problem, place, evaluations)?))
    }

    /// Fit briefly from stable candidates of the multistart and from modifications of the unstable optimum.
    fn short_fits(&self, best: &Candidate, reached: &[Candidate]) -> Result<Vec<Candidate>> {
        let stable = reached.iter().filter(|candidate| !is_unstable(self.free, candidate)).take(MAX_STABLE_CANDIDATES);
        let mut starts: Vec<(Candidate, Vec<usize>)> =
            stable.map(|candidate| (candidate.clone(), Vec::new())).collect();
        starts.push(dissipative_candidate(self.free, best));
        starts.extend(candidates_without_term(self.free, best));
        let mut fits = Vec::new();
        for (start, changed) in starts.into_iter().filter(|(start, _)| !is_unstable(self.free, start)) {
            let adapt = |fixed: &[usize]| self.minimize(&start, fixed, FIRST_BUDGET_EVALUATIONS);
            let adapted = if changed.is_empty() { Ok(start.clone()) } else { adapt(&changed) };
            // Candidates without a finite simulation on this grid are skipped.
            fits.extend(ignore_failure(
                adapted.and_then(|adapted| self.minimize(&adapted, &[], FIRST_BUDGET_EVALUATIONS)),
            )?);
        }
        Ok(fits)
    }

    /// Continue from `end` along the stability limit, and return the best result.
    ///
    /// The optimization of all parameters stopped at `end` because its next step would be unstable. The cost can still
    /// decrease along the limit. Each autoregressive coefficient in turn is therefore fixed at its value in `end`, and
    /// the cost is minimized over the other parameters.
    fn minimize_along_limit(&self, end: &Candidate) -> Result<Candidate> {
        let status = end.result.status;
        let mut best = end.clone();
        for k in autoregressive_indices(self.free) {
            let fixed = [self.free.orders.len() + k];
            let optimum = ignore_failure(self.minimize(end, &fixed, EVALUATIONS_PER_CANDIDATE))?;
            best = optimum.filter(|optimum| optimum.cost_per_residual() < best.cost_per_residual()).unwrap_or(best);
        }
        // Convergence with one coefficient fixed does not imply convergence of all parameters.
        best.result.status = status;
        Ok(best)
    }

    /// Select the stable candidate that is compared with the unstable optimum.
    ///
    /// A converged optimum is preferred over a candidate on the stability limit. The exception is a candidate that fits
    /// significantly better than all converged optima.
    fn select_optimum(&self, ends: &[Candidate]) -> Result<Candidate> {
        let attempts: Vec<&OptimizationResult> = ends.iter().map(|candidate| &candidate.result).collect();
        let order = self.grid.finer()?.rank_results(&attempts)?;
        let first = order.first().copied().unwrap_or(0);
        let is_preferred = |&&i: &&usize| {
            attempts[i].has_converged() && !is_significantly_better(&self.grid, attempts[first], attempts[i])
        };
        Ok(ends[order.iter().find(is_preferred).copied().unwrap_or(first)].clone())
    }
}

/// Return true if the result `best` fits significantly better than `other`, by Vuong's test of non-nested models.
///
/// The test compares the mean squares over segments of the runs (Vuong, doi:10.2307/1912557; for autocorrelated
/// residuals Rivers & Vuong, doi:10.1111/1368-423X.t01-1-00071). If there are fewer than two segments, no test is
/// possible, and the result is true.
#[must_use]
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn is_significantly_better(grid: &Objective<'_>, best: &OptimizationResult, other: &OptimizationResult) -> bool {
    if other.cost_per_residual() > DECISIVE_RESIDUAL_RATIO * DECISIVE_RESIDUAL_RATIO * best.cost_per_residual() {
        return true;
    }
    let squares = |attempt: &OptimizationResult| {
        grid.residuals(attempt).iter().map(|run| squares_by_sample(run)).collect::<Vec<_>>()
    };
    let (best_squares, other_squares) = (squares(best), squares(other));
    let samples: usize = other_squares.iter().map(Vec::len).sum();
    let mut less = Vec::new();
    for (one, two) in other_squares.iter().zip(&best_squares) {
        let fall: Vec<f64> = one.iter().zip(two).map(|(a, b)| a - b).collect();
        let count = (COMPARISON_SEGMENTS * fall.len() as f64 / samples as f64).round_ties_even().max(1.0) as usize;
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
    let variance = less.iter().map(|v| (v - middle).powi(2)).sum::<f64>() / (count - 1.0);
    middle > STUDENT_T_QUANTILE_99 * (variance / count).sqrt()
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

//! Successive halving: evaluation budgets, survivors and distinct optima.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::channel;

use crate::error::{Error, Result};
use crate::estimation::joint_fit::objective::{Objective, RELATIVE_COST_TOLERANCE};
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::problem::Candidate;
use crate::estimation::joint_fit::progress::ProgressListener;
use crate::estimation::output_error::{Experiment, MinimizationSettings, Status};
use crate::parallel::Stop;

/// Number of evaluations of every candidate in the first budget.
pub(in crate::estimation::joint_fit) const FIRST_BUDGET_EVALUATIONS: usize = 15;
/// Number of evaluations in the second budget, for candidates with a cost near the best.
pub(super) const SECOND_BUDGET_EVALUATIONS: usize = 60;
/// Number of initial guesses of a submodel that continue after the prescreening.
pub(super) const SUBMODEL_SURVIVORS: usize = 8;
/// Number of evaluations of each candidate in the prescreening.
pub(super) const PRESCREEN_EVALUATIONS: usize = 2;
/// Maximum number of candidates that continue on all samples.
pub(super) const MAX_FINAL_SURVIVORS: usize = 3;
/// Ratio of a coarse cost to the best coarse cost above which the candidate does not continue.
pub(super) const MAX_SURVIVOR_COST_RATIO: f64 = 3.0;
/// Ratio of a coefficient to its initial guess below which it counts as 0.
///
/// In logarithmic coordinates, a coefficient cannot reach 0; its lower limit is e^-20 times the initial guess.
const ZERO_COEFFICIENT_RATIO: f64 = 1e-8;
/// Ratio of the cost per residual to the noise floor up to which the residuals count as noise.
const MAX_NOISE_COST_RATIO: f64 = 1.2;
/// Relative difference of two costs below which they can belong to the same optimum.
const SAME_COST_TOLERANCE: f64 = 1e-3;
/// Relative difference of each parameter below which two candidates are the same iterate. It is also the absolute
/// difference of each order below which two candidates can be the same optimum.
const SAME_PARAMETER_TOLERANCE: f64 = 0.02;
/// Relative tolerance of the orders of the same optimum, added to the absolute tolerance.
const SAME_ORDER_RELATIVE_TOLERANCE: f64 = 1e-5;

/// Executor of one rung of successive halving, with the number of starts, the threads and the progress callback.
#[derive(Clone, Copy)]
pub(super) struct RungExecutor<'a> {
    pub start_count: usize,
    pub threads: usize,
    pub listener: Option<&'a ProgressListener<'a>>,
}

impl RungExecutor<'_> {
    /// Optimize candidates with a budget of evaluations each; return those with a finite simulation, best first.
    pub(super) fn run(
        &self,
        parameter_set: &ParameterSet,
        objective: &Objective<'_>,
        candidates: &[Candidate],
        evaluations: usize,
    ) -> Result<Vec<Candidate>> {
        let results = self.run_each(parameter_set, objective, candidates, evaluations)?;
        Ok(sort_by_cost(results.into_iter().flatten().collect()))
    }

    /// Optimize each candidate with a budget of evaluations; the result is None if its simulation is not finite.
    pub(super) fn run_each(
        &self,
        parameter_set: &ParameterSet,
        objective: &Objective<'_>,
        candidates: &[Candidate],
        evaluations: usize,
    ) -> Result<Vec<Option<Candidate>>> {
        let rung = Rung {
            parameter_set,
            experiments: objective.experiments(),
            requires_stability: objective.requires_stability,
            evaluations,
            stop: objective.stop(),
        };
        let mut count = 0;
        let mut report_progress = || {
            let finished = count.min(self.start_count.saturating_sub(1));
            count += 1;
            self.listener.map_or(Ok(()), |listener| listener(finished, self.start_count))
        };
        if self.threads.min(candidates.len()) <= 1 {
            let results = candidates.iter().map(|candidate| {
                let candidate_result = rung.optimize(candidate)?;
                report_progress()?;
                Ok(candidate_result)
            });
            return results.collect();
        }
        let mut results: Vec<Option<Candidate>> = vec![None; candidates.len()];
        let (next, stop_flag) = (AtomicUsize::new(0), Stop::default());
        let (send, receive) = channel();
        let (rung, next, stop_flag) = (&rung, &next, &stop_flag);
        std::thread::scope(|scope| {
            let mut first_error = None;
            let threads = self.threads.min(candidates.len());
            for _ in 0..threads {
                let send = send.clone();
                let optimize_candidates = move || {
                    while !stop_flag.is_set() {
                        let k = next.fetch_add(1, Ordering::Relaxed);
                        let Some(candidate) = candidates.get(k) else { return };
                        if send.send((k, rung.optimize(candidate))).is_err() {
                            return;
                        }
                    }
                };
                if let Err(error) = std::thread::Builder::new().spawn_scoped(scope, optimize_candidates) {
                    stop_flag.set();
                    first_error = Some(Error::Threads { threads, reason: error.to_string() });
                    break;
                }
            }
            drop(send);
            for (k, result) in &receive {
                match result.and_then(|result| report_progress().map(|()| result)) {
                    Ok(result) => results[k] = result,
                    Err(error) => {
                        stop_flag.set();
                        first_error.get_or_insert(error);
                    }
                }
            }
            first_error.map_or(Ok(()), Err)
        })?;
        Ok(results)
    }
}

/// Common settings of the optimizations of one rung.
struct Rung<'a> {
    parameter_set: &'a ParameterSet,
    experiments: &'a [Experiment],
    requires_stability: bool,
    evaluations: usize,
    stop: &'a Stop,
}

impl Rung<'_> {
    /// Optimize one candidate. Return None if the optimization fails, for example because the simulation is not finite.
    fn optimize(&self, candidate: &Candidate) -> Result<Option<Candidate>> {
        let settings = MinimizationSettings { evaluations: self.evaluations, tolerance: RELATIVE_COST_TOLERANCE };
        let iterate = &candidate.result.iterate;
        let problem = self.parameter_set.problem_at(iterate, false, &[]);
        match problem.minimize(self.experiments, iterate, settings, self.requires_stability, self.stop) {
            Ok(result) => {
                let candidate_result = candidate.with_result(result.without_residuals());
                Ok(Some(zero_vanishing_coefficients(self.parameter_set, candidate, candidate_result)))
            }
            Err(Error::Interrupted) => Err(Error::Interrupted),
            Err(_) => Ok(None),
        }
    }
}

/// Set coefficients that became negligible in logarithmic coordinates to 0, so that they can change their sign.
fn zero_vanishing_coefficients(parameter_set: &ParameterSet, start: &Candidate, mut result: Candidate) -> Candidate {
    if parameter_set.products.is_empty() && !parameter_set.has_friction() {
        let initial_coefficients = &start.result.iterate.point.coefficients;
        for (value, initial_value) in result.result.iterate.point.coefficients.iter_mut().zip(initial_coefficients) {
            if value.abs() < ZERO_COEFFICIENT_RATIO * initial_value.abs() {
                *value = 0.0;
            }
        }
    }
    result
}

/// Sort candidates by cost per residual; equal costs keep their sequence.
pub(in crate::estimation::joint_fit) fn sort_by_cost(mut candidates: Vec<Candidate>) -> Vec<Candidate> {
    candidates.sort_by(|a, b| a.cost_per_residual().total_cmp(&b.cost_per_residual()));
    candidates
}

/// Split the candidates of a short fit into those that continue and the others.
///
/// A candidate continues if its budget is exhausted. `noise_floor` is the cost per residual of the noise alone. If some
/// candidate has converged at this noise floor, the cost of a continuing candidate must also not exceed the least
/// converged cost.
pub(in crate::estimation::joint_fit) fn split_unfinished(
    candidates: Vec<Candidate>,
    noise_floor: f64,
) -> (Vec<Candidate>, Vec<Candidate>) {
    let converged = candidates.iter().filter(|candidate| candidate.result.has_converged());
    let least_cost = converged.map(Candidate::cost_per_residual).fold(f64::INFINITY, f64::min);
    let limit = if least_cost <= MAX_NOISE_COST_RATIO * noise_floor {
        (1.0 + SAME_COST_TOLERANCE) * least_cost
    } else {
        f64::INFINITY
    };
    let does_continue =
        |candidate: &Candidate| candidate.result.status == Status::Exhausted && candidate.cost_per_residual() <= limit;
    candidates.into_iter().partition(does_continue)
}

/// Split candidates into those that can reach the least cost among them within `evaluations` evaluations, and the
/// others.
///
/// A cost is extrapolated at its mean decrease per evaluation in the last optimization of the candidate. Optimizations
/// on a plateau above the best candidate thus end. A candidate with one evaluation has no such rate and continues.
pub(super) fn split_by_prospect(candidates: Vec<Candidate>, evaluations: usize) -> (Vec<Candidate>, Vec<Candidate>) {
    let least_cost = candidates.iter().map(|candidate| candidate.result.cost).fold(f64::INFINITY, f64::min);
    #[allow(clippy::cast_precision_loss)]
    let can_reach = |candidate: &Candidate| {
        let (cost, count) = (candidate.result.cost, candidate.result.evaluations);
        let decrease = (candidate.cost_before - cost) * evaluations as f64 / count.max(1) as f64;
        count < 2 || cost - decrease <= least_cost
    };
    candidates.into_iter().partition(can_reach)
}

/// Return the survivors that continue on all samples: the best distinct optima within the cost ratio.
#[must_use]
pub fn select_survivors(candidates: &[Candidate]) -> Vec<Candidate> {
    let mut optima = merge_duplicates(candidates, is_same_optimum);
    optima.truncate(MAX_FINAL_SURVIVORS);
    competitive_candidates(&optima)
}

/// Return the candidates whose cost is at most `MAX_SURVIVOR_COST_RATIO` times that of the first, best one.
#[must_use]
pub fn competitive_candidates(candidates: &[Candidate]) -> Vec<Candidate> {
    let limit =
        candidates.first().map_or(0.0, |best_candidate| MAX_SURVIVOR_COST_RATIO * best_candidate.cost_per_residual());
    candidates.iter().filter(|candidate| candidate.cost_per_residual() <= limit).cloned().collect()
}

/// Return true if two candidates agree in cost, orders and input parameters.
#[must_use]
pub fn is_same_optimum(first: &Candidate, second: &Candidate) -> bool {
    let orders = |candidate: &Candidate| candidate.result.iterate.point.orders.clone();
    let inputs = |candidate: &Candidate| candidate.result.iterate.point.inputs.clone();
    (first.cost_per_residual() - second.cost_per_residual()).abs() <= SAME_COST_TOLERANCE * first.cost_per_residual()
        && are_all_close(&orders(second), &orders(first), SAME_ORDER_RELATIVE_TOLERANCE, SAME_PARAMETER_TOLERANCE)
        // Delays that differ by a period belong to different optima.
        && are_all_close(&inputs(second), &inputs(first), SAME_PARAMETER_TOLERANCE, 0.0)
}

/// Return true if two candidates agree in all parameters.
///
/// Order grids with common points yield such candidates.
#[must_use]
pub fn is_same_iterate(first: &Candidate, second: &Candidate) -> bool {
    are_all_close(&second.result.values(), &first.result.values(), SAME_PARAMETER_TOLERANCE, 0.0)
}

/// Return true if all values agree within the sum of `relative_tolerance` (times the second value) and
/// `absolute_tolerance`.
pub(super) fn are_all_close(first: &[f64], second: &[f64], relative_tolerance: f64, absolute_tolerance: f64) -> bool {
    first.iter().zip(second).all(|(a, b)| (a - b).abs() <= absolute_tolerance + relative_tolerance * b.abs())
}

/// Merge each candidate into an earlier one that is the same, and append the origins to that candidate.
#[must_use]
pub fn merge_duplicates(candidates: &[Candidate], is_same: impl Fn(&Candidate, &Candidate) -> bool) -> Vec<Candidate> {
    let mut distinct: Vec<Candidate> = Vec::new();
    for candidate in candidates {
        match distinct.iter_mut().find(|distinct| is_same(distinct, candidate)) {
            None => distinct.push(candidate.clone()),
            Some(first) => {
                first.duplicates.push(candidate.origin.clone());
                first.duplicates.extend(candidate.duplicates.iter().cloned());
            }
        }
    }
    distinct
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::joint_fit::problem::{Iterate, OptimizationResult};
    use crate::estimation::output_error::ParameterPoint;

    fn candidate_at(level: f64, order: f64) -> Candidate {
        let point = ParameterPoint { orders: vec![order], coefficients: vec![1.0], inputs: Vec::new() };
        let result = OptimizationResult::initial_result(Iterate { point, states: Vec::new() });
        Candidate {
            result: OptimizationResult { cost: level, residual_count: 2, ..result },
            origin: String::new(),
            duplicates: Vec::new(),
            cost_before: f64::INFINITY,
        }
    }

    #[test]
    fn candidates_stop_only_beside_an_optimum_at_the_noise_floor() {
        let candidate_with_status = |cost: f64, status| {
            let mut candidate = candidate_at(cost, 1.0);
            candidate.result.status = status;
            candidate
        };
        let candidates = || {
            [
                (1.0, Status::Converged),
                (1.0005, Status::Exhausted),
                (1.5, Status::Exhausted),
                (0.5, Status::Exhausted),
                (2.0, Status::Stalled),
            ]
            .map(|(cost, status)| candidate_with_status(cost, status))
            .to_vec()
        };
        let costs = |noise_floor: f64| {
            let (unfinished, others) = split_unfinished(candidates(), noise_floor);
            assert_eq!(unfinished.len() + others.len(), 5);
            unfinished.iter().map(|candidate| candidate.result.cost).collect::<Vec<_>>()
        };
        assert_eq!(costs(1.0), [1.0005, 0.5]);
        assert_eq!(costs(0.1), [1.0005, 1.5, 0.5]);
    }

    #[test]
    fn candidate_on_a_plateau_does_not_continue() {
        let candidate_with_decrease = |cost_before: f64, cost: f64, evaluations: usize| {
            let mut candidate = Candidate { cost_before, ..candidate_at(cost, 1.0) };
            candidate.result.evaluations = evaluations;
            candidate
        };
        // The best one, a plateau, two that fall fast enough, one without a rate.
        let candidates = [
            candidate_with_decrease(1.0, 1.0, 15),
            candidate_with_decrease(2.1, 2.0, 15),
            candidate_with_decrease(5.0, 3.0, 15),
            candidate_with_decrease(f64::INFINITY, 4.0, 2),
        ];
        let (promising, others) =
            split_by_prospect([&candidates[..], &[candidate_with_decrease(5.0, 5.0, 1)]].concat(), 60);
        let costs = |candidates: &[Candidate]| candidates.iter().map(|c| c.result.cost).collect::<Vec<_>>();
        assert_eq!((costs(&promising), costs(&others)), (vec![1.0, 3.0, 4.0, 5.0], vec![2.0]));
    }

    #[test]
    fn candidate_above_the_limit_does_not_exclude_later_ones() {
        // The sequence is that of a finer grid. The cost of the last candidate is within the ratio nevertheless.
        let candidates = [candidate_at(1.0, 0.5), candidate_at(3.5, 1.0), candidate_at(2.0, 1.5)];
        let orders: Vec<f64> = select_survivors(&candidates).iter().map(|r| r.result.iterate.point.orders[0]).collect();
        assert_eq!(orders, [0.5, 1.5]);
        assert!(competitive_candidates(&[candidate_at(0.0, 1.0), candidate_at(1e-9, 2.0)]).len() == 1);
    }
}

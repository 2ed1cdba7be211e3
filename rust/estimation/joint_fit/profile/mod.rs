//! Profile likelihood of a joint fit: intervals in which the cost rises by no more than the noise explains.
//!
//! At each value of one parameter, all others are refitted (Venzon & Moolgavkar, doi:10.2307/2347496; Raue et al.,
//! doi:10.1093/bioinformatics/btp358). [`ProfileLikelihood`] evaluates the cost around an optimum, and [`BoundSearch`]
//! finds one bound.

mod bound_search;
mod likelihood;

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::channel;

use super::progress::ProgressListener;
use crate::error::Result;
use crate::parallel::pool;
use crate::signal::statistics::median;

pub use bound_search::{BoundOutcome, BoundSearch, Interval};
pub use likelihood::{CostSurface, FitState, ProfileLikelihood, MAX_REFIT_EVALUATIONS};

use bound_search::MAX_REFITS_PER_BOUND;

/// Maximum relative error of the Wald interval of a parameter; above it, the parameter is profiled.
///
/// The error is estimated with one linear step of all other parameters.
const MAX_QUADRATIC_ERROR: f64 = 0.1;
/// Minimum number of simulations that must remain per bound for the search to continue.
const MIN_BUDGET_PER_BOUND: usize = 10;
/// Minimum decrease of the sum of squares at which a lower optimum is reported.
///
/// It is relative to the rise of the sum of squares at one standard error.
const MIN_COST_REDUCTION: f64 = 0.1;
/// Maximum number of searches. A search ends if it finds a lower optimum, and the next search starts around that
/// optimum.
const MAX_LOWER_OPTIMA: usize = 5;

/// Settings of profile-likelihood intervals: parameters, confidence level and resources.
#[derive(Debug, Clone)]
pub struct ProfileSettings {
    /// Indices of the parameters to be profiled. None selects those whose Wald interval is inaccurate.
    pub parameters: Option<Vec<usize>>,
    /// Standard normal quantile of the confidence level, such as 1.96 for 95 %: half-width of the Wald interval in
    /// standard errors.
    pub width: f64,
    /// Maximum number of simulations for all bounds, and minimum initial budget of each bound; None for no limit.
    pub budget: Option<(usize, usize)>,
    /// Number of threads. Results do not depend on it.
    pub threads: usize,
}

/// Profile-likelihood intervals, and any lower optimum found during the search.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ProfileResult {
    /// Index and interval of each profiled parameter.
    pub intervals: Vec<(usize, Interval)>,
    /// Parameter values of an optimum with a significantly lower cost than the fit; None if no such optimum was found.
    pub lower_optimum: Option<Vec<f64>>,
    /// True if the lower optimum also has a lower cost than the fit at half the step.
    pub lower_on_finer_grid: bool,
    /// Indices of the parameters whose profile needed more simulations than allowed.
    pub incomplete: Vec<usize>,
    /// Total number of simulations.
    pub evaluations: usize,
}

/// Compute profile-likelihood intervals around an optimum.
///
/// Each bound is searched from the optimum independently of the others. If a lower optimum is found, the search starts
/// again around it. The budget is distributed evenly, and unused simulations go to the bounds that are not found yet.
/// The interval of a parameter that the data do not determine is unbounded. Progress is reported as the number of
/// bounds found and the number of all bounds.
///
/// # Errors
/// [`Error::Interrupted`](crate::error::Error::Interrupted) after a stop request. Also the error of the listener, and
/// the error of a covariance that cannot be computed.
pub fn profile_intervals(
    start: ProfileLikelihood<'_>,
    settings: &ProfileSettings,
    report: &ProgressListener<'_>,
) -> Result<ProfileResult> {
    let parameters = match &settings.parameters {
        Some(indices) => indices.clone(),
        None => {
            let mut inaccurate = Vec::new();
            for i in 0..start.size() {
                if start.nonlinearity(i, settings.width)? > MAX_QUADRATIC_ERROR {
                    inaccurate.push(i);
                }
            }
            inaccurate
        }
    };
    if settings.budget.is_some_and(|(max_evaluations, min_per_bound)| {
        min_per_bound.saturating_mul(2 * parameters.len()) > max_evaluations
    }) {
        return Ok(ProfileResult { incomplete: parameters, ..ProfileResult::default() });
    }
    let (cost, mut likelihood, mut evaluations) = (start.cost(), start, 0);
    let mut bounds = Vec::new();
    for _ in 0..MAX_LOWER_OPTIMA {
        let budget = settings.budget.map(|(max_evaluations, _)| max_evaluations.saturating_sub(evaluations));
        let bounds_result = search_bounds(&likelihood, &parameters, settings, budget, report)?;
        (bounds, evaluations) = (bounds_result.bounds, evaluations + bounds_result.evaluations);
        let Some(lower) = bounds_result.lower else { break };
        // For another optimum, the extrapolation to step 0 is not known.
        likelihood = likelihood.recenter(&lower)?;
    }
    let units: Vec<f64> = likelihood.units.iter().copied().filter(|unit| unit.is_finite()).collect();
    let is_lower = !units.is_empty() && 2.0 * (cost - likelihood.cost()) > MIN_COST_REDUCTION * median(units);
    let mut result = ProfileResult { evaluations, ..ProfileResult::default() };
    if is_lower {
        result.lower_optimum = Some(likelihood.values());
        result.lower_on_finer_grid = likelihood.is_lower_on_finer_grid()?;
    }
    for i in parameters {
        let bounds_of_parameter: Vec<&(usize, Option<Interval>)> = bounds.iter().filter(|(of, _)| *of == i).collect();
        if bounds_of_parameter.iter().any(|(_, bounds_result)| bounds_result.is_none()) {
            result.incomplete.push(i);
            continue;
        }
        let sides = bounds_of_parameter.into_iter().filter_map(|(_, bounds_result)| bounds_result.clone());
        let interval = sides.reduce(Interval::intersect).unwrap_or_else(Interval::whole_line);
        result.intervals.push((i, interval.shift(likelihood.shift[i], likelihood.bounds()[i])));
    }
    Ok(result)
}

/// Result of the search for all bounds: one interval per parameter and side, or None if it is not found.
///
/// `lower` is a lower optimum that ended the search, and `evaluations` the number of simulations.
struct BoundsResult {
    bounds: Vec<(usize, Option<Interval>)>,
    lower: Option<Vec<f64>>,
    evaluations: usize,
}

/// Search for both bounds of every identifiable parameter.
///
/// The search stops at the first lower optimum, because the other bounds would belong to the wrong optimum.
fn search_bounds(
    likelihood: &ProfileLikelihood<'_>,
    parameters: &[usize],
    settings: &ProfileSettings,
    budget: Option<usize>,
    report: &ProgressListener<'_>,
) -> Result<BoundsResult> {
    let sides = parameters.iter().filter(|&&i| likelihood.is_identifiable(i)).flat_map(|&i| [(i, -1.0), (i, 1.0)]);
    let mut searches: Vec<BoundSearch> =
        sides.map(|(i, side)| BoundSearch::new(likelihood, i, side, settings.width)).collect();
    let total = searches.len();
    let mut bounds: Vec<(usize, Option<Interval>)> = searches.iter().map(|search| (search.parameter, None)).collect();
    let (workers, first_lower) = (pool(settings.threads.max(1))?, AtomicUsize::new(usize::MAX));
    let mut evaluations = vec![0; total];
    let mut lower_optimum = None;
    while bounds.iter().any(|(_, bound)| bound.is_none()) {
        let open_count = bounds.iter().filter(|(_, bound)| bound.is_none()).count();
        // Budgets are assigned in whole rounds, so that they do not depend on the number of threads.
        let budget_per_search = budget.map_or(2 * MAX_REFIT_EVALUATIONS * MAX_REFITS_PER_BOUND, |max_evaluations| {
            max_evaluations.saturating_sub(evaluations.iter().sum()) / open_count
        });
        if budget_per_search < MIN_BUDGET_PER_BOUND {
            break;
        }
        let (sender, receiver) = channel();
        let mut outcomes: Vec<Option<BoundOutcome>> = (0..total).map(|_| None).collect();
        workers.in_place_scope(|scope| {
            for (k, search) in searches.iter_mut().enumerate().filter(|(k, _)| bounds[*k].1.is_none()) {
                let (sender, allowed, first_lower) = (sender.clone(), evaluations[k] + budget_per_search, &first_lower);
                scope.spawn(move |_| {
                    let bound = search.advance(likelihood, allowed, &|| first_lower.load(Ordering::Relaxed) < k);
                    if matches!(bound, Ok(BoundOutcome::Lower(_))) {
                        first_lower.fetch_min(k, Ordering::Relaxed);
                    }
                    drop(sender.send((k, bound)));
                });
            }
            drop(sender);
            let mut count = total - open_count;
            for (k, bound) in receiver {
                let bound = bound.inspect_err(|_| likelihood.stop().set())?;
                if let BoundOutcome::Found(_) = bound {
                    count += 1;
                    report(count, total).inspect_err(|_| likelihood.stop().set())?;
                }
                outcomes[k] = Some(bound);
            }
            Ok(())
        })?;
        for (k, outcome) in outcomes.into_iter().enumerate() {
            let Some(outcome) = outcome else { continue };
            evaluations[k] = searches[k].evaluations();
            match outcome {
                BoundOutcome::Found(interval) => bounds[k].1 = Some(interval),
                BoundOutcome::Paused => {}
                BoundOutcome::Lower(values) => {
                    lower_optimum = Some(values);
                    break;
                }
            }
        }
        if lower_optimum.is_some() {
            break;
        }
    }
    Ok(BoundsResult { bounds, lower: lower_optimum, evaluations: evaluations.iter().sum() })
}

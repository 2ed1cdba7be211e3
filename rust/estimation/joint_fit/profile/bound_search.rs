//! Search for one bound of a profile-likelihood interval by a bracketed Newton method.

use super::likelihood::{ProfileLikelihood, Refit, MAX_REFIT_EVALUATIONS};
use crate::error::Result;
use crate::estimation::joint_fit::problem::OptimizationResult;

/// Maximum relative difference between the square root of the cost rise and the threshold at a converged bound.
///
/// Newton's next step must also be shorter than [`BOUND_TOLERANCE`] times the distance from the optimum.
const RISE_TOLERANCE: f64 = 0.1;
/// Maximum Newton step at a converged bound, relative to the distance from the optimum.
const BOUND_TOLERANCE: f64 = 0.02;
/// Maximum number of refits for one bound.
pub(super) const MAX_REFITS_PER_BOUND: usize = 40;
/// Maximum distance of a bound from the optimum, relative to the length of the first step.
///
/// Beyond this distance, the interval of a parameter counts as unbounded.
const MAX_BOUND_DISTANCE: f64 = 1e3;
/// Minimum length of the first step, relative to the half-width of the Wald interval.
const MIN_FIRST_STEP_RATIO: f64 = 0.01;
/// Minimum scale of a bracket, relative to the distance of its outer end from the optimum.
///
/// The scale is the magnitude of the parameter at the inner end, but at most the distance of the outer end from the
/// optimum. A bracket is narrow if its width is at most [`BOUND_TOLERANCE`] times this scale.
const BRACKET_SCALE_RATIO: f64 = 0.1;
/// Minimum factor by which one step increases the distance from the optimum.
const MIN_STEP_FACTOR: f64 = 1.1;
/// Maximum factor by which one step increases the distance from the optimum.
const MAX_STEP_FACTOR: f64 = 4.0;
/// Ratio of the increases of the square root of the cost rise in two successive steps, below which the cost counts as
/// leveling off.
const LEVELING_RATIO: f64 = 0.5;
/// Relative margin by which the extrapolated square root of the cost rise must stay below the threshold for the cost to
/// count as leveling off.
const LEVELING_MARGIN: f64 = 0.05;
/// Minimum distance of a step from both ends of its bracket, as a fraction of the bracket width.
const BRACKET_MARGIN: f64 = 0.05;

/// Interval of one parameter, or the part of it on one side of the optimum.
#[derive(Debug, Clone, PartialEq)]
pub struct Interval {
    /// Lower bound.
    pub low: f64,
    /// Upper bound.
    pub high: f64,
    /// Parameter value and rise of the sum of squares, in units of the noise variance, at each refit.
    pub points: Vec<(f64, f64)>,
    /// Number of simulations of the search.
    pub evaluations: usize,
}

impl Interval {
    /// An unbounded interval, without a refit.
    pub(super) fn whole_line() -> Self {
        Self { low: f64::NEG_INFINITY, high: f64::INFINITY, points: Vec::new(), evaluations: 0 }
    }

    /// Shift the finite bounds by `change` and limit them to the bounds of the parameter.
    ///
    /// `change` is the estimate, extrapolated to step 0, minus the optimum at the step of the profile.
    pub(super) fn shift(mut self, change: f64, (low, high): (f64, f64)) -> Self {
        for bound in [&mut self.low, &mut self.high].into_iter().filter(|bound| bound.is_finite()) {
            *bound = (*bound + change).clamp(low, high);
        }
        self
    }

    /// Intersection of the intervals of the two sides, with the points of both.
    pub(super) fn intersect(mut self, other: Self) -> Self {
        self.points.extend(other.points);
        self.points.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let (low, high) = (self.low.max(other.low), self.high.min(other.high));
        Self { low, high, points: self.points, evaluations: self.evaluations + other.evaluations }
    }
}

/// Result of a search for a bound.
pub enum BoundOutcome {
    /// Interval of which the bound that was searched for is known; the other bound is not.
    Found(Interval),
    /// The budget is exhausted, or the search was canceled.
    Paused,
    /// Parameter values of an optimum with a lower cost than the fit.
    Lower(Vec<f64>),
}

/// Search for one bound of the interval of a parameter.
///
/// At a refit, the derivative of the cost with respect to the parameter is the slope of the profile. If the cost is a
/// parabola, the square root of its rise above the optimum is a linear function of the parameter. One refit then
/// suffices.
pub struct BoundSearch {
    /// Index of the parameter.
    pub parameter: usize,
    /// −1 for the lower bound, 1 for the upper bound.
    side: f64,
    /// Half-width of the Wald interval, in standard errors.
    width: f64,
    /// Value of the parameter at the optimum.
    optimum_value: f64,
    /// Distance of the first refit from the optimum.
    first_distance: f64,
    /// Maximum distance of a refit from the optimum.
    max_distance: f64,
    /// Distance of the next refit from the optimum.
    distance: f64,
    /// Distance between the optimum and the last refit whose cost is below the threshold.
    inner_distance: f64,
    /// Distance between the optimum and the nearest refit whose cost is above the threshold; infinite if there is none.
    outer_distance: f64,
    /// Result of the last refit whose cost is below the threshold.
    inner_result: OptimizationResult,
    /// Result of the refit that was interrupted when the budget was exhausted; the next refit starts from it.
    interrupted_result: Option<OptimizationResult>,
    refits: usize,
    /// Square root of the cost rise at the previous step.
    previous_rise: f64,
    /// Increase of the square root of the cost rise in the previous step.
    previous_rise_increment: f64,
    points: Vec<(f64, f64)>,
    evaluations: usize,
}

impl BoundSearch {
    /// Return a search for the lower (`side` −1) or upper (`side` 1) bound; `width` is the half-width of the Wald
    /// interval in standard errors.
    #[must_use]
    pub fn new(likelihood: &ProfileLikelihood<'_>, parameter: usize, side: f64, width: f64) -> Self {
        let (optimum_value, half_width) = (likelihood.values()[parameter], likelihood.errors[parameter] * width);
        let (low, high) = likelihood.bounds()[parameter];
        let limit = if side < 0.0 { low } else { high };
        // In an unbounded valley, the standard error is no measure of its length.
        let first_distance = half_width.min(optimum_value.abs().max(MIN_FIRST_STEP_RATIO * half_width));
        let max_distance = (MAX_BOUND_DISTANCE * first_distance).min((limit - optimum_value).abs());
        Self {
            parameter,
            side,
            width,
            optimum_value,
            first_distance,
            max_distance,
            distance: first_distance.min(max_distance),
            inner_distance: 0.0,
            outer_distance: f64::INFINITY,
            inner_result: likelihood.optimum.clone(),
            interrupted_result: None,
            refits: 0,
            previous_rise: 0.0,
            previous_rise_increment: f64::INFINITY,
            points: Vec::new(),
            evaluations: 0,
        }
    }

    /// Number of simulations so far.
    #[must_use]
    pub fn evaluations(&self) -> usize {
        self.evaluations
    }

    /// Continue the search until it ends or `max_evaluations` simulations have been performed in total.
    ///
    /// # Errors
    /// [`Error::Interrupted`](crate::error::Error::Interrupted) after a stop request.
    pub fn advance(
        &mut self,
        likelihood: &ProfileLikelihood<'_>,
        max_evaluations: usize,
        is_cancelled: &dyn Fn() -> bool,
    ) -> Result<BoundOutcome> {
        while self.refits < MAX_REFITS_PER_BOUND
            && (self.interrupted_result.is_some() || self.distance > self.inner_distance)
        {
            likelihood.stop().check()?;
            if is_cancelled() {
                return Ok(BoundOutcome::Paused);
            }
            let origin = self.interrupted_result.take().unwrap_or_else(|| self.inner_result.clone());
            let budget = MAX_REFIT_EVALUATIONS.min(max_evaluations.saturating_sub(self.evaluations));
            let refit = match budget {
                0 => Refit::Infeasible,
                _ => {
                    likelihood.refit(self.parameter, self.optimum_value + self.side * self.distance, &origin, budget)?
                }
            };
            let refit_result = match refit {
                Refit::Lower(lower) => {
                    self.evaluations += lower.evaluations;
                    return Ok(BoundOutcome::Lower(lower.values()));
                }
                Refit::Optimum(refit_result) => Some(refit_result),
                Refit::Infeasible => None,
            };
            let used_evaluations = refit_result.as_ref().map_or(budget, |refit_result| refit_result.evaluations);
            self.evaluations += used_evaluations;
            if budget < MAX_REFIT_EVALUATIONS && used_evaluations >= budget {
                // The result of an interrupted refit is not a point of the profile.
                self.interrupted_result = Some(refit_result.unwrap_or(origin));
                return Ok(BoundOutcome::Paused);
            }
            self.refits += 1;
            if let Some(distance) = self.step(likelihood, refit_result) {
                return Ok(BoundOutcome::Found(self.side_of(self.optimum_value + self.side * distance)));
            }
        }
        // The interval is bounded only if some finite cost beyond the threshold was computed.
        let is_bounded =
            self.outer_distance.is_finite() && self.points.iter().any(|(_, rise)| *rise >= self.width * self.width);
        let bound =
            if is_bounded { self.optimum_value + self.side * self.outer_distance } else { self.side * f64::INFINITY };
        Ok(BoundOutcome::Found(self.side_of(bound)))
    }

    /// Return the interval on this side of the optimum that ends at `bound`.
    fn side_of(&mut self, bound: f64) -> Interval {
        let mut interval = Interval::whole_line();
        *(if self.side < 0.0 { &mut interval.low } else { &mut interval.high }) = bound;
        (interval.points, interval.evaluations) = (std::mem::take(&mut self.points), self.evaluations);
        interval
    }

    /// Set the distance of the next refit, or NaN to end the search. Return the distance of the bound if it is found.
    fn step(&mut self, likelihood: &ProfileLikelihood<'_>, refit_result: Option<OptimizationResult>) -> Option<f64> {
        let (i, width) = (self.parameter, self.width);
        let (mut rise, mut newton_distance, mut is_near) = (f64::INFINITY, f64::INFINITY, false);
        if let Some(refit_result) = &refit_result {
            rise = likelihood.rise(i, 2.0 * refit_result.cost);
            self.points.push((self.optimum_value + self.side * self.distance + likelihood.shift[i], rise * rise));
            let slope = if rise > 0.0 {
                self.side * likelihood.slope(refit_result, i) / (likelihood.units[i] * rise)
            } else {
                0.0
            };
            if slope > 0.0 {
                newton_distance = self.distance + (width - rise) / slope;
            }
            is_near = (rise / width - 1.0).abs() <= RISE_TOLERANCE;
            let is_short = (newton_distance - self.distance).abs() <= BOUND_TOLERANCE * self.distance;
            if is_near && is_short && self.inner_distance < newton_distance && newton_distance <= self.max_distance {
                return Some(newton_distance);
            }
        }
        match refit_result {
            Some(refit_result) if rise <= width => {
                (self.inner_distance, self.inner_result) = (self.distance, refit_result);
                if self.distance >= self.outer_distance {
                    // The earlier refit at the outer point did not find the optimum.
                    self.outer_distance = f64::INFINITY;
                }
                if self.distance >= self.max_distance {
                    self.distance = f64::NAN;
                    return None;
                }
            }
            _ => {
                if self.distance >= self.outer_distance {
                    // Small steps confirm that the outer point is outside: the profile jumps here, or the simulation
                    // diverges.
                    self.distance = f64::NAN;
                    return None;
                }
                self.outer_distance = self.distance;
            }
        }
        let (inner, outer) = (self.inner_distance, self.outer_distance);
        let is_bracketed = outer.is_finite();
        let scale = outer.min((self.optimum_value + self.side * inner).abs()).max(BRACKET_SCALE_RATIO * outer);
        let is_narrow = is_bracketed && outer - inner <= BOUND_TOLERANCE * scale;
        if is_near && !is_narrow && inner < newton_distance && newton_distance < outer.min(self.max_distance) {
            // Close to the bound, Newton's step is more accurate than a step of fixed ratio.
            self.distance = newton_distance;
        } else if !is_bracketed {
            let rise_increment = rise - self.previous_rise;
            self.previous_rise = rise;
            let is_leveling_off = rise_increment <= LEVELING_RATIO * self.previous_rise_increment
                && rise + rise_increment < (1.0 - LEVELING_MARGIN) * width;
            if is_leveling_off && self.distance > MAX_STEP_FACTOR * self.first_distance {
                self.distance = f64::NAN;
                return None;
            }
            self.previous_rise_increment = rise_increment;
            let longest_distance = (MAX_STEP_FACTOR * self.distance).min(self.max_distance);
            self.distance = newton_distance.max(MIN_STEP_FACTOR * self.distance).min(longest_distance);
        } else if is_narrow {
            self.distance = outer;
        } else {
            let margin = BRACKET_MARGIN * (outer - inner);
            let is_within = inner < newton_distance && newton_distance < outer;
            let next_distance = if is_within { newton_distance } else { self.bracket_midpoint() };
            self.distance = next_distance.max(inner + margin).min(outer - margin);
        }
        None
    }

    /// Distance from the optimum to the midpoint of the bracket. The midpoint is a geometric mean if the parameter has
    /// the same sign at both ends.
    fn bracket_midpoint(&self) -> f64 {
        let (inner, outer) = (
            self.optimum_value + self.side * self.inner_distance,
            self.optimum_value + self.side * self.outer_distance,
        );
        if inner * outer > 0.0 {
            self.side * ((inner * outer).sqrt().copysign(inner) - self.optimum_value)
        } else {
            0.5 * (self.inner_distance + self.outer_distance)
        }
    }
}

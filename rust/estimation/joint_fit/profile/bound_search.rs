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

    /// Shift the finite bounds by `by` and limit them to the bounds of the parameter.
    ///
    /// `by` is the estimate, extrapolated to step 0, minus the optimum at the step of the profile.
    pub(super) fn shift(mut self, by: f64, (low, high): (f64, f64)) -> Self {
        for end in [&mut self.low, &mut self.high].into_iter().filter(|end| end.is_finite()) {
            *end = (*end + by).clamp(low, high);
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
    start: f64,
    /// Distance of the first refit from the optimum.
    first: f64,
    /// Maximum distance of a refit from the optimum.
    farthest: f64,
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
    pub fn new(around: &ProfileLikelihood<'_>, parameter: usize, side: f64, width: f64) -> Self {
        let (start, half) = (around.values()[parameter], around.errors[parameter] * width);
        let (low, high) = around.bounds()[parameter];
        let limit = if side < 0.0 { low } else { high };
        // In an unbounded valley, the standard error is no measure of its length.
        let first = half.min(start.abs().max(MIN_FIRST_STEP_RATIO * half));
        let farthest = (MAX_BOUND_DISTANCE * first).min((limit - start).abs());
        Self {
            parameter,
            side,
            width,
            start,
            first,
            farthest,
            distance: first.min(farthest),
            inner_distance: 0.0,
            outer_distance: f64::INFINITY,
            inner_result: around.best.clone(),
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

    /// Continue the search until it ends or `allowed` simulations have been performed in total.
    ///
    /// # Errors
    /// [`Error::Interrupted`](crate::error::Error::Interrupted) after a stop request.
    pub fn advance(
        &mut self,
        around: &ProfileLikelihood<'_>,
        allowed: usize,
        is_cancelled: &dyn Fn() -> bool,
    ) -> Result<BoundOutcome> {
        while self.refits < MAX_REFITS_PER_BOUND
            && (self.interrupted_result.is_some() || self.distance > self.inner_distance)
        {
            around.stop().check()?;
            if is_cancelled() {
                return Ok(BoundOutcome::Paused);
            }
            let origin = self.interrupted_result.take().unwrap_or_else(|| self.inner_result.clone());
            let budget = MAX_REFIT_EVALUATIONS.min(allowed.saturating_sub(self.evaluations));
            let refit = match budget {
                0 => Refit::Infeasible,
                _ => around.refit(self.parameter, self.start + self.side * self.distance, &origin, budget)?,
            };
            let refit_result = match refit {
                Refit::Lower(lower) => {
                    self.evaluations += lower.evaluations;
                    return Ok(BoundOutcome::Lower(lower.values()));
                }
                Refit::Optimum(refit_result) => Some(refit_result),
                Refit::Infeasible => None,
            };
            let used = refit_result.as_ref().map_or(budget, |refit_result| refit_result.evaluations);
            self.evaluations += used;
            if budget < MAX_REFIT_EVALUATIONS && used >= budget {
                // The result of an interrupted refit is not a point of the profile.
                self.interrupted_result = Some(refit_result.unwrap_or(origin));
                return Ok(BoundOutcome::Paused);
            }
            self.refits += 1;
            if let Some(distance) = self.step(around, refit_result) {
                return Ok(BoundOutcome::Found(self.side_of(self.start + self.side * distance)));
            }
        }
        // The interval is bounded only if some finite cost beyond the threshold was computed.
        let is_bounded =
            self.outer_distance.is_finite() && self.points.iter().any(|(_, rise)| *rise >= self.width * self.width);
        let bound = if is_bounded { self.start + self.side * self.outer_distance } else { self.side * f64::INFINITY };
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
    fn step(&mut self, around: &ProfileLikelihood<'_>, refit_result: Option<OptimizationResult>) -> Option<f64> {
        let (i, width) = (self.parameter, self.width);
        let (mut rise, mut following, mut near) = (f64::INFINITY, f64::INFINITY, false);
        if let Some(refit_result) = &refit_result {
            rise = around.rise(i, 2.0 * refit_result.cost);
            self.points.push((self.start + self.side * self.distance + around.shift[i], rise * rise));
            let slope =
                if rise > 0.0 { self.side * around.slope(refit_result, i) / (around.units[i] * rise) } else { 0.0 };
            if slope > 0.0 {
                following = self.distance + (width - rise) / slope;
            }
            near = (rise / width - 1.0).abs() <= RISE_TOLERANCE;
            let short = (following - self.distance).abs() <= BOUND_TOLERANCE * self.distance;
            if near && short && self.inner_distance < following && following <= self.farthest {
                return Some(following);
            }
        }
        match refit_result {
            Some(refit_result) if rise <= width => {
                (self.inner_distance, self.inner_result) = (self.distance, refit_result);
                if self.distance >= self.outer_distance {
                    // The earlier refit at the outer point did not find the optimum.
                    self.outer_distance = f64::INFINITY;
                }
                if self.distance >= self.farthest {
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
        let (inside, outside) = (self.inner_distance, self.outer_distance);
        let closed = outside.is_finite();
        let scale = outside.min((self.start + self.side * inside).abs()).max(BRACKET_SCALE_RATIO * outside);
        let narrow = closed && outside - inside <= BOUND_TOLERANCE * scale;
        if near && !narrow && inside < following && following < outside.min(self.farthest) {
            // Close to the bound, Newton's step is more accurate than a step of fixed ratio.
            self.distance = following;
        } else if !closed {
            let gain = rise - self.previous_rise;
            self.previous_rise = rise;
            let levels =
                gain <= LEVELING_RATIO * self.previous_rise_increment && rise + gain < (1.0 - LEVELING_MARGIN) * width;
            if levels && self.distance > MAX_STEP_FACTOR * self.first {
                self.distance = f64::NAN;
                return None;
            }
            self.previous_rise_increment = gain;
            let longest = (MAX_STEP_FACTOR * self.distance).min(self.farthest);
            self.distance = following.max(MIN_STEP_FACTOR * self.distance).min(longest);
        } else if narrow {
            self.distance = outside;
        } else {
            let margin = BRACKET_MARGIN * (outside - inside);
            let within = inside < following && following < outside;
            let next = if within { following } else { self.bracket_midpoint() };
            self.distance = next.max(inside + margin).min(outside - margin);
        }
        None
    }

    /// Distance from the optimum to the midpoint of the bracket. The midpoint is a geometric mean if the parameter has
    /// the same sign at both ends.
    fn bracket_midpoint(&self) -> f64 {
        let (inner, outer) =
            (self.start + self.side * self.inner_distance, self.start + self.side * self.outer_distance);
        if inner * outer > 0.0 {
            self.side * ((inner * outer).sqrt().copysign(inner) - self.start)
        } else {
            0.5 * (self.inner_distance + self.outer_distance)
        }
    }
}

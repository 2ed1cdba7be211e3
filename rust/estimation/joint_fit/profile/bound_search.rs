//! Search for one bound of a profile-likelihood interval by a bracketed Newton method.

use super::likelihood::{ProfileLikelihood, Refit, MAX_REFIT_EVALUATIONS};
use crate::error::Result;
use crate::estimation::joint_fit::problem::OptimizationResult;

/// Tolerance of a bound: maximum difference of the root of the cost rise from its threshold. Newton's next step must
/// also be shorter than [`BOUND_TOLERANCE`] times the distance from the optimum.
const RISE_TOLERANCE: f64 = 0.1;
/// Maximum Newton step at a converged bound, relative to the distance from the optimum.
const BOUND_TOLERANCE: f64 = 0.02;
/// Maximum number of refits for one bound.
pub(super) const MAX_REFITS_PER_BOUND: usize = 40;
/// Maximum distance of a bound from the optimum, in half-widths of the Wald interval. Beyond it the interval counts as
/// unbounded.
const MAX_BOUND_DISTANCE: f64 = 1e3;
/// Minimum length of the first step, relative to the Wald half-width.
const MIN_FIRST_STEP_RATIO: f64 = 0.01;
/// A bracket is narrow if its width is [`BOUND_TOLERANCE`] times the value inside it, or times this fraction of its
/// distance from the optimum.
const BRACKET_SCALE_RATIO: f64 = 0.1;
/// Minimum factor by which one step increases the distance from the optimum.
const MIN_STEP_FACTOR: f64 = 1.1;
/// Maximum factor by which one step increases the distance from the optimum.
const MAX_STEP_FACTOR: f64 = 4.0;
/// Maximum ratio of the rises of the root cost in two successive steps at which the cost counts as leveling off. The
/// root cost must also be below this fraction of the threshold.
const LEVELING_RATIO: f64 = 0.5;
const LEVELING_MARGIN: f64 = 0.05;
/// Minimum distance of a step from both ends of its bracket, as a fraction of the bracket width.
const BRACKET_MARGIN: f64 = 0.05;

/// Interval of one parameter, or one side of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Interval {
    /// Lower bound.
    pub low: f64,
    /// Upper bound.
    pub high: f64,
    /// (parameter value, rise of the sum of squares in units of the noise variance) at each refit.
    pub points: Vec<(f64, f64)>,
    /// Number of simulations.
    pub evaluations: usize,
}

impl Interval {
    /// The whole line, without a refit.
    pub(super) fn whole_line() -> Self {
        Self { low: f64::NEG_INFINITY, high: f64::INFINITY, points: Vec::new(), evaluations: 0 }
    }

    /// Interval shifted by the difference between the optima on the extrapolated grid and on the profile grid, then
    /// limited to the bounds of its parameter.
    pub(super) fn shift(mut self, by: f64, (low, high): (f64, f64)) -> Self {
        for end in [&mut self.low, &mut self.high].into_iter().filter(|end| end.is_finite()) {
            *end = (*end + by).clamp(low, high);
        }
        self
    }

    /// Intersection of the two sides.
    pub(super) fn intersect(mut self, other: Self) -> Self {
        self.points.extend(other.points);
        self.points.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let (low, high) = (self.low.max(other.low), self.high.min(other.high));
        Self { low, high, points: self.points, evaluations: self.evaluations + other.evaluations }
    }
}

/// Result of a search for a bound.
pub enum BoundOutcome {
    /// The interval on this side of the optimum.
    Found(Interval),
    /// The budget is exhausted, or the search was cancelled.
    Paused,
    /// Parameters of an optimum with a lower cost than the fit.
    Lower(Vec<f64>),
}

/// Search for one bound of the interval of a parameter.
///
/// At a refit the slope of the cost along the parameter is the slope of the profile. The root of its rise is linear if
/// the cost is a parabola, so one refit then suffices.
pub struct BoundSearch {
    /// Index of the parameter.
    pub parameter: usize,
    side: f64,
    width: f64,
    start: f64,
    first: f64,
    farthest: f64,
    /// Distance of the next refit from the optimum.
    way: f64,
    /// Distance of the last refit below the threshold, and of the first refit above it.
    inside: f64,
    outside: f64,
    within: OptimizationResult,
    /// Result of the refit that the budget interrupted.
    origin: Option<OptimizationResult>,
    refits: usize,
    reached: f64,
    gained: f64,
    points: Vec<(f64, f64)>,
    evaluations: usize,
}

impl BoundSearch {
    /// Search of the lower (−1) or upper (1) bound at a half-width in standard deviations.
    #[must_use]
    pub fn new(around: &ProfileLikelihood<'_>, parameter: usize, side: f64, width: f64) -> Self {
        let (start, half) = (around.values()[parameter], around.errors[parameter] * width);
        let (low, high) = around.bounds()[parameter];
        let limit = if side < 0.0 { low } else { high };
        // In a valley without end standard errors are no measure of it.
        let first = half.min(start.abs().max(MIN_FIRST_STEP_RATIO * half));
        let farthest = (MAX_BOUND_DISTANCE * first).min((limit - start).abs());
        Self {
            parameter,
            side,
            width,
            start,
            first,
            farthest,
            way: first.min(farthest),
            inside: 0.0,
            outside: f64::INFINITY,
            within: around.best.clone(),
            origin: None,
            refits: 0,
            reached: 0.0,
            gained: f64::INFINITY,
            points: Vec::new(),
            evaluations: 0,
        }
    }

    /// Number of simulations so far.
    #[must_use]
    pub fn evaluations(&self) -> usize {
        self.evaluations
    }

    /// Continue with a total budget of simulations.
    ///
    /// # Errors
    /// [`Error::Interrupted`](crate::error::Error::Interrupted).
    pub fn advance(
        &mut self,
        around: &ProfileLikelihood<'_>,
        allowed: usize,
        is_cancelled: &dyn Fn() -> bool,
    ) -> Result<BoundOutcome> {
        while self.refits < MAX_REFITS_PER_BOUND && (self.origin.is_some() || self.way > self.inside) {
            around.stop().check()?;
            if is_cancelled() {
                return Ok(BoundOutcome::Paused);
            }
            let origin = self.origin.take().unwrap_or_else(|| self.within.clone());
            let lap = MAX_REFIT_EVALUATIONS.min(allowed.saturating_sub(self.evaluations));
            let refit = match lap {
                0 => Refit::Infeasible,
                _ => around.refit(self.parameter, self.start + self.side * self.way, &origin, lap)?,
            };
            let refit_result = match refit {
                Refit::Lower(lower) => {
                    self.evaluations += lower.evaluations;
                    return Ok(BoundOutcome::Lower(lower.values()));
                }
                Refit::Optimum(refit_result) => Some(refit_result),
                Refit::Infeasible => None,
            };
            let took = refit_result.as_ref().map_or(lap, |refit_result| refit_result.evaluations);
            self.evaluations += took;
            if lap < MAX_REFIT_EVALUATIONS && took >= lap {
                // An interrupted refit is no bound of the profile.
                self.origin = Some(refit_result.unwrap_or(origin));
                return Ok(BoundOutcome::Paused);
            }
            self.refits += 1;
            if let Some(distance) = self.step(around, refit_result) {
                return Ok(BoundOutcome::Found(self.side_of(self.start + self.side * distance)));
            }
        }
        // The interval is bounded only if some finite cost beyond the threshold was computed.
        let risen = self.outside.is_finite() && self.points.iter().any(|(_, rise)| *rise >= self.width * self.width);
        let bound = if risen { self.start + self.side * self.outside } else { self.side * f64::INFINITY };
        Ok(BoundOutcome::Found(self.side_of(bound)))
    }

    /// Interval on this side of the optimum.
    fn side_of(&mut self, bound: f64) -> Interval {
        let mut interval = Interval::whole_line();
        *(if self.side < 0.0 { &mut interval.low } else { &mut interval.high }) = bound;
        (interval.points, interval.evaluations) = (std::mem::take(&mut self.points), self.evaluations);
        interval
    }

    /// Choose the distance of the next refit. Return the distance of the bound if it is found; NaN ends the search.
    fn step(&mut self, around: &ProfileLikelihood<'_>, refit_result: Option<OptimizationResult>) -> Option<f64> {
        let (i, width) = (self.parameter, self.width);
        let (mut rise, mut following, mut near) = (f64::INFINITY, f64::INFINITY, false);
        if let Some(refit_result) = &refit_result {
            rise = around.rise(i, 2.0 * refit_result.cost);
            self.points.push((self.start + self.side * self.way + around.shift[i], rise * rise));
            let slope =
                if rise > 0.0 { self.side * around.slope(refit_result, i) / (around.units[i] * rise) } else { 0.0 };
            if slope > 0.0 {
                following = self.way + (width - rise) / slope;
            }
            near = (rise / width - 1.0).abs() <= RISE_TOLERANCE;
            let short = (following - self.way).abs() <= BOUND_TOLERANCE * self.way;
            if near && short && self.inside < following && following <= self.farthest {
                return Some(following);
            }
        }
        match refit_result {
            Some(refit_result) if rise <= width => {
                (self.inside, self.within) = (self.way, refit_result);
                if self.way >= self.outside {
                    // The refit at the outer point did not find the optimum.
                    self.outside = f64::INFINITY;
                }
                if self.way >= self.farthest {
                    self.way = f64::NAN;
                    return None;
                }
            }
            _ => {
                if self.way >= self.outside {
                    // Small steps confirm that the outer point is outside: the profile jumps here, or the simulation
                    // diverges.
                    self.way = f64::NAN;
                    return None;
                }
                self.outside = self.way;
            }
        }
        let (inside, outside) = (self.inside, self.outside);
        let closed = outside.is_finite();
        let scale = outside.min((self.start + self.side * inside).abs()).max(BRACKET_SCALE_RATIO * outside);
        let narrow = closed && outside - inside <= BOUND_TOLERANCE * scale;
        if near && !narrow && inside < following && following < outside.min(self.farthest) {
            // Close to the bound, Newton's step is more accurate than a step of fixed ratio.
            self.way = following;
        } else if !closed {
            let gain = rise - self.reached;
            self.reached = rise;
            let levels = gain <= LEVELING_RATIO * self.gained && rise + gain < (1.0 - LEVELING_MARGIN) * width;
            if levels && self.way > MAX_STEP_FACTOR * self.first {
                self.way = f64::NAN;
                return None;
            }
            self.gained = gain;
            let longest = (MAX_STEP_FACTOR * self.way).min(self.farthest);
            self.way = following.max(MIN_STEP_FACTOR * self.way).min(longest);
        } else if narrow {
            self.way = outside;
        } else {
            let margin = BRACKET_MARGIN * (outside - inside);
            let within = inside < following && following < outside;
            let next = if within { following } else { self.bracket_midpoint() };
            self.way = next.max(inside + margin).min(outside - margin);
        }
        None
    }

    /// Midpoint of the bracket; geometric if both values have the same sign.
    fn bracket_midpoint(&self) -> f64 {
        let (near, far) = (self.start + self.side * self.inside, self.start + self.side * self.outside);
        if near * far > 0.0 {
            self.side * ((near * far).sqrt().copysign(near) - self.start)
        } else {
            0.5 * (self.inside + self.outside)
        }
    }
}

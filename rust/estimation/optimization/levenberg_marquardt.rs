//! Nonlinear least squares by Levenberg–Marquardt, for any problem that can say its residuals and their derivatives.
//!
//! Columns are scaled by the Jacobian's norms, steps follow from a QR factor of [J | e] with the damping below it, and a
//! rejected step costs no Jacobian. A problem says itself how a point moves: in which coordinates, and within which bounds.
//! What stands on a bound and is pushed out of it is left out of step and gradient, so that the rest moves on.
//!
//! Where Gauss–Newton foretells the fall of the cost badly, what it leaves out is learnt (`Curvature`); along a valley
//! the search leaps (`Valley`).
//!
//! A minimum is where the gradient vanishes, and nothing else is called one: the cosine between the residuals and every
//! column that is free to move, the relative offset of Dennis & Schnabel (doi:10.1137/1.9781611971200, §7.2) and MINPACK.

pub use super::damped_step::Problem;

use super::damped_step::{Curvature, Linear, Valley, LEAST_DAMPING};
use crate::error::{check_length, Error, Result};

/// Damping of the first step: near Gauss–Newton's, yet safe where a start is some tens of percent off.
const FIRST_DAMPING: f64 = 1e-3;
/// Damping beyond which a step is shorter than rounding.
const LARGEST_DAMPING: f64 = 1e12;
/// A step as good as its prediction lowers the damping by this factor, a rejected one raises it by as much.
const FACTOR: f64 = 10.0;
/// Share of the predicted fall of the cost that a step reaches whose damping is right.
const FAIR: f64 = 0.25;
/// Residuals that are differences of signals carry rounding of this share of them at most, once no step lowers the cost.
const ROUNDING: f64 = 1e-10;

/// Where the search for the optimum ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// The gradient is zero, but for what pushes out of a bound and for rounding.
    Converged,
    /// The last allowed evaluation still moved.
    Exhausted,
    /// No step lowers the cost although the gradient is not zero.
    Stalled,
    /// The way down leads where the problem has no value, or none that may be trusted.
    Wall,
}

/// How long to search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Most evaluations of the residuals; 0 for those of the start without their derivatives.
    pub evaluations: usize,
    /// Share of the cost by which a Gauss–Newton step lowers it at a minimum, and so the square of the gradient's cosine.
    pub tolerance: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { evaluations: 100, tolerance: 1e-10 }
    }
}

/// A minimum, or where the search for it ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Minimum<P, E> {
    /// The best point.
    pub point: P,
    /// Its evaluation.
    pub evaluation: E,
    /// Half the sum of squared residuals.
    pub cost: f64,
    /// Derivatives of the residuals there, one column a parameter; none where only residuals were asked for.
    pub jacobian: Vec<Vec<f64>>,
    /// Evaluations of residuals.
    pub evaluations: usize,
    /// How it ended.
    pub status: Status,
}

/// Half the sum of squares.
fn cost(residuals: &[f64]) -> f64 {
    0.5 * residuals.iter().map(|e| e * e).sum::<f64>()
}

/// Minimises half the sum of squared residuals from a start. An evaluation costs what the problem says, a step O(k² N)
/// for k parameters and N residuals.
///
/// # Errors
/// As the problem's own at the start; [`Error::Length`] for columns of the Jacobian that do not match the residuals.
///
/// ```
/// use ftlm::error::Result;
/// use ftlm::estimation::optimization::levenberg_marquardt::{minimise, Settings};
/// use ftlm::estimation::optimization::damped_step::Problem;
///
/// /// x² − 2.
/// struct Root;
///
/// impl Problem for Root {
///     type Point = f64;
///     type Evaluation = [f64; 1];
///     fn evaluate(&self, x: &f64) -> Result<[f64; 1]> {
///         Ok([x * x - 2.0])
///     }
///     fn residuals<'a>(&self, evaluation: &'a [f64; 1]) -> &'a [f64] {
///         evaluation
///     }
///     fn jacobian(&self, x: &f64, _: &[f64; 1]) -> Result<Vec<Vec<f64>>> {
///         Ok(vec![vec![2.0 * x]])
///     }
///     fn moved(&self, x: &f64, steps: &[f64]) -> (f64, f64) {
///         (x + steps[0], steps[0].abs())
///     }
/// }
///
/// # fn main() -> Result<()> {
/// let found = minimise(&Root, 1.0, Settings::default())?;
/// assert!((found.point - 2.0_f64.sqrt()).abs() < 1e-9);
/// # Ok(())
/// # }
/// ```
pub fn minimise<P: Problem>(
    problem: &P,
    start: P::Point,
    settings: Settings,
) -> Result<Minimum<P::Point, P::Evaluation>> {
    let mut search = Search { problem, settings, evaluations: 1, gain: f64::INFINITY, hit: false, corners: false };
    let mut at = search.start(start)?;
    if settings.evaluations == 0 {
        return Ok(at.ended(1, Status::Exhausted));
    }
    at.jacobian = search.slopes(&at.point, &at.evaluation)?;
    let mut valley = Valley::new();
    loop {
        let ended = match search.advance(&mut at)? {
            Advance::Moved(step, gain) => {
                valley.moved(&step, gain);
                None
            }
            Advance::Ended(status) => Some(status),
        };
        if let Some(before) = valley.outcome(at.cost, search.evaluations, ended.is_some()) {
            at = before;
            search.anew();
            continue;
        }
        if let Some(status) = ended {
            return Ok(at.ended(search.evaluations, status));
        }
        let left = if problem.leaps() { settings.evaluations - search.evaluations } else { 0 };
        if let Some(leap) = valley.leap(left) {
            if let Some(there) = search.landed(&at, &leap)? {
                let from = at.cost;
                valley.left(std::mem::replace(&mut at, there), from, search.evaluations);
                search.anew();
            } else {
                valley.fell();
            }
        }
    }
}

/// A point with all that the next step from it is made of.
struct At<P: Problem> {
    point: P::Point,
    evaluation: P::Evaluation,
    cost: f64,
    jacobian: Vec<Vec<f64>>,
    trusted: bool,
    damping: f64,
    curvature: Curvature,
    /// The last step in coordinates, and the gradient before it.
    before: Option<(Vec<f64>, Vec<f64>)>,
}

impl<P: Problem> At<P> {
    fn ended(self, evaluations: usize, status: Status) -> Minimum<P::Point, P::Evaluation> {
        let Self { point, evaluation, cost, jacobian, .. } = self;
        Minimum { point, evaluation, cost, jacobian, evaluations, status }
    }
}

/// What one step came to: its coordinates and the share of the cost that fell, or the end.
enum Advance {
    Moved(Vec<f64>, f64),
    Ended(Status),
}

/// What a search knows beside where it is.
struct Search<'a, P> {
    problem: &'a P,
    settings: Settings,
    evaluations: usize,
    /// Share of the cost by which the last step lowered it.
    gain: f64,
    /// Whether the last step that was tried led where there is no value.
    hit: bool,
    /// Whether parameters stay that have corners.
    corners: bool,
}

impl<P: Problem> Search<'_, P> {
    fn slopes(&self, point: &P::Point, evaluation: &P::Evaluation) -> Result<Vec<Vec<f64>>> {
        let jacobian = self.problem.jacobian(point, evaluation)?;
        let rows = self.problem.residuals(evaluation).len();
        jacobian.iter().try_for_each(|column| check_length("column of the Jacobian", rows, column.len()))?;
        Ok(jacobian)
    }

    /// The start, without its derivatives.
    fn start(&self, start: P::Point) -> Result<At<P>> {
        let evaluation = self.problem.evaluate(&start)?;
        let point = self.problem.settled(&evaluation, start);
        let (cost, trusted) = (cost(self.problem.residuals(&evaluation)), self.problem.trusted(&point));
        let (damping, curvature) = (FIRST_DAMPING, Curvature::new(0));
        Ok(At { point, evaluation, cost, jacobian: Vec::new(), trusted, damping, curvature, before: None })
    }

    /// Forgets how the last steps went.
    fn anew(&mut self) {
        (self.gain, self.hit) = (f64::INFINITY, false);
    }

    /// Where a leap leads, in coordinates; none where the problem has no value or none that may be trusted.
    fn landed(&mut self, from: &At<P>, leap: &[f64]) -> Result<Option<At<P>>> {
        let next = self.problem.moved(&from.point, leap).0;
        self.evaluations += 1;
        let made = self.start(next).and_then(|mut there| {
            there.jacobian = self.slopes(&there.point, &there.evaluation)?;
            Ok(there)
        });
        match made {
            Ok(there) if there.cost.is_finite() && (there.trusted || !from.trusted) => Ok(Some(there)),
            Ok(_) | Err(Error::Diverged { .. } | Error::LeadingZero { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// One step that lowers the cost, or why there is none.
    fn advance(&mut self, at: &mut At<P>) -> Result<Advance> {
        let (problem, settings) = (self.problem, self.settings);
        // The gradient's cosine at a minimum: its square is a share of the cost.
        let flat = settings.tolerance.max(f64::EPSILON).sqrt();
        loop {
            if self.evaluations >= settings.evaluations {
                return Ok(Advance::Ended(Status::Exhausted));
            }
            let linear = Linear::at(problem, &at.point, &at.jacobian, problem.residuals(&at.evaluation), self.corners);
            if at.curvature.is_for(at.jacobian.len()) {
                if let Some((taken, gradient)) = at.before.take() {
                    let now = linear.gradient_by_parameter();
                    let change: Vec<f64> = now.iter().zip(&gradient).map(|(a, b)| a - b).collect();
                    at.curvature.learn(&taken, &change, &linear.columns_along(&taken));
                }
            } else {
                at.curvature = Curvature::new(at.jacobian.len());
            }
            let slope = linear.slope();
            let level = slope <= flat * linear.norm;
            let (newton, falls) = linear.step(LEAST_DAMPING);
            let nowhere = problem.moved(&at.point, &linear.unscaled(&newton)).1 <= settings.tolerance;
            // A flat gradient along a valley may still have far to go: a whole step says so, unless none has led anywhere.
            if nowhere || (level && (falls <= settings.tolerance || self.gain <= settings.tolerance)) {
                return Ok(Advance::Ended(Status::Converged));
            }
            if self.gain <= settings.tolerance && self.hit {
                return Ok(Advance::Ended(Status::Wall));
            }
            self.hit = false;
            match self.lowered(at, &linear, (slope, level))? {
                Some(advance) => return Ok(advance),
                // What has corners stays, and the rest goes on.
                None => (self.corners, at.damping, self.gain) = (true, FIRST_DAMPING, f64::INFINITY),
            }
        }
    }

    /// Steps ever shorter until one lowers the cost; none where parameters with corners are to stay first.
    fn lowered(&mut self, at: &mut At<P>, linear: &Linear, (slope, level): (f64, bool)) -> Result<Option<Advance>> {
        let (problem, settings) = (self.problem, self.settings);
        loop {
            let curved = if at.curvature.used { linear.curved_step(at.damping, &at.curvature) } else { None };
            if at.curvature.used && curved.is_none() && at.damping <= LARGEST_DAMPING {
                at.damping *= FACTOR;
                continue;
            }
            let first = if curved.is_some() { linear.projected } else { 0 };
            let (step, falls) = curved.unwrap_or_else(|| linear.step(at.damping));
            let steps = linear.unscaled(&step);
            let (next, moved) = problem.moved(&at.point, &steps);
            if moved <= settings.tolerance || at.damping > LARGEST_DAMPING {
                // No step lowers the cost any more: at its bottom, for rounding, at a wall or at a corner.
                return Ok(if level || slope <= ROUNDING * problem.size(&at.evaluation) {
                    Some(Advance::Ended(Status::Converged))
                } else if self.hit {
                    Some(Advance::Ended(Status::Wall))
                } else if !self.corners && (0..linear.scales.len()).any(|i| problem.kinked(&at.point, i)) {
                    None
                } else {
                    Some(Advance::Ended(Status::Stalled))
                });
            }
            if self.evaluations >= settings.evaluations {
                return Ok(Some(Advance::Ended(Status::Exhausted)));
            }
            self.evaluations += 1;
            let trusts = problem.trusted(&next);
            // A step that lowers nothing, or leaves the numbers, is shortened.
            let tried = problem.evaluate(&next).and_then(|found| {
                let reached = cost(problem.residuals(&found));
                if !reached.is_finite() || (at.trusted && !trusts) {
                    return Err(Error::Diverged { what: "step".into(), index: 0 });
                }
                if reached >= at.cost {
                    return Ok(None);
                }
                let settled = problem.settled(&found, next.clone());
                Ok(Some((self.slopes(&settled, &found)?, found, reached, settled)))
            });
            match tried {
                Ok(Some((slopes, found, reached, next))) => {
                    self.gain = (at.cost - reached) / at.cost.max(f64::MIN_POSITIVE);
                    (at.point, at.evaluation, at.cost, at.jacobian, at.trusted) =
                        (next, found, reached, slopes, trusts);
                    let told = linear.falls(&step, first);
                    at.curvature.judge(told, told - linear.bent(&step, &at.curvature), self.gain);
                    at.before = Some((steps.clone(), linear.gradient_by_parameter()));
                    if self.gain >= FAIR * falls {
                        at.damping = (at.damping / FACTOR).max(LEAST_DAMPING);
                    }
                    return Ok(Some(Advance::Moved(steps, self.gain)));
                }
                Ok(None) => self.hit = false,
                Err(Error::Diverged { .. } | Error::LeadingZero { .. }) => self.hit = true,
                Err(error) => return Err(error),
            }
            at.damping *= FACTOR;
        }
    }
}

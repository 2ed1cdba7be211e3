//! Nonlinear least squares by Levenberg–Marquardt, for any problem that can say its residuals and their derivatives.
//!
//! Columns are scaled by the Jacobian's norms, steps follow from a QR factor of [J | e] with the damping below it, and a
//! rejected step costs no Jacobian. A problem says itself how a point moves: in which coordinates, and within which bounds.
//! What stands on a bound and is pushed out of it is left out of step and gradient, so that the rest moves on.
//!
//! Where Gauss–Newton foretells the fall of the cost badly, what it leaves out is learnt (`curvature`); along a valley
//! the search leaps (`valley`).
//!
//! A minimum is where the gradient vanishes, and nothing else is called one: the cosine between the residuals and every
//! column that is free to move, the relative offset of Dennis & Schnabel (doi:10.1137/1.9781611971200, §7.2) and MINPACK.

use super::curvature::Curvature;
use super::valley::Valley;
use crate::dense;
use crate::error::{check_length, Error, Result};
use crate::small::{self, back_substitute};

/// Damping of the first step: near Gauss–Newton's, yet safe where a start is some tens of percent off.
const FIRST_DAMPING: f64 = 1e-3;
/// Least damping: below it the factor's rounding damps more.
const LEAST_DAMPING: f64 = 1e-12;
/// Damping beyond which a step is shorter than rounding.
const LARGEST_DAMPING: f64 = 1e12;
/// A step as good as its prediction lowers the damping by this factor, a rejected one raises it by as much.
const FACTOR: f64 = 10.0;
/// Share of the predicted fall of the cost that a step reaches whose damping is right.
const FAIR: f64 = 0.25;
/// Residuals that are differences of signals carry rounding of this share of them at most, once no step lowers the cost.
const ROUNDING: f64 = 1e-10;

/// A sum of squares to minimise.
pub trait Problem {
    /// What the residuals depend on.
    type Point: Clone;
    /// Residuals at a point, with whatever their derivatives there need.
    type Evaluation;

    /// Evaluates a point. [`Error::Diverged`] and [`Error::LeadingZero`] mean that a step went too far: it is shortened.
    ///
    /// # Errors
    /// Any other error ends the search.
    fn evaluate(&self, point: &Self::Point) -> Result<Self::Evaluation>;

    /// The residuals of an evaluation.
    fn residuals<'a>(&self, evaluation: &'a Self::Evaluation) -> &'a [f64];

    /// Derivatives of the residuals with respect to every parameter, one column each.
    ///
    /// # Errors
    /// As [`Problem::evaluate`]; [`Error::Diverged`] counts as a step too far.
    fn jacobian(&self, point: &Self::Point, evaluation: &Self::Evaluation) -> Result<Vec<Vec<f64>>>;

    /// The point moved by steps in the parameters' coordinates, within its bounds, and the largest relative move.
    fn moved(&self, point: &Self::Point, steps: &[f64]) -> (Self::Point, f64);

    /// The point to which an evaluation belongs, where it solved for parameters in which the residuals are linear.
    fn settled(&self, _evaluation: &Self::Evaluation, point: Self::Point) -> Self::Point {
        point
    }

    /// Whether every evaluation solves for a parameter: its steps need no damping.
    fn projected(&self, _parameter: usize) -> bool {
        false
    }

    /// Derivative of a parameter with respect to the coordinate in which it is stepped.
    fn stretch(&self, _point: &Self::Point, _parameter: usize) -> f64 {
        1.0
    }

    /// Other parameters that move with a parameter's coordinate, and how much.
    fn carried(&self, _point: &Self::Point, _parameter: usize) -> Vec<(usize, f64)> {
        Vec::new()
    }

    /// How far a parameter may move down and up in its coordinate before it stands on a bound.
    fn room(&self, _point: &Self::Point, _parameter: usize) -> (f64, f64) {
        (f64::INFINITY, f64::INFINITY)
    }

    /// Whether the cost may have corners along a parameter: a minimum there has no slope.
    fn kinked(&self, _point: &Self::Point, _parameter: usize) -> bool {
        false
    }

    /// Norm of what the residuals are differences of, which bounds their rounding.
    fn size(&self, _evaluation: &Self::Evaluation) -> f64 {
        0.0
    }

    /// Whether a point may be trusted: from one that may, no step leads to one that may not.
    fn trusted(&self, _point: &Self::Point) -> bool {
        true
    }
}

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

/// The linear problem at a point: R of [J | e] with J in coordinates and unit columns, and what may move. What every
/// evaluation solves for comes first, so that the lower part of R belongs to the rest with that projected out.
struct Linear {
    r: Vec<f64>,
    /// The parameter at each place.
    order: Vec<usize>,
    /// Length of a coordinate's unit in scaled steps, 0 where nothing moves with it.
    scales: Vec<f64>,
    /// Products of the unit columns with the residuals.
    gradient: Vec<f64>,
    /// Distances from the bounds, in scaled steps.
    room: Vec<(f64, f64)>,
    /// What is left out of the steps.
    held: Vec<bool>,
    /// How many every evaluation solves for.
    projected: usize,
    /// Norm of the residuals.
    norm: f64,
}

impl Linear {
    fn at<P: Problem>(problem: &P, point: &P::Point, jacobian: &[Vec<f64>], residuals: &[f64], corners: bool) -> Self {
        let (mut order, rest): (Vec<usize>, Vec<usize>) = (0..jacobian.len()).partition(|&i| problem.projected(i));
        let projected = order.len();
        order.extend(rest);
        let mut columns = Vec::with_capacity(jacobian.len() + 1);
        let mut scales = Vec::with_capacity(jacobian.len());
        for &i in &order {
            let factor = problem.stretch(point, i);
            let mut column: Vec<f64> = jacobian[i].iter().map(|v| v * factor).collect();
            for (other, slope) in problem.carried(point, i) {
                column.iter_mut().zip(&jacobian[other]).for_each(|(v, w)| *v += slope * w);
            }
            let norm = column.iter().map(|v| v * v).sum::<f64>().sqrt();
            let scale = if norm > 0.0 { 1.0 / norm } else { 0.0 };
            column.iter_mut().for_each(|v| *v *= scale);
            columns.push(column);
            scales.push(norm);
        }
        let gradient: Vec<f64> = columns.iter().map(|c| c.iter().zip(residuals).map(|(j, e)| j * e).sum()).collect();
        columns.push(residuals.to_vec());
        let scaled = |(down, up): (f64, f64), scale: f64| (down * scale, up * scale);
        let room: Vec<(f64, f64)> =
            order.iter().zip(&scales).map(|(&i, &scale)| scaled(problem.room(point, i), scale)).collect();
        let held = (room.iter().zip(&gradient).enumerate())
            .map(|(place, (&(down, up), &g))| {
                let out = if g > 0.0 { down <= 0.0 } else { up <= 0.0 };
                out || scales[place] <= 0.0 || (corners && problem.kinked(point, order[place]))
            })
            .collect();
        let norm = residuals.iter().map(|e| e * e).sum::<f64>().sqrt();
        Self { r: dense::triangular_factor(&columns), order, scales, gradient, room, held, projected, norm }
    }

    /// Largest component of the gradient along what is free to move.
    fn slope(&self) -> f64 {
        self.gradient.iter().zip(&self.held).filter(|(_, held)| !**held).fold(0.0, |a, (g, _)| a.max(g.abs()))
    }

    /// Minimises ‖J s + e‖² + λ‖s‖² over what is free and within its bounds, and the share of the cost that falls.
    fn step(&self, damping: f64) -> (Vec<f64>, f64) {
        let step = self.within(|held| Some(damped_step(&self.r, held, self.projected, damping))).unwrap_or_default();
        let falls = self.falls(&step, 0);
        (step, falls)
    }

    /// The same with a learnt curvature, what every evaluation solves for left to it; none where that has no minimum.
    fn curved_step(&self, damping: f64, curvature: &Curvature) -> Option<(Vec<f64>, f64)> {
        let step = self.within(|held| self.curved(held, damping, curvature))?;
        let falls = self.falls(&step, self.projected) - self.bent(&step, curvature);
        Some((step, falls))
    }

    /// Share of the cost that a learnt curvature adds along a scaled step.
    fn bent(&self, step: &[f64], curvature: &Curvature) -> f64 {
        curvature.along(&self.unscaled(step)) / (self.norm * self.norm).max(f64::MIN_POSITIVE)
    }

    /// A step of what is free that pushes nothing out of its bounds.
    fn within(&self, step_of: impl Fn(&[bool]) -> Option<Vec<f64>>) -> Option<Vec<f64>> {
        let mut held = self.held.clone();
        let mut step = loop {
            let step = step_of(&held)?;
            let out = (0..step.len()).find(|&i| {
                let (down, up) = self.room[i];
                !held[i] && ((step[i] < 0.0 && down <= 0.0) || (step[i] > 0.0 && up <= 0.0))
            });
            match out {
                Some(i) => held[i] = true,
                None => break step,
            }
        };
        step.iter_mut().zip(&self.room).for_each(|(s, &(down, up))| *s = s.max(-down.max(0.0)).min(up.max(0.0)));
        Some(step)
    }

    /// Share of the cost that falls along a step as the columns say, those before `first` projected out.
    fn falls(&self, step: &[f64], first: usize) -> f64 {
        let k = step.len();
        let image = |i: usize| (i..k).map(|j| self.r[i * (k + 1) + j] * step[j]).sum::<f64>();
        let (moved, along) = (first..k)
            .map(|i| (image(i), self.r[i * (k + 1) + k]))
            .fold((0.0, 0.0), |(a, b), (v, e)| (a + v * v, b + v * e));
        (-2.0 * along - moved) / (self.norm * self.norm).max(f64::MIN_POSITIVE)
    }

    /// JᵀJ s in coordinates for a step in coordinates, by parameter, what every evaluation solves for projected out.
    fn columns_along(&self, step: &[f64]) -> Vec<f64> {
        let k = self.scales.len();
        let scaled: Vec<f64> = self.order.iter().zip(&self.scales).map(|(&i, scale)| step[i] * scale).collect();
        let images: Vec<f64> = (0..k)
            .map(|i| {
                let image = (i.max(self.projected)..k).map(|j| self.r[i * (k + 1) + j] * scaled[j]).sum::<f64>();
                if i < self.projected {
                    0.0
                } else {
                    image
                }
            })
            .collect();
        let mut out = vec![0.0; k];
        for (place, (&i, scale)) in self.order.iter().zip(&self.scales).enumerate().skip(self.projected) {
            out[i] = scale * (0..=place).map(|l| self.r[l * (k + 1) + place] * images[l]).sum::<f64>();
        }
        out
    }

    /// Gradient in coordinates, by parameter; 0 of what every evaluation solves for.
    fn gradient_by_parameter(&self) -> Vec<f64> {
        let mut out = vec![0.0; self.scales.len()];
        for (place, &i) in self.order.iter().enumerate().skip(self.projected) {
            out[i] = self.gradient[place] * self.scales[place];
        }
        out
    }

    /// Minimises the cost with a learnt curvature and damping; none where it is no minimum.
    fn curved(&self, held: &[bool], damping: f64, curvature: &Curvature) -> Option<Vec<f64>> {
        let k = held.len();
        let free: Vec<usize> = (self.projected..k).filter(|&i| !held[i]).collect();
        let count = free.len();
        let product = |i: usize, j: usize| {
            let last = i.min(j);
            (self.projected..=last).map(|l| self.r[l * (k + 1) + i] * self.r[l * (k + 1) + j]).sum::<f64>()
        };
        let mut matrix = vec![0.0; count * count];
        let mut target = vec![0.0; count];
        for (a, &i) in free.iter().enumerate() {
            for (b, &j) in free.iter().enumerate() {
                let learnt = curvature.at(self.order[i], self.order[j]) / (self.scales[i] * self.scales[j]);
                matrix[a * count + b] = product(i, j) + learnt + if a == b { damping } else { 0.0 };
            }
            target[a] = -(self.projected..=i).map(|l| self.r[l * (k + 1) + i] * self.r[l * (k + 1) + k]).sum::<f64>();
        }
        let solved = small::positive_solve(&matrix, &target)?;
        let mut step = vec![0.0; k];
        free.iter().zip(solved).for_each(|(&i, s)| step[i] = s);
        Some(step)
    }

    /// A scaled step in the parameters' coordinates, by parameter.
    fn unscaled(&self, step: &[f64]) -> Vec<f64> {
        let mut out = vec![0.0; step.len()];
        for ((&i, s), scale) in self.order.iter().zip(step).zip(&self.scales) {
            out[i] = if *scale > 0.0 { s / scale } else { 0.0 };
        }
        out
    }
}

/// Minimises ‖R s + e‖² + λ‖s‖² for the triangular factor of [J | e], with 0 for what is held; what is projected is hardly
/// damped.
fn damped_step(r: &[f64], held: &[bool], projected: usize, damping: f64) -> Vec<f64> {
    let (k, free) = (held.len(), (0..held.len()).filter(|&j| !held[j]).collect::<Vec<_>>());
    if free.is_empty() {
        return vec![0.0; k];
    }
    let mut columns: Vec<Vec<f64>> = free
        .iter()
        .enumerate()
        .map(|(at, &j)| {
            let mut column = vec![0.0; k + free.len()];
            for (i, value) in column.iter_mut().enumerate().take(j + 1) {
                *value = r[i * (k + 1) + j];
            }
            column[k + at] = if j < projected { LEAST_DAMPING } else { damping }.sqrt();
            column
        })
        .collect();
    let mut target = vec![0.0; k + free.len()];
    for (i, value) in target.iter_mut().take(k).enumerate() {
        *value = -r[i * (k + 1) + k];
    }
    columns.push(target);
    let q = dense::triangular_factor(&columns);
    let stride = free.len() + 1;
    let rhs: Vec<f64> = (0..free.len()).map(|i| q[i * stride + free.len()]).collect();
    let mut step = vec![0.0; k];
    free.iter().zip(back_substitute(&q, stride, &rhs)).for_each(|(&j, s)| step[j] = s);
    step
}

/// Minimises half the sum of squared residuals from a start. An evaluation costs what the problem says, a step O(k² N)
/// for k parameters and N residuals.
///
/// # Errors
/// As the problem's own at the start; [`Error::Length`] for columns of the Jacobian that do not match the residuals.
///
/// ```
/// use ftlm::error::Result;
/// use ftlm::estimate::output_error::levenberg_marquardt::{minimise, Problem, Settings};
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
        if let Some(before) = valley.outcome(&at, search.evaluations, ended.is_some()) {
            at = before;
            search.anew();
            continue;
        }
        if let Some(status) = ended {
            return Ok(at.ended(search.evaluations, status));
        }
        if let Some(leap) = valley.leap(settings.evaluations - search.evaluations) {
            if let Some(there) = search.landed(&at, &leap)? {
                valley.left(std::mem::replace(&mut at, there), search.evaluations);
                search.anew();
            } else {
                valley.fell();
            }
        }
    }
}

/// A point with all that the next step from it is made of.
pub(super) struct At<P: Problem> {
    point: P::Point,
    evaluation: P::Evaluation,
    pub(super) cost: f64,
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

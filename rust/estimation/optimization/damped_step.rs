//! The linear problem at a point of a search, and its steps: damped, within bounds, with a learnt curvature or without.
//!
//! What a sum of squares must say of itself to be minimised.
//!
//! What Gauss–Newton leaves out of the curvature of a sum of squares: Σ e ∇²e, learnt from the steps that were taken.
//!
//! Where a model leaves out a part of a machine its residuals stay large, and along a valley their own curvature is as
//! large as that of the columns: Gauss–Newton then creeps. The secant updates of Dennis, Gay & Welsch (NL2SOL,
//! doi:10.1145/355958.355965) cost no evaluation, and are used only where they foretell the cost better.
//!
//! Leaps along the bottom of a curved valley, where steps that lower the cost are short beside the way that is left.
//!
//! Numbers that data hardly tell apart make a valley that bends: steps follow its bottom one short chord after another, all
//! in one direction. What they came to together is repeated a few times over in one leap, from the end of which ordinary
//! steps lead down to the bottom again; where they do not soon end below the point that was left, the search goes on there.

use crate::error::Result;
use crate::linalg::dense;
use crate::linalg::orthogonal::norm;
use crate::linalg::small::{self, back_substitute};

/// Least damping: below it the factor's rounding damps more.
pub(crate) const LEAST_DAMPING: f64 = 1e-12;

/// The linear problem at a point: R of [J | e] with J in coordinates and unit columns, and what may move. What every
/// evaluation solves for comes first, so that the lower part of R belongs to the rest with that projected out.
pub(crate) struct Linear {
    r: Vec<f64>,
    /// The parameter at each place.
    order: Vec<usize>,
    /// Length of a coordinate's unit in scaled steps, 0 where nothing moves with it.
    pub(crate) scales: Vec<f64>,
    /// Products of the unit columns with the residuals.
    gradient: Vec<f64>,
    /// Distances from the bounds, in scaled steps.
    room: Vec<(f64, f64)>,
    /// What is left out of the steps.
    held: Vec<bool>,
    /// How many every evaluation solves for.
    pub(crate) projected: usize,
    /// Norm of the residuals.
    pub(crate) norm: f64,
}

impl Linear {
    pub(crate) fn at<P: Problem>(
        problem: &P,
        point: &P::Point,
        jacobian: &[Vec<f64>],
        residuals: &[f64],
        corners: bool,
    ) -> Self {
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
            let size = norm(&column);
            let scale = if size > 0.0 { 1.0 / size } else { 0.0 };
            column.iter_mut().for_each(|v| *v *= scale);
            columns.push(column);
            scales.push(size);
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
        Self {
            r: dense::triangular_factor(&columns),
            order,
            scales,
            gradient,
            room,
            held,
            projected,
            norm: norm(residuals),
        }
    }

    /// Largest component of the gradient along what is free to move.
    pub(crate) fn slope(&self) -> f64 {
        self.gradient.iter().zip(&self.held).filter(|(_, held)| !**held).fold(0.0, |a, (g, _)| a.max(g.abs()))
    }

    /// Minimises ‖J s + e‖² + λ‖s‖² over what is free and within its bounds, and the share of the cost that falls.
    pub(crate) fn step(&self, damping: f64) -> (Vec<f64>, f64) {
        let step = self.within(|held| Some(damped_step(&self.r, held, self.projected, damping))).unwrap_or_default();
        let falls = self.falls(&step, 0);
        (step, falls)
    }

    /// The same with a learnt curvature, what every evaluation solves for left to it; none where that has no minimum.
    pub(crate) fn curved_step(&self, damping: f64, curvature: &Curvature) -> Option<(Vec<f64>, f64)> {
        let step = self.within(|held| self.curved(held, damping, curvature))?;
        let falls = self.falls(&step, self.projected) - self.bent(&step, curvature);
        Some((step, falls))
    }

    /// Share of the cost that a learnt curvature adds along a scaled step.
    pub(crate) fn bent(&self, step: &[f64], curvature: &Curvature) -> f64 {
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
    pub(crate) fn falls(&self, step: &[f64], first: usize) -> f64 {
        let k = step.len();
        let image = |i: usize| (i..k).map(|j| self.r[i * (k + 1) + j] * step[j]).sum::<f64>();
        let (moved, along) = (first..k)
            .map(|i| (image(i), self.r[i * (k + 1) + k]))
            .fold((0.0, 0.0), |(a, b), (v, e)| (a + v * v, b + v * e));
        (-2.0 * along - moved) / (self.norm * self.norm).max(f64::MIN_POSITIVE)
    }

    /// JᵀJ s in coordinates for a step in coordinates, by parameter, what every evaluation solves for projected out.
    pub(crate) fn columns_along(&self, step: &[f64]) -> Vec<f64> {
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
    pub(crate) fn gradient_by_parameter(&self) -> Vec<f64> {
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
    pub(crate) fn unscaled(&self, step: &[f64]) -> Vec<f64> {
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

/// A sum of squares to minimise.
pub trait Problem {
    /// What the residuals depend on.
    type Point: Clone;
    /// Residuals at a point, with whatever their derivatives there need.
    type Evaluation;

    /// Evaluates a point. [`crate::error::Error::Diverged`] and [`crate::error::Error::LeadingZero`] mean that a step went too far: it is shortened.
    ///
    /// # Errors
    /// Any other error ends the search.
    fn evaluate(&self, point: &Self::Point) -> Result<Self::Evaluation>;

    /// The residuals of an evaluation.
    fn residuals<'a>(&self, evaluation: &'a Self::Evaluation) -> &'a [f64];

    /// Derivatives of the residuals with respect to every parameter, one column each.
    ///
    /// # Errors
    /// As [`Problem::evaluate`]; [`crate::error::Error::Diverged`] counts as a step too far.
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

    /// Whether a search may leap along valleys: not where many starts are to find an optimum each, which a leap may pass.
    fn leaps(&self) -> bool {
        true
    }
}
/// A model must be better by this factor at the last step to be taken for the next one.
const BETTER: f64 = 1.5;
/// Predictions closer to the truth than this share of the fall are both right.
const RIGHT: f64 = 0.1;

/// The learnt matrix, in the coordinates of the steps, and whether it is used.
pub(crate) struct Curvature {
    count: usize,
    matrix: Vec<f64>,
    learnt: bool,
    pub(crate) used: bool,
}

impl Curvature {
    /// Nothing known of so many parameters.
    pub(crate) fn new(count: usize) -> Self {
        Self { count, matrix: vec![0.0; count * count], learnt: false, used: false }
    }

    /// Whether it is of so many parameters.
    pub(crate) fn is_for(&self, count: usize) -> bool {
        self.count == count
    }

    /// An element of the matrix.
    pub(crate) fn at(&self, i: usize, j: usize) -> f64 {
        self.matrix[i * self.count + j]
    }

    fn times(&self, step: &[f64]) -> Vec<f64> {
        self.matrix.chunks_exact(self.count.max(1)).map(|row| row.iter().zip(step).map(|(a, s)| a * s).sum()).collect()
    }

    /// Its share of the second-order change of twice the cost along a step.
    pub(crate) fn along(&self, step: &[f64]) -> f64 {
        self.times(step).iter().zip(step).map(|(a, s)| a * s).sum()
    }

    /// Compares what was foretold without the matrix, and with it, with the fall of the cost.
    pub(crate) fn judge(&mut self, without: f64, with: f64, fall: f64) {
        let (missed, missed_with) = ((without - fall).abs(), (with - fall).abs());
        if self.used {
            self.used = missed_with <= BETTER * missed;
        } else {
            self.used = self.learnt && missed > RIGHT * fall.abs() && BETTER * missed_with < missed;
        }
    }

    /// Learns from a step after which the gradient had changed by `change`, of which `columns` is what the columns say.
    pub(crate) fn learn(&mut self, step: &[f64], change: &[f64], columns: &[f64]) {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        let wanted: Vec<f64> = change.iter().zip(columns).map(|(y, c)| y - c).collect();
        let scale = dot(change, step);
        let size = dot(step, step).sqrt() * dot(change, change).sqrt();
        if !(scale.is_finite() && scale.abs() > 1e-6 * size && size > 0.0) {
            return;
        }
        // What was learnt elsewhere counts no more than what is seen here.
        let before = self.along(step);
        let sizing = if before == 0.0 { 1.0 } else { (dot(step, &wanted) / before).abs().min(1.0) };
        self.matrix.iter_mut().for_each(|v| *v *= sizing);
        let missing: Vec<f64> = wanted.iter().zip(self.times(step)).map(|(w, s)| w - s).collect();
        let twice = dot(&missing, step) / (scale * scale);
        for i in 0..self.count {
            for j in 0..self.count {
                self.matrix[i * self.count + j] +=
                    (missing[i] * change[j] + change[i] * missing[j]) / scale - twice * change[i] * change[j];
            }
        }
        self.learnt = self.matrix.iter().all(|v| v.is_finite());
        if !self.learnt {
            *self = Self::new(self.count);
        }
    }
}
/// Steps on which a leap is founded.
const STEPS: usize = 4;
/// Of the length of these steps the share that their sum has at least: else they lead nowhere together.
const STRAIGHT: f64 = 0.8;
/// Share of the cost that a step lowers at most: who gets on needs no leap.
const CREEPS: f64 = 1e-3;
/// Evaluations within which a leap must come to something.
const PATIENCE: usize = 6;
/// How often the sum of the steps is repeated, at first and at most.
const REACH: f64 = 2.0;
const FARTHEST: f64 = 16.0;

/// The last steps of a search, and the point that it left by a leap.
pub(crate) struct Valley<P> {
    steps: Vec<Vec<f64>>,
    reach: f64,
    /// Where it leapt from, what it cost there, and after how many evaluations.
    left: Option<(P, f64, usize)>,
}

impl<P> Valley<P> {
    /// Nothing known.
    pub(crate) fn new() -> Self {
        Self { steps: Vec::new(), reach: REACH, left: None }
    }

    /// Takes a step, in coordinates, that lowered the cost by a share of it.
    pub(crate) fn moved(&mut self, step: &[f64], gain: f64) {
        if gain > CREEPS {
            self.steps.clear();
        } else {
            self.steps.push(step.to_vec());
        }
    }

    /// The leap that the last steps ask for, if that many evaluations are left for it.
    pub(crate) fn leap(&mut self, evaluations: usize) -> Option<Vec<f64>> {
        if self.left.is_some() || self.steps.len() < STEPS || evaluations <= PATIENCE {
            return None;
        }
        let last = self.steps.split_off(self.steps.len() - STEPS);
        self.steps.clear();
        let norm = |v: &[f64]| v.iter().map(|s| s * s).sum::<f64>().sqrt();
        let sum: Vec<f64> = (0..last[0].len()).map(|i| last.iter().map(|step| step[i]).sum()).collect();
        let straight = norm(&sum) >= STRAIGHT * last.iter().map(|step| norm(step)).sum::<f64>();
        straight.then(|| sum.iter().map(|s| self.reach * s).collect())
    }

    /// The search leapt from this point, at this cost.
    pub(crate) fn left(&mut self, from: P, cost: f64, evaluations: usize) {
        self.left = Some((from, cost, evaluations));
    }

    /// A leap led nowhere.
    pub(crate) fn fell(&mut self) {
        self.reach = (0.5 * self.reach).max(1.0);
        self.steps.clear();
    }

    /// The point that was left, where the leap from it has come to nothing; a search that ends has no time left.
    pub(crate) fn outcome(&mut self, cost: f64, evaluations: usize, ends: bool) -> Option<P> {
        let (from, least, since) = self.left.take()?;
        if cost < least {
            self.reach = (2.0 * self.reach).min(FARTHEST);
            self.steps.clear();
            return None;
        }
        if ends || evaluations >= since + PATIENCE {
            self.fell();
            return Some(from);
        }
        self.left = Some((from, least, since));
        None
    }
}

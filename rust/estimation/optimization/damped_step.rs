//! The linear problem at a point of a search, and its steps: damped, within bounds, with a learnt curvature or without.

use super::curvature::Curvature;
use super::problem::Problem;
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

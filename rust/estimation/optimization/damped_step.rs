//! Steps of a nonlinear least-squares problem: problem trait, damped step, secant curvature, valley extrapolation.
//!
//! J is the Jacobian of the residuals e. With an incomplete model the residuals stay large. In an ill-conditioned
//! valley, the second-order part of the Hessian is then as large as JᵀJ, and Gauss–Newton converges slowly. The secant
//! updates of Dennis, Gay & Welsch (NL2SOL, doi:10.1145/355958.355965) approximate this part without an evaluation.
//! They are used only if they predict the cost better.
//!
//! Poorly determined parameters cause a curved valley, along which successive steps have nearly the same direction. The
//! sum of the last steps is multiplied and tried as one extrapolation step. Ordinary steps follow from there. If they
//! do not soon reach a lower cost, the search returns to the point before the extrapolation.

use std::ops::Range;

use crate::error::Result;
use crate::linalg::dense;
use crate::linalg::orthogonal::norm;
use crate::linalg::small::{self, back_substitute};
use crate::signal::statistics::inner;

/// Minimum damping. Below it, the rounding error of the QR factorization dominates.
pub(crate) const MIN_DAMPING: f64 = 1e-12;
/// Maximum distance from a linear constraint at which the constraint is active.
///
/// The distance is the change of the residuals on the way to the constraint, relative to the norm of the residuals.
const ACTIVE_CONSTRAINT_TOLERANCE: f64 = 1e-9;

/// Linearization of a problem at a point: triangular factor R of the QR factorization of [J | e].
///
/// The columns of the Jacobian J are derivatives with respect to the coordinates, scaled to unit norm. e are the
/// residuals. Eliminated parameters come first. The lower part of R then belongs to the other parameters, with the
/// eliminated ones projected out.
pub(crate) struct LinearizedProblem {
    r: Vec<f64>,
    /// Index of the parameter of each column.
    order: Vec<usize>,
    /// Norm of each column before scaling; 0 for a parameter without effect.
    pub(crate) scales: Vec<f64>,
    /// Dot products of the unit columns with the residuals.
    gradient: Vec<f64>,
    /// Distances from the lower and the upper bound, in scaled steps, by column.
    distance_to_bounds: Vec<(f64, f64)>,
    /// Linear inequality constraints on scaled steps: unit normal, and maximum dot product of the normal with a step.
    constraints: Vec<(Vec<f64>, f64)>,
    /// True for each column whose parameter is excluded from the steps.
    is_fixed: Vec<bool>,
    /// Number of eliminated parameters.
    pub(crate) eliminated_count: usize,
    /// Norm of the residuals.
    pub(crate) norm: f64,
}

impl LinearizedProblem {
    pub(crate) fn at<P: LeastSquaresProblem>(
        problem: &P,
        point: &P::Point,
        jacobian: &[Vec<f64>],
        residuals: &[f64],
        fixes_kinks: bool,
    ) -> Self {
        let (mut order, other_parameters): (Vec<usize>, Vec<usize>) =
            (0..jacobian.len()).partition(|&i| problem.is_eliminated(i));
        let eliminated_count = order.len();
        order.extend(other_parameters);
        // Columns are computed where they are needed, because stored columns would double the memory of the Jacobian.
        let factors: Vec<f64> = order.iter().map(|&i| problem.coordinate_derivative(point, i)).collect();
        let couplings: Vec<_> = order.iter().map(|&i| problem.coupled_derivatives(point, i)).collect();
        let append_column = |column: usize, rows: Range<usize>, out: &mut Vec<f64>| {
            let first = out.len();
            out.extend(jacobian[order[column]][rows.clone()].iter().map(|v| v * factors[column]));
            for (other, slope) in &couplings[column] {
                out[first..].iter_mut().zip(&jacobian[*other][rows.clone()]).for_each(|(v, w)| *v += slope * w);
            }
        };
        let (mut scales, mut gradient) = (Vec::with_capacity(jacobian.len()), Vec::with_capacity(jacobian.len()));
        let (rows, mut buffer) = (residuals.len(), Vec::with_capacity(residuals.len()));
        let inverse_of = |scale: f64| if scale > 0.0 { 1.0 / scale } else { 0.0 };
        for column in 0..jacobian.len() {
            buffer.clear();
            append_column(column, 0..rows, &mut buffer);
            let column_norm = norm(&buffer);
            let scale = inverse_of(column_norm);
            gradient.push(buffer.iter().zip(residuals).map(|(v, e)| (v * scale) * e).sum::<f64>());
            scales.push(column_norm);
        }
        let r = dense::triangular_factor_by_blocks((jacobian.len() + 1, rows), |column, rows, out| {
            let first = out.len();
            match scales.get(column) {
                None => out.extend_from_slice(&residuals[rows]),
                Some(&column_norm) => {
                    append_column(column, rows, out);
                    let scale = inverse_of(column_norm);
                    out[first..].iter_mut().for_each(|v| *v *= scale);
                }
            }
        });
        let scale_distances = |(lower, upper): (f64, f64), scale: f64| (lower * scale, upper * scale);
        let distance_to_bounds: Vec<(f64, f64)> = order
            .iter()
            .zip(&scales)
            .map(|(&i, &scale)| scale_distances(problem.distance_to_bounds(point, i), scale))
            .collect();
        let constraints = (problem.constraints(point).into_iter())
            .map(|(normal, distance)| {
                let unscale = |(&i, &scale): (&usize, &f64)| if scale > 0.0 { normal[i] / scale } else { 0.0 };
                let direction: Vec<f64> = order.iter().zip(&scales).map(unscale).collect();
                let direction_norm = norm(&direction);
                let (direction_norm, distance) = if direction_norm > 0.0 {
                    (direction_norm, distance / direction_norm)
                } else {
                    (1.0, f64::INFINITY)
                };
                (direction.iter().map(|v| v / direction_norm).collect(), distance)
            })
            .collect();
        let is_fixed = (distance_to_bounds.iter().zip(&gradient).enumerate())
            .map(|(column, (&(lower, upper), &g))| {
                let is_blocked = if g > 0.0 { lower <= 0.0 } else { upper <= 0.0 };
                is_blocked || scales[column] <= 0.0 || (fixes_kinks && problem.has_kinks(point, order[column]))
            })
            .collect();
        Self {
            r,
            order,
            scales,
            gradient,
            distance_to_bounds,
            constraints,
            is_fixed,
            eliminated_count,
            norm: norm(residuals),
        }
    }

    /// Largest magnitude of a gradient component of a free parameter, without the parts along active constraints.
    pub(crate) fn max_gradient(&self) -> f64 {
        let mut gradient = self.gradient.clone();
        for (k, multiplier) in self.active_constraints() {
            gradient.iter_mut().zip(&self.constraints[k].0).for_each(|(g, n)| *g += multiplier * n);
        }
        gradient.iter().zip(&self.is_fixed).filter(|(_, is_fixed)| !**is_fixed).fold(0.0, |a, (g, _)| a.max(g.abs()))
    }

    /// Return true if a linear inequality constrains the steps.
    pub(crate) fn is_constrained(&self) -> bool {
        !self.constraints.is_empty()
    }

    /// Return the active constraints that block the descent direction, as pairs of index and Lagrange multiplier.
    pub(crate) fn active_constraints(&self) -> Vec<(usize, f64)> {
        let is_active = |k: &usize| self.constraints[*k].1 <= ACTIVE_CONSTRAINT_TOLERANCE * self.norm;
        let active: Vec<usize> = (0..self.constraints.len()).filter(is_active).collect();
        let without_fixed =
            |values: &[f64]| values.iter().zip(&self.is_fixed).map(|(v, f)| if *f { 0.0 } else { *v }).collect();
        let normals: Vec<Vec<f64>> = active.iter().map(|&k| without_fixed(&self.constraints[k].0)).collect();
        let descent_direction: Vec<f64> = self.gradient.iter().map(|g| -g).collect();
        let multipliers = small::nonnegative_solution(&normals, &without_fixed(&descent_direction));
        active.into_iter().zip(multipliers).filter(|(_, multiplier)| *multiplier > 0.0).collect()
    }

    /// Minimize ‖J s + e‖² + λ‖s‖² over the scaled step s of the free parameters, within bounds and constraints.
    ///
    /// λ is `damping`. Return the step and the predicted relative decrease of the cost.
    pub(crate) fn damped_step_and_decrease(&self, damping: f64) -> (Vec<f64>, f64) {
        let step = self
            .step_within_bounds(|is_fixed| {
                Some(triangular_damped_step(&self.r, is_fixed, self.eliminated_count, damping, &self.constraints))
            })
            .unwrap_or_default();
        let decrease = self.predicted_decrease(&step, 0);
        (step, decrease)
    }

    /// Return the scaled step that minimizes the quadratic model with secant curvature, and the predicted relative
    /// decrease of the cost.
    ///
    /// The step changes only the parameters that are not eliminated. Return None if the quadratic model has no minimum.
    pub(crate) fn curved_step(&self, damping: f64, curvature: &Curvature) -> Option<(Vec<f64>, f64)> {
        let step = self.step_within_bounds(|is_fixed| self.minimize_with_curvature(is_fixed, damping, curvature))?;
        let decrease = self.predicted_decrease(&step, self.eliminated_count) - self.curvature_change(&step, curvature);
        Some((step, decrease))
    }

    /// Relative increase of the cost along a scaled step that is due to the secant curvature.
    pub(crate) fn curvature_change(&self, step: &[f64], curvature: &Curvature) -> f64 {
        curvature.quadratic_form(&self.to_coordinates(step)) / (self.norm * self.norm).max(f64::MIN_POSITIVE)
    }

    /// Return the scaled step within bounds, by an active-set iteration.
    ///
    /// `step_of` returns the step for given flags of fixed parameters, or None if there is no step.
    fn step_within_bounds(&self, step_of: impl Fn(&[bool]) -> Option<Vec<f64>>) -> Option<Vec<f64>> {
        let mut is_fixed = self.is_fixed.clone();
        let mut step = loop {
            let step = step_of(&is_fixed)?;
            let blocked_parameter = (0..step.len()).find(|&i| {
                let (lower, upper) = self.distance_to_bounds[i];
                !is_fixed[i] && ((step[i] < 0.0 && lower <= 0.0) || (step[i] > 0.0 && upper <= 0.0))
            });
            match blocked_parameter {
                Some(i) => is_fixed[i] = true,
                None => break step,
            }
        };
        step.iter_mut()
            .zip(&self.distance_to_bounds)
            .for_each(|(s, &(lower, upper))| *s = s.max(-lower.max(0.0)).min(upper.max(0.0)));
        Some(step)
    }

    /// Return the relative decrease of the cost that JᵀJ predicts for a scaled step.
    ///
    /// The columns before `first` are projected out.
    pub(crate) fn predicted_decrease(&self, step: &[f64], first: usize) -> f64 {
        let k = step.len();
        let image = |i: usize| (i..k).map(|j| self.r[i * (k + 1) + j] * step[j]).sum::<f64>();
        let (quadratic, linear) = (first..k)
            .map(|i| (image(i), self.r[i * (k + 1) + k]))
            .fold((0.0, 0.0), |(a, b), (v, e)| (a + v * v, b + v * e));
        (-2.0 * linear - quadratic) / (self.norm * self.norm).max(f64::MIN_POSITIVE)
    }

    /// Product JᵀJ s of the Gauss–Newton matrix with a step s in coordinates, by parameter.
    ///
    /// The eliminated parameters are projected out.
    pub(crate) fn gauss_newton_product(&self, step: &[f64]) -> Vec<f64> {
        let k = self.scales.len();
        let scaled_step: Vec<f64> = self.order.iter().zip(&self.scales).map(|(&i, scale)| step[i] * scale).collect();
        let images: Vec<f64> = (0..k)
            .map(|i| {
                let image =
                    (i.max(self.eliminated_count)..k).map(|j| self.r[i * (k + 1) + j] * scaled_step[j]).sum::<f64>();
                if i < self.eliminated_count {
                    0.0
                } else {
                    image
                }
            })
            .collect();
        let mut out = vec![0.0; k];
        for (column, (&i, scale)) in self.order.iter().zip(&self.scales).enumerate().skip(self.eliminated_count) {
            out[i] = scale * (0..=column).map(|l| self.r[l * (k + 1) + column] * images[l]).sum::<f64>();
        }
        out
    }

    /// Gradient of the cost by the coordinates, one value per parameter; 0 for eliminated parameters.
    pub(crate) fn gradient_by_parameter(&self) -> Vec<f64> {
        let mut out = vec![0.0; self.scales.len()];
        for (column, &i) in self.order.iter().enumerate().skip(self.eliminated_count) {
            out[i] = self.gradient[column] * self.scales[column];
        }
        out
    }

    /// Minimize the quadratic model with secant curvature and damping. Return None if it is not positive definite.
    fn minimize_with_curvature(&self, is_fixed: &[bool], damping: f64, curvature: &Curvature) -> Option<Vec<f64>> {
        let k = is_fixed.len();
        let free: Vec<usize> = (self.eliminated_count..k).filter(|&i| !is_fixed[i]).collect();
        let count = free.len();
        let product = |i: usize, j: usize| {
            let last = i.min(j);
            (self.eliminated_count..=last).map(|l| self.r[l * (k + 1) + i] * self.r[l * (k + 1) + j]).sum::<f64>()
        };
        let mut matrix = vec![0.0; count * count];
        let mut target = vec![0.0; count];
        for (a, &i) in free.iter().enumerate() {
            for (b, &j) in free.iter().enumerate() {
                let secant_curvature = curvature.at(self.order[i], self.order[j]) / (self.scales[i] * self.scales[j]);
                matrix[a * count + b] = product(i, j) + secant_curvature + if a == b { damping } else { 0.0 };
            }
            target[a] =
                -(self.eliminated_count..=i).map(|l| self.r[l * (k + 1) + i] * self.r[l * (k + 1) + k]).sum::<f64>();
        }
        let solution = small::positive_solve(&matrix, &target)?;
        let mut step = vec![0.0; k];
        free.iter().zip(solution).for_each(|(&i, s)| step[i] = s);
        Some(step)
    }

    /// Convert a scaled step by column to a step in the coordinates by parameter.
    pub(crate) fn to_coordinates(&self, step: &[f64]) -> Vec<f64> {
        let mut out = vec![0.0; step.len()];
        for ((&i, s), scale) in self.order.iter().zip(step).zip(&self.scales) {
            out[i] = if *scale > 0.0 { s / scale } else { 0.0 };
        }
        out
    }
}

/// Minimize ‖R s + e‖² + λ‖s‖² for the triangular factor `r` of [J | e], with s = 0 for fixed parameters.
///
/// λ is `damping`, except for the first `eliminated_count` parameters. These are eliminated and have the damping
/// [`MIN_DAMPING`]. Each constraint (normal, room) means normal · s ≤ room.
fn triangular_damped_step(
    r: &[f64],
    is_fixed: &[bool],
    eliminated_count: usize,
    damping: f64,
    constraints: &[(Vec<f64>, f64)],
) -> Vec<f64> {
    let (k, free) = (is_fixed.len(), (0..is_fixed.len()).filter(|&j| !is_fixed[j]).collect::<Vec<_>>());
    if free.is_empty() {
        return vec![0.0; k];
    }
    let mut columns: Vec<Vec<f64>> = free
        .iter()
        .enumerate()
        .map(|(column_index, &j)| {
            let mut column = vec![0.0; k + free.len()];
            for (i, value) in column.iter_mut().enumerate().take(j + 1) {
                *value = r[i * (k + 1) + j];
            }
            column[k + column_index] = if j < eliminated_count { MIN_DAMPING } else { damping }.sqrt();
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
    let mut solution = back_substitute(&q, stride, &rhs);
    let free_constraints: Vec<(Vec<f64>, f64)> =
        constraints.iter().map(|(normal, room)| (free.iter().map(|&j| normal[j]).collect(), room.max(0.0))).collect();
    if free_constraints.iter().any(|(normal, room)| inner(normal, &solution) > *room) {
        solution = constrained_solution(&q, stride, &rhs, &free_constraints);
    }
    let mut step = vec![0.0; k];
    free.iter().zip(solution).for_each(|(&j, s)| step[j] = s);
    step
}

/// Minimize ‖R x − rhs‖ for upper-triangular R under normal · x ≤ room, where x = 0 is feasible.
///
/// In z = R x − rhs this is a least-distance problem, which is solved by nonnegative least squares (Lawson & Hanson,
/// doi:10.1137/1.9781611971217, §23.4).
fn constrained_solution(r: &[f64], stride: usize, rhs: &[f64], constraints: &[(Vec<f64>, f64)]) -> Vec<f64> {
    let (k, rhs_norm) = (rhs.len(), norm(rhs));
    let unconstrained = back_substitute(r, stride, rhs);
    let columns: Vec<Vec<f64>> = (constraints.iter())
        .filter(|(normal, room)| room.is_finite() && normal.iter().any(|v| *v != 0.0))
        .map(|(normal, room)| {
            // −R⁻ᵀ normal, followed by the distance from the constraint.
            let mut column: Vec<f64> = Vec::with_capacity(k + 1);
            for i in 0..k {
                let known_sum: f64 = (0..i).map(|l| r[l * stride + i] * column[l]).sum();
                column.push((-normal[i] - known_sum) / r[i * stride + i]);
            }
            let column_norm = norm(&column);
            column.push((inner(normal, &unconstrained) - room) / rhs_norm);
            column.iter().map(|v| v / column_norm).collect()
        })
        .collect();
    let mut target = vec![0.0; k + 1];
    target[k] = 1.0;
    let weights = small::nonnegative_solution(&columns, &target);
    let mut remaining: Vec<f64> = target.iter().map(|v| -v).collect();
    for (column, weight) in columns.iter().zip(&weights) {
        remaining.iter_mut().zip(column).for_each(|(v, c)| *v += weight * c);
    }
    let shifted_rhs: Vec<f64> = rhs.iter().zip(&remaining).map(|(b, v)| b - rhs_norm * v / remaining[k]).collect();
    back_substitute(r, stride, &shifted_rhs)
}

/// Nonlinear least-squares problem.
pub trait LeastSquaresProblem {
    /// Parameters at which the residuals are evaluated.
    type Point: Clone;
    /// Residuals at a point, and intermediate results for their derivatives.
    type Evaluation;

    /// Compute the residuals at a point.
    ///
    /// The minimization shortens the step after an error that ends the simulation, such as
    /// [`crate::error::Error::Diverged`] and [`crate::error::Error::LeadingZero`].
    ///
    /// # Errors
    /// Any other error terminates the minimization.
    fn evaluate(&self, point: &Self::Point) -> Result<Self::Evaluation>;

    /// Residuals of an evaluation.
    fn residuals<'a>(&self, evaluation: &'a Self::Evaluation) -> &'a [f64];

    /// Return the derivatives of the residuals: one vector per parameter, with one element per residual.
    ///
    /// # Errors
    /// The minimization shortens the step after an error that ends the simulation, and terminates after any other
    /// error.
    fn jacobian(&self, point: &Self::Point, evaluation: &Self::Evaluation) -> Result<Vec<Vec<f64>>>;

    /// Release the intermediate results of an evaluation that only its derivatives need.
    ///
    /// The residuals remain available. The minimization calls this after [`Self::jacobian`].
    fn release(&self, _evaluation: &mut Self::Evaluation) {}

    /// Move a point by steps in the coordinates, within bounds.
    ///
    /// Return the new point and the largest relative change of a parameter.
    fn apply_step(&self, point: &Self::Point, steps: &[f64]) -> (Self::Point, f64);

    /// Return the point of an evaluation, with the eliminated linear parameters at their optimum.
    fn point_of_evaluation(&self, _evaluation: &Self::Evaluation, point: Self::Point) -> Self::Point {
        point
    }

    /// Return true if every evaluation eliminates this parameter. Its steps then need no damping.
    fn is_eliminated(&self, _parameter: usize) -> bool {
        false
    }

    /// Derivative of a parameter with respect to its coordinate.
    fn coordinate_derivative(&self, _point: &Self::Point, _parameter: usize) -> f64 {
        1.0
    }

    /// Derivatives of other parameters with respect to the coordinate of a parameter.
    ///
    /// Each is a pair of the index of the other parameter and the derivative.
    fn coupled_derivatives(&self, _point: &Self::Point, _parameter: usize) -> Vec<(usize, f64)> {
        Vec::new()
    }

    /// Distance of a parameter from its lower and upper bound, in its coordinate.
    fn distance_to_bounds(&self, _point: &Self::Point, _parameter: usize) -> (f64, f64) {
        (f64::INFINITY, f64::INFINITY)
    }

    /// Linear inequality constraints on steps from a point, as pairs of normal and room.
    ///
    /// A step in the coordinates is admissible if its dot product with the normal is at most the room.
    fn constraints(&self, _point: &Self::Point) -> Vec<(Vec<f64>, f64)> {
        Vec::new()
    }

    /// Return true if the cost can have kinks along a parameter, so that the gradient need not vanish at a minimum.
    fn has_kinks(&self, _point: &Self::Point, _parameter: usize) -> bool {
        false
    }

    /// Norm of the signals whose difference is the residual vector. It determines the rounding error of the residuals.
    fn signal_norm(&self, _evaluation: &Self::Evaluation) -> f64 {
        0.0
    }

    /// Return true if a point is admissible. Steps from an admissible point to an inadmissible one are rejected.
    fn is_admissible(&self, _point: &Self::Point) -> bool {
        true
    }

    /// Return true if the minimization may extrapolate along valleys.
    ///
    /// A multistart disables extrapolation, to keep distinct optima.
    fn allows_extrapolation(&self) -> bool {
        true
    }

    /// Return true if the optimum is nearly known, so that the first step may be almost Gauss–Newton.
    fn starts_near_optimum(&self) -> bool {
        false
    }
}
/// Minimum ratio of the prediction errors of the two models at the last step for the next step to change to the better
/// model.
///
/// The two models are those without and with secant curvature.
const MIN_PREDICTION_IMPROVEMENT: f64 = 1.5;
/// Relative prediction error below which the Gauss–Newton model is accurate enough.
const PREDICTION_TOLERANCE: f64 = 0.1;

/// Secant approximation of the second-order part of the Hessian, in the coordinates of the steps.
pub(crate) struct Curvature {
    count: usize,
    matrix: Vec<f64>,
    has_update: bool,
    pub(crate) is_used: bool,
}

impl Curvature {
    /// Return a zero matrix for `count` parameters.
    pub(crate) fn new(count: usize) -> Self {
        Self { count, matrix: vec![0.0; count * count], has_update: false, is_used: false }
    }

    /// Return true if the matrix has `count` rows.
    pub(crate) fn is_for(&self, count: usize) -> bool {
        self.count == count
    }

    /// Element (i, j) of the matrix.
    pub(crate) fn at(&self, i: usize, j: usize) -> f64 {
        self.matrix[i * self.count + j]
    }

    fn product(&self, step: &[f64]) -> Vec<f64> {
        self.matrix.chunks_exact(self.count.max(1)).map(|row| row.iter().zip(step).map(|(a, s)| a * s).sum()).collect()
    }

    /// Quadratic form sᵀ B s of this matrix B with a step s: second-order change of twice the cost.
    pub(crate) fn quadratic_form(&self, step: &[f64]) -> f64 {
        self.product(step).iter().zip(step).map(|(a, s)| a * s).sum()
    }

    /// Decide whether the next step uses the matrix.
    ///
    /// `gauss_newton_decrease` and `curvature_decrease` are the relative decreases of the cost that are predicted
    /// without and with the matrix. `decrease` is the actual one.
    pub(crate) fn select_model(&mut self, gauss_newton_decrease: f64, curvature_decrease: f64, decrease: f64) {
        let (gauss_newton_error, curvature_error) =
            ((gauss_newton_decrease - decrease).abs(), (curvature_decrease - decrease).abs());
        if self.is_used {
            self.is_used = curvature_error <= MIN_PREDICTION_IMPROVEMENT * gauss_newton_error;
        } else {
            self.is_used = self.has_update
                && gauss_newton_error > PREDICTION_TOLERANCE * decrease.abs()
                && MIN_PREDICTION_IMPROVEMENT * curvature_error < gauss_newton_error;
        }
    }

    /// Update the matrix after a step.
    ///
    /// `change` is the change of the gradient, and `gauss_newton_change` is its part due to JᵀJ.
    pub(crate) fn update(&mut self, step: &[f64], change: &[f64], gauss_newton_change: &[f64]) {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        let target: Vec<f64> = change.iter().zip(gauss_newton_change).map(|(y, c)| y - c).collect();
        let scale = dot(change, step);
        let norm_product = dot(step, step).sqrt() * dot(change, change).sqrt();
        if !(scale.is_finite() && scale.abs() > 1e-6 * norm_product && norm_product > 0.0) {
            return;
        }
        // Sizing: earlier updates must not exceed the curvature observed along this step.
        let previous_form = self.quadratic_form(step);
        let sizing = if previous_form == 0.0 { 1.0 } else { (dot(step, &target) / previous_form).abs().min(1.0) };
        self.matrix.iter_mut().for_each(|v| *v *= sizing);
        let residual: Vec<f64> = target.iter().zip(self.product(step)).map(|(w, s)| w - s).collect();
        let correction = dot(&residual, step) / (scale * scale);
        for i in 0..self.count {
            for j in 0..self.count {
                self.matrix[i * self.count + j] +=
                    (residual[i] * change[j] + change[i] * residual[j]) / scale - correction * change[i] * change[j];
            }
        }
        self.has_update = self.matrix.iter().all(|v| v.is_finite());
        if !self.has_update {
            *self = Self::new(self.count);
        }
    }
}
/// Number of most recent steps whose sum is extrapolated.
const EXTRAPOLATION_STEPS: usize = 4;
/// Minimum ratio of the norm of the sum of the steps to the sum of their norms at which they have a common direction.
const MIN_STRAIGHTNESS: f64 = 0.8;
/// Relative decrease of the cost per step above which no extrapolation is needed.
const MAX_GAIN_PER_STEP: f64 = 1e-3;
/// Number of evaluations after an extrapolation within which the cost must decrease.
const MAX_TRIAL_EVALUATIONS: usize = 6;
/// Initial factor by which the sum of the steps is multiplied.
const INITIAL_EXTRAPOLATION_FACTOR: f64 = 2.0;
/// Maximum factor by which the sum of the steps is multiplied.
const MAX_EXTRAPOLATION_FACTOR: f64 = 16.0;

/// Last steps of a minimization, and the point before a trial extrapolation.
pub(crate) struct ValleyExtrapolation<P> {
    steps: Vec<Vec<f64>>,
    factor: f64,
    /// Point before the extrapolation, its cost, and the number of evaluations until then.
    trial_start: Option<(P, f64, usize)>,
}

impl<P> ValleyExtrapolation<P> {
    /// Return an extrapolation without recorded steps.
    pub(crate) fn new() -> Self {
        Self { steps: Vec::new(), factor: INITIAL_EXTRAPOLATION_FACTOR, trial_start: None }
    }

    /// Record a step in coordinates. Discard all steps if the relative decrease of the cost, `gain`, is large.
    pub(crate) fn record_step(&mut self, step: &[f64], gain: f64) {
        if gain > MAX_GAIN_PER_STEP {
            self.steps.clear();
        } else {
            self.steps.push(step.to_vec());
        }
    }

    /// Return an extrapolation step in coordinates, or None.
    ///
    /// The result is not None if the last steps have a common direction and the remaining number of `evaluations`
    /// suffices.
    pub(crate) fn propose_step(&mut self, evaluations: usize) -> Option<Vec<f64>> {
        if self.trial_start.is_some() || self.steps.len() < EXTRAPOLATION_STEPS || evaluations <= MAX_TRIAL_EVALUATIONS
        {
            return None;
        }
        let last_steps = self.steps.split_off(self.steps.len() - EXTRAPOLATION_STEPS);
        self.steps.clear();
        let norm = |v: &[f64]| v.iter().map(|s| s * s).sum::<f64>().sqrt();
        let sum: Vec<f64> = (0..last_steps[0].len()).map(|i| last_steps.iter().map(|step| step[i]).sum()).collect();
        let is_straight = norm(&sum) >= MIN_STRAIGHTNESS * last_steps.iter().map(|step| norm(step)).sum::<f64>();
        is_straight.then(|| sum.iter().map(|s| self.factor * s).collect())
    }

    /// Begin a trial extrapolation. Store the point before it, the cost and the number of evaluations.
    pub(crate) fn begin_trial(&mut self, start: P, cost: f64, evaluations: usize) {
        self.trial_start = Some((start, cost, evaluations));
    }

    /// Reject the trial extrapolation: halve the extrapolation factor, to 1 at least, and discard the recorded steps.
    pub(crate) fn reject_trial(&mut self) {
        self.factor = (0.5 * self.factor).max(1.0);
        self.steps.clear();
    }

    /// Return the point before the trial extrapolation if the trial failed or the search ends during it, else None.
    ///
    /// After a decrease of the cost, the extrapolation factor is doubled.
    pub(crate) fn outcome(&mut self, cost: f64, evaluations: usize, is_final: bool) -> Option<P> {
        let (start, start_cost, start_evaluations) = self.trial_start.take()?;
        if cost < start_cost {
            self.factor = (2.0 * self.factor).min(MAX_EXTRAPOLATION_FACTOR);
            self.steps.clear();
            return None;
        }
        if is_final || evaluations >= start_evaluations + MAX_TRIAL_EVALUATIONS {
            self.reject_trial();
            return Some(start);
        }
        self.trial_start = Some((start, start_cost, start_evaluations));
        None
    }
}

//! Residuals at a parameter point, and the elimination of the linear coefficients.

use super::parameterization::ParameterPoint;
use crate::error::{Error, Result};
use crate::estimation::least_squares;
use crate::linalg::dense;
use crate::linalg::orthogonal::{norm, project_out};
use crate::linalg::small::back_substitute;

/// Relative norm of the component of a response outside the span of the previous responses, at or below which the
/// response counts as linearly dependent.
///
/// The responses are those to the initial terms.
pub(crate) const RANK_TOLERANCE: f64 = 1e-12;

/// Residuals at a point, and intermediate results `P` of each experiment for the derivatives of the residuals.
pub(crate) struct Evaluation<P> {
    /// Parameter point, with optimal values of the linear coefficients.
    pub(crate) point: ParameterPoint,
    pub(crate) residuals: Vec<f64>,
    /// Norm of the weighted measured samples.
    pub(crate) measured_norm: f64,
    /// Coefficients of the initial terms, by experiment and equation.
    pub(crate) initial: Vec<Vec<Vec<f64>>>,
    pub(crate) exponents: Vec<Vec<f64>>,
    pub(crate) parts: Vec<P>,
}

impl<P> Evaluation<P> {
    /// Return an evaluation at a point before any experiment is evaluated.
    pub(crate) fn empty(point: ParameterPoint) -> Self {
        let (residuals, initial, exponents) = (Vec::new(), Vec::new(), Vec::new());
        Self { point, residuals, measured_norm: 0.0, initial, exponents, parts: Vec::new() }
    }

    /// Eliminate the linear coefficients and the initial terms from the residuals of each experiment.
    ///
    /// `columns` contains, by experiment, the weighted responses to the initial terms. Each response has the index of
    /// its equation, or None for a constant level of the output. The function `basis_and_effects` returns two items for
    /// an experiment: the orthonormal basis of these responses, and the effects of the linear coefficients on the
    /// samples.
    pub(crate) fn eliminate(
        &mut self,
        linear: &[usize],
        equations: usize,
        mut residuals: Vec<Vec<f64>>,
        columns: Vec<Vec<(Option<usize>, Vec<f64>)>>,
        basis_and_effects: impl Fn(&P) -> (&[Vec<f64>], &[Vec<f64>]),
    ) -> Result<()> {
        if !linear.is_empty() {
            let mut linear_sides: Vec<LinearSide<'_>> = Vec::with_capacity(residuals.len());
            for (residual, part) in residuals.iter().zip(&self.parts) {
                let (basis, effects) = basis_and_effects(part);
                linear_sides.push((residual, basis, effects.iter().map(Vec::as_slice).collect()));
            }
            let steps = solve_linear_steps(&linear_sides)?;
            linear.iter().zip(&steps).for_each(|(&j, step)| self.point.coefficients[j] += step);
            for (residual, part) in residuals.iter_mut().zip(&self.parts) {
                for (effect, step) in basis_and_effects(part).1.iter().zip(&steps) {
                    residual.iter_mut().zip(effect).for_each(|(e, v)| *e -= step * v);
                }
            }
        }
        for (mut residual, columns) in residuals.into_iter().zip(columns) {
            let mut initial: Vec<Vec<f64>> = vec![Vec::new(); equations];
            if !columns.is_empty() {
                let (equation_indices, columns): (Vec<_>, Vec<_>) = columns.into_iter().unzip();
                let (values, _) = least_squares::solve(&columns, &residual, 0)?;
                for ((equation_index, column), x) in equation_indices.iter().zip(&columns).zip(&values) {
                    if let Some(i) = equation_index {
                        initial[*i].push(*x);
                    }
                    residual.iter_mut().zip(column).for_each(|(e, v)| *e -= x * v);
                }
            }
            append(&mut self.residuals, residual);
            self.initial.push(initial);
        }
        Ok(())
    }
}

/// Append the values of one experiment to those of the previous ones. Those of the first experiment are not copied.
pub(crate) fn append(all: &mut Vec<f64>, values: Vec<f64>) {
    if all.is_empty() {
        *all = values;
    } else {
        all.extend(values);
    }
}

/// Levenberg damping of the least-squares problem for the steps of the linear coefficients, whose columns have norm 1.
///
/// It is at the level of rounding errors, so a coefficient that is not identifiable is not changed.
const COLLINEARITY_DAMPING: f64 = 1e-7;

/// Residuals of an experiment, the basis of its initial terms, and the effects of linear coefficients on the samples.
pub(crate) type LinearSide<'a> = (&'a [f64], &'a [Vec<f64>], Vec<&'a [f64]>);

/// Return the steps of the linear coefficients that minimize the residuals of all experiments.
///
/// The initial terms of each experiment are projected out. [`Error::Diverged`] if a step is not finite.
pub(crate) fn solve_linear_steps(linear_sides: &[LinearSide<'_>]) -> Result<Vec<f64>> {
    let count = linear_sides.first().map_or(0, |(_, _, effects)| effects.len());
    let rows: usize = linear_sides.iter().map(|(residuals, _, _)| residuals.len()).sum();
    let mut columns: Vec<Vec<f64>> = (0..=count).map(|_| Vec::with_capacity(rows + count)).collect();
    for (residuals, basis, effects) in linear_sides {
        for (column, column_part) in columns.iter_mut().zip(effects.iter().chain([residuals])) {
            let first = column.len();
            column.extend_from_slice(column_part);
            project_out(basis, &mut column[first..]);
        }
    }
    let mut scales = Vec::with_capacity(count);
    for (index, column) in columns.iter_mut().enumerate() {
        let column_norm = norm(column);
        if index < count {
            let scale = if column_norm > 0.0 && column_norm.is_finite() { 1.0 / column_norm } else { 0.0 };
            column.iter_mut().for_each(|v| *v *= scale);
            scales.push(scale);
        }
        column.resize(rows + count, 0.0);
        if index < count {
            column[rows + index] = COLLINEARITY_DAMPING;
        }
    }
    let r = dense::triangular_factor(&columns);
    let stride = count + 1;
    let rhs: Vec<f64> = (0..count).map(|i| r[i * stride + count]).collect();
    let steps: Vec<f64> = back_substitute(&r, stride, &rhs).iter().zip(&scales).map(|(s, scale)| s * scale).collect();
    match steps.iter().position(|v| !v.is_finite()) {
        Some(index) => Err(Error::Diverged { what: "linear coefficient".into(), index }),
        None => Ok(steps),
    }
}

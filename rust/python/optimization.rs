//! Bindings of the Levenberg–Marquardt method for residuals from Python callbacks.

use std::cell::RefCell;

use numpy::{PyArray1, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use super::convert::{copy_vector, rows, vector};
use super::errors::run_attached;
use super::estimation::status;
use crate::error::{check_length, Error, Result};
use crate::estimation::optimization::damped_step::{LeastSquaresProblem, LinearizedProblem};
use crate::estimation::optimization::levenberg_marquardt::{minimize as find_minimum, MinimizationSettings};
use crate::signal::statistics::inner;

/// Maximum violation of a constraint by a step that counts as rounding error. It is relative to Σ|row·step|, the sum of
/// the moduli of the terms of the constraint.
const CONSTRAINT_TOLERANCE: f64 = 1e-9;
const CONSTRAINT_ROUNDING: f64 = 1e-14;

/// Relative decrease of the sum of squares by a full step at which the minimization has converged, slightly above
/// rounding error.
const COST_REDUCTION_TOLERANCE: f64 = 1e-14;

/// Least-squares problem with residuals and Jacobian from Python callbacks, under the constraints rows · values ≤
/// limits.
struct CallbackProblem<'py> {
    residuals: Bound<'py, PyAny>,
    jacobian: Bound<'py, PyAny>,
    rows: Vec<Vec<f64>>,
    limits: Vec<f64>,
    signal_norm: f64,
    /// Exception that a callback raised.
    raised: RefCell<Option<PyErr>>,
}

impl<'py> CallbackProblem<'py> {
    /// Call a callback with these values and convert its result. An exception is stored in `raised`, and
    /// [`Error::Interrupted`] is returned.
    fn call<T>(
        &self,
        callback: &Bound<'py, PyAny>,
        values: &[f64],
        convert: impl Fn(Bound<'py, PyAny>) -> PyResult<T>,
    ) -> Result<T> {
        let argument = PyArray1::from_slice(callback.py(), values);
        callback.call1((argument,)).and_then(convert).map_err(|error| {
            *self.raised.borrow_mut() = Some(error);
            Error::Interrupted
        })
    }
}

impl LeastSquaresProblem for CallbackProblem<'_> {
    type Point = Vec<f64>;
    type Evaluation = Vec<f64>;

    fn evaluate(&self, point: &Vec<f64>) -> Result<Vec<f64>> {
        self.call(&self.residuals, point, |result| {
            copy_vector("residuals", &result.extract::<PyReadonlyArray1<'_, f64>>()?)
        })
    }

    fn residuals<'a>(&self, evaluation: &'a Vec<f64>) -> &'a [f64] {
        evaluation
    }

    fn jacobian(&self, point: &Vec<f64>, evaluation: &Vec<f64>) -> Result<Vec<Vec<f64>>> {
        let result =
            self.call(&self.jacobian, point, |result| rows(&result.extract::<PyReadonlyArray2<'_, f64>>()?))?;
        check_length("rows of the Jacobian", evaluation.len(), result.len())?;
        result.iter().try_for_each(|row| check_length("a row of the Jacobian", point.len(), row.len()))?;
        if let Some(index) = result.iter().position(|row| row.iter().any(|v| !v.is_finite())) {
            return Err(Error::Diverged { what: "Jacobian".into(), index });
        }
        Ok((0..point.len()).map(|k| result.iter().map(|row| row[k]).collect()).collect())
    }

    fn apply_step(&self, point: &Vec<f64>, steps: &[f64]) -> (Vec<f64>, f64) {
        let mut step_fraction: f64 = 1.0;
        for (row, slack) in self.constraints(point) {
            let slope = inner(&row, steps);
            let rounding_scale: f64 = row.iter().zip(steps).map(|(a, s)| (a * s).abs()).sum();
            if slope - slack > CONSTRAINT_TOLERANCE * rounding_scale + CONSTRAINT_ROUNDING {
                step_fraction = step_fraction.min(slack / slope);
            }
        }
        let next: Vec<f64> = point.iter().zip(steps).map(|(x, s)| x + step_fraction * s).collect();
        let changes = steps.iter().zip(&next).map(|(s, x)| (step_fraction * s).abs() / x.abs().max(f64::MIN_POSITIVE));
        (next.clone(), changes.fold(0.0, f64::max))
    }

    fn constraints(&self, point: &Vec<f64>) -> Vec<(Vec<f64>, f64)> {
        let constraint = |(row, limit): (&Vec<f64>, &f64)| (row.clone(), (limit - inner(row, point)).max(0.0));
        self.rows.iter().zip(&self.limits).map(constraint).collect()
    }

    fn signal_norm(&self, _: &Vec<f64>) -> f64 {
        self.signal_norm
    }
}

/// Result of an optimization: (values, sum of squares, termination status, number of evaluations, indices of the active
/// constraints).
type MinimumTuple<'py> = (Bound<'py, PyArray1<f64>>, f64, &'static str, usize, Vec<usize>);

/// Minimize a sum of squares from a feasible initial guess, under the constraints `rows` · values ≤ `limits`.
///
/// `residuals` and `jacobian` are functions of the values. `jacobian` returns one row per residual.
#[pyfunction]
#[pyo3(signature = (residuals, jacobian, start, rows, limits, *, signal_norm=0.0, evaluations=120))]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn minimize<'py>(
    py: Python<'py>,
    residuals: Bound<'py, PyAny>,
    jacobian: Bound<'py, PyAny>,
    start: PyReadonlyArray1<'py, f64>,
    rows: PyReadonlyArray2<'py, f64>,
    limits: PyReadonlyArray1<'py, f64>,
    signal_norm: f64,
    evaluations: usize,
) -> PyResult<MinimumTuple<'py>> {
    let (start, limits) = (vector("start", &start)?, vector("limits", &limits)?);
    let rows = super::convert::rows(&rows)?;
    check_length("limits", rows.len(), limits.len())?;
    rows.iter().try_for_each(|row| check_length("a row of the constraints", start.len(), row.len()))?;
    let problem = CallbackProblem { residuals, jacobian, rows, limits, signal_norm, raised: RefCell::new(None) };
    let optimum = run_attached(|| {
        let optimum =
            find_minimum(&problem, start, MinimizationSettings { evaluations, tolerance: COST_REDUCTION_TOLERANCE })?;
        let linear = LinearizedProblem::at(&problem, &optimum.point, &optimum.jacobian, &optimum.evaluation, false);
        let active = linear.active_constraints().into_iter().map(|(k, _)| k).collect::<Vec<_>>();
        Ok((optimum, active))
    });
    if let Some(error) = problem.raised.take() {
        return Err(error);
    }
    let (optimum, active) = optimum?;
    let values = PyArray1::from_vec(py, optimum.point);
    Ok((values, 2.0 * optimum.cost, status(optimum.status), optimum.evaluations, active))
}

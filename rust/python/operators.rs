//! Bindings of operators: kernels, transforms, operational matrices, fractional integrals, means, dense factors.

use numpy::{PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use super::convert::{check_size, column_count, copy_vector, matrix, rows, stack_rows, vector, List};
use super::errors::run_detached;
use crate::equation::Filter;
use crate::error::{check_dense, check_finite, check_length, check_points, Error};
use crate::fractional::integral::{self, Derivative, IntegralRule};
use crate::fractional::operational_matrices;
use crate::linalg::dense;
use crate::python::order_search::watch::run_interruptible;
use crate::series;
use crate::signal::block_pulse;

type Array<'py> = Bound<'py, PyArray1<f64>>;
type Matrix<'py> = Bound<'py, PyArray2<f64>>;

fn unknown_choice(name: &str, value: &str, choices: &str) -> Error {
    Error::Structure { what: format!("{name} '{value}' is not known"), remedy: format!("use one of {choices}") }
}

#[pyfunction]
pub fn haar_transform<'py>(py: Python<'py>, x: PyReadonlyArray2<'py, f64>) -> PyResult<Matrix<'py>> {
    map_rows(py, &x, operational_matrices::haar_transform)
}

#[pyfunction]
pub fn haar_inverse<'py>(py: Python<'py>, x: PyReadonlyArray2<'py, f64>) -> PyResult<Matrix<'py>> {
    map_rows(py, &x, operational_matrices::haar_inverse)
}

fn map_rows<'py>(
    py: Python<'py>,
    x: &PyReadonlyArray2<'py, f64>,
    work: fn(&mut [f64]) -> crate::error::Result<()>,
) -> PyResult<Matrix<'py>> {
    let (count, width, mut values) = flatten(x)?;
    let values = run_interruptible(py, values.len(), None, move |stop| {
        for row in 0..count {
            stop.check()?;
            let row = &mut values[row * width..][..width];
            check_finite("x", row)?;
            work(row)?;
        }
        Ok(values)
    })?;
    PyArray1::from_vec(py, values).reshape([count, width])
}

/// Return the number of rows of a matrix, their length, and all values, row after row.
fn flatten(x: &PyReadonlyArray2<'_, f64>) -> PyResult<(usize, usize, Vec<f64>)> {
    check_size(x)?;
    Ok((x.as_array().nrows(), column_count(x), x.as_array().iter().copied().collect()))
}

#[pyfunction]
pub fn haar_matrix(py: Python<'_>, m: usize) -> PyResult<Matrix<'_>> {
    let values = run_detached(py, || {
        check_dense(m)?;
        operational_matrices::haar_matrix(m)
    })?;
    matrix(py, values, m)
}

#[pyfunction]
pub fn block_pulse_matrix(py: Python<'_>, order: f64, m: usize, step: f64) -> PyResult<Matrix<'_>> {
    let values = run_detached(py, || {
        check_dense(m)?;
        operational_matrices::block_pulse_matrix(order, m, step)
    })?;
    matrix(py, values, m)
}

#[pyfunction]
#[pyo3(signature = (order, m, step, *, dense = false))]
pub fn operational_matrix(py: Python<'_>, order: f64, m: usize, step: f64, dense: bool) -> PyResult<Matrix<'_>> {
    let values = run_detached(py, || {
        check_dense(m)?;
        if dense {
            operational_matrices::operational_matrix_dense(order, m, step)
        } else {
            operational_matrices::operational_matrix(order, m, step)
        }
    })?;
    matrix(py, values, m)
}

#[pyfunction]
#[pyo3(signature = (a, b, m, *, naive = false))]
pub fn series_multiply<'py>(
    py: Python<'py>,
    a: PyReadonlyArray1<'py, f64>,
    b: PyReadonlyArray1<'py, f64>,
    m: usize,
    naive: bool,
) -> PyResult<Array<'py>> {
    let (a, b) = (vector("a", &a)?, vector("b", &b)?);
    check_points("m", m)?;
    let product = run_interruptible(py, m, None, move |_| {
        Ok(if naive { series::multiply_naive(&a, &b, m) } else { series::multiply(&a, &b, m) })
    })?;
    Ok(PyArray1::from_vec(py, product))
}

#[pyfunction]
#[pyo3(signature = (numerator, divisor, *, naive = false))]
pub fn series_divide<'py>(
    py: Python<'py>,
    numerator: PyReadonlyArray1<'py, f64>,
    divisor: PyReadonlyArray1<'py, f64>,
    naive: bool,
) -> PyResult<Array<'py>> {
    let (n, d) = (vector("numerator", &numerator)?, vector("divisor", &divisor)?);
    let quotient = run_interruptible(py, n.len(), None, move |_| {
        check_length("divisor", n.len(), d.len())?;
        if naive {
            series::divide_naive(&n, &d)
        } else {
            series::divide(&n, &d)
        }
    })?;
    Ok(PyArray1::from_vec(py, quotient))
}

#[pyfunction]
pub fn fractional_integral<'py>(
    py: Python<'py>,
    x: PyReadonlyArray2<'py, f64>,
    order: f64,
    step: f64,
    rule: &str,
) -> PyResult<Matrix<'py>> {
    let rule = match rule {
        "block-pulse" => IntegralRule::BlockPulse,
        "trapezoidal" => IntegralRule::Trapezoidal,
        "grunwald-letnikov" => IntegralRule::GrunwaldLetnikov,
        other => return Err(unknown_choice("rule", other, "block-pulse, trapezoidal, grunwald-letnikov").into()),
    };
    let (count, width, mut values) = flatten(&x)?;
    let values = run_interruptible(py, values.len(), None, move |stop| {
        let rows_at_once = (MAX_BLOCK_POINTS / width.max(1)).max(1);
        for block in values.chunks_mut(rows_at_once * width.max(1)) {
            stop.check()?;
            integral::integrate_signals(block, width, order, step, rule)?;
        }
        Ok(values)
    })?;
    PyArray1::from_vec(py, values).reshape([count, width])
}

/// Number of values that are integrated between two checks for a stop request.
const MAX_BLOCK_POINTS: usize = 1 << 17;

#[pyfunction]
pub fn fractional_derivative<'py>(
    py: Python<'py>,
    x: PyReadonlyArray2<'py, f64>,
    order: f64,
    step: f64,
    definition: &str,
    initial: PyReadonlyArray2<'py, f64>,
) -> PyResult<Matrix<'py>> {
    let definition = match definition {
        "grunwald-letnikov" => Derivative::GrunwaldLetnikov,
        "riemann-liouville" => Derivative::RiemannLiouville,
        "caputo" => Derivative::Caputo,
        other => return Err(unknown_choice("definition", other, "grunwald-letnikov, riemann-liouville, caputo").into()),
    };
    let ((count, width, values), (initial_rows, terms, initial)) = (flatten(&x)?, flatten(&initial)?);
    let values = run_interruptible(py, values.len(), None, move |stop| {
        check_length("initial", count, initial_rows)?;
        let mut derivatives = Vec::with_capacity(values.len());
        for row in 0..count {
            stop.check()?;
            let (row, initial) = (&values[row * width..][..width], &initial[row * terms..][..terms]);
            derivatives.extend(integral::fractional_derivative(row, order, step, definition, initial)?);
        }
        Ok(derivatives)
    })?;
    PyArray1::from_vec(py, values).reshape([count, width])
}

#[pyfunction]
pub fn point_samples<'py>(py: Python<'py>, means: PyReadonlyArray1<'py, f64>) -> PyResult<Array<'py>> {
    let values = copy_vector("means", &means)?;
    Ok(PyArray1::from_vec(py, run_detached(py, || Ok(block_pulse::point_samples(&values)))?))
}

#[pyfunction]
pub fn delay_samples<'py>(
    py: Python<'py>,
    samples: PyReadonlyArray1<'py, f64>,
    delay: f64,
    before: f64,
) -> PyResult<Array<'py>> {
    let samples = vector("samples", &samples)?;
    Ok(PyArray1::from_vec(py, run_detached(py, || block_pulse::delay_samples(&samples, delay, before))?))
}

#[pyfunction]
pub fn filter_series(
    py: Python<'_>,
    numerator: List<(f64, f64)>,
    denominator: List<(f64, f64)>,
    m: usize,
    step: f64,
) -> PyResult<Array<'_>> {
    let filter = Filter { numerator: numerator.into(), denominator: denominator.into() };
    Ok(PyArray1::from_vec(py, run_detached(py, || filter.series(m, step))?))
}

fn finite_rows(array: &PyReadonlyArray2<'_, f64>) -> PyResult<Vec<Vec<f64>>> {
    let columns = rows(array)?;
    for column in &columns {
        check_finite("a column", column)?;
    }
    Ok(columns)
}

#[pyfunction]
pub fn triangular_factor<'py>(py: Python<'py>, transpose: PyReadonlyArray2<'py, f64>) -> PyResult<Matrix<'py>> {
    let columns_of_matrix = finite_rows(&transpose)?;
    let count = columns_of_matrix.len();
    let factor = run_interruptible(py, column_count(&transpose), None, move |_| {
        Ok(dense::triangular_factor(&columns_of_matrix))
    })?;
    matrix(py, factor, count)
}

#[pyfunction]
#[allow(clippy::type_complexity)]
pub fn singular_values<'py>(
    py: Python<'py>,
    transpose: PyReadonlyArray2<'py, f64>,
) -> PyResult<(Matrix<'py>, Bound<'py, PyArray1<f64>>, Matrix<'py>)> {
    let columns_of_matrix = finite_rows(&transpose)?;
    let factors = run_interruptible(py, column_count(&transpose), None, move |_| {
        dense::singular_values(&columns_of_matrix).ok_or_else(|| Error::Structure {
            what: "the singular value decomposition did not converge".into(),
            remedy: "scale the columns".into(),
        })
    })?;
    Ok((stack_rows(py, &factors.left)?, PyArray1::from_vec(py, factors.values), stack_rows(py, &factors.right)?))
}

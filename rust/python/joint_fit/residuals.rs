//! Bindings of residual analysis: covariance of a fit, noise coloring, whiteness.

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use crate::estimation::joint_fit::covariance as spread;
use crate::python::convert::{copied, matrix, rows, vector, List};
use crate::python::errors::attached;
use crate::python::order_search::watch::leavable;
use crate::signal::statistics;

type Array<'py> = Bound<'py, PyArray1<f64>>;
type Table<'py> = Bound<'py, PyArray2<f64>>;

fn all_copied(name: &str, arrays: &[PyReadonlyArray1<'_, f64>]) -> PyResult<Vec<Vec<f64>>> {
    arrays.iter().map(|array| copied(name, array)).collect()
}

/// Covariance from a Jacobian (a row a parameter), residuals by run and output, and their sum of squares.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn covariance_of<'py>(
    py: Python<'py>,
    jacobian: PyReadonlyArray2<'py, f64>,
    series: List<PyReadonlyArray1<'py, f64>>,
    squares: f64,
) -> PyResult<Table<'py>> {
    let (jacobian, series) = (rows(&jacobian)?, all_copied("residuals", &series)?);
    let (size, points) = (jacobian.len(), jacobian.iter().map(Vec::len).sum());
    let found = leavable(py, points, None, move |_| spread::of_residuals(&jacobian, &series, squares))?;
    matrix(py, found, size)
}

/// Covariance of a fit, whose residuals may have robust weights.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn fit_covariance<'py>(
    py: Python<'py>,
    jacobian: PyReadonlyArray2<'py, f64>,
    series: List<PyReadonlyArray1<'py, f64>>,
    shares: Option<PyReadonlyArray1<'py, f64>>,
) -> PyResult<Table<'py>> {
    let (jacobian, series) = (rows(&jacobian)?, all_copied("residuals", &series)?);
    let shares = shares.map(|shares| vector("shares", &shares)).transpose()?;
    let (size, points) = (jacobian.len(), jacobian.iter().map(Vec::len).sum());
    let found = leavable(py, points, None, move |_| spread::of_fit(&jacobian, series, shares.as_deref()))?;
    matrix(py, found, size)
}

/// Long-run covariance of sums of scores, with Bartlett weights.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn long_run<'py>(
    py: Python<'py>,
    jacobian: PyReadonlyArray2<'py, f64>,
    series: List<PyReadonlyArray1<'py, f64>>,
) -> PyResult<Table<'py>> {
    let (jacobian, series) = (rows(&jacobian)?, all_copied("residuals", &series)?);
    let (size, points) = (jacobian.len(), jacobian.iter().map(Vec::len).sum());
    let found = leavable(py, points, None, move |_| spread::long_run(&jacobian, &series))?;
    matrix(py, found, size)
}

/// Filter that whitens series with one spectrum, and the innovation variance.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn coloured<'py>(
    py: Python<'py>,
    series: List<PyReadonlyArray1<'py, f64>>,
    most: usize,
) -> PyResult<(Array<'py>, f64)> {
    let series = all_copied("series", &series)?;
    let points = series.iter().map(Vec::len).sum::<usize>().saturating_mul(most.max(1));
    let (filter, power) = leavable(py, points, None, move |_| {
        Ok(statistics::coloured(&series.iter().map(Vec::as_slice).collect::<Vec<_>>(), most))
    })?;
    Ok((PyArray1::from_vec(py, filter), power))
}

/// Autocovariances of noise that a filter whitens.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn colour_covariances<'py>(
    py: Python<'py>,
    through: PyReadonlyArray1<'py, f64>,
    power: f64,
    count: usize,
) -> PyResult<Array<'py>> {
    let through = vector("filter", &through)?;
    let found = leavable(py, count, None, move |_| {
        // The circulant has many times as many points.
        crate::error::check_points("points for autocovariances", count.saturating_mul(16))?;
        Ok(statistics::covariances(&through, power, count))
    })?;
    Ok(PyArray1::from_vec(py, found))
}

/// Autocovariances of series at lags from 0, and the number of pairs in each mean.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn autocovariances<'py>(
    py: Python<'py>,
    series: List<PyReadonlyArray1<'py, f64>>,
    most: usize,
) -> PyResult<(Array<'py>, Array<'py>)> {
    let series = all_copied("series", &series)?;
    let points = series.iter().map(Vec::len).sum::<usize>().saturating_mul(most.max(1));
    let (sums, pairs) = leavable(py, points, None, move |_| {
        crate::error::check_points("lags by 256", most.saturating_mul(256))?;
        Ok(statistics::autocovariances(&series.iter().map(Vec::as_slice).collect::<Vec<_>>(), most))
    })?;
    Ok((PyArray1::from_vec(py, sums), PyArray1::from_vec(py, pairs)))
}

/// Whether autocorrelations of a series are consistent with white noise.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn is_white(py: Python<'_>, series: PyReadonlyArray1<'_, f64>, lags: usize) -> PyResult<bool> {
    let series = copied("series", &series)?;
    leavable(py, series.len(), None, move |_| Ok(statistics::is_white(&series, lags)))
}

/// Quantile of chi-squared at the level of a normal quantile.
#[pyfunction]
pub fn chi_squared(degrees: f64, quantile: f64) -> PyResult<f64> {
    attached(|| Ok(statistics::chi_squared(degrees, quantile)))
}

//! Bindings of residual analysis: covariance of a fit, noise coloring, whiteness.

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use crate::estimation::generalized_least_squares;
use crate::estimation::joint_fit::covariance as covariance_estimators;
use crate::python::convert::{copy_vector, matrix, rows, vector, List};
use crate::python::errors::run_attached;
use crate::python::order_search::watch::run_interruptible;
use crate::signal::statistics;

type Array<'py> = Bound<'py, PyArray1<f64>>;
type Table<'py> = Bound<'py, PyArray2<f64>>;

fn copy_vectors(name: &str, arrays: &[PyReadonlyArray1<'_, f64>]) -> PyResult<Vec<Vec<f64>>> {
    arrays.iter().map(|array| copy_vector(name, array)).collect()
}

/// Return the covariance of parameters from a Jacobian with one row per parameter, the residuals of each run and
/// output, and their sum of squares.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn covariance_of<'py>(
    py: Python<'py>,
    jacobian: PyReadonlyArray2<'py, f64>,
    series: List<PyReadonlyArray1<'py, f64>>,
    squares: f64,
) -> PyResult<Table<'py>> {
    let (jacobian, series) = (rows(&jacobian)?, copy_vectors("residuals", &series)?);
    let (size, points) = (jacobian.len(), jacobian.iter().map(Vec::len).sum());
    let covariance = run_interruptible(py, points, None, move |_| {
        covariance_estimators::covariance_of_residuals(&jacobian, &series, squares, 0)
    })?;
    matrix(py, covariance, size)
}

/// Return the covariance of the parameters of a fit from a Jacobian with one row per parameter, and the residuals of
/// each run and output. `robust_weights` has one weight per column; None for a squared loss. The last `priors` columns
/// are the derivatives of the residuals of priors.
#[pyfunction]
#[pyo3(signature = (jacobian, series, robust_weights, priors=0))]
#[allow(clippy::needless_pass_by_value)]
pub fn fit_covariance<'py>(
    py: Python<'py>,
    jacobian: PyReadonlyArray2<'py, f64>,
    series: List<PyReadonlyArray1<'py, f64>>,
    robust_weights: Option<PyReadonlyArray1<'py, f64>>,
    priors: usize,
) -> PyResult<Table<'py>> {
    let (jacobian, series) = (rows(&jacobian)?, copy_vectors("residuals", &series)?);
    let robust_weights = robust_weights.map(|weights| vector("robust weights", &weights)).transpose()?;
    let (size, points) = (jacobian.len(), jacobian.iter().map(Vec::len).sum());
    let covariance = run_interruptible(py, points, None, move |_| {
        covariance_estimators::robust_covariance(&jacobian, series, robust_weights.as_deref(), priors)
    })?;
    matrix(py, covariance, size)
}

/// Return the long-run covariance of the sums of scores (Jacobian times residual), with Bartlett weights.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn long_run_covariance<'py>(
    py: Python<'py>,
    jacobian: PyReadonlyArray2<'py, f64>,
    series: List<PyReadonlyArray1<'py, f64>>,
) -> PyResult<Table<'py>> {
    let (jacobian, series) = (rows(&jacobian)?, copy_vectors("residuals", &series)?);
    let (size, points) = (jacobian.len(), jacobian.iter().map(Vec::len).sum());
    let covariance =
        run_interruptible(py, points, None, move |_| covariance_estimators::long_run_covariance(&jacobian, &series))?;
    matrix(py, covariance, size)
}

/// Return the likelihood ratio of two nested regressions of `residuals` under autoregressive noise, whose order is at
/// most `max_lag`. The rows of `nested_columns` and `full_columns` are the regressors of the smaller and of the larger
/// regression. `blocks` holds the (start, stop) indices of the samples by output and run.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn prediction_ratio(
    py: Python<'_>,
    nested_columns: PyReadonlyArray2<'_, f64>,
    full_columns: PyReadonlyArray2<'_, f64>,
    residuals: PyReadonlyArray1<'_, f64>,
    blocks: List<List<(usize, usize)>>,
    max_lag: usize,
) -> PyResult<f64> {
    let (nested_columns, full_columns, residuals) =
        (rows(&nested_columns)?, rows(&full_columns)?, copy_vector("residuals", &residuals)?);
    let outputs: Vec<Vec<_>> = blocks.iter().map(|ranges| ranges.iter().map(|&(a, b)| a..b.max(a)).collect()).collect();
    let points = residuals.len().saturating_mul((nested_columns.len() + full_columns.len() + max_lag).max(1));
    run_interruptible(py, points, None, move |stop| {
        generalized_least_squares::prediction_ratio(&nested_columns, &full_columns, &residuals, &outputs, max_lag, stop)
    })
}

/// Return the whitening filter 1, a₁, …, aₙ of series with a common spectrum, and the innovation variance. n is at most
/// `max_order`.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn whitening_filter<'py>(
    py: Python<'py>,
    series: List<PyReadonlyArray1<'py, f64>>,
    max_order: usize,
) -> PyResult<(Array<'py>, f64)> {
    let series = copy_vectors("series", &series)?;
    let points = series.iter().map(Vec::len).sum::<usize>().saturating_mul(max_order.max(1));
    let (filter, power) = run_interruptible(py, points, None, move |_| {
        Ok(statistics::whitening_filter(&series.iter().map(Vec::as_slice).collect::<Vec<_>>(), max_order))
    })?;
    Ok((PyArray1::from_vec(py, filter), power))
}

/// Fit an ARX model to series that may depend on inputs. Return (whitening filter of the noise, index of the sample at
/// which the innovations start, innovations of each series, number of coefficients).
#[pyfunction]
#[allow(clippy::needless_pass_by_value, clippy::type_complexity)]
pub fn arx_model<'py>(
    py: Python<'py>,
    series: List<PyReadonlyArray1<'py, f64>>,
    inputs: List<List<PyReadonlyArray1<'py, f64>>>,
    max_order: usize,
) -> PyResult<(Array<'py>, usize, Vec<Array<'py>>, usize)> {
    let series = copy_vectors("series", &series)?;
    let inputs = inputs.iter().map(|rows| copy_vectors("inputs", rows)).collect::<PyResult<Vec<_>>>()?;
    let lags = max_order.saturating_mul(inputs.len() + 1).max(1);
    let points = series.iter().map(Vec::len).sum::<usize>().saturating_mul(lags);
    let model = run_interruptible(py, points, None, move |_| {
        for rows in &inputs {
            crate::error::check_length("inputs", series.len(), rows.len())?;
            for (input, row) in rows.iter().zip(&series) {
                crate::error::check_length("inputs", row.len(), input.len())?;
                crate::error::check_finite("inputs", input)?;
            }
        }
        crate::error::check_points("lags by 256", lags.saturating_mul(256))?;
        let input_rows: Vec<Vec<&[f64]>> = inputs.iter().map(|rows| rows.iter().map(Vec::as_slice).collect()).collect();
        Ok(statistics::arx_model(&series.iter().map(Vec::as_slice).collect::<Vec<_>>(), &input_rows, max_order))
    })?;
    let innovations = model.innovations.into_iter().map(|row| PyArray1::from_vec(py, row)).collect();
    Ok((PyArray1::from_vec(py, model.filter), model.start, innovations, model.parameters))
}

/// Return the autocovariances of series at lags 0 to `max_lag`, and the number of sample pairs at each lag.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn autocovariances<'py>(
    py: Python<'py>,
    series: List<PyReadonlyArray1<'py, f64>>,
    max_lag: usize,
) -> PyResult<(Array<'py>, Array<'py>)> {
    let series = copy_vectors("series", &series)?;
    let points = series.iter().map(Vec::len).sum::<usize>().saturating_mul(max_lag.max(1));
    let (sums, pairs) = run_interruptible(py, points, None, move |_| {
        crate::error::check_points("lags by 256", max_lag.saturating_mul(256))?;
        Ok(statistics::autocovariances(&series.iter().map(Vec::as_slice).collect::<Vec<_>>(), max_lag))
    })?;
    Ok((PyArray1::from_vec(py, sums), PyArray1::from_vec(py, pairs)))
}

/// Return the portmanteau statistic of series over `lags` lags. For white noise of any variance it is chi-squared with
/// `lags` degrees of freedom.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn portmanteau(py: Python<'_>, series: List<PyReadonlyArray1<'_, f64>>, lags: usize) -> PyResult<f64> {
    let series = copy_vectors("series", &series)?;
    let points = series.iter().map(Vec::len).sum::<usize>().saturating_mul(lags.max(1));
    run_interruptible(py, points, None, move |_| {
        Ok(statistics::portmanteau(&series.iter().map(Vec::as_slice).collect::<Vec<_>>(), lags))
    })
}

/// Return the variance of the sum of a series relative to its value for white noise, at least 1.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn variance_inflation(py: Python<'_>, series: PyReadonlyArray1<'_, f64>) -> PyResult<f64> {
    let series = copy_vector("series", &series)?;
    run_interruptible(py, series.len(), None, move |_| Ok(statistics::variance_inflation(&series)))
}

/// Return true if a series is consistent with white noise by the portmanteau test over `lags` lags at 1 %.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn is_white(py: Python<'_>, series: PyReadonlyArray1<'_, f64>, lags: usize) -> PyResult<bool> {
    let series = copy_vector("series", &series)?;
    run_interruptible(py, series.len(), None, move |_| Ok(statistics::is_white(&series, lags)))
}

/// Return the quantile of the chi-squared distribution. `quantile` is the standard normal quantile at the same
/// probability.
#[pyfunction]
pub fn chi_squared(degrees: f64, quantile: f64) -> PyResult<f64> {
    run_attached(|| Ok(statistics::chi_squared(degrees, quantile)))
}

//! Bindings of operators on batches of signals, one signal per row. Several rows can share one set of parameters.

use numpy::{PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use super::convert::{check_size, column_count, vector, List};
use super::order_search::watch::run_interruptible;
use crate::error::{check_finite, check_length, check_points, check_step, Error, Result};
use crate::estimation::multi_innovation;
use crate::fractional::kernels;
use crate::parallel::Stop;
use crate::series;
use crate::signal::block_pulse::{self, Intersample};

type Matrix<'py> = Bound<'py, PyArray2<f64>>;

/// Batch of rows of equal length, stored one after another.
struct Batch {
    values: Vec<f64>,
    width: usize,
}

impl Batch {
    fn new(name: &str, array: &PyReadonlyArray2<'_, f64>) -> PyResult<Self> {
        check_size(array)?;
        let values: Vec<f64> = array.as_array().iter().copied().collect();
        check_finite(name, &values)?;
        Ok(Self { values, width: column_count(array) })
    }

    fn count(&self) -> usize {
        self.values.len().checked_div(self.width).unwrap_or(0)
    }

    fn into_matrix(self, py: Python<'_>, count: usize) -> PyResult<Matrix<'_>> {
        let width = self.width;
        PyArray1::from_vec(py, self.values).reshape([count, width])
    }

    /// Apply `work` to the rows of each group in place.
    ///
    /// `work` receives the index of a group and up to 64 of its rows, one after another. `groups` holds the group of
    /// each row, from 0 to `count` − 1.
    fn change_groups(
        &mut self,
        groups: &[usize],
        count: usize,
        stop: &Stop,
        mut work: impl FnMut(usize, &mut [f64]) -> Result<()>,
    ) -> Result<()> {
        check_length("groups of rows", self.count(), groups.len())?;
        let mut members = vec![Vec::new(); count];
        for (row, &group) in groups.iter().enumerate() {
            let Some(list) = members.get_mut(group) else {
                let what = format!("row {row} of group {group} of {count}");
                return Err(Error::Structure { what, remedy: "count groups from 0".into() });
            };
            list.push(row);
        }
        for (group, list) in members.into_iter().enumerate() {
            for part in list.chunks(MAX_BLOCK_ROWS) {
                stop.check()?;
                let mut block = Vec::with_capacity(part.len() * self.width);
                part.iter().for_each(|&row| block.extend_from_slice(&self.values[row * self.width..][..self.width]));
                work(group, &mut block)?;
                for (&row, changed) in part.iter().zip(block.chunks_exact(self.width)) {
                    self.values[row * self.width..][..self.width].copy_from_slice(changed);
                }
            }
        }
        Ok(())
    }
}

/// Number of rows between two checks for a stop request.
const MAX_BLOCK_ROWS: usize = 64;

/// Return the kernels of fractional integrals of several orders as rows of `m` values. With `derivative`, return their
/// derivatives with respect to the order.
#[pyfunction]
#[pyo3(signature = (orders, m, step, *, derivative = false))]
pub fn block_pulse_kernels<'py>(
    py: Python<'py>,
    orders: PyReadonlyArray1<'py, f64>,
    m: usize,
    step: f64,
    derivative: bool,
) -> PyResult<Matrix<'py>> {
    let orders = vector("order", &orders)?;
    let count = orders.len();
    check_points("m", m)?;
    check_points("values of all kernels", m.saturating_mul(count))?;
    let values = run_interruptible(py, m.saturating_mul(count), None, move |stop| {
        check_step(step)?;
        let mut values = Vec::with_capacity(m * count);
        for order in orders {
            stop.check()?;
            kernels::check_order("order", order)?;
            values.extend(if derivative {
                kernels::block_pulse_kernel_derivative(order, m, step)
            } else {
                kernels::block_pulse_kernel(order, m, step)
            });
        }
        Ok(values)
    })?;
    PyArray1::from_vec(py, values).reshape([count, m])
}

/// Operation on rows, in place, with one kernel.
type KernelWork = fn(&[f64], &mut [f64], &Stop) -> Result<()>;

/// Apply `work` to rows, each with the first column of its Toeplitz matrix. `groups` holds the index of the matrix of
/// each row.
fn with_kernels<'py>(
    py: Python<'py>,
    first_columns: &PyReadonlyArray2<'py, f64>,
    (name, array): (&str, &PyReadonlyArray2<'py, f64>),
    groups: List<usize>,
    work: KernelWork,
) -> PyResult<Matrix<'py>> {
    let (first, mut batch) = (Batch::new("kernel", first_columns)?, Batch::new(name, array)?);
    let (count, size) = (batch.count(), batch.values.len());
    let batch = run_interruptible(py, size, None, move |stop| {
        check_length("kernel", batch.width, first.width)?;
        batch.change_groups(&groups, first.count(), stop, |group, block| {
            work(&first.values[group * first.width..][..first.width], block, stop)
        })?;
        Ok(batch)
    })?;
    batch.into_matrix(py, count)
}

/// Return the products of lower triangular Toeplitz matrices with rows. `groups` holds the index of the matrix of each
/// row.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn toeplitz_apply<'py>(
    py: Python<'py>,
    first_columns: PyReadonlyArray2<'py, f64>,
    x: PyReadonlyArray2<'py, f64>,
    groups: List<usize>,
) -> PyResult<Matrix<'py>> {
    with_kernels(py, &first_columns, ("x", &x), groups, |kernel, block, _| {
        series::multiply_signals(kernel, block);
        Ok(())
    })
}

/// Solve lower triangular Toeplitz systems. `groups` holds the index of the matrix of each right-hand side.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn toeplitz_solve<'py>(
    py: Python<'py>,
    first_columns: PyReadonlyArray2<'py, f64>,
    b: PyReadonlyArray2<'py, f64>,
    groups: List<usize>,
) -> PyResult<Matrix<'py>> {
    with_kernels(py, &first_columns, ("b", &b), groups, |kernel, block, stop| {
        block.chunks_exact_mut(kernel.len()).try_for_each(|row| {
            stop.check()?;
            row.copy_from_slice(&series::divide(row, kernel)?);
            Ok(())
        })
    })
}

/// Return the means of sampled signals over `m` equal pulses, one row per signal. Signals are constant between samples
/// if `hold`, otherwise linear.
#[pyfunction]
pub fn pulse_mean_rows<'py>(
    py: Python<'py>,
    samples: PyReadonlyArray2<'py, f64>,
    m: usize,
    hold: bool,
) -> PyResult<Matrix<'py>> {
    let batch = Batch::new("samples", &samples)?;
    let count = batch.count();
    check_points("m", m)?;
    check_points("values of all rows", m.saturating_mul(count))?;
    let interpolation = if hold { Intersample::Hold } else { Intersample::Linear };
    let values = run_interruptible(py, batch.values.len(), None, move |stop| {
        let mut values = Vec::with_capacity(m * count);
        for row in batch.values.chunks_exact(batch.width.max(1)) {
            stop.check()?;
            values.extend(block_pulse::pulse_means(row, m, interpolation)?.into_vec());
        }
        Ok(values)
    })?;
    PyArray1::from_vec(py, values).reshape([count, m])
}

/// Return multi-innovation estimates of X in m = Q X, eq. (44) of the paper. `q` and `m` hold several problems of
/// `count` rows one after another.
///
/// The result has one row of coefficients per problem. With `path`, it has the coefficients after every row.
#[pyfunction]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn multi_innovation_rows<'py>(
    py: Python<'py>,
    q: PyReadonlyArray2<'py, f64>,
    m: PyReadonlyArray1<'py, f64>,
    count: usize,
    length: usize,
    prior_covariance: List<f64>,
    path: bool,
) -> PyResult<Matrix<'py>> {
    let (batch, target) = (Batch::new("Q", &q)?, vector("m", &m)?);
    let width = batch.width;
    let coefficient_rows = run_interruptible(py, batch.values.len(), None, move |stop| {
        check_length("rows of Q", target.len(), batch.count())?;
        let mut coefficient_rows = Vec::new();
        for (rows, target) in batch.values.chunks(count.max(1) * width.max(1)).zip(target.chunks(count.max(1))) {
            stop.check()?;
            // The estimators need contiguous columns.
            let flat: Vec<f64> = (0..width).flat_map(|j| rows.iter().skip(j).step_by(width).copied()).collect();
            let columns: Vec<&[f64]> = flat.chunks_exact(target.len()).collect();
            coefficient_rows.extend(if path {
                multi_innovation::path(&columns, target, length, &prior_covariance, stop)?
            } else {
                multi_innovation::estimate(&columns, target, length, &prior_covariance)?
            });
        }
        Ok(coefficient_rows)
    })?;
    let rows = coefficient_rows.len().checked_div(width).unwrap_or(0);
    PyArray1::from_vec(py, coefficient_rows).reshape([rows, width])
}

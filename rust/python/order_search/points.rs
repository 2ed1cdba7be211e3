//! Errors of candidates given as points, for a genetic algorithm.

use numpy::{PyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use super::watch::watched;
use crate::error::{check_length, Error};
use crate::order_search::given_points::{Point, Points as PointsOf};
use crate::order_search::options::Norm;
use crate::python::convert::{records, rows, RecordArg};
use crate::python::errors::detached;
use crate::python::lists::List;

/// Errors of candidates at orders and coefficients of their own.
#[pyclass(module = "ftlm._core")]
pub struct Points {
    inner: PointsOf,
    width: usize,
}

#[pymethods]
impl Points {
    #[new]
    #[allow(clippy::needless_pass_by_value)]
    fn new(
        py: Python<'_>,
        runs: List<RecordArg<'_>>,
        output: usize,
        signals: List<usize>,
        inputs: List<bool>,
        squares: bool,
    ) -> PyResult<Self> {
        let width = signals.len();
        let norm = if squares { Norm::L2 } else { Norm::L1 };
        let (records, signals, inputs) = (records(&runs)?, signals.into(), inputs.into());
        Ok(Self { inner: detached(py, || PointsOf::new(records, output, signals, inputs, norm))?, width })
    }

    /// Errors of candidates given as rows (alpha, orders, coefficients); infinite beyond the limit.
    #[allow(clippy::needless_pass_by_value)]
    fn scores<'py>(
        &mut self,
        py: Python<'py>,
        candidates: PyReadonlyArray2<'py, f64>,
        limit: f64,
        threads: usize,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let (rows, Self { inner, width }) = (rows(&candidates)?, self);
        let found = watched(py, None, |control| {
            let point = |row: Vec<f64>| {
                check_length("a candidate", 1 + 2 * *width, row.len())?;
                let (orders, coefficients) = row[1..].split_at(*width);
                Ok(Point { order: row[0], orders: orders.to_vec(), coefficients: coefficients.to_vec() })
            };
            let points = rows.into_iter().map(point).collect::<Result<Vec<_>, Error>>()?;
            inner.scores(&points, limit, threads, control)
        })?;
        Ok(PyArray1::from_vec(py, found))
    }
}

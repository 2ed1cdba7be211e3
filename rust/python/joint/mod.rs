//! What is free in a joint fit, its numbers in the runs' own unit of time, and what describes its residuals.

mod asked;
mod fit;
mod named;

use std::collections::BTreeMap;
use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use super::arrays::{copied, matrix, rows, vector};
use super::errors::{attached, detached};
use super::lists::List;
use super::search::watch::leavable;
use crate::colour;
use crate::error::check_length;
use crate::estimate::joint::covariance as spread;
use crate::estimate::joint::free::{Free, Law};
use crate::estimate::joint::Clock;
use crate::statistics;
use named::{named, StructureArg};

pub use fit::{joint_fit, joint_grids, joint_race, JointRace};

type Array<'py> = Bound<'py, PyArray1<f64>>;
type Table<'py> = Bound<'py, PyArray2<f64>>;
/// Sample interval and duration of each run \[s\].
type Spans = List<(f64, f64)>;

/// What is free in a joint fit.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointProblem {
    inner: Arc<Free>,
}

#[pymethods]
impl JointProblem {
    #[new]
    fn new(told: StructureArg) -> PyResult<Self> {
        let structure = named(told)?;
        attached(|| Ok(Self { inner: Arc::new(Free::of(structure)?) }))
    }

    /// Names of the free orders.
    #[getter]
    fn orders(&self) -> PyResult<Vec<String>> {
        attached(|| Ok(self.inner.orders.clone()))
    }

    /// Names of the free coefficients, those of a law among them.
    #[getter]
    fn coefficients(&self) -> PyResult<Vec<String>> {
        attached(|| Ok(self.inner.coefficients.clone()))
    }

    /// Coefficients that a law gives: name, sign, factors.
    #[getter]
    fn products(&self) -> PyResult<Vec<(String, f64, Vec<String>)>> {
        let told = |law: &Law| (law.name.clone(), law.sign, law.factors.clone());
        attached(|| Ok(self.inner.products.iter().map(told).collect()))
    }

    /// Second order with one derivative of the output, everything else as it is, as far as the bounds allow.
    #[getter]
    fn whole_orders(&self) -> PyResult<Vec<f64>> {
        attached(|| Ok(self.inner.whole_orders()))
    }

    /// Free coefficients from freely estimated ones, by name; ratios as the median of what the equations can say.
    #[allow(clippy::needless_pass_by_value)]
    fn free_from(&self, estimated: BTreeMap<String, f64>) -> PyResult<Vec<f64>> {
        attached(|| Ok(self.inner.free_from(&estimated)))
    }

    /// Bounds of everything that is free.
    #[getter]
    fn bounds(&self) -> PyResult<Vec<(f64, f64)>> {
        attached(|| Ok(self.inner.problem.bounds()))
    }

    /// The last point on the way from a feasible one to another that keeps bounds and constraints of orders.
    fn feasible<'py>(
        &self,
        py: Python<'py>,
        at: PyReadonlyArray1<'py, f64>,
        towards: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Array<'py>> {
        let (at, towards) = (vector("values to go from", &at)?, vector("values to go to", &towards)?);
        let found = detached(py, || self.inner.problem.feasible(&at, &towards))?;
        Ok(PyArray1::from_vec(py, found))
    }

    /// The unit of time of runs, each told by its sample interval and its duration.
    #[allow(clippy::needless_pass_by_value)]
    fn clock(&self, spans: Spans) -> PyResult<JointClock> {
        attached(|| {
            spans.iter().try_for_each(|&(step, duration)| {
                crate::error::check_step(step)?;
                crate::error::check_step(duration)
            })?;
            Ok(JointClock { inner: Clock::of(&self.inner.problem, &spans), size: self.inner.problem.size() })
        })
    }
}

/// Numbers of a fit in a unit of time of the runs' own.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointClock {
    inner: Clock,
    size: usize,
}

impl JointClock {
    fn values(&self, name: &str, array: &PyReadonlyArray1<'_, f64>) -> PyResult<Vec<f64>> {
        let values = copied(name, array)?;
        check_length(name, self.size, values.len())?;
        Ok(values)
    }
}

#[pymethods]
impl JointClock {
    /// ln of the unit of time.
    #[getter]
    fn unit(&self) -> PyResult<f64> {
        attached(|| Ok(self.inner.unit()))
    }

    /// Parameters in the unit.
    fn told<'py>(&self, py: Python<'py>, values: PyReadonlyArray1<'py, f64>) -> PyResult<Array<'py>> {
        let values = self.values("values", &values)?;
        Ok(PyArray1::from_vec(py, attached(|| Ok(self.inner.told(&values)))?))
    }

    /// Parameters from those in the unit.
    fn untold<'py>(&self, py: Python<'py>, values: PyReadonlyArray1<'py, f64>) -> PyResult<Array<'py>> {
        let values = self.values("values", &values)?;
        Ok(PyArray1::from_vec(py, attached(|| Ok(self.inner.untold(&values)))?))
    }

    /// A small step of the parameters at some values, from the one in the unit.
    fn step<'py>(
        &self,
        py: Python<'py>,
        values: PyReadonlyArray1<'py, f64>,
        moved: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Array<'py>> {
        let (values, moved) = (self.values("values", &values)?, self.values("step", &moved)?);
        Ok(PyArray1::from_vec(py, attached(|| Ok(self.inner.step(&values, &moved)))?))
    }

    /// Standard errors in the unit; infinite where the runs do not see all that takes part.
    fn errors<'py>(
        &self,
        py: Python<'py>,
        values: PyReadonlyArray1<'py, f64>,
        covariance: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Array<'py>> {
        let (values, spread) = (self.values("values", &values)?, rows(&covariance)?);
        check_length("rows of a covariance", self.size, spread.len())?;
        spread.iter().try_for_each(|row| check_length("a row of a covariance", self.size, row.len()))?;
        Ok(PyArray1::from_vec(py, attached(|| Ok(self.inner.errors(&values, &spread.concat())))?))
    }
}

fn all_copied(name: &str, arrays: &[PyReadonlyArray1<'_, f64>]) -> PyResult<Vec<Vec<f64>>> {
    arrays.iter().map(|array| copied(name, array)).collect()
}

/// Covariance from a Jacobian, a row a parameter, residuals by run and output, and the sum of their squares.
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

/// The same of a fit, whose residuals may have counted by shares.
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

/// Covariance of sums of scores with Bartlett weights.
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

/// The whitening filter of series that share one colour, and the power that it leaves.
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
        Ok(colour::coloured(&series.iter().map(Vec::as_slice).collect::<Vec<_>>(), most))
    })?;
    Ok((PyArray1::from_vec(py, filter), power))
}

/// Autocovariances of noise that a filter makes white.
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
        // A circle of many times as many points holds them.
        crate::error::check_points("points for autocovariances", count.saturating_mul(16))?;
        Ok(colour::covariances(&through, power, count))
    })?;
    Ok(PyArray1::from_vec(py, found))
}

/// Autocovariances of series at lags from 0, and how many pairs each is the mean of.
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

/// Whether autocorrelations of a series could be those of white noise.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn is_white(py: Python<'_>, series: PyReadonlyArray1<'_, f64>, lags: usize) -> PyResult<bool> {
    let series = copied("series", &series)?;
    leavable(py, series.len(), None, move |_| Ok(statistics::is_white(&series, lags)))
}

/// Value that chi-squared exceeds as often as a normal variable exceeds a quantile.
#[pyfunction]
pub fn chi_squared(degrees: f64, quantile: f64) -> PyResult<f64> {
    attached(|| Ok(statistics::chi_squared(degrees, quantile)))
}

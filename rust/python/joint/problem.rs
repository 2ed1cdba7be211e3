//! What is free in a joint fit, and its numbers in the runs' own unit of time.

use std::collections::BTreeMap;
use std::sync::Arc;

use numpy::{PyArray1, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use super::super::arrays::{copied, rows, vector};
use super::super::errors::{attached, detached};
use super::super::lists::List;
use super::named::{named, StructureArg};
use crate::error::check_length;
use crate::estimate::joint::free::{Free, Law};
use crate::estimate::joint::Clock;

type Array<'py> = Bound<'py, PyArray1<f64>>;
/// Sample interval and duration of each run \[s\].
type Spans = List<(f64, f64)>;

/// What is free in a joint fit.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointProblem {
    pub(super) inner: Arc<Free>,
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

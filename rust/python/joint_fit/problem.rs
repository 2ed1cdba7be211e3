//! Bindings of the parameter set of a joint fit and of its time scaling.

use std::collections::BTreeMap;
use std::sync::Arc;

use numpy::{PyArray1, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::structure::{parse_structure, StructureArg};
use crate::error::{check_length, Error};
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::structure::Law;
use crate::estimation::joint_fit::{Iterate, TimeScaling};
use crate::estimation::output_error::Settings;
use crate::python::convert::{copy_vector, rows, stack_rows, to_vectors, vector, List};
use crate::python::errors::{run_attached, run_detached};
use crate::python::estimation::{count_evaluated_pulses, experiment, status, ExperimentArg};
use crate::python::order_search::watch::{run_interruptible, Stop};

type Array<'py> = Bound<'py, PyArray1<f64>>;
/// Sampling interval and duration of each run \[s\].
type Spans = List<(f64, f64)>;

/// Parameter set of a joint fit.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointProblem {
    pub(super) inner: Arc<ParameterSet>,
}

#[pymethods]
impl JointProblem {
    #[new]
    fn new(told: StructureArg) -> PyResult<Self> {
        let structure = parse_structure(told)?;
        run_attached(|| Ok(Self { inner: Arc::new(ParameterSet::from_structure(structure)?) }))
    }

    /// Names of the free orders.
    #[getter]
    fn orders(&self) -> PyResult<Vec<String>> {
        run_attached(|| Ok(self.inner.orders.clone()))
    }

    /// Names of the free coefficients, including those of a coefficient law.
    #[getter]
    fn coefficients(&self) -> PyResult<Vec<String>> {
        run_attached(|| Ok(self.inner.coefficients.clone()))
    }

    /// Coefficients that a law determines: name, sign, factors.
    #[getter]
    fn products(&self) -> PyResult<Vec<(String, f64, Vec<String>)>> {
        let told = |law: &Law| (law.name.clone(), law.sign, law.factors.clone());
        run_attached(|| Ok(self.inner.products.iter().map(told).collect()))
    }

    /// Integer-order start: second order with one derivative of the output, others unchanged, within the bounds.
    #[getter]
    fn whole_orders(&self) -> PyResult<Vec<f64>> {
        run_attached(|| Ok(self.inner.integer_orders()))
    }

    /// Free coefficients from independent estimates by name. Ratios are the median over the equations.
    #[allow(clippy::needless_pass_by_value)]
    fn free_from(&self, estimated: BTreeMap<String, f64>) -> PyResult<Vec<f64>> {
        run_attached(|| Ok(self.inner.free_from(&estimated)))
    }

    /// Bounds of all free parameters.
    #[getter]
    fn bounds(&self) -> PyResult<Vec<(f64, f64)>> {
        run_attached(|| Ok(self.inner.problem.bounds()))
    }

    /// Last point between a feasible point and another that satisfies bounds and constraints of the orders.
    fn feasible<'py>(
        &self,
        py: Python<'py>,
        at: PyReadonlyArray1<'py, f64>,
        towards: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Array<'py>> {
        let (at, towards) = (vector("values to go from", &at)?, vector("values to go to", &towards)?);
        let found = run_detached(py, || self.inner.problem.last_feasible_point(&at, &towards))?;
        Ok(PyArray1::from_vec(py, found))
    }

    /// Minimize the output error on sampled runs by Levenberg–Marquardt.
    ///
    /// `start` has the values of the free parameters and the states of runs with friction. Coordinates are logarithmic
    /// where the start allows it, unless `plain`. `held` are the indices of fixed parameters.
    #[pyo3(signature = (runs, start, plain, held, evaluations, tolerance, steady, stop=None))]
    #[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
    fn minimize<'py>(
        &self,
        py: Python<'py>,
        runs: List<ExperimentArg<'py>>,
        start: (List<f64>, List<List<f64>>),
        plain: bool,
        held: List<usize>,
        evaluations: usize,
        tolerance: f64,
        steady: bool,
        stop: Option<&Stop>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let experiments = runs.iter().map(experiment).collect::<PyResult<Vec<_>>>()?;
        let place = Iterate { point: self.inner.problem.point(&start.0)?, states: to_vectors(start.1) };
        let size = self.inner.problem.size();
        if let Some(beyond) = held.iter().find(|&&number| number >= size) {
            let what = format!("number {beyond} of {size} to be held");
            return Err(Error::Structure { what, remedy: "count them from 0".into() }.into());
        }
        let (free, settings) = (Arc::clone(&self.inner), Settings { evaluations, tolerance });
        let points = count_evaluated_pulses(&experiments, evaluations);
        let found = run_interruptible(py, points, stop, move |stop| {
            free.problem_at(&place, plain, &held).minimize(&experiments, &place, settings, steady, stop)
        })?;
        let dict = PyDict::new(py);
        dict.set_item("values", found.values())?;
        dict.set_item("states", &found.iterate.states)?;
        dict.set_item("initial", found.initial)?;
        dict.set_item("cost", found.cost)?;
        dict.set_item("residuals", PyArray1::from_vec(py, found.residuals))?;
        let none = found.jacobian.first().is_none_or(Vec::is_empty);
        dict.set_item("jacobian", if none { None } else { Some(stack_rows(py, &found.jacobian)?) })?;
        dict.set_item("evaluations", found.evaluations)?;
        dict.set_item("status", status(found.status))?;
        Ok(dict)
    }

    /// Time scaling of runs, each given by its sampling interval and its duration.
    #[allow(clippy::needless_pass_by_value)]
    fn time_scaling(&self, spans: Spans) -> PyResult<JointTimeScaling> {
        run_attached(|| {
            spans.iter().try_for_each(|&(step, duration)| {
                crate::error::check_step(step)?;
                crate::error::check_step(duration)
            })?;
            Ok(JointTimeScaling {
                inner: TimeScaling::from_runs(&self.inner.problem, &spans),
                size: self.inner.problem.size(),
            })
        })
    }
}

/// Parameters of a fit in the time scaling of its runs.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointTimeScaling {
    inner: TimeScaling,
    size: usize,
}

impl JointTimeScaling {
    fn values(&self, name: &str, array: &PyReadonlyArray1<'_, f64>) -> PyResult<Vec<f64>> {
        let values = copy_vector(name, array)?;
        check_length(name, self.size, values.len())?;
        Ok(values)
    }
}

#[pymethods]
impl JointTimeScaling {
    /// Logarithm of the time unit.
    #[getter]
    fn unit(&self) -> PyResult<f64> {
        run_attached(|| Ok(self.inner.unit()))
    }

    /// Parameters in scaled time.
    fn to_scaled<'py>(&self, py: Python<'py>, values: PyReadonlyArray1<'py, f64>) -> PyResult<Array<'py>> {
        let values = self.values("values", &values)?;
        Ok(PyArray1::from_vec(py, run_attached(|| Ok(self.inner.to_scaled(&values)))?))
    }

    /// Parameters from those in scaled time.
    fn to_unscaled<'py>(&self, py: Python<'py>, values: PyReadonlyArray1<'py, f64>) -> PyResult<Array<'py>> {
        let values = self.values("values", &values)?;
        Ok(PyArray1::from_vec(py, run_attached(|| Ok(self.inner.to_unscaled(&values)))?))
    }

    /// Small step of the parameters at some values, from the step in scaled time.
    fn step<'py>(
        &self,
        py: Python<'py>,
        values: PyReadonlyArray1<'py, f64>,
        moved: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Array<'py>> {
        let (values, moved) = (self.values("values", &values)?, self.values("step", &moved)?);
        Ok(PyArray1::from_vec(py, run_attached(|| Ok(self.inner.step(&values, &moved)))?))
    }

    /// Standard errors in scaled time. Infinite if a parameter is not identifiable.
    fn errors<'py>(
        &self,
        py: Python<'py>,
        values: PyReadonlyArray1<'py, f64>,
        covariance: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Array<'py>> {
        let (values, spread) = (self.values("values", &values)?, rows(&covariance)?);
        check_length("rows of a covariance", self.size, spread.len())?;
        spread.iter().try_for_each(|row| check_length("a row of a covariance", self.size, row.len()))?;
        Ok(PyArray1::from_vec(py, run_attached(|| Ok(self.inner.standard_errors(&values, &spread.concat())))?))
    }
}

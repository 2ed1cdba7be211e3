//! Bindings of the parameter set of a joint fit.

use std::sync::Arc;

use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::structure::{parse_structure, StructureArg};
use crate::error::Error;
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::structure::Law;
use crate::estimation::joint_fit::Iterate;
use crate::estimation::output_error::MinimizationSettings;
use crate::python::convert::{stack_rows, to_vectors, vector, List};
use crate::python::errors::{run_attached, run_detached};
use crate::python::estimation::{count_evaluated_pulses, experiment, status, ExperimentArg};
use crate::python::order_search::watch::{run_interruptible, Stop};

type Array<'py> = Bound<'py, PyArray1<f64>>;

/// Optimization problem of a joint fit: its free parameters and model.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointProblem {
    pub(super) inner: Arc<ParameterSet>,
}

#[pymethods]
impl JointProblem {
    #[new]
    fn new(structure: StructureArg) -> PyResult<Self> {
        let structure = parse_structure(structure)?;
        run_attached(|| Ok(Self { inner: Arc::new(ParameterSet::from_structure(structure)?) }))
    }

    /// Names of the free orders.
    #[getter]
    fn orders(&self) -> PyResult<Vec<String>> {
        run_attached(|| Ok(self.inner.orders.clone()))
    }

    /// Names of the free coefficients, including the parameters of a coefficient law.
    #[getter]
    fn coefficients(&self) -> PyResult<Vec<String>> {
        run_attached(|| Ok(self.inner.coefficients.clone()))
    }

    /// Coefficients that a coefficient law determines: (name, sign, names of the factors).
    #[getter]
    fn products(&self) -> PyResult<Vec<(String, f64, Vec<String>)>> {
        let law_tuple = |law: &Law| (law.name.clone(), law.sign, law.factors.clone());
        run_attached(|| Ok(self.inner.products.iter().map(law_tuple).collect()))
    }

    /// (lower, upper) bound of each free parameter.
    #[getter]
    fn bounds(&self) -> PyResult<Vec<(f64, f64)>> {
        run_attached(|| Ok(self.inner.problem.bounds()))
    }

    /// Move from the feasible point `start` toward `target`, and return the last point that satisfies the bounds and
    /// the constraints of the orders. The move follows the constraints that are active at `start`.
    fn feasible<'py>(
        &self,
        py: Python<'py>,
        start: PyReadonlyArray1<'py, f64>,
        target: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Array<'py>> {
        let (start, target) = (vector("start point", &start)?, vector("target point", &target)?);
        let point = run_detached(py, || self.inner.problem.last_feasible_point(&start, &target))?;
        Ok(PyArray1::from_vec(py, point))
    }

    /// Minimize the output error on sampled runs by the Levenberg–Marquardt method. Return the optimum as a dictionary.
    ///
    /// `start` holds the values of the free parameters, and the initial states of runs with friction. The coordinate of
    /// a nonzero coefficient is its logarithm, or the coefficient itself if `plain` is true or there are non-linear
    /// terms. `fixed` holds the indices of fixed parameters. With `requires_stability`, no step leads from a stable
    /// model to an unstable one. The cost includes the priors of the structure. The returned residuals and the Jacobian
    /// are those of the samples alone.
    #[pyo3(signature = (runs, start, plain, fixed, evaluations, tolerance, requires_stability, stop=None))]
    #[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
    fn minimize<'py>(
        &self,
        py: Python<'py>,
        runs: List<ExperimentArg<'py>>,
        start: (List<f64>, List<List<f64>>),
        plain: bool,
        fixed: List<usize>,
        evaluations: usize,
        tolerance: f64,
        requires_stability: bool,
        stop: Option<&Stop>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let experiments = runs.iter().map(experiment).collect::<PyResult<Vec<_>>>()?;
        let iterate = Iterate { point: self.inner.problem.point(&start.0)?, states: to_vectors(start.1) };
        let size = self.inner.problem.size();
        if let Some(index) = fixed.iter().find(|&&number| number >= size) {
            let what = format!("the parameter to be fixed has index {index}, but there are {size}");
            return Err(Error::Structure { what, remedy: "count them from 0".into() }.into());
        }
        let (parameter_set, settings) = (Arc::clone(&self.inner), MinimizationSettings { evaluations, tolerance });
        let points = count_evaluated_pulses(&experiments, evaluations);
        let priors = self.inner.problem.model.priors.len();
        let mut optimum = run_interruptible(py, points, stop, move |stop| {
            parameter_set.problem_at(&iterate, plain, &fixed).minimize(
                &experiments,
                &iterate,
                settings,
                requires_stability,
                stop,
            )
        })?;
        for values in std::iter::once(&mut optimum.residuals).chain(&mut optimum.jacobian) {
            values.truncate(values.len().saturating_sub(priors));
        }
        let dict = PyDict::new(py);
        dict.set_item("values", optimum.values())?;
        dict.set_item("states", &optimum.iterate.states)?;
        dict.set_item("initial", optimum.initial)?;
        let responses =
            optimum.initial_responses.iter().map(|rows| stack_rows(py, rows)).collect::<PyResult<Vec<_>>>()?;
        dict.set_item("initial_responses", responses)?;
        dict.set_item("cost", optimum.cost)?;
        dict.set_item("residuals", PyArray1::from_vec(py, optimum.residuals))?;
        let is_empty = optimum.jacobian.first().is_none_or(Vec::is_empty);
        dict.set_item("jacobian", if is_empty { None } else { Some(stack_rows(py, &optimum.jacobian)?) })?;
        dict.set_item("evaluations", optimum.evaluations)?;
        dict.set_item("status", status(optimum.status))?;
        Ok(dict)
    }
}

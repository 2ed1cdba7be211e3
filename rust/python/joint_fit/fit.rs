//! Bindings of the joint fit in one call, and of the multistart whose candidates several fits share.

use std::sync::Arc;

use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::problem::JointProblem;
use crate::error::Result;
use crate::estimation::joint_fit::fit;
use crate::estimation::joint_fit::initial_guesses::OrderGrids;
use crate::estimation::joint_fit::multistart::{self, select_survivors, MultistartContext};
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::{
    Candidate, FitProblem, Initialization, Iterate, JointFit, Loss, Objective, OptimizationResult, OptimumStatistics,
    OutputScale, Settings, Weights,
};
use crate::python::convert::{matrix, stack_rows, List};
use crate::python::errors::run_attached;
use crate::python::estimation::status;
use crate::python::order_search::watch::{run_with_progress, Stop};
use crate::python::recording::{recordings, Recording};
use crate::recording::{Recordings, Sampling};

type Table<'py> = Bound<'py, PyArray2<f64>>;
/// Resources: (threads, bytes of memory of one order grid).
type Means = (usize, u64);

/// Candidates of a multistart, best first. Fits of the same structure to the same runs continue from them.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointMultistart {
    inner: Arc<Vec<Candidate>>,
}

#[pymethods]
impl JointMultistart {
    fn __len__(&self) -> PyResult<usize> {
        run_attached(|| Ok(self.inner.len()))
    }

    /// Values of the free parameters of each candidate.
    #[getter]
    fn values(&self) -> PyResult<Vec<Vec<f64>>> {
        run_attached(|| Ok(self.inner.iter().map(|runner| runner.result.values()).collect()))
    }

    /// Description of the start of each candidate.
    #[getter]
    fn origins(&self) -> PyResult<Vec<String>> {
        run_attached(|| Ok(self.inner.iter().map(|runner| runner.origin.clone()).collect()))
    }
}

/// Runs as source of a fit.
pub(super) fn source(free: &ParameterSet, runs: &[Py<Recording>]) -> Result<Recordings> {
    let outputs: Vec<usize> = free.structure.equations.iter().map(|e| e.output).collect();
    recordings(runs, free.structure.signals.len(), &outputs, free.structure.inputs.len())
}

/// Multistart of a problem with these output weights. `floor` is the cost of pure noise per residual.
#[pyfunction]
#[pyo3(signature = (problem, runs, weights, floor, means, progress=None, stop=None))]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn joint_multistart(
    py: Python<'_>,
    problem: &JointProblem,
    runs: List<Py<Recording>>,
    weights: List<f64>,
    floor: f64,
    means: Means,
    progress: Option<Py<PyAny>>,
    stop: Option<&Stop>,
) -> PyResult<JointMultistart> {
    let (free, (threads, memory)) = (Arc::clone(&problem.inner), means);
    let source = source(&free, &runs)?;
    let reached = run_with_progress(py, stop, progress.as_ref(), move |stop, report| {
        let starts = OrderGrids::new(&source, threads, memory, stop);
        let course = MultistartContext {
            source: &source,
            starts: &starts,
            stop,
            weights: &weights,
            floor,
            threads,
            told: Some(&report),
        };
        multistart::run_multistart(&free, course)
    })?;
    Ok(JointMultistart { inner: Arc::new(reached) })
}

/// Refine candidates, each (values of the free parameters, description), on coarse grids.
#[pyfunction]
#[pyo3(signature = (problem, runs, weights, decimation, starts, threads, stop=None))]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn refine_candidates(
    py: Python<'_>,
    problem: &JointProblem,
    runs: List<Py<Recording>>,
    weights: List<f64>,
    decimation: usize,
    starts: List<(List<f64>, String)>,
    threads: usize,
    stop: Option<&Stop>,
) -> PyResult<JointMultistart> {
    let free = Arc::clone(&problem.inner);
    let starts =
        starts.into_iter().map(|(values, origin)| candidate_at(&free, &values, origin)).collect::<Result<Vec<_>>>()?;
    let source = source(&free, &runs)?;
    let reached = run_with_progress(py, stop, None, move |stop, _| {
        let weights = Weights { outputs: weights.into(), robust_weights: None };
        let sampling = Sampling { decimation, ..Sampling::default() };
        let grid = Objective::new((&free.problem, &source, stop), weights, sampling, false)?;
        multistart::optimize_on_coarse_grids(&free, &grid, &starts, threads)
    })?;
    Ok(JointMultistart { inner: Arc::new(reached) })
}

fn candidate_at(free: &ParameterSet, values: &[f64], origin: String) -> Result<Candidate> {
    Ok(Candidate::at(Iterate { point: free.problem.point(values)?, states: Vec::new() }, origin))
}

/// Initial guess near an earlier fit: (values of the free parameters, noise of each output, pulses per sampling
/// interval).
type NearArg = (List<f64>, List<f64>, usize);

/// Fit a structure to its runs. None if every start has a simulation that overflows.
#[pyfunction]
#[pyo3(signature = (problem, runs, sizes, known, start, near, candidates, huber, refine, means, progress=None, stop=None))]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn joint_fit<'py>(
    py: Python<'py>,
    problem: &JointProblem,
    runs: List<Py<Recording>>,
    sizes: List<(f64, f64)>,
    known: List<List<f64>>,
    start: Option<List<f64>>,
    near: Option<NearArg>,
    candidates: Option<&JointMultistart>,
    huber: bool,
    refine: bool,
    means: Means,
    progress: Option<Py<PyAny>>,
    stop: Option<&Stop>,
) -> PyResult<Option<Bound<'py, PyDict>>> {
    let (free, (threads, memory)) = (Arc::clone(&problem.inner), means);
    let candidates = candidates.map(|found| Vec::clone(&found.inner));
    let initialization = match (near, start) {
        (Some((values, noise, pulses_per_sample)), _) => Initialization::WarmStart {
            values: values.into(),
            noise: noise.into(),
            pulses_per_sample,
            candidates: candidates.unwrap_or_default(),
        },
        (None, Some(values)) => Initialization::InitialGuess(values.into()),
        (None, None) => Initialization::Multistart { known: crate::python::convert::to_vectors(known), candidates },
    };
    let loss = if huber { Loss::Huber } else { Loss::Squares };
    let settings = Settings { loss, refine, threads };
    let sizes: Vec<OutputScale> = sizes.iter().map(|&(deviation, noise)| OutputScale { deviation, noise }).collect();
    let outputs = free.problem.outputs.len();
    crate::error::check_length("sizes of outputs", outputs, sizes.len())?;
    let size = free.problem.size();
    let source = source(&free, &runs)?;
    let found = run_with_progress(py, stop, progress.as_ref(), move |stop, report| {
        let starts = OrderGrids::new(&source, threads, memory, stop);
        let sought = FitProblem { free: &free, source: &source, starts: &starts, sizes: &sizes, stop };
        fit::fit(sought, initialization, settings, report)
    })?;
    found.map(|found| fit_to_dict(py, found, size)).transpose()
}

/// Tables of all runs.
fn tables<'py>(py: Python<'py>, runs: &[Vec<Vec<f64>>]) -> PyResult<Vec<Table<'py>>> {
    runs.iter().map(|run| stack_rows(py, run)).collect()
}

fn fit_to_dict(py: Python<'_>, found: JointFit, size: usize) -> PyResult<Bound<'_, PyDict>> {
    let JointFit { finished, reached, growth } = found;
    let OptimumStatistics {
        attempt,
        weights,
        pulses_per_sample: every,
        estimate,
        step_converged: settled,
        covariance,
        noise,
        residuals,
        robust,
    } = finished;
    let OptimizationResult { iterate: place, cost, initial, .. } = &attempt;
    let dict = PyDict::new(py);
    dict.set_item("shares", weights.robust_weights.map(|shares| tables(py, &shares)).transpose()?)?;
    dict.set_item("every", every)?;
    dict.set_item("estimate", estimate)?;
    dict.set_item("settled", settled)?;
    dict.set_item("covariance", matrix(py, covariance, size)?)?;
    dict.set_item("noise", noise)?;
    dict.set_item("left", tables(py, &residuals)?)?;
    dict.set_item("robust", robust.map(|robust| (robust.reduced_weight_count, robust.outliers, robust.samples)))?;
    dict.set_item("on_grid", PyArray1::from_vec(py, attempt.values()))?;
    dict.set_item("states", &place.states)?;
    dict.set_item("cost", cost)?;
    dict.set_item("status", status(attempt.status))?;
    dict.set_item("initial_terms", initial.iter().flatten().map(Vec::len).sum::<usize>())?;
    let starts = reached.iter().flat_map(|runner| {
        std::iter::once(&runner.origin)
            .chain(&runner.duplicates)
            .map(|origin| (runner.cost_per_residual(), origin.clone()))
    });
    dict.set_item("starts", starts.collect::<Vec<_>>())?;
    let survivors = select_survivors(&reached).into_iter().map(|c| (c.cost_per_residual(), c.result.values()));
    dict.set_item("survivors", survivors.collect::<Vec<_>>())?;
    dict.set_item(
        "growth",
        growth.map(|growth| (growth.keeps_unstable, growth.residual_excess, growth.at_stability_limit)),
    )?;
    Ok(dict)
}

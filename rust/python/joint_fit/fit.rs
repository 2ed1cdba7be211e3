//! Bindings of the joint fit in one call, and of the multistart whose candidates several fits share.

use std::sync::Arc;

use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::problem::JointProblem;
use super::resampler::{Answering, Asked, Known, Question, RunsArg};
use crate::error::Result;
use crate::estimation::joint_fit::fit;
use crate::estimation::joint_fit::initial_guesses::Lattices;
use crate::estimation::joint_fit::multistart::{self, Course};
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::{
    Attempt, Finished, Grid, JointFit, Loss, Outset, Place, Runner, Sampling, Settings, Size, Sought, Weights,
};
use crate::python::convert::{matrix, stacked, List};
use crate::python::errors::attached;
use crate::python::estimation::status;
use crate::python::order_search::watch::{served, Stop};

type Table<'py> = Bound<'py, PyArray2<f64>>;
/// Resources: (threads, bytes of memory of one order grid).
type Means = (usize, u64);

/// Candidates of a multistart, best first. Fits of the same structure to the same runs continue from them.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointRace {
    inner: Arc<Vec<Runner>>,
}

#[pymethods]
impl JointRace {
    fn __len__(&self) -> PyResult<usize> {
        attached(|| Ok(self.inner.len()))
    }

    /// Values of the free parameters of each candidate.
    #[getter]
    fn values(&self) -> PyResult<Vec<Vec<f64>>> {
        attached(|| Ok(self.inner.iter().map(|runner| runner.attempt.values()).collect()))
    }

    /// Description of the start of each candidate.
    #[getter]
    fn origins(&self) -> PyResult<Vec<String>> {
        attached(|| Ok(self.inner.iter().map(|runner| runner.origin.clone()).collect()))
    }
}

/// Run `work` with the runs of an argument as source.
fn asking<T: Send + 'static>(
    py: Python<'_>,
    runs: RunsArg,
    stop: Option<&Stop>,
    work: impl FnOnce(&crate::parallel::Stop, &Asked<'_, T>) -> Result<T> + Send + 'static,
) -> PyResult<T> {
    let (known, answering): (Known, Answering) = Known::of(runs)?;
    served(
        py,
        stop,
        |py, question: Question| answering.answer(py, question),
        move |stop, desk| work(stop, &Asked::<T>::new(desk, known)),
    )
}

/// Multistart of a problem with these output weights. `floor` is the cost of pure noise per residual.
#[pyfunction]
#[pyo3(signature = (problem, runs, weights, floor, means, stop=None))]
#[allow(clippy::needless_pass_by_value)]
pub fn joint_race(
    py: Python<'_>,
    problem: &JointProblem,
    runs: RunsArg,
    weights: List<f64>,
    floor: f64,
    means: Means,
    stop: Option<&Stop>,
) -> PyResult<JointRace> {
    let (free, (threads, memory)) = (Arc::clone(&problem.inner), means);
    let reached = asking(py, runs, stop, move |stop, source| {
        let starts = Lattices::new(source, threads, memory, stop);
        let told = |done, of| source.tell(done, of);
        let course = Course { source, starts: &starts, stop, weights: &weights, floor, threads, told: Some(&told) };
        multistart::race(&free, course)
    })?;
    Ok(JointRace { inner: Arc::new(reached) })
}

/// Refine candidates, each (values of the free parameters, description), on coarse grids.
#[pyfunction]
#[pyo3(signature = (problem, runs, weights, decimation, starts, threads, stop=None))]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn joint_grids(
    py: Python<'_>,
    problem: &JointProblem,
    runs: RunsArg,
    weights: List<f64>,
    decimation: usize,
    starts: List<(List<f64>, String)>,
    threads: usize,
    stop: Option<&Stop>,
) -> PyResult<JointRace> {
    let free = Arc::clone(&problem.inner);
    let starts =
        starts.into_iter().map(|(values, origin)| started(&free, &values, origin)).collect::<Result<Vec<_>>>()?;
    let reached = asking(py, runs, stop, move |stop, source| {
        let weights = Weights { outputs: weights.into(), shares: None };
        let sampling = Sampling { decimation, ..Sampling::default() };
        let grid = Grid::new((&free.problem, source, stop), weights, sampling, false)?;
        multistart::on_coarse_grids(&free, &grid, &starts, threads)
    })?;
    Ok(JointRace { inner: Arc::new(reached) })
}

fn started(free: &Free, values: &[f64], origin: String) -> Result<Runner> {
    Ok(Runner::at(Place { point: free.problem.point(values)?, states: Vec::new() }, origin))
}

/// Initial guess near an earlier fit: (values of the free parameters, noise of each output, pulses per sampling
/// interval).
type NearArg = (List<f64>, List<f64>, usize);

/// Fit a structure to its runs. None if every start has a simulation that overflows.
#[pyfunction]
#[pyo3(signature = (problem, runs, sizes, known, start, near, raced, huber, refine, means, stop=None))]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn joint_fit<'py>(
    py: Python<'py>,
    problem: &JointProblem,
    runs: RunsArg,
    sizes: List<(f64, f64)>,
    known: List<List<f64>>,
    start: Option<List<f64>>,
    near: Option<NearArg>,
    raced: Option<&JointRace>,
    huber: bool,
    refine: bool,
    means: Means,
    stop: Option<&Stop>,
) -> PyResult<Option<Bound<'py, PyDict>>> {
    let (free, (threads, memory)) = (Arc::clone(&problem.inner), means);
    let raced = raced.map(|raced| Vec::clone(&raced.inner));
    let outset = match (near, start) {
        (Some((values, noise, every)), _) => {
            Outset::Near { values: values.into(), noise: noise.into(), every, raced: raced.unwrap_or_default() }
        }
        (None, Some(values)) => Outset::Given(values.into()),
        (None, None) => Outset::Starts { known: crate::python::convert::nested(known), raced },
    };
    let loss = if huber { Loss::Huber } else { Loss::Squares };
    let settings = Settings { loss, refine, threads };
    let sizes: Vec<Size> = sizes.iter().map(|&(size, noise)| Size { size, noise }).collect();
    let outputs = free.problem.outputs.len();
    crate::error::check_length("sizes of outputs", outputs, sizes.len())?;
    let size = free.problem.size();
    let found = asking(py, runs, stop, move |stop, source| {
        let starts = Lattices::new(source, threads, memory, stop);
        let sought = Sought { free: &free, source, starts: &starts, sizes: &sizes, stop };
        fit::fit(sought, outset, settings, &|done, of| source.tell(done, of))
    })?;
    found.map(|found| described(py, found, size)).transpose()
}

/// Tables of all runs.
fn tables<'py>(py: Python<'py>, runs: &[Vec<Vec<f64>>]) -> PyResult<Vec<Table<'py>>> {
    runs.iter().map(|run| stacked(py, run)).collect()
}

fn described(py: Python<'_>, found: JointFit, size: usize) -> PyResult<Bound<'_, PyDict>> {
    let JointFit { finished, reached, growth } = found;
    let Finished { attempt, weights, every, estimate, settled, covariance, noise, residuals, robust } = finished;
    let Attempt { place, cost, initial, .. } = &attempt;
    let dict = PyDict::new(py);
    dict.set_item("shares", weights.shares.map(|shares| tables(py, &shares)).transpose()?)?;
    dict.set_item("every", every)?;
    dict.set_item("estimate", estimate)?;
    dict.set_item("settled", settled)?;
    dict.set_item("covariance", matrix(py, covariance, size)?)?;
    dict.set_item("noise", noise)?;
    dict.set_item("left", tables(py, &residuals)?)?;
    dict.set_item("robust", robust.map(|robust| (robust.lowered, robust.outliers, robust.samples)))?;
    dict.set_item("on_grid", PyArray1::from_vec(py, attempt.values()))?;
    dict.set_item("states", &place.states)?;
    dict.set_item("cost", cost)?;
    dict.set_item("status", status(attempt.status))?;
    dict.set_item("initial_terms", initial.iter().flatten().map(Vec::len).sum::<usize>())?;
    let starts = reached.iter().flat_map(|runner| {
        std::iter::once(&runner.origin).chain(&runner.alike).map(|origin| (runner.level(), origin.clone()))
    });
    dict.set_item("starts", starts.collect::<Vec<_>>())?;
    dict.set_item("growth", growth.map(|growth| (growth.kept, growth.excess, growth.at_limit)))?;
    Ok(dict)
}

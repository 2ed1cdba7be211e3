//! Bindings of the profile likelihood and of the cost surface of a joint fit.

use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::fit::source;
use super::problem::JointProblem;
use crate::error::{check_finite, Error};
use crate::estimation::joint_fit::profile::{
    profile_intervals as search_intervals, CostSurface, FitState, ProfileLikelihood, ProfileSettings,
};
use crate::estimation::joint_fit::Weights;
use crate::python::convert::{matrix, rows, vector, List};
use crate::python::order_search::watch::{run_with_progress, Stop};
use crate::python::recording::Recording;

/// Cost surface as (smallest sum of squares, values of both parameters, sums of squares).
type SurfaceTuple<'py> = (f64, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray2<f64>>);

/// State of a fit from a dictionary with these keys: estimate, values on its finest grid, weight of each output, robust
/// weights of the samples by run, pulses per sampling interval, true if the step has converged, true if unstable models
/// are excluded.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct FitArg<'py> {
    estimate: PyReadonlyArray1<'py, f64>,
    on_grid: PyReadonlyArray1<'py, f64>,
    weights: List<f64>,
    shares: Option<List<PyReadonlyArray2<'py, f64>>>,
    every: usize,
    settled: bool,
    steady: bool,
}

fn state(fit: FitArg<'_>) -> PyResult<FitState> {
    let shares = fit.shares.map(|shares| shares.iter().map(rows).collect::<PyResult<_>>()).transpose()?;
    Ok(FitState {
        estimate: vector("estimate", &fit.estimate)?,
        on_grid: vector("values on the grid", &fit.on_grid)?,
        weights: Weights { outputs: fit.weights.into(), robust_weights: shares },
        pulses_per_sample: fit.every,
        step_converged: fit.settled,
        requires_stability: fit.steady,
    })
}

/// Return an error for an index without a parameter.
fn check_parameters(problem: &JointProblem, parameters: &[usize]) -> PyResult<()> {
    let size = problem.inner.problem.size();
    match parameters.iter().find(|&&i| i >= size) {
        None => Ok(()),
        Some(i) => {
            let what = format!("parameter {i} of {size}");
            Err(Error::Structure { what, remedy: "count them from 0".into() }.into())
        }
    }
}

/// Profile-likelihood intervals of a fit around the optimum that `evaluations` lead to.
///
/// Without `parameters`, those with an inaccurate Wald interval are profiled. `budget` is the maximum number of
/// simulations for all bounds, and the smallest initial budget of each bound.
#[pyfunction]
#[pyo3(signature = (
    problem, runs, fit, parameters, width, *, budget=None, threads=1, evaluations=120, progress=None, stop=None,
))]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn profile_intervals<'py>(
    py: Python<'py>,
    problem: &JointProblem,
    runs: List<Py<Recording>>,
    fit: FitArg<'py>,
    parameters: Option<List<usize>>,
    width: f64,
    budget: Option<(usize, usize)>,
    threads: usize,
    evaluations: usize,
    progress: Option<Py<PyAny>>,
    stop: Option<&Stop>,
) -> PyResult<Bound<'py, PyDict>> {
    check_parameters(problem, parameters.as_deref().map_or(&[], Vec::as_slice))?;
    check_finite("half-width of the intervals", &[width])?;
    let (free, fit) = (Arc::clone(&problem.inner), state(fit)?);
    let source = source(&free, &runs)?;
    let settings = ProfileSettings { parameters: parameters.map(Vec::from), width, budget, threads };
    let result = run_with_progress(py, stop, progress.as_ref(), move |stop, report| {
        search_intervals(ProfileLikelihood::new((&free, &source, stop), &fit, evaluations)?, &settings, report)
    })?;
    let dict = PyDict::new(py);
    let intervals = result.intervals.into_iter().map(|(i, one)| (i, one.low, one.high, one.points, one.evaluations));
    dict.set_item("intervals", intervals.collect::<Vec<_>>())?;
    dict.set_item("lower_optimum", result.lower_optimum.map(|values| PyArray1::from_vec(py, values)))?;
    dict.set_item("lower_on_finer_grid", result.lower_on_finer_grid)?;
    dict.set_item("incomplete", result.incomplete)?;
    dict.set_item("evaluations", result.evaluations)?;
    Ok(dict)
}

/// Maximum number of points on each axis of a cost surface. Each pair of values is a simulation.
const MAX_SURFACE_POINTS: usize = 64;

#[allow(clippy::cast_precision_loss)]
fn check_surface_points(points: usize) -> Result<(), Error> {
    if points <= MAX_SURFACE_POINTS {
        return Ok(());
    }
    let (name, value) = ("points of a cost surface".into(), points as f64);
    let (range, remedy) = (format!("[0, {MAX_SURFACE_POINTS}]"), "use fewer points, over a smaller range".into());
    Err(Error::OutOfRange { name, value, range, remedy })
}

/// Sums of squares of a fit over two parameters: at the optimum, the values of both, and at each pair of values.
///
/// Rows are values of the second parameter. `halves` are the distances of the outermost values from the optimum.
#[pyfunction]
#[pyo3(signature = (problem, runs, fit, pair, halves, points, *, refit=true, evaluations=20, stop=None))]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn cost_surface<'py>(
    py: Python<'py>,
    problem: &JointProblem,
    runs: List<Py<Recording>>,
    fit: FitArg<'py>,
    pair: [usize; 2],
    halves: [f64; 2],
    points: usize,
    refit: bool,
    evaluations: usize,
    stop: Option<&Stop>,
) -> PyResult<SurfaceTuple<'py>> {
    check_parameters(problem, &pair)?;
    check_surface_points(points)?;
    let (free, fit) = (Arc::clone(&problem.inner), state(fit)?);
    let source = source(&free, &runs)?;
    let (least, [first, second], scores) = run_with_progress(py, stop, None, move |stop, _| {
        let surface = CostSurface::new((&free, &source, stop), &fit, pair, refit, evaluations)?;
        let axes = [0, 1].map(|k| surface.axis(k, halves[k], points));
        let scores = surface.scores(&axes[0], &axes[1])?;
        Ok((surface.least(), axes, scores))
    })?;
    Ok((least, PyArray1::from_vec(py, first), PyArray1::from_vec(py, second), matrix(py, scores, points)?))
}

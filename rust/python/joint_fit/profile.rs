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

/// Cost surface: (smallest sum of squares, values of the first parameter, values of the second parameter, sums of
/// squares).
type SurfaceTuple<'py> = (f64, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray2<f64>>);

/// State of a fit, from a dictionary with these fields as keys. `estimate` holds the parameters extrapolated to zero
/// step, and `on_grid` the parameters at the shortest step. `weights` holds the weights of the outputs, and
/// `robust_weights` those of the samples by run. `pulses_per_sample` belongs to the shortest step. `step_converged` is
/// true if the estimate no longer changes with the step. If `requires_stability` is true, no step of an optimization
/// leads from a stable model to an unstable one.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct FitArg<'py> {
    estimate: PyReadonlyArray1<'py, f64>,
    on_grid: PyReadonlyArray1<'py, f64>,
    weights: List<f64>,
    robust_weights: Option<List<PyReadonlyArray2<'py, f64>>>,
    pulses_per_sample: usize,
    step_converged: bool,
    requires_stability: bool,
}

fn fit_state(fit: FitArg<'_>) -> PyResult<FitState> {
    let robust_weights = fit.robust_weights.map(|runs| runs.iter().map(rows).collect::<PyResult<_>>()).transpose()?;
    Ok(FitState {
        estimate: vector("estimate", &fit.estimate)?,
        grid_optimum: vector("values on the grid", &fit.on_grid)?,
        weights: Weights { outputs: fit.weights.into(), robust_weights },
        pulses_per_sample: fit.pulses_per_sample,
        step_converged: fit.step_converged,
        requires_stability: fit.requires_stability,
    })
}

/// Return an error if the index of a parameter is out of range.
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

/// Return profile-likelihood intervals of a fit as a dictionary. The item `intervals` holds (index of the parameter,
/// lower bound, upper bound, points, evaluations) of each parameter.
///
/// Without `parameters`, the parameters with an inaccurate Wald interval are profiled. `width` is the half-width of the
/// Wald interval in standard errors. `budget` holds the maximum number of simulations for all bounds, and the smallest
/// initial budget of each bound. At most `evaluations` evaluations locate the optimum before the profiles.
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
    let (parameter_set, fit) = (Arc::clone(&problem.inner), fit_state(fit)?);
    let source = source(&parameter_set, &runs)?;
    let settings = ProfileSettings { parameters: parameters.map(Vec::from), width, budget, threads };
    let result = run_with_progress(py, stop, progress.as_ref(), move |stop, report| {
        search_intervals(ProfileLikelihood::new((&parameter_set, &source, stop), &fit, evaluations)?, &settings, report)
    })?;
    let dict = PyDict::new(py);
    let intervals = result
        .intervals
        .into_iter()
        .map(|(i, interval)| (i, interval.low, interval.high, interval.points, interval.evaluations));
    dict.set_item("intervals", intervals.collect::<Vec<_>>())?;
    dict.set_item("lower_optimum", result.lower_optimum.map(|values| PyArray1::from_vec(py, values)))?;
    dict.set_item("lower_on_finer_grid", result.lower_on_finer_grid)?;
    dict.set_item("incomplete", result.incomplete)?;
    dict.set_item("evaluations", result.evaluations)?;
    Ok(dict)
}

/// Maximum number of points on each axis of a cost surface. Each pair of values requires a simulation.
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

/// Return the sums of squares of a fit over two parameters as (smallest sum, values of the first parameter, values of
/// the second parameter, sums of squares).
///
/// Each row of the sums of squares belongs to one value of the second parameter. `half_widths` holds the distances of
/// the outermost values from the optimum. With `refit`, all other parameters follow by one linear step.
#[pyfunction]
#[pyo3(signature = (problem, runs, fit, pair, half_widths, points, *, refit=true, evaluations=20, stop=None))]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn cost_surface<'py>(
    py: Python<'py>,
    problem: &JointProblem,
    runs: List<Py<Recording>>,
    fit: FitArg<'py>,
    pair: [usize; 2],
    half_widths: [f64; 2],
    points: usize,
    refit: bool,
    evaluations: usize,
    stop: Option<&Stop>,
) -> PyResult<SurfaceTuple<'py>> {
    check_parameters(problem, &pair)?;
    check_surface_points(points)?;
    let (parameter_set, fit) = (Arc::clone(&problem.inner), fit_state(fit)?);
    let source = source(&parameter_set, &runs)?;
    let (minimum, [first, second], scores) = run_with_progress(py, stop, None, move |stop, _| {
        let surface = CostSurface::new((&parameter_set, &source, stop), &fit, pair, refit, evaluations)?;
        let axes = [0, 1].map(|k| surface.axis(k, half_widths[k], points));
        let scores = surface.scores(&axes[0], &axes[1])?;
        Ok((surface.minimum(), axes, scores))
    })?;
    Ok((minimum, PyArray1::from_vec(py, first), PyArray1::from_vec(py, second), matrix(py, scores, points)?))
}

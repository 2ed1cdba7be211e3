//! Bindings of the joint fit, and of a multistart that provides initial guesses for several fits.

use std::sync::Arc;

use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::problem::JointProblem;
use crate::error::Result;
use crate::estimation::joint_fit::fit;
use crate::estimation::joint_fit::initial_guesses::OrderGrids;
use crate::estimation::joint_fit::multistart::select_survivors;
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::progress::FitProgress;
use crate::estimation::joint_fit::{
    Candidate, FitProblem, Initialization, JointFit, Loss, OptimizationResult, OptimumStatistics, OutputScale, Settings,
};
use crate::python::convert::{matrix, stack_rows, to_vectors, List};
use crate::python::estimation::status;
use crate::python::order_search::watch::{run_with_progress, Stop};
use crate::python::recording::{recordings, Recording};
use crate::recording::Recordings;

type Table<'py> = Bound<'py, PyArray2<f64>>;
/// Resources of a fit: (number of threads, memory limit of one order grid \[bytes\]).
type FitResources = (usize, u64);

/// Candidates of a multistart, best first. Later fits of the same structure to the same runs can start from these
/// candidates.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointMultistart {
    inner: Arc<Vec<Candidate>>,
}

/// Return the runs as the data of a fit. Return an error if their signals or outputs are not those of the parameter
/// set.
pub(super) fn source(parameter_set: &ParameterSet, runs: &[Py<Recording>]) -> Result<Recordings> {
    let outputs: Vec<usize> = parameter_set.structure.equations.iter().map(|e| e.output).collect();
    recordings(runs, parameter_set.structure.recorded_count(), &outputs, parameter_set.structure.inputs.len())
}

/// Run the multistart of a joint fit and return its candidates. `progress` is called with (steps done, all steps).
#[pyfunction]
#[pyo3(signature = (problem, runs, resources, progress=None, stop=None))]
#[allow(clippy::needless_pass_by_value)]
pub fn joint_multistart(
    py: Python<'_>,
    problem: &JointProblem,
    runs: List<Py<Recording>>,
    resources: FitResources,
    progress: Option<Py<PyAny>>,
    stop: Option<&Stop>,
) -> PyResult<JointMultistart> {
    let (parameter_set, (threads, memory)) = (Arc::clone(&problem.inner), resources);
    let source = source(&parameter_set, &runs)?.with_memory_limit(usize::try_from(memory).unwrap_or(usize::MAX));
    let candidates = run_with_progress(py, stop, progress.as_ref(), move |stop, report| {
        let order_grids = OrderGrids::new(&source, threads, memory, stop);
        let output_scale = OutputScale::from_recordings(&source)?;
        let fit_problem = FitProblem {
            parameter_set: &parameter_set,
            source: &source,
            guess_source: &order_grids,
            scales: &output_scale,
            stop,
        };
        fit_problem.run_multistart(threads, &mut FitProgress::new(&report))
    })?;
    Ok(JointMultistart { inner: Arc::new(candidates) })
}

/// Warm start from an earlier fit: (values of the free parameters, noise standard deviation of each output, pulses per
/// sampling interval).
type WarmStartArg = (List<f64>, List<f64>, usize);

/// Fit a structure to its runs and return the result as a dictionary. None if the simulation overflows for every
/// initial guess.
#[pyfunction]
#[pyo3(signature = (
    problem, runs, guesses, initial_guess, warm_start, candidates, huber, refine, resources, progress=None, stop=None,
))]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn joint_fit<'py>(
    py: Python<'py>,
    problem: &JointProblem,
    runs: List<Py<Recording>>,
    guesses: List<List<f64>>,
    initial_guess: Option<List<f64>>,
    warm_start: Option<WarmStartArg>,
    candidates: Option<&JointMultistart>,
    huber: bool,
    refine: bool,
    resources: FitResources,
    progress: Option<Py<PyAny>>,
    stop: Option<&Stop>,
) -> PyResult<Option<Bound<'py, PyDict>>> {
    let (parameter_set, (threads, memory)) = (Arc::clone(&problem.inner), resources);
    let candidates = candidates.map(|fit| Vec::clone(&fit.inner));
    let initialization = match (warm_start, initial_guess) {
        (Some((values, noise, pulses_per_sample)), _) => Initialization::WarmStart {
            values: values.into(),
            noise: noise.into(),
            pulses_per_sample,
            candidates: candidates.unwrap_or_default(),
        },
        (None, Some(values)) => Initialization::InitialGuess(values.into()),
        (None, None) => Initialization::Multistart { given_guesses: to_vectors(guesses), candidates },
    };
    let loss = if huber { Loss::Huber } else { Loss::Squares };
    let settings = Settings { loss, refine, threads };
    let size = parameter_set.problem.size();
    let source = source(&parameter_set, &runs)?.with_memory_limit(usize::try_from(memory).unwrap_or(usize::MAX));
    let fit = run_with_progress(py, stop, progress.as_ref(), move |stop, report| {
        let order_grids = OrderGrids::new(&source, threads, memory, stop);
        let output_scale = OutputScale::from_recordings(&source)?;
        let fit_problem = FitProblem {
            parameter_set: &parameter_set,
            source: &source,
            guess_source: &order_grids,
            scales: &output_scale,
            stop,
        };
        fit::fit(fit_problem, initialization, settings, report)
    })?;
    fit.map(|fit| fit_to_dict(py, fit, size)).transpose()
}

/// Convert the rows of each run to a table.
fn tables<'py>(py: Python<'py>, runs: &[Vec<Vec<f64>>]) -> PyResult<Vec<Table<'py>>> {
    runs.iter().map(|run| stack_rows(py, run)).collect()
}

fn fit_to_dict(py: Python<'_>, fit: JointFit, size: usize) -> PyResult<Bound<'_, PyDict>> {
    let JointFit { optimum, candidates, stability } = fit;
    let OptimumStatistics {
        result,
        weights,
        pulses_per_sample,
        estimate,
        step_converged,
        covariance,
        noise,
        residuals,
        robust,
        prior_fractions,
    } = optimum;
    let OptimizationResult { iterate, cost, initial, .. } = &result;
    let dict = PyDict::new(py);
    dict.set_item("robust_weights", weights.robust_weights.map(|runs| tables(py, &runs)).transpose()?)?;
    dict.set_item("pulses_per_sample", pulses_per_sample)?;
    dict.set_item("estimate", estimate)?;
    dict.set_item("step_converged", step_converged)?;
    dict.set_item("covariance", matrix(py, covariance, size)?)?;
    dict.set_item("noise", noise)?;
    dict.set_item("residuals", tables(py, &residuals)?)?;
    dict.set_item("robust", robust.map(|robust| (robust.reduced_weight_count, robust.outliers, robust.samples)))?;
    dict.set_item("prior_fractions", prior_fractions)?;
    dict.set_item("on_grid", PyArray1::from_vec(py, result.values()))?;
    dict.set_item("states", &iterate.states)?;
    dict.set_item("cost", cost)?;
    dict.set_item("status", status(result.status))?;
    dict.set_item("initial_terms", initial.iter().flatten().map(Vec::len).sum::<usize>())?;
    let origins = candidates.iter().flat_map(|candidate| {
        std::iter::once(&candidate.origin)
            .chain(&candidate.duplicates)
            .map(|origin| (candidate.cost_per_residual(), origin.clone()))
    });
    dict.set_item("starts", origins.collect::<Vec<_>>())?;
    let survivors = select_survivors(&candidates).into_iter().map(|c| (c.cost_per_residual(), c.result.values()));
    dict.set_item("survivors", survivors.collect::<Vec<_>>())?;
    dict.set_item("unstable_optimum", stability.map(|c| (c.keeps_unstable, c.residual_excess, c.at_stability_limit)))?;
    Ok(dict)
}

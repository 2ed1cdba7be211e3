//! Bindings of simulation, output and equation error, explicit Euler, metrics and correlations.

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use super::convert::{
    copy_vector, equations, initial, matrix, record, rows, stack_rows, structure, to_vectors, vector, EquationArg,
    InitialArg, List, RecordArg, StructureArg,
};
use super::errors::run_detached;
use super::estimation::jumps_near;
use crate::python::order_search::watch::run_interruptible;
use crate::signal::block_pulse::{Intersample, SampleInterpolation};
use crate::simulate::{self, OutputFilter};
use crate::state_space::{self, Input};

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn respond<'py>(
    py: Python<'py>,
    run: RecordArg<'py>,
    model: List<EquationArg>,
    inputs: List<bool>,
    terms: List<List<(f64, f64)>>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let record = record(&run)?;
    let equations = equations(model, record.len(), &inputs)?;
    let outputs =
        run_interruptible(py, record.m(), None, move |_| simulate::respond(&equations, &record, &to_vectors(terms)))?;
    stack_rows(py, &outputs)
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
#[allow(clippy::type_complexity)]
pub fn respond_and_units<'py>(
    py: Python<'py>,
    run: RecordArg<'py>,
    model: List<EquationArg>,
    inputs: List<bool>,
    units: List<(usize, f64)>,
) -> PyResult<(Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f64>>)> {
    let record = record(&run)?;
    let equations = equations(model, record.len(), &inputs)?;
    let (driven, units) =
        run_interruptible(py, record.m(), None, move |_| simulate::respond_and_units(&equations, &record, &units))?;
    Ok((stack_rows(py, &driven)?, stack_rows(py, &units.concat())?))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value, clippy::type_complexity)]
pub fn respond_with_initial<'py>(
    py: Python<'py>,
    run: RecordArg<'py>,
    model: List<EquationArg>,
    inputs: List<bool>,
    terms: InitialArg,
    filter: Option<(PyReadonlyArray1<'py, f64>, List<bool>)>,
) -> PyResult<(Bound<'py, PyArray2<f64>>, Vec<Vec<f64>>, Vec<Vec<f64>>)> {
    let record = record(&run)?;
    let equations = equations(model, record.len(), &inputs)?;
    let initial = initial(terms)?;
    let filter = filter.map(|(series, applies)| Ok::<_, PyErr>((vector("filter", &series)?, applies))).transpose()?;
    let response = run_interruptible(py, record.m(), None, move |_| {
        let filter = filter.as_ref().map(|(series, applies)| OutputFilter { series, applies });
        simulate::respond_with_initial(&equations, &record, &initial, filter)
    })?;
    Ok((stack_rows(py, &response.outputs)?, response.exponents, response.initial))
}

/// (signal, samples, whether held, delay in steps, value before the record).
type InputArg<'py> = (usize, PyReadonlyArray1<'py, f64>, bool, f64, f64);

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn state_space_respond<'py>(
    py: Python<'py>,
    model: List<EquationArg>,
    inputs: List<bool>,
    driving: List<InputArg<'py>>,
    terms: List<List<(f64, f64)>>,
    step: f64,
    rows: usize,
) -> PyResult<Option<Bound<'py, PyArray2<f64>>>> {
    let equations = equations(model, inputs.len(), &inputs)?;
    let driving = (driving.iter())
        .map(|(signal, samples, held, delay, before)| {
            let between = if *held { Intersample::Hold } else { Intersample::Linear };
            let samples = vector("input", samples)?;
            Ok(Input { signal: *signal, samples, between, delay: *delay, before: *before })
        })
        .collect::<PyResult<Vec<_>>>()?;
    let count = equations.len();
    let found = run_interruptible(py, rows, None, move |stop| {
        state_space::respond(&equations, &driving, &to_vectors(terms), step, rows, stop)
    })?;
    found.map(|samples| matrix(py, samples, count)).transpose()
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn equation_error<'py>(
    py: Python<'py>,
    run: RecordArg<'py>,
    equation: EquationArg,
    inputs: List<bool>,
    terms: InitialArg,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let record = record(&run)?;
    let equations = equations(vec![equation].into(), record.len(), &inputs)?;
    let initial = initial(terms)?;
    let found =
        run_interruptible(py, record.m(), None, move |_| simulate::equation_error(&equations[0], &record, &initial))?;
    Ok(PyArray1::from_vec(py, found))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn explicit_euler<'py>(
    py: Python<'py>,
    signals: PyReadonlyArray2<'py, f64>,
    step: f64,
    model: List<EquationArg>,
    inputs: List<bool>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let signals = rows(&signals)?;
    let equations = equations(model, signals.len(), &inputs)?;
    let outputs = run_detached(py, || simulate::explicit_euler(&equations, &signals, step))?;
    stack_rows(py, &outputs)
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn trace_errors<'py>(
    py: Python<'py>,
    run: RecordArg<'py>,
    equation: StructureArg,
    inputs: List<bool>,
    trace: PyReadonlyArray2<'py, f64>,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let record = record(&run)?;
    let structure = structure(equation, record.len(), &inputs)?;
    let rows = rows(&trace)?;
    let found = run_interruptible(py, record.m(), None, move |_| simulate::trace_errors(&structure, &record, &rows))?;
    Ok(PyArray1::from_vec(py, found))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn nyquist_margin(py: Python<'_>, own_terms: List<(f64, f64)>, step: f64) -> PyResult<f64> {
    run_detached(py, || Ok(simulate::nyquist_margin(&own_terms, step)))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn metrics(
    py: Python<'_>,
    measured: PyReadonlyArray1<'_, f64>,
    residuals: PyReadonlyArray1<'_, f64>,
) -> PyResult<(f64, f64, f64, f64)> {
    let measured = vector("measured", &measured)?;
    let residuals = copy_vector("residuals", &residuals)?;
    let found = run_detached(py, || crate::signal::metrics::metrics(&measured, &residuals))?;
    Ok((found.error, found.rmse, found.nr, found.fit_percent))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn correlation<'py>(
    py: Python<'py>,
    x: List<PyReadonlyArray1<'py, f64>>,
    y: List<PyReadonlyArray1<'py, f64>>,
    lags: usize,
) -> PyResult<(Bound<'py, PyArray1<f64>>, f64, usize)> {
    let x = x.iter().map(|a| vector("x", a)).collect::<PyResult<Vec<_>>>()?;
    let y = y.iter().map(|a| vector("y", a)).collect::<PyResult<Vec<_>>>()?;
    let found = run_detached(py, || crate::signal::metrics::correlation(&x, &y, lags))?;
    Ok((PyArray1::from_vec(py, found.values), found.variance, found.window))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn interpolate_samples<'py>(
    py: Python<'py>,
    means: PyReadonlyArray2<'py, f64>,
    places: PyReadonlyArray1<'py, f64>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (means, places) = (rows(&means)?, vector("times of readings", &places)?);
    let m = means.first().map_or(0, Vec::len);
    let read = run_detached(py, || {
        let readings = SampleInterpolation::new(places, m)?;
        Ok(means.iter().map(|row| readings.interpolate(row)).collect::<Vec<_>>())
    })?;
    stack_rows(py, &read)
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn kink_correction<'py>(
    py: Python<'py>,
    m: usize,
    places: PyReadonlyArray1<'py, f64>,
    jumps: (PyReadonlyArray1<'py, f64>, PyReadonlyArray1<'py, f64>),
    order: f64,
    step: f64,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let places = vector("times of readings", &places)?;
    let readings = SampleInterpolation::new(places, m)?;
    let jumps = jumps_near(&readings, &jumps.0, &jumps.1)?;
    let lacking = run_detached(py, || Ok(readings.kink_corrections(&jumps, order, step)))?;
    Ok(PyArray1::from_vec(py, lacking))
}

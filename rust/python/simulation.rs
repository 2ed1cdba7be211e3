//! Bindings of simulation, output error, equation error, explicit Euler, metrics and correlations.

use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use super::convert::{
    copy_vector, derived_signals, equations, initial, record, rows, stack_rows, structure, to_vectors, vector,
    DerivedArg, EquationArg, InitialArg, List, RecordArg, StructureArg,
};
use super::errors::run_detached;
use super::estimation::jumps_at_samples;
use super::recording::Recording;
use crate::error::check_length;
use crate::friction::FrictionLaw;
use crate::output_samples::{self, InitialTerms, OutputSamples, Refinement};
use crate::python::order_search::watch::{run_interruptible, Stop};
use crate::signal::block_pulse::SampleInterpolation;
use crate::simulate::{self, OutputFilter};

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
    let errors =
        run_interruptible(py, record.m(), None, move |_| simulate::equation_error(&equations[0], &record, &initial))?;
    Ok(PyArray1::from_vec(py, errors))
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
    let errors = run_interruptible(py, record.m(), None, move |_| simulate::trace_errors(&structure, &record, &rows))?;
    Ok(PyArray1::from_vec(py, errors))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn nyquist_margin(py: Python<'_>, output_terms: List<(f64, f64)>, step: f64) -> PyResult<f64> {
    run_detached(py, || Ok(simulate::nyquist_margin(&output_terms, step)))
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
    let metrics = run_detached(py, || crate::signal::metrics::metrics(&measured, &residuals))?;
    Ok((metrics.error, metrics.rmse, metrics.nr, metrics.fit_percent))
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
    let result = run_detached(py, || crate::signal::metrics::correlation(&x, &y, lags))?;
    Ok((PyArray1::from_vec(py, result.values), result.variance, result.window))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn interpolate_samples<'py>(
    py: Python<'py>,
    means: PyReadonlyArray2<'py, f64>,
    positions: PyReadonlyArray1<'py, f64>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (means, positions) = (rows(&means)?, vector("times of nonuniform samples", &positions)?);
    let m = means.first().map_or(0, Vec::len);
    let samples = run_detached(py, || {
        let interpolation = SampleInterpolation::new(positions, m)?;
        Ok(means.iter().map(|row| interpolation.interpolate(row)).collect::<Vec<_>>())
    })?;
    stack_rows(py, &samples)
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn kink_correction<'py>(
    py: Python<'py>,
    m: usize,
    positions: PyReadonlyArray1<'py, f64>,
    jumps: (PyReadonlyArray1<'py, f64>, PyReadonlyArray1<'py, f64>),
    order: f64,
    step: f64,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let positions = vector("times of nonuniform samples", &positions)?;
    let interpolation = SampleInterpolation::new(positions, m)?;
    let jumps = jumps_at_samples(&interpolation, &jumps.0, &jumps.1)?;
    let correction = run_detached(py, || Ok(interpolation.kink_corrections(&jumps, order, step)))?;
    Ok(PyArray1::from_vec(py, correction))
}

/// [(exponent, coefficient), …] of the initial terms by equation.
type TermsList = Vec<Vec<(f64, f64)>>;

/// (samples of the outputs as rows, initial terms).
type SamplesTuple<'py> = (Bound<'py, PyArray2<f64>>, TermsList);

fn samples_tuple<'py>(py: Python<'py>, samples: OutputSamples) -> PyResult<SamplesTuple<'py>> {
    Ok((stack_rows(py, &samples.outputs)?, samples.initial))
}

/// Model with known orders and coefficients on a recording, whose outputs can be simulated.
#[pyclass(module = "ftlm._core", frozen)]
pub struct OutputSimulation {
    inner: Arc<output_samples::OutputSimulation>,
    /// Number of values of all signals on a grid of one pulse per sampling interval.
    points: usize,
}

/// Initial terms: (true to fit their coefficients, [(exponent, coefficient), …] by equation, true to fit levels as
/// well).
type TermsArg = (bool, List<List<(f64, f64)>>, bool);

fn initial_terms((fitted, terms, has_level): TermsArg) -> InitialTerms {
    let terms = to_vectors(terms);
    if fitted {
        let exponents = terms.into_iter().map(|terms| terms.into_iter().map(|term| term.0).collect()).collect();
        InitialTerms::Fitted { exponents, has_level }
    } else {
        InitialTerms::Given(terms)
    }
}

#[pymethods]
impl OutputSimulation {
    #[new]
    #[pyo3(signature = (run, model, frictions, times, derived=List::default()))]
    #[allow(clippy::needless_pass_by_value)]
    fn new(
        run: Py<Recording>,
        model: List<EquationArg>,
        frictions: List<(usize, (f64, f64, f64))>,
        times: Option<PyReadonlyArray1<'_, f64>>,
        derived: List<DerivedArg>,
    ) -> PyResult<Self> {
        let run = Arc::clone(&run.get().inner);
        let derived = derived_signals(derived)?;
        let signals = run.channels().len() + derived.len();
        let equations = equations(model, signals, &vec![true; signals])?;
        let law = |(equation, (coulomb, stribeck, speed))| (equation, FrictionLaw { coulomb, stribeck, speed });
        let frictions = frictions.into_iter().map(law).collect();
        let times = times.as_ref().map(|times| vector("sample times", times)).transpose()?;
        let points = run.len().saturating_mul(run.channels().len());
        super::errors::run_attached(|| {
            let inner = if derived.is_empty() {
                output_samples::OutputSimulation::new(run, equations, frictions, times)?
            } else {
                output_samples::OutputSimulation::with_derived(run, equations, frictions, derived, times)?
            };
            Ok(Self { inner: Arc::new(inner), points })
        })
    }

    /// Return (samples, initial terms) of a simulation on a grid of `pulses_per_sample` pulses per sampling interval.
    #[pyo3(signature = (pulses_per_sample, terms, stop=None))]
    fn samples<'py>(
        &self,
        py: Python<'py>,
        pulses_per_sample: usize,
        terms: TermsArg,
        stop: Option<&Stop>,
    ) -> PyResult<SamplesTuple<'py>> {
        let (inner, initial) = (Arc::clone(&self.inner), initial_terms(terms));
        let points = self.points.saturating_mul(pulses_per_sample);
        samples_tuple(py, run_interruptible(py, points, stop, move |_| inner.samples(pulses_per_sample, &initial))?)
    }

    /// Return (exact samples, initial terms) of a model with integer orders. None if the model must be discretized by
    /// block pulses.
    #[pyo3(signature = (terms, stop=None))]
    fn exact_samples<'py>(
        &self,
        py: Python<'py>,
        terms: TermsArg,
        stop: Option<&Stop>,
    ) -> PyResult<Option<SamplesTuple<'py>>> {
        let (inner, initial) = (Arc::clone(&self.inner), initial_terms(terms));
        let exact = run_interruptible(py, self.points, stop, move |stop| inner.exact_samples(&initial, stop))?;
        exact.map(|samples| samples_tuple(py, samples)).transpose()
    }

    /// Refine the step. Return ((extrapolated samples, initial terms), pulses per sampling interval at the shortest
    /// step, change of each output). The change is the one expected if the step is halved again, relative to the
    /// largest magnitude of the output.
    #[pyo3(signature = (terms, tolerance, max_pulses, long_record_intervals, memory, stop=None))]
    #[allow(clippy::too_many_arguments)]
    fn refine<'py>(
        &self,
        py: Python<'py>,
        terms: TermsArg,
        tolerance: f64,
        max_pulses: usize,
        long_record_intervals: usize,
        memory: usize,
        stop: Option<&Stop>,
    ) -> PyResult<(SamplesTuple<'py>, usize, Bound<'py, PyArray1<f64>>)> {
        let (inner, initial) = (Arc::clone(&self.inner), initial_terms(terms));
        let options = Refinement { tolerance, max_pulses, long_record_intervals, memory };
        // The number of refinements is not known beforehand, so the work always runs on a separate thread.
        let samples = run_interruptible(py, usize::MAX, stop, move |stop| inner.refine(&initial, options, stop))?;
        Ok((samples_tuple(py, samples.samples)?, samples.refinement, PyArray1::from_vec(py, samples.change)))
    }

    /// Return the initial terms that represent past inputs, as (exponent, coefficient) by equation. They are the
    /// posterior mean under a prior on these inputs. `exponents` and `free` are the exponents of all terms and of those
    /// without a prior, by equation. None if a response is not finite.
    #[pyo3(signature = (exponents, free, has_level, tolerance, max_pulses, long_record_intervals, memory, stop=None))]
    #[allow(clippy::too_many_arguments)]
    fn fit_past_inputs(
        &self,
        py: Python<'_>,
        exponents: List<List<f64>>,
        free: List<List<f64>>,
        has_level: bool,
        tolerance: f64,
        max_pulses: usize,
        long_record_intervals: usize,
        memory: usize,
        stop: Option<&Stop>,
    ) -> PyResult<Option<TermsList>> {
        let (inner, exponents, free) = (Arc::clone(&self.inner), to_vectors(exponents), to_vectors(free));
        let options = Refinement { tolerance, max_pulses, long_record_intervals, memory };
        run_interruptible(py, usize::MAX, stop, move |stop| {
            inner.fit_past_inputs(&exponents, &free, has_level, options, stop)
        })
    }

    /// Fit the initial terms of a model with friction or non-linear terms to the measured outputs. Return (exponent,
    /// coefficient) of each term, by equation.
    #[pyo3(signature = (initial_terms, pulses_per_sample, stop=None))]
    fn fit_initial_states(
        &self,
        py: Python<'_>,
        initial_terms: InitialArg,
        pulses_per_sample: usize,
        stop: Option<&Stop>,
    ) -> PyResult<TermsList> {
        let (inner, initial) = (Arc::clone(&self.inner), initial(initial_terms)?);
        run_interruptible(py, usize::MAX, stop, move |stop| inner.fit_initial_states(initial, pulses_per_sample, stop))
    }
}

/// Extrapolate samples, simulated with the steps h, h/2, h/4, …, to zero step. Return (samples, relative change of each
/// output, extrapolated additional values). `outputs` holds the output index of each additional value.
#[pyfunction]
#[allow(clippy::needless_pass_by_value, clippy::type_complexity)]
pub fn richardson_limit<'py>(
    py: Python<'py>,
    grids: List<(PyReadonlyArray2<'py, f64>, List<f64>)>,
    outputs: List<usize>,
) -> PyResult<(Bound<'py, PyArray2<f64>>, Bound<'py, PyArray1<f64>>, Vec<f64>)> {
    let grids = grids.iter().map(|(samples, values)| Ok((rows(samples)?, values.to_vec())));
    let grids = grids.collect::<PyResult<Vec<_>>>()?;
    let limit = run_detached(py, || {
        for (samples, values) in &grids {
            check_length(
                "outputs of a grid",
                grids[0].0.len().max(outputs.iter().max().map_or(0, |o| o + 1)),
                samples.len(),
            )?;
            check_length("additional values of a grid", outputs.len(), values.len())?;
        }
        Ok(output_samples::richardson_limit(grids, &outputs).unwrap_or_default())
    })?;
    Ok((stack_rows(py, &limit.samples)?, PyArray1::from_vec(py, limit.change), limit.terms))
}

//! Bindings of least squares, multi-innovation least squares, instrumental variables and experiments.

use numpy::{PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use super::convert::{
    check_size, initial, prior, record, records, rows, stack_rows, structure, to_vectors, vector, InitialArg, List,
    RecordArg, StructureArg,
};
use super::errors::{run_attached, run_detached};
use super::recording::Experiment;
use crate::equation::Initial;
use crate::error::{check_finite, check_length, Error};
use crate::estimation::instrumental_variables as instruments;
use crate::estimation::least_squares::{self as least_squares_estimator, Estimate};
use crate::estimation::multi_innovation::{self as multi_innovation_estimator, Innovation, RowBasis};
use crate::estimation::output_error;
use crate::estimation::resonance_scan;
use crate::estimation::streaming::{Streaming as StreamingFit, StreamingOptions};
use crate::python::order_search::watch::run_interruptible;
use crate::regressors::Record;
use crate::signal::block_pulse::{Jumps, SampleInterpolation};

/// (coefficients, coefficients of the initial terms by record, exponents of the initial terms, [(record, position), …]
/// of the initial terms that were excluded as linearly dependent).
pub type EstimateTuple = (Vec<f64>, Vec<Vec<f64>>, Vec<f64>, Vec<(usize, usize)>);

/// Return the total number of pulses of all records.
pub fn count_pulses(records: &[Record]) -> usize {
    records.iter().map(Record::m).sum()
}

/// Return the total number of pulses of all experiments times the maximum number of evaluations.
pub fn count_evaluated_pulses(experiments: &[output_error::Experiment], evaluations: usize) -> usize {
    experiments.iter().map(|e| e.record.m()).sum::<usize>().saturating_mul(evaluations)
}

fn estimate_tuple(estimate: Estimate) -> EstimateTuple {
    (estimate.coefficients, estimate.initial, estimate.exponents, estimate.excluded_terms)
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn least_squares(
    py: Python<'_>,
    runs: List<RecordArg<'_>>,
    equation: StructureArg,
    inputs: List<bool>,
    fixed: List<Option<f64>>,
    terms: InitialArg,
) -> PyResult<EstimateTuple> {
    let records = records(&runs)?;
    let structure = structure(equation, inputs.len(), &inputs)?;
    let initial = initial(terms)?;
    let points = count_pulses(&records);
    Ok(estimate_tuple(run_interruptible(py, points, None, move |_| {
        least_squares_estimator::fit(&records, &structure, &fixed, &initial)
    })?))
}

/// (output error, coefficients) of a point; None if they are not finite.
type PointTuple = Option<(f64, Vec<f64>)>;

#[pyfunction]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)]
pub fn projected_errors(
    py: Python<'_>,
    runs: List<RecordArg<'_>>,
    equation: StructureArg,
    inputs: List<bool>,
    fixed: List<Option<f64>>,
    terms: InitialArg,
    autoregressive_orders: List<f64>,
    points: List<List<f64>>,
) -> PyResult<Vec<PointTuple>> {
    let records = records(&runs)?;
    let structure = structure(equation, inputs.len(), &inputs)?;
    let initial = initial(terms)?;
    let points: Vec<Vec<f64>> = points.iter().map(|point| point.to_vec()).collect();
    let work = count_pulses(&records).saturating_mul(points.len());
    let projections = run_interruptible(py, work, None, move |_| {
        resonance_scan::fit_with_fixed_poles(&records, &structure, &fixed, &initial, &autoregressive_orders, &points)
    })?;
    Ok(projections.into_iter().map(|projection| projection.map(|p| (p.error, p.coefficients))).collect())
}

#[pyfunction]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value, clippy::type_complexity)]
pub fn multi_innovation<'py>(
    py: Python<'py>,
    runs: List<RecordArg<'py>>,
    equation: StructureArg,
    inputs: List<bool>,
    fixed: List<Option<f64>>,
    terms: InitialArg,
    length: usize,
    prior_covariance: Option<f64>,
    haar: bool,
    recursion: bool,
) -> PyResult<(EstimateTuple, Option<Bound<'py, PyArray2<f64>>>)> {
    let records = records(&runs)?;
    let structure = structure(equation, inputs.len(), &inputs)?;
    let initial = initial(terms)?;
    let points = count_pulses(&records);
    let row_basis = if haar { RowBasis::Haar } else { RowBasis::Time };
    let innovation = Innovation { length, prior: prior(prior_covariance), row_basis };
    if recursion {
        let (estimate, trace) = run_interruptible(py, points, None, move |_| {
            multi_innovation_estimator::recursion(&records, &structure, &fixed, &initial, &innovation)
        })?;
        return Ok((estimate_tuple(estimate), Some(stack_rows(py, &trace)?)));
    }
    let estimate = run_interruptible(py, points, None, move |_| {
        multi_innovation_estimator::closed_form(&records, &structure, &fixed, &initial, &innovation)
    })?;
    Ok((estimate_tuple(estimate), None))
}

/// Result of refined instrumental variables: estimate and covariance of each equation, and convergence of the
/// iteration.
#[derive(IntoPyObject)]
pub struct InstrumentalFit {
    estimates: Vec<EstimateTuple>,
    covariances: Vec<Vec<f64>>,
    iterations: usize,
    converged: bool,
    damped: bool,
}

#[pyfunction]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)]
pub fn instrumental_variables(
    py: Python<'_>,
    runs: List<RecordArg<'_>>,
    equations: List<StructureArg>,
    inputs: List<bool>,
    fixed: List<List<Option<f64>>>,
    terms: InitialArg,
    iterations: usize,
    tolerance: f64,
) -> PyResult<InstrumentalFit> {
    let measured = records(&runs)?;
    let structures =
        equations.into_iter().map(|e| structure(e, inputs.len(), &inputs)).collect::<PyResult<Vec<_>>>()?;
    let (initial, fixed) = (initial(terms)?, to_vectors(fixed));
    let settings = instruments::InstrumentalSettings { iterations, tolerance };
    let points = count_pulses(&measured).saturating_mul(iterations.max(1));
    let fit = run_interruptible(py, points, None, move |stop| {
        let at_rest = initial == Initial::Rest;
        let measured = measured
            .into_iter()
            .map(|r| instruments::with_projections(r, &inputs, at_rest, stop))
            .collect::<Result<Vec<_>, _>>()?;
        instruments::fit(&measured, &structures, &fixed, &initial, settings)
    })?;
    let (mut estimates, mut covariances) = (Vec::new(), Vec::new());
    for e in fit.estimates {
        estimates.push((e.coefficients, e.initial, e.exponents, Vec::new()));
        covariances.push(e.covariance);
    }
    let (iterations, converged, damped) = (fit.iterations, fit.converged, fit.damped);
    Ok(InstrumentalFit { estimates, covariances, iterations, converged, damped })
}

/// Nonuniform samples as a pair. The first element holds the sample positions, in pulses. The second holds the jumps of
/// each signal as (positions in pulses, sizes), None for a signal that is not a zero-order hold.
pub type NonuniformSamplesArg<'py> =
    (PyReadonlyArray1<'py, f64>, List<Option<(PyReadonlyArray1<'py, f64>, PyReadonlyArray1<'py, f64>)>>);
/// Experiment from a dictionary with these fields as keys. `samples` and `robust_weights` have one row per output.
/// `filter` holds (power series, flag of each output) of the filter for simulated outputs. `signals` holds (values at
/// the samples, true for a zero-order hold) of each signal.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct ExperimentFields<'py> {
    record: RecordArg<'py>,
    pulses_per_sample: usize,
    samples: PyReadonlyArray2<'py, f64>,
    filter: Option<(PyReadonlyArray1<'py, f64>, List<bool>)>,
    weights: List<f64>,
    signals: List<(Option<PyReadonlyArray1<'py, f64>>, bool)>,
    robust_weights: Option<PyReadonlyArray2<'py, f64>>,
    sample_times: Option<NonuniformSamplesArg<'py>>,
}

/// Experiment that the core sampled, or a dictionary of its fields.
#[derive(FromPyObject)]
#[allow(clippy::large_enum_variant)] // one value per run
pub enum ExperimentArg<'py> {
    Sampled(Py<Experiment>),
    Given(ExperimentFields<'py>),
}

/// Return the jumps of a zero-order-hold signal, assigned to the sample times near them. Return an error if the times
/// of the jumps do not ascend.
pub fn jumps_at_samples(
    interpolation: &SampleInterpolation,
    positions: &PyReadonlyArray1<'_, f64>,
    sizes: &PyReadonlyArray1<'_, f64>,
) -> PyResult<Jumps> {
    let (positions, sizes) = (vector("times of jumps", positions)?, vector("jumps", sizes)?);
    check_length("jumps", positions.len(), sizes.len())?;
    if let Some(k) = positions.windows(2).position(|pair| pair[0] > pair[1]) {
        let what = format!("the jump times decrease at index {k}");
        return Err(Error::Structure { what, remedy: "give them in ascending order".into() }.into());
    }
    Ok(interpolation.jumps(&positions, &sizes))
}

pub fn experiment(argument: &ExperimentArg<'_>) -> PyResult<output_error::Experiment> {
    let argument = match argument {
        ExperimentArg::Sampled(experiment) => return Ok(experiment.get().inner.clone()),
        ExperimentArg::Given(argument) => argument,
    };
    let (record, samples, weights) = (record(&argument.record)?, rows(&argument.samples)?, argument.weights.to_vec());
    let experiment = match &argument.sample_times {
        None => output_error::Experiment::new(record, argument.pulses_per_sample, samples, weights)?,
        Some((positions, jumps)) => {
            let interpolation =
                SampleInterpolation::new(vector("times of nonuniform samples", positions)?, record.m())?;
            let jumps = (jumps.iter())
                .map(|signal| {
                    let Some((positions, sizes)) = signal else { return Ok(None) };
                    Ok(Some(jumps_at_samples(&interpolation, positions, sizes)?))
                })
                .collect::<PyResult<Vec<_>>>()?;
            output_error::Experiment::with_nonuniform_samples(
                record,
                samples,
                weights,
                output_error::NonuniformSamples { interpolation, jumps },
            )?
        }
    };
    let experiment = match &argument.robust_weights {
        None => experiment,
        Some(weights) => experiment.with_sample_weights(rows(weights)?)?,
    };
    let point_values = (argument.signals.iter())
        .map(|(values, is_hold)| {
            let values = values.as_ref().map(|v| vector("signal at the samples", v)).transpose()?;
            Ok(output_error::PointValues { values, is_zero_order_hold: *is_hold })
        })
        .collect::<PyResult<Vec<_>>>()?;
    let experiment = experiment.with_point_values(point_values)?;
    Ok(match &argument.filter {
        None => experiment,
        Some((series, applies)) => experiment.with_filter(vector("filter", series)?, applies.to_vec())?,
    })
}

/// Return the termination status of an optimization as text.
pub fn status(status: output_error::Status) -> &'static str {
    match status {
        output_error::Status::Converged => "converged",
        output_error::Status::Exhausted => "exhausted",
        output_error::Status::Stalled => "stalled",
        output_error::Status::DomainLimit => "domain limit",
    }
}

/// Return true if s^alpha minus the terms c s^order of (c, order) in `output_terms` has a zero in the closed right
/// half-plane.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn has_unstable_pole(py: Python<'_>, alpha: f64, output_terms: List<(f64, f64)>) -> PyResult<bool> {
    run_detached(py, || {
        check_finite("alpha", &[alpha])?;
        output_terms.iter().try_for_each(|&(c, order)| check_finite("output terms", &[c, order]))?;
        Ok(output_error::stability::is_unstable(alpha, &output_terms))
    })
}

/// Multi-innovation recursion, eq. (44) of the paper, on a stream of samples. See module `estimation::streaming` of
/// the core.
#[pyclass(module = "ftlm._core")]
pub struct Streaming {
    inner: StreamingFit,
}

#[pymethods]
impl Streaming {
    #[new]
    #[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        step: f64,
        max_pulses: usize,
        inputs: List<bool>,
        equations: List<(StructureArg, List<Option<f64>>)>,
        length: usize,
        prior_covariance: Option<f64>,
        forgetting: f64,
        terms: InitialArg,
    ) -> PyResult<Self> {
        let equations = equations
            .into_iter()
            .map(|(equation, fixed)| Ok((structure(equation, inputs.len(), &inputs)?, fixed.into())))
            .collect::<PyResult<Vec<_>>>()?;
        let options = StreamingOptions { length, prior: prior(prior_covariance), forgetting, initial: initial(terms)? };
        let inner = run_detached(py, || StreamingFit::new(step, max_pulses, &inputs, &equations, options))?;
        Ok(Self { inner })
    }

    /// Append samples, shape (n, signals). Return the coefficients of all equations after each sample, shape (n,
    /// coefficients).
    #[allow(clippy::needless_pass_by_value)]
    fn push<'py>(
        &mut self,
        py: Python<'py>,
        samples: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        check_size(&samples)?;
        let (length, width) = (samples.shape()[0], samples.shape()[1]);
        let (values, count): (Vec<f64>, usize) =
            (samples.as_array().iter().copied().collect(), self.inner.coefficient_count());
        let inner = &mut self.inner;
        let path = run_detached(py, || {
            let mut path = Vec::with_capacity(length * count);
            for row in 0..length {
                inner.push(&values[row * width..(row + 1) * width])?;
                inner.append_coefficients(&mut path);
            }
            Ok(path)
        })?;
        PyArray1::from_vec(py, path).reshape([length, count])
    }

    #[getter]
    fn coefficients(&self) -> PyResult<Vec<Vec<f64>>> {
        run_attached(|| Ok(self.inner.coefficients()))
    }

    #[getter]
    fn pulses(&self) -> PyResult<usize> {
        run_attached(|| Ok(self.inner.pulses()))
    }
}

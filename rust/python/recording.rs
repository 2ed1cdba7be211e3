//! Bindings of recordings and of the experiments sampled from them.

use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;

use super::convert::{copy_vector, rows, stack_rows, vector, List};
use super::errors::{run_attached, run_detached};
use crate::equation::Filter;
use crate::error::{check_length, Error, Result};
use crate::estimation::output_error::{self, InputLaw};
use crate::python::order_search::watch::run_interruptible;
use crate::recording::{self, Channel, Recordings, Role, Sampling};
use crate::signal::block_pulse::{Intersample, PulseMeans};
use crate::signal::nonuniform::NonuniformSignal;

type Array<'py> = Bound<'py, PyArray1<f64>>;
type Table<'py> = Bound<'py, PyArray2<f64>>;

/// Signal from a dictionary with these fields as keys. `nonuniform` holds the samples at the nonuniform sample times of
/// the run, and `delay` is in seconds. `limits` holds (law, value or None if free) of each saturation and dead zone.
/// `enters_others` is true if the signal enters the equation of another output.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct ChannelArg<'py> {
    name: String,
    samples: PyReadonlyArray1<'py, f64>,
    nonuniform: Option<PyReadonlyArray1<'py, f64>>,
    role: String,
    delay: Option<f64>,
    limits: List<(String, Option<f64>)>,
    filtered: bool,
    enters_others: bool,
}

/// Sensor filter as (coefficient, order) pairs: those of the numerator, then those of the denominator.
type FilterArg = (List<(f64, f64)>, List<(f64, f64)>);

/// Run from a dictionary with these fields as keys. `free` holds (index of the signal, law) of each free delay,
/// saturation and dead zone.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct RunArg<'py> {
    name: String,
    step: f64,
    times: Option<PyReadonlyArray1<'py, f64>>,
    signals: List<ChannelArg<'py>>,
    outputs: List<usize>,
    filter: Option<FilterArg>,
    filter_states: usize,
    at_rest: bool,
    coupled: bool,
    friction: bool,
    free: List<(usize, String)>,
}

/// Return the law of an input by its name: `delay`, `saturation` or `dead_zone`.
pub fn input_law(name: &str) -> Result<InputLaw> {
    match name {
        "delay" => Ok(InputLaw::Delay),
        "saturation" => Ok(InputLaw::Saturation),
        "dead_zone" => Ok(InputLaw::DeadZone),
        other => Err(Error::Structure {
            what: format!("law '{other}' of an input is not known"),
            remedy: "use delay, saturation or dead_zone".into(),
        }),
    }
}

fn role(name: &str) -> Result<Role> {
    match name {
        "zoh" => Ok(Role::Input(Intersample::Hold)),
        "foh" => Ok(Role::Input(Intersample::Linear)),
        "output" => Ok(Role::Output),
        "derived" => Ok(Role::Derived),
        other => Err(Error::Structure {
            what: format!("role '{other}' of a signal is not known"),
            remedy: "use zoh, foh, output or derived".into(),
        }),
    }
}

fn channel(argument: &ChannelArg<'_>) -> PyResult<Channel> {
    let samples = |values| copy_vector("samples", values);
    let limits = argument.limits.iter().map(|(law, value)| Ok((input_law(law)?, *value)));
    Ok(Channel {
        nonuniform: argument.nonuniform.as_ref().map(samples).transpose()?,
        delay: argument.delay,
        nonlinearities: limits.collect::<Result<_>>()?,
        is_filtered: argument.filtered,
        enters_others: argument.enters_others,
        ..Channel::new(&argument.name, samples(&argument.samples)?, role(&argument.role)?)
    })
}

/// Pulse means: (step, means of each signal as rows, power series of the sensor filter or None, initial state). The
/// initial state is (flag of a filter transient in each signal, initial levels, filter responses as rows or None).
type PulsesTuple<'py> = (f64, Table<'py>, Option<Array<'py>>, (Vec<bool>, Vec<f64>, Option<Table<'py>>));

/// Run that the core can sample on any grid of block pulses.
#[pyclass(module = "ftlm._core", frozen)]
pub struct Recording {
    pub(super) inner: Arc<recording::Recording>,
}

#[pymethods]
impl Recording {
    #[new]
    #[allow(clippy::needless_pass_by_value)]
    fn new(run: RunArg<'_>) -> PyResult<Self> {
        let times = run.times.as_ref().map(|times| vector("sample times", times)).transpose()?;
        let channels = run.signals.iter().map(channel).collect::<PyResult<_>>()?;
        let free = run.free.iter().map(|(signal, law)| Ok((*signal, input_law(law)?)));
        let free_inputs = free.collect::<Result<_>>()?;
        let filter = run
            .filter
            .map(|(numerator, denominator)| Filter { numerator: numerator.into(), denominator: denominator.into() });
        run_attached(|| {
            let mut inner = recording::Recording::new(&run.name, run.step, times, channels, run.outputs.to_vec())?;
            inner.filter = filter;
            inner.filter_states = run.filter_states;
            inner.is_at_rest = run.at_rest;
            inner.is_coupled = run.coupled;
            inner.has_friction = run.friction;
            inner.free_inputs = free_inputs;
            Ok(Self { inner: Arc::new(inner) })
        })
    }

    /// Return the means of all signals over `m` pulses. If `filtered`, the sensor filter is applied to signals that
    /// were not measured through it.
    fn pulses<'py>(&self, py: Python<'py>, m: usize, filtered: bool) -> PyResult<PulsesTuple<'py>> {
        let run = Arc::clone(&self.inner);
        let points = m.saturating_mul(run.channels().len());
        let block_pulses = run_interruptible(py, points, None, move |_| run.pulses(m, filtered))?;
        let means: Vec<_> = block_pulses.means.into_iter().map(PulseMeans::into_vec).collect();
        let responses = &block_pulses.impulse_responses;
        let responses = if responses.is_empty() { None } else { Some(stack_rows(py, responses)?) };
        let series = block_pulses.filter.map(|series| PyArray1::from_vec(py, series));
        Ok((
            block_pulses.step,
            stack_rows(py, &means)?,
            series,
            (block_pulses.has_transient, block_pulses.initial_levels, responses),
        ))
    }

    /// Return the experiment with `pulses_per_sample` pulses per sampling interval and decimated samples. `weights`
    /// holds the weights of the outputs, and `robust_weights` those of the compared samples, one row per output.
    #[pyo3(signature = (pulses_per_sample, decimation, weights, robust_weights=None))]
    #[allow(clippy::needless_pass_by_value)]
    fn experiment(
        &self,
        py: Python<'_>,
        pulses_per_sample: usize,
        decimation: usize,
        weights: List<f64>,
        robust_weights: Option<PyReadonlyArray2<'_, f64>>,
    ) -> PyResult<Experiment> {
        let robust_weights = robust_weights.as_ref().map(rows).transpose()?;
        let run = Arc::clone(&self.inner);
        let points = run.len().saturating_mul(pulses_per_sample).saturating_mul(run.channels().len());
        let inner = run_interruptible(py, points, None, move |_| {
            let sampling = Sampling { pulses_per_sample, decimation, ..Sampling::default() };
            let experiment = run.experiment(sampling)?.with_weights(&weights, robust_weights.as_deref())?;
            experiment.check()?;
            Ok(experiment)
        })?;
        Ok(Experiment { inner })
    }

    /// Return the times \[s\] and sizes of the jumps of a zero-order-hold input; None for other signals.
    fn jumps<'py>(&self, py: Python<'py>, signal: usize) -> PyResult<Option<(Array<'py>, Array<'py>)>> {
        self.inner.channel(signal)?;
        let jumps = run_detached(py, || Ok(self.inner.jumps(signal)))?;
        Ok(jumps.map(|(times, sizes)| (PyArray1::from_vec(py, times), PyArray1::from_vec(py, sizes))))
    }

    /// Return the values of a signal just after the given times \[s\]; None for a derived signal.
    #[allow(clippy::needless_pass_by_value)]
    fn values_at<'py>(
        &self,
        py: Python<'py>,
        signal: usize,
        times: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Option<Array<'py>>> {
        self.inner.channel(signal)?;
        let times = vector("times", &times)?;
        Ok(run_detached(py, || Ok(self.inner.values_at(signal, &times)))?.map(|values| PyArray1::from_vec(py, values)))
    }

    /// Return the samples of a signal as it enters the equations. Known saturations and dead zones are applied, and the
    /// initial transient of the sensor filter is removed.
    fn acting_samples<'py>(&self, py: Python<'py>, signal: usize) -> PyResult<Array<'py>> {
        self.inner.channel(signal)?;
        Ok(PyArray1::from_vec(py, run_detached(py, || Ok(self.inner.acting_samples(signal).into_owned()))?))
    }
}

/// Run sampled on one grid of block pulses, with the samples to compare with a simulation.
#[pyclass(module = "ftlm._core", frozen)]
pub struct Experiment {
    pub(super) inner: output_error::Experiment,
}

#[pymethods]
impl Experiment {
    /// Number of compared samples of each output.
    #[getter]
    fn compared_count(&self) -> PyResult<usize> {
        run_attached(|| Ok(self.inner.compared_count()))
    }

    /// Weights of the compared samples, one row per output; None if all weights are 1.
    #[getter]
    fn robust_weights<'py>(&self, py: Python<'py>) -> PyResult<Option<Table<'py>>> {
        let weights = run_attached(|| Ok(&self.inner.sample_weights))?;
        if weights.is_empty() {
            Ok(None)
        } else {
            stack_rows(py, weights).map(Some)
        }
    }
}

/// Return the exact means of a signal with nonuniform sample times over `m` pulses of length `step` \[s\]. The signal
/// is constant between samples if `hold`, otherwise linear.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn nonuniform_means<'py>(
    py: Python<'py>,
    times: PyReadonlyArray1<'py, f64>,
    samples: PyReadonlyArray1<'py, f64>,
    m: usize,
    step: f64,
    hold: bool,
) -> PyResult<Array<'py>> {
    let (times, samples) = (vector("times", &times)?, vector("samples", &samples)?);
    let interpolation = if hold { Intersample::Hold } else { Intersample::Linear };
    let means = run_detached(py, || NonuniformSignal::new(&times, &samples, interpolation)?.means(m, step))?;
    Ok(PyArray1::from_vec(py, means.into_vec()))
}

/// Return the runs of a fit. Return an error if a run does not have the given numbers of signals and free input
/// parameters, and the given outputs.
pub fn recordings(runs: &[Py<Recording>], signals: usize, outputs: &[usize], free: usize) -> Result<Recordings> {
    let runs = Recordings::new(runs.iter().map(|run| Arc::clone(&run.get().inner)).collect())?;
    if let Some(run) = runs.runs().next() {
        check_length("signals of a run", signals, run.channels().len())?;
        check_length("free input parameters of a run", free, run.free_inputs.len())?;
        if run.outputs() != outputs {
            let what = format!("the run has outputs {:?}, but the problem has outputs {outputs:?}", run.outputs());
            return Err(Error::Structure { what, remedy: "create the run and the problem from one structure".into() });
        }
    }
    Ok(runs)
}

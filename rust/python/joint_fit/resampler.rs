//! Data source that samples runs by Python callbacks during a fit. Responses are cached.

use std::cell::RefCell;
use std::collections::BTreeMap;

use numpy::PyReadonlyArray1;
use pyo3::prelude::*;

use crate::error::{check_step, Error};
use crate::estimation::joint_fit::{Recordings, Sampling, Source};
use crate::estimation::output_error::Experiment;
use crate::python::convert::{records, List, RecordArg};
use crate::python::estimation::{experiment, ExperimentArg};
use crate::python::order_search::watch::RequestChannel;
use crate::regressors::Record;
use crate::signal::block_pulse::Intersample;

/// Runs: (object with methods sampled, records and read; sampling interval and duration of each run \[s\]; inter-sample
/// behavior of each signal, None for outputs; progress callback).
pub type RunsArg = (Py<PyAny>, List<(f64, f64)>, List<Option<String>>, Option<Py<PyAny>>);

/// Request from the core to Python.
pub enum Request {
    /// Runs sampled on a grid.
    Experiments(Sampling),
    /// Records of so many pulses, with inputs transformed by these parameters.
    Records(usize, Vec<f64>),
    /// Samples of a signal.
    Samples(usize),
    /// Progress: steps done and total.
    Progress(usize, usize),
}

/// Response of Python to a request.
pub enum Response {
    /// Response to a grid.
    Experiments(Vec<Experiment>),
    /// Response to records.
    Records(Vec<Record>),
    /// Response to samples, by run.
    Samples(Vec<Vec<f64>>),
    /// Response to progress.
    Empty,
}

/// Properties of the runs that need no request.
pub struct RunProperties {
    spans: Vec<(f64, f64)>,
    inputs: Vec<Option<Intersample>>,
}

impl RunProperties {
    /// Properties from an argument, and the resampler.
    pub fn of(argument: RunsArg) -> PyResult<(Self, PythonResampler)> {
        let (runs, spans, inputs, told) = argument;
        for &(step, duration) in spans.iter() {
            check_step(step)?;
            check_step(duration)?;
        }
        let between = |word: &Option<String>| match word.as_deref() {
            None => Ok(None),
            Some("zoh") => Ok(Some(Intersample::Hold)),
            Some("foh") => Ok(Some(Intersample::Linear)),
            Some(other) => Err(Error::Structure {
                what: format!("'{other}' is nothing that an input does between samples"),
                remedy: "use zoh or foh".into(),
            }),
        };
        let inputs = inputs.iter().map(between).collect::<Result<_, _>>()?;
        Ok((Self { spans: spans.into(), inputs }, PythonResampler { runs, told }))
    }
}

/// Python object that serves requests while Python is attached.
pub struct PythonResampler {
    runs: Py<PyAny>,
    told: Option<Py<PyAny>>,
}

impl PythonResampler {
    /// Serve a request.
    pub fn answer(&self, py: Python<'_>, question: Request) -> PyResult<Response> {
        Ok(match question {
            Request::Experiments(Sampling { pulses_per_sample: every, decimation, leading_intervals: first }) => {
                let given: List<ExperimentArg<'_>> =
                    self.runs.call_method1(py, "sample", (every, decimation, first))?.extract(py)?;
                Response::Experiments(given.iter().map(experiment).collect::<PyResult<_>>()?)
            }
            Request::Records(m, inputs) => {
                let given: List<RecordArg<'_>> = self.runs.call_method1(py, "records", (m, inputs))?.extract(py)?;
                Response::Records(records(&given)?)
            }
            Request::Samples(signal) => {
                let given: List<PyReadonlyArray1<'_, f64>> =
                    self.runs.call_method1(py, "read", (signal,))?.extract(py)?;
                Response::Samples(given.iter().map(|samples| samples.as_array().to_vec()).collect())
            }
            Request::Progress(done, of) => {
                if let Some(told) = &self.told {
                    told.call1(py, (done, of))?;
                }
                Response::Empty
            }
        })
    }
}

/// Records by number of pulses and the bits of the input parameters.
type Records = BTreeMap<(usize, Vec<u64>), Vec<Record>>;

/// Source of runs that sends requests to Python.
pub struct CallbackSource<'a, T> {
    desk: &'a RequestChannel<Request, Response, T>,
    known: RunProperties,
    samples: RefCell<BTreeMap<usize, Vec<Vec<f64>>>>,
    records: RefCell<Records>,
}

impl<'a, T> CallbackSource<'a, T> {
    /// Source behind a request channel.
    pub fn new(desk: &'a RequestChannel<Request, Response, T>, known: RunProperties) -> Self {
        Self { desk, known, samples: RefCell::default(), records: RefCell::default() }
    }

    /// Report progress.
    pub fn report_progress(&self, done: usize, of: usize) -> Result<(), Error> {
        self.desk.ask(Request::Progress(done, of)).map(drop)
    }
}

fn unexpected_response_error() -> Error {
    Error::Internal { what: "an answer to another question".into() }
}

impl<T> Source for CallbackSource<'_, T> {
    fn spans(&self) -> Vec<(f64, f64)> {
        self.known.spans.clone()
    }

    fn experiments(&self, sampling: Sampling) -> Result<Vec<Experiment>, Error> {
        match self.desk.ask(Request::Experiments(sampling))? {
            Response::Experiments(found) => Ok(found),
            _ => Err(unexpected_response_error()),
        }
    }
}

impl<T> Recordings for CallbackSource<'_, T> {
    fn inputs(&self) -> Vec<Option<Intersample>> {
        self.known.inputs.clone()
    }

    fn samples(&self, signal: usize) -> Result<Vec<Vec<f64>>, Error> {
        if let Some(found) = self.samples.borrow().get(&signal) {
            return Ok(found.clone());
        }
        let Response::Samples(found) = self.desk.ask(Request::Samples(signal))? else {
            return Err(unexpected_response_error());
        };
        self.samples.borrow_mut().insert(signal, found.clone());
        Ok(found)
    }

    fn records(&self, m: usize, inputs: &[f64]) -> Result<Vec<Record>, Error> {
        let key = (m, inputs.iter().map(|v| v.to_bits()).collect::<Vec<_>>());
        if let Some(found) = self.records.borrow().get(&key) {
            return Ok(found.clone());
        }
        let Response::Records(found) = self.desk.ask(Request::Records(m, inputs.into()))? else {
            return Err(unexpected_response_error());
        };
        self.records.borrow_mut().insert(key, found.clone());
        Ok(found)
    }
}

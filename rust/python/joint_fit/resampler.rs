//! Runs that Python samples while the core fits: every question is asked once.

use std::cell::RefCell;
use std::collections::BTreeMap;

use numpy::PyReadonlyArray1;
use pyo3::prelude::*;

use crate::error::{check_step, Error};
use crate::estimation::joint_fit::{Recordings, Sampling, Source};
use crate::estimation::output_error::Experiment;
use crate::python::convert::{records, List, RecordArg};
use crate::python::estimation::{experiment, ExperimentArg};
use crate::python::order_search::watch::Desk;
use crate::regressors::Record;
use crate::signal::block_pulse::Intersample;

/// (its methods sampled, records and read, sample interval and duration of each run \[s\], what each signal does between
/// samples where it is an input, who is told how far a fit is).
pub type RunsArg = (Py<PyAny>, List<(f64, f64)>, List<Option<String>>, Option<Py<PyAny>>);

/// What the core asks.
pub enum Question {
    /// Runs on a grid.
    Experiments(Sampling),
    /// Records of so many pulses, inputs acting with these numbers.
    Records(usize, Vec<f64>),
    /// What was read of a signal.
    Samples(usize),
    /// Nothing: so much of a whole is done.
    Told(usize, usize),
}

/// What Python answers.
pub enum Answer {
    /// To runs on a grid.
    Experiments(Vec<Experiment>),
    /// To records.
    Records(Vec<Record>),
    /// To what was read, by run.
    Samples(Vec<Vec<f64>>),
    /// To being told.
    Heard,
}

/// What is known of the runs without asking.
pub struct Known {
    spans: Vec<(f64, f64)>,
    inputs: Vec<Option<Intersample>>,
}

impl Known {
    /// Of an argument, and who answers.
    pub fn of(argument: RunsArg) -> PyResult<(Self, Answering)> {
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
        Ok((Self { spans: spans.into(), inputs }, Answering { runs, told }))
    }
}

/// Who answers, where Python is attached.
pub struct Answering {
    runs: Py<PyAny>,
    told: Option<Py<PyAny>>,
}

impl Answering {
    /// The answer to a question.
    pub fn answer(&self, py: Python<'_>, question: Question) -> PyResult<Answer> {
        Ok(match question {
            Question::Experiments(Sampling { every, decimation, first }) => {
                let given: List<ExperimentArg<'_>> =
                    self.runs.call_method1(py, "sample", (every, decimation, first))?.extract(py)?;
                Answer::Experiments(given.iter().map(experiment).collect::<PyResult<_>>()?)
            }
            Question::Records(m, inputs) => {
                let given: List<RecordArg<'_>> = self.runs.call_method1(py, "records", (m, inputs))?.extract(py)?;
                Answer::Records(records(&given)?)
            }
            Question::Samples(signal) => {
                let given: List<PyReadonlyArray1<'_, f64>> =
                    self.runs.call_method1(py, "read", (signal,))?.extract(py)?;
                Answer::Samples(given.iter().map(|samples| samples.as_array().to_vec()).collect())
            }
            Question::Told(done, of) => {
                if let Some(told) = &self.told {
                    told.call1(py, (done, of))?;
                }
                Answer::Heard
            }
        })
    }
}

/// Records by their pulses and the bits of the numbers of inputs.
type Records = BTreeMap<(usize, Vec<u64>), Vec<Record>>;

/// The runs, as the core has them.
pub struct Asked<'a, T> {
    desk: &'a Desk<Question, Answer, T>,
    known: Known,
    samples: RefCell<BTreeMap<usize, Vec<Vec<f64>>>>,
    records: RefCell<Records>,
}

impl<'a, T> Asked<'a, T> {
    /// Runs behind a desk.
    pub fn new(desk: &'a Desk<Question, Answer, T>, known: Known) -> Self {
        Self { desk, known, samples: RefCell::default(), records: RefCell::default() }
    }

    /// Tells so much of a whole.
    pub fn tell(&self, done: usize, of: usize) -> Result<(), Error> {
        self.desk.ask(Question::Told(done, of)).map(drop)
    }
}

fn other() -> Error {
    Error::Internal { what: "an answer to another question".into() }
}

impl<T> Source for Asked<'_, T> {
    fn spans(&self) -> Vec<(f64, f64)> {
        self.known.spans.clone()
    }

    fn experiments(&self, sampling: Sampling) -> Result<Vec<Experiment>, Error> {
        match self.desk.ask(Question::Experiments(sampling))? {
            Answer::Experiments(found) => Ok(found),
            _ => Err(other()),
        }
    }
}

impl<T> Recordings for Asked<'_, T> {
    fn inputs(&self) -> Vec<Option<Intersample>> {
        self.known.inputs.clone()
    }

    fn samples(&self, signal: usize) -> Result<Vec<Vec<f64>>, Error> {
        if let Some(found) = self.samples.borrow().get(&signal) {
            return Ok(found.clone());
        }
        let Answer::Samples(found) = self.desk.ask(Question::Samples(signal))? else { return Err(other()) };
        self.samples.borrow_mut().insert(signal, found.clone());
        Ok(found)
    }

    fn records(&self, m: usize, inputs: &[f64]) -> Result<Vec<Record>, Error> {
        let key = (m, inputs.iter().map(|v| v.to_bits()).collect::<Vec<_>>());
        if let Some(found) = self.records.borrow().get(&key) {
            return Ok(found.clone());
        }
        let Answer::Records(found) = self.desk.ask(Question::Records(m, inputs.into()))? else { return Err(other()) };
        self.records.borrow_mut().insert(key, found.clone());
        Ok(found)
    }
}

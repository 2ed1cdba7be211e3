//! Recordings of one structure: the measured runs of a joint fit.

use std::sync::Arc;

use super::channel::{Channel, Role};
use super::run::{Recording, Sampling};
use crate::error::{check_length, check_memory, Error, Result};
use crate::estimation::output_error::Experiment;
use crate::regressors::Record;
use crate::signal::block_pulse::Intersample;

/// Recordings with the same signals and outputs: the runs of a joint fit, shared with other fits.
#[derive(Debug, Clone, PartialEq)]
pub struct Recordings {
    runs: Vec<Arc<Recording>>,
    memory: usize,
}

impl Recordings {
    /// Return the recordings as the data of one fit. They must have the same number of signals, the same outputs and
    /// the same number of free input parameters.
    ///
    /// # Errors
    /// [`Error::Length`] for different numbers of signals or free input parameters, [`Error::Structure`] for different
    /// outputs.
    ///
    /// ```
    /// # fn main() -> ftlm::error::Result<()> {
    /// use ftlm::recording::{Channel, Recording, Recordings, Role, Sampling};
    /// use ftlm::signal::block_pulse::Intersample;
    /// let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// let u = Channel::new("u", vec![1.0, 2.0, 2.0, 2.0], Role::Input(Intersample::Hold));
    /// let runs = Recordings::new(vec![Recording::new("run", 0.1, None, vec![y, u], vec![0])?])?;
    /// let fine = runs.experiments(Sampling { pulses_per_sample: 2, ..Sampling::default() })?;
    /// assert_eq!(fine[0].record.signal(1), [1.0, 1.0, 2.0, 2.0, 2.0, 2.0]);
    /// # Ok(())
    /// # }
    /// ```
    pub fn new<R: Into<Arc<Recording>>>(runs: Vec<R>) -> Result<Self> {
        let runs: Vec<Arc<Recording>> = runs.into_iter().map(Into::into).collect();
        for pair in runs.windows(2) {
            check_length("signals of a run", pair[0].channels().len(), pair[1].channels().len())?;
            check_length("free input parameters of a run", pair[0].free_inputs.len(), pair[1].free_inputs.len())?;
            if pair[0].outputs() != pair[1].outputs() {
                let what =
                    format!("the runs have different outputs, {:?} and {:?}", pair[1].outputs(), pair[0].outputs());
                return Err(Error::Structure {
                    what,
                    remedy: "create the run and the problem from one structure".into(),
                });
            }
        }
        Ok(Self { runs, memory: usize::MAX })
    }

    /// Return the recordings with a memory limit \[bytes\] for all experiments together.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Recordings, Role, Sampling};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// # let runs = Recordings::new(vec![run])?;
    /// assert!(runs.with_memory_limit(100).experiments(Sampling::default()).is_err());
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn with_memory_limit(self, bytes: usize) -> Self {
        Self { memory: bytes, ..self }
    }

    /// The recordings, one per run.
    pub fn runs(&self) -> impl ExactSizeIterator<Item = &Recording> {
        self.runs.iter().map(Arc::as_ref)
    }

    /// Return the sampling interval and the duration of each run \[s\].
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn intervals_and_durations(&self) -> Vec<(f64, f64)> {
        self.runs.iter().map(|run| (run.step(), run.len() as f64 * run.step())).collect()
    }

    /// Return the experiment of each run on a grid of block pulses.
    ///
    /// # Errors
    /// [`Error::Memory`] if the experiments exceed the memory limit. The errors of [`Recording::experiment`] for an
    /// invalid sampling.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Recordings, Role, Sampling};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// # let runs = Recordings::new(vec![run])?;
    /// assert_eq!(runs.experiments(Sampling::default())?[0].compared_count(), 2);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn experiments(&self, sampling: Sampling) -> Result<Vec<Experiment>> {
        sampling.check()?;
        let bytes: usize = self.runs.iter().map(|run| run.bytes(sampling)).fold(0, usize::saturating_add);
        let names = || self.runs.iter().map(|run| format!("'{}'", run.name())).collect::<Vec<_>>().join(", ");
        let pulses_per_sample = sampling.pulses_per_sample;
        check_memory(
            || format!("grids of {pulses_per_sample} pulses per sample of run {}", names()),
            bytes,
            self.memory,
        )?;
        self.runs.iter().map(|run| run.experiment(sampling)).collect()
    }

    /// Return the behavior of each input between samples: a zero-order hold if it has one in any run. None for other
    /// signals.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Recordings, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// # let runs = Recordings::new(vec![run])?;
    /// assert_eq!(runs.inputs(), [None, Some(Intersample::Hold)]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn inputs(&self) -> Vec<Option<Intersample>> {
        let is_zero_order_hold =
            |signal: usize| self.runs.iter().any(|run| run.channels()[signal].is_zero_order_hold());
        let input_behavior = |(signal, channel): (usize, &Channel)| match channel.role {
            Role::Input(_) if is_zero_order_hold(signal) => Some(Intersample::Hold),
            Role::Input(_) => Some(Intersample::Linear),
            _ => None,
        };
        self.runs.first().into_iter().flat_map(|run| run.channels().iter().enumerate()).map(input_behavior).collect()
    }

    /// Return the uniform samples of a signal in each run; NaN for missing samples.
    ///
    /// # Errors
    /// [`Error::Structure`] for a signal index out of range.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Recordings, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// # let runs = Recordings::new(vec![run])?;
    /// assert_eq!(runs.samples(1)?, [[1.0, 2.0, 2.0, 3.0]]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn samples(&self, signal: usize) -> Result<Vec<&[f64]>> {
        let samples_of_run = |run| Recording::channel(run, signal).map(|channel| channel.samples.as_slice());
        self.runs().map(samples_of_run).collect()
    }

    /// Return the record of each run over `m` block pulses, with all signals filtered by the sensor filter. Missing
    /// samples are interpolated.
    ///
    /// `inputs` holds the values of the free input parameters. Outputs enter other equations as measured.
    ///
    /// # Errors
    /// The errors of [`Recording::pulses`], for an invalid number of pulses or a signal that is too small. The errors
    /// of [`Recording::with_free_inputs`], for a wrong number of values in `inputs`.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Recordings, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// # let runs = Recordings::new(vec![run])?;
    /// assert_eq!(runs.records(3, &[])?[0].signal(1), [1.0, 2.0, 2.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn records(&self, m: usize, inputs: &[f64]) -> Result<Vec<Record>> {
        let record_of_run = |run: &Recording| {
            let mut with_inputs = run.with_free_inputs(inputs)?;
            with_inputs.is_coupled = false;
            with_inputs.pulses(m, true)?.into_record()
        };
        self.runs().map(record_of_run).collect()
    }
}

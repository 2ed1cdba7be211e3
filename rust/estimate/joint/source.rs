//! Where the runs of a joint fit come from: sampled as finely as it is asked.

use crate::error::{check_length, check_step, Error, Result};
use crate::estimate::output_error::{Experiment, Instant};
use crate::means::{pulse_means, Intersample};
use crate::regressors::Record;

/// Runs that can be sampled on any grid. Weights of what it gives are not looked at; shares say what was read.
pub trait Source {
    /// Sample interval and duration of each run \[s\].
    fn spans(&self) -> Vec<(f64, f64)>;

    /// The runs with so many pulses a sample interval, of every `decimation`-th sample.
    ///
    /// # Errors
    /// Whatever keeps it from that.
    fn experiments(&self, every: usize, decimation: usize) -> Result<Vec<Experiment>>;
}

/// A signal that was read at regular times.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// What was read.
    pub samples: Vec<f64>,
    /// What it does in between.
    pub between: Intersample,
}

/// Runs whose signals were all read at the same regular times, throughout, without a filter.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::estimate::joint::{Sampled, Signal, Source};
/// use ftlm::means::Intersample;
/// let y = Signal { samples: vec![0.0, 1.0, 4.0, 9.0], between: Intersample::Linear };
/// let u = Signal { samples: vec![1.0, 2.0, 2.0, 2.0], between: Intersample::Hold };
/// let runs = Sampled::new(0.1, vec![0], vec![vec![y, u]])?;
/// let fine = runs.experiments(2, 1)?;
/// assert_eq!(fine[0].record.signal(1), [1.0, 1.0, 2.0, 2.0, 2.0, 2.0]);
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Sampled {
    step: f64,
    outputs: Vec<usize>,
    runs: Vec<Vec<Signal>>,
}

impl Sampled {
    /// Runs of one sample interval, signals in one order, and which of them are the outputs of the equations.
    ///
    /// # Errors
    /// [`Error::Length`], [`Error::OutOfRange`], [`Error::Structure`].
    pub fn new(step: f64, outputs: Vec<usize>, runs: Vec<Vec<Signal>>) -> Result<Self> {
        check_step(step)?;
        for run in &runs {
            let rows = run.first().map_or(0, |signal| signal.samples.len());
            run.iter().try_for_each(|signal| check_length("samples of a signal", rows, signal.samples.len()))?;
            if outputs.iter().any(|&output| output >= run.len()) || rows < 3 {
                let what = format!("a run of {} signals and {rows} samples", run.len());
                return Err(Error::Structure { what, remedy: "give every output, and three samples or more".into() });
            }
        }
        Ok(Self { step, outputs, runs })
    }
}

impl Source for Sampled {
    #[allow(clippy::cast_precision_loss)]
    fn spans(&self) -> Vec<(f64, f64)> {
        self.runs.iter().map(|run| (self.step, run[0].samples.len() as f64 * self.step)).collect()
    }

    #[allow(clippy::cast_precision_loss)]
    fn experiments(&self, every: usize, decimation: usize) -> Result<Vec<Experiment>> {
        let decimation = decimation.max(1);
        let of = |run: &Vec<Signal>| {
            let intervals = (run[0].samples.len() - 1) / decimation;
            let rows = intervals * decimation + 1;
            let means = run.iter().map(|s| pulse_means(&s.samples[..rows], intervals * every, s.between));
            let step = self.step * decimation as f64 / every.max(1) as f64;
            let record = Record::new(step, means.collect::<Result<_>>()?, None)?;
            let kept = |s: &Signal| s.samples[..rows].iter().copied().step_by(decimation).collect::<Vec<_>>();
            let instants = run.iter().map(|s| Instant { values: Some(kept(s)), held: s.between == Intersample::Hold });
            let instants = instants.collect();
            let samples = self.outputs.iter().map(|&output| kept(&run[output])).collect();
            Experiment::new(record, every, samples, vec![1.0; self.outputs.len()])?.with_instants(instants)
        };
        self.runs.iter().map(of).collect()
    }
}

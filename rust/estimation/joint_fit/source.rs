//! Source of the runs of a joint fit, sampled on a requested grid.

use crate::error::{check_length, check_points, check_step, Error, Result};
use crate::estimation::output_error::{Experiment, PointValues};
use crate::regressors::Record;
use crate::signal::block_pulse::{pulse_means, Intersample};

/// Source of runs that can be sampled on any grid.
///
/// The output weights of its experiments are ignored. Their sample weights mark missing samples.
pub trait Source {
    /// Sampling interval and duration of each run \[s\].
    fn spans(&self) -> Vec<(f64, f64)>;

    /// Sample the runs.
    ///
    /// # Errors
    /// If the runs cannot be sampled.
    fn experiments(&self, sampling: Sampling) -> Result<Vec<Experiment>>;
}

/// Sampling of the runs: step, decimation and length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Sampling {
    /// Block pulses per sampling interval.
    pub pulses_per_sample: usize,
    /// Decimation factor of the samples.
    pub decimation: usize,
    /// Number of leading sampling intervals of each run to use; None for all.
    pub leading_intervals: Option<usize>,
}

impl Sampling {
    /// Check that pulses and decimation are positive and not excessive.
    ///
    /// # Errors
    /// [`Error::OutOfRange`].
    pub fn check(self) -> Result<()> {
        for (name, number) in
            [("pulses a sample interval", self.pulses_per_sample), ("samples that become one", self.decimation)]
        {
            check_points(name, number)?;
            if number == 0 {
                let (value, range) = (0.0, "[1, ∞)".into());
                return Err(Error::OutOfRange { name: name.into(), value, range, remedy: "give 1 or more".into() });
            }
        }
        Ok(())
    }
}

impl Default for Sampling {
    fn default() -> Self {
        Self { pulses_per_sample: 1, decimation: 1, leading_intervals: None }
    }
}

/// Source of runs that also supplies samples and block-pulse records for initial guesses.
pub trait Recordings: Source {
    /// Intersample behavior of the signals that are inputs; None for other signals.
    fn inputs(&self) -> Vec<Option<Intersample>>;

    /// Uniform samples of a signal by run; NaN for missing samples.
    ///
    /// # Errors
    /// If the samples are not available.
    fn samples(&self, signal: usize) -> Result<Vec<Vec<f64>>>;

    /// Record of each run with `m` block pulses.
    ///
    /// All signals have passed the sensor filter, the inputs are the measured ones, and `inputs` are the values of the
    /// free input parameters.
    ///
    /// # Errors
    /// If the records are not available.
    fn records(&self, m: usize, inputs: &[f64]) -> Result<Vec<Record>>;
}

/// Uniformly sampled signal.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Sample values.
    pub samples: Vec<f64>,
    /// Behavior between the samples.
    pub intersample: Intersample,
}

/// Runs of signals sampled at the same uniform times, without gaps and without a sensor filter.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::estimation::joint_fit::{SampledRuns, Sampling, Signal, Source};
/// use ftlm::signal::block_pulse::Intersample;
/// let y = Signal { samples: vec![0.0, 1.0, 4.0, 9.0], intersample: Intersample::Linear };
/// let u = Signal { samples: vec![1.0, 2.0, 2.0, 2.0], intersample: Intersample::Hold };
/// let runs = SampledRuns::new(0.1, vec![0], vec![vec![y, u]])?;
/// let fine = runs.experiments(Sampling { pulses_per_sample: 2, ..Sampling::default() })?;
/// assert_eq!(fine[0].record.signal(1), [1.0, 1.0, 2.0, 2.0, 2.0, 2.0]);
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct SampledRuns {
    step: f64,
    outputs: Vec<usize>,
    runs: Vec<Vec<Signal>>,
}

impl SampledRuns {
    /// Runs of one sampling interval, with the signals in the same sequence and the indices of the outputs.
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

impl Source for SampledRuns {
    #[allow(clippy::cast_precision_loss)]
    fn spans(&self) -> Vec<(f64, f64)> {
        self.runs.iter().map(|run| (self.step, run[0].samples.len() as f64 * self.step)).collect()
    }

    #[allow(clippy::cast_precision_loss)]
    fn experiments(&self, sampling: Sampling) -> Result<Vec<Experiment>> {
        let Sampling { pulses_per_sample: every, decimation, leading_intervals: first } = sampling;
        let decimation = decimation.max(1);
        let of = |run: &Vec<Signal>| {
            let all = run[0].samples.len() - 1;
            let intervals = first.map_or(all, |first| first.min(all)) / decimation;
            let rows = intervals * decimation + 1;
            let means = run.iter().map(|s| pulse_means(&s.samples[..rows], intervals * every, s.intersample));
            let step = self.step * decimation as f64 / every.max(1) as f64;
            let record = Record::new(step, means.collect::<Result<_>>()?, None)?;
            let kept = |s: &Signal| s.samples[..rows].iter().copied().step_by(decimation).collect::<Vec<_>>();
            let instants = run
                .iter()
                .map(|s| PointValues { values: Some(kept(s)), is_zero_order_hold: s.intersample == Intersample::Hold });
            let instants = instants.collect();
            let samples = self.outputs.iter().map(|&output| kept(&run[output])).collect();
            Experiment::new(record, every, samples, vec![1.0; self.outputs.len()])?.with_point_values(instants)
        };
        self.runs.iter().map(of).collect()
    }
}

impl Recordings for SampledRuns {
    fn inputs(&self) -> Vec<Option<Intersample>> {
        let signals = self.runs.first().into_iter().flatten().enumerate();
        signals.map(|(i, signal)| (!self.outputs.contains(&i)).then_some(signal.intersample)).collect()
    }

    fn samples(&self, signal: usize) -> Result<Vec<Vec<f64>>> {
        let of = |run: &Vec<Signal>| run.get(signal).map(|signal| signal.samples.clone());
        let missing = || Error::Structure { what: format!("no signal {signal}"), remedy: "number them from 0".into() };
        self.runs.iter().map(of).collect::<Option<_>>().ok_or_else(missing)
    }

    #[allow(clippy::cast_precision_loss)]
    fn records(&self, m: usize, inputs: &[f64]) -> Result<Vec<Record>> {
        check_length("free numbers of inputs", 0, inputs.len())?;
        let of = |run: &Vec<Signal>| {
            let means = run.iter().map(|s| pulse_means(&s.samples, m, s.intersample)).collect::<Result<_>>()?;
            let duration = self.step * (run[0].samples.len() - 1) as f64;
            Record::new(duration / m.max(1) as f64, means, None)
        };
        self.runs.iter().map(of).collect()
    }
}

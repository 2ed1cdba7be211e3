//! One run to compare with, sample by sample.

use crate::error::{check_finite, check_length, Error, Result};
use crate::regressors::Record;
use crate::series;

/// One run to compare with: pulse means on a grid of which every `every`-th edge is a sample.
#[derive(Debug, Clone)]
pub struct Experiment {
    /// Pulse means of all signals.
    pub record: Record,
    /// Pulses a sample interval.
    pub every: usize,
    /// Point samples of each equation's output, one more than there are intervals.
    pub samples: Vec<Vec<f64>>,
    /// Filter that simulated outputs pass before they are compared, where there is one: a series as long as the record,
    /// and a flag for each output that passes it.
    pub filter: Option<(Vec<f64>, Vec<bool>)>,
    /// 1/σ of each equation's output.
    pub weights: Vec<f64>,
    /// What each signal is at the samples, for terms that feed through at once; empty: nothing but the pulse means.
    pub instants: Vec<Instant>,
}

/// A signal at the instants of the samples.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Instant {
    /// Its values at the samples, after it changed; none: the mean of the pulses on either side.
    pub values: Option<Vec<f64>>,
    /// Whether it holds in between, which decides what it is after a free delay.
    pub held: bool,
}

impl Experiment {
    /// An experiment without a filter.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn new(record: Record, every: usize, samples: Vec<Vec<f64>>, weights: Vec<f64>) -> Result<Self> {
        let experiment = Self { record, every, samples, filter: None, weights, instants: Vec::new() };
        experiment.check()?;
        Ok(experiment)
    }

    /// The same experiment, its outputs compared behind a filter.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn with_filter(mut self, series: Vec<f64>, applies: Vec<bool>) -> Result<Self> {
        self.filter = Some((series, applies));
        self.check()?;
        Ok(self)
    }

    /// The same experiment, with what each signal of the record is at the samples.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn with_instants(mut self, instants: Vec<Instant>) -> Result<Self> {
        self.instants = instants;
        self.check()?;
        Ok(self)
    }

    /// Refuses what cannot be compared.
    ///
    /// # Errors
    /// [`Error::Structure`] where the pulses are no multiple of `every`, [`Error::Length`], [`Error::NotFinite`].
    pub fn check(&self) -> Result<()> {
        let (m, every) = (self.record.m(), self.every);
        if every == 0 || m % every != 0 {
            let what = format!("{m} pulses are no multiple of {every} a sample interval");
            return Err(Error::Structure { what, remedy: "refine every interval alike".into() });
        }
        for (i, samples) in self.samples.iter().enumerate() {
            check_finite(&format!("samples of output {i}"), samples)?;
            check_length("samples", m / every + 1, samples.len())?;
        }
        if let Some((series, applies)) = &self.filter {
            check_finite("filter", series)?;
            check_length("filter", m, series.len())?;
            check_length("filtered outputs", self.samples.len(), applies.len())?;
        }
        if !self.instants.is_empty() {
            check_length("signals at the samples", self.record.len(), self.instants.len())?;
        }
        for values in self.instants.iter().filter_map(|instant| instant.values.as_ref()) {
            check_finite("signal at the samples", values)?;
            check_length("signal at the samples", m / every + 1, values.len())?;
        }
        check_finite("weights", &self.weights)?;
        check_length("weights", self.samples.len(), self.weights.len())
    }

    /// Samples that are compared: all that have a pulse on either side.
    pub(super) fn compared(&self) -> usize {
        (self.record.m() / self.every).saturating_sub(1)
    }

    /// Pulses on either side of each compared sample.
    fn sides<'a>(&'a self, means: &'a [f64]) -> impl Iterator<Item = (f64, f64)> + 'a {
        (1..=self.compared()).map(move |k| (means[k * self.every - 1], means[k * self.every]))
    }

    /// A signal at each compared sample less the mean of the pulses on either side.
    pub(super) fn lacking(&self, signal: usize) -> Vec<f64> {
        let sides = self.sides(self.record.signal(signal));
        match self.instants.get(signal).and_then(|instant| instant.values.as_ref()) {
            Some(values) => values[1..].iter().zip(sides).map(|(v, (a, b))| v - 0.5 * (a + b)).collect(),
            None => sides.map(|_| 0.0).collect(),
        }
    }

    /// The same of a signal after a free delay, from its means and their slope: half the jump of one that holds.
    pub(super) fn lacking_behind(&self, signal: usize, shifted: &(Vec<f64>, Vec<f64>)) -> (Vec<f64>, Vec<f64>) {
        let half = if self.instants.get(signal).is_some_and(|instant| instant.held) { 0.5 } else { 0.0 };
        let jump = |means: &[f64]| self.sides(means).map(|(a, b)| half * (b - a)).collect();
        (jump(&shifted.0), jump(&shifted.1))
    }

    /// Weighted samples of pulse means, all outputs after one another.
    pub(super) fn sampled(&self, response: &[Vec<f64>]) -> Vec<f64> {
        let mut samples = Vec::with_capacity(response.len() * self.compared());
        for (i, means) in response.iter().enumerate() {
            let filtered;
            let means = match &self.filter {
                Some((filter, applies)) if applies[i] => {
                    filtered = series::multiply(filter, means, means.len());
                    &filtered
                }
                _ => means,
            };
            let w = self.weights[i];
            samples.extend(self.sides(means).map(|(a, b)| 0.5 * w * (a + b)));
        }
        samples
    }
}

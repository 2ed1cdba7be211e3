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
}

impl Experiment {
    /// An experiment without a filter.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn new(record: Record, every: usize, samples: Vec<Vec<f64>>, weights: Vec<f64>) -> Result<Self> {
        let experiment = Self { record, every, samples, filter: None, weights };
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
        check_finite("weights", &self.weights)?;
        check_length("weights", self.samples.len(), self.weights.len())
    }

    /// Samples that are compared: all that have a pulse on either side.
    pub(super) fn compared(&self) -> usize {
        (self.record.m() / self.every).saturating_sub(1)
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
            samples.extend((1..=self.compared()).map(|k| {
                let edge = k * self.every;
                0.5 * w * (means[edge - 1] + means[edge])
            }));
        }
        samples
    }
}

//! One run to compare with, sample by sample.

use crate::error::{check_finite, check_length, Error, Result};
use crate::regressors::Record;
use crate::series;

/// One run to compare with: pulse means on a grid of which every `every`-th edge is a sample.
#[derive(Debug, Clone)]
pub struct Experiment {
    pub(super) record: Record,
    pub(super) every: usize,
    pub(super) samples: Vec<Vec<f64>>,
    pub(super) weights: Vec<f64>,
    filter: Option<(Vec<f64>, Vec<bool>)>,
}

impl Experiment {
    /// Pulse means of all signals, `every` pulses a sample interval; point samples of each equation's output, one more
    /// than there are intervals; 1/σ of each of these outputs.
    ///
    /// # Errors
    /// [`Error::Structure`] where the pulses are no multiple of `every`, [`Error::Length`], [`Error::NotFinite`].
    pub fn new(record: Record, every: usize, samples: Vec<Vec<f64>>, weights: Vec<f64>) -> Result<Self> {
        if every == 0 || record.m() % every != 0 {
            let what = format!("{} pulses are no multiple of {every} a sample interval", record.m());
            return Err(Error::Structure { what, remedy: "refine every interval alike".into() });
        }
        for (i, samples) in samples.iter().enumerate() {
            check_finite(&format!("samples of output {i}"), samples)?;
            check_length("samples", record.m() / every + 1, samples.len())?;
        }
        check_finite("weights", &weights)?;
        check_length("weights", samples.len(), weights.len())?;
        Ok(Self { record, every, samples, weights, filter: None })
    }

    /// Puts a filter (a series as long as the record) before the comparison, for those outputs whose flag is set.
    ///
    /// # Errors
    /// [`Error::Length`], [`Error::NotFinite`].
    pub fn with_filter(mut self, series: Vec<f64>, applies: Vec<bool>) -> Result<Self> {
        check_finite("filter", &series)?;
        check_length("filter", self.record.m(), series.len())?;
        check_length("filtered outputs", self.samples.len(), applies.len())?;
        self.filter = Some((series, applies));
        Ok(self)
    }

    /// Pulse means of all signals.
    #[must_use]
    pub fn record(&self) -> &Record {
        &self.record
    }

    /// Pulses a sample interval.
    #[must_use]
    pub fn every(&self) -> usize {
        self.every
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

//! Experiment: one run whose samples are compared with the simulation.

use std::sync::Arc;

use crate::error::{check_finite, check_length, Error, Result};
use crate::regressors::{is_impulse, Record};
use crate::series;
use crate::signal::block_pulse::{Jumps, Readings};

/// One run to compare with: pulse means on a grid with a sample at every `pulses_per_sample`-th edge.
#[derive(Debug, Clone)]
pub struct Experiment {
    /// Pulse means of all signals, shared by experiments that differ in weights only.
    pub record: Arc<Record>,
    /// Block pulses per sampling interval.
    pub every: usize,
    /// Point samples of each equation's output, one more than there are intervals.
    pub samples: Vec<Vec<f64>>,
    /// Sensor filter of the simulated outputs, if any: a series of the length of the record, and a flag per output.
    pub filter: Option<(Vec<f64>, Vec<bool>)>,
    /// 1/σ of each equation's output.
    pub weights: Vec<f64>,
    /// Value of each signal at the sample times, for direct feedthrough; empty if only pulse means are known.
    pub instants: Vec<Instant>,
    /// Relative weight of each compared sample of each output, 0 for a missing sample; empty for unit weights.
    pub shares: Vec<Vec<f64>>,
    /// Nonuniform sample times; None for uniform samples on the grid.
    pub own: Option<OwnTimes>,
    /// True if the signals of the record, and thus the simulated outputs, have already passed the filter.
    passed: bool,
}

/// Nonuniform sample times, all of which are compared.
#[derive(Debug, Clone, PartialEq)]
pub struct OwnTimes {
    /// Sample times.
    pub readings: Readings,
    /// Jumps near the samples of each zero-order-hold signal of the record; None for other signals.
    pub jumps: Vec<Option<Jumps>>,
}

/// Values of a signal at the sample times.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Instant {
    /// Values at the samples, after a jump; None for the mean of the adjacent pulses.
    pub values: Option<Vec<f64>>,
    /// True for a zero-order hold between samples.
    pub held: bool,
}

impl Experiment {
    /// Experiment without a filter.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn new(record: Record, every: usize, samples: Vec<Vec<f64>>, weights: Vec<f64>) -> Result<Self> {
        let experiment = Self::unchecked(record, every, samples, weights);
        experiment.check()?;
        Ok(experiment)
    }

    /// Experiment with nonuniform sample times.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn with_own_times(record: Record, samples: Vec<Vec<f64>>, weights: Vec<f64>, own: OwnTimes) -> Result<Self> {
        let experiment = Self { own: Some(own), ..Self::unchecked(record, 1, samples, weights) };
        experiment.check()?;
        Ok(experiment)
    }

    fn unchecked(record: Record, every: usize, samples: Vec<Vec<f64>>, weights: Vec<f64>) -> Self {
        let (filter, instants, shares, own) = (None, Vec::new(), Vec::new(), None);
        Self { record: Arc::new(record), every, samples, filter, weights, instants, shares, own, passed: false }
    }

    /// Set relative weights of the compared samples.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn with_shares(mut self, shares: Vec<Vec<f64>>) -> Result<Self> {
        self.shares = shares;
        self.check()?;
        Ok(self)
    }

    /// Set the sensor filter of the simulated outputs.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn with_filter(mut self, series: Vec<f64>, applies: Vec<bool>) -> Result<Self> {
        self.filter = Some((series, applies));
        self.check()?;
        Ok(self)
    }

    /// Set the values of the signals at the sample times.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn with_instants(mut self, instants: Vec<Instant>) -> Result<Self> {
        self.instants = instants;
        self.check()?;
        Ok(self)
    }

    /// Check lengths and values.
    ///
    /// # Errors
    /// [`Error::Structure`] if the pulses are no multiple of `pulses_per_sample`, [`Error::Length`],
    /// [`Error::NotFinite`].
    pub fn check(&self) -> Result<()> {
        let (m, every) = (self.record.m(), self.every);
        if every == 0 || m % every != 0 {
            let what = format!("{m} pulses are no multiple of {every} a sample interval");
            return Err(Error::Structure { what, remedy: "refine every interval alike".into() });
        }
        for (i, samples) in self.samples.iter().enumerate() {
            check_finite(&format!("samples of output {i}"), samples)?;
            check_length("samples", self.own.as_ref().map_or(m / every + 1, |own| own.readings.len()), samples.len())?;
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
            check_length("signal at the samples", self.samples.first().map_or(m / every + 1, Vec::len), values.len())?;
        }
        if let Some(own) = &self.own {
            check_length("jumps of signals", self.record.len(), own.jumps.len())?;
        }
        if !self.shares.is_empty() {
            check_length("outputs with shares", self.samples.len(), self.shares.len())?;
        }
        for shares in &self.shares {
            check_finite("shares of samples", shares)?;
            check_length("shares of samples", self.compared(), shares.len())?;
        }
        check_finite("weights", &self.weights)?;
        check_length("weights", self.samples.len(), self.weights.len())
    }

    /// Experiment with prefiltered signals, if all outputs pass the filter; None otherwise.
    ///
    /// Equations and filter commute, so that filtering the inputs once replaces filtering every simulated output.
    ///
    /// # Errors
    /// As [`Record::through`].
    pub(crate) fn passed_first(&self) -> Result<Option<Self>> {
        match &self.filter {
            Some((series, applies))
                if applies.iter().all(|&a| a) && self.own.is_none() && !self.record.is_filtered() =>
            {
                Ok(Some(Self { record: Arc::new(self.record.through(series)?), passed: true, ..self.clone() }))
            }
            _ => Ok(None),
        }
    }

    /// True if an initial term of this exponent affects only the sensor filter of this output.
    pub(crate) fn moves_filter(&self, output: usize, exponent: f64) -> bool {
        is_impulse(exponent) && (self.passed || !self.record.is_filtered() || self.record.is_held(output))
    }

    /// True if an output passes a sensor filter, alone or with its whole equation.
    pub(crate) fn behind_filter(&self, output: usize) -> bool {
        self.record.is_filtered() || self.filter.as_ref().is_some_and(|(_, applies)| applies[output])
    }

    /// Number of compared samples: those with a pulse on either side, or all nonuniform samples.
    pub(crate) fn compared(&self) -> usize {
        match &self.own {
            Some(own) => own.readings.len(),
            None => (self.record.m() / self.every).saturating_sub(1),
        }
    }

    /// Part of the values at the samples that is compared.
    fn inner<'a>(&self, values: &'a [f64]) -> &'a [f64] {
        let first = usize::from(self.own.is_none());
        &values[first..first + self.compared()]
    }

    /// Weights of the compared samples of an output.
    pub(crate) fn weights_of(&self, output: usize) -> impl Iterator<Item = f64> + '_ {
        let (weight, shares) = (self.weights[output], self.shares.get(output));
        (0..self.compared()).map(move |k| weight * shares.map_or(1.0, |shares| shares[k]))
    }

    /// Weights times measured samples, for the compared samples, outputs concatenated.
    pub(crate) fn measured(&self) -> Vec<f64> {
        let weighted = |(i, values): (usize, &Vec<f64>)| -> Vec<f64> {
            self.weights_of(i).zip(self.inner(values)).map(|(w, v)| w * v).collect()
        };
        self.samples.iter().enumerate().flat_map(weighted).collect()
    }

    /// Pulse means on either side of each compared sample.
    fn sides<'a>(&'a self, means: &'a [f64]) -> impl Iterator<Item = (f64, f64)> + 'a {
        (1..=self.compared()).map(move |k| (means[k * self.every - 1], means[k * self.every]))
    }

    /// Values of a signal at the compared samples, from its pulse means.
    fn told(&self, means: &[f64]) -> Vec<f64> {
        match &self.own {
            Some(own) => own.readings.read(means),
            None => self.sides(means).map(|(a, b)| 0.5 * (a + b)).collect(),
        }
    }

    /// Deviation of a signal at the compared samples from the value given by its pulse means.
    pub(crate) fn lacking(&self, signal: usize) -> Vec<f64> {
        match self.instants.get(signal).and_then(|instant| instant.values.as_ref()) {
            Some(values) => {
                self.inner(values).iter().zip(self.told(self.record.signal(signal))).map(|(v, told)| v - told).collect()
            }
            None => vec![0.0; self.compared()],
        }
    }

    /// Deviation of an input with a free parameter, and its derivative: half the jump of a zero-order hold.
    pub(crate) fn lacking_behind(&self, signal: usize, acted: &(Vec<f64>, Vec<f64>)) -> (Vec<f64>, Vec<f64>) {
        let half = if self.instants.get(signal).is_some_and(|instant| instant.held) { 0.5 } else { 0.0 };
        let jump = |means: &[f64]| self.sides(means).map(|(a, b)| half * (b - a)).collect();
        (jump(&acted.0), jump(&acted.1))
    }

    /// Samples of pulse means, weighted, outputs concatenated.
    pub(crate) fn sampled(&self, response: &[Vec<f64>]) -> Vec<f64> {
        let mut samples = Vec::with_capacity(response.len() * self.compared());
        for (i, means) in response.iter().enumerate() {
            let filtered;
            let means = match &self.filter {
                Some((filter, applies)) if applies[i] && !self.passed => {
                    filtered = series::multiply(filter, means, means.len());
                    &filtered
                }
                _ => means,
            };
            samples.extend(self.weights_of(i).zip(self.told(means)).map(|(w, v)| w * v));
        }
        samples
    }

    /// Weights times corrections of the samples of each output; zero for filtered outputs.
    pub(crate) fn weighted(&self, values: &[Vec<f64>]) -> Vec<f64> {
        let mut out = Vec::with_capacity(values.len() * self.compared());
        for (i, row) in values.iter().enumerate() {
            let behind = self.filter.as_ref().is_some_and(|(_, applies)| applies[i]);
            out.extend(self.weights_of(i).zip(row).map(|(w, v)| if behind { 0.0 } else { w * v }));
        }
        out
    }
}

//! One run to compare with, sample by sample.

use std::sync::Arc;

use crate::error::{check_finite, check_length, Error, Result};
use crate::regressors::{is_impulse, Record};
use crate::series;
use crate::signal::block_pulse::{Jumps, Readings};

/// One run to compare with: pulse means on a grid of which every `every`-th edge is a sample.
#[derive(Debug, Clone)]
pub struct Experiment {
    /// Pulse means of all signals; those of runs that differ in weights alone are the same.
    pub record: Arc<Record>,
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
    /// Share of its weight with which each compared sample of each output counts, 0 for one that was not read; empty: all
    /// count alike.
    pub shares: Vec<Vec<f64>>,
    /// When the samples were read, where that is not at every `every`-th edge.
    pub own: Option<OwnTimes>,
    /// Whether the signals of the record passed the filter already, and with them whatever follows from these.
    passed: bool,
}

/// Samples at times of their own, all of which are compared.
#[derive(Debug, Clone, PartialEq)]
pub struct OwnTimes {
    /// When they were read.
    pub readings: Readings,
    /// Jumps of each signal of the record that holds in between, near them.
    pub jumps: Vec<Option<Jumps>>,
}

/// A signal at the instants of the samples.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Instant {
    /// Its values at the samples, after it changed; none: the mean of the pulses on either side.
    pub values: Option<Vec<f64>>,
    /// Whether it holds in between, which decides what it is once it acts.
    pub held: bool,
}

impl Experiment {
    /// An experiment without a filter.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn new(record: Record, every: usize, samples: Vec<Vec<f64>>, weights: Vec<f64>) -> Result<Self> {
        let experiment = Self::unchecked(record, every, samples, weights);
        experiment.check()?;
        Ok(experiment)
    }

    /// An experiment whose samples were read at times of their own.
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

    /// The same experiment, some of its compared samples counting less.
    ///
    /// # Errors
    /// As [`Experiment::check`].
    pub fn with_shares(mut self, shares: Vec<Vec<f64>>) -> Result<Self> {
        self.shares = shares;
        self.check()?;
        Ok(self)
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

    /// The same experiment with its signals behind the filter, where all outputs pass it: equations and filter commute, and
    /// what drives passes it once, what answers as often as it is asked for. None where that is not so.
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

    /// Whether an initial term of this exponent moves nothing but the filter of the output that is this signal.
    pub(crate) fn moves_filter(&self, output: usize, exponent: f64) -> bool {
        is_impulse(exponent) && (self.passed || !self.record.is_filtered() || self.record.is_held(output))
    }

    /// Whether an output passes a filter before it is compared, by itself or with all of its equation.
    pub(crate) fn behind_filter(&self, output: usize) -> bool {
        self.record.is_filtered() || self.filter.as_ref().is_some_and(|(_, applies)| applies[output])
    }

    /// Samples that are compared: all that have a pulse on either side, or all that were read at times of their own.
    pub(crate) fn compared(&self) -> usize {
        match &self.own {
            Some(own) => own.readings.len(),
            None => (self.record.m() / self.every).saturating_sub(1),
        }
    }

    /// The compared ones of values at the samples.
    fn inner<'a>(&self, values: &'a [f64]) -> &'a [f64] {
        let first = usize::from(self.own.is_none());
        &values[first..first + self.compared()]
    }

    /// Weights of an output's compared samples.
    pub(crate) fn weights_of(&self, output: usize) -> impl Iterator<Item = f64> + '_ {
        let (weight, shares) = (self.weights[output], self.shares.get(output));
        (0..self.compared()).map(move |k| weight * shares.map_or(1.0, |shares| shares[k]))
    }

    /// Weighted compared samples as measured, all outputs after one another.
    pub(crate) fn measured(&self) -> Vec<f64> {
        let weighted = |(i, values): (usize, &Vec<f64>)| -> Vec<f64> {
            self.weights_of(i).zip(self.inner(values)).map(|(w, v)| w * v).collect()
        };
        self.samples.iter().enumerate().flat_map(weighted).collect()
    }

    /// Pulses on either side of each compared sample.
    fn sides<'a>(&'a self, means: &'a [f64]) -> impl Iterator<Item = (f64, f64)> + 'a {
        (1..=self.compared()).map(move |k| (means[k * self.every - 1], means[k * self.every]))
    }

    /// A signal at each compared sample as its pulse means tell it.
    fn told(&self, means: &[f64]) -> Vec<f64> {
        match &self.own {
            Some(own) => own.readings.read(means),
            None => self.sides(means).map(|(a, b)| 0.5 * (a + b)).collect(),
        }
    }

    /// A signal at each compared sample less what the pulses on either side tell.
    pub(crate) fn lacking(&self, signal: usize) -> Vec<f64> {
        match self.instants.get(signal).and_then(|instant| instant.values.as_ref()) {
            Some(values) => {
                self.inner(values).iter().zip(self.told(self.record.signal(signal))).map(|(v, told)| v - told).collect()
            }
            None => vec![0.0; self.compared()],
        }
    }

    /// The same of an input with a free number, from its means and their slope: half the jump of one that holds.
    pub(crate) fn lacking_behind(&self, signal: usize, acted: &(Vec<f64>, Vec<f64>)) -> (Vec<f64>, Vec<f64>) {
        let half = if self.instants.get(signal).is_some_and(|instant| instant.held) { 0.5 } else { 0.0 };
        let jump = |means: &[f64]| self.sides(means).map(|(a, b)| half * (b - a)).collect();
        (jump(&acted.0), jump(&acted.1))
    }

    /// Weighted samples of pulse means, all outputs after one another.
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

    /// Weighted, as the samples are, what pulse means do not tell of each output; nothing of what passes the filter.
    pub(crate) fn weighted(&self, values: &[Vec<f64>]) -> Vec<f64> {
        let mut out = Vec::with_capacity(values.len() * self.compared());
        for (i, row) in values.iter().enumerate() {
            let behind = self.filter.as_ref().is_some_and(|(_, applies)| applies[i]);
            out.extend(self.weights_of(i).zip(row).map(|(w, v)| if behind { 0.0 } else { w * v }));
        }
        out
    }
}

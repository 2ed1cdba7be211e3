//! Experiment: one run whose measured samples are compared with the simulation.

use std::sync::Arc;

use crate::error::{check_finite, check_length, Error, Result};
use crate::regressors::{is_impulse, Record};
use crate::series;
use crate::signal::block_pulse::{Jumps, SampleInterpolation};

/// One run of measured data as block-pulse means. The samples lie at every `pulses_per_sample`-th pulse edge, or at
/// nonuniform times. The compared samples, which yield residuals, are all nonuniform samples, or all uniform samples
/// except the first and the last.
#[derive(Debug, Clone)]
pub struct Experiment {
    /// Block-pulse means of all signals, shared by experiments that differ in weights only.
    pub record: Arc<Record>,
    /// Number of block pulses per sampling interval.
    pub pulses_per_sample: usize,
    /// Samples of the output of each equation. The number of uniform samples is the number of sampling intervals plus
    /// one. Shared like the record.
    pub samples: Arc<Vec<Vec<f64>>>,
    /// Sensor filter of the simulated outputs, if any: its series, one value per pulse, and a flag per output.
    pub filter: Option<(Vec<f64>, Vec<bool>)>,
    /// Weight 1/σ of the output of each equation, with its noise standard deviation σ.
    pub weights: Vec<f64>,
    /// Values of each signal at the sample times, for direct feedthrough; empty if only pulse means are known.
    pub point_values: Arc<Vec<PointValues>>,
    /// Relative weight of each compared sample of each output, 0 for a missing sample; empty for unit weights.
    pub sample_weights: Vec<Vec<f64>>,
    /// Nonuniform sample times; None for uniform samples.
    pub nonuniform: Option<NonuniformSamples>,
    /// True if the signals of the record, and thus the simulated outputs, have already passed the filter.
    is_prefiltered: bool,
}

/// Nonuniform sample times of a run. All samples are compared with the simulation.
#[derive(Debug, Clone, PartialEq)]
pub struct NonuniformSamples {
    /// Interpolation of block-pulse means at the sample times.
    pub interpolation: SampleInterpolation,
    /// Jumps near the samples of each zero-order-hold signal of the record; None for other signals.
    pub jumps: Vec<Option<Jumps>>,
}

/// Values of a signal at the sample times.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointValues {
    /// Values at the sample times, just after any jump. None stands for the mean of the adjacent pulses.
    pub values: Option<Vec<f64>>,
    /// True if the signal is a zero-order hold between samples.
    pub is_zero_order_hold: bool,
}

impl Experiment {
    /// Return an experiment with uniform samples, `pulses_per_sample` pulses per sampling interval, and no filter.
    ///
    /// # Errors
    /// [`Error::Structure`] if the number of pulses is not a multiple of `pulses_per_sample`. [`Error::Length`] if the
    /// data do not match the record. [`Error::NotFinite`] if a value is not finite.
    pub fn new(record: Record, pulses_per_sample: usize, samples: Vec<Vec<f64>>, weights: Vec<f64>) -> Result<Self> {
        let experiment = Self::new_unchecked(record, pulses_per_sample, samples, weights);
        experiment.check()?;
        Ok(experiment)
    }

    /// Return an experiment with nonuniform sample times.
    ///
    /// # Errors
    /// [`Error::Length`] if the data do not match the record. [`Error::NotFinite`] if a value is not finite.
    pub fn with_nonuniform_samples(
        record: Record,
        samples: Vec<Vec<f64>>,
        weights: Vec<f64>,
        nonuniform: NonuniformSamples,
    ) -> Result<Self> {
        let experiment = Self { nonuniform: Some(nonuniform), ..Self::new_unchecked(record, 1, samples, weights) };
        experiment.check()?;
        Ok(experiment)
    }

    fn new_unchecked(record: Record, pulses_per_sample: usize, samples: Vec<Vec<f64>>, weights: Vec<f64>) -> Self {
        let (filter, point_values, sample_weights, nonuniform) = (None, Arc::default(), Vec::new(), None);
        Self {
            record: Arc::new(record),
            pulses_per_sample,
            samples: Arc::new(samples),
            filter,
            weights,
            point_values,
            sample_weights,
            nonuniform,
            is_prefiltered: false,
        }
    }

    /// Set the relative weights of the compared samples, one list per output.
    ///
    /// # Errors
    /// [`Error::Length`] if there is not one weight per compared sample of each output. [`Error::NotFinite`] if a
    /// weight is not finite.
    pub fn with_sample_weights(mut self, sample_weights: Vec<Vec<f64>>) -> Result<Self> {
        self.sample_weights = sample_weights;
        self.check()?;
        Ok(self)
    }

    /// Set the weights of the outputs, and multiply the relative weights of the compared samples by `robust_weights`.
    ///
    /// # Errors
    /// [`Error::Length`] if `robust_weights` does not match the outputs or the compared samples.
    pub fn with_weights(mut self, outputs: &[f64], robust_weights: Option<&[Vec<f64>]>) -> Result<Self> {
        self.weights = outputs.to_vec();
        let Some(robust_weights) = robust_weights else { return Ok(self) };
        check_length("outputs with robust weights", self.samples.len(), robust_weights.len())?;
        if self.sample_weights.is_empty() {
            self.sample_weights = robust_weights.to_vec();
            return Ok(self);
        }
        for (row, factors) in self.sample_weights.iter_mut().zip(robust_weights) {
            check_length("robust weights of samples", row.len(), factors.len())?;
            row.iter_mut().zip(factors).for_each(|(weight, factor)| *weight *= factor);
        }
        Ok(self)
    }

    /// Set the sensor filter of the simulated outputs: its series, and a flag per output that passes it.
    ///
    /// # Errors
    /// [`Error::Length`] if there is not one value per pulse and one flag per output. [`Error::NotFinite`] if a value
    /// is not finite.
    pub fn with_filter(mut self, series: Vec<f64>, filtered_outputs: Vec<bool>) -> Result<Self> {
        self.filter = Some((series, filtered_outputs));
        self.check()?;
        Ok(self)
    }

    /// Set the values of the signals at the sample times, one entry per signal.
    ///
    /// # Errors
    /// [`Error::Length`] if the values do not match the signals or samples. [`Error::NotFinite`] if a value is not
    /// finite.
    pub fn with_point_values(mut self, point_values: Vec<PointValues>) -> Result<Self> {
        self.point_values = Arc::new(point_values);
        self.check()?;
        Ok(self)
    }

    /// Check that all data match the record and that their values are finite.
    ///
    /// # Errors
    /// [`Error::Structure`] if the number of pulses is not a multiple of `pulses_per_sample`. [`Error::Length`] if data
    /// do not match the record, the outputs or the samples. [`Error::NotFinite`] if a value is not finite.
    pub fn check(&self) -> Result<()> {
        let (m, pulses_per_sample) = (self.record.m(), self.pulses_per_sample);
        if pulses_per_sample == 0 || m % pulses_per_sample != 0 {
            let what = format!("{m} pulses are not a multiple of {pulses_per_sample} pulses per sample interval");
            return Err(Error::Structure {
                what,
                remedy: "use the same number of pulses in every sample interval".into(),
            });
        }
        for (i, samples) in self.samples.iter().enumerate() {
            check_finite(&format!("samples of output {i}"), samples)?;
            check_length(
                "samples",
                self.nonuniform.as_ref().map_or(m / pulses_per_sample + 1, |nonuniform| nonuniform.interpolation.len()),
                samples.len(),
            )?;
        }
        if let Some((series, filtered_outputs)) = &self.filter {
            check_finite("filter", series)?;
            check_length("filter", m, series.len())?;
            check_length("filtered outputs", self.samples.len(), filtered_outputs.len())?;
        }
        if !self.point_values.is_empty() {
            check_length("signals at the samples", self.record.len(), self.point_values.len())?;
        }
        for values in self.point_values.iter().filter_map(|point| point.values.as_ref()) {
            check_finite("signal at the samples", values)?;
            check_length(
                "signal at the samples",
                self.samples.first().map_or(m / pulses_per_sample + 1, Vec::len),
                values.len(),
            )?;
        }
        if let Some(nonuniform) = &self.nonuniform {
            check_length("jumps of signals", self.record.len(), nonuniform.jumps.len())?;
        }
        if !self.sample_weights.is_empty() {
            check_length("outputs with robust weights", self.samples.len(), self.sample_weights.len())?;
        }
        for sample_weights in &self.sample_weights {
            check_finite("robust weights of samples", sample_weights)?;
            check_length("robust weights of samples", self.compared_count(), sample_weights.len())?;
        }
        check_finite("weights", &self.weights)?;
        check_length("weights", self.samples.len(), self.weights.len())
    }

    /// Return the experiment with prefiltered signals if all outputs pass the filter.
    ///
    /// Return None otherwise, for nonuniform samples, and for a record that is filtered already. Equations and filter
    /// commute. Filtering the inputs once therefore replaces filtering every simulated output.
    ///
    /// # Errors
    /// [`Error::NotFinite`] if a filtered signal overflows ([`Record::with_filter`]).
    pub(crate) fn prefilter_signals(&self) -> Result<Option<Self>> {
        match &self.filter {
            Some((series, filtered_outputs))
                if filtered_outputs.iter().all(|&a| a) && self.nonuniform.is_none() && !self.record.is_filtered() =>
            {
                Ok(Some(Self {
                    record: Arc::new(self.record.with_filter(series)?),
                    is_prefiltered: true,
                    ..self.clone()
                }))
            }
            _ => Ok(None),
        }
    }

    /// Return true if an initial term with this exponent represents only the initial state of the sensor filter of this
    /// output.
    pub(crate) fn affects_only_filter(&self, output: usize, exponent: f64) -> bool {
        is_impulse(exponent)
            && (self.is_prefiltered || !self.record.is_filtered() || self.record.has_filter_transient(output))
    }

    /// Return true if an output passes a sensor filter, either alone or with all signals of its equation.
    pub(crate) fn is_filtered(&self, output: usize) -> bool {
        self.record.is_filtered() || self.filter.as_ref().is_some_and(|(_, filtered_outputs)| filtered_outputs[output])
    }

    /// Number of compared samples of each output: all nonuniform samples, or the uniform samples between two pulses.
    #[must_use]
    pub fn compared_count(&self) -> usize {
        match &self.nonuniform {
            Some(nonuniform) => nonuniform.interpolation.len(),
            None => (self.record.m() / self.pulses_per_sample).saturating_sub(1),
        }
    }

    /// Part of `values` that belongs to the compared samples.
    fn compared_values<'a>(&self, values: &'a [f64]) -> &'a [f64] {
        let first = usize::from(self.nonuniform.is_none());
        &values[first..first + self.compared_count()]
    }

    /// Add `shifts` to the compared samples of each output. Shifts that are not finite are ignored.
    pub(crate) fn shift_samples(&mut self, shifts: &[Vec<f64>]) {
        let first = usize::from(self.nonuniform.is_none());
        for (samples, shifts) in Arc::make_mut(&mut self.samples).iter_mut().zip(shifts) {
            let pairs = samples[first..].iter_mut().zip(shifts).filter(|(_, shift)| shift.is_finite());
            pairs.for_each(|(sample, shift)| *sample += shift);
        }
    }

    /// Weights of the compared samples of an output, 1/σ times the relative weight.
    pub(crate) fn weights_of(&self, output: usize) -> impl Iterator<Item = f64> + '_ {
        let (weight, sample_weights) = (self.weights[output], self.sample_weights.get(output));
        (0..self.compared_count()).map(move |k| weight * sample_weights.map_or(1.0, |sample_weights| sample_weights[k]))
    }

    /// The weighted measured values of the compared samples, with all outputs concatenated.
    pub(crate) fn measured_samples(&self) -> Vec<f64> {
        let weight_samples = |(i, values): (usize, &Vec<f64>)| -> Vec<f64> {
            self.weights_of(i).zip(self.compared_values(values)).map(|(w, v)| w * v).collect()
        };
        self.samples.iter().enumerate().flat_map(weight_samples).collect()
    }

    /// Pulse means just before and just after each compared sample of a uniform run.
    fn adjacent_means<'a>(&'a self, means: &'a [f64]) -> impl Iterator<Item = (f64, f64)> + 'a {
        (1..=self.compared_count())
            .map(move |k| (means[k * self.pulses_per_sample - 1], means[k * self.pulses_per_sample]))
    }

    /// Values of a signal at the compared samples, computed from its pulse means.
    fn samples_of_pulses(&self, means: &[f64]) -> Vec<f64> {
        match &self.nonuniform {
            Some(nonuniform) => nonuniform.interpolation.interpolate(means),
            None => self.adjacent_means(means).map(|(a, b)| 0.5 * (a + b)).collect(),
        }
    }

    /// Values of a signal at the compared samples minus those computed from its pulse means.
    ///
    /// They are 0 if only pulse means are known.
    pub(crate) fn point_deviation(&self, signal: usize) -> Vec<f64> {
        match self.point_values.get(signal).and_then(|point| point.values.as_ref()) {
            Some(values) => self
                .compared_values(values)
                .iter()
                .zip(self.samples_of_pulses(self.record.signal(signal)))
                .map(|(v, point)| v - point)
                .collect(),
            None => vec![0.0; self.compared_count()],
        }
    }

    /// Values of an input with a free parameter minus those computed from its pulse means, and the derivative of this
    /// deviation, at the compared samples.
    ///
    /// `nonlinearity_output` contains the pulse means of the input after its nonlinearity, and their derivative with
    /// respect to the parameter. The deviation is half the jump of a zero-order hold, and 0 for other inputs.
    pub(crate) fn input_point_deviation(
        &self,
        signal: usize,
        nonlinearity_output: &(Vec<f64>, Vec<f64>),
    ) -> (Vec<f64>, Vec<f64>) {
        let jump_factor =
            if self.point_values.get(signal).is_some_and(|point| point.is_zero_order_hold) { 0.5 } else { 0.0 };
        let jump = |means: &[f64]| self.adjacent_means(means).map(|(a, b)| jump_factor * (b - a)).collect();
        (jump(&nonlinearity_output.0), jump(&nonlinearity_output.1))
    }

    /// The weighted values of the outputs at the compared samples, computed from their pulse means.
    ///
    /// All outputs are concatenated.
    pub(crate) fn weighted_samples(&self, response: &[Vec<f64>]) -> Vec<f64> {
        let mut samples = Vec::with_capacity(response.len() * self.compared_count());
        for (i, means) in response.iter().enumerate() {
            let filtered_means;
            let means = match &self.filter {
                Some((filter, filtered_outputs)) if filtered_outputs[i] && !self.is_prefiltered => {
                    filtered_means = series::multiply(filter, means, means.len());
                    &filtered_means
                }
                _ => means,
            };
            samples.extend(self.weights_of(i).zip(self.samples_of_pulses(means)).map(|(w, v)| w * v));
        }
        samples
    }

    /// Corrections `values` of the compared samples, multiplied by the weights, with all outputs concatenated. They are
    /// zero for filtered outputs.
    pub(crate) fn weighted_corrections(&self, values: &[Vec<f64>]) -> Vec<f64> {
        let mut out = Vec::with_capacity(values.len() * self.compared_count());
        for (i, row) in values.iter().enumerate() {
            let is_filtered = self.filter.as_ref().is_some_and(|(_, filtered_outputs)| filtered_outputs[i]);
            out.extend(self.weights_of(i).zip(row).map(|(w, v)| if is_filtered { 0.0 } else { w * v }));
        }
        out
    }
}

//! Recording of one run that can be sampled on any grid of block pulses: pulse means of its signals, and samples to
//! compare with a simulation.

use std::borrow::Cow;

use super::channel::{Channel, Role};
use super::sensor_filter::FilterStates;
use crate::equation::Filter;
use crate::error::{check_length, check_points, check_step, Error, Result};
use crate::estimation::joint_fit::format::format_general;
use crate::estimation::output_error::{Experiment, InputLaw, NonuniformSamples, PointValues};
use crate::regressors::Record;
use crate::series;
use crate::signal::block_pulse::{
    check_pulses, delay_samples, point_samples, pulse_means, Intersample, PulseJump, PulseMeans, SampleInterpolation,
};
use crate::signal::nonuniform::{check_times, interpolate, interpolate_gaps, NonuniformSignal, TIME_TOLERANCE};

/// Minimum number of samples of a recording.
const MIN_SAMPLES: usize = 3;
/// Minimum peak magnitude of a nonzero signal. Squares of smaller values underflow.
pub(crate) const MIN_SIGNAL_PEAK: f64 = 1e-140;

/// Sampling of runs: block pulses, decimation and length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Sampling {
    /// Number of block pulses per sampling interval after decimation.
    pub pulses_per_sample: usize,
    /// Decimation factor: one of this many successive samples is used.
    pub decimation: usize,
    /// Number of leading sampling intervals of each run that are used; None for all.
    pub leading_intervals: Option<usize>,
}

impl Sampling {
    /// Return an error for an invalid number of pulses or decimation factor.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a value that is zero or too large.
    ///
    /// ```
    /// # use ftlm::recording::Sampling;
    /// assert!(Sampling::default().check().is_ok());
    /// assert!(Sampling { decimation: 0, ..Sampling::default() }.check().is_err());
    /// ```
    pub fn check(self) -> Result<()> {
        for (name, number) in
            [("pulses per sampling interval", self.pulses_per_sample), ("decimation factor", self.decimation)]
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

/// One measured run. Its signals have the roles, delays, saturations and dead zones that a structure defines.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::recording::{Channel, Recording, Role};
/// use ftlm::signal::block_pulse::Intersample;
/// let y = Channel::new("y", vec![0.0, 1.0, f64::NAN, 9.0], Role::Output);
/// let u = Channel { delay: Some(0.1), ..Channel::new("u", vec![1.0, 2.0, 3.0, 4.0], Role::Input(Intersample::Hold)) };
/// let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
/// assert_eq!(run.pulses(3, false)?.means[1].values(), [0.0, 1.0, 2.0]);
/// assert_eq!(run.experiment(Default::default())?.sample_weights, [[1.0, 0.0]]);
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    name: String,
    step: f64,
    times: Option<Vec<f64>>,
    channels: Vec<Channel>,
    outputs: Vec<usize>,
    /// Sensor filter that some signals have passed; None without a filter.
    pub filter: Option<Filter>,
    /// Number of unknown initial states of the sensor filter; 0 with zero initial conditions.
    pub filter_states: usize,
    /// True if all signals were zero before the first sample.
    pub is_at_rest: bool,
    /// True if other outputs enter an equation as simulated, false if as measured.
    pub is_coupled: bool,
    /// True if an equation has friction or non-linear terms. Outputs are then simulated before the sensor filter.
    pub has_friction: bool,
    /// Signal index and kind of each delay, saturation and dead zone that is to be estimated.
    pub free_inputs: Vec<(usize, InputLaw)>,
}

/// Pulse means of the signals of a recording, with their filter, initial levels and jumps.
#[derive(Debug, Clone, PartialEq)]
pub struct Pulses {
    /// Pulse width \[s\].
    pub step: f64,
    /// Pulse means of each signal.
    pub means: Vec<PulseMeans>,
    /// Sensor filter as a power series in the one-step delay, if all signals have passed it.
    pub filter: Option<Vec<f64>>,
    /// For each signal, whether it may contain an initial transient of the sensor filter.
    pub has_transient: Vec<bool>,
    /// Initial level of each signal; 0 with zero initial conditions. Improper terms act on the deviation from this
    /// level.
    pub initial_levels: Vec<f64>,
    /// Pulse means of the responses of the sensor filter to an impulse and its derivatives, one row for each.
    pub impulse_responses: Vec<Vec<f64>>,
    /// Jumps of each zero-order-hold signal within pulses. Empty without friction, and if pulses are longer than a
    /// sampling interval.
    pub jumps: Vec<Vec<PulseJump>>,
}

impl Pulses {
    /// Return the record without filter transients and initial levels.
    ///
    /// # Errors
    /// The errors of [`Record::new`], for a pulse mean that is not finite or an invalid step.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert_eq!(run.pulses(3, false)?.into_record()?.signal(1), [1.0, 2.0, 2.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn into_record(self) -> Result<Record> {
        let record = Record::new(self.step, self.means, self.filter)?;
        if self.jumps.is_empty() {
            Ok(record)
        } else {
            record.with_jumps(self.jumps)
        }
    }

    /// Return the record with the filter transients and initial levels, if there are any.
    ///
    /// # Errors
    /// The errors of [`Record::new`], for a pulse mean that is not finite or an invalid step.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert_eq!(run.pulses(3, false)?.into_record_with_initial_state()?.m(), 3);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn into_record_with_initial_state(mut self) -> Result<Record> {
        let transient = std::mem::take(&mut self.has_transient);
        let (levels, responses) =
            (std::mem::take(&mut self.initial_levels), std::mem::take(&mut self.impulse_responses));
        let has_initial_state = transient.contains(&true) || levels.iter().any(|v| *v != 0.0);
        let record = self.into_record()?;
        if has_initial_state {
            record.with_initial_state(transient, &levels, responses)
        } else {
            Ok(record)
        }
    }
}

impl Recording {
    /// Build a recording of signals with the sampling interval `step` \[s\]. `times` \[s\] holds the nonuniform sample
    /// times, if any.
    ///
    /// `outputs` holds the indices of the signals that equations simulate, in the sequence of the equations.
    ///
    /// # Errors
    /// [`Error::Length`] for unequal or too few samples. [`Error::Structure`] for an output index out of range, or for
    /// times that do not ascend from 0. The errors of [`Channel::check`] for an invalid channel.
    pub fn new(
        name: &str,
        step: f64,
        times: Option<Vec<f64>>,
        channels: Vec<Channel>,
        outputs: Vec<usize>,
    ) -> Result<Self> {
        check_step(step)?;
        let rows = channels.first().map_or(0, |channel| channel.samples.len());
        check_length("samples of a run", rows.max(MIN_SAMPLES), rows)?;
        check_points("samples of a run", rows)?;
        if let Some(times) = &times {
            check_times(times)?;
        }
        for channel in &channels {
            check_length(&format!("signal {}", channel.name), rows, channel.samples.len())?;
            if channel.role != Role::Derived {
                let (expected, actual) = (times.as_ref().map(Vec::len), channel.nonuniform.as_ref().map(Vec::len));
                check_length("samples at nonuniform times", expected.unwrap_or(0), actual.unwrap_or(0))?;
            }
            channel.check()?;
        }
        if let Some(output) = outputs.iter().find(|output| **output >= channels.len()) {
            let what = format!("output {output} of {} signals", channels.len());
            return Err(Error::Structure { what, remedy: "number them from 0".into() });
        }
        Ok(Self {
            name: name.into(),
            step,
            times,
            channels,
            outputs,
            filter: None,
            filter_states: 0,
            is_at_rest: true,
            is_coupled: true,
            has_friction: false,
            free_inputs: Vec::new(),
        })
    }

    /// Return a recording of other signals with the same sample times, sensor filter and initial conditions.
    ///
    /// # Errors
    /// The errors of [`Recording::new`], for samples of unequal length or an invalid channel.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// let output = run.with_channels(run.channels()[..1].to_vec(), vec![0])?;
    /// assert_eq!(output.channels().len(), 1);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn with_channels(&self, channels: Vec<Channel>, outputs: Vec<usize>) -> Result<Self> {
        let new = Self::new(&self.name, self.step, self.times.clone(), channels, outputs)?;
        Ok(Self {
            filter: self.filter.clone(),
            filter_states: self.filter_states,
            is_at_rest: self.is_at_rest,
            is_coupled: self.is_coupled,
            has_friction: self.has_friction,
            ..new
        })
    }

    /// Name of the run for messages.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Build a recording of uniform samples. Its outputs are the channels with [`Role::Output`], in the sequence of
    /// `channels`.
    ///
    /// # Errors
    /// The errors of [`Self::new`], for samples of unequal length or an invalid channel.
    pub fn from_channels(step: f64, channels: Vec<Channel>) -> Result<Self> {
        let outputs = (0..channels.len()).filter(|&signal| channels[signal].role == Role::Output).collect();
        Self::new("run", step, None, channels, outputs)
    }

    /// Signals of the recording.
    #[must_use]
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// Return a signal by its index.
    ///
    /// # Errors
    /// [`Error::Structure`] for an index out of range.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert!(run.channel(1)?.name == "u" && run.channel(2).is_err());
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn channel(&self, signal: usize) -> Result<&Channel> {
        self.channels.get(signal).ok_or_else(|| Error::Structure {
            what: format!("signal {signal} of {}", self.channels.len()),
            remedy: "number them from 0".into(),
        })
    }

    /// Indices of the signals that equations simulate.
    #[must_use]
    pub fn outputs(&self) -> &[usize] {
        &self.outputs
    }

    /// Number of uniform samples.
    #[must_use]
    pub fn len(&self) -> usize {
        self.channels.first().map_or(0, |channel| channel.samples.len())
    }

    /// Always false: a recording has at least three samples.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Sampling interval \[s\].
    #[must_use]
    pub fn step(&self) -> f64 {
        self.step
    }

    /// Time from the first to the last uniform sample \[s\].
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn duration(&self) -> f64 {
        (self.len() - 1) as f64 * self.step
    }

    /// Return the recording with these values of the delays, saturations and dead zones in `free_inputs`.
    ///
    /// # Errors
    /// [`Error::Length`] for a wrong number of values. The errors of [`Channel::check`] for an invalid value.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// use ftlm::estimation::output_error::InputLaw;
    /// let mut run = run;
    /// run.free_inputs = vec![(1, InputLaw::Delay)];
    /// assert_eq!(run.with_free_inputs(&[0.1])?.pulse_means(1, 3)?.values(), [0.0, 1.0, 2.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn with_free_inputs(&self, values: &[f64]) -> Result<Self> {
        check_length("free input parameters", self.free_inputs.len(), values.len())?;
        let mut copy = self.clone();
        self.free_inputs.iter().try_for_each(|(signal, _)| self.channel(*signal).map(drop))?;
        for (&(signal, law), &value) in self.free_inputs.iter().zip(values) {
            let channel = &mut copy.channels[signal];
            if law == InputLaw::Delay {
                channel.delay = Some(value);
            }
            for (_, limit) in channel.nonlinearities.iter_mut().filter(|item| item.0 == law && item.1.is_none()) {
                *limit = Some(value);
            }
            channel.check()?;
        }
        copy.free_inputs.clear();
        Ok(copy)
    }

    /// Return the recording of the first `rows` samples.
    ///
    /// # Errors
    /// [`Error::Recording`] for fewer than three samples.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert_eq!(run.leading_part(3)?.len(), 3);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[allow(clippy::cast_precision_loss)]
    pub fn leading_part(&self, rows: usize) -> Result<Cow<'_, Self>> {
        if rows >= self.len() {
            return Ok(Cow::Borrowed(self));
        }
        if rows < MIN_SAMPLES {
            let what = format!("window: {rows} rows remain, {MIN_SAMPLES} are needed");
            return Err(Error::Recording { what, remedy: "widen the limits".into() });
        }
        // Interpolation up to the last uniform sample requires the nonuniform sample that follows it.
        let end = (rows - 1) as f64 * self.step + self.step;
        let nonuniform = self.times.as_ref().map_or(0, |times| times.partition_point(|time| *time <= end));
        let leading_channel = |channel: &Channel| channel.leading_part(rows, nonuniform);
        Ok(Cow::Owned(Self {
            name: self.name.clone(),
            times: self.times.as_ref().map(|times| times[..nonuniform].to_vec()),
            channels: self.channels.iter().map(leading_channel).collect(),
            outputs: self.outputs.clone(),
            filter: self.filter.clone(),
            free_inputs: self.free_inputs.clone(),
            ..*self
        }))
    }

    /// True if the equations relate filtered signals, because a measured signal that has passed the sensor filter
    /// enters them.
    #[must_use]
    pub fn is_all_filtered(&self) -> bool {
        let is_simulated = |signal| (self.is_coupled || self.has_friction) && self.outputs.contains(&signal);
        self.channels.iter().enumerate().any(|(signal, channel)| channel.is_filtered && !is_simulated(signal))
    }

    /// True if the recording has nonuniform sample times.
    #[must_use]
    pub fn has_nonuniform_samples(&self) -> bool {
        self.times.is_some()
    }

    /// True if simulations are compared with the measurement at nonuniform sample times.
    fn compares_nonuniform_samples(&self) -> bool {
        self.times.is_some() && self.free_inputs.is_empty() && !self.is_all_filtered()
    }

    /// Return the states of the sensor filter if its initial transient is removed from a signal, otherwise None. The
    /// transient is removed from filtered signals that enter other equations as measured.
    fn removed_transient(&self, signal: usize) -> Option<FilterStates> {
        let channel = &self.channels[signal];
        let is_simulated = self.is_coupled && self.outputs.contains(&signal);
        let is_commanded = channel.is_zero_order_hold() || (channel.delay.is_some() && channel.role != Role::Output);
        let enters_as_measured = channel.is_filtered && channel.enters_others && !is_simulated && !is_commanded;
        if !enters_as_measured || self.filter_states == 0 || channel.role == Role::Derived || !self.is_all_filtered() {
            return None;
        }
        FilterStates::from_filter(self.filter.as_ref()?).filter(|states| states.has_lasting_transient(self.step))
    }

    /// Return the uniform samples of a signal as it enters the equations. Known saturations and dead zones are applied,
    /// and the initial transient of the sensor filter is removed.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// use ftlm::estimation::output_error::InputLaw;
    /// let u = Channel { nonlinearities: vec![(InputLaw::Saturation, Some(1.5))], ..u };
    /// let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert_eq!(*run.acting_samples(1), [1.0, 1.5, 1.5, 1.5]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn acting_samples(&self, signal: usize) -> Cow<'_, [f64]> {
        let channel = &self.channels[signal];
        let limited = channel.apply_limits(&channel.samples);
        match self.transient(signal, &limited) {
            Some(transient) => limited.iter().zip(transient).map(|(v, offset)| v - offset).collect(),
            None => limited,
        }
    }

    /// Return the nonuniform samples of a signal as it enters the equations; None if it has no nonuniform samples.
    fn acting_nonuniform_samples(&self, signal: usize) -> Option<Cow<'_, [f64]>> {
        let (channel, times) = (&self.channels[signal], self.times.as_ref()?);
        let limited = channel.apply_limits(channel.nonuniform.as_ref()?);
        let uniform = channel.apply_limits(&channel.samples);
        let Some(transient) = self.transient(signal, &uniform) else { return Some(limited) };
        let transient_values: Vec<f64> = uniform.iter().zip(transient).map(|(v, offset)| v - (v - offset)).collect();
        let grid = self.uniform_times();
        Some(limited.iter().zip(times).map(|(v, &time)| v - interpolate(time, &grid, &transient_values)).collect())
    }

    fn transient(&self, signal: usize, samples: &[f64]) -> Option<Vec<f64>> {
        self.removed_transient(signal)?.transient(samples, self.step, self.filter_states)
    }

    #[allow(clippy::cast_precision_loss)]
    fn uniform_times(&self) -> Vec<f64> {
        (0..self.len()).map(|row| row as f64 * self.step).collect()
    }

    /// Return the value of a delayed signal before its first sample: 0 with zero initial conditions, otherwise the
    /// value of the first sample.
    pub(crate) fn value_before(&self, samples: &[f64]) -> f64 {
        if self.is_at_rest {
            0.0
        } else {
            samples[0]
        }
    }

    /// Return the means over `m` pulses of a signal as it enters the equations. They are exact integrals of the
    /// recorded signal with known saturations, dead zones and delay applied.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for no pulse or too many pulses, [`Error::NotFinite`] for a sample that is not finite.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert_eq!(run.pulse_means(1, 3)?.values(), [1.0, 2.0, 2.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[allow(clippy::cast_precision_loss)]
    pub fn pulse_means(&self, signal: usize, m: usize) -> Result<PulseMeans> {
        check_pulses(m)?;
        let channel = &self.channels[signal];
        let intersample = channel.intersample();
        if channel.role == Role::Derived {
            return pulse_means(&channel.samples, m, intersample);
        }
        if let (Some(times), Some(samples)) = (&self.times, self.acting_nonuniform_samples(signal))
            && (channel.role != Role::Output || !channel.nonuniform.iter().flatten().any(|v| v.is_nan()))
        {
            let before = self.value_before(&self.acting_samples(signal));
            let interpolant = NonuniformSignal::new_unchecked(times, &samples, intersample);
            return interpolant.with_delay(channel.lag(), before).means(m, self.duration() / m as f64);
        }
        let acting_samples = self.acting_samples(signal);
        let mut samples = interpolate_gaps(&acting_samples);
        if channel.lag() != 0.0 {
            let intervals = self.len() - 1;
            // On a finer grid a delayed command switches within a sampling interval. Its samples are therefore repeated
            // on that grid before the delay is applied.
            let count = if intersample == Intersample::Hold && m.is_multiple_of(intervals) {
                (m / intervals).max(1)
            } else {
                1
            };
            let before = self.value_before(&samples);
            let repeated: Vec<f64> =
                samples.iter().flat_map(|v| std::iter::repeat_n(*v, count)).take(intervals * count + 1).collect();
            samples = delay_samples(&repeated, channel.lag() / self.step * count as f64, before)?.into();
        }
        pulse_means(&samples, m, intersample)
    }

    /// Return the pulse means of all signals as they enter the equations.
    ///
    /// If `filtered`, signals that were not measured through the sensor filter are filtered. The equations then relate
    /// filtered signals.
    ///
    /// # Errors
    /// The errors of [`Recording::pulse_means`] and [`Filter::series`]. [`Error::Recording`] for a signal whose squares
    /// underflow.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert_eq!(run.pulses(3, false)?.means[1].values(), [1.0, 2.0, 2.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[allow(clippy::cast_precision_loss)]
    pub fn pulses(&self, m: usize, filtered: bool) -> Result<Pulses> {
        check_pulses(m)?;
        let step = self.duration() / m as f64;
        let filter = self.filter.as_ref().filter(|_| filtered);
        let series = filter.map(|filter| filter.series(m, step)).transpose()?;
        let mut means = Vec::with_capacity(self.channels.len());
        for (signal, channel) in self.channels.iter().enumerate() {
            let mut row = self.pulse_means(signal, m)?.into_vec();
            if let Some(series) = series.as_ref().filter(|_| !channel.is_filtered) {
                row = series::multiply(series, &row, m);
            }
            let peak = row.iter().fold(0.0, |peak: f64, v| peak.max(v.abs()));
            if 0.0 < peak && peak < MIN_SIGNAL_PEAK {
                let what = format!(
                    "signal '{}' of run '{}': no mean is larger than {}, and squares below {MIN_SIGNAL_PEAK:e} lose \
                     their digits",
                    channel.name,
                    self.name,
                    format_general(peak, 3),
                );
                return Err(Error::Recording { what, remedy: "scale the signal".into() });
            }
            means.push(PulseMeans::new(row));
        }
        let impulse_responses = match filter.and_then(FilterStates::from_filter) {
            Some(states) => states.impulse_responses(self.filter_states, m, step)?,
            None => Vec::new(),
        };
        let has_unknown_states = self.filter_states > 0 && series.is_some();
        let pulse_jumps = |signal| self.with_signal(signal, |line| line.pulse_jumps(m, step)).unwrap_or_default();
        // A pulse that is longer than a sampling interval averages over jumps.
        let has_jumps = self.has_friction && m >= self.len() - 1;
        let jumps = if has_jumps { (0..self.channels.len()).map(pulse_jumps).collect() } else { Vec::new() };
        Ok(Pulses {
            step,
            means,
            filter: series,
            has_transient: self.channels.iter().map(|channel| has_unknown_states && channel.is_filtered).collect(),
            initial_levels: (0..self.channels.len()).map(|signal| self.initial_level(signal)).collect(),
            impulse_responses,
            jumps,
        })
    }

    /// Return the initial level of a signal. It is 0 with zero initial conditions, for derived signals, and if the
    /// first sample is missing. It is also 0 for filtered signals if the equations relate filtered signals.
    fn initial_level(&self, signal: usize) -> f64 {
        let channel = &self.channels[signal];
        if self.is_at_rest || channel.role == Role::Derived || (channel.is_filtered && self.is_all_filtered()) {
            return 0.0;
        }
        let first = channel.apply_limits(&channel.samples[..1])[0];
        if first.is_finite() {
            first
        } else {
            0.0
        }
    }

    /// Return the experiment with the given sampling: pulse means of the signals, and the samples to compare with a
    /// simulation.
    ///
    /// Free delays, saturations and dead zones are not applied, because the fit determines them. Outputs have weight 1,
    /// and missing samples weight 0.
    ///
    /// # Errors
    /// The errors of [`Recording::pulses`] for an invalid number of pulses, of [`Recording::leading_part`] for fewer
    /// than three samples, and of [`Experiment::check`].
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role, Sampling};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// let fine = run.experiment(Sampling { pulses_per_sample: 2, ..Sampling::default() })?;
    /// assert_eq!(fine.record.m(), 6);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn experiment(&self, sampling: Sampling) -> Result<Experiment> {
        sampling.check()?;
        let Sampling { pulses_per_sample, decimation, leading_intervals } = sampling;
        let run = match leading_intervals {
            Some(intervals) => self.leading_part(intervals.saturating_add(1))?,
            None => Cow::Borrowed(self),
        };
        let intervals = (run.len() - 1) / decimation;
        let run = run.leading_part(intervals * decimation + 1)?;
        let filtered = run.is_all_filtered();
        let pulses = run.pulses(intervals.saturating_mul(pulses_per_sample), filtered)?;
        let (m, step) = (pulses.means[0].values().len(), pulses.step);
        let filter = if filtered { None } else { run.filter.as_ref() };
        let filter = filter.map(|filter| filter.series(m, step)).transpose()?;
        let weights = vec![1.0; run.outputs.len()];
        let nonuniform = run.compares_nonuniform_samples();
        let (experiment, sample_weights, point_values) = if nonuniform {
            run.nonuniform_experiment(pulses, decimation, weights)?
        } else {
            let point_values = (0..run.channels.len())
                .map(|signal| run.point_values(signal, &pulses, pulses_per_sample, decimation))
                .collect::<Result<_>>()?;
            let samples =
                run.outputs.iter().map(|&output| run.compared_samples(output, &pulses, pulses_per_sample, decimation));
            let (samples, sample_weights) = without_gaps(samples.collect());
            let record = pulses.into_record_with_initial_state()?;
            (Experiment::new(record, pulses_per_sample, samples, weights)?, sample_weights, point_values)
        };
        let experiment = match sample_weights {
            None => experiment,
            Some(sample_weights) if nonuniform => experiment.with_sample_weights(sample_weights)?,
            // The first and the last sample are not compared.
            Some(sample_weights) => {
                let inner = sample_weights.into_iter().map(|row| row[1..row.len() - 1].to_vec()).collect();
                experiment.with_sample_weights(inner)?
            }
        };
        let experiment = experiment.with_point_values(point_values)?;
        match filter {
            None => Ok(experiment),
            Some(series) => {
                let passes_filter = run.outputs.iter().map(|&output| run.channels[output].is_filtered).collect();
                experiment.with_filter(series, passes_filter)
            }
        }
    }

    /// Return the recorded samples of each output: the nonuniform samples if simulations are compared with these,
    /// otherwise the uniform samples. Missing samples are NaN.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert_eq!(run.recorded_rows(), [[0.0, 1.0, 4.0, 9.0]]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn recorded_rows(&self) -> Vec<Vec<f64>> {
        let outputs = self.outputs.iter().map(|&output| &self.channels[output]);
        let Some(times) = self.times.as_ref().filter(|_| self.compares_nonuniform_samples()) else {
            return outputs.map(|channel| channel.samples.clone()).collect();
        };
        let count = times.partition_point(|time| *time <= self.duration() * (1.0 + TIME_TOLERANCE));
        outputs.map(|channel| channel.leading_part(0, count).nonuniform.unwrap_or_default()).collect()
    }

    /// Return the memory of an experiment \[bytes\]: pulse means and values of the signals, samples and weights of the
    /// outputs.
    pub(super) fn bytes(&self, sampling: Sampling) -> usize {
        let rows = self.len().min(sampling.leading_intervals.unwrap_or(usize::MAX)) / sampling.decimation;
        let pulses = rows.saturating_mul(sampling.pulses_per_sample);
        let signals = pulses.saturating_add(rows).saturating_mul(self.channels.len());
        signals.saturating_add(2 * rows * self.outputs.len()).saturating_mul(size_of::<f64>())
    }

    /// Return the samples of each output to compare with a simulation on a grid of `pulses_per_sample` block pulses per
    /// sampling interval. They are filtered if the equations relate filtered signals. Missing samples are NaN.
    ///
    /// # Errors
    /// The errors of [`Recording::pulses`], for an invalid number of pulses or a sample that is not finite.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert_eq!(run.compared_rows(1)?, [[0.0, 1.0, 4.0, 9.0]]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn compared_rows(&self, pulses_per_sample: usize) -> Result<Vec<Vec<f64>>> {
        let mut outputs = self.outputs.iter().map(|&output| &self.channels[output]);
        let is_filtered = !self.is_all_filtered() || outputs.all(|channel| channel.is_filtered);
        if is_filtered || self.compares_nonuniform_samples() {
            return Ok(self.recorded_rows());
        }
        let pulses = self.pulses((self.len() - 1).saturating_mul(pulses_per_sample), true)?;
        Ok(self.outputs.iter().map(|&output| self.compared_samples(output, &pulses, pulses_per_sample, 1)).collect())
    }

    /// Return a recording of `rows` samples that are zero. If `sample` is (signal, row), this one sample is 1.
    pub(crate) fn unit_recording(&self, rows: usize, sample: Option<(usize, usize)>) -> Self {
        let unit_channel = |(signal, channel): (usize, &Channel)| {
            let mut samples = vec![0.0; rows];
            if let Some((_, row)) = sample.filter(|(index, _)| *index == signal) {
                samples[row] = 1.0;
            }
            Channel { samples, ..channel.leading_part(0, 0) }
        };
        let mut channels: Vec<Channel> = self.channels.iter().enumerate().map(unit_channel).collect();
        channels.iter_mut().for_each(|channel| {
            channel.nonlinearities.clear();
            channel.nonuniform = None;
        });
        Self {
            name: self.name.clone(),
            times: None,
            channels,
            outputs: self.outputs.clone(),
            filter: self.filter.clone(),
            filter_states: 0,
            is_at_rest: true,
            free_inputs: Vec::new(),
            ..*self
        }
    }

    /// Return the samples of an output to compare with a simulation. They are filtered if the equations relate filtered
    /// signals.
    fn compared_samples(&self, output: usize, pulses: &Pulses, stride: usize, decimation: usize) -> Vec<f64> {
        let channel = &self.channels[output];
        if pulses.filter.is_none() || channel.is_filtered {
            return channel.samples.iter().copied().step_by(decimation).collect();
        }
        point_samples(pulses.means[output].values()).into_iter().step_by(stride).collect()
    }

    /// Return the values of a signal at the sample times, after any jump at these times.
    ///
    /// The values are None for derived signals. They are None for signals to which the sensor filter is applied
    /// numerically, because these have no jumps or slope discontinuities. They are also None for an output with missing
    /// samples.
    fn point_values(&self, signal: usize, pulses: &Pulses, stride: usize, decimation: usize) -> Result<PointValues> {
        let channel = &self.channels[signal];
        let is_filtered_numerically = pulses.filter.is_some() && !channel.is_filtered;
        let samples = channel.nonuniform.as_ref().unwrap_or(&channel.samples);
        let has_gaps = channel.role == Role::Output && samples.iter().any(|v| v.is_nan());
        if channel.role == Role::Derived || has_gaps || is_filtered_numerically {
            return Ok(PointValues::default());
        }
        let is_zero_order_hold = channel.is_zero_order_hold();
        if channel.lag() != 0.0 && is_zero_order_hold {
            // A delayed command switches between samples. Its value at a sample time is that of the pulse that follows.
            let mut values: Vec<f64> = pulses.means[signal].values().iter().copied().step_by(stride).collect();
            values.extend(values.last().copied());
            return Ok(PointValues { values: Some(values), is_zero_order_hold });
        }
        let mut samples = self.acting_samples(signal);
        if channel.lag() != 0.0 {
            samples = delay_samples(&samples, channel.lag() / self.step, self.value_before(&samples))?.into();
        }
        Ok(PointValues { values: Some(samples.iter().copied().step_by(decimation).collect()), is_zero_order_hold })
    }

    /// Return the experiment at nonuniform sample times, the weights of its samples, and the point values of each
    /// signal. The weights are None if no sample is missing. Samples at t = 0 are not compared.
    #[allow(clippy::cast_precision_loss, clippy::type_complexity)]
    fn nonuniform_experiment(
        &self,
        pulses: Pulses,
        decimation: usize,
        weights: Vec<f64>,
    ) -> Result<(Experiment, Option<Vec<Vec<f64>>>, Vec<PointValues>)> {
        let times = self.times.as_deref().unwrap_or_default();
        let last = self.duration() * (1.0 + TIME_TOLERANCE);
        let rows: Vec<usize> =
            (0..times.len()).filter(|&row| times[row] > 0.0 && times[row] <= last).step_by(decimation).collect();
        let sample_times: Vec<f64> = rows.iter().map(|&row| times[row]).collect();
        let (m, step) = (pulses.means[0].values().len(), pulses.step);
        let positions = sample_times.iter().map(|time| (time / step).min(m as f64)).collect();
        let interpolation = SampleInterpolation::new(positions, m)?;
        let output_samples = |&output: &usize| {
            let samples_of_output = self.channels[output].nonuniform.as_deref().unwrap_or_default();
            rows.iter().map(|&row| samples_of_output[row]).collect()
        };
        let (samples, sample_weights) = without_gaps(self.outputs.iter().map(output_samples).collect());
        let mut jumps = Vec::with_capacity(self.channels.len());
        let mut point_values = Vec::with_capacity(self.channels.len());
        for signal in 0..self.channels.len() {
            jumps.push(self.jumps(signal).map(|(times, sizes)| {
                let positions: Vec<f64> = times.iter().map(|time| time / step).collect();
                interpolation.jumps(&positions, &sizes)
            }));
            // A signal with a missing sample is not an input.
            let values = self.values_at(signal, &sample_times).filter(|values| !values.iter().any(|v| v.is_nan()));
            point_values.push(PointValues { values, is_zero_order_hold: false });
        }
        let record = pulses.into_record_with_initial_state()?;
        let nonuniform = NonuniformSamples { interpolation, jumps };
        let experiment = Experiment::with_nonuniform_samples(record, samples, weights, nonuniform)?;
        Ok((experiment, sample_weights, point_values))
    }

    /// Return the times \[s\] and sizes of the jumps of a zero-order-hold input with its delay applied; None for other
    /// signals.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert!(run.jumps(0).is_none() && run.jumps(1).is_some());
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn jumps(&self, signal: usize) -> Option<(Vec<f64>, Vec<f64>)> {
        if !self.channels[signal].is_zero_order_hold() {
            return None;
        }
        self.with_signal(signal, |interpolant| interpolant.jumps()).flatten()
    }

    /// Return the values of a signal just after the given times \[s\], with delay, saturation and dead zone applied;
    /// None for a derived signal.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let y = Channel::new("y", vec![0.0, 1.0, 4.0, 9.0], Role::Output);
    /// # let u = Channel::new("u", vec![1.0, 2.0, 2.0, 3.0], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    /// assert!(run.values_at(0, &[0.15]).is_some_and(|values| (values[0] - 2.5).abs() < 1e-12));
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn values_at(&self, signal: usize, times: &[f64]) -> Option<Vec<f64>> {
        self.with_signal(signal, |interpolant| interpolant.at(times))
    }

    /// Apply a function to a signal at its own sample times, with saturations, dead zones and delay applied. Return
    /// None for a derived signal.
    fn with_signal<T>(&self, signal: usize, work: impl FnOnce(NonuniformSignal<'_>) -> T) -> Option<T> {
        let channel = &self.channels[signal];
        if channel.role == Role::Derived {
            return None;
        }
        let (times, measured) = match (&self.times, &channel.nonuniform) {
            (Some(times), Some(measured)) => (Cow::Borrowed(times.as_slice()), measured),
            _ => (Cow::Owned(self.uniform_times()), &channel.samples),
        };
        let samples = channel.apply_limits(measured);
        let interpolant = NonuniformSignal::new_unchecked(&times, &samples, channel.intersample());
        Some(work(interpolant.with_delay(channel.lag(), self.value_before(&samples))))
    }
}

/// Replace missing samples (NaN) by 0. Return the samples and their weights. A missing sample has weight 0, any other
/// sample weight 1. The weights are None if no sample is missing.
fn without_gaps(samples: Vec<Vec<f64>>) -> (Vec<Vec<f64>>, Option<Vec<Vec<f64>>>) {
    if !samples.iter().flatten().any(|v| v.is_nan()) {
        return (samples, None);
    }
    let weights = samples.iter().map(|row| row.iter().map(|v| f64::from(u8::from(!v.is_nan()))).collect()).collect();
    let replace_gaps = |row: Vec<f64>| row.into_iter().map(|v| if v.is_nan() { 0.0 } else { v }).collect();
    (samples.into_iter().map(replace_gaps).collect(), Some(weights))
}

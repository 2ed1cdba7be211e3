//! Channel: samples of one signal of a recording, with its delay, saturation and dead zone.

use std::borrow::Cow;

use crate::error::{check_finite, Error, Result};
use crate::estimation::output_error::InputLaw;
use crate::signal::block_pulse::Intersample;

/// Role of a signal in a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Input, with its behavior between samples.
    Input(Intersample),
    /// Output, linear between samples.
    Output,
    /// Signal computed from other signals, with a zero-order hold. Its values at single times are not known.
    Derived,
}

/// Saturation or dead zone of an input, and its value in the unit of the input. The value is None if it is to be
/// estimated.
pub type Nonlinearity = (InputLaw, Option<f64>);

/// One signal of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Channel {
    /// Name of the signal for messages.
    pub name: String,
    /// Samples on the uniform grid of the recording; NaN for missing samples of an output.
    pub samples: Vec<f64>,
    /// Samples at the nonuniform sample times of the recording, if it has such times; NaN for missing samples of an
    /// output.
    pub nonuniform: Option<Vec<f64>>,
    /// Role of the signal: input, output or derived signal.
    pub role: Role,
    /// Delay of an input \[s\]; None if the structure does not define a delay for it.
    pub delay: Option<f64>,
    /// Saturations and dead zones, in the sequence in which they act.
    pub nonlinearities: Vec<Nonlinearity>,
    /// True if the signal was measured through the sensor filter.
    pub is_filtered: bool,
    /// True if the signal enters the equation of another output.
    pub enters_others: bool,
}

impl Channel {
    /// Uniformly sampled signal without delay, saturation, dead zone or filter.
    #[must_use]
    pub fn new(name: &str, samples: Vec<f64>, role: Role) -> Self {
        Self {
            name: name.into(),
            samples,
            nonuniform: None,
            role,
            delay: None,
            nonlinearities: Vec::new(),
            is_filtered: false,
            enters_others: false,
        }
    }

    /// Return an error for invalid samples, delay, saturations or dead zones.
    ///
    /// # Errors
    /// [`Error::NotFinite`] for a sample of an input or a delay that is not finite. [`Error::OutOfRange`] for a
    /// saturation or dead zone that is negative or not finite.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// assert!(Channel::new("u", vec![f64::NAN], Role::Input(Intersample::Hold)).check().is_err());
    /// ```
    pub fn check(&self) -> Result<()> {
        if matches!(self.role, Role::Input(_)) {
            let sample_rows = std::iter::once(&self.samples).chain(&self.nonuniform);
            sample_rows.into_iter().try_for_each(|samples| check_finite(&format!("signal {}", self.name), samples))?;
        }
        check_finite(&format!("delay of {}", self.name), &[self.lag()])?;
        let mut limits = self.nonlinearities.iter().filter_map(|(_, value)| *value);
        match limits.find(|v| !(*v >= 0.0 && v.is_finite())) {
            None => Ok(()),
            Some(value) => Err(Error::OutOfRange {
                name: format!("limit of {}", self.name),
                value,
                range: "[0, ∞)".into(),
                remedy: "give a number from 0".into(),
            }),
        }
    }

    /// Return the behavior of the signal between its samples.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// assert_eq!(Channel::new("y", vec![0.0], Role::Output).intersample(), Intersample::Linear);
    /// ```
    #[must_use]
    pub fn intersample(&self) -> Intersample {
        match self.role {
            Role::Input(intersample) => intersample,
            Role::Output => Intersample::Linear,
            Role::Derived => Intersample::Hold,
        }
    }

    /// True if the signal is an input with zero-order hold.
    pub(crate) fn is_zero_order_hold(&self) -> bool {
        self.role == Role::Input(Intersample::Hold)
    }

    /// Delay \[s\]; 0 without a delay.
    pub(crate) fn lag(&self) -> f64 {
        self.delay.unwrap_or(0.0)
    }

    /// Return samples with the known saturations and dead zones of the channel applied.
    pub(super) fn apply_limits<'a>(&self, samples: &'a [f64]) -> Cow<'a, [f64]> {
        let mut values = Cow::Borrowed(samples);
        for (law, limit) in self.nonlinearities.iter().filter_map(|(law, value)| value.map(|value| (law, value))) {
            for v in values.to_mut() {
                let clipped = v.clamp(-limit, limit);
                *v = if *law == InputLaw::DeadZone { *v - clipped } else { clipped };
            }
        }
        values
    }

    /// Return the channel with the first `rows` uniform and the first `nonuniform` nonuniform samples.
    pub(super) fn leading_part(&self, rows: usize, nonuniform: usize) -> Self {
        let first = |samples: &[f64], count: usize| samples[..count.min(samples.len())].to_vec();
        Self {
            name: self.name.clone(),
            samples: first(&self.samples, rows),
            nonuniform: self.nonuniform.as_ref().map(|samples| first(samples, nonuniform)),
            nonlinearities: self.nonlinearities.clone(),
            ..*self
        }
    }
}

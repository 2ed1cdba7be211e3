//! Channel: samples of one signal of a recording, with its delay, saturation and dead zone.

use std::borrow::Cow;

use crate::error::{check_finite, Error, Result};
use crate::estimation::output_error::InputLaw;
use crate::signal::block_pulse::Intersample;

/// Role of a signal in a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Input of the machine, with its behavior between samples.
    Input(Intersample),
    /// Output, linear between samples.
    Output,
    /// Signal computed from others, held between samples; its values at single times are not known.
    Derived,
}

/// Saturation or dead zone of an input; the value is None while it is to be estimated.
pub type Nonlinearity = (InputLaw, Option<f64>);

/// One signal of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Channel {
    /// Name for messages.
    pub name: String,
    /// Samples on the uniform grid of the recording; NaN for missing samples of an output.
    pub samples: Vec<f64>,
    /// Samples at the nonuniform sample times of the recording, if it has any; NaN for missing samples of an output.
    pub nonuniform: Option<Vec<f64>>,
    /// Input, output or derived signal.
    pub role: Role,
    /// Delay of an input \[s\]; None if the structure has no delay of this input.
    pub delay: Option<f64>,
    /// Saturations and dead zones in the order in which they act.
    pub nonlinearities: Vec<Nonlinearity>,
    /// Whether the signal was measured through the sensor filter.
    pub is_filtered: bool,
    /// Whether the signal enters an equation of another output.
    pub enters_others: bool,
}

impl Channel {
    /// Uniformly sampled signal without delay, non-linearity or filter.
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

    /// Return an error for invalid samples or limits.
    ///
    /// # Errors
    /// [`Error::NotFinite`] for a sample of an input, [`Error::OutOfRange`] for a limit below 0.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// assert!(Channel::new("u", vec![f64::NAN], Role::Input(Intersample::Hold)).check().is_err());
    /// ```
    pub fn check(&self) -> Result<()> {
        if matches!(self.role, Role::Input(_)) {
            let all = std::iter::once(&self.samples).chain(&self.nonuniform);
            all.into_iter().try_for_each(|samples| check_finite(&format!("signal {}", self.name), samples))?;
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

    /// Behavior between samples.
    ///
    /// ```
    /// # use ftlm::recording::{Channel, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// assert_eq!(Channel::new("y", vec![0.0], Role::Output).intersample(), Intersample::Linear);
    /// ```
    #[must_use]
    pub fn intersample(&self) -> Intersample {
        match self.role {
            Role::Input(between) => between,
            Role::Output => Intersample::Linear,
            Role::Derived => Intersample::Hold,
        }
    }

    /// Whether the signal is an input that is held between samples.
    pub(crate) fn is_held_input(&self) -> bool {
        self.role == Role::Input(Intersample::Hold)
    }

    /// Delay \[s\].
    pub(crate) fn lag(&self) -> f64 {
        self.delay.unwrap_or(0.0)
    }

    /// Apply the known saturations and dead zones of the channel to samples.
    pub(super) fn behind_limits<'a>(&self, samples: &'a [f64]) -> Cow<'a, [f64]> {
        let mut limited = Cow::Borrowed(samples);
        for (law, limit) in self.nonlinearities.iter().filter_map(|(law, value)| value.map(|value| (law, value))) {
            for v in limited.to_mut() {
                let clipped = v.clamp(-limit, limit);
                *v = if *law == InputLaw::DeadZone { *v - clipped } else { clipped };
            }
        }
        limited
    }

    /// Channel of the first `rows` uniform and the first `nonuniform` nonuniform samples.
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

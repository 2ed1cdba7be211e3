//! What an actuator does to an input before it drives an equation: a delay, a saturation, a dead zone, its number free.

use crate::error::{Error, Result};
use crate::signal::block_pulse::delayed;

/// How an input acts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputLaw {
    /// Later, by a time \[s\].
    Delay,
    /// No further than a limit on either side of 0, in the input's unit.
    Saturation,
    /// By what exceeds a threshold on either side of 0, in the input's unit.
    DeadZone,
}

/// The free number of an input's law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FreeInput {
    /// Index of the input in the record; no equation's output.
    pub signal: usize,
    /// How it acts.
    pub law: InputLaw,
    /// Least and largest value: \[s\] of a delay, else in the input's unit.
    pub bounds: (f64, f64),
}

impl InputLaw {
    /// Pulse means of an input once it acts, and their derivative with respect to the number of its law.
    ///
    /// A delay shifts held inputs exactly, one that is linear in between to second order in the step; its derivative is
    /// that towards longer delays where it is a whole number of steps. A limit bends every pulse by itself, which is
    /// exact for what holds in between.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a number that is negative or none.
    ///
    /// ```
    /// use ftlm::estimation::output_error::input::InputLaw;
    /// # fn main() -> ftlm::error::Result<()> {
    /// let (means, slope) = InputLaw::Saturation.acted(&[0.5, 2.0, -3.0], 1.5, 0.1, 0.0)?;
    /// assert_eq!((means, slope), (vec![0.5, 1.5, -1.5], vec![0.0, 1.0, -1.0]));
    /// let (means, slope) = InputLaw::DeadZone.acted(&[0.5, 2.0, -3.0], 1.5, 0.1, 0.0)?;
    /// assert_eq!((means, slope), (vec![0.0, 0.5, -1.5], vec![0.0, -1.0, 1.0]));
    /// # Ok(())
    /// # }
    /// ```
    pub fn acted(self, means: &[f64], value: f64, step: f64, before: f64) -> Result<(Vec<f64>, Vec<f64>)> {
        if !(value >= 0.0 && value.is_finite()) {
            return Err(Error::OutOfRange {
                name: "number of an input".into(),
                value,
                range: "[0, ∞)".into(),
                remedy: "an input acts after it is given, and alike on both sides of 0".into(),
            });
        }
        let beyond = |v: f64| if v.abs() > value { v.signum() } else { 0.0 };
        Ok(match self {
            Self::Delay => {
                let steps = value / step;
                let whole = steps.floor();
                let (near, far) = (delayed(means, whole, before)?, delayed(means, whole + 1.0, before)?);
                let slope = near.iter().zip(&far).map(|(near, far)| (far - near) / step).collect();
                (delayed(means, steps, before)?, slope)
            }
            Self::Saturation => means.iter().map(|&v| (v.clamp(-value, value), beyond(v))).unzip(),
            Self::DeadZone => means
                .iter()
                .map(|&v| {
                    let side = beyond(v);
                    (if side == 0.0 { 0.0 } else { v - value * side }, -side)
                })
                .unzip(),
        })
    }
}

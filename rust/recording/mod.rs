//! Recordings: measured runs that can be sampled on any grid of block pulses, for joint fits.
//!
//! A recording contains the uniform samples of every signal of a structure, and nonuniform samples if there are any. It
//! also describes gaps, delays, saturations, dead zones and the sensor filter. [`Recording::pulses`] computes the pulse
//! means of the signals in the equations. [`Recording::experiment`] adds the samples to compare with a simulation.
//! Outputs are linear between samples. Inputs have a zero-order hold or are linear, as declared. Missing samples are
//! interpolated for pulse means, and have weight 0 in the comparison.

mod channel;
mod recordings;
mod run;
mod sensor_filter;

pub use channel::{Channel, Nonlinearity, Role};
pub use recordings::Recordings;
pub(crate) use run::MIN_SIGNAL_PEAK;
pub use run::{Pulses, Recording, Sampling};

//! Recordings: measured runs that are sampled on any grid of block pulses, as source of a joint fit.
//!
//! A recording contains the uniform samples of every signal of a structure, and the nonuniform samples if there are
//! any. It also has gaps, delays, saturations, dead zones and the sensor filter. It computes the pulse means of the
//! signals in the equations ([`Recording::pulses`]), and the samples for comparison with a simulation
//! ([`Recording::experiment`]). Outputs are linear between samples, inputs as they were recorded. Missing samples are
//! interpolated where pulse means need them, and have weight 0 where samples are compared.

mod channel;
mod recordings;
mod run;
mod sensor_filter;

pub use channel::{Channel, Nonlinearity, Role};
pub use recordings::Recordings;
pub(crate) use run::MIN_SIGNAL_PEAK;
pub use run::{Pulses, Recording, Sampling};

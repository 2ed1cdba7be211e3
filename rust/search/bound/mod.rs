//! What is proved of a candidate's output error from a few inner products with test vectors, without running it.

pub(crate) mod adapted;
pub mod lower;
pub(crate) mod probes;
pub(crate) mod reach;
mod vectors;

pub use lower::{excluded_by, lower_bounds, out_of_reach};

//! What is proved of a candidate's output error from a few inner products with test vectors, without running it.

pub mod lower;
pub(crate) mod probes;
pub(crate) mod reach;
mod vectors;

pub use lower::{lower_bounds, out_of_reach};

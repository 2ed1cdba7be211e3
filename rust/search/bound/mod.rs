//! What is proved of a candidate's output error from a few inner products with test vectors, without running it.

pub(crate) mod adapted;
mod losses;
pub mod lower;
pub(crate) mod probes;
pub(crate) mod reach;
pub(crate) mod roots;
pub(crate) mod tangents;
mod vectors;

pub use lower::{excluded_by, excluded_in_turn, lower_bounds, out_of_reach};
pub use roots::explodes;
pub use tangents::excluded_along;

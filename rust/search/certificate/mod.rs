//! What is proved of all orders, not of a lattice's alone: no orders in some intervals have a smaller equation error.
//!
//! The regressor of a term is a smooth curve in its order (`curve`). About the middle of a cell of orders the least
//! squared equation error is bounded from below over the whole cell (`cell`, `span`), from inner products that are made
//! once for middles of all sizes of cells (`tables`); cells that are not far enough above the best are halved (`sweep`).

mod cell;
mod curve;
mod region;
mod span;
mod sweep;
mod tables;

pub use cell::cell_bounds;
pub use region::{Range, Region};
pub use sweep::{certify, Asked, Certificate};

//! What is proved of all orders, not of a lattice's alone: no orders in some intervals have a smaller equation error.
//!
//! The regressor of a term is a smooth curve in its order (`regressor_expansion`). About the middle of a cell of orders
//! the least squared equation error is bounded from below over the whole cell (`cell_bound`, `subspace_bound`), from
//! inner products that are made once for middles of all sizes of cells (`gram_tables`); cells that are not far enough
//! above the best are halved (`bisection`).

mod bisection;
mod cell_bound;
mod gram_tables;
mod regressor_expansion;
mod subspace_bound;

pub use bisection::{certify, Asked, Certificate};
pub use cell_bound::cell_bounds;
pub use gram_tables::{Range, Region};

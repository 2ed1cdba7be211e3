//! Branch and bound over boxes of orders: one dual bound excludes all candidates of a box.
//!
//! Two orders vary over a slice of the order grid. The inner products and norms that the bound needs are tabulated once
//! per slice along each of the two orders (`axis_table`). The coefficients of all candidates of the slice are computed.
//! Over a box, every other quantity is interpolated between the corners, with a bound of the interpolation error
//! (`box_bound`). Boxes are bisected until the bound excludes them or they are small (`bisection`).

mod axis_table;
mod bisection;
mod box_bound;

pub use bisection::{box_bounds, open_candidates, BoxBound};
pub(crate) use bisection::{screen_slice, BranchAndBound, MIN_SLICE_CANDIDATES};

//! Branch and bound over boxes of orders: one dual bound excludes all candidates of a box.
//!
//! Two orders vary over a slice of the order grid. The quantities of the dual bound are tabulated once per slice along
//! each order (`axis_table`), and the coefficients of all candidates are computed. Over a box, all quantities are
//! interpolated between its corners, with bounded remainders (`box_bound`). Boxes are bisected until they are excluded
//! or small (`bisection`).

mod axis_table;
mod bisection;
mod box_bound;

pub use bisection::{box_bounds, open_candidates, BoxBound};
pub(crate) use bisection::{screen_slice, BranchAndBound, MIN_SLICE_CANDIDATES};

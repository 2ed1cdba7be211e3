//! Boxes of orders: whole boxes of candidates excluded by one proved bound.
//!
//! Over a slab of the lattice two orders alone vary (`crate::order_search::grid::traversal`). What the candidate bound
//! is made of (`crate::order_search::dual_bound::lower_bound`) is tabled along each of the two once for the slab
//! (`axis_table`), coefficients are made of all candidates, and laid over a box by its corners with proved remainders
//! (`box_bound`), and boxes are halved until they are excluded or small (`bisection`).

mod axis_table;
mod bisection;
mod box_bound;

pub use bisection::{box_bounds, left_open, Boxed};
pub(crate) use bisection::{screen_slab, Boxes, LEAST};

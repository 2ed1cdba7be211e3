//! Boxes of orders: whole boxes of candidates excluded by one proved bound.
//!
//! Over a slab of the lattice two orders alone vary (`crate::search::lattice::slab`). What the candidate bound is made
//! of (`crate::search::bound::lower`) is tabled along each of the two once for the slab (`side`), coefficients are made of
//! all candidates (`strip`), all is laid over a box by its corners with proved remainders (`cell`), and boxes are halved
//! until they are excluded or small (`walk`).

mod cell;
mod side;
mod strip;
mod walk;

pub use walk::{box_bounds, left_open, Boxed};
pub(crate) use walk::{screen_slab, Boxes, LEAST};

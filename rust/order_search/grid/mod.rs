//! Order grids of a search, enumerated by index.
//!
//! The orders of the terms are independent ([`independent`]), or they depend on a few free orders by a law
//! ([`order_law`]). Only the axes are stored, not their product.

pub mod independent;
pub mod order_law;
pub(crate) mod traversal;

pub use independent::{OrderGrid, TermAxis, MAX_CANDIDATES};
pub use order_law::{LawEquation, OrderLawGrid, MAX_TUPLES};

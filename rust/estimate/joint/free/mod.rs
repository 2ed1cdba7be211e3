//! What is free in a joint fit, by name: structures that lose terms, orders and coefficients on the way to simpler ones.

mod order;
mod structure;
mod unknowns;

pub use order::Order;
pub use structure::{Coefficient, Equation, Hints, Input, Law, Rubs, Structure, Term};
pub use unknowns::{Free, ALPHA_BOUNDS, SEARCHED_ORDER};

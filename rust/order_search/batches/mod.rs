//! Batch evaluation of an order search over one equation.

mod batch;
mod evaluator;
mod incumbent;
mod vector_generation;

pub use evaluator::{algorithm, rounds, rounds_by, search, waves, Search};

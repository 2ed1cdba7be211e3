//! A search over a lattice, round by round.

mod along;
mod batch;
mod evaluator;
mod incumbent;
mod nearby;
mod plan;
mod vector_generation;

pub use evaluator::{search, Search};
pub use plan::{algorithm, rounds, rounds_by, waves};

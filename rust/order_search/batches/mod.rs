//! A search over a lattice, round by round.

mod batch;
mod evaluator;
mod incumbent;
mod vector_generation;

pub use evaluator::{algorithm, rounds, rounds_by, search, waves, Search};

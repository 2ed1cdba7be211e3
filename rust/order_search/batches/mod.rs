//! Batch evaluation of an order search over one equation.

mod batch;
mod evaluator;
mod incumbent;
mod vector_generation;

pub use evaluator::{algorithm_version, batch_count, batch_count_by_version, generation_ends, search, BatchEvaluator};

//! Batch evaluation of an order search over one equation.

mod batch;
mod evaluator;
mod incumbent;
mod vector_generation;

pub use evaluator::{batch_count, generation_ends, search, BatchEvaluator};

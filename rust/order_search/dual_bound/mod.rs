//! Lower bounds of a candidate's output error from few inner products with test vectors, without simulation.

pub(crate) mod infeasibility;
pub(crate) mod linearized_vectors;
pub mod lower_bound;
pub(crate) mod tailored_vectors;
pub(crate) mod test_vectors;
pub(crate) mod unstable_zeros;

pub use linearized_vectors::excluded_by_linearized_vector;
pub use lower_bound::{excluded_by, exclusion_flags, is_infeasible, lower_bounds};
pub use unstable_zeros::has_unstable_zeros;

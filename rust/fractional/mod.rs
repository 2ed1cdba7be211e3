//! Fractional integrals and derivatives: kernels, operational matrices, and an approximation whose memory does not grow
//! with the record.

pub mod exponential_sum;
mod integer_powers;
pub mod integral;
pub mod kernels;
pub mod operational_matrices;
pub(crate) mod starred_transform;

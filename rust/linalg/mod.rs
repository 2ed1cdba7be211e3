//! Linear algebra: dense products and factors, small solves, orthonormal bases of long columns.

pub mod dense;
pub(crate) mod orthogonal;
pub mod small;

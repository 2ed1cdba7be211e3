//! Estimators of the coefficients at given orders, one file each.

pub mod least_squares;
pub mod multi_innovation;

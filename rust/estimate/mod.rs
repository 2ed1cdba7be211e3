//! Estimators, one file each: of the coefficients at given orders, and of orders and coefficients together.

pub mod instrumental_variables;
pub mod least_squares;
pub mod multi_innovation;
pub mod multivariable;
pub mod output_error;
pub mod streaming;

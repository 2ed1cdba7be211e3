//! Estimators, a module each: of the coefficients at given orders, and of orders and coefficients together.

pub mod iv;
pub mod joint;
pub mod least_squares;
pub mod multi_innovation;
pub mod output_error;
pub mod resonances;
pub mod streaming;

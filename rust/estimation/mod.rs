//! Estimators: coefficients at given orders, and orders and coefficients together.

pub mod generalized_least_squares;
pub mod instrumental_variables;
pub mod joint_fit;
pub mod least_squares;
pub mod multi_innovation;
pub mod optimization;
pub mod output_error;
pub mod resonance_scan;
pub mod streaming;

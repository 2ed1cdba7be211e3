//! Optimization: nonlinear least squares within bounds.

pub mod damped_step;
pub mod levenberg_marquardt;
pub mod prior;

//! Optimization: nonlinear least squares within bounds.

mod curvature;
pub mod damped_step;
pub mod levenberg_marquardt;
pub mod problem;
mod valley;

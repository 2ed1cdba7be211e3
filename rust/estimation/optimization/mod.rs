//! Optimization: non-linear least squares within bounds.

pub mod damped_step;
pub mod levenberg_marquardt;

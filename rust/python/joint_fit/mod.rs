//! Bindings of the joint fit: structures by name, multistart, fit with intervals, residual analysis.

mod fit;
mod problem;
mod resampler;
mod residuals;
mod structure;

pub use fit::{joint_fit, joint_grids, joint_race, JointRace};
pub use problem::{JointClock, JointProblem};
pub use residuals::{
    autocovariances, chi_squared, colour_covariances, coloured, covariance_of, fit_covariance, is_white, long_run,
};

//! Bindings of the joint fit: structures by name, multistart, fit with intervals, residual analysis.

mod fit;
mod problem;
mod profile;
mod residuals;
mod structure;

pub use fit::{joint_fit, joint_multistart, JointMultistart};
pub use problem::JointProblem;
pub use profile::{cost_surface, profile_intervals};
pub use residuals::{
    arx_model, autocovariances, chi_squared, covariance_of, fit_covariance, is_white, long_run_covariance, portmanteau,
    prediction_ratio, variance_inflation, whitening_filter,
};

//! Output-error fit of bodies with friction by Levenberg–Marquardt: orders, coefficients and initial states.

use super::model::FrictionModel;
use crate::error::Result;
use crate::estimation::optimization::levenberg_marquardt::MinimizationSettings;
use crate::estimation::output_error::Experiment;
use crate::estimation::state_fit;
pub use crate::estimation::state_fit::{Start, StateFit};
use crate::parallel::Stop;

/// Least-squares fit with weights of the output error from an initial guess.
///
/// # Errors
/// An initial guess whose simulation overflows ([`crate::error::Error::Diverged`]), an inconsistent model or
/// experiments that do not fit it ([`FrictionModel::check`]).
pub fn fit(
    model: &FrictionModel,
    experiments: &[Experiment],
    start: &Start,
    settings: MinimizationSettings,
) -> Result<StateFit> {
    fit_until(model, experiments, start, settings, &Stop::default())
}

/// Interruptible [`fit`].
///
/// # Errors
/// As [`fit`]; [`crate::error::Error::Interrupted`].
pub fn fit_until(
    model: &FrictionModel,
    experiments: &[Experiment],
    start: &Start,
    settings: MinimizationSettings,
    stop: &Stop,
) -> Result<StateFit> {
    state_fit::fit(model, experiments, start, settings, stop)
}

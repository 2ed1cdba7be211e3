//! Output-error fit of bodies with friction by Levenberg–Marquardt: orders, coefficients and initial states.

use super::model::FrictionModel;
use crate::error::Result;
use crate::estimation::optimization::levenberg_marquardt::Settings;
use crate::estimation::output_error::Experiment;
use crate::estimation::state_fit;
pub use crate::estimation::state_fit::{Fit, Start};
use crate::parallel::Stop;

/// Least-squares fit with weights of the output error from an initial guess.
///
/// # Errors
/// An initial guess whose simulation overflows ([`crate::error::Error::Diverged`]), an inconsistent model or
/// experiments that do not fit it ([`FrictionModel::check`]).
pub fn fit(model: &FrictionModel, experiments: &[Experiment], start: &Start, settings: Settings) -> Result<Fit> {
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
    settings: Settings,
    stop: &Stop,
) -> Result<Fit> {
    state_fit::fit(model, experiments, start, settings, stop)
}

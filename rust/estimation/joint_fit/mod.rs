//! A joint fit of all equations on all runs by output error: one call from a structure, its runs and settings to an optimum
//! with its covariance.
//!
//! [`parameter_set::Free`] says what is free in a structure. [`initial_guesses::Lattices`] finds where to start from,
//! [`multistart::race`] sends the starts over laps on thinned samples, [`reweighting::settled`] descends until each
//! output weighs by its own residuals, [`stability_preference::steadied`] keeps free runs that grow only where the runs
//! force them, and [`step_refinement::refined`] halves the step until that moves the estimate by little of its standard
//! error, and tells the limit. [`fit::fit`] is all of it. What is compared with comes from a [`Source`], which samples
//! runs as finely as it is asked.

pub mod covariance;
pub mod fit;
mod format;
pub mod initial_guesses;
pub mod multistart;
pub mod objective;
pub mod parameter_set;
pub mod problem;
pub mod progress;
pub mod reweighting;
pub mod source;
pub mod stability_preference;
pub mod step_refinement;
pub mod structure;

pub use fit::{JointFit, Outset, Settings, Size, Sought};
pub use multistart::Starts;
pub use objective::{Grid, Weights};
pub use parameter_set::Clock;
pub use problem::{Attempt, Place, Problem, Runner};
pub use reweighting::{settled, Loss, Robust};
pub use source::{Recordings, Sampled, Sampling, Signal, Source};
pub use stability_preference::Growth;
pub use step_refinement::{freed, refined, Finished, Optimum};

//! A joint fit of all equations on all runs by output error: one call from a structure, its runs and settings to an optimum
//! with its covariance.
//!
//! [`parameter_set::Free`] says what is free in a structure. [`initial_guesses::Lattices`] finds where to start from,
//! [`multistart::race`] sends the starts over laps on thinned samples, [`settled::settled`] descends until each output
//! weighs by its own residuals, [`stability_preference::steadied`] keeps free runs that grow only where the runs force
//! them, and [`step_refinement::refined`] halves the step until that moves the estimate by little of its standard
//! error, and tells the limit. [`fit::fit`] is all of it. What is compared with comes from a [`Source`], which samples
//! runs as finely as it is asked.

pub mod attempt;
mod clock;
pub mod covariance;
mod feasible;
pub mod fit;
mod format;
pub mod initial_guesses;
pub mod multistart;
pub mod objective;
pub mod order;
pub mod parameter_set;
pub mod problem;
pub mod progress;
pub mod reweighting;
mod runner;
pub mod settled;
pub mod source;
pub mod stability_preference;
pub mod step_refinement;
pub mod structure;

pub use attempt::{Attempt, Place};
pub use clock::Clock;
pub use fit::{JointFit, Outset, Settings, Size, Sought};
pub use multistart::Starts;
pub use objective::{Grid, Weights};
pub use problem::Problem;
pub use reweighting::{Loss, Robust};
pub use runner::Runner;
pub use settled::settled;
pub use source::{Recordings, Sampled, Sampling, Signal, Source};
pub use stability_preference::Growth;
pub use step_refinement::{freed, refined, Finished, Optimum};

//! The end of a joint fit: from a start to an optimum on a grid fine enough, with its weights, its limit at step 0 and the
//! covariance that its residuals leave.
//!
//! [`settled::settled`] descends until each output weighs by its own residuals; [`refined::refined`] halves the step until
//! that moves the estimate by little of its standard error, and tells the limit. What both compare with comes from a
//! [`Source`], which samples runs as finely as it is asked.

pub mod attempt;
mod clock;
pub mod covariance;
mod feasible;
pub mod free;
pub mod grid;
pub mod problem;
pub mod refined;
mod runner;
pub mod settled;
pub mod shares;
pub mod source;
pub mod starts;
mod words;

pub use attempt::{Attempt, Place};
pub use clock::Clock;
pub use grid::{Grid, Weights};
pub use problem::Problem;
pub use refined::{freed, refined, Finished, Optimum};
pub use runner::Runner;
pub use settled::settled;
pub use shares::{Loss, Robust};
pub use source::{Recordings, Sampled, Sampling, Signal, Source};

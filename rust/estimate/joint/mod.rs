//! A joint fit of all equations on all runs by output error: one call from a structure, its runs and settings to an optimum
//! with its covariance.
//!
//! [`free::Free`] says what is free in a structure. [`starts::Lattices`] finds where to start from, [`race::race`] sends the
//! starts over laps on thinned samples, [`settled::settled`] descends until each output weighs by its own residuals,
//! [`steady::steadied`] keeps free runs that grow only where the runs force them, and [`refined::refined`] halves the step
//! until that moves the estimate by little of its standard error, and tells the limit. [`fit::fit`] is all of it. What is
//! compared with comes from a [`Source`], which samples runs as finely as it is asked.

pub mod attempt;
mod clock;
pub mod covariance;
mod feasible;
pub mod fit;
pub mod free;
pub mod grid;
pub mod pace;
pub mod problem;
pub mod race;
pub mod refined;
mod runner;
pub mod settled;
pub mod shares;
pub mod source;
pub mod starts;
pub mod steady;
mod words;

pub use attempt::{Attempt, Place};
pub use clock::Clock;
pub use fit::{JointFit, Outset, Settings, Size, Sought};
pub use grid::{Grid, Weights};
pub use problem::Problem;
pub use race::Starts;
pub use refined::{freed, refined, Finished, Optimum};
pub use runner::Runner;
pub use settled::settled;
pub use shares::{Loss, Robust};
pub use source::{Recordings, Sampled, Sampling, Signal, Source};
pub use steady::Growth;

//! Joint fit of all equations to all runs by output error, from a structure to an optimum with its covariance.
//!
//! A `ParameterSet` lists the free parameters of a structure. Initial guesses come from coarse order grids. A
//! multistart with successive halving optimizes them on subsampled records. Iterative reweighting then estimates the
//! noise level of each output. An unstable optimum is kept only if it fits significantly better than a stable one.
//! Finally the step is halved until the estimate changes by a small part of its standard error, and extrapolated to
//! zero step. [`fit::fit`] runs all of it. The runs come from a [`Source`], which samples them at the requested step.

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

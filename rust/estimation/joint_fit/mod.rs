//! Joint fit of all equations to all runs by output error, from a structure to an optimum with its covariance.
//!
//! A `ParameterSet` lists the free parameters of a structure. Initial guesses come from coarse order grids. A
//! multistart with successive halving optimizes them on subsampled records. Iterative reweighting then estimates the
//! noise level of each output. An unstable optimum is kept only if it fits significantly better than a stable one.
//! Finally the step of the simulation is halved until the estimate changes by a small part of its standard error. The
//! estimate is extrapolated to zero step. [`fit::fit`] performs all of these steps.
//! [`Recordings`](crate::recording::Recordings) sample the runs at the requested step.

pub mod covariance;
pub mod fit;
pub(crate) mod format;
pub mod initial_guesses;
pub mod multistart;
pub mod objective;
pub mod parameter_set;
pub mod problem;
pub mod profile;
pub mod progress;
pub mod reweighting;
pub mod stability_preference;
pub mod step_refinement;
pub mod structure;

pub use fit::{fit_equations, EquationFit, FitProblem, Initialization, JointFit, OutputScale, Settings};
pub use multistart::InitialGuessSource;
pub use objective::{Objective, Weights};
pub use parameter_set::TimeScaling;
pub use problem::{Candidate, Iterate, OptimizationResult, Problem};
pub use reweighting::{fit_reweighted, Loss, RobustSummary};
pub use stability_preference::StabilityComparison;
pub use step_refinement::{best_alternative, correct_step, refine_step, Optimum, OptimumStatistics};

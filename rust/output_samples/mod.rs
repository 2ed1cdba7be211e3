//! Output samples: simulation of a model on a recording, at its sample times, on one grid or in the limit of zero step.
//!
//! Samples follow from the pulse means of the outputs before them, and direct feedthrough from the values of the inputs
//! at the samples. Initial terms are given, or fitted to the measured samples. The step is halved until Richardson
//! extrapolation has converged; the responses of long records are refined only where they change. Integer orders on
//! uniform samples need no grid. Initial terms that represent past inputs have a prior.

mod exact;
mod initial_terms;
mod past_inputs;
mod refinement;
mod richardson;
mod simulation;

pub use initial_terms::{fit_initial_terms, OutputSamples};
pub use refinement::{RefinedSamples, Refinement};
pub use richardson::{richardson_limit, LimitEstimate};
pub use simulation::{InitialTerms, OutputSimulation};

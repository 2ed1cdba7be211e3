//! Output samples: simulation of a model on a recording, at its sample times, on one grid of block pulses or in the
//! limit of zero step.
//!
//! A sample at a uniform sample time is extrapolated from the pulse means before it. Direct feedthrough uses the values
//! of the inputs at the sample times. Initial terms are given, or fitted to the measured samples. The step is halved
//! until Richardson extrapolation has converged. For long records, responses to single samples are superposed, and
//! refined only where they change. Models of integer orders at uniform sample times are simulated exactly, without
//! block pulses. Initial terms that represent past inputs have a prior.

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

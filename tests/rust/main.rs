//! Tests of the mathematics: reference numbers, naive oracles, identities and orders of convergence.
//!
//! One module a topic; `common` holds what they share. Every random number has a fixed seed.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

mod argument_errors;
mod bindings;
mod branch_and_bound;
mod certificate;
mod coupled_instrumental_variables;
mod coupled_search;
mod dual_bounds;
mod equation;
mod estimators;
mod force_jumps;
mod fractional;
mod friction;
mod given_points;
mod haar;
mod initial_guesses;
mod input_limits;
mod instrumental_variables;
mod joint_fit;
mod kernels;
mod levenberg_marquardt;
mod metrics;
mod nonuniform_samples;
mod output_error;
mod output_samples;
mod plants;
mod pulse_means;
mod rig;
mod screening_bounds;
mod search;
mod search_argument_errors;
mod series;
mod simulate;
mod time_scaling;

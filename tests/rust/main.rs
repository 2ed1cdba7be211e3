//! Tests of the mathematics: reference numbers, naive oracles, identities and orders of convergence.
//!
//! One module a topic; `common` holds what they share. Every random number has a fixed seed.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

mod bindings;
mod boxes;
mod certificate;
mod clock;
mod equation;
mod estimators;
mod fractional;
mod friction;
mod haar;
mod iv;
mod joint;
mod joint_fit;
mod kernels;
mod levenberg_marquardt;
mod limits;
mod means;
mod metrics;
mod output_error;
mod plants;
mod points;
mod proofs;
mod readings;
mod refusals;
mod rig;
mod search;
mod search_refusals;
mod series;
mod simulate;
mod stage;
mod starts;

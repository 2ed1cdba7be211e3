//! Exhaustive order search over one equation or over coupled equations.
//!
//! Candidates are enumerated by index ([`grid`]). A candidate is excluded by a lower bound of its output error
//! ([`dual_bound`]), or together with a whole box of orders by branch and bound ([`branch_and_bound`]). The remaining
//! candidates are simulated in parallel batches ([`batches`]). For coupled equations, the score tables of the equations
//! are joined under their order law ([`stage_join`]). The module [`given_points`] evaluates given orders and
//! coefficients. A [`certificate`] bounds the equation error from below over all real orders. The settings are in
//! [`options`], the results in [`result`], and stop requests and checkpoints in [`control`].

pub mod batches;
pub mod branch_and_bound;
mod candidate;
mod candidate_index;
pub mod certificate;
pub mod control;
pub mod dual_bound;
pub mod given_points;
pub mod grid;
pub mod options;
pub mod result;
mod screening;
pub mod stage_join;

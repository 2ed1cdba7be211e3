//! Exhaustive order searches: generate by index ([`grid`]), exclude by a proved bound ([`dual_bound`]), evaluate in
//! parallel ([`batches`]), join the equations of a stage under its order law ([`stage_join`]); evaluate points off the
//! lattice ([`given_points`]), or prove something of all orders at once ([`certificate`]). All speak of [`options`],
//! [`result`] and [`control`].

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

//! Exhaustive order searches: generate by index ([`lattice`]), exclude by a proved bound ([`bound`]), evaluate in
//! parallel ([`run`]), join the equations of a stage under its order law ([`stage`]); or evaluate points off the lattice
//! ([`points`]).

pub mod bound;
mod instruments;
pub mod lattice;
pub mod points;
pub mod run;
pub mod stage;

//! Exhaustive order searches: enumerate ([`lattice`]), evaluate in parallel ([`run`]), join the equations of a stage
//! under its order law ([`stage`]).

pub mod lattice;
pub mod run;
pub mod stage;

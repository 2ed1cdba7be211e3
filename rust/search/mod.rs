//! Exhaustive order searches: generate by index ([`lattice`]), exclude by a proved bound ([`bound`]), evaluate in
//! parallel ([`rounds`]), join the equations of a stage under its order law ([`stage`]); or evaluate points off the
//! lattice ([`points`]). All speak of [`options`], [`outcome`] and [`control`].

pub mod bound;
pub mod boxes;
mod budget;
mod candidate;
mod catalogue;
pub mod control;
pub mod lattice;
pub mod options;
pub mod outcome;
pub mod points;
pub mod rounds;
mod screen;
mod spread;
pub mod stage;
pub mod threads;

//! Exhaustive order searches: generate by index ([`lattice`]), exclude by a proved bound ([`bound`]), evaluate in
//! parallel ([`rounds`]), join the equations of a stage under its order law ([`stage`]); evaluate points off the
//! lattice ([`points`]), or prove something of all orders at once ([`certificate`]). All speak of [`options`],
//! [`outcome`] and [`control`].

pub mod bound;
pub mod boxes;
mod budget;
mod candidate;
mod catalogue;
pub mod certificate;
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

//! A search over a lattice, round by round.

mod along;
mod hunt;
mod made;
mod nearby;
mod plan;
mod ready;
mod scouts;

pub use plan::{algorithm, rounds, rounds_by, waves};
pub use ready::{search, Search};

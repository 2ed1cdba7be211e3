//! The race of starts: short fits on thinned samples, of which the best go on.
//!
//! [`race`] sends starts over laps, from a glance to those few that go on on all samples. Beside them run the problems
//! inside a problem, whose optima it reaches, too: a term less ([`Simpler`]), an order less ([`LowerOrder`]), orders known
//! ([`Held`]) or whole ([`Whole`]).

mod behind;
mod bodies;
mod coarse_grid;
mod halving;
mod known;
mod lower;
mod nested_models;
mod search;
mod thinned;
mod whole;

pub use bodies::on_coarse_grids;
pub use halving::{distinct, finalists, in_reach, same_optimum, same_place};
pub use known::{held, Held};
pub use lower::{lower_order, LowerOrder};
pub use nested_models::{simpler, unlike, Simpler};
pub use search::{race, Course, Starts};
pub use whole::{whole, Whole};

//! The race of starts: short fits on thinned samples, of which the best go on.
//!
//! [`race`] sends starts over laps, from a glance to those few that go on on all samples. Beside them run the problems
//! inside a problem, whose optima it reaches, too: a term less ([`Simpler`]), an order less ([`LowerOrder`]), orders known
//! ([`Held`]) or whole ([`Whole`]).

mod coarse_grid;
mod halving;
mod nested_models;
mod search;

pub use halving::{distinct, finalists, in_reach, same_optimum, same_place};
pub use nested_models::{held, lower_order, simpler, unlike, whole, Held, LowerOrder, Simpler, Whole};
pub use search::{on_coarse_grids, race, Course, Starts};

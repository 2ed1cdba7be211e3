//! Multistart with successive halving: short fits on subsampled records, of which the best continue.
//!
//! Candidates are optimized with growing budgets, from a prescreening to the few survivors that continue on all
//! samples. Submodels supply further candidates, because the full problem reaches their optima, too: problems with one
//! term less ([`ReducedProblem`]), a lower order ([`LowerOrderProblem`]), one fixed order ([`FixedOrderProblem`]) or
//! integer orders ([`IntegerOrderProblem`]).

mod coarse_grid;
mod halving;
mod nested_models;
mod search;

pub use halving::{distinct, finalists, in_reach, same_optimum, same_place};
pub use nested_models::{held, lower_order, simpler, unlike, whole, Held, LowerOrder, Simpler, Whole};
pub use search::{on_coarse_grids, race, Course, Starts};

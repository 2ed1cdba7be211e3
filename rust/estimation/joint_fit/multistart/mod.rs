//! Multistart with successive halving: short fits on subsampled records, after which the best candidates continue.
//!
//! Candidates are optimized with growing budgets, from a prescreening to the few survivors that continue on all
//! samples. Some candidates start from optima of integer orders, with the orders freed ([`IntegerOrderProblem`]),
//! others from order grids. Optima of submodels are further candidates of the full problem. A submodel lacks one term
//! ([`ReducedProblem`]) or has one fixed order ([`FixedOrderProblem`]). Equations with friction start from linear fits
//! ([`run_friction_multistart`]). Equations with nonlinear terms start from fits with the measured values of their
//! expressions ([`run_nonlinear_multistart`]).

mod coarse_grid;
mod friction;
mod halving;
mod nested_models;
mod nonlinear;
mod search;
mod sliding_body;

pub use coarse_grid::{coarse_sampling, leading_part, MAX_COARSE_SAMPLES};
pub use friction::run_friction_multistart;
pub use halving::{competitive_candidates, is_same_iterate, is_same_optimum, merge_duplicates, select_survivors};
pub(super) use halving::{sort_by_cost, split_unfinished, FIRST_BUDGET_EVALUATIONS};
pub use nested_models::{
    fixed_order_problems, integer_order_problems, reduced_problems, FixedOrderProblem, IntegerOrderProblem,
    ReducedProblem,
};
pub use nonlinear::run_nonlinear_multistart;
pub use search::{run_multistart, InitialGuessSource, MultistartContext, SELECTION_INTERVALS};

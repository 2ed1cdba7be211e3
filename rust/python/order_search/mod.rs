//! Bindings of the order search: order grid, coupled search, given points. Ctrl-C interrupts a search.

mod arguments;
mod grid_search;
mod stage;
pub(crate) mod watch;

pub use grid_search::{
    certify, force_portable, order_grid_size, panic_on_purpose, search, search_join, search_plan, OrderSearch, Points,
};
pub use stage::{search_stage, StageSearch};

//! Order searches for Python: over a lattice, over a stage, at points; watched for Ctrl-C while they run.

mod arguments;
mod grid_search;
mod stage;
pub(crate) mod watch;

pub use grid_search::{
    certify, lattice_size, panic_on_purpose, portable, search, search_join, search_plan, OrderSearch, Points,
};
pub use stage::{search_stage, StageSearch};

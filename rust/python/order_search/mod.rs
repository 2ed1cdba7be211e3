//! Order searches for Python: over a lattice, over a stage, at points; watched for Ctrl-C while they run.

mod arguments;
mod certificate;
mod grid_search;
mod hooks;
mod points;
mod stage;
pub(crate) mod watch;

pub use certificate::certify;
pub use grid_search::{lattice_size, search, search_join, search_plan, OrderSearch};
pub use hooks::{panic_on_purpose, portable};
pub use points::Points;
pub use stage::{search_stage, StageSearch};

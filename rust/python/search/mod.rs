//! Order searches for Python: over a lattice, over a stage, at points; watched for Ctrl-C while they run.

mod arguments;
mod certificate;
mod hooks;
mod orders;
mod points;
mod stage;
pub(super) mod watch;

pub use certificate::certify;
pub use hooks::{panic_on_purpose, portable};
pub use orders::{lattice_size, search, search_join, search_plan, OrderSearch};
pub use points::Points;
pub use stage::{search_stage, StageSearch};

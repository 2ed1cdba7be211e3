//! Order search over coupled equations. The score tables of the equations are joined: orders are combined if they are
//! compatible under the order law.

mod best_first;
mod join;
mod tuples;

pub use best_first::{search, CoupledSearch, SearchState, StageOutcome, StageRow};
pub use join::Span;

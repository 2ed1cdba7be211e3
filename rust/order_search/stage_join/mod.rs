//! Order search over coupled equations, by joining the score tables of the equations on their order law.

mod best_first;
mod join;
mod tuples;

pub use best_first::{search, SearchState, Stage, StageOutcome, StageRow};
pub use join::Span;

//! Order search over all equations of a stage under its order law, by joining the equations' score tables on the law.

mod best_first;
mod join;
mod tuples;

pub use best_first::{search, Course, Stage, StageOutcome, StageRow};
pub use join::Span;

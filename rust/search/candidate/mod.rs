//! One candidate of a search: its coefficients, then its error.

pub(crate) mod columns;
mod instruments;
pub(crate) mod march;
pub(crate) mod needed;
pub(crate) mod normal;
pub(crate) mod problem;
pub(crate) mod squares;
pub(crate) mod stretch;

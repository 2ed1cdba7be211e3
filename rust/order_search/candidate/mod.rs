//! Computation of coefficients and error of one candidate.

pub(crate) mod columns;
mod instrumental_variables;
pub(crate) mod normal_equations;
pub(crate) mod problem;
pub(crate) mod row_bound;
pub(crate) mod simulation;

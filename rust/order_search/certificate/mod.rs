//! Certificates over all real orders: a lower bound of the squared equation error within given intervals of orders.
//!
//! The regressor of a term is a smooth function of its order (`regressor_expansion`). A cell is a box of orders. By
//! expansion about its midpoint, the squared equation error with optimal coefficients is bounded from below over a
//! whole cell (`cell_bound`, `subspace_bound`). The inner products are computed once for the midpoints of cells of all
//! sizes (`gram_tables`). Cells whose bound is too small are bisected (`bisection`).

mod bisection;
mod cell_bound;
mod gram_tables;
mod regressor_expansion;
mod subspace_bound;

pub use bisection::{certify, Certificate, CertificateOptions};
pub use cell_bound::cell_bounds;
pub use gram_tables::{Range, Region};

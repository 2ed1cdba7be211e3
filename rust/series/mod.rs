//! Power series in the one-step delay, truncated: products, quotients, linear systems, and reference algorithms for
//! tests.
//!
//! A causal operator on pulse means (means over sampling intervals) is a polynomial in the one-step delay z, truncated
//! at z^m. The fractional integral F^η is one of them. All such operators commute. Products ([`product`]) are
//! convolutions by FFT. Quotients ([`division`]) use forward substitution in blocks that are joined by FFT products.
//! [`solve`] solves for several unknown series. If all orders are integers, [`mod@running_sums`] solves the same
//! systems by running sums.
//!
//! ```
//! # fn main() -> ftlm::error::Result<()> {
//! use ftlm::series;
//! // (1 + z)(1 − z) = 1 − z², and back.
//! let product = series::multiply(&[1.0, 1.0, 0.0], &[1.0, -1.0, 0.0], 3);
//! assert_eq!(product, [1.0, 0.0, -1.0]);
//! assert_eq!(series::divide(&product, &[1.0, -1.0, 0.0])?, [1.0, 1.0, 0.0]);
//! # Ok(())
//! # }
//! ```

mod block_transform;
pub mod division;
#[cfg(feature = "oracles")]
pub mod naive;
pub mod product;
pub mod running_sums;

pub use division::{divide, reciprocal, solve, Division, Solver, BLOCK_TERMS};
#[cfg(feature = "oracles")]
pub use naive::{divide_naive, multiply_naive};
pub use product::{multiply, multiply_signals, Buffers, Kernel, SumOfProducts};
pub use running_sums::{running_sums, RunningSumSystem, Source, MAX_SUMS, RIGHT_SIDE_LANES};

//! Truncated power series in the one-step delay: multiply, divide, solve, and the naive oracles beside them.
//!
//! A causal operator on pulse means is a polynomial in the delay z cut off at z^m; the fractional integral F^η is one of
//! them. All such operators commute. Products ([`product`]) are convolutions by FFT, quotients ([`division`]) forward
//! substitution in blocks joined by FFT products; [`solve`] solves several unknown series at once. Where all orders are
//! whole, [`mod@running_sums`] does the same by running sums.
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

pub mod division;
#[cfg(feature = "oracles")]
pub mod naive;
pub mod product;
pub mod running_sums;

pub use division::{divide, reciprocal, solve, Division, Solver, BLOCK};
#[cfg(feature = "oracles")]
pub use naive::{divide_naive, multiply_naive};
pub use product::{multiply, Buffers, Kernel, SumOfProducts};
pub use running_sums::{running_sums, Recursion, Source, ABREAST, MAX_SUMS};

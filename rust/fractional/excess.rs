//! Terms of a higher order than their equation's own output: kernels below η = 0.
//!
//! D^α y = c D^ν s + … with ν > α is integrated by ν, its highest order: I^{ν−α} y = c s + …. All operators commute, so
//! that equation divided by the kernel of I^{ν−α} is y = c D^{ν−α} s + …, whose D^{ν−α} is the reciprocal of that kernel:
//! one form for every term, of second order in the step, and D^q I^q is the identity to rounding.

use crate::fractional::kernels::{block_pulse_kernel, kernel_with_derivative};
use crate::series::{multiply, reciprocal};

/// A term stays below its equation's α by more than minus this. The reciprocal kernel of D^1 is Tustin's rule, which
/// rings from pulse to pulse for ever.
pub const MAX_EXCESS: f64 = 1.0;

/// Kernel of I^η in pulse means for η > −[`MAX_EXCESS`]: as [`block_pulse_kernel`], below 0 its reciprocal at −η.
///
/// ```
/// use ftlm::fractional::excess::kernel;
/// let both = ftlm::series::multiply(&kernel(-0.4, 64, 0.1), &kernel(0.4, 64, 0.1), 64);
/// assert!((both[0] - 1.0).abs() < 1e-12 && both[1..].iter().all(|v| v.abs() < 1e-12));
/// ```
#[must_use]
pub fn kernel(eta: f64, m: usize, step: f64) -> Vec<f64> {
    if eta >= 0.0 {
        block_pulse_kernel(eta, m, step)
    } else {
        reciprocal(&block_pulse_kernel(-eta, m, step))
    }
}

/// [`kernel`] and its derivative with respect to η.
#[must_use]
pub fn kernel_and_slope(eta: f64, m: usize, step: f64) -> (Vec<f64>, Vec<f64>) {
    if eta >= 0.0 {
        return kernel_with_derivative(eta, m, step);
    }
    let (integral, slope) = kernel_with_derivative(-eta, m, step);
    let made = reciprocal(&integral);
    // d/dη of 1/F(−η) is F′(−η)/F(−η)².
    let square = multiply(&made, &made, m);
    (made, multiply(&square, &slope, m))
}

/// The first number of [`kernel`]: what a pulse answers within itself.
#[must_use]
pub fn first(eta: f64, step: f64) -> f64 {
    let size = eta.abs();
    let value = libm::pow(step, size) / libm::tgamma(size + 2.0);
    if eta >= 0.0 {
        value
    } else {
        1.0 / value
    }
}

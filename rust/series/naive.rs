//! Products and quotients of series by definition, as references for tests of the fast algorithms.

use super::product::direct;
use crate::error::{Error, Result};

/// Return the first m terms of the product of two power series by definition, a reference for tests of
/// [`super::product::multiply`]. O(m²).
#[must_use]
pub fn multiply_naive(a: &[f64], b: &[f64], m: usize) -> Vec<f64> {
    direct(a, b, m)
}

/// Return the first m terms of the quotient of two power series by forward substitution, where m is the length of the
/// numerator. It is a reference for tests of [`super::division::divide`]. O(m²).
///
/// # Errors
/// [`Error::LeadingZero`] if the divisor starts with zero, [`Error::Length`] if it is shorter than the numerator.
pub fn divide_naive(numerator: &[f64], divisor: &[f64]) -> Result<Vec<f64>> {
    let leading = check_leading(divisor)?;
    if divisor.len() < numerator.len() {
        return Err(Error::Length { name: "divisor".into(), expected: numerator.len(), found: divisor.len() });
    }
    let mut quotient = numerator.to_vec();
    for k in 0..quotient.len() {
        quotient[k] /= leading;
        let value = quotient[k];
        for (rest, &d) in quotient[k + 1..].iter_mut().zip(&divisor[1..]) {
            *rest -= d * value;
        }
    }
    Ok(quotient)
}

/// Return the leading coefficient. [`Error::LeadingZero`] if it is zero, not finite or missing.
fn check_leading(divisor: &[f64]) -> Result<f64> {
    match divisor.first() {
        Some(&d) if d != 0.0 && d.is_finite() => Ok(d),
        first => Err(Error::LeadingZero { leading: first.copied().unwrap_or(0.0) }),
    }
}

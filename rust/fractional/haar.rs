//! The fast Haar transform and the dense Haar matrix: an orthogonal change of basis of pulse means.

use crate::error::{check_dense, Error, Result};

/// Refuses a length that is no power of two.
///
/// # Errors
/// [`Error::NotPowerOfTwo`] with the two nearest powers, [`Error::Length`] for m = 0.
pub fn check_power_of_two(m: usize) -> Result<()> {
    if m == 0 {
        return Err(Error::Length { name: "the signal".into(), expected: 1, found: 0 });
    }
    if m.is_power_of_two() {
        Ok(())
    } else {
        let above = m.next_power_of_two();
        Err(Error::NotPowerOfTwo { m, below: above / 2, above })
    }
}

/// Φ f in place: Haar coefficients, coarse to fine, of pulse means. O(m).
///
/// # Errors
/// [`Error::NotPowerOfTwo`].
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// let mut f = [1.0, 1.0, 1.0, 1.0];
/// ftlm::fractional::haar::transform(&mut f)?;
/// assert!((f[0] - 2.0).abs() < 1e-15 && f[1..] == [0.0; 3]);
/// # Ok(())
/// # }
/// ```
pub fn transform(f: &mut [f64]) -> Result<()> {
    check_power_of_two(f.len())?;
    let mut scratch = vec![0.0; f.len()];
    forward(f, &mut scratch);
    Ok(())
}

/// Φᵀ c in place: pulse means from Haar coefficients. O(m).
///
/// # Errors
/// [`Error::NotPowerOfTwo`].
pub fn inverse(c: &mut [f64]) -> Result<()> {
    check_power_of_two(c.len())?;
    let mut scratch = vec![0.0; c.len()];
    let mut len = 1;
    while len < c.len() {
        for i in 0..len {
            let (sum, rise) = (c[i], c[len + i]);
            scratch[2 * i] = (sum + rise) * std::f64::consts::FRAC_1_SQRT_2;
            scratch[2 * i + 1] = (sum - rise) * std::f64::consts::FRAC_1_SQRT_2;
        }
        len *= 2;
        c[..len].copy_from_slice(&scratch[..len]);
    }
    Ok(())
}

/// [`transform`] with the caller's scratch, for loops over rows; `f` has a power of two of elements.
pub(crate) fn forward(f: &mut [f64], scratch: &mut [f64]) {
    let mut len = f.len();
    while len > 1 {
        let half = len / 2;
        for i in 0..half {
            let (left, right) = (f[2 * i], f[2 * i + 1]);
            scratch[i] = (left + right) * std::f64::consts::FRAC_1_SQRT_2;
            scratch[half + i] = (left - right) * std::f64::consts::FRAC_1_SQRT_2;
        }
        f[..len].copy_from_slice(&scratch[..len]);
        len = half;
    }
}

/// The orthogonal Haar matrix Φ, row-major m × m (paper (27), (29)), written from the definition.
///
/// # Errors
/// [`Error::NotPowerOfTwo`].
#[allow(clippy::cast_precision_loss)]
pub fn matrix(m: usize) -> Result<Vec<f64>> {
    check_power_of_two(m)?;
    check_dense(m)?;
    let mut phi = vec![0.0; m * m];
    let unit = 1.0 / (m as f64).sqrt();
    phi[..m].fill(unit);
    for sigma in 1..m {
        let level = sigma.ilog2();
        let support = m >> level;
        let start = (sigma - (1 << level)) * support;
        let height = unit * libm::exp2(f64::from(level) / 2.0);
        let row = &mut phi[sigma * m + start..sigma * m + start + support];
        let (left, right) = row.split_at_mut(support / 2);
        left.fill(height);
        right.fill(-height);
    }
    Ok(phi)
}

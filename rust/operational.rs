//! Integration operational matrices: F^η of block pulses and P^η of Haar wavelets, dense, for study and as oracle.
//!
//! Identification and simulation never need them: they apply F^η as a series ([`crate::series`]).

use crate::dense;
use crate::error::{check_step, Result};
use crate::fractional::{block_pulse_kernel, check_order};
use crate::haar;

/// Upper-triangular Toeplitz F^η, row-major m × m (paper (32)); `step` = duration / m.
///
/// # Errors
/// An order outside [0, 3] or a step that is not positive.
pub fn block_pulse_matrix(eta: f64, m: usize, step: f64) -> Result<Vec<f64>> {
    check_order("order", eta)?;
    check_step(step)?;
    let kernel = block_pulse_kernel(eta, m, step);
    let mut f = vec![0.0; m * m];
    for (i, row) in f.chunks_exact_mut(m).enumerate() {
        row[i..].copy_from_slice(&kernel[..m - i]);
    }
    Ok(f)
}

/// P^η = Φ F^η Φᵀ (paper (37)) by the two-sided fast Haar transform, row-major m × m. O(m²).
///
/// # Errors
/// As [`block_pulse_matrix`], and m must be a power of two.
pub fn operational_matrix(eta: f64, m: usize, step: f64) -> Result<Vec<f64>> {
    haar::check_power_of_two(m)?;
    let mut f = block_pulse_matrix(eta, m, step)?;
    let mut scratch = vec![0.0; m];
    for _ in 0..2 {
        for row in f.chunks_exact_mut(m) {
            haar::forward(row, &mut scratch);
        }
        transpose(&mut f, m);
    }
    Ok(f)
}

/// P^η by two dense matrix products: the oracle of [`operational_matrix`]. O(m³).
///
/// # Errors
/// As [`operational_matrix`].
pub fn operational_matrix_dense(eta: f64, m: usize, step: f64) -> Result<Vec<f64>> {
    let phi = haar::matrix(m)?;
    let f = block_pulse_matrix(eta, m, step)?;
    let phi_f = dense::multiply(&phi, &f, m, m, m);
    let mut phi_transposed = phi;
    transpose(&mut phi_transposed, m);
    Ok(dense::multiply(&phi_f, &phi_transposed, m, m, m))
}

/// In-place transpose in tiles that fit the first-level cache.
fn transpose(a: &mut [f64], m: usize) {
    const TILE: usize = 32;
    for i0 in (0..m).step_by(TILE) {
        for j0 in (i0..m).step_by(TILE) {
            for i in i0..(i0 + TILE).min(m) {
                for j in j0.max(i + 1)..(j0 + TILE).min(m) {
                    a.swap(i * m + j, j * m + i);
                }
            }
        }
    }
}

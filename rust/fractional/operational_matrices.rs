//! Operational matrices of fractional integration for block pulses and Haar wavelets, and the fast Haar transform.
//!
//! Identification and simulation apply the block-pulse matrix F^η as a power series instead ([`crate::series`]).

use crate::error::{check_dense, check_step, Error, Result};
use crate::fractional::kernels::{block_pulse_kernel, check_order};
#[cfg(feature = "oracles")]
use crate::linalg::dense;

/// Return the block-pulse operational matrix F^η, eq. (32) of the paper: upper-triangular Toeplitz, row-major m × m.
/// `step` is the pulse length \[s\], the duration divided by m.
///
/// # Errors
/// [`Error::OutOfRange`] for an order outside [0, 10] or a step that is not positive. Also an error for m = 0, or an m
/// that needs too much memory.
pub fn block_pulse_matrix(eta: f64, m: usize, step: f64) -> Result<Vec<f64>> {
    check_order("order", eta)?;
    check_step(step)?;
    check_dense(m)?;
    let kernel = block_pulse_kernel(eta, m, step);
    let mut f = vec![0.0; m * m];
    for (i, row) in f.chunks_exact_mut(m).enumerate() {
        row[i..].copy_from_slice(&kernel[..m - i]);
    }
    Ok(f)
}

/// Return the Haar operational matrix P^η = Φ F^η Φᵀ, eq. (37) of the paper, row-major m × m. Φ is the Haar matrix and
/// F^η the block-pulse matrix. `step` is the pulse length \[s\]. O(m²).
///
/// F^η is Toeplitz, so an element depends only on the widths of two wavelets and their distance. Each row is composed
/// of contiguous ranges of tables, one for each pair of levels (widths). All tables together have O(m log m) values.
///
/// # Errors
/// The errors of [`block_pulse_matrix`], and [`Error::NotPowerOfTwo`] for an m that is not a power of two.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// // The mean of I^1 of one on [0, 2] is 1.
/// let p = ftlm::fractional::operational_matrices::operational_matrix(1.0, 2, 1.0)?;
/// assert!((p[0] - 1.0).abs() < 1e-12);
/// # Ok(())
/// # }
/// ```
pub fn operational_matrix(eta: f64, m: usize, step: f64) -> Result<Vec<f64>> {
    check_power_of_two(m)?;
    check_order("order", eta)?;
    check_step(step)?;
    check_dense(m)?;
    // sums[k] are the sums of 2^k successive kernel values, the last of which is at n.
    let mut sums = vec![block_pulse_kernel(eta, m, step)];
    let mut width = 1;
    while width < m {
        let last = &sums[sums.len() - 1];
        let wider = (0..m).map(|n| last[n] + if n < width { 0.0 } else { last[n - width] }).collect();
        sums.push(wider);
        width *= 2;
    }
    let mut out = Vec::with_capacity(m * m);
    let mut response = vec![0.0; m];
    // The constant comes first, then the wavelets from the widest to the narrowest.
    for level in 0..sums.len() {
        let rows = Wavelet::of(level, m);
        rows.respond(&sums, &mut response);
        let tables = tables(&rows, &response, m);
        for i in 0..m / rows.width {
            for table in &tables {
                out.extend_from_slice(table.window(i));
            }
        }
    }
    Ok(out)
}

/// One level of the Haar basis: the constant, or all wavelets of one width.
struct Wavelet {
    /// Width of a wavelet in pulses.
    width: usize,
    /// True for the constant basis function, false for a level of wavelets.
    constant: bool,
    /// Absolute value of a basis function of this level where it is not 0.
    scale: f64,
}

impl Wavelet {
    /// Return a level of the Haar basis for m pulses. Level 0 is the constant, level 1 the widest wavelet, and every
    /// further level halves the width.
    #[allow(clippy::cast_precision_loss)]
    fn of(level: usize, m: usize) -> Self {
        let width = m >> level.saturating_sub(1);
        Self { width, constant: level == 0, scale: 1.0 / (width as f64).sqrt() }
    }

    /// Write the convolution Σ_s φ(s) f(n − s) of a kernel f with a wavelet φ of this level to `out`. `sums[k]`
    /// contains the sums of 2^k successive values of f.
    fn respond(&self, sums: &[Vec<f64>], out: &mut [f64]) {
        let half = self.width / 2;
        if self.constant {
            let total_sums = &sums[sums.len() - 1];
            out.iter_mut().zip(total_sums).for_each(|(o, v)| *o = v * self.scale);
            return;
        }
        let half_sums = &sums[half.trailing_zeros() as usize];
        for (n, o) in out.iter_mut().enumerate() {
            *o = (half_sums[n] - if n < half { 0.0 } else { half_sums[n - half] }) * self.scale;
        }
    }
}

/// Table of the matrix elements whose row belongs to one wavelet level and whose column belongs to another. An element
/// depends only on the time distance of the two wavelets. Each row is a contiguous range of `values`.
struct Table {
    values: Vec<f64>,
    /// Number of columns, which all belong to one wavelet level.
    count: usize,
    /// Number of rows within the width of one column, 1 if columns are not wider than rows. Each of these rows has a
    /// separate range of `values`.
    phases: usize,
    /// Number of columns within the width of one row, 1 if rows are not wider than columns.
    stride: usize,
    /// Number of rows, which all belong to one wavelet level.
    rows: usize,
}

impl Table {
    /// Return the elements of this table in row `i`, counted from the first row of the wavelet level.
    fn window(&self, i: usize) -> &[f64] {
        let start = if self.phases > 1 {
            (i % self.phases) * (2 * self.count - 1) + self.count - 1 - i / self.phases
        } else {
            (self.rows - 1 - i) * self.stride
        };
        &self.values[start..start + self.count]
    }
}

/// Return one table for each level of the columns, from the constant to the narrowest wavelets. The rows belong to one
/// wavelet level. `response` is the convolution of the kernel with a wavelet of the rows.
fn tables(rows: &Wavelet, response: &[f64], m: usize) -> Vec<Table> {
    // padded[m + d] is the sum of the responses from d on, over half the width of a column.
    let mut padded = vec![0.0; 2 * m];
    padded[m..].copy_from_slice(response);
    let levels = m.trailing_zeros() as usize;
    let mut tables = Vec::with_capacity(levels + 1);
    for level in (1..=levels).rev() {
        let columns = Wavelet::of(level, m);
        let half = columns.width / 2;
        tables.push(table(rows, &columns, m, |e| (padded[e] - padded[e + half]) * columns.scale));
        for e in 0..2 * m - half {
            padded[e] += padded[e + half];
        }
    }
    let constant = Wavelet::of(0, m);
    tables.push(table(rows, &constant, m, |e| padded[e] * constant.scale));
    tables.reverse();
    tables
}

/// Build a table. `entry(m + d)` is the element for a column that starts d pulses after its row.
fn table(rows: &Wavelet, columns: &Wavelet, m: usize, entry: impl Fn(usize) -> f64) -> Table {
    let count = m / columns.width;
    let (phases, stride) = ((columns.width / rows.width).max(1), (rows.width / columns.width).max(1));
    let values = if phases > 1 {
        let starts = |phase: usize| (0..2 * count - 1).map(move |k| (k + 1) * columns.width - phase * rows.width);
        (0..phases).flat_map(starts).map(&entry).collect()
    } else {
        (rows.width..=2 * m - columns.width).step_by(columns.width).map(&entry).collect()
    };
    Table { values, count, phases, stride, rows: m / rows.width }
}

/// Return the Haar operational matrix P^η by two dense matrix products, a reference for tests of
/// [`operational_matrix`]. O(m³).
///
/// # Errors
/// An order out of range, or a size that is too large or not a power of two ([`operational_matrix`]).
#[cfg(feature = "oracles")]
pub fn operational_matrix_dense(eta: f64, m: usize, step: f64) -> Result<Vec<f64>> {
    let phi = haar_matrix(m)?;
    let f = block_pulse_matrix(eta, m, step)?;
    let phi_f = dense::multiply(&phi, &f, m, m, m);
    let mut phi_transposed = phi;
    transpose(&mut phi_transposed, m);
    Ok(dense::multiply(&phi_f, &phi_transposed, m, m, m))
}

/// Transpose a row-major m × m matrix in place, in tiles that fit the first-level cache.
#[cfg(feature = "oracles")]
fn transpose(a: &mut [f64], m: usize) {
    const TILE_SIZE: usize = 32;
    for i0 in (0..m).step_by(TILE_SIZE) {
        for j0 in (i0..m).step_by(TILE_SIZE) {
            for i in i0..(i0 + TILE_SIZE).min(m) {
                for j in j0.max(i + 1)..(j0 + TILE_SIZE).min(m) {
                    a.swap(i * m + j, j * m + i);
                }
            }
        }
    }
}

/// Return an error for a length that is not a power of two.
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

/// Replace the pulse means f by their Haar coefficients Φ f, in the sequence from coarse to fine. O(m) for m pulses.
///
/// # Errors
/// [`Error::NotPowerOfTwo`] if the number of pulses is not a power of two.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// let mut f = [1.0, 1.0, 1.0, 1.0];
/// ftlm::fractional::operational_matrices::haar_transform(&mut f)?;
/// assert!((f[0] - 2.0).abs() < 1e-15 && f[1..] == [0.0; 3]);
/// # Ok(())
/// # }
/// ```
pub fn haar_transform(f: &mut [f64]) -> Result<()> {
    check_power_of_two(f.len())?;
    let mut scratch = vec![0.0; f.len()];
    haar_transform_with_scratch(f, &mut scratch);
    Ok(())
}

/// Replace Haar coefficients c by the pulse means Φᵀ c. O(m) for m pulses.
///
/// # Errors
/// [`Error::NotPowerOfTwo`] if the number of pulses is not a power of two.
pub fn haar_inverse(c: &mut [f64]) -> Result<()> {
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

/// Transform as [`haar_transform`] does, with scratch memory from the caller. `scratch` must be at least as long as
/// `f`, and the length of `f` must be a power of two.
pub(crate) fn haar_transform_with_scratch(f: &mut [f64], scratch: &mut [f64]) {
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

/// Return the orthogonal Haar matrix Φ by definition, eqs. (27) and (29) of the paper, row-major m × m.
///
/// # Errors
/// [`Error::NotPowerOfTwo`] if the number of pulses is not a power of two.
#[allow(clippy::cast_precision_loss)]
pub fn haar_matrix(m: usize) -> Result<Vec<f64>> {
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

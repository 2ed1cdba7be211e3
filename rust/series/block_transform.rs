//! Complex transforms of blocks of 64 real terms, for products of series block by block.
//!
//! Terms 64 to 127 of the product of a block of 64 terms and a segment of 128 terms are the middle product. It is the
//! contribution of a block of a quotient to a later block. Modulo z⁶⁴ − i, a real series a + z⁶⁴ b is the complex
//! series a + i b. The imaginary part of the product of the block and the segment is therefore the middle product. The
//! 64 values of a series at the roots of z⁶⁴ = i are a discrete Fourier transform. It is computed in two passes of 8,
//! each with [`LANE_COUNT`] columns in parallel.

use std::array::from_fn;
use std::f64::consts::{FRAC_1_SQRT_2, PI};

use crate::simd::{self, LANE_COUNT};

/// Number of terms in a block. Its transform has the same number of values.
pub const BLOCK_TERMS: usize = LANE_COUNT * LANE_COUNT;

/// Real parts, then imaginary parts, of [`LANE_COUNT`] complex values.
pub(super) type Tile = [[f64; LANE_COUNT]; 2];

/// Values of a series at the roots of z⁶⁴ = i, or its terms modulo z⁶⁴ − i, row-major 8 × 8.
type Square = [Tile; LANE_COUNT];

/// Constant factors of the transform.
struct Factors {
    /// Factor e^{iπ j/128} of term j. It maps the roots of z⁶⁴ = i to the roots of z⁶⁴ = 1.
    shift: Square,
    /// Conjugates of `shift` divided by 64.
    inverse_shift: Square,
    /// Twiddle factors e^{2πi jk/64} between the two passes.
    twiddles: Square,
}

impl Factors {
    #[allow(clippy::cast_precision_loss)]
    fn new() -> Self {
        let square = |scale: f64, angle: &dyn Fn(usize, usize) -> f64| -> Square {
            from_fn(|row| {
                let tile = |f: fn(f64) -> f64| from_fn(|lane| scale * f(2.0 * PI * angle(row, lane)));
                [tile(f64::cos), tile(f64::sin)]
            })
        };
        let terms = BLOCK_TERMS as f64;
        let shift = |row: usize, lane: usize| (row * LANE_COUNT + lane) as f64 / (4.0 * terms);
        Self {
            shift: square(1.0, &shift),
            inverse_shift: square(1.0 / terms, &|row, lane| -shift(row, lane)),
            twiddles: square(1.0, &|row, lane| (row * lane) as f64 / terms),
        }
    }
}

// Each thread has its own factors. If a process forks while another thread has locked shared ones, the lock would never
// be released.
thread_local!(static FACTORS: Factors = Factors::new());

/// Replace the rows x_j in each lane by the sums Σ_j x_j e^{2πi jk/8}, k = 0 … 7. With real and imaginary parts
/// exchanged (`RE` = 1, `IM` = 0), the factor is e^{−2πi jk/8}.
#[allow(clippy::needless_range_loop)]
#[inline(always)]
fn sum_rows<const RE: usize, const IM: usize>(x: &mut Square) {
    for l in 0..LANE_COUNT {
        let re = |j: usize| x[j][RE][l];
        let im = |j: usize| x[j][IM][l];
        let (a, b) = ((re(0) + re(4), im(0) + im(4)), (re(0) - re(4), im(0) - im(4)));
        let (c, d) = ((re(2) + re(6), im(2) + im(6)), (re(2) - re(6), im(2) - im(6)));
        let (e, f) = ((re(1) + re(5), im(1) + im(5)), (re(1) - re(5), im(1) - im(5)));
        let (g, h) = ((re(3) + re(7), im(3) + im(7)), (re(3) - re(7), im(3) - im(7)));
        let even = [(a.0 + c.0, a.1 + c.1), (b.0 - d.1, b.1 + d.0), (a.0 - c.0, a.1 - c.1), (b.0 + d.1, b.1 - d.0)];
        let (o1, o3) = ((f.0 - h.1, f.1 + h.0), (f.0 + h.1, f.1 - h.0));
        let o2 = (e.0 - g.0, e.1 - g.1);
        let odd = [
            (e.0 + g.0, e.1 + g.1),
            (FRAC_1_SQRT_2 * (o1.0 - o1.1), FRAC_1_SQRT_2 * (o1.0 + o1.1)),
            (-o2.1, o2.0),
            (-FRAC_1_SQRT_2 * (o3.0 + o3.1), FRAC_1_SQRT_2 * (o3.0 - o3.1)),
        ];
        for k in 0..4 {
            (x[k][RE][l], x[k][IM][l]) = (even[k].0 + odd[k].0, even[k].1 + odd[k].1);
            (x[k + 4][RE][l], x[k + 4][IM][l]) = (even[k].0 - odd[k].0, even[k].1 - odd[k].1);
        }
    }
}

/// Multiply the elements by factors, or by their conjugates if `sign` is −1. Return the result with rows and lanes
/// transposed.
#[inline(always)]
fn multiply_and_transpose(x: &mut Square, factors: &Square, sign: f64) -> Square {
    for row in 0..LANE_COUNT {
        for l in 0..LANE_COUNT {
            let (re, im) = (factors[row][0][l], sign * factors[row][1][l]);
            let (a, b) = (x[row][0][l], x[row][1][l]);
            (x[row][0][l], x[row][1][l]) = (a * re - b * im, a * im + b * re);
        }
    }
    from_fn(|l| [from_fn(|row| x[row][0][l]), from_fn(|row| x[row][1][l])])
}

/// Transform of a block, or of a block and the next one. This task is compiled for the widest vector instructions
/// available.
struct ForwardTransform<'a> {
    factors: &'a Factors,
    low: &'a [f64; BLOCK_TERMS],
    high: Option<&'a [f64; BLOCK_TERMS]>,
}

impl simd::SimdKernel for ForwardTransform<'_> {
    type Output = Square;

    #[inline(always)]
    fn run(self) -> Square {
        let Self { factors, low, high } = self;
        let shift = &factors.shift;
        let mut x: Square = from_fn(|row| {
            let [re, im] = &shift[row];
            [from_fn(|l| low[row * LANE_COUNT + l] * re[l]), from_fn(|l| low[row * LANE_COUNT + l] * im[l])]
        });
        if let Some(high) = high {
            for row in 0..LANE_COUNT {
                for l in 0..LANE_COUNT {
                    let (b, [re, im]) = (high[row * LANE_COUNT + l], &shift[row]);
                    x[row][0][l] -= b * im[l];
                    x[row][1][l] += b * re[l];
                }
            }
        }
        sum_rows::<0, 1>(&mut x);
        let mut y = multiply_and_transpose(&mut x, &factors.twiddles, 1.0);
        sum_rows::<0, 1>(&mut y);
        y
    }
}

/// Write the transform of up to 128 terms to every `stride`-th tile. A tile is a group of frequencies.
pub(super) fn transform(terms: &[f64], tiles: &mut [Tile], stride: usize) {
    let (blocks, rest) = terms.as_chunks();
    let mut padded = [0.0; BLOCK_TERMS];
    padded[..rest.len()].copy_from_slice(rest);
    let mut blocks = blocks.iter().chain((!rest.is_empty()).then_some(&padded));
    let (low, high) = (blocks.next().unwrap_or(&[0.0; BLOCK_TERMS]), blocks.next());
    let square = FACTORS.with(|factors| simd::dispatch_simd(ForwardTransform { factors, low, high }));
    for (row, tile) in square.iter().enumerate() {
        tiles[row * stride] = *tile;
    }
}

/// Inverse transform that gives the middle product (terms 64 to 127) of a block of 64 terms and a segment of 128 terms.
/// This task is compiled for the widest vector instructions available.
struct InverseTransform<'a> {
    factors: &'a Factors,
    tiles: &'a [Tile],
}

impl simd::SimdKernel for InverseTransform<'_> {
    type Output = [f64; BLOCK_TERMS];

    #[inline(always)]
    fn run(self) -> [f64; BLOCK_TERMS] {
        let Self { factors, tiles } = self;
        let mut x: Square = from_fn(|row| tiles[row]);
        sum_rows::<1, 0>(&mut x);
        let mut y = multiply_and_transpose(&mut x, &factors.twiddles, -1.0);
        sum_rows::<1, 0>(&mut y);
        let shift = &factors.inverse_shift;
        from_fn(|j| {
            let (row, l) = (j / LANE_COUNT, j % LANE_COUNT);
            y[row][0][l] * shift[row][1][l] + y[row][1][l] * shift[row][0][l]
        })
    }
}

/// Return the middle product of a block and a segment: terms 64 to 127 of their product. `tiles` is the product of
/// their transforms.
pub(super) fn middle_product(tiles: &[Tile]) -> [f64; BLOCK_TERMS] {
    FACTORS.with(|factors| simd::dispatch_simd(InverseTransform { factors, tiles }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transform_products_match_middle_products() {
        let term = |k: usize| f64::from(u32::try_from(k * k % 17).unwrap_or(0)) - 8.0;
        for length in [1, BLOCK_TERMS - 1, BLOCK_TERMS, BLOCK_TERMS + 1, 2 * BLOCK_TERMS - 1, 2 * BLOCK_TERMS] {
            let block: Vec<f64> = (0..BLOCK_TERMS).map(term).collect();
            let piece: Vec<f64> = (3..3 + length).map(term).collect();
            let spectra = [&block, &piece].map(|terms| {
                let mut tiles = [[[0.0; LANE_COUNT]; 2]; LANE_COUNT];
                transform(terms, &mut tiles, 1);
                tiles
            });
            let product: Square = from_fn(|row| {
                let [[a, b], [c, d]] = [spectra[0][row], spectra[1][row]];
                [from_fn(|l| a[l] * c[l] - b[l] * d[l]), from_fn(|l| a[l] * d[l] + b[l] * c[l])]
            });
            for (k, found) in middle_product(&product).iter().enumerate() {
                let at = BLOCK_TERMS + k;
                let terms = (0..=at).filter(|&j| j < block.len() && at - j < length);
                let expected: f64 = terms.map(|j| block[j] * piece[at - j]).sum();
                assert!((found - expected).abs() < 1e-10, "term {at} of {length}: {found}, {expected}");
            }
        }
    }
}

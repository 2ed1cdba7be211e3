//! Test vectors, and what integrals of the output make of them.
//!
//! They are complex exponentials under windows that end gently: there F_iᵀt is nearly a multiple of t.

use rayon::prelude::*;

use crate::lanes::WIDTH;
use crate::regressors::Bank;
use crate::search::options::Norm;
use crate::series::{Buffers, Kernel, SumOfProducts};

/// One value for each of [`WIDTH`] test vectors.
pub(super) type Wide = [f64; WIDTH];

/// Lowest frequency of a test vector, in cycles a record.
const LOWEST: f64 = 0.3;

/// Spectra of test vectors held at a time, in bytes.
const SPECTRA: usize = 64 << 20;

/// How a test vector fades; it must not stop dead, which its integrals would all feel.
#[derive(Debug, Clone, Copy)]
enum Window {
    /// One up to this share of the record, then half a cosine down to zero.
    Taper(f64),
    /// Down to e to the minus this.
    Decay(f64),
}

impl Window {
    fn at(self, x: f64) -> f64 {
        match self {
            Self::Taper(flat) if x <= flat => 1.0,
            Self::Taper(flat) => 0.5 + 0.5 * libm::cos(std::f64::consts::PI * (x - flat) / (1.0 - flat)),
            Self::Decay(rate) => libm::exp(-rate * x),
        }
    }
}

/// Windows and how many frequencies each gets; measured on Plant A's lattice at three levels of noise, where the late
/// taper removes most and the decays see the candidates whose error is early.
const WINDOWS: [(Window, usize); 3] = [(Window::Taper(0.5), 24), (Window::Taper(0.0), 12), (Window::Decay(5.0), 12)];

/// Number of test vectors to choose from.
pub(super) const POOL: usize = 48;

/// The first `count` test vectors, real and imaginary parts; every window's frequencies span the whole range.
#[allow(clippy::cast_precision_loss)]
pub(super) fn vectors(count: usize, m: usize) -> Vec<[Vec<f64>; 2]> {
    let highest = (m as f64 / 32.0).max(4.0);
    // Where fewer are asked for, every window gives its share.
    let all: Vec<(Window, f64)> = WINDOWS
        .iter()
        .flat_map(|&(window, full)| {
            let n = (full * count).div_ceil(POOL);
            (0..n).map(move |i| {
                let share = if n > 1 { i as f64 / (n - 1) as f64 } else { 0.5 };
                (window, LOWEST * libm::pow(highest / LOWEST, share))
            })
        })
        .take(count)
        .collect();
    all.par_iter()
        .map(|&(window, cycles)| {
            (0..m)
                .map(|k| {
                    let x = (k as f64 + 0.5) / m as f64;
                    let (sin, cos) = libm::sincos(-std::f64::consts::TAU * cycles * x);
                    let size = window.at(x);
                    (size * cos, size * sin)
                })
                .unzip()
        })
        .map(|(re, im)| [re, im])
        .collect()
}

/// g·‖t‖ and ‖Fᵀt − g t‖ of every own column and test vector, columns first.
pub(super) fn effects(
    bank: &Bank,
    own: &[usize],
    vectors: &[[Vec<f64>; 2]],
    sizes: &[f64],
    norm: Norm,
    unit: f64,
) -> Vec<[Wide; 3]> {
    let m = vectors.first().map_or(0, |v| v[0].len());
    let groups = vectors.len() / WIDTH;
    let mut out = vec![[[0.0; WIDTH]; 3]; own.len() * groups];
    // Fᵀt is F applied to t read backwards, read backwards.
    let backwards = |x: &[f64]| -> Vec<f64> { x.iter().rev().copied().collect() };
    let batch = (SPECTRA / (64 * m.max(1))).clamp(1, vectors.len().max(1));
    for start in (0..vectors.len()).step_by(batch) {
        let end = (start + batch).min(vectors.len());
        let spectra: Vec<[Kernel; 2]> = vectors[start..end]
            .par_iter()
            .map(|[a, b]| [Kernel::new(&backwards(a)), Kernel::new(&backwards(b))])
            .collect();
        let found: Vec<Vec<[f64; 3]>> = own
            .par_iter()
            .map(|&p| {
                let kernel = Kernel::new(bank.kernel(p));
                let length: f64 = bank.kernel(p).iter().map(|v| v.abs()).sum();
                let mut product = SumOfProducts::new(m);
                let mut buffers = Buffers::default();
                let (mut re, mut im) = (vec![0.0; m], vec![0.0; m]);
                (start..end)
                    .map(|j| {
                        for (part, out) in spectra[j - start].iter().zip([&mut re, &mut im]) {
                            product.add(1.0, &kernel, part);
                            product.take(out, &mut buffers);
                        }
                        effect(&vectors[j], sizes[j], &re, &im, norm, unit * length)
                    })
                    .collect()
            })
            .collect();
        for (row, values) in found.iter().enumerate() {
            for (value, j) in values.iter().zip(start..) {
                for (half, v) in value.iter().enumerate() {
                    out[row * groups + j / WIDTH][half][j % WIDTH] = *v;
                }
            }
        }
    }
    out
}

/// g·‖t‖ and ‖u − g t‖ for u given backwards; g is the projection of u on t, best for the norm of squares.
#[allow(clippy::cast_precision_loss)]
fn effect([a, b]: &[Vec<f64>; 2], size: f64, re: &[f64], im: &[f64], norm: Norm, rounding: f64) -> [f64; 3] {
    let rows = || a.iter().zip(b).zip(re.iter().zip(im).rev());
    let (mut x, mut y, mut squares) = (0.0, 0.0, 0.0);
    for ((a, b), (u, v)) in rows() {
        // conj(t)·u
        x += a * u + b * v;
        y += a * v - b * u;
        squares += a * a + b * b;
    }
    let (g, h) = (x / squares, y / squares);
    let rests = rows().map(|((a, b), (u, v))| {
        let (p, q) = (u - (g * a - h * b), v - (g * b + h * a));
        p * p + q * q
    });
    let (rest, count) = match norm {
        Norm::L1 => (rests.fold(0.0, f64::max).sqrt(), 1.0),
        Norm::L2 => (rests.sum::<f64>().sqrt(), (a.len() as f64).sqrt()),
    };
    [g * size, h * size, rest + rounding * count + 16.0 * f64::EPSILON * (g.abs() + h.abs()) * size]
}

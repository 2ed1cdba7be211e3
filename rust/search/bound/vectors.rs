//! Test vectors, and what integrals of the output make of them.
//!
//! They are complex exponentials under windows that end gently: there F_iᵀt is nearly a multiple of t.

use std::ops::Range;

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

/// A window and how often the vector turns in a record.
type Shape = (Window, f64);

/// The first `count` test vectors; every window's frequencies span the whole range.
#[allow(clippy::cast_precision_loss)]
fn shapes(count: usize, m: usize) -> Vec<Shape> {
    let highest = (m as f64 / 32.0).max(4.0);
    // Where fewer are asked for, every window gives its share.
    WINDOWS
        .iter()
        .flat_map(|&(window, full)| {
            let n = (full * count).div_ceil(POOL);
            (0..n).map(move |i| {
                let share = if n > 1 { i as f64 / (n - 1) as f64 } else { 0.5 };
                (window, LOWEST * libm::pow(highest / LOWEST, share))
            })
        })
        .take(count)
        .collect()
}

/// Real and imaginary parts of each.
#[allow(clippy::cast_precision_loss)]
fn drawn(shapes: &[Shape], m: usize) -> Vec<[Vec<f64>; 2]> {
    shapes
        .par_iter()
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

/// The first `count` test vectors, real and imaginary parts.
pub(super) fn vectors(count: usize, m: usize) -> Vec<[Vec<f64>; 2]> {
    drawn(&shapes(count, m), m)
}

/// What a thread needs to hold test vectors against a column.
struct Scratch {
    product: SumOfProducts,
    buffers: Buffers,
    parts: [Vec<f64>; 2],
}

/// Own columns by row, each with the test vectors of a batch that it is held against at a time: with all of them, but
/// where threads would wait for one another with one, which come last.
fn tasks(own: usize, batch: usize, threads: usize) -> Vec<(usize, Range<usize>)> {
    let whole = own - own % threads.max(1);
    let single = (whole..own).flat_map(|row| (0..batch).map(move |j| (row, j..j + 1)));
    (0..whole).map(|row| (row, 0..batch)).chain(single).collect()
}

/// g·‖t‖ and ‖Fᵀt − g t‖ of every own column and test vector, columns first.
pub(super) fn effects(
    bank: &Bank,
    own: &[usize],
    vectors: Vec<[Vec<f64>; 2]>,
    sizes: &[f64],
    norm: Norm,
    unit: f64,
) -> Vec<[Wide; 3]> {
    let (m, count) = (vectors.first().map_or(0, |v| v[0].len()), vectors.len());
    let groups = count / WIDTH;
    let mut out = vec![[[0.0; WIDTH]; 3]; own.len() * groups];
    // Fᵀt is F applied to t read backwards, read backwards.
    let backwards = |x: &[f64]| -> Vec<f64> { x.iter().rev().copied().collect() };
    // Two spectra of as many bins as there are samples.
    let batch = (SPECTRA / (32 * m.max(1))).clamp(1, count.max(1));
    // Of a long record the vectors take more than all else here: drawn again a few at a time they take nothing.
    let mut all = Some(vectors).filter(|_| batch == count);
    let shapes = shapes(count, m);
    for start in (0..count).step_by(batch) {
        let end = (start + batch).min(count);
        let some = all.take().unwrap_or_else(|| drawn(&shapes[start..end], m));
        let halves: Vec<&Vec<f64>> = some.iter().flatten().collect();
        let spectra: Vec<Kernel> =
            halves.into_par_iter().with_max_len(1).map(|half| Kernel::new(&backwards(half))).collect();
        let scratch = || Scratch {
            product: SumOfProducts::new(m),
            buffers: Buffers::default(),
            parts: [vec![0.0; m], vec![0.0; m]],
        };
        // One after the other, as threads come: the short ones at the end fill what the long ones leave.
        let found: Vec<(usize, usize, [f64; 3])> = tasks(own.len(), end - start, rayon::current_num_threads())
            .into_iter()
            .par_bridge()
            .map_init(scratch, |Scratch { product, buffers, parts: [re, im] }, (row, which)| {
                let kernel = Kernel::made_with(bank.kernel(own[row]), buffers);
                let length: f64 = bank.kernel(own[row]).iter().map(|v| v.abs()).sum();
                which
                    .map(|j| {
                        for (part, out) in spectra[2 * j..2 * j + 2].iter().zip([&mut *re, &mut *im]) {
                            product.add(1.0, &kernel, part);
                            product.take(out, buffers);
                        }
                        (row, start + j, effect(&some[j], sizes[start + j], re, im, norm, unit * length))
                    })
                    .collect::<Vec<_>>()
            })
            .flatten_iter()
            .collect();
        for (row, j, values) in found {
            for (half, value) in values.into_iter().enumerate() {
                out[row * groups + j / WIDTH][half][j % WIDTH] = value;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::regressors::{Index, Key, Record};

    #[test]
    #[allow(clippy::cast_precision_loss)]
    fn a_few_at_a_time_are_what_each_is_alone() -> crate::error::Result<()> {
        // Long enough for three batches of sixteen vectors.
        let (m, count) = (SPECTRA / 32 / 6, 2 * WIDTH);
        let record = Record::new(1e-3, vec![(0..m).map(|k| libm::sin(k as f64 * 0.01)).collect()], None)?;
        let mut index = Index::default();
        let own: Vec<usize> = [0.4, 1.1, 1.9].map(|eta| index.insert(Key::integral(0, eta))).into();
        let bank = Bank::new(&index, &record, 0)?;
        let all = vectors(count, m);
        let sizes = vec![1.0; count];
        let found: Vec<Vec<[Wide; 3]>> = [1, 2]
            .iter()
            .filter_map(|&threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().ok())
            .map(|pool| pool.install(|| effects(&bank, &own, all.clone(), &sizes, Norm::L1, 1e-9)))
            .collect();
        assert!(found.len() == 2 && found[0] == found[1], "whatever the threads");
        let groups = count / WIDTH;
        for (row, &p) in own.iter().enumerate() {
            let kernel = Kernel::new(bank.kernel(p));
            let length: f64 = bank.kernel(p).iter().map(|v| v.abs()).sum();
            for (j, vector) in all.iter().enumerate().step_by(5) {
                let [re, im] = [0, 1].map(|half| {
                    let signal: Vec<f64> = vector[half].iter().rev().copied().collect();
                    let mut out = vec![0.0; m];
                    kernel.apply(&signal, &mut out, &mut Buffers::default());
                    out
                });
                let alone = effect(vector, 1.0, &re, &im, Norm::L1, 1e-9 * length);
                for (half, value) in alone.into_iter().enumerate() {
                    let there = found[0][row * groups + j / WIDTH][half][j % WIDTH];
                    assert!((there - value).abs() <= 1e-12 * (1.0 + value.abs()), "{row} {j} {half}: {there} {value}");
                }
            }
        }
        Ok(())
    }

    #[test]
    fn every_column_meets_every_vector_once() {
        for (own, batch, threads) in [(11, 2, 2), (11, 2, 1), (3, 5, 8), (0, 4, 2), (4, 1, 4)] {
            let tasks = tasks(own, batch, threads);
            let mut pairs: Vec<(usize, usize)> =
                tasks.iter().flat_map(|(row, which)| which.clone().map(move |j| (*row, j))).collect();
            pairs.sort_unstable();
            let wanted: Vec<(usize, usize)> = (0..own).flat_map(|row| (0..batch).map(move |j| (row, j))).collect();
            assert_eq!(pairs, wanted);
        }
        assert_eq!(tasks(11, 2, 2).len(), 12);
    }
}

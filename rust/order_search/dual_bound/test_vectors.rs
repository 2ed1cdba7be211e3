//! Test vectors, and what integrals of the output make of them.
//!
//! They are complex exponentials under windows that end gently: there F_iᵀt is nearly a multiple of t.

use rayon::prelude::*;

use crate::order_search::options::Norm;
use crate::regressors::Bank;
use crate::series::{Buffers, Kernel};
use crate::simd::WIDTH;
use crate::stop::Stop;

/// One value for each of [`WIDTH`] test vectors.
pub(super) type Wide = [f64; WIDTH];

/// Lowest frequency of a test vector, in cycles a record.
const LOWEST: f64 = 0.3;

/// Spectra of test vectors, and of columns, held at a time, in bytes.
const SPECTRA: usize = 64 << 20;
const COLUMNS: usize = 192 << 20;

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

/// Writes a test vector's real and imaginary parts.
#[allow(clippy::cast_precision_loss)]
fn draw((window, cycles): Shape, halves: &mut [Vec<f64>; 2]) {
    let m = halves[0].len();
    let [re, im] = halves;
    for (k, (re, im)) in re.iter_mut().zip(im).enumerate() {
        let x = (k as f64 + 0.5) / m as f64;
        let (sin, cos) = libm::sincos(-std::f64::consts::TAU * cycles * x);
        let size = window.at(x);
        (*re, *im) = (size * cos, size * sin);
    }
}

/// The first `count` test vectors, real and imaginary parts. What it comes to once it was told to stop is of no use.
pub(super) fn vectors(count: usize, m: usize, stop: &Stop) -> Vec<[Vec<f64>; 2]> {
    shapes(count, m)
        .par_iter()
        .map(|&shape| {
            let mut halves = [0, 1].map(|_| vec![0.0; m]);
            if !stop.is_set() {
                draw(shape, &mut halves);
            }
            halves
        })
        .collect()
}

/// A test vector that is held against one own column after another.
struct Vector {
    halves: [Vec<f64>; 2],
    /// Its number among all.
    which: usize,
    size: f64,
    /// Spectra of its halves read backwards: Fᵀt is F applied to t read backwards, read backwards.
    spectra: [Kernel; 2],
    /// Fᵀt of the last column and of the one before it, backwards.
    here: [Vec<f64>; 2],
    before: [Vec<f64>; 2],
    /// g and what rounding may do, of the last column.
    last: Option<[f64; 3]>,
}

impl Vector {
    /// None yet: memory for one of so many samples.
    fn none(m: usize) -> Self {
        let none = || [0, 1].map(|_| vec![0.0; m]);
        let spectra = [0, 1].map(|_| Kernel::noughts(m));
        Self { halves: none(), which: 0, size: 0.0, spectra, here: none(), before: none(), last: None }
    }

    /// Turns to the test vector in its halves.
    fn turn(&mut self, which: usize, size: f64, buffers: &mut Buffers) {
        for (spectrum, half) in self.spectra.iter_mut().zip(&self.halves) {
            spectrum.read(half.iter().rev().copied(), buffers);
        }
        (self.which, self.size, self.last) = (which, size, None);
    }

    /// Of the next own column, whose moduli add up to `length`, what [`effects`] gives, but the step in place of the way.
    fn on(&mut self, column: &Kernel, length: f64, norm: Norm, unit: f64, buffers: &mut Buffers) -> [f64; 4] {
        std::mem::swap(&mut self.here, &mut self.before);
        for (spectrum, here) in self.spectra.iter().zip(&mut self.here) {
            column.times(spectrum, here, buffers);
        }
        let before = self.last.map(|last| (&self.before, last));
        let [g, h, rest, lost, step] = effect(&self.halves, &self.here, before, norm, unit * length);
        self.last = Some([g, h, lost]);
        let beyond = 16.0 * f64::EPSILON * (g.abs() + h.abs()) * self.size;
        [g * self.size, h * self.size, rest + beyond, step]
    }
}

/// g·‖t‖, ‖Fᵀt − g t‖, and how far this last vector has come since the first own column, of every own column and test
/// vector, columns first. What it comes to once it was told to stop is of no use.
pub(super) fn effects(
    bank: &Bank,
    own: &[usize],
    vectors: Vec<[Vec<f64>; 2]>,
    sizes: &[f64],
    (norm, unit): (Norm, f64),
    stop: &Stop,
) -> Vec<[Wide; 4]> {
    let (m, count) = (vectors.first().map_or(0, |v| v[0].len()), vectors.len());
    let groups = count / WIDTH;
    let mut out = vec![[[0.0; WIDTH]; 4]; own.len() * groups];
    // Every thread has a vector of its own; two spectra of as many bins as there are samples.
    let threads = rayon::current_num_threads();
    let batch = (SPECTRA / (32 * m.max(1))).max(threads).min(count.max(1));
    // As many blocks of columns as must be, of one size as nearly as can be.
    let block = own.len().div_ceil(own.len().div_ceil((COLUMNS / (16 * m.max(1))).max(threads)).max(1)).max(1);
    let kernels = |columns: &[usize]| -> Vec<(Kernel, f64)> {
        let kernel = |buffers: &mut Buffers, &column: &usize| {
            let length = bank.kernel(column).iter().map(|v| v.abs()).sum();
            (Kernel::made_with(bank.kernel(column), buffers), length)
        };
        columns.par_iter().with_max_len(1).map_init(Buffers::default, kernel).collect()
    };
    // Of a long record the vectors take more than all else here: drawn again a few at a time they take nothing.
    let mut all = Some(vectors).filter(|_| batch == count);
    let shapes = shapes(count, m);
    let mut held: Vec<Vector> = (0..batch).map(|_| Vector::none(m)).collect();
    let mut spectra = Vec::new();
    for start in (0..count).step_by(batch) {
        held.truncate(count - start);
        let drawn = all.take();
        held.par_iter_mut().with_max_len(1).enumerate().for_each_init(Buffers::default, |buffers, (i, vector)| {
            if stop.is_set() {
                return;
            }
            match &drawn {
                Some(all) => vector.halves.clone_from(&all[i]),
                None => draw(shapes[start + i], &mut vector.halves),
            }
            vector.turn(start + i, sizes[start + i], buffers);
        });
        for (first, columns) in own.chunks(block).enumerate().map(|(i, columns)| (i * block, columns)) {
            if stop.is_set() {
                return out;
            }
            if block < own.len() || start == 0 {
                spectra.clear();
                spectra.extend(kernels(columns));
            }
            let found: Vec<(usize, Vec<[f64; 4]>)> = held
                .par_iter_mut()
                .with_max_len(1)
                .map_init(Buffers::default, |buffers, vector| {
                    let columns = spectra.iter().take_while(|_| !stop.is_set());
                    let rows = columns.map(|(column, length)| vector.on(column, *length, norm, unit, buffers));
                    let rows = rows.collect();
                    (vector.which, rows)
                })
                .collect();
            for (which, rows) in found {
                for (row, values) in (first..).zip(rows) {
                    for (half, value) in values.into_iter().enumerate() {
                        out[row * groups + which / WIDTH][half][which % WIDTH] = value;
                    }
                }
            }
        }
    }
    // Steps add up to ways.
    for place in groups..out.len() {
        let before = out[place - groups][3];
        out[place][3].iter_mut().zip(before).for_each(|(way, before)| *way += before);
    }
    out
}

/// g, ‖u − g t‖, what rounding may do to that vector, and its distance from the one before; of u given backwards, and of
/// the u before it with its g and what rounding may do. g is the projection of u on t, best for the norm of squares.
#[allow(clippy::cast_precision_loss)]
fn effect(
    [a, b]: &[Vec<f64>; 2],
    [re, im]: &[Vec<f64>; 2],
    before: Option<(&[Vec<f64>; 2], [f64; 3])>,
    norm: Norm,
    rounding: f64,
) -> [f64; 5] {
    let rows = || a.iter().zip(b).zip(re.iter().zip(im).rev());
    let (mut x, mut y, mut squares) = (0.0, 0.0, 0.0);
    for ((a, b), (u, v)) in rows() {
        // conj(t)·u
        x += a * u + b * v;
        y += a * v - b * u;
        squares += a * a + b * b;
    }
    let (g, h) = (x / squares, y / squares);
    let apart = |(a, b): (&f64, &f64), (u, v): (f64, f64), g: f64, h: f64| {
        let (p, q) = (u - (g * a - h * b), v - (g * b + h * a));
        p * p + q * q
    };
    let count = (a.len() as f64).sqrt();
    // Both in one reading: a long record is not in any cache.
    let add = |sum: f64, x: f64| match norm {
        Norm::L1 => sum.max(x),
        Norm::L2 => sum + x,
    };
    let lost = match norm {
        Norm::L1 => rounding,
        Norm::L2 => rounding * count,
    };
    let rest = |t, (u, v): (&f64, &f64)| apart(t, (*u, *v), g, h);
    let (rest, step) = match before {
        None => (rows().fold(0.0, |sum, (t, u)| add(sum, rest(t, u))), 0.0),
        Some(([re, im], [g0, h0, lost0])) => {
            let (rest, step) = rows().zip(re.iter().zip(im).rev()).fold((0.0, 0.0), |sums, ((t, (u, v)), (u0, v0))| {
                let step = apart(t, (u - u0, v - v0), g - g0, h - h0);
                (add(sums.0, rest(t, (u, v))), add(sums.1, step))
            });
            (rest, f64::sqrt(step) + lost + lost0)
        }
    };
    [g, h, f64::sqrt(rest) + lost, lost, step]
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
        let all = vectors(count, m, &Stop::default());
        let sizes = vec![1.0; count];
        let found: Vec<Vec<[Wide; 4]>> = [1, 2]
            .iter()
            .filter_map(|&threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().ok())
            .map(|pool| pool.install(|| effects(&bank, &own, all.clone(), &sizes, (Norm::L1, 1e-9), &Stop::default())))
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
                let [g, h, rest, ..] = effect(vector, &[re, im], None, Norm::L1, 1e-9 * length);
                let alone = [g, h, rest];
                for (half, value) in alone.into_iter().enumerate() {
                    let there = found[0][row * groups + j / WIDTH][half][j % WIDTH];
                    assert!((there - value).abs() <= 1e-12 * (1.0 + value.abs()), "{row} {j} {half}: {there} {value}");
                }
            }
        }
        Ok(())
    }

    #[test]
    fn who_was_told_to_stop_makes_no_more_columns_and_holds_no_more_vectors() -> crate::error::Result<()> {
        let m = 64;
        let record = Record::new(0.1, vec![vec![1.0; m]], None)?;
        let mut index = Index::default();
        let own: Vec<usize> = [0.4, 1.1].map(|eta| index.insert(Key::integral(0, eta))).into();
        let (going, told) = (Stop::default(), Stop::default());
        told.set();
        let bank = Bank::counted(&index, &record, 0, &going)?;
        assert!(matches!(Bank::counted(&index, &record, 0, &told), Err(crate::error::Error::Interrupted)));
        let found =
            |stop| effects(&bank, &own, vectors(WIDTH, m, &Stop::default()), &[1.0; WIDTH], (Norm::L1, 1e-15), stop);
        assert!(found(&going).iter().flatten().flatten().any(|v| *v != 0.0));
        assert!(found(&told).iter().flatten().flatten().all(|v| *v == 0.0));
        Ok(())
    }

    #[test]
    fn ways_are_no_shorter_than_what_lies_between() -> crate::error::Result<()> {
        let (m, count) = (96, WIDTH);
        let record = Record::new(0.05, vec![(0..m).map(|k| libm::sin(f64::from(k) * 0.3)).collect()], None)?;
        let mut index = Index::default();
        let orders: Vec<f64> = (1..40).map(|i| 0.05 * f64::from(i)).collect();
        let own: Vec<usize> = orders.iter().map(|&eta| index.insert(Key::integral(0, eta))).collect();
        let bank = Bank::new(&index, &record, 0)?;
        let all = vectors(count, m as usize, &Stop::default());
        for norm in [Norm::L1, Norm::L2] {
            let found = effects(&bank, &own, all.clone(), &[1.0; WIDTH], (norm, 1e-15), &Stop::default());
            let vector = |row: usize, j: usize| -> Vec<(f64, f64)> {
                let [g, h] = [0, 1].map(|half: usize| found[row][half][j]);
                let parts = [0, 1].map(|half: usize| -> Vec<f64> {
                    let (t, f) = (&all[j][half], bank.kernel(own[row]));
                    (0..t.len()).map(|k| (k..t.len()).map(|i| t[i] * f[i - k]).sum()).collect()
                });
                let t = all[j][0].iter().zip(&all[j][1]);
                t.zip(parts[0].iter().zip(&parts[1]))
                    .map(|((a, b), (u, v))| (u - (g * a - h * b), v - (g * b + h * a)))
                    .collect()
            };
            let mut closest = 0.0_f64;
            for (i, k) in [(0, 1), (0, 38), (3, 9), (20, 22), (17, 18)] {
                for (j, way) in found[k][3].iter().enumerate() {
                    let squares = vector(i, j)
                        .into_iter()
                        .zip(vector(k, j))
                        .map(|(a, b)| (a.0 - b.0) * (a.0 - b.0) + (a.1 - b.1) * (a.1 - b.1));
                    let apart = match norm {
                        Norm::L1 => squares.fold(0.0, f64::max).sqrt(),
                        Norm::L2 => squares.sum::<f64>().sqrt(),
                    };
                    let way = way - found[i][3][j];
                    assert!(way >= apart * (1.0 - 1e-12), "{norm:?} {i} to {k}, {j}: {way} for {apart}");
                    closest = closest.max(apart / way);
                }
            }
            assert!(closest > 0.999, "neighbours are as far apart as the way between them: {closest}");
        }
        Ok(())
    }
}

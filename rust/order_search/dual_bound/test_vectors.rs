//! Test vectors, and what integrals of the output make of them.
//!
//! They are complex exponentials under windows that end gently: there F_iᵀt is nearly a multiple of t.
//!
//! The test vectors on one record: what each says of a candidate's error there.

use rayon::prelude::*;

use crate::linalg::dense;
use crate::order_search::options::Norm;
use crate::parallel::{self, Stop};
use crate::regressors::Bank;
use crate::series::{Buffers, Kernel};
use crate::simd::WIDTH;

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

/// A column without an effect on the divisor.
pub(crate) const NONE: usize = usize::MAX;

/// The test vectors on one record: what they make of each column.
pub(crate) struct Probes {
    /// Number of [`Wide`] groups of test vectors.
    pub(crate) groups: usize,
    /// ⟨t, x⟩ of column p and group g at p·groups + g, real and imaginary part.
    pub(crate) products: Vec<[Wide; 2]>,
    /// ⟨t, y⟩.
    pub(crate) target: Vec<[Wide; 2]>,
    /// Row of `effects` of a column, [`NONE`] where it is not of the output itself.
    pub(crate) rows: Vec<usize>,
    /// g·‖t‖ (real, imaginary), ‖Fᵀt − g t‖, and the way that Fᵀt − g t has come since the first row: no two rows are
    /// farther apart than the way between them.
    pub(crate) effects: Vec<[Wide; 4]>,
    /// ‖t‖ in the dual norm.
    pub(crate) size: Vec<Wide>,
    /// What rounding may add to |⟨t, w⟩| per unit of a column's coefficient, and for the target.
    pub(crate) rounding: Vec<f64>,
    pub(crate) target_rounding: f64,
    /// What rounding may add to a sum of m terms, per unit.
    pub(crate) unit: f64,
}

/// Most own columns that are looked at together.
const TOGETHER: usize = 4;

impl Probes {
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn new(
        bank: &Bank,
        target: &[f64],
        norm: Norm,
        (output_error, count): (bool, usize),
        stop: &Stop,
    ) -> Self {
        let m = target.len();
        let groups = count / WIDTH;
        let vectors = vectors(count, m, stop);
        let dual = |parts: &[&[f64]; 2]| -> f64 {
            let squares = parts[0].iter().zip(parts[1]).map(|(a, b)| a * a + b * b);
            match norm {
                Norm::L1 => squares.fold(0.0, f64::max).sqrt(),
                Norm::L2 => squares.sum::<f64>().sqrt(),
            }
        };
        let sizes: Vec<f64> = parallel::map(vectors.iter().collect(), || (), |(), [a, b]| dual(&[a, b]));

        let mut columns: Vec<&[f64]> = (0..bank.len()).map(|p| bank.column(p)).collect();
        columns.push(target);
        let flat: Vec<&[f64]> = vectors.iter().flatten().map(Vec::as_slice).collect();
        let (inner, halves) = (dense::inner_products(&columns, &flat, stop), flat.len());
        let gathered = |p: usize| -> Vec<[Wide; 2]> {
            (0..groups)
                .map(|g| {
                    let part = |half: usize| std::array::from_fn(|n| inner[p * halves + 2 * (g * WIDTH + n) + half]);
                    [part(0), part(1)]
                })
                .collect()
        };
        let products: Vec<[Wide; 2]> = (0..bank.len()).flat_map(gathered).collect();

        // A generous multiple of what m additions may lose; it covers columns, inner products and the march as well.
        let unit = 16.0 * f64::EPSILON * m as f64;
        let sum = |x: &[f64]| x.iter().map(|v| v.abs()).sum::<f64>();
        let size_of_target = sum(target);
        let own: Vec<usize> = (0..bank.len()).filter(|&p| output_error && !bank.kernel(p).is_empty()).collect();
        let mut rows = vec![NONE; bank.len()];
        own.iter().enumerate().for_each(|(row, &p)| rows[p] = row);
        let rounding = parallel::map(
            (0..bank.len()).collect(),
            || (),
            |(), p| unit * (sum(bank.column(p)) + sum(bank.kernel(p)) * size_of_target),
        );
        let effects = effects(bank, &own, vectors, &sizes, (norm, unit), stop);
        let size = (0..groups).map(|g| std::array::from_fn(|n| sizes[g * WIDTH + n])).collect();
        Self {
            groups,
            products,
            target: gathered(bank.len()),
            rows,
            effects,
            size,
            rounding,
            target_rounding: 2.0 * unit * size_of_target,
            unit,
        }
    }

    pub(super) fn chosen(&self, which: &[usize]) -> Self {
        let groups = which.len() / WIDTH;
        let pick = |source: &[Wide], g: usize| -> Wide {
            std::array::from_fn(|n| source[which[g * WIDTH + n] / WIDTH][which[g * WIDTH + n] % WIDTH])
        };
        let part =
            |rows: &[[Wide; 2]], half: usize, g: usize| pick(&rows.iter().map(|r| r[half]).collect::<Vec<_>>(), g);
        let pairs = |rows: &[[Wide; 2]]| (0..groups).map(|g| [part(rows, 0, g), part(rows, 1, g)]).collect::<Vec<_>>();
        let fours = |rows: &[[Wide; 4]]| {
            let part = |h: usize, g: usize| pick(&rows.iter().map(|r| r[h]).collect::<Vec<_>>(), g);
            (0..groups).map(|g| std::array::from_fn(|h| part(h, g))).collect::<Vec<[Wide; 4]>>()
        };
        Self {
            groups,
            products: self.products.chunks(self.groups).flat_map(pairs).collect(),
            target: pairs(&self.target),
            rows: self.rows.clone(),
            effects: self.effects.chunks(self.groups).flat_map(fours).collect(),
            size: (0..groups).map(|g| pick(&self.size, g)).collect(),
            rounding: self.rounding.clone(),
            target_rounding: self.target_rounding,
            unit: self.unit,
        }
    }

    #[inline(always)]
    pub(super) fn allowance(&self, terms: &[usize], coefficients: &[f64], initial: &[usize], weights: &[f64]) -> f64 {
        let pairs = terms.iter().zip(coefficients).chain(initial.iter().zip(weights));
        pairs.fold(self.target_rounding, |sum, (&p, c)| sum + c.abs() * self.rounding[p])
    }

    /// Bounds and guesses of one group of test vectors.
    #[inline(always)]
    pub(super) fn group(
        &self,
        group: usize,
        terms: &[usize],
        coefficients: &[f64],
        initial: &[usize],
        weights: &[f64],
        rounding: f64,
    ) -> (Wide, Wide) {
        let [mut re, mut im] = self.target[group];
        let mut divisor = self.size[group];
        let (mut divisor_im, mut slack) = ([0.0; WIDTH], [0.0; WIDTH]);
        let (mut own, mut count) = ([(0, 0.0); TOGETHER], 0);
        for (&p, &c) in terms.iter().zip(coefficients) {
            let [a, b] = &self.products[p * self.groups + group];
            for n in 0..WIDTH {
                re[n] -= c * a[n];
                im[n] -= c * b[n];
            }
            let row = self.rows[p];
            if row != NONE {
                let [a, b, rest, _] = &self.effects[row * self.groups + group];
                for n in 0..WIDTH {
                    divisor[n] -= c * a[n];
                    divisor_im[n] -= c * b[n];
                    slack[n] += c.abs() * rest[n];
                }
                if count < TOGETHER {
                    own[count] = (row, c);
                }
                count += 1;
            }
        }
        for (&p, &c) in initial.iter().zip(weights) {
            let [a, b] = &self.products[p * self.groups + group];
            for n in 0..WIDTH {
                re[n] -= c * a[n];
                im[n] -= c * b[n];
            }
        }
        if (2..=TOGETHER).contains(&count) {
            let together = self.together(group, &mut own[..count]);
            for n in 0..WIDTH {
                slack[n] = if together[n] < slack[n] { together[n] } else { slack[n] };
            }
        }
        let (mut bounds, mut guesses) = ([0.0; WIDTH], [0.0; WIDTH]);
        for n in 0..WIDTH {
            let seen = (re[n] * re[n] + im[n] * im[n]).sqrt() - rounding;
            let size = (divisor[n] * divisor[n] + divisor_im[n] * divisor_im[n]).sqrt();
            // A hair more, for the rounding of the divisor and of the score itself.
            bounds[n] = seen / ((size + slack[n]) * (1.0 + self.unit));
            guesses[n] = seen / size;
        }
        (bounds, guesses)
    }

    /// At most ‖Σ c (Fᵀt − g t)‖ of own columns by row, whose coefficients may cancel: all of them times what the first
    /// row has, and all but the first so many times the way to the next.
    #[inline(always)]
    fn together(&self, group: usize, own: &mut [(usize, f64)]) -> Wide {
        for i in 1..own.len() {
            let mut at = i;
            while at > 0 && own[at - 1].0 > own[at].0 {
                own.swap(at - 1, at);
                at -= 1;
            }
        }
        let (mut left, mut all) = (0.0, 0.0);
        for (_, c) in own.iter() {
            left += c;
            all += c.abs();
        }
        let [.., first, mut before] = self.effects[own[0].0 * self.groups + group];
        let [.., last] = &self.effects[own[own.len() - 1].0 * self.groups + group];
        let mut most = [0.0; WIDTH];
        for n in 0..WIDTH {
            // What is left of sums loses as much as they are.
            most[n] = left.abs() * first[n] + 16.0 * f64::EPSILON * all * (first[n] + last[n]);
        }
        for at in 1..own.len() {
            left -= own[at - 1].1;
            let [.., way] = self.effects[own[at].0 * self.groups + group];
            for n in 0..WIDTH {
                most[n] += left.abs() * (way[n] - before[n]);
            }
            before = way;
        }
        most
    }
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

//! Set of fixed test vectors, and their inner products with the regressors.
//!
//! The vectors t are complex exponentials multiplied by windows that end smoothly. For the convolution matrix F of an
//! output column, Fᵀt is then nearly a multiple of t.

use rayon::prelude::*;

use crate::linalg::dense;
use crate::order_search::options::Norm;
use crate::parallel::{self, Stop};
use crate::regressors::Bank;
use crate::series::{Buffers, Kernel};
use crate::simd::LANE_COUNT;

/// One value for each of [`LANE_COUNT`] test vectors.
pub(super) type Wide = [f64; LANE_COUNT];

/// Minimum frequency of a test vector \[cycles per record\].
const MIN_CYCLES_PER_RECORD: f64 = 0.3;

/// Maximum memory of the spectra of one batch of test vectors \[bytes\].
const VECTOR_SPECTRA_BYTES: usize = 64 << 20;
/// Maximum memory of the spectra of one block of output columns \[bytes\].
const COLUMN_SPECTRA_BYTES: usize = 192 << 20;

/// Window by which the complex exponential of a test vector is multiplied. It ends smoothly, because only then does the
/// transposed convolution with a kernel give nearly a multiple of the test vector.
#[derive(Debug, Clone, Copy)]
enum Window {
    /// Window that is 1 up to this fraction of the record, then a half cosine down to 0.
    Taper(f64),
    /// Exponential decay from 1 to e^{−rate} at the end of the record.
    Decay(f64),
}

impl Window {
    /// Return the value of the window at the time `x`, which is a fraction of the record length.
    fn at(self, x: f64) -> f64 {
        match self {
            Self::Taper(flat) if x <= flat => 1.0,
            Self::Taper(flat) => 0.5 + 0.5 * libm::cos(std::f64::consts::PI * (x - flat) / (1.0 - flat)),
            Self::Decay(rate) => libm::exp(-rate * x),
        }
    }
}

/// Windows and the number of frequencies for each. They were chosen by measurements at three noise levels. The taper
/// that starts in the middle of the record excludes the most candidates. The exponential decays exclude candidates with
/// an error early in the record.
const WINDOW_FREQUENCY_COUNTS: [(Window, usize); 3] =
    [(Window::Taper(0.5), 24), (Window::Taper(0.0), 12), (Window::Decay(5.0), 12)];

/// Total number of fixed test vectors. A search selects some of them.
pub(super) const MAX_TEST_VECTORS: usize = 48;

/// Window and frequency \[cycles per record\] of a test vector.
type Shape = (Window, f64);

/// Return windows and frequencies of the first `count` test vectors for a record of `m` samples. The frequencies of
/// every window span the whole range.
#[allow(clippy::cast_precision_loss)]
fn vector_shapes(count: usize, m: usize) -> Vec<Shape> {
    let highest = (m as f64 / 32.0).max(4.0);
    // For a smaller count, every window contributes proportionally.
    WINDOW_FREQUENCY_COUNTS
        .iter()
        .flat_map(|&(window, full)| {
            let n = (full * count).div_ceil(MAX_TEST_VECTORS);
            (0..n).map(move |i| {
                let fraction = if n > 1 { i as f64 / (n - 1) as f64 } else { 0.5 };
                (window, MIN_CYCLES_PER_RECORD * libm::pow(highest / MIN_CYCLES_PER_RECORD, fraction))
            })
        })
        .take(count)
        .collect()
}

/// Write the real and the imaginary part of a test vector to `parts`, one vector each.
#[allow(clippy::cast_precision_loss)]
fn write_vector((window, cycles): Shape, parts: &mut [Vec<f64>; 2]) {
    let m = parts[0].len();
    let [re, im] = parts;
    for (k, (re, im)) in re.iter_mut().zip(im).enumerate() {
        let x = (k as f64 + 0.5) / m as f64;
        let (sin, cos) = libm::sincos(-std::f64::consts::TAU * cycles * x);
        let size = window.at(x);
        (*re, *im) = (size * cos, size * sin);
    }
}

/// Return the real and imaginary parts of the first `count` test vectors for a record of `m` samples. The result is
/// unusable after a stop request.
pub(super) fn build_vectors(count: usize, m: usize, stop: &Stop) -> Vec<[Vec<f64>; 2]> {
    vector_shapes(count, m)
        .par_iter()
        .map(|&shape| {
            let mut parts = [0, 1].map(|_| vec![0.0; m]);
            if !stop.is_set() {
                write_vector(shape, &mut parts);
            }
            parts
        })
        .collect()
}

/// Workspace in which one test vector t is multiplied in sequence by the transposed convolution matrices F of the
/// output columns.
struct Vector {
    /// Real and imaginary part of the test vector.
    parts: [Vec<f64>; 2],
    /// Index of the test vector.
    number: usize,
    /// Dual norm of the test vector.
    size: f64,
    /// Spectra of the time-reversed real and imaginary part of the test vector t. For a convolution matrix F, the
    /// product Fᵀt is the time reversal of F applied to the time-reversed t.
    spectra: [Kernel; 2],
    /// Product Fᵀt of the test vector t with the convolution matrix F of the current column, in reversed time.
    current_product: [Vec<f64>; 2],
    /// Product Fᵀt of the test vector t with the convolution matrix F of the previous column, in reversed time.
    previous_product: [Vec<f64>; 2],
    /// Projection of Fᵀt on t for the most recent column (real and imaginary part), and a bound of the rounding error
    /// of Fᵀt. Here t is the test vector, and F is the convolution matrix of the column.
    last_projection: Option<[f64; 3]>,
}

impl Vector {
    /// Return a workspace for test vectors on a record of `m` samples.
    fn with_samples(m: usize) -> Self {
        let zeros = || [0, 1].map(|_| vec![0.0; m]);
        let spectra = [0, 1].map(|_| Kernel::zeros(m));
        Self {
            parts: zeros(),
            number: 0,
            size: 0.0,
            spectra,
            current_product: zeros(),
            previous_product: zeros(),
            last_projection: None,
        }
    }

    /// Compute the spectra of the test vector stored in `parts`. `number` is its index, and `size` its dual norm.
    fn load_spectra(&mut self, number: usize, size: f64, buffers: &mut Buffers) {
        for (spectrum, half) in self.spectra.iter_mut().zip(&self.parts) {
            spectrum.read(half.iter().rev().copied(), buffers);
        }
        (self.number, self.size, self.last_projection) = (number, size, None);
    }

    /// Return the entries of [`divisor_effects`] for the next output column, with the distance from the previous column
    /// in place of the path length. `length` is the sum of the moduli of the column's kernel.
    fn apply_column(&mut self, column: &Kernel, length: f64, norm: Norm, unit: f64, buffers: &mut Buffers) -> [f64; 4] {
        std::mem::swap(&mut self.current_product, &mut self.previous_product);
        for (spectrum, product) in self.spectra.iter().zip(&mut self.current_product) {
            column.times(spectrum, product, buffers);
        }
        let before = self.last_projection.map(|last| (&self.previous_product, last));
        let [g, h, rest, rounding, step] =
            column_effect(&self.parts, &self.current_product, before, norm, unit * length);
        self.last_projection = Some([g, h, rounding]);
        let truncation = 16.0 * f64::EPSILON * (g.abs() + h.abs()) * self.size;
        [g * self.size, h * self.size, rest + truncation, step]
    }
}

/// Compute g·‖t‖ (real, imaginary), ‖Fᵀt − g t‖ and a path length for every output column and group of test vectors t.
/// Here F is the convolution matrix of the column, and g the projection of Fᵀt on t. The path length is the sum of the
/// distances of Fᵀt − g t between consecutive columns, from the first column on.
pub(super) fn divisor_effects(
    bank: &Bank,
    output_columns: &[usize],
    vectors: Vec<[Vec<f64>; 2]>,
    sizes: &[f64],
    (norm, unit): (Norm, f64),
    stop: &Stop,
) -> Vec<[Wide; 4]> {
    let (m, count) = (vectors.first().map_or(0, |v| v[0].len()), vectors.len());
    let groups = count / LANE_COUNT;
    let mut out = vec![[[0.0; LANE_COUNT]; 4]; output_columns.len() * groups];
    // Each thread needs its own vector, whose two spectra have as many bins as the record has samples.
    let threads = rayon::current_num_threads();
    let batch = (VECTOR_SPECTRA_BYTES / (32 * m.max(1))).max(threads).min(count.max(1));
    // As few blocks of columns as possible, of nearly equal size.
    let block = output_columns
        .len()
        .div_ceil(output_columns.len().div_ceil((COLUMN_SPECTRA_BYTES / (16 * m.max(1))).max(threads)).max(1))
        .max(1);
    let kernels = |columns: &[usize]| -> Vec<(Kernel, f64)> {
        let kernel = |buffers: &mut Buffers, &column: &usize| {
            let length = bank.kernel(column).iter().map(|v| v.abs()).sum();
            (Kernel::with_buffers(bank.kernel(column), buffers), length)
        };
        columns.par_iter().with_max_len(1).map_init(Buffers::default, kernel).collect()
    };
    // For a long record the vectors need most of the memory, so they are recomputed batch by batch.
    let mut all = Some(vectors).filter(|_| batch == count);
    let shapes = vector_shapes(count, m);
    let mut batch_vectors: Vec<Vector> = (0..batch).map(|_| Vector::with_samples(m)).collect();
    let mut spectra = Vec::new();
    for start in (0..count).step_by(batch) {
        batch_vectors.truncate(count - start);
        let next_vector = all.take();
        batch_vectors.par_iter_mut().with_max_len(1).enumerate().for_each_init(
            Buffers::default,
            |buffers, (i, vector)| {
                if stop.is_set() {
                    return;
                }
                match &next_vector {
                    Some(all) => vector.parts.clone_from(&all[i]),
                    None => write_vector(shapes[start + i], &mut vector.parts),
                }
                vector.load_spectra(start + i, sizes[start + i], buffers);
            },
        );
        for (first, columns) in output_columns.chunks(block).enumerate().map(|(i, columns)| (i * block, columns)) {
            if stop.is_set() {
                return out;
            }
            if block < output_columns.len() || start == 0 {
                spectra.clear();
                spectra.extend(kernels(columns));
            }
            let effects: Vec<(usize, Vec<[f64; 4]>)> = batch_vectors
                .par_iter_mut()
                .with_max_len(1)
                .map_init(Buffers::default, |buffers, vector| {
                    let columns = spectra.iter().take_while(|_| !stop.is_set());
                    let rows =
                        columns.map(|(column, length)| vector.apply_column(column, *length, norm, unit, buffers));
                    let rows = rows.collect();
                    (vector.number, rows)
                })
                .collect();
            for (vector_index, rows) in effects {
                for (row, values) in (first..).zip(rows) {
                    for (half, value) in values.into_iter().enumerate() {
                        out[row * groups + vector_index / LANE_COUNT][half][vector_index % LANE_COUNT] = value;
                    }
                }
            }
        }
    }
    for group in groups..out.len() {
        let previous = out[group - groups][3];
        out[group][3].iter_mut().zip(previous).for_each(|(value, previous)| *value += previous);
    }
    out
}

/// Compute g (real, imaginary), ‖u − g t‖, its rounding-error bound and the distance of u − g t from its value for the
/// previous vector. Here t is `[a, b]`, u is `[re, im]` in reversed time, and `before` is the previous u, g and
/// rounding-error bound. The projection g of u on t minimizes the L2 norm of u − g t.
#[allow(clippy::cast_precision_loss)]
fn column_effect(
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
    let orthogonal_part = |(a, b): (&f64, &f64), (u, v): (f64, f64), g: f64, h: f64| {
        let (p, q) = (u - (g * a - h * b), v - (g * b + h * a));
        p * p + q * q
    };
    let count = (a.len() as f64).sqrt();
    // Both sums are computed in one pass, because a long record does not fit into any cache.
    let add = |sum: f64, x: f64| match norm {
        Norm::L1 => sum.max(x),
        Norm::L2 => sum + x,
    };
    let rounding_error = match norm {
        Norm::L1 => rounding,
        Norm::L2 => rounding * count,
    };
    let orthogonal_norm = |t, (u, v): (&f64, &f64)| orthogonal_part(t, (*u, *v), g, h);
    let (orthogonal_norm, step) = match before {
        None => (rows().fold(0.0, |sum, (t, u)| add(sum, orthogonal_norm(t, u))), 0.0),
        Some(([re, im], [g0, h0, lost0])) => {
            let (orthogonal_norm, step) =
                rows().zip(re.iter().zip(im).rev()).fold((0.0, 0.0), |sums, ((t, (u, v)), (u0, v0))| {
                    let step = orthogonal_part(t, (u - u0, v - v0), g - g0, h - h0);
                    (add(sums.0, orthogonal_norm(t, (u, v))), add(sums.1, step))
                });
            (orthogonal_norm, f64::sqrt(step) + rounding_error + lost0)
        }
    };
    [g, h, f64::sqrt(orthogonal_norm) + rounding_error, rounding_error, step]
}

/// Index of a column that does not belong to the output and therefore does not enter the denominator.
pub(crate) const NO_INDEX: usize = usize::MAX;

/// Set of fixed test vectors t on one record: products with every column, and norms. A group has [`LANE_COUNT`] test
/// vectors.
pub(crate) struct TestVectors {
    /// Number of groups of [`LANE_COUNT`] test vectors.
    pub(crate) groups: usize,
    /// Products of the test vectors of group g with column p, at index p·groups + g. Each is given as real and
    /// imaginary part.
    pub(crate) products: Vec<[Wide; 2]>,
    /// Products of the test vectors with the measured output, by group. Each is given as real and imaginary part.
    pub(crate) target: Vec<[Wide; 2]>,
    /// Row of each column in `effects`, [`NO_INDEX`] if it is not an output column.
    pub(crate) rows: Vec<usize>,
    /// Values g·‖t‖ (real, imaginary), ‖Fᵀt − g t‖ and path length, by output column, then by group of test vectors t.
    /// F is the convolution matrix of the column, and g the projection of Fᵀt on t. The path length is the sum of the
    /// distances of Fᵀt − g t between consecutive columns, from the first column on. The distance between two columns
    /// is at most the difference of their path lengths.
    pub(crate) effects: Vec<[Wide; 4]>,
    /// Dual norms of the test vectors, by group of [`LANE_COUNT`] vectors.
    pub(crate) size: Vec<Wide>,
    /// For each column, contribution per unit of its coefficient to the rounding-error bound of the product of a test
    /// vector with the equation error.
    pub(crate) rounding: Vec<f64>,
    /// Contribution of the measured output to the rounding-error bound of the product of a test vector with the
    /// equation error.
    pub(crate) target_rounding: f64,
    /// Relative rounding-error bound of a sum over all samples of the record.
    pub(crate) unit: f64,
}

/// Maximum number of output columns of a candidate for which their contributions to the denominator are bounded
/// jointly. With more output columns, each contribution is bounded separately.
const MAX_JOINT_OUTPUT_COLUMNS: usize = 4;

impl TestVectors {
    /// Build `count` test vectors on one record, and compute their products. If `output_error` is false, no column
    /// enters the denominator.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn new(
        bank: &Bank,
        target: &[f64],
        norm: Norm,
        (output_error, count): (bool, usize),
        stop: &Stop,
    ) -> Self {
        let m = target.len();
        let groups = count / LANE_COUNT;
        let vectors = build_vectors(count, m, stop);
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
        let (inner, parts) = (dense::inner_products(&columns, &flat, stop), flat.len());
        let grouped_products = |p: usize| -> Vec<[Wide; 2]> {
            (0..groups)
                .map(|g| {
                    let part =
                        |half: usize| std::array::from_fn(|n| inner[p * parts + 2 * (g * LANE_COUNT + n) + half]);
                    [part(0), part(1)]
                })
                .collect()
        };
        let products: Vec<[Wide; 2]> = (0..bank.len()).flat_map(grouped_products).collect();

        // Generous multiple of the error of m additions, which also covers columns, inner products and simulation.
        let unit = 16.0 * f64::EPSILON * m as f64;
        let sum = |x: &[f64]| x.iter().map(|v| v.abs()).sum::<f64>();
        let size_of_target = sum(target);
        let output_columns: Vec<usize> =
            (0..bank.len()).filter(|&p| output_error && !bank.kernel(p).is_empty()).collect();
        let mut rows = vec![NO_INDEX; bank.len()];
        output_columns.iter().enumerate().for_each(|(row, &p)| rows[p] = row);
        let rounding = parallel::map(
            (0..bank.len()).collect(),
            || (),
            |(), p| unit * (sum(bank.column(p)) + sum(bank.kernel(p)) * size_of_target),
        );
        let effects = divisor_effects(bank, &output_columns, vectors, &sizes, (norm, unit), stop);
        let size = (0..groups).map(|g| std::array::from_fn(|n| sizes[g * LANE_COUNT + n])).collect();
        Self {
            groups,
            products,
            target: grouped_products(bank.len()),
            rows,
            effects,
            size,
            rounding,
            target_rounding: 2.0 * unit * size_of_target,
            unit,
        }
    }

    /// Return the set with only the test vectors with the indices `indices`, in this sequence. Their number is a
    /// multiple of [`LANE_COUNT`].
    pub(super) fn select_vectors(&self, indices: &[usize]) -> Self {
        let groups = indices.len() / LANE_COUNT;
        let select_lanes = |source: &[Wide], g: usize| -> Wide {
            std::array::from_fn(|n| {
                source[indices[g * LANE_COUNT + n] / LANE_COUNT][indices[g * LANE_COUNT + n] % LANE_COUNT]
            })
        };
        let part = |rows: &[[Wide; 2]], half: usize, g: usize| {
            select_lanes(&rows.iter().map(|r| r[half]).collect::<Vec<_>>(), g)
        };
        let pairs = |rows: &[[Wide; 2]]| (0..groups).map(|g| [part(rows, 0, g), part(rows, 1, g)]).collect::<Vec<_>>();
        let fours = |rows: &[[Wide; 4]]| {
            let part = |h: usize, g: usize| select_lanes(&rows.iter().map(|r| r[h]).collect::<Vec<_>>(), g);
            (0..groups).map(|g| std::array::from_fn(|h| part(h, g))).collect::<Vec<[Wide; 4]>>()
        };
        Self {
            groups,
            products: self.products.chunks(self.groups).flat_map(pairs).collect(),
            target: pairs(&self.target),
            rows: self.rows.clone(),
            effects: self.effects.chunks(self.groups).flat_map(fours).collect(),
            size: (0..groups).map(|g| select_lanes(&self.size, g)).collect(),
            rounding: self.rounding.clone(),
            target_rounding: self.target_rounding,
            unit: self.unit,
        }
    }

    /// Return the rounding-error bound of the product of a test vector with the equation error, for a candidate with
    /// these columns and coefficients.
    #[inline(always)]
    pub(super) fn rounding_bound(
        &self,
        terms: &[usize],
        coefficients: &[f64],
        initial: &[usize],
        weights: &[f64],
    ) -> f64 {
        let pairs = terms.iter().zip(coefficients).chain(initial.iter().zip(weights));
        pairs.fold(self.target_rounding, |sum, (&p, c)| sum + c.abs() * self.rounding[p])
    }

    /// Return, for each test vector of a group, a lower bound of the norm of the error and an estimate of this norm.
    /// `coefficients` belong to the columns `terms`, and `weights` to the columns `initial` of the initial terms.
    /// `rounding` is the rounding-error bound of the products.
    #[inline(always)]
    pub(super) fn group_bounds(
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
        let (mut divisor_im, mut slack) = ([0.0; LANE_COUNT], [0.0; LANE_COUNT]);
        let (mut output_terms, mut count) = ([(0, 0.0); MAX_JOINT_OUTPUT_COLUMNS], 0);
        for (&p, &c) in terms.iter().zip(coefficients) {
            let [a, b] = &self.products[p * self.groups + group];
            for n in 0..LANE_COUNT {
                re[n] -= c * a[n];
                im[n] -= c * b[n];
            }
            let row = self.rows[p];
            if row != NO_INDEX {
                let [a, b, rest, _] = &self.effects[row * self.groups + group];
                for n in 0..LANE_COUNT {
                    divisor[n] -= c * a[n];
                    divisor_im[n] -= c * b[n];
                    slack[n] += c.abs() * rest[n];
                }
                if count < MAX_JOINT_OUTPUT_COLUMNS {
                    output_terms[count] = (row, c);
                }
                count += 1;
            }
        }
        for (&p, &c) in initial.iter().zip(weights) {
            let [a, b] = &self.products[p * self.groups + group];
            for n in 0..LANE_COUNT {
                re[n] -= c * a[n];
                im[n] -= c * b[n];
            }
        }
        if (2..=MAX_JOINT_OUTPUT_COLUMNS).contains(&count) {
            let together = self.joint_slack(group, &mut output_terms[..count]);
            for n in 0..LANE_COUNT {
                slack[n] = if together[n] < slack[n] { together[n] } else { slack[n] };
            }
        }
        let (mut bounds, mut guesses) = ([0.0; LANE_COUNT], [0.0; LANE_COUNT]);
        for n in 0..LANE_COUNT {
            let response = (re[n] * re[n] + im[n] * im[n]).sqrt() - rounding;
            let size = (divisor[n] * divisor[n] + divisor_im[n] * divisor_im[n]).sqrt();
            // Margin for the rounding of the divisor and of the score.
            bounds[n] = response / ((size + slack[n]) * (1.0 + self.unit));
            guesses[n] = response / size;
        }
        (bounds, guesses)
    }

    /// Return an upper bound of ‖Σ c (Fᵀt − g t)‖ for each test vector t of a group. The sum is over output columns
    /// with convolution matrix F and coefficient c, and g is the projection of Fᵀt on t. `output_terms` lists row and
    /// coefficient of each column. Coefficients of opposite sign partly cancel in this bound.
    ///
    /// By summation by parts, the sum of all coefficients multiplies the norm of the first column. Each partial sum
    /// multiplies the path length to the next column.
    #[inline(always)]
    fn joint_slack(&self, group: usize, output_terms: &mut [(usize, f64)]) -> Wide {
        for i in 1..output_terms.len() {
            let mut position = i;
            while position > 0 && output_terms[position - 1].0 > output_terms[position].0 {
                output_terms.swap(position - 1, position);
                position -= 1;
            }
        }
        let (mut remainder, mut all) = (0.0, 0.0);
        for (_, c) in output_terms.iter() {
            remainder += c;
            all += c.abs();
        }
        let [.., first, mut before] = self.effects[output_terms[0].0 * self.groups + group];
        let [.., last] = &self.effects[output_terms[output_terms.len() - 1].0 * self.groups + group];
        let mut max_norm = [0.0; LANE_COUNT];
        for n in 0..LANE_COUNT {
            // Partial sums lose accuracy in proportion to the sum of the moduli.
            max_norm[n] = remainder.abs() * first[n] + 16.0 * f64::EPSILON * all * (first[n] + last[n]);
        }
        for position in 1..output_terms.len() {
            remainder -= output_terms[position - 1].1;
            let [.., norms] = self.effects[output_terms[position].0 * self.groups + group];
            for n in 0..LANE_COUNT {
                max_norm[n] += remainder.abs() * (norms[n] - before[n]);
            }
            before = norms;
        }
        max_norm
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::regressors::{Index, Key, Record};

    #[test]
    #[allow(clippy::cast_precision_loss)]
    fn batched_test_vectors_match_single_ones() -> crate::error::Result<()> {
        // Long enough for three batches of sixteen vectors.
        let (m, count) = (VECTOR_SPECTRA_BYTES / 32 / 6, 2 * LANE_COUNT);
        let record = Record::from_rows(1e-3, vec![(0..m).map(|k| libm::sin(k as f64 * 0.01)).collect()], None)?;
        let mut index = Index::default();
        let output_columns: Vec<usize> = [0.4, 1.1, 1.9].map(|eta| index.insert(Key::integral(0, eta))).into();
        let bank = Bank::new(&index, &record, 0)?;
        let all = build_vectors(count, m, &Stop::default());
        let sizes = vec![1.0; count];
        let bounds: Vec<Vec<[Wide; 4]>> = [1, 2]
            .iter()
            .filter_map(|&threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().ok())
            .map(|pool| {
                pool.install(|| {
                    divisor_effects(&bank, &output_columns, all.clone(), &sizes, (Norm::L1, 1e-9), &Stop::default())
                })
            })
            .collect();
        assert!(bounds.len() == 2 && bounds[0] == bounds[1], "whatever the threads");
        let groups = count / LANE_COUNT;
        for (row, &p) in output_columns.iter().enumerate() {
            let kernel = Kernel::new(bank.kernel(p));
            let length: f64 = bank.kernel(p).iter().map(|v| v.abs()).sum();
            for (j, vector) in all.iter().enumerate().step_by(5) {
                let [re, im] = [0, 1].map(|half| {
                    let signal: Vec<f64> = vector[half].iter().rev().copied().collect();
                    let mut out = vec![0.0; m];
                    kernel.apply(&signal, &mut out, &mut Buffers::default());
                    out
                });
                let [g, h, rest, ..] = column_effect(vector, &[re, im], None, Norm::L1, 1e-9 * length);
                let alone = [g, h, rest];
                for (half, value) in alone.into_iter().enumerate() {
                    let bound = bounds[0][row * groups + j / LANE_COUNT][half][j % LANE_COUNT];
                    assert!((bound - value).abs() <= 1e-12 * (1.0 + value.abs()), "{row} {j} {half}: {bound} {value}");
                }
            }
        }
        Ok(())
    }

    #[test]
    fn stop_request_ends_column_computation_and_frees_vectors() -> crate::error::Result<()> {
        let m = 64;
        let record = Record::from_rows(0.1, vec![vec![1.0; m]], None)?;
        let mut index = Index::default();
        let output_columns: Vec<usize> = [0.4, 1.1].map(|eta| index.insert(Key::integral(0, eta))).into();
        let (going, stopped_flag) = (Stop::default(), Stop::default());
        stopped_flag.set();
        let bank = Bank::new_interruptible(&index, &record, 0, &going)?;
        assert!(matches!(
            Bank::new_interruptible(&index, &record, 0, &stopped_flag),
            Err(crate::error::Error::Interrupted)
        ));
        let columns = |stop| {
            divisor_effects(
                &bank,
                &output_columns,
                build_vectors(LANE_COUNT, m, &Stop::default()),
                &[1.0; LANE_COUNT],
                (Norm::L1, 1e-15),
                stop,
            )
        };
        assert!(columns(&going).iter().flatten().flatten().any(|v| *v != 0.0));
        assert!(columns(&stopped_flag).iter().flatten().flatten().all(|v| *v == 0.0));
        Ok(())
    }

    #[test]
    fn path_lengths_are_at_least_the_distances() -> crate::error::Result<()> {
        let (m, count) = (96, LANE_COUNT);
        let record = Record::from_rows(0.05, vec![(0..m).map(|k| libm::sin(f64::from(k) * 0.3)).collect()], None)?;
        let mut index = Index::default();
        let orders: Vec<f64> = (1..40).map(|i| 0.05 * f64::from(i)).collect();
        let output_columns: Vec<usize> = orders.iter().map(|&eta| index.insert(Key::integral(0, eta))).collect();
        let bank = Bank::new(&index, &record, 0)?;
        let all = build_vectors(count, m as usize, &Stop::default());
        for norm in [Norm::L1, Norm::L2] {
            let effects = divisor_effects(
                &bank,
                &output_columns,
                all.clone(),
                &[1.0; LANE_COUNT],
                (norm, 1e-15),
                &Stop::default(),
            );
            let vector = |row: usize, j: usize| -> Vec<(f64, f64)> {
                let [g, h] = [0, 1].map(|half: usize| effects[row][half][j]);
                let parts = [0, 1].map(|half: usize| -> Vec<f64> {
                    let (t, f) = (&all[j][half], bank.kernel(output_columns[row]));
                    (0..t.len()).map(|k| (k..t.len()).map(|i| t[i] * f[i - k]).sum()).collect()
                });
                let t = all[j][0].iter().zip(&all[j][1]);
                t.zip(parts[0].iter().zip(&parts[1]))
                    .map(|((a, b), (u, v))| (u - (g * a - h * b), v - (g * b + h * a)))
                    .collect()
            };
            let mut closest = 0.0_f64;
            for (i, k) in [(0, 1), (0, 38), (3, 9), (20, 22), (17, 18)] {
                for (j, way) in effects[k][3].iter().enumerate() {
                    let squares = vector(i, j)
                        .into_iter()
                        .zip(vector(k, j))
                        .map(|(a, b)| (a.0 - b.0) * (a.0 - b.0) + (a.1 - b.1) * (a.1 - b.1));
                    let apart = match norm {
                        Norm::L1 => squares.fold(0.0, f64::max).sqrt(),
                        Norm::L2 => squares.sum::<f64>().sqrt(),
                    };
                    let way = way - effects[i][3][j];
                    assert!(way >= apart * (1.0 - 1e-12), "{norm:?} {i} to {k}, {j}: {way} for {apart}");
                    closest = closest.max(apart / way);
                }
            }
            assert!(closest > 0.999, "neighbours are as far apart as the way between them: {closest}");
        }
        Ok(())
    }
}

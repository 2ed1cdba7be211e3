//! Test vectors that are exact for one candidate and corrected to first order for candidates with other coefficients.
//!
//! The denominator of a candidate is D = 1 − Σ c_i F_i over its output terms, with coefficients c_i and convolution
//! matrices F_i. The test vector of the candidate with denominator D₀ and output error e₀ is t₀ = D₀⁻ᵀ sign(e₀).
//!
//! Another candidate with the same orders of the output terms has D = D₀ − Σ x_m G_m. The G_m are combinations of the
//! F_i that make the vectors G_mᵀt₀ orthogonal. One Newton step for D⁻ᵀ sign(e₀) gives t = t₀ + Σ x_m v_m with v_m =
//! D₀⁻ᵀ G_mᵀ t₀. Then Dᵀt = D₀ᵀt₀ − Σ x_m x_n G_nᵀ v_m up to rounding. The bound decreases by a term of second order,
//! which a few precomputed norms limit.

use std::collections::BTreeMap;

use crate::equation::Equation;
use crate::error::{check_length, Error, Result};
use crate::order_search::dual_bound::tailored_vectors::RoundingBounds;
use crate::order_search::dual_bound::test_vectors::NO_INDEX;
use crate::order_search::options::Norm;
use crate::regressors::{Bank, Index, Key, Record};
use crate::series::{divide, reciprocal, Buffers, Kernel, SumOfProducts};
use crate::simd;

/// Maximum number of output terms of a candidate with linearized test vectors.
pub(crate) const MAX_OUTPUT_TERMS: usize = 4;
/// Maximum ratio of the error to the limit on the samples that a test vector covers. For a candidate with a larger
/// error, the vector covers only the first samples. The error on these samples is a lower bound of the error on all
/// samples.
const MAX_ERROR_LIMIT_RATIO: f64 = 4.0;
/// Magnitude below which products of two values do not overflow.
const MAX_SAFE_MAGNITUDE: f64 = 1e100;

/// Return true if the test vector built for `vector_equation` proves that the output error of `equation` exceeds
/// `limit`. The output error is Σ|y − ŷ| or Σ(y − ŷ)² with zero initial conditions. The vector is corrected to first
/// order. The output terms of both equations must have the same orders.
///
/// # Errors
/// [`Error::Structure`] for invalid signals, and [`Error::Length`] for a wrong number of coefficients.
/// [`Error::OutOfRange`] for invalid orders, different orders of the output terms, or a number of output terms other
/// than 1 to 4.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::equation::{Equation, Structure, Term};
/// # use ftlm::order_search::dual_bound::excluded_by_linearized_vector;
/// # use ftlm::order_search::options::Norm;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.8);
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
/// let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
/// let structure = Structure { output: 0, order: 0.8, terms };
/// let equation = |a: f64, b: f64| Equation { structure: structure.clone(), coefficients: vec![a, b] };
/// // y is the integral of order 0.8 of u: D^0.8 y = u.
/// let (made_for, other) = (equation(-0.5, 2.0), equation(-0.4, 2.1));
/// let proved = |limit: f64| excluded_by_linearized_vector(&record, &made_for, &other, Norm::L1, limit);
/// assert!(proved(1.0)? && !proved(1e3)?);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn excluded_by_linearized_vector(
    record: &Record,
    vector_equation: &Equation,
    equation: &Equation,
    norm: Norm,
    limit: f64,
) -> Result<bool> {
    let mut index = Index::default();
    let mut positions = Vec::new();
    for Equation { structure, coefficients } in [vector_equation, equation] {
        structure.check(record.len(), |_| true)?;
        check_length("coefficients", structure.terms.len(), coefficients.len())?;
        let keys = (0..structure.terms.len())
            .map(|k| index.insert(Key::integral(structure.terms[k].signal, structure.integration(k))));
        positions.push(keys.collect::<Vec<_>>());
    }
    let bank = Bank::new(&index, record, equation.structure.output)?;
    let (banks, targets) = ([bank], [record.signal(equation.structure.output).to_vec()]);
    let mut linearized_vectors = LinearizedVectors::new(&banks, &targets, norm);
    let output_columns = linearized_vectors.output_columns(&positions[0]);
    if output_columns != linearized_vectors.output_columns(&positions[1])
        || output_columns.is_empty()
        || output_columns.len() > MAX_OUTPUT_TERMS
    {
        return Err(Error::OutOfRange {
            name: "output terms".into(),
            value: 0.0,
            range: format!("1 to {MAX_OUTPUT_TERMS} terms of the output, of the same orders in both equations"),
            remedy: "give both equations such terms".into(),
        });
    }
    let vector = linearized_vectors.fit((&banks, &targets), &positions[0], &vector_equation.coefficients, limit);
    linearized_vectors.add(output_columns, vector.into_iter().collect());
    Ok(linearized_vectors.excludes_candidate(
        &positions[1],
        &equation.coefficients,
        limit,
        &mut VectorLookup::default(),
    ))
}

/// Test vector t₀ of one candidate and its first-order corrections v_m, one per output term, over all records. D₀ is
/// the denominator of this candidate, and G_m are orthogonalized kernel matrices of its output terms.
pub(crate) struct LinearizedVector {
    /// Coefficients of the output terms of the candidate for which the vector is built.
    center: Vec<f64>,
    /// Coefficients of the kernel matrices F_i of the k output terms in the basis of orthogonalized matrices G_i: F_i =
    /// G_i + Σ_{j<i} `projections[i·k + j]` G_j.
    projections: Vec<f64>,
    /// Largest modulus of the values of each first-order correction of the test vector.
    peak_values: Vec<f64>,
    /// Rounding error ‖D₀ᵀv_m − G_mᵀt₀‖ of each first-order correction v_m of the test vector t₀, in the dual norm. D₀
    /// is the denominator, and G_m an orthogonalized kernel matrix.
    solution_residuals: Vec<f64>,
    /// For each orthogonalized kernel G_m, an upper bound of the sum of moduli of its series, times the largest dual
    /// norm of a vector with values of at most 1. The bound sums the moduli over all kernels of which G_m is a
    /// combination.
    series_norms: Vec<f64>,
    /// Dual norms of the second-order terms ‖G_nᵀv_m + G_mᵀv_n‖ for n < m, then ‖G_mᵀv_m‖, for each m in sequence. G_m
    /// are orthogonalized kernel matrices, and v_m the first-order corrections of the test vector.
    second_order_norms: Vec<f64>,
    /// Dual norm ‖D₀ᵀt₀‖ of the test vector t₀ for the denominator D₀ of its candidate.
    norm: f64,
    /// Upper bound of the dual norm ‖D₀ᵀt‖ for any vector t with values of at most 1 in modulus. D₀ is the denominator
    /// of the candidate for which the test vector is built.
    center_norm: f64,
    /// Products of the test vector and of each of its k corrections with the measured output, the k output columns and
    /// all input columns. Row-major with one row per vector, shape (k + 1) × (k + 1 + number of input columns).
    products: Vec<f64>,
}

/// All linearized test vectors of a search. They are looked up by the output columns of a candidate.
pub(crate) struct LinearizedVectors {
    rounding_bounds: RoundingBounds,
    /// Index of each column among the input columns, [`NO_INDEX`] for an output column.
    input_index: Vec<usize>,
    /// Number of regressor columns of signals other than the output.
    width: usize,
    /// Range of the vectors in `vectors` for given output columns: first vector, and vector after the last one.
    ranges: BTreeMap<Vec<usize>, (usize, usize)>,
    vectors: Vec<LinearizedVector>,
}

/// State of the vector lookup of one thread, reused for all candidates.
#[derive(Default)]
pub(crate) struct VectorLookup {
    /// Regressor columns of the most recent candidate that are integrals of the output.
    output_columns: Vec<usize>,
    /// Regressor columns of the current candidate that are integrals of the output.
    next_output_columns: Vec<usize>,
    /// Range of the vectors for `output_columns`: first vector, and vector after the last one.
    range: (usize, usize),
    /// Index, within this range, of the vector that excluded the most recent candidate.
    last_vector: usize,
}

impl LinearizedVectors {
    /// Return an empty set of linearized test vectors for these records.
    pub(crate) fn new(banks: &[Bank], targets: &[Vec<f64>], norm: Norm) -> Self {
        let mut input_index = Vec::new();
        let mut width = 0;
        if let Some(bank) = banks.first() {
            for p in 0..bank.len() {
                input_index.push(if bank.kernel(p).is_empty() { width } else { NO_INDEX });
                width += usize::from(bank.kernel(p).is_empty());
            }
        }
        Self {
            rounding_bounds: RoundingBounds::new(banks, targets, norm),
            input_index,
            width,
            ranges: BTreeMap::new(),
            vectors: Vec::new(),
        }
    }

    /// Return the memory of one vector for candidates with `output_count` output terms \[bytes\].
    pub(crate) fn bytes(&self, output_count: usize) -> u64 {
        8 * ((output_count + 1) * (output_count + 1 + self.width) + output_count * (2 * output_count + 4) + 8) as u64
    }

    /// Return those columns of a candidate that are integrals of the output.
    pub(crate) fn output_columns(&self, terms: &[usize]) -> Vec<usize> {
        terms.iter().copied().filter(|&p| self.input_index[p] == NO_INDEX).collect()
    }

    /// Store the vectors built for candidates with these output columns.
    pub(crate) fn add(&mut self, output_columns: Vec<usize>, new_vectors: Vec<LinearizedVector>) {
        let start = self.vectors.len();
        self.vectors.extend(new_vectors);
        self.ranges.insert(output_columns, (start, self.vectors.len()));
    }

    /// Return the number of linearized test vectors.
    pub(crate) fn len(&self) -> usize {
        self.vectors.len()
    }

    /// Return the memory of all linearized test vectors \[bytes\].
    pub(crate) fn memory_bytes(&self) -> u64 {
        self.ranges
            .iter()
            .map(|(output_columns, (start, end))| self.bytes(output_columns.len()) * (end - start) as u64)
            .sum()
    }

    /// Build the test vector of the candidate with columns `terms` and coefficients `c`. It covers the first samples,
    /// up to an error of [`MAX_ERROR_LIMIT_RATIO`] times the limit. `None` if it covers no sample or a value overflows.
    pub(crate) fn fit(
        &self,
        (banks, targets): (&[Bank], &[Vec<f64>]),
        terms: &[usize],
        c: &[f64],
        limit: f64,
    ) -> Option<LinearizedVector> {
        let output_terms: Vec<(usize, f64)> =
            terms.iter().zip(c).map(|(&p, &c)| (p, c)).filter(|(p, _)| self.input_index[*p] == NO_INDEX).collect();
        let k = output_terms.len();
        let mut parts: Vec<RecordVectors> = Vec::new();
        let mut raw = 0.0;
        for (bank, target) in banks.iter().zip(targets) {
            let (mut divisor, mut input_sum) = (vec![0.0; target.len()], vec![0.0; target.len()]);
            divisor[0] = 1.0;
            for (&p, &c) in terms.iter().zip(c) {
                let (sum, values, c) = match bank.kernel(p) {
                    [] => (&mut input_sum, bank.column(p), c),
                    kernel => (&mut divisor, kernel, -c),
                };
                sum.iter_mut().zip(values).for_each(|(sum, x)| *sum += c * x);
            }
            let mut target_series: Vec<f64> = Vec::new();
            for (v, y) in divide(&input_sum, &divisor).ok()?.iter().zip(target) {
                let error = y - v;
                let (size, slope) = match self.rounding_bounds.norm {
                    Norm::L1 => (error.abs(), if error < 0.0 { -1.0 } else { 1.0 }),
                    Norm::L2 => (error * error, error),
                };
                // This form of the condition also rejects NaN.
                if !(raw + size <= MAX_ERROR_LIMIT_RATIO * limit && raw + size < f64::MAX) {
                    break;
                }
                raw += size;
                target_series.push(slope);
            }
            if target_series.is_empty() {
                break;
            }
            divisor.truncate(target_series.len());
            // In reversed time, transposed operators become the operators themselves.
            let vector = divide(&time_reversed(&target_series), &divisor).ok()?;
            parts.push(RecordVectors {
                divisor,
                vectors: vec![vector],
                first_order_terms: Vec::new(),
                series: Vec::new(),
            });
        }
        let top = largest(parts.iter().flat_map(|part| &part.vectors[0]));
        if !(f64::MIN_POSITIVE..MAX_SAFE_MAGNITUDE).contains(&top) {
            return None;
        }
        parts.iter_mut().flat_map(|part| &mut part.vectors[0]).for_each(|v| *v /= top);
        let mut projections = vec![0.0; k * k];
        let mut buffers = Buffers::default();
        for (part, bank) in parts.iter_mut().zip(banks) {
            let vector = Kernel::new(&part.vectors[0]);
            for &(p, _) in &output_terms {
                let series = bank.kernel(p)[..part.divisor.len()].to_vec();
                let mut step = vec![0.0; series.len()];
                Kernel::new(&series).times(&vector, &mut step, &mut buffers);
                part.first_order_terms.push(step);
                part.series.push(series);
            }
        }
        // Orthogonalize the terms. They are nearly collinear, with coefficients of opposite sign.
        for i in 0..k {
            for j in 0..i {
                let inner = |a: usize, b: usize| -> f64 {
                    parts.iter().map(|part| simd::dot(&part.first_order_terms[a], &part.first_order_terms[b])).sum()
                };
                let square = inner(j, j);
                let projection = if square > 0.0 { inner(i, j) / square } else { 0.0 };
                projections[i * k + j] = projection;
                for part in &mut parts {
                    for rows in [&mut part.first_order_terms, &mut part.series] {
                        let (before, after) = rows.split_at_mut(i);
                        after[0].iter_mut().zip(&before[j]).for_each(|(x, y)| *x -= projection * y);
                    }
                }
            }
        }
        let mut accumulator = NormAccumulator::new(self.rounding_bounds.norm, k);
        for part in &mut parts {
            part.add_corrections(&mut accumulator, &mut buffers);
        }
        let mut lengths: Vec<f64> = Vec::new();
        for (i, &(p, _)) in output_terms.iter().enumerate() {
            let basis_part: f64 = (0..i).map(|j| projections[i * k + j].abs() * lengths[j]).sum();
            lengths.push(self.rounding_bounds.kernel_norms[p] + basis_part);
        }
        let sizes: Vec<f64> = (1..=k).map(|m| largest(parts.iter().flat_map(|part| &part.vectors[m]))).collect();
        let products = self.products(&parts, banks, targets, &output_terms);
        let center_bound = self.rounding_bounds.max_dual_norm
            + output_terms.iter().map(|&(p, c)| c.abs() * self.rounding_bounds.kernel_norms[p]).sum::<f64>();
        let NormAccumulator { norm, solution_residuals: rests, second_order_norms: bends, .. } =
            accumulator.final_norms();
        let is_finite = [&lengths, &sizes, &products, &rests, &bends, &projections]
            .into_iter()
            .flatten()
            .all(|v| v.abs() < MAX_SAFE_MAGNITUDE);
        let center = output_terms.iter().map(|(_, c)| *c).collect();
        (is_finite && norm < MAX_SAFE_MAGNITUDE && center_bound < MAX_SAFE_MAGNITUDE).then_some(LinearizedVector {
            center,
            projections,
            peak_values: sizes,
            solution_residuals: rests,
            series_norms: lengths,
            second_order_norms: bends,
            norm,
            center_norm: center_bound,
            products,
        })
    }

    /// Compute the products of the test vector and its corrections with the measured output, the output columns and the
    /// input columns. The result is row-major with one row per vector.
    fn products(
        &self,
        parts: &[RecordVectors],
        banks: &[Bank],
        targets: &[Vec<f64>],
        output_terms: &[(usize, f64)],
    ) -> Vec<f64> {
        let row = output_terms.len() + 1 + self.width;
        let mut products = vec![0.0; (output_terms.len() + 1) * row];
        for ((part, bank), target) in parts.iter().zip(banks).zip(targets) {
            let vectors: Vec<Vec<f64>> = part.vectors.iter().map(|v| time_reversed(v)).collect();
            let input_columns = (0..bank.len()).filter(|&p| self.input_index[p] != NO_INDEX);
            let columns = std::iter::once(&target[..]).chain(output_terms.iter().map(|&(p, _)| bank.column(p)));
            let columns = columns.chain(input_columns.map(|p| bank.column(p)));
            let columns: Vec<&[f64]> = columns.map(|column| &column[..part.divisor.len()]).collect();
            simd::dispatch_simd(Products { vectors: &vectors, columns: &columns, out: &mut products });
        }
        products
    }

    /// Return true if some vector proves that the raw score (Σ|e| or Σe²) of a candidate exceeds the limit.
    #[inline(always)]
    pub(crate) fn excludes_candidate(
        &self,
        terms: &[usize],
        coefficients: &[f64],
        limit: f64,
        lookup: &mut VectorLookup,
    ) -> bool {
        let VectorLookup { output_columns, next_output_columns, range, last_vector: last } = lookup;
        next_output_columns.clear();
        next_output_columns.extend(terms.iter().copied().filter(|&p| self.input_index[p] == NO_INDEX));
        if next_output_columns != output_columns {
            std::mem::swap(next_output_columns, output_columns);
            *range = self.ranges.get(&output_columns[..]).copied().unwrap_or((0, 0));
        }
        let count = range.1 - range.0;
        for attempt in 0..count {
            let index = (*last + attempt) % count;
            if self.vector_excludes(&self.vectors[range.0 + index], terms, coefficients, limit) {
                *last = index;
                return true;
            }
        }
        false
    }

    /// Return true if this vector proves that the raw score (Σ|e| or Σe²) of a candidate exceeds the limit. The
    /// candidate must have the output columns for which the vector was built.
    #[inline(always)]
    pub(crate) fn vector_excludes(
        &self,
        linearized: &LinearizedVector,
        terms: &[usize],
        coefficients: &[f64],
        limit: f64,
    ) -> bool {
        let (rounding_bounds, k) = (&self.rounding_bounds, linearized.center.len());
        let limit = rounding_bounds.norm_threshold(limit);
        let (mut rounding, mut length) = (rounding_bounds.target_rounding, 0.0);
        let (mut output_coefficients, mut count) = ([0.0; MAX_OUTPUT_TERMS], 0);
        for (&p, &c) in terms.iter().zip(coefficients) {
            rounding += c.abs() * rounding_bounds.rounding[p];
            length += c.abs() * rounding_bounds.kernel_norms[p];
            if self.input_index[p] == NO_INDEX {
                output_coefficients[count] = c;
                count += 1;
            }
        }
        // Coordinates of the coefficient differences in the basis of the G_m.
        let mut x = [0.0; MAX_OUTPUT_TERMS];
        for i in 0..k {
            let deviation = output_coefficients[i] - linearized.center[i];
            x[i] += deviation;
            x.iter_mut()
                .zip(&linearized.projections[i * k..i * k + i])
                .for_each(|(x, projection)| *x += projection * deviation);
        }
        let (mut size, mut norm, mut steps, mut index) = (1.0, linearized.norm, 0.0, 0);
        for m in 0..k {
            size += x[m].abs() * linearized.peak_values[m];
            norm += x[m].abs() * linearized.solution_residuals[m];
            steps += x[m].abs() * linearized.series_norms[m];
            for n in 0..=m {
                norm += (x[m] * x[n]).abs() * linearized.second_order_norms[index];
                index += 1;
            }
        }
        norm += rounding_bounds.unit * size * (linearized.center_norm + length + steps);
        let (mut response, row) = (0.0, k + 1 + self.width);
        for m in 0..=k {
            let products = &linearized.products[m * row..(m + 1) * row];
            let mut correlation = products[0];
            for i in 0..k {
                correlation -= output_coefficients[i] * products[1 + i];
            }
            for (&p, &c) in terms.iter().zip(coefficients) {
                if self.input_index[p] != NO_INDEX {
                    correlation -= c * products[1 + k + self.input_index[p]];
                }
            }
            response += if m == 0 { correlation } else { x[m - 1] * correlation };
        }
        // Neither NaN nor an overflow proves anything.
        response.abs() - size * rounding > limit * norm && response.abs() < f64::MAX
    }
}

/// Intermediate vectors on one record, stored in reversed time. t₀ is the test vector, D₀ the denominator, and G_m are
/// orthogonalized kernels of the output terms.
struct RecordVectors {
    /// Denominator of the candidate as a series.
    divisor: Vec<f64>,
    /// Test vector, followed by its first-order corrections, one per output term.
    vectors: Vec<Vec<f64>>,
    /// Product of the test vector with each transposed kernel matrix, orthogonalized.
    first_order_terms: Vec<Vec<f64>>,
    /// The orthogonalized kernels of the output terms as series.
    series: Vec<Vec<f64>>,
}

impl RecordVectors {
    /// Compute the first-order corrections of the test vector, and add this record to the norms that the bound
    /// requires.
    fn add_corrections(&mut self, accumulator: &mut NormAccumulator, buffers: &mut Buffers) {
        let (m, k) = (self.divisor.len(), self.first_order_terms.len());
        let (divisor, inverse) = (Kernel::new(&self.divisor), Kernel::new(&reciprocal(&self.divisor)));
        let series: Vec<Kernel> = self.series.iter().map(|x| Kernel::new(x)).collect();
        let mut out = vec![0.0; m];
        divisor.times(&Kernel::new(&self.vectors[0]), &mut out, buffers);
        accumulator.norm = accumulator.accumulate(accumulator.norm, &out);
        let mut corrections: Vec<Kernel> = Vec::new();
        for (i, step) in self.first_order_terms.iter().enumerate() {
            let mut vector = vec![0.0; m];
            inverse.times(&Kernel::new(step), &mut vector, buffers);
            let spectrum = Kernel::new(&vector);
            divisor.times(&spectrum, &mut out, buffers);
            out.iter_mut().zip(step).for_each(|(x, y)| *x -= y);
            accumulator.solution_residuals[i] = accumulator.accumulate(accumulator.solution_residuals[i], &out);
            corrections.push(spectrum);
            self.vectors.push(vector);
        }
        let (mut sum, mut index) = (SumOfProducts::new(m), 0);
        for i in 0..k {
            for j in 0..=i {
                sum.add(1.0, &series[i], &corrections[j]);
                if i != j {
                    sum.add(1.0, &series[j], &corrections[i]);
                }
                sum.take(&mut out, buffers);
                accumulator.second_order_norms[index] =
                    accumulator.accumulate(accumulator.second_order_norms[index], &out);
                index += 1;
            }
        }
    }
}

/// Norms over all records: the largest modulus for [`Norm::L1`]. For [`Norm::L2`] they are sums of squares until
/// [`Self::final_norms`] takes the roots.
struct NormAccumulator {
    kind: Norm,
    norm: f64,
    solution_residuals: Vec<f64>,
    second_order_norms: Vec<f64>,
}

impl NormAccumulator {
    fn new(kind: Norm, k: usize) -> Self {
        Self { kind, norm: 0.0, solution_residuals: vec![0.0; k], second_order_norms: vec![0.0; k * (k + 1) / 2] }
    }

    /// Return the accumulated norm `partial_norm` with these values included. Infinite for [`Norm::L1`] if a value is
    /// not finite.
    fn accumulate(&self, partial_norm: f64, values: &[f64]) -> f64 {
        match self.kind {
            Norm::L1 if values.iter().all(|v| v.is_finite()) => partial_norm.max(largest(values)),
            Norm::L1 => f64::INFINITY,
            Norm::L2 => partial_norm + values.iter().map(|v| v * v).sum::<f64>(),
        }
    }

    /// Take the square roots of the sums of squares for [`Norm::L2`].
    fn final_norms(mut self) -> Self {
        if self.kind == Norm::L2 {
            let all = self
                .solution_residuals
                .iter_mut()
                .chain(&mut self.second_order_norms)
                .chain(std::iter::once(&mut self.norm));
            all.for_each(|v| *v = v.sqrt());
        }
        self
    }
}

/// Task that adds inner products of vectors with columns to `out`, row-major with one row per vector. This task is
/// compiled for the widest vector instructions available.
struct Products<'a> {
    vectors: &'a [Vec<f64>],
    columns: &'a [&'a [f64]],
    out: &'a mut [f64],
}

impl simd::SimdKernel for Products<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        for (i, column) in self.columns.iter().enumerate() {
            for (m, vector) in self.vectors.iter().enumerate() {
                self.out[m * self.columns.len() + i] += simd::dot(vector, column);
            }
        }
    }
}

/// Return the values in reversed order.
fn time_reversed(x: &[f64]) -> Vec<f64> {
    x.iter().rev().copied().collect()
}

/// Return the largest modulus of values; NaN if a value is NaN.
fn largest<'a>(values: impl IntoIterator<Item = &'a f64>) -> f64 {
    values.into_iter().fold(0.0, |top: f64, v| if top.is_nan() || v.abs() <= top { top } else { v.abs() })
}

#[cfg(test)]
mod tests {
    use super::largest;

    #[test]
    fn largest_modulus_propagates_nan() {
        assert!((largest(&[1.0, -3.0, 2.0]) - 3.0).abs() < f64::EPSILON);
        for values in [[f64::NAN, 1.0, 2.0], [3.0, f64::NAN, 1.0], [1.0, 2.0, f64::NAN]] {
            assert!(largest(&values).is_nan());
        }
    }
}

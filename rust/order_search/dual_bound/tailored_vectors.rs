//! Test vectors that are each tailored to one candidate, and rounding-error bounds of their products.
//!
//! A candidate has the denominator D = 1 − Σ c F over its output terms, with coefficients c and convolution matrices F.
//! Its test vector is t = D⁻ᵀ sign(e) for the output error e. For the equation error w of this candidate, ⟨t, w⟩/‖Dᵀt‖
//! equals its score. For any other candidate it is a lower bound, as for every test vector. Dᵀt is computed exactly, so
//! the bound is also tight for large coefficients of opposite sign and for noise common to all candidates. The records
//! are concatenated, so one bound covers the error on all of them.

use rayon::prelude::*;

use crate::linalg::dense;
use crate::order_search::dual_bound::test_vectors::NO_INDEX;
use crate::order_search::options::Norm;
use crate::parallel::Stop;
use crate::regressors::Bank;
use crate::series::{divide, Buffers, Kernel};
use crate::simd::{self, LANE_COUNT};

/// Number of samples after which the partial sum of a norm is compared with its limit.
const NORM_CHECK_SAMPLES: usize = 8 * LANE_COUNT;
/// Magnitude below which products and sums do not overflow.
const MAX_SAFE_MAGNITUDE: f64 = 1e100;

/// Maximum number of output terms of a candidate for which norms are cached.
const MAX_CACHED_OUTPUT_TERMS: usize = 2;
/// Number of entries of the cache of norms of one thread.
const NORM_CACHE_ENTRIES: usize = 256;

/// Index of an output column among all output columns, and its coefficient.
type Weighted = (usize, f64);

/// Test vector t over all records, and its products with every column.
pub(crate) struct TailoredVector {
    /// Values of the vector, at most 1 in modulus, zero-padded to a multiple of [`NORM_CHECK_SAMPLES`].
    vector: Vec<f64>,
    /// Products of the test vector with every regressor column.
    products: Vec<f64>,
    /// Product of the test vector with the measured output.
    target: f64,
    /// Products Fᵀt with the convolution matrices F of all output columns, one after another. Each is as long as the
    /// test vector.
    transposed_products: Vec<f64>,
}

/// Dual norm ‖Dᵀt‖ of one test vector t for one candidate with denominator D = 1 − Σ c F over its output terms. F are
/// convolution matrices. Candidates with the same output columns and similar coefficients c have nearly the same norm.
#[derive(Clone, Copy)]
struct CachedNorm {
    /// Index of the test vector.
    vector: usize,
    /// Output columns of the candidate (integrals of the output) and their coefficients.
    output_terms: [Weighted; MAX_CACHED_OUTPUT_TERMS],
    /// Dual norm ‖Dᵀt‖ plus its rounding-error bound, with the denominator D of the candidate and the test vector t.
    norm: f64,
    /// Factor p in the decomposition a₂ = p·a₁ + r. Here a₁ and a₂ are the products Fᵀt of the test vector t with the
    /// convolution matrices F of the two output columns. The remainder r is orthogonal to a₁.
    projection: f64,
    /// Dual norms of a₁ and a₂ − p·a₁ as defined for `projection`, NaN until they are computed.
    deviation_norms: [f64; MAX_CACHED_OUTPUT_TERMS],
    /// Rounding-error bound of the norm per unit change of each coefficient.
    slack: [f64; MAX_CACHED_OUTPUT_TERMS],
}

/// Cache of norms of one thread, reused for all candidates.
#[derive(Default)]
pub(crate) struct NormCache {
    /// Output columns of the current candidate (integrals of the output) and their coefficients.
    output_terms: Vec<Weighted>,
    /// Index of the test vector that excluded the most recent candidate.
    last_vector: usize,
    /// The cached norms for the test vectors, found by the output columns of a candidate. `None` disables the cache.
    norms: Option<Vec<Option<CachedNorm>>>,
}

impl NormCache {
    /// Return a cache of norms for candidates that are visited by increasing index.
    pub(crate) fn for_adjacent_candidates() -> Self {
        Self { norms: Some(Vec::new()), ..Self::default() }
    }
}

/// Test vectors tailored to candidates, and their rounding-error bounds.
pub(crate) struct TailoredVectors {
    rounding_bounds: RoundingBounds,
    /// Index of each column among the output columns, [`NO_INDEX`] for any other column.
    rows: Vec<usize>,
    pub(crate) vectors: Vec<TailoredVector>,
}

impl TailoredVectors {
    /// Return the memory of one test vector for these banks \[bytes\].
    pub(crate) fn bytes(banks: &[Bank]) -> u64 {
        let samples: usize = banks.iter().map(samples).sum();
        let output_count = banks.first().map_or(0, |bank| output_columns(bank).len());
        8 * (samples.next_multiple_of(NORM_CHECK_SAMPLES) as u64 * (output_count as u64 + 1)
            + banks.first().map_or(0, Bank::len) as u64)
    }

    /// Return an empty set of tailored test vectors for these records.
    pub(crate) fn new(banks: &[Bank], targets: &[Vec<f64>], norm: Norm) -> Self {
        let mut rows = vec![NO_INDEX; banks.first().map_or(0, Bank::len)];
        if let Some(bank) = banks.first() {
            output_columns(bank).into_iter().enumerate().for_each(|(row, p)| rows[p] = row);
        }
        Self { rounding_bounds: RoundingBounds::new(banks, targets, norm), rows, vectors: Vec::new() }
    }

    /// Build the test vector of the candidate with columns `terms` and coefficients `c`. `None` if its simulation or
    /// the vector overflows. Runs on the current thread pool.
    pub(crate) fn fit(
        &self,
        banks: &[Bank],
        targets: &[Vec<f64>],
        terms: &[usize],
        c: &[f64],
    ) -> Option<TailoredVector> {
        let time_reversed = |x: &[f64]| -> Vec<f64> { x.iter().rev().copied().collect() };
        let mut vectors: Vec<Vec<f64>> = Vec::new();
        for (bank, target) in banks.iter().zip(targets) {
            let (mut divisor, mut input_sum) = (vec![0.0; target.len()], vec![0.0; target.len()]);
            divisor[0] = 1.0;
            for (&p, &c) in terms.iter().zip(c) {
                let kernel = bank.kernel(p);
                if kernel.is_empty() {
                    input_sum.iter_mut().zip(bank.column(p)).for_each(|(n, x)| *n += c * x);
                } else {
                    divisor.iter_mut().zip(kernel).for_each(|(d, x)| *d -= c * x);
                }
            }
            let error: Vec<f64> = divide(&input_sum, &divisor).ok()?.iter().zip(target).map(|(v, y)| y - v).collect();
            let target_series: Vec<f64> = match self.rounding_bounds.norm {
                Norm::L1 => error.iter().map(|e| if *e < 0.0 { -1.0 } else { 1.0 }).collect(),
                Norm::L2 => error,
            };
            vectors.push(time_reversed(&divide(&time_reversed(&target_series), &divisor).ok()?));
        }
        let top = vectors.iter().flatten().fold(0.0_f64, |top, v| top.max(v.abs()));
        if !vectors.iter().flatten().all(|v| v.is_finite()) || top < f64::MIN_POSITIVE {
            return None;
        }
        vectors.iter_mut().flatten().for_each(|v| *v /= top);
        let (mut products, mut target) = (vec![0.0; self.rows.len()], 0.0);
        for ((bank, y), t) in banks.iter().zip(targets).zip(&vectors) {
            let mut columns: Vec<&[f64]> = (0..bank.len()).map(|p| bank.column(p)).collect();
            columns.push(y);
            let inner = dense::inner_products(&columns, &[t], &Stop::default());
            products.iter_mut().zip(&inner).for_each(|(sum, x)| *sum += x);
            target += inner[bank.len()];
        }
        let spectra: Vec<Kernel> = vectors.iter().map(|t| Kernel::new(&time_reversed(t))).collect();
        let mut vector: Vec<f64> = vectors.concat();
        let length = vector.len().next_multiple_of(NORM_CHECK_SAMPLES);
        vector.resize(length, 0.0);
        let output_columns: Vec<usize> = (0..self.rows.len()).filter(|&p| self.rows[p] != NO_INDEX).collect();
        let mut kernel_products = vec![0.0; output_columns.len() * length];
        kernel_products.par_chunks_mut(length).zip(&output_columns).for_each(|(kernel_products, &p)| {
            let (mut index, mut buffers) = (0, Buffers::default());
            for (bank, spectrum) in banks.iter().zip(&spectra) {
                let part = &mut kernel_products[index..index + samples(bank)];
                Kernel::new(bank.kernel(p)).times(spectrum, part, &mut buffers);
                part.reverse();
                index += part.len();
            }
        });
        let is_finite =
            products.iter().chain(&kernel_products).all(|v| v.abs() < MAX_SAFE_MAGNITUDE) && target.is_finite();
        is_finite.then_some(TailoredVector { vector, products, target, transposed_products: kernel_products })
    }

    /// Return true if some vector proves that the raw score (Σ|e| or Σe²) of a candidate exceeds the limit. The vector
    /// that excluded the most recent candidate is tried first.
    #[inline(always)]
    pub(crate) fn excludes_candidate(
        &self,
        terms: &[usize],
        coefficients: &[f64],
        limit: f64,
        memory: &mut NormCache,
    ) -> bool {
        let limit = self.rounding_bounds.norm_threshold(limit);
        let NormCache { output_terms, last_vector: last, norms: cache } = memory;
        let (mut rounding, mut length) = (self.rounding_bounds.target_rounding, self.max_vector_norm());
        output_terms.clear();
        for (&p, &c) in terms.iter().zip(coefficients) {
            rounding += c.abs() * self.rounding_bounds.rounding[p];
            length += c.abs() * self.rounding_bounds.kernel_norms[p];
            if self.rows[p] != NO_INDEX {
                output_terms.push((self.rows[p], c));
            }
        }
        let rounding_error = self.rounding_bounds.unit * length;
        let max_norm = |index: usize| {
            let tailored = &self.vectors[index];
            let response =
                terms.iter().zip(coefficients).fold(tailored.target, |sum, (&p, &c)| sum - c * tailored.products[p]);
            (response.abs() - rounding) / limit - rounding_error
        };
        let pair: [Weighted; MAX_CACHED_OUTPUT_TERMS] =
            std::array::from_fn(|n| output_terms.get(n).copied().unwrap_or((NO_INDEX, 0.0)));
        let mut cache_index = None;
        if let (Some(cache), 1..=MAX_CACHED_OUTPUT_TERMS) = (cache, output_terms.len()) {
            cache.resize(NORM_CACHE_ENTRIES, None);
            let entry_index = pair[0].0.wrapping_mul(97).wrapping_add(pair[1].0) % NORM_CACHE_ENTRIES;
            let entry = &mut cache[entry_index];
            if entry.is_some_and(|entry| entry.output_terms[0].0 != pair[0].0 || entry.output_terms[1].0 != pair[1].0) {
                *entry = None;
            }
            if let Some(entry) = entry {
                if entry.deviation_norms[0].is_nan() {
                    self.compute_deviation_norms(entry);
                }
                *last = entry.vector;
                if self.norm_upper_bound(entry, &pair) <= max_norm(entry.vector) {
                    return true;
                }
            }
            cache_index = Some(entry);
        }
        for attempt in 0..self.vectors.len() {
            let index = (*last + attempt) % self.vectors.len();
            let Some(norm) = self.norm_up_to_limit(&self.vectors[index], output_terms, max_norm(index)) else {
                continue;
            };
            *last = index;
            if let Some(cache_index) = cache_index {
                let lengths = |n: usize| {
                    terms
                        .iter()
                        .find(|p| self.rows[**p] == pair[n].0)
                        .map_or(0.0, |p| self.rounding_bounds.kernel_norms[*p])
                };
                let norm = norm + rounding_error;
                *cache_index = Some(match *cache_index {
                    Some(entry) if entry.vector == index => CachedNorm { output_terms: pair, norm, ..entry },
                    _ => CachedNorm {
                        vector: index,
                        output_terms: pair,
                        norm,
                        projection: 0.0,
                        deviation_norms: [f64::NAN; MAX_CACHED_OUTPUT_TERMS],
                        slack: [lengths(0), lengths(1)],
                    },
                });
            }
            return true;
        }
        false
    }

    /// Return an upper bound of ‖Dᵀt‖ for a candidate with the same output columns as the cached norm. D is the
    /// denominator of the candidate, and t the test vector of the cached norm.
    #[inline(always)]
    fn norm_upper_bound(&self, cached: &CachedNorm, output_terms: &[Weighted; MAX_CACHED_OUTPUT_TERMS]) -> f64 {
        let deviations = [output_terms[0].1 - cached.output_terms[0].1, output_terms[1].1 - cached.output_terms[1].1];
        let [first, second] = cached.deviation_norms;
        let deviation_norm =
            (deviations[0] + cached.projection * deviations[1]).abs() * first + deviations[1].abs() * second;
        let rounding = deviations[0].abs() * cached.slack[0] + deviations[1].abs() * cached.slack[1];
        (cached.norm + deviation_norm + self.rounding_bounds.unit * rounding) * (1.0 + self.rounding_bounds.unit)
    }

    /// Compute bounds of the change of ‖Dᵀt‖ per unit change of the coefficients, and store them in the cached norm. D
    /// is the denominator of a candidate, and t the test vector of the cached norm.
    #[inline(always)]
    fn compute_deviation_norms(&self, cached: &mut CachedNorm) {
        let tailored = &self.vectors[cached.vector];
        let length = tailored.vector.len();
        let row = |n: usize| match cached.output_terms[n].0 {
            NO_INDEX => &[][..],
            row => &tailored.transposed_products[row * length..(row + 1) * length],
        };
        let (first, second) = (row(0), row(1));
        let (square, inner) = (simd::dot(first, first), simd::dot(&first[..second.len()], second));
        // The bound holds for any value.
        let projection = if square > 0.0 && (inner / square).abs() < MAX_SAFE_MAGNITUDE { inner / square } else { 0.0 };
        cached.projection = projection;
        cached.deviation_norms =
            [self.difference_norm(first, first, 0.0), self.difference_norm(second, first, projection)];
        cached.slack[1] += projection.abs() * cached.slack[0];
    }

    /// Return the dual norm ‖a − factor·b‖ of vectors whose length is a multiple of [`NORM_CHECK_SAMPLES`].
    #[inline(always)]
    fn difference_norm(&self, a: &[f64], b: &[f64], factor: f64) -> f64 {
        let mut all = [0.0_f64; LANE_COUNT];
        for (a, b) in a.chunks_exact(LANE_COUNT).zip(b.chunks_exact(LANE_COUNT)) {
            for n in 0..LANE_COUNT {
                let value = a[n] - factor * b[n];
                all[n] = match self.rounding_bounds.norm {
                    Norm::L1 if value.abs() > all[n] => value.abs(),
                    Norm::L1 => all[n],
                    Norm::L2 => all[n] + value * value,
                };
            }
        }
        match self.rounding_bounds.norm {
            Norm::L1 => all.into_iter().fold(0.0, f64::max),
            Norm::L2 => all.into_iter().sum::<f64>().sqrt(),
        }
    }

    /// Return an upper bound of the dual norm of a test vector, whose values are at most 1 in modulus.
    #[inline(always)]
    #[allow(clippy::cast_precision_loss)]
    fn max_vector_norm(&self) -> f64 {
        match (self.rounding_bounds.norm, self.vectors.first()) {
            (Norm::L2, Some(tailored)) => (tailored.vector.len() as f64).sqrt(),
            _ => 1.0,
        }
    }

    /// Return the dual norm ‖t − Σ c Fᵀt‖, where t is a test vector. The sum is over the output columns, each with
    /// convolution matrix F and coefficient c. `None` if it exceeds `limit` or cannot be computed safely.
    #[inline(always)]
    fn norm_up_to_limit(&self, tailored: &TailoredVector, output_terms: &[Weighted], limit: f64) -> Option<f64> {
        // A NaN limit proves nothing. Products with coefficients below [`MAX_SAFE_MAGNITUDE`] do not overflow.
        if limit.is_nan() || limit <= 0.0 || !output_terms.iter().all(|(_, c)| c.abs() < MAX_SAFE_MAGNITUDE) {
            return None;
        }
        let length = tailored.vector.len();
        let squares = limit * limit;
        let mut all = [0.0_f64; LANE_COUNT];
        for (first, vector) in
            (0..length).step_by(NORM_CHECK_SAMPLES).zip(tailored.vector.chunks_exact(NORM_CHECK_SAMPLES))
        {
            let mut sums = [0.0; NORM_CHECK_SAMPLES];
            sums.copy_from_slice(vector);
            for &(row, c) in output_terms {
                let convolution_product =
                    &tailored.transposed_products[row * length + first..row * length + first + NORM_CHECK_SAMPLES];
                for i in 0..NORM_CHECK_SAMPLES {
                    sums[i] -= c * convolution_product[i];
                }
            }
            for part in sums.chunks_exact(LANE_COUNT) {
                for n in 0..LANE_COUNT {
                    all[n] = match self.rounding_bounds.norm {
                        Norm::L1 if part[n].abs() > all[n] => part[n].abs(),
                        Norm::L1 => all[n],
                        Norm::L2 => all[n] + part[n] * part[n],
                    };
                }
            }
            let is_beyond = match self.rounding_bounds.norm {
                Norm::L1 => all.iter().any(|v| *v > limit),
                Norm::L2 => all.iter().sum::<f64>() > squares,
            };
            if is_beyond {
                return None;
            }
        }
        Some(match self.rounding_bounds.norm {
            Norm::L1 => all.into_iter().fold(0.0, f64::max),
            Norm::L2 => all.into_iter().sum::<f64>().sqrt(),
        })
    }
}

/// Return the number of samples of a bank.
fn samples(bank: &Bank) -> usize {
    if bank.is_empty() {
        0
    } else {
        bank.column(0).len()
    }
}

/// Return the columns that are integrals of the output.
fn output_columns(bank: &Bank) -> Vec<usize> {
    (0..bank.len()).filter(|&p| !bank.kernel(p).is_empty()).collect()
}

/// Rounding-error bounds of products with test vectors t, |t| ≤ 1, over all records.
pub(super) struct RoundingBounds {
    pub(super) norm: Norm,
    /// For each column, contribution per unit of its coefficient to the rounding-error bound of the product of a test
    /// vector with the equation error.
    pub(super) rounding: Vec<f64>,
    /// Contribution of the measured output to the rounding-error bound of the product of a test vector with the
    /// equation error.
    pub(super) target_rounding: f64,
    /// For each output column, the sum of the moduli of its kernel times the largest dual norm of a test vector. The
    /// record with the largest value counts. Zero for other columns.
    pub(super) kernel_norms: Vec<f64>,
    /// Largest dual norm of a vector whose values are at most 1 in modulus.
    pub(super) max_dual_norm: f64,
    /// Relative rounding-error bound of a sum over all samples.
    pub(super) unit: f64,
}

impl RoundingBounds {
    /// Compute the bounds for these records. `targets` is the measured output of each record.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn new(banks: &[Bank], targets: &[Vec<f64>], norm: Norm) -> Self {
        let width = banks.first().map_or(0, Bank::len);
        let all: usize = targets.iter().map(Vec::len).sum();
        let unit = 16.0 * f64::EPSILON * all as f64;
        let (mut rounding, mut kernel_norms) = (vec![0.0; width], vec![0.0_f64; width]);
        let max_dual_norm = match norm {
            Norm::L1 => 1.0,
            Norm::L2 => (all as f64).sqrt(),
        };
        for (bank, target) in banks.iter().zip(targets) {
            let target = sum_of_moduli(target);
            for p in 0..width {
                let length = sum_of_moduli(bank.kernel(p));
                rounding[p] += unit * (sum_of_moduli(bank.column(p)) + length * target);
                kernel_norms[p] = kernel_norms[p].max(length * max_dual_norm);
            }
        }
        let target_rounding = 2.0 * unit * targets.iter().map(|y| sum_of_moduli(y)).sum::<f64>();
        Self { norm, rounding, target_rounding, kernel_norms, max_dual_norm, unit }
    }

    /// Return the norm of the error above which the raw score (Σ|e| or Σe²) exceeds `raw`, with a margin for the
    /// rounding of the score.
    #[inline(always)]
    pub(super) fn norm_threshold(&self, raw: f64) -> f64 {
        (1.0 + self.unit)
            * match self.norm {
                Norm::L1 => raw,
                Norm::L2 => raw.sqrt(),
            }
    }
}

/// Return Σ|x|.
pub(super) fn sum_of_moduli(x: &[f64]) -> f64 {
    x.iter().map(|v| v.abs()).sum()
}

//! Dual lower bound of a candidate's output error from a few inner products.
//!
//! Let y be the measured output. The terms of the equation have coefficients c and columns x (integrals of the
//! signals). F_i is the convolution matrix of output term i. Let D = 1 − Σ c_i F_i over the terms of the output, and
//! let w = y − Σ c x over all terms be the equation error. The output error e satisfies D e = w. For any test vector t,
//! ⟨t, w⟩ = ⟨t, D e⟩ = ⟨Dᵀt, e⟩, so by Hölder's inequality
//!
//!   ‖e‖ ≥ |⟨t, w⟩| / ‖Dᵀt‖ in the dual norm, and ‖Dᵀt‖ ≤ |1 − Σ c_i g_i|·‖t‖ + Σ |c_i|·‖F_iᵀt − g_i t‖
//!
//! for any numbers g_i. Inner products and norms are computed once for all candidates. The bound of one candidate then
//! takes about thirty operations per test vector.

use crate::equation::{Equation, Structure};
use crate::error::{check_length, Result};
use crate::order_search::dual_bound::infeasibility::InfeasibilityProof;
use crate::order_search::dual_bound::tailored_vectors::{NormCache, TailoredVectors};
use crate::order_search::dual_bound::test_vectors::{TestVectors, MAX_TEST_VECTORS};
use crate::order_search::options::Norm;
use crate::parallel::Stop;
use crate::regressors::{Bank, Index, Key, Record};
use crate::simd::LANE_COUNT;

/// Return one lower bound of an equation's output error per fixed test vector, with zero initial conditions. The output
/// error is Σ|y − ŷ| for [`Norm::L1`] and Σ(y − ŷ)² for [`Norm::L2`].
///
/// # Errors
/// [`crate::error::Error::OutOfRange`] or [`crate::error::Error::Structure`] for orders or signals that do not form an
/// equation. [`crate::error::Error::Length`] for a number of coefficients that differs from the number of terms.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::equation::{Equation, Structure, Term};
/// # use ftlm::order_search::dual_bound::lower_bounds;
/// # use ftlm::order_search::options::Norm;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.8);
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
/// let structure = Structure { output: 0, order: 0.8, terms: vec![Term { signal: 1, order: 0.0 }] };
/// // y is the integral of order 0.8 of u. With c = 2 instead of 1, the output error is Σ|y|.
/// let equation = |c: f64| Equation { structure: structure.clone(), coefficients: vec![c] };
/// let error: f64 = record.signal(0).iter().map(|y| y.abs()).sum();
/// let proved = |c: f64| Ok::<_, ftlm::error::Error>(
///     lower_bounds(&record, &equation(c), Norm::L1)?.into_iter().fold(0.0, f64::max)
/// );
/// assert!(proved(1.0)? < 1e-9 && proved(2.0)? > 0.1 * error && proved(2.0)? <= error);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn lower_bounds(record: &Record, equation: &Equation, norm: Norm) -> Result<Vec<f64>> {
    let (bound, positions) = build_pool_bound(record, &equation.structure, norm)?;
    check_length("coefficients", positions.len(), equation.coefficients.len())?;
    let mut vector_bounds = vec![0.0; bound.len()];
    bound.bound_per_vector(|_| (&positions[..], &equation.coefficients[..], &[][..], &[][..]), &mut vector_bounds);
    Ok(vector_bounds)
}

/// Return true if it is proved that no coefficients of this structure give an output error of at most `limit`. The
/// output error is Σ|y − ŷ| or Σ(y − ŷ)² with zero initial conditions. Fixed coefficients keep their values. `start` is
/// one initial guess per term.
///
/// # Errors
/// [`crate::error::Error::OutOfRange`] or [`crate::error::Error::Structure`] for orders or signals that do not form an
/// equation. [`crate::error::Error::Length`] for a number of coefficients that differs from the number of terms.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::equation::{Structure, Term};
/// # use ftlm::order_search::dual_bound::is_infeasible;
/// # use ftlm::order_search::options::Norm;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.8);
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
/// let structure = Structure { output: 0, order: 0.8, terms: vec![Term { signal: 1, order: 0.0 }] };
/// // y is the integral of order 0.8 of u: a free coefficient fits it, a fixed coefficient of 2 does not.
/// assert!(!is_infeasible(&record, &structure, &[None], &[2.0], Norm::L1, 1e-3)?);
/// assert!(is_infeasible(&record, &structure, &[Some(2.0)], &[2.0], Norm::L1, 1e-3)?);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn is_infeasible(
    record: &Record,
    structure: &Structure,
    fixed: &[Option<f64>],
    start: &[f64],
    norm: Norm,
    limit: f64,
) -> Result<bool> {
    let (bound, positions) = build_pool_bound(record, structure, norm)?;
    check_length("fixed coefficients", structure.terms.len(), fixed.len())?;
    check_length("coefficients", structure.terms.len(), start.len())?;
    Ok(bound.proves_infeasible(limit, &positions, fixed, &[], start, &mut InfeasibilityProof::default()))
}

/// Return true if the test vector tailored to `vector_equation` proves that the output error of `equation` exceeds
/// `limit`. The output error is Σ|y − ŷ| or Σ(y − ŷ)² with zero initial conditions.
///
/// # Errors
/// [`crate::error::Error::OutOfRange`] or [`crate::error::Error::Structure`] for orders or signals that do not form an
/// equation. [`crate::error::Error::Length`] for a number of coefficients that differs from the number of terms.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::equation::{Equation, Structure, Term};
/// # use ftlm::order_search::dual_bound::{excluded_by, lower_bounds};
/// # use ftlm::order_search::options::Norm;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.8);
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
/// let structure = Structure { output: 0, order: 0.8, terms: vec![Term { signal: 1, order: 0.0 }] };
/// // y is the integral of order 0.8 of u. With c = 2 the output error is Σ|y|, with c = 3 it is 2Σ|y|.
/// let equation = |c: f64| Equation { structure: structure.clone(), coefficients: vec![c] };
/// let error: f64 = record.signal(0).iter().map(|y| y.abs()).sum();
/// let proved = |limit: f64| excluded_by(&record, &equation(2.0), &equation(3.0), Norm::L1, limit);
/// assert!(proved(1.99 * error)? && !proved(2.0 * error)?);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn excluded_by(
    record: &Record,
    vector_equation: &Equation,
    equation: &Equation,
    norm: Norm,
    limit: f64,
) -> Result<bool> {
    Ok(exclusion_flags(record, vector_equation, std::slice::from_ref(equation), norm, limit)? == [true])
}

/// Apply [`excluded_by`] to several equations of the same output in sequence, and return one result per equation. As in
/// a search, norms of the test vector are cached from one equation to the next.
///
/// # Errors
/// [`crate::error::Error::OutOfRange`] or [`crate::error::Error::Structure`] for orders or signals that do not form an
/// equation. [`crate::error::Error::Length`] for a number of coefficients that differs from the number of terms.
pub fn exclusion_flags(
    record: &Record,
    vector_equation: &Equation,
    equations: &[Equation],
    norm: Norm,
    limit: f64,
) -> Result<Vec<bool>> {
    let mut index = Index::default();
    let mut positions = Vec::new();
    for Equation { structure, coefficients } in std::iter::once(vector_equation).chain(equations) {
        structure.check(record.len(), |_| true)?;
        check_length("coefficients", structure.terms.len(), coefficients.len())?;
        let keys = (0..structure.terms.len())
            .map(|k| index.insert(Key::integral(structure.terms[k].signal, structure.integration(k))));
        positions.push(keys.collect::<Vec<_>>());
    }
    let bank = Bank::new(&index, record, vector_equation.structure.output)?;
    let (banks, targets) = ([bank], [record.signal(vector_equation.structure.output).to_vec()]);
    let mut tailored = TailoredVectors::new(&banks, &targets, norm);
    tailored.vectors.extend(tailored.fit(&banks, &targets, &positions[0], &vector_equation.coefficients));
    let mut memory = NormCache::for_adjacent_candidates();
    let candidates = positions[1..].iter().zip(equations);
    Ok(candidates
        .map(|(terms, candidates)| tailored.excludes_candidate(terms, &candidates.coefficients, limit, &mut memory))
        .collect())
}

/// Return the dual lower bound with all [`MAX_TEST_VECTORS`] fixed test vectors on one record. Also return the column
/// index of each term of the structure in the bank of regressors.
fn build_pool_bound(record: &Record, structure: &Structure, norm: Norm) -> Result<(Bound, Vec<usize>)> {
    structure.check(record.len(), |_| true)?;
    let mut index = Index::default();
    let positions: Vec<usize> = (0..structure.terms.len())
        .map(|k| index.insert(Key::integral(structure.terms[k].signal, structure.integration(k))))
        .collect();
    let bank = Bank::new(&index, record, structure.output)?;
    let target = record.signal(structure.output).to_vec();
    Ok((Bound::new((&[bank], &[target]), norm, true, MAX_TEST_VECTORS, &Stop::default()), positions))
}

/// Dual lower bound of the error of any candidate, from test vectors that are the same for all candidates. Each record
/// has one set of test vectors.
pub(crate) struct Bound {
    norm: Norm,
    test_vectors: Vec<TestVectors>,
}

impl Bound {
    /// Maximum number of test vectors per record.
    pub(crate) const MAX_TEST_VECTORS: usize = MAX_TEST_VECTORS;

    /// Build `count` test vectors per record. The count is a multiple of [`LANE_COUNT`] and at most
    /// [`MAX_TEST_VECTORS`].
    ///
    /// The bound applies to the output error if `output_error` is true, otherwise to the equation error. Runs on the
    /// current thread pool. The result is unusable after a stop request.
    pub(crate) fn new(
        (banks, targets): (&[Bank], &[Vec<f64>]),
        norm: Norm,
        output_error: bool,
        count: usize,
        stop: &Stop,
    ) -> Self {
        let test_vectors =
            banks.iter().zip(targets).map(|(b, y)| TestVectors::new(b, y, norm, (output_error, count), stop)).collect();
        Self { norm, test_vectors }
    }

    /// Return the test vectors of each record.
    pub(crate) fn test_vectors(&self) -> &[TestVectors] {
        &self.test_vectors
    }

    /// Return the number of test vectors per record.
    pub(crate) fn len(&self) -> usize {
        self.test_vectors.first().map_or(0, |p| p.groups * LANE_COUNT)
    }

    /// Return the bound with only the test vectors `indices`, in the given sequence. Their number is a multiple of
    /// [`LANE_COUNT`].
    pub(crate) fn select_vectors(&self, indices: &[usize]) -> Self {
        Self { norm: self.norm, test_vectors: self.test_vectors.iter().map(|p| p.select_vectors(indices)).collect() }
    }

    /// Return a lower bound of a candidate's raw score (Σ|e| or Σe²), and an estimate of the score that determines the
    /// evaluation sequence.
    ///
    /// For record r, `columns(r)` returns the columns and coefficients of the terms, then of the initial terms. The sum
    /// over records stops once the bound exceeds `limit`.
    #[inline(always)]
    pub(crate) fn evaluate<'a>(
        &self,
        limit: f64,
        columns: impl Fn(usize) -> (&'a [usize], &'a [f64], &'a [usize], &'a [f64]),
    ) -> (f64, f64) {
        let (mut bound, mut guess) = (0.0, 0.0);
        for (r, test_vectors) in self.test_vectors.iter().enumerate() {
            let (terms, coefficients, initial, weights) = columns(r);
            let rounding = test_vectors.rounding_bound(terms, coefficients, initial, weights);
            let (mut largest, mut max_distance) = (0.0, 0.0);
            for group in 0..test_vectors.groups {
                let (bounds, guesses) =
                    test_vectors.group_bounds(group, terms, coefficients, initial, weights, rounding);
                for n in 0..LANE_COUNT {
                    // Neither NaN nor an overflow proves anything.
                    if bounds[n] > largest && bounds[n] < f64::MAX {
                        largest = bounds[n];
                    }
                    if guesses[n] > max_distance {
                        max_distance = guesses[n];
                    }
                }
                if bound + self.raw(largest) > limit {
                    break;
                }
            }
            bound += self.raw(largest);
            guess += self.raw(max_distance);
        }
        (bound, guess)
    }

    /// Return true if it is proved that no coefficients of the columns `terms` give a raw score (Σ|e| or Σe²) of at
    /// most `limit`.
    ///
    /// The slice `fixed` has one entry per term, `None` for a free coefficient. The coefficients of the initial terms
    /// are free. `start` is the initial guess: coefficients of the terms, then of the initial terms by record.
    #[inline(always)]
    pub(crate) fn proves_infeasible(
        &self,
        limit: f64,
        terms: &[usize],
        fixed: &[Option<f64>],
        initial: &[usize],
        start: &[f64],
        scratch: &mut InfeasibilityProof,
    ) -> bool {
        let largest = match self.norm {
            Norm::L1 => limit,
            Norm::L2 => limit.sqrt(),
        };
        scratch.set_conditions(&self.test_vectors, largest, terms, fixed, initial, start);
        scratch.find_multipliers()
    }

    /// Compute the lower bound of the raw score (Σ|e| or Σe²) from each test vector separately, summed over records.
    /// Nonpositive or overflowing bounds count as 0.
    pub(crate) fn bound_per_vector<'a>(
        &self,
        columns: impl Fn(usize) -> (&'a [usize], &'a [f64], &'a [usize], &'a [f64]),
        out: &mut [f64],
    ) {
        out.fill(0.0);
        for (r, test_vectors) in self.test_vectors.iter().enumerate() {
            let (terms, coefficients, initial, weights) = columns(r);
            let rounding = test_vectors.rounding_bound(terms, coefficients, initial, weights);
            for (group, out) in out.chunks_exact_mut(LANE_COUNT).enumerate().take(test_vectors.groups) {
                let (bounds, _) = test_vectors.group_bounds(group, terms, coefficients, initial, weights, rounding);
                for (sum, bound) in out.iter_mut().zip(bounds) {
                    if bound > 0.0 && bound < f64::MAX {
                        *sum += self.raw(bound);
                    }
                }
            }
        }
    }

    /// Convert a norm of the error to a raw score: Σ|e| for [`Norm::L1`], Σe² for [`Norm::L2`].
    #[inline(always)]
    fn raw(&self, norm: f64) -> f64 {
        match self.norm {
            Norm::L1 => norm,
            Norm::L2 => norm * norm,
        }
    }
}

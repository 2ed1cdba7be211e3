//! Data shared by all candidates of one equation, and the evaluation of one candidate: coefficients, lower bounds,
//! error.

use crate::equation::{Initial, Structure};
use crate::error::{check_finite, Error, Result};
use crate::estimation::multi_innovation::RowBasis;
use crate::fractional::operational_matrices;
use crate::order_search::candidate::columns::Columns;
use crate::order_search::candidate::instrumental_variables::{start_bank, Refiner};
use crate::order_search::candidate::normal_equations::{
    apply_innovation_weights, plain_gram, Normal, NormalEquations, ResidualSumOfSquares, Solve,
};
use crate::order_search::candidate::simulation::BlockSimulation;
use crate::order_search::control::Control;
use crate::order_search::dual_bound::infeasibility::InfeasibilityProof;
use crate::order_search::dual_bound::linearized_vectors::{LinearizedVector, LinearizedVectors, VectorLookup};
use crate::order_search::dual_bound::lower_bound::Bound;
use crate::order_search::dual_bound::tailored_vectors::{NormCache, TailoredVector, TailoredVectors};
use crate::order_search::dual_bound::unstable_zeros::UnstableZeros;
use crate::order_search::options::{Criterion, Estimator, Options};
use crate::order_search::result::{Failure, Row, Verdict};
use crate::parallel::Stop;
use crate::regressors::{Bank, Index, Key, Record};
use crate::simd::{self, LANE_COUNT};

/// Cost of one simulation, in Fourier transforms of a record. Test vectors are built only while they cost a small
/// fraction of all simulations.
const SIMULATION_COST_TRANSFORMS: u64 = 6;
/// Cost of one refinement of coefficients, in Fourier transforms of a record. A refinement takes a few steps with a
/// division and a dozen transforms each.
const REFINEMENT_COST_TRANSFORMS: u64 = 100;

/// Regressor columns (indices in the banks) and coefficients of the terms of a candidate.
pub(crate) type SolvedCandidate = (Vec<usize>, Vec<f64>);

/// Data shared by all candidates of one equation.
pub(crate) struct Problem {
    /// Regressors of all candidates and their column numbers in the banks.
    index: Index,
    /// Bank of regressors of each record.
    banks: Vec<Bank>,
    /// The measured output of each record.
    targets: Vec<Vec<f64>>,
    pub(crate) equations: NormalEquations,
    /// Gram matrix without weights and prior. Present if candidates are ranked by squared equation error.
    pub(crate) residual_sums: Option<ResidualSumOfSquares>,
    /// Normal equations without weights and prior. Present if the coefficients have weights or a prior and candidates
    /// are ranked by squared equation error.
    least_squares: Option<Normal>,
    pub(crate) bound: Option<Bound>,
    /// Test vectors tailored to candidates of the search. Present if they save time.
    pub(crate) tailored_vectors: Option<TailoredVectors>,
    /// Test for unstable zeros of the denominator of a candidate. Present in large searches in which the other bounds
    /// exclude too few candidates.
    pub(crate) unstable_zeros: Option<UnstableZeros>,
    pub(crate) linearized_vectors: Option<LinearizedVectors>,
    refiner: Option<Refiner>,
    /// Banks of regressors for the dual bound. Used only if coefficients are refined, and empty after the bound is
    /// built.
    bound_banks: Vec<Bank>,
    options: Options,
    samples: usize,
}

/// Arguments of [`Bound::evaluate`] as a task that is compiled for the widest vector instructions available.
struct BoundKernel<'a, F> {
    bound: &'a Bound,
    limit: f64,
    columns: F,
}

impl<'a, F> simd::SimdKernel for BoundKernel<'a, F>
where
    F: Fn(usize) -> (&'a [usize], &'a [f64], &'a [usize], &'a [f64]),
{
    type Output = (f64, f64);

    #[inline(always)]
    fn run(self) -> (f64, f64) {
        self.bound.evaluate(self.limit, self.columns)
    }
}

/// Arguments of [`Bound::proves_infeasible`] as a task that is compiled for the widest vector instructions available.
struct InfeasibilityKernel<'a> {
    bound: &'a Bound,
    limit: f64,
    terms: &'a [usize],
    fixed: &'a [Option<f64>],
    initial: &'a [usize],
    start: &'a [f64],
    proof: &'a mut InfeasibilityProof,
}

impl simd::SimdKernel for InfeasibilityKernel<'_> {
    type Output = bool;

    #[inline(always)]
    fn run(self) -> bool {
        self.bound.proves_infeasible(self.limit, self.terms, self.fixed, self.initial, self.start, self.proof)
    }
}

/// Arguments of [`TailoredVectors::excludes_candidate`] as a task that is compiled for the widest vector instructions
/// available.
struct TailoredVectorKernel<'a> {
    tailored: &'a TailoredVectors,
    limit: f64,
    terms: &'a [usize],
    coefficients: &'a [f64],
    memory: &'a mut NormCache,
}

impl simd::SimdKernel for TailoredVectorKernel<'_> {
    type Output = bool;

    #[inline(always)]
    fn run(self) -> bool {
        self.tailored.excludes_candidate(self.terms, self.coefficients, self.limit, self.memory)
    }
}

/// Arguments of [`LinearizedVectors::excludes_candidate`] as a task that is compiled for the widest vector instructions
/// available.
struct LinearizedVectorKernel<'a> {
    linearized_vectors: &'a LinearizedVectors,
    limit: f64,
    terms: &'a [usize],
    coefficients: &'a [f64],
    lookup: &'a mut VectorLookup,
}

impl simd::SimdKernel for LinearizedVectorKernel<'_> {
    type Output = bool;

    #[inline(always)]
    fn run(self) -> bool {
        self.linearized_vectors.excludes_candidate(self.terms, self.coefficients, self.limit, self.lookup)
    }
}

/// Workspace of one thread for the evaluation of candidates.
pub(crate) struct Scratch {
    norm_cache: NormCache,
    lookup: VectorLookup,
    infeasibility: InfeasibilityProof,
    /// Initial guess of the coefficients for the proof of infeasibility.
    start: Vec<f64>,
    least_squares: Solve<1>,
    simulation: BlockSimulation,
    /// Coefficients of the terms of the most recent candidate.
    coefficients: Vec<f64>,
    /// Coefficients of the initial terms of the most recent candidate, record by record.
    weights: Vec<f64>,
    /// Regressor columns (indices in the banks) of the terms of the current candidate.
    pub(crate) positions: Vec<usize>,
    /// Regressor columns (indices in the banks) of the initial terms of the current candidate.
    pub(crate) initial: Vec<usize>,
}

impl Default for Scratch {
    fn default() -> Self {
        Self {
            norm_cache: NormCache::default(),
            lookup: VectorLookup::default(),
            infeasibility: InfeasibilityProof::default(),
            start: Vec::new(),
            least_squares: Solve::new(),
            simulation: BlockSimulation::default(),
            coefficients: Vec::new(),
            weights: Vec::new(),
            positions: Vec::new(),
            initial: Vec::new(),
        }
    }
}

impl Problem {
    /// Build banks of regressors and Gram matrices for the regressors in `index`. The caller must check that the memory
    /// suffices.
    pub(crate) fn new(
        records: &[Record],
        output: usize,
        index: Index,
        fixed: &[Option<f64>],
        options: &Options,
        stop: &Stop,
    ) -> Result<Self> {
        if records.is_empty() {
            return Err(Error::Length { name: "records".into(), expected: 1, found: 0 });
        }
        options.check()?;
        check_finite("fixed coefficients", &fixed.iter().flatten().copied().collect::<Vec<_>>())?;
        if matches!(options.estimator, Estimator::MultiInnovation(innovation) if innovation.row_basis == RowBasis::Haar)
        {
            for record in records {
                operational_matrices::check_power_of_two(record.m())?;
            }
        }
        let width = index.keys().len();
        let refines = options.refines();
        // If other measured outputs entered as inputs, their noise would be ranked like an error of the equation.
        let banks = records
            .iter()
            .map(|r| {
                if refines {
                    Bank::new_interruptible(&index, &r.clean_record(), output, stop)
                } else {
                    Bank::new_interruptible(&index, r, output, stop)
                }
            })
            .collect::<Result<Vec<_>>>()?;
        let targets: Vec<Vec<f64>> = records.iter().map(|r| r.signal(output).to_vec()).collect();
        let samples = records.iter().map(Record::m).sum();
        let elements = (width + 1) * (width + 1);
        let mut sum = vec![0.0; elements];
        let mut unweighted = if options.ranks_by_gram_matrix() { vec![0.0; elements] } else { Vec::new() };
        let precisions = |squares: &[f64]| -> Vec<f64> {
            let precision = |&squares: &f64| match options.estimator {
                Estimator::LeastSquares | Estimator::InstrumentalVariables(_) => 0.0,
                Estimator::MultiInnovation(innovation) => innovation.prior.precision(squares),
            };
            squares.iter().map(precision).collect()
        };
        let mut squares = vec![0.0; width];
        let mut parts = Vec::new();
        for ((bank, target), record) in banks.iter().zip(&targets).zip(records) {
            let mut gram = if refines {
                let (bank, target) = start_bank(record, output, &index, stop)?;
                plain_gram(&bank, &target, stop)
            } else {
                plain_gram(bank, target, stop)
            };
            stop.check()?;
            unweighted.iter_mut().zip(&gram).for_each(|(s, g)| *s += g);
            let diagonal: Vec<f64> = (0..width).map(|p| gram[p * (width + 2)]).collect();
            squares.iter_mut().zip(&diagonal).for_each(|(s, g)| *s += g);
            if let Estimator::MultiInnovation(innovation) = options.estimator {
                apply_innovation_weights(&mut gram, bank, target, innovation)?;
            }
            sum.iter_mut().zip(&gram).for_each(|(s, g)| *s += g);
            if options.initial != Initial::Rest {
                parts.push(Normal::new(&gram, width, &precisions(&diagonal)));
            }
        }
        let weighted = matches!(options.estimator, Estimator::MultiInnovation(_));
        let least_squares =
            (options.ranks_by_gram_matrix() && weighted).then(|| Normal::new(&unweighted, width, &vec![0.0; width]));
        let refiner = match options.estimator {
            Estimator::InstrumentalVariables(settings) => Some(Refiner::new(records, output, &banks, settings, stop)),
            _ => None,
        };
        // The dual bound uses D e = w with denominator D, output error e and equation error w. It requires integrals of
        // the measured output.
        let bound_banks = if refines && options.pruning && options.criterion == Criterion::OutputError {
            records
                .iter()
                .map(|r| Bank::new_interruptible(&index, &r.clean_record_except(output), output, stop))
                .collect::<Result<_>>()?
        } else {
            Vec::new()
        };
        Ok(Self {
            index,
            banks,
            targets,
            equations: NormalEquations::new(Normal::new(&sum, width, &precisions(&squares)), parts, fixed),
            residual_sums: options
                .ranks_by_gram_matrix()
                .then(|| ResidualSumOfSquares::new(unweighted, width, samples, fixed.len(), options.weights())),
            least_squares,
            bound: None,
            tailored_vectors: None,
            unstable_zeros: None,
            linearized_vectors: None,
            refiner,
            bound_banks,
            options: options.clone(),
            samples,
        })
    }

    /// Build as many fixed test vectors as save time in a search over about `candidates` candidates. Runs on the
    /// current thread pool.
    pub(crate) fn with_bound(mut self, candidates: u64, stop: &Stop) -> Self {
        let banks = std::mem::take(&mut self.bound_banks);
        let (banks, transforms) = if self.refines() {
            (&banks, 4 * REFINEMENT_COST_TRANSFORMS)
        } else {
            (&self.banks, SIMULATION_COST_TRANSFORMS)
        };
        if self.options.pruning && self.residual_sums.is_none() && !banks.is_empty() {
            let output_error = self.options.criterion == Criterion::OutputError;
            let output_count = (0..self.index.keys().len()).filter(|&p| !banks[0].kernel(p).is_empty()).count() as u64;
            // Each test vector needs two transforms per output column. Its inner products cost about one transform.
            let effect_count = 2 * output_count + 4;
            #[allow(clippy::cast_possible_truncation)]
            let groups = (candidates.saturating_mul(transforms) / 4 / (effect_count * LANE_COUNT as u64))
                .min((Bound::MAX_TEST_VECTORS / LANE_COUNT) as u64) as usize;
            if groups > 0 {
                let data = (&banks[..], &self.targets[..]);
                self.bound = Some(Bound::new(data, self.options.norm, output_error, groups * LANE_COUNT, stop));
            }
        }
        self
    }

    /// Return true if coefficients are refined by instrumental variables after a first estimate.
    pub(crate) fn refines(&self) -> bool {
        self.refiner.is_some()
    }

    /// Return an empty set of tailored test vectors, and the memory of one such vector \[bytes\].
    pub(crate) fn empty_tailored_vectors(&self) -> (TailoredVectors, u64) {
        (TailoredVectors::new(&self.banks, &self.targets, self.options.norm), TailoredVectors::bytes(&self.banks))
    }

    /// Build the test vector tailored to the candidate with these columns, with zero initial conditions. `None` if the
    /// candidate is singular or a value overflows.
    pub(crate) fn tailor_vector(&self, tailored: &TailoredVectors, positions: &[usize]) -> Option<TailoredVector> {
        let coefficients = self.coefficients(positions)?;
        tailored.fit(&self.banks, &self.targets, positions, &coefficients)
    }

    /// Return true if these test vectors prove that the raw score (Σ|e| or Σe²) of the candidate with these columns
    /// exceeds `limit`.
    pub(crate) fn excluded_by_tailored(&self, tailored: &TailoredVectors, positions: &[usize], limit: f64) -> bool {
        let Some(coefficients) = self.coefficients(positions) else { return false };
        let mut memory = NormCache::default();
        simd::dispatch_simd(TailoredVectorKernel {
            tailored,
            limit,
            terms: positions,
            coefficients: &coefficients,
            memory: &mut memory,
        })
    }

    /// Return a set of linearized test vectors, by which lower bounds of the error are computed, without any vector.
    pub(crate) fn empty_linearized_vectors(&self) -> LinearizedVectors {
        LinearizedVectors::new(&self.banks, &self.targets, self.options.norm)
    }

    /// Build the linearized test vector of the candidate with these columns and coefficients, with zero initial
    /// conditions. `None` if the vector covers no sample or a value overflows.
    pub(crate) fn linearize_vector(
        &self,
        linearized_vectors: &LinearizedVectors,
        terms: &[usize],
        c: &[f64],
        limit: f64,
    ) -> Option<LinearizedVector> {
        linearized_vectors.fit((&self.banks, &self.targets), terms, c, limit)
    }

    /// Return those candidates, as columns and coefficients, that this vector does not exclude at this limit of the raw
    /// score (Σ|e| or Σe²).
    pub(crate) fn not_excluded_by(
        &self,
        linearized_vectors: &LinearizedVectors,
        linearized: &LinearizedVector,
        all: &[SolvedCandidate],
        limit: f64,
    ) -> Vec<SolvedCandidate> {
        all.iter()
            .filter(|(terms, c)| !linearized_vectors.vector_excludes(linearized, terms, c, limit))
            .cloned()
            .collect()
    }

    /// Build the test for unstable zeros if its tables fit into `spare_bytes` bytes. Return the memory used \[bytes\],
    /// 0 if the test is not built. Runs on the current thread pool.
    pub(crate) fn add_unstable_zeros(&mut self, spare_bytes: u64) -> u64 {
        let bytes = UnstableZeros::bytes(&self.banks);
        if bytes > spare_bytes || !UnstableZeros::is_affordable(&self.targets) {
            return 0;
        }
        self.unstable_zeros = Some(UnstableZeros::new(&self.banks, &self.targets, self.options.norm));
        bytes
    }

    /// Return the normal equations for the error bound of a box. If candidates are ranked by simulation, these
    /// equations determine the coefficients of the candidates. Otherwise they minimize the squared equation error.
    /// `None` with fixed coefficients or initial terms.
    pub(crate) fn box_equations(&self) -> Option<&Normal> {
        let equations = self.equations.unconstrained_equations()?;
        Some(self.least_squares.as_ref().unwrap_or(equations))
    }

    /// Solve the normal equations for the coefficients of the candidate with these columns, with zero initial
    /// conditions. `None` if the equations are singular.
    pub(crate) fn coefficients(&self, positions: &[usize]) -> Option<Vec<f64>> {
        let sources: Vec<Columns<1>> = positions.iter().map(|&p| Columns::new([p])).collect();
        let mut solve = Solve::new();
        let [singular] = self.equations.solve(&sources, &[], &mut solve);
        (!singular).then(|| solve.coefficients.iter().map(|c| c[0]).collect())
    }

    /// Return the Euclidean norm of the output over all records.
    pub(crate) fn size(&self) -> f64 {
        self.targets.iter().flatten().map(|y| y * y).sum::<f64>().sqrt()
    }

    /// Return the total number of samples of all records.
    pub(crate) fn samples(&self) -> usize {
        self.samples
    }

    /// Return the column number, in the banks, of the regressor that is the fractional integral of order `eta` of
    /// `signal`.
    pub(crate) fn position(&self, signal: usize, eta: f64) -> Result<usize> {
        self.index
            .get(Key::integral(signal, eta))
            .ok_or_else(|| Error::Internal { what: format!("no regressor of signal {signal} at order {eta}") })
    }

    /// Write the regressor columns (indices in the banks) of the initial terms of a structure to `out`.
    pub(crate) fn initial_positions(&self, structure: &Structure, out: &mut Vec<usize>) {
        out.clear();
        out.extend(
            structure
                .initial_exponents(&self.options.initial)
                .into_iter()
                .filter_map(|e| self.index.get(Key::initial(e))),
        );
    }

    /// Evaluate the candidate whose terms have the columns `positions` and whose initial terms have the columns
    /// `initial`. `limit` is a limit of the raw score (Σ|e| or Σe²).
    ///
    /// The coefficients are stored in `scratch`. If `tries_dual_bound` is true, the dual bound is tried before the
    /// simulation.
    pub(crate) fn evaluate(
        &self,
        positions: &[usize],
        initial: &[usize],
        limit: f64,
        tries_dual_bound: bool,
        scratch: &mut Scratch,
        control: &Control,
    ) -> Verdict {
        let sources: Vec<Columns<1>> = positions.iter().map(|&p| Columns::new([p])).collect();
        let Scratch {
            norm_cache: memory,
            lookup,
            infeasibility: proof,
            start,
            least_squares,
            simulation,
            coefficients,
            weights,
            ..
        } = scratch;
        let [singular] = self.equations.solve(&sources, initial, least_squares);
        if singular {
            return Verdict::Failed(Failure::Singular);
        }
        coefficients.clear();
        coefficients.extend(least_squares.coefficients.iter().map(|c| c[0]));
        weights.clear();
        weights.extend(least_squares.initial.iter().map(|c| c[0]));
        if let (Some(_), Some(bound), true) = (&self.refiner, &self.bound, limit < f64::INFINITY) {
            // Refinement may change the coefficients arbitrarily, so only a bound over all coefficients can exclude the
            // candidate.
            start.clear();
            start.extend(coefficients.iter().chain(weights.iter()));
            let (terms, fixed) = (positions, self.equations.fixed_coefficients());
            if simd::dispatch_simd(InfeasibilityKernel { bound, limit, terms, fixed, initial, start, proof }) {
                return Verdict::Bounded(limit);
            }
        }
        if let Some(refiner) = &self.refiner {
            let (data, column_indices) = ((&self.banks[..], &self.targets[..]), (positions, initial));
            let fixed = self.equations.fixed_coefficients();
            if let Err(failure) = refiner.refine(data, column_indices, fixed, coefficients, weights, &control.stop) {
                // A stop request invalidates the result.
                return if control.is_stopped() { Verdict::Stopped(0.0) } else { Verdict::Failed(failure) };
            }
        }
        let (coefficients, weights) = (&coefficients[..], &weights[..]);
        let of_record = |r: usize| &weights[r * initial.len()..(r + 1) * initial.len()];
        if let (true, Some(bound)) = (tries_dual_bound && limit < f64::INFINITY, &self.bound) {
            let columns = |r: usize| (positions, coefficients, initial, of_record(r));
            let (lowest, _) = simd::dispatch_simd(BoundKernel { bound, limit, columns });
            if lowest > limit {
                return Verdict::Bounded(lowest);
            }
        }
        if let (Some(tailored), true) = (&self.tailored_vectors, limit < f64::INFINITY)
            && simd::dispatch_simd(TailoredVectorKernel { tailored, limit, terms: positions, coefficients, memory })
        {
            return Verdict::Bounded(limit);
        }
        if let (Some(linearized_vectors), true) = (&self.linearized_vectors, limit < f64::INFINITY)
            && simd::dispatch_simd(LinearizedVectorKernel {
                linearized_vectors,
                limit,
                terms: positions,
                coefficients,
                lookup,
            })
        {
            return Verdict::Bounded(limit);
        }
        let norm = self.options.norm;
        let mut raw = 0.0;
        for (r, (bank, target)) in self.banks.iter().zip(&self.targets).enumerate() {
            let terms = positions.iter().copied().zip(coefficients.iter().copied());
            let starts = initial.iter().copied().zip(of_record(r).iter().copied());
            let column = |(p, c): (usize, f64)| (bank.column(p), c);
            let verdict = match self.options.criterion {
                Criterion::EquationError => {
                    simulation.residuals(target, terms.chain(starts).map(column), norm, raw, limit)
                }
                Criterion::OutputError => {
                    let output_terms =
                        terms.clone().map(|(p, c)| (bank.kernel(p), c)).filter(|(kernel, _)| !kernel.is_empty());
                    let input_terms = terms.filter(|&(p, _)| bank.kernel(p).is_empty()).chain(starts).map(column);
                    simulation.accumulate_error(target, output_terms, input_terms, norm, raw, limit, control)
                }
            };
            match verdict {
                Verdict::Score(sum) => raw = sum,
                other => return other,
            }
        }
        Verdict::Score(raw)
    }

    /// Return the score of a sum of absolute or squared errors in the selected norm.
    pub(crate) fn score(&self, raw: f64) -> f64 {
        self.options.norm.score(raw, self.samples)
    }

    /// Return the table row of the most recently evaluated candidate, with `initial` initial terms per record.
    pub(crate) fn row(&self, index: u64, raw: f64, initial: usize, scratch: &Scratch) -> Row {
        Row {
            index,
            score: raw,
            coefficients: scratch.coefficients.clone(),
            initial: (0..self.banks.len()).map(|r| scratch.weights[r * initial..(r + 1) * initial].to_vec()).collect(),
        }
    }

    /// Evaluate a single structure up to a limit of the raw score (Σ|e| or Σe²). Return its outcome and its table row.
    pub(crate) fn evaluate_structure(
        &self,
        structure: &Structure,
        limit: f64,
        scratch: &mut Scratch,
        control: &Control,
    ) -> Result<(Verdict, Row)> {
        let positions = (0..structure.terms.len())
            .map(|k| self.position(structure.terms[k].signal, structure.integration(k)))
            .collect::<Result<Vec<_>>>()?;
        let mut initial = Vec::new();
        self.initial_positions(structure, &mut initial);
        let verdict = self.evaluate(&positions, &initial, limit, true, scratch, control);
        let raw = if let Verdict::Score(raw) = verdict { raw } else { f64::INFINITY };
        let row = match verdict {
            Verdict::Failed(Failure::Singular) => {
                Row { index: 0, score: raw, coefficients: Vec::new(), initial: Vec::new() }
            }
            _ => self.row(0, raw, initial.len(), scratch),
        };
        Ok((verdict, row))
    }
}

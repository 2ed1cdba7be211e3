//! Evaluates the candidates of an order search: in parallel, ordered, stoppable, every one accounted for.
//!
//! Candidates stream by in rounds. All of a round get coefficients, several side by side, and those that a proved lower
//! bound excludes are done; the others are followed, likely ones first, each until its partial sum passes the worst
//! score kept: what is left out cannot be among the kept ones, so the table is that of brute force, ties by index.
//!
//! Rounds form waves of 1, 2, 4, … A round knows the rows kept before its wave and what it finds itself, nothing else,
//! so it comes to the same bits, counts too, wherever and whenever it is done: on any number of threads, on another
//! machine, or continued from a checkpoint.

use std::borrow::Cow;
use std::collections::HashSet;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use crate::dense;
use crate::equation::{grains, Initial, Structure, ORDER_GRAIN};
use crate::error::{check_length, Error, Result};
use crate::estimate::iv::Settings;
use crate::estimate::multi_innovation::{Innovation, Rows};
use crate::haar;
use crate::lanes::{self, Lanes, WIDTH};
use crate::regressors::{Bank, Index, Key, Record, BANK_LIMIT};
use crate::search::bound::{self, Bound, Reach};
use crate::search::instruments::{start_bank, Refiner};
use crate::search::lattice::{Cursor, Lattice};
use crate::series::{Division, BLOCK};
use crate::small::{packed, solve_lanes};

/// Candidates of one round where the Gram matrix alone ranks (16 ns each), where bounds screen (a microsecond or so), and
/// where every candidate is followed: a round is long enough to be worth sending away, and short enough to be lost.
const ROUND_PLAIN: u64 = 1 << 18;
const ROUND_BOUNDED: u64 = 1 << 16;
const ROUND_FOLLOWED: u64 = 1 << 12;
/// Pulses of all candidates followed between two checkpoints: a tenth of a second or so of one core.
const PIECE: usize = 1 << 21;
/// Candidates that a thread screens at a time.
const CHUNK: u64 = 512;
/// First and largest number of candidates followed between two looks at the kept scores.
const FOLLOWED: (u64, u64) = (256, 16_384);
/// Candidates tried beforehand, spread over the lattice: they choose the test vectors and give the first good score.
const SCOUTS: u64 = 2048;
/// Test vectors that a search works with.
const VECTORS: usize = 16;
/// Transforms that following one candidate is worth; making test vectors must stay below a fraction of all that.
const TRANSFORMS: u64 = 6;
/// The same where coefficients are refined: a few steps of a division and a dozen transforms each.
const REFINING: u64 = 100;
/// First and largest number of refined candidates followed between two looks at the kept scores: each takes about a
/// millisecond, and a lower score excludes many.
const REFINED: (u64, u64) = (32, 1024);
/// Candidates among which the most likely ones are refined beforehand: guesses are cheap, and what is kept of a good
/// part of the lattice excludes most of it.
const GUESSED: u64 = 1 << 18;
/// Failures listed one by one; the rest are only counted.
pub(crate) const LISTED: usize = 100;
/// Most threads a search starts.
pub const MAX_THREADS: usize = 1024;

/// Which error ranks the candidates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Criterion {
    /// e = y − ŷ, ŷ the free run.
    OutputError,
    /// ε = y − Σ c I^{α−ν} s, measured signals on the right-hand side.
    EquationError,
}

/// How an error becomes a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Norm {
    /// Σ|e| (paper (45)).
    L1,
    /// √(Σe²/M) (paper (46)).
    L2,
}

/// How a candidate gets its coefficients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Estimator {
    /// Least squares on the equation error.
    LeastSquares,
    /// Multi-innovation least squares in closed form.
    MultiInnovation(Innovation),
    /// Refined instrumental variables from the records' clean signals ([`Record::with_clean`]).
    InstrumentalVariables(Settings),
}

/// The settings of a search.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Which error ranks.
    pub criterion: Criterion,
    /// How it is summed.
    pub norm: Norm,
    /// Where coefficients come from.
    pub estimator: Estimator,
    /// Initial terms of each record.
    pub initial: Initial,
    /// How many rows to keep.
    pub keep: usize,
    /// Threads.
    pub threads: usize,
    /// Whether to leave a candidate as soon as it cannot be kept, by bound or partial sum; `false` is brute force, the
    /// oracle.
    pub early_stopping: bool,
}

/// Shared with the caller while a search runs.
#[derive(Debug, Default)]
pub struct Control {
    /// Set to end the search with [`Error::Interrupted`].
    pub stop: AtomicBool,
    /// Candidates dealt with so far.
    pub done: AtomicU64,
    /// Candidates in all, once known.
    pub total: AtomicU64,
    /// Candidates among those done that were left before the end of the record.
    pub pruned: AtomicU64,
    /// Set by a caller that takes checkpoints.
    pub saving: AtomicBool,
    /// The latest checkpoint that the caller has not taken yet.
    pub checkpoint: Mutex<Option<Checkpoint>>,
}

impl Control {
    /// Leaves a checkpoint; rows of one that was not taken are passed on.
    fn save(&self, mut checkpoint: Checkpoint) {
        let mut slot = self.checkpoint.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(missed) = slot.take() {
            checkpoint.part.rows.extend(missed.part.rows);
        }
        *slot = Some(checkpoint);
    }

    /// Takes the latest checkpoint.
    pub fn take(&self) -> Option<Checkpoint> {
        self.checkpoint.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

/// Why a candidate has no score.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Failure {
    /// Its regressors are linearly dependent to working precision.
    Singular,
    /// Its free run left the range of floating point.
    Diverged,
}

/// One kept candidate.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Index in the lattice.
    pub index: u64,
    /// Score in the norm asked for, summed over records.
    pub score: f64,
    /// One coefficient a term.
    pub coefficients: Vec<f64>,
    /// Coefficients of the initial terms, per record, in the order of the structure's exponents.
    pub initial: Vec<Vec<f64>>,
}

/// What became of the candidates: `kept + beaten + bounded + stopped + singular + diverged = candidates`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// All.
    pub candidates: u64,
    /// In the table.
    pub kept: u64,
    /// Evaluated to the end and not kept.
    pub beaten: u64,
    /// Excluded by a lower bound of their score, without a run.
    pub bounded: u64,
    /// Left before the end because their partial sum could no longer be kept.
    pub stopped: u64,
    /// Without coefficients.
    pub singular: u64,
    /// Without a finite response.
    pub diverged: u64,
}

/// The result of a search.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Kept rows, best first, ties by index.
    pub rows: Vec<Row>,
    /// What became of all.
    pub counts: Counts,
    /// The first failures by index, at most 100.
    pub failures: Vec<(u64, Failure)>,
}

/// What some rounds came to.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Part {
    /// Their best rows, as many as are kept; scores are raw sums (Σ|e| or Σe²).
    pub rows: Vec<Row>,
    /// What became of their candidates. None is kept yet: the rows count as beaten.
    pub counts: Counts,
    /// Their first failures by index, at most 100.
    pub failures: Vec<(u64, Failure)>,
}

impl Part {
    /// Takes in what other rounds came to.
    pub fn join(&mut self, other: Self, keep: usize) {
        self.rows.extend(other.rows);
        trim(&mut self.rows, keep);
        self.counts.add(&other.counts);
        self.failures.extend(other.failures);
        self.failures.sort_unstable();
        self.failures.truncate(LISTED);
    }

    /// Index and raw score of each row: what later rounds need to know.
    #[must_use]
    pub fn seed(&self) -> Vec<(u64, f64)> {
        self.rows.iter().map(|row| (row.index, row.score)).collect()
    }

    /// The result of a search, from all of its rounds over records of so many samples.
    #[must_use]
    pub fn outcome(mut self, norm: Norm, samples: usize) -> Outcome {
        self.counts.kept = self.rows.len() as u64;
        self.counts.beaten = self.counts.beaten.saturating_sub(self.counts.kept);
        for row in &mut self.rows {
            row.score = score(norm, row.score, samples);
        }
        Outcome { rows: self.rows, counts: self.counts, failures: self.failures }
    }
}

impl Counts {
    fn add(&mut self, other: &Self) {
        for (sum, n) in [
            (&mut self.candidates, other.candidates),
            (&mut self.kept, other.kept),
            (&mut self.beaten, other.beaten),
            (&mut self.bounded, other.bounded),
            (&mut self.stopped, other.stopped),
            (&mut self.singular, other.singular),
            (&mut self.diverged, other.diverged),
        ] {
            *sum = sum.saturating_add(n);
        }
    }

    /// Candidates dealt with.
    #[must_use]
    pub fn done(&self) -> u64 {
        [self.kept, self.beaten, self.bounded, self.stopped, self.singular, self.diverged]
            .iter()
            .fold(0, |sum, n| sum.saturating_add(*n))
    }
}

/// Where a stretch of rounds stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Number of the round; those of the stretch before it are done.
    pub round: u64,
    /// How many of its open candidates have been followed, in order of visiting.
    pub followed: u64,
    /// End and length of the batch that this lies in; 0 if the round has not been screened.
    pub end: u64,
    /// See `end`.
    pub size: u64,
    /// The limit of that batch.
    pub limit: f64,
}

impl Place {
    fn start(round: u64) -> Self {
        Self { round, followed: 0, end: 0, size: 0, limit: f64::INFINITY }
    }
}

/// A stretch of rounds, half done.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    /// Where it stands.
    pub place: Place,
    /// What it came to so far. A checkpoint that is taken holds only the rows found since the one before; one to go on
    /// from must hold all of them.
    pub part: Part,
}

/// What one candidate came to, in raw sums (Σ|e| or Σe²).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// Run to the end.
    Score(f64),
    /// Not run: this lower bound is above the limit.
    Bounded(f64),
    /// Left at this partial sum, above the limit.
    Stopped(f64),
    /// It has no score.
    Failed(Failure),
}

/// Everything the candidates of one equation share.
pub(crate) struct Problem {
    index: Index,
    banks: Vec<Bank>,
    targets: Vec<Vec<f64>>,
    terms: Normal,
    /// Per record, for its initial terms; empty at rest.
    parts: Vec<Normal>,
    /// Where the equation error in squares ranks: its own Gram matrix, without weights and prior.
    plain: Option<Plain>,
    bound: Option<Bound>,
    refiner: Option<Refiner>,
    /// Where coefficients are refined: the banks that the bound speaks of, until it is made.
    bound_banks: Vec<Bank>,
    fixed: Vec<Option<f64>>,
    /// Terms whose coefficients are estimated.
    free: Vec<usize>,
    options: Options,
    samples: usize,
}

/// Normal equations over a bank's columns, weighted as the estimator asks, scaled to a diagonal of ones.
struct Normal {
    width: usize,
    /// Correlation matrix, row-major width × width; rows of columns that vanish are 0.
    correlation: Vec<f64>,
    rhs: Vec<f64>,
    /// Size of each column, and its inverse or 0.
    size: Vec<f64>,
    inverse: Vec<f64>,
}

impl Normal {
    /// From a Gram matrix over columns and target, (width + 1)² row-major, and what the prior adds to its diagonal.
    fn new(gram: &[f64], width: usize, prior: f64) -> Self {
        let stride = width + 1;
        let diagonal = |p: usize| gram[p * stride + p] + prior;
        let size: Vec<f64> = (0..width)
            .map(|p| if diagonal(p) > 0.0 && diagonal(p).is_finite() { diagonal(p).sqrt() } else { 0.0 })
            .collect();
        let inverse: Vec<f64> = size.iter().map(|&s| if s > 0.0 { 1.0 / s } else { 0.0 }).collect();
        let mut correlation = vec![0.0; width * width];
        for p in 0..width {
            for q in (0..width).filter(|&q| inverse[p] > 0.0 && inverse[q] > 0.0) {
                correlation[p * width + q] = if p == q { 1.0 } else { gram[p * stride + q] * inverse[p] * inverse[q] };
            }
        }
        let rhs = (0..width).map(|p| gram[p * stride + width] * inverse[p]).collect();
        Self { width, correlation, rhs, size, inverse }
    }
}

/// Gram matrix of columns and target summed over records, and the norms on its diagonal.
struct Plain {
    stride: usize,
    gram: Vec<f64>,
    /// Its diagonal, and the roots of that.
    diagonal: Vec<f64>,
    norms: Vec<f64>,
    /// What rounding may add to a squared sum, per unit of the squared sum of norms.
    unit: f64,
}

/// Memory of a solve of L candidates side by side.
struct Solve<const L: usize> {
    gram: Vec<Lanes<L>>,
    /// Right-hand side, then the scaled solution.
    rhs: Vec<Lanes<L>>,
    coefficients: Vec<Lanes<L>>,
    /// Coefficients of the initial terms, record by record.
    initial: Vec<Lanes<L>>,
}

impl<const L: usize> Solve<L> {
    fn new() -> Self {
        Self { gram: Vec::new(), rhs: Vec::new(), coefficients: Vec::new(), initial: Vec::new() }
    }
}

/// Memory of a screening of L candidates side by side.
struct Screen<const L: usize> {
    solve: Solve<L>,
    positions: Vec<Columns<L>>,
    initial: Vec<usize>,
    /// Columns of the candidate that comes next.
    terms: Vec<usize>,
    /// One candidate's columns, coefficients and initial terms.
    columns: Vec<usize>,
    coefficients: Vec<f64>,
    weights: Vec<f64>,
}

impl<const L: usize> Screen<L> {
    fn new(width: usize) -> Self {
        Self {
            solve: Solve::new(),
            positions: vec![Columns::new([0; L]); width],
            initial: Vec::new(),
            terms: vec![0; width],
            columns: vec![0; width],
            coefficients: vec![0.0; width],
            weights: Vec::new(),
        }
    }
}

/// [`Bound::evaluate`] as a kernel.
struct Bounding<'a, F> {
    bound: &'a Bound,
    limit: f64,
    columns: F,
}

impl<'a, F> lanes::Kernel for Bounding<'a, F>
where
    F: Fn(usize) -> (&'a [usize], &'a [f64], &'a [usize], &'a [f64]),
{
    type Output = (f64, f64);

    #[inline(always)]
    fn run(self) -> (f64, f64) {
        self.bound.evaluate(self.limit, self.columns)
    }
}

/// [`Bound::excludes`] as a kernel.
struct Excluding<'a> {
    bound: &'a Bound,
    limit: f64,
    terms: &'a [usize],
    fixed: &'a [Option<f64>],
    initial: &'a [usize],
    start: &'a [f64],
    reach: &'a mut Reach,
}

impl lanes::Kernel for Excluding<'_> {
    type Output = bool;

    #[inline(always)]
    fn run(self) -> bool {
        self.bound.excludes(self.limit, self.terms, self.fixed, self.initial, self.start, self.reach)
    }
}

/// Memory of one thread.
pub(crate) struct Scratch {
    reach: Reach,
    start: Vec<f64>,
    one: Solve<1>,
    divisor: Vec<f64>,
    block: Vec<f64>,
    division: Option<Division>,
    /// Coefficients of the last candidate's terms, and of its initial terms by record.
    pub(crate) coefficients: Vec<f64>,
    weights: Vec<f64>,
    positions: Vec<usize>,
    initial: Vec<usize>,
}

impl Scratch {
    pub(crate) fn new() -> Self {
        Self {
            reach: Reach::default(),
            start: Vec::new(),
            one: Solve::new(),
            divisor: Vec::new(),
            block: vec![0.0; BLOCK],
            division: None,
            coefficients: Vec::new(),
            weights: Vec::new(),
            positions: Vec::new(),
            initial: Vec::new(),
        }
    }
}

impl Problem {
    /// Builds banks and Gram matrices for the regressors in `index`.
    pub(crate) fn new(
        records: &[Record],
        output: usize,
        index: Index,
        fixed: &[Option<f64>],
        options: &Options,
    ) -> Result<Self> {
        if records.is_empty() {
            return Err(Error::Length { name: "records".into(), expected: 1, found: 0 });
        }
        if options.keep == 0 {
            return Err(out_of_range("keep", 0.0, "[1, ∞)", "keep at least one row"));
        }
        if let Estimator::MultiInnovation(innovation) = options.estimator {
            innovation.check()?;
            if innovation.rows == Rows::Haar {
                for record in records {
                    haar::check_power_of_two(record.m())?;
                }
            }
        }
        let width = index.keys().len();
        // Banks refuse for themselves; products of all columns may need far more.
        let bytes = 8 * (3 + records.len() as u128) * (width as u128 + 1).pow(2);
        if bytes > BANK_LIMIT {
            let m = records.iter().map(Record::m).max().unwrap_or(0);
            return Err(Error::BankTooLarge { columns: width, m, bytes, limit: BANK_LIMIT });
        }
        let refined = matches!(options.estimator, Estimator::InstrumentalVariables(_));
        // Noise of a measured output that drives an equation would rank like a fault of the equation.
        let banks = records
            .iter()
            .map(|r| if refined { Bank::new(&index, &r.cleaned(), output) } else { Bank::new(&index, r, output) })
            .collect::<Result<Vec<_>>>()?;
        let targets: Vec<Vec<f64>> = records.iter().map(|r| r.signal(output).to_vec()).collect();
        let samples = records.iter().map(Record::m).sum();
        let squares = (width + 1) * (width + 1);
        let (mut sum, mut unweighted) = (vec![0.0; squares], Vec::new());
        let prior = match options.estimator {
            Estimator::LeastSquares | Estimator::InstrumentalVariables(_) => 0.0,
            Estimator::MultiInnovation(innovation) => 1.0 / innovation.prior_covariance,
        };
        let plain = options.early_stopping
            && !refined
            && options.criterion == Criterion::EquationError
            && options.norm == Norm::L2
            && options.initial == Initial::Rest;
        if plain {
            unweighted = vec![0.0; squares];
        }
        let mut parts = Vec::new();
        for ((bank, target), record) in banks.iter().zip(&targets).zip(records) {
            let mut gram = if refined {
                let (bank, target) = start_bank(record, output, &index)?;
                plain_gram(&bank, &target)
            } else {
                plain_gram(bank, target)
            };
            unweighted.iter_mut().zip(&gram).for_each(|(s, g)| *s += g);
            if let Estimator::MultiInnovation(innovation) = options.estimator {
                weigh(&mut gram, bank, target, innovation)?;
            }
            sum.iter_mut().zip(&gram).for_each(|(s, g)| *s += g);
            if options.initial != Initial::Rest {
                parts.push(Normal::new(&gram, width, prior));
            }
        }
        #[allow(clippy::cast_precision_loss)]
        let plain = plain.then(|| Plain {
            stride: width + 1,
            diagonal: (0..=width).map(|p| unweighted[p * (width + 2)]).collect(),
            norms: (0..=width).map(|p| unweighted[p * (width + 2)].max(0.0).sqrt()).collect(),
            gram: unweighted,
            unit: 4.0 * f64::EPSILON * samples as f64,
        });
        let refiner = match options.estimator {
            Estimator::InstrumentalVariables(settings) => Some(Refiner::new(records, output, &banks, settings)),
            _ => None,
        };
        // D e = w holds for integrals of the output as it was measured.
        let bound_banks = if refined && options.early_stopping && options.criterion == Criterion::OutputError {
            records.iter().map(|r| Bank::new(&index, &r.cleaned_but(output), output)).collect::<Result<_>>()?
        } else {
            Vec::new()
        };
        Ok(Self {
            index,
            banks,
            targets,
            refiner,
            terms: Normal::new(&sum, width, prior),
            parts,
            plain,
            bound: None,
            bound_banks,
            fixed: fixed.to_vec(),
            free: (0..fixed.len()).filter(|&k| fixed[k].is_none()).collect(),
            options: options.clone(),
            samples,
        })
    }

    /// Makes test vectors for about this many candidates, as far as they pay; on the current thread pool.
    pub(crate) fn with_bound(mut self, candidates: u64) -> Self {
        let banks = std::mem::take(&mut self.bound_banks);
        let (banks, transforms) =
            if self.refiner.is_some() { (&banks, 4 * REFINING) } else { (&self.banks, TRANSFORMS) };
        if self.options.early_stopping && self.plain.is_none() && !banks.is_empty() {
            let output_error = self.options.criterion == Criterion::OutputError;
            let own = (0..self.index.keys().len()).filter(|&p| !banks[0].kernel(p).is_empty()).count() as u64;
            // Two transforms for each own column and test vector; the products cost as much as a transform or so.
            let each = 2 * own + 4;
            #[allow(clippy::cast_possible_truncation)]
            let groups =
                (candidates * transforms / 4 / (each * WIDTH as u64)).min((bound::POOL / WIDTH) as u64) as usize;
            if groups > 0 {
                self.bound = Some(Bound::new(banks, &self.targets, self.options.norm, output_error, groups * WIDTH));
            }
        }
        self
    }

    /// Position of I^{α−ν} s in the banks.
    pub(crate) fn position(&self, signal: usize, eta: f64) -> Result<usize> {
        self.index
            .get(Key::integral(signal, eta))
            .ok_or_else(|| Error::Internal { what: format!("no regressor of signal {signal} at order {eta}") })
    }

    /// Positions of the initial terms of a structure.
    fn initial_positions(&self, structure: &Structure, out: &mut Vec<usize>) {
        out.clear();
        out.extend(
            structure
                .initial_exponents(&self.options.initial)
                .into_iter()
                .filter_map(|e| self.index.get(Key::initial(e))),
        );
    }

    /// Evaluates a structure given the positions of its terms; leaves its coefficients in the scratch.
    ///
    /// `bounded` tells whether the bound, where there is one, is asked first.
    pub(crate) fn evaluate(
        &self,
        positions: &[usize],
        initial: &[usize],
        limit: f64,
        bounded: bool,
        scratch: &mut Scratch,
        control: &Control,
    ) -> Verdict {
        let sources: Vec<Columns<1>> = positions.iter().map(|&p| Columns::new([p])).collect();
        let [singular] = self.solve(&sources, initial, &mut scratch.one);
        if singular {
            return Verdict::Failed(Failure::Singular);
        }
        scratch.coefficients.clear();
        scratch.coefficients.extend(scratch.one.coefficients.iter().map(|c| c[0]));
        scratch.weights.clear();
        scratch.weights.extend(scratch.one.initial.iter().map(|c| c[0]));
        if let (Some(_), Some(bound), true) = (&self.refiner, &self.bound, limit < f64::INFINITY) {
            // The refinement may change the coefficients in any way: only what holds of all of them excludes.
            let Scratch { reach, start, coefficients, weights, .. } = scratch;
            start.clear();
            start.extend(coefficients.iter().chain(weights.iter()));
            let (terms, fixed) = (positions, &self.fixed[..]);
            if lanes::widest(Excluding { bound, limit, terms, fixed, initial, start, reach }) {
                return Verdict::Bounded(limit);
            }
        }
        if let Some(refiner) = &self.refiner {
            let (coefficients, weights) = (&mut scratch.coefficients, &mut scratch.weights);
            let (data, places) = ((&self.banks[..], &self.targets[..]), (positions, initial));
            if let Err(failure) = refiner.refine(data, places, &self.fixed, coefficients, weights) {
                return Verdict::Failed(failure);
            }
        }
        if let (true, Some(bound)) = (bounded && limit < f64::INFINITY, &self.bound) {
            let (weights, n) = (&scratch.weights, initial.len());
            let columns = |r: usize| (positions, &scratch.coefficients[..], initial, &weights[r * n..(r + 1) * n]);
            let (lowest, _) = lanes::widest(Bounding { bound, limit, columns });
            if lowest > limit {
                return Verdict::Bounded(lowest);
            }
        }
        let mut raw = 0.0;
        for r in 0..self.banks.len() {
            let first = r * initial.len();
            let verdict = match self.options.criterion {
                Criterion::EquationError => self.residuals(r, positions, initial, first, limit, raw, scratch),
                Criterion::OutputError => self.march(r, positions, initial, first, limit, raw, scratch, control),
            };
            match verdict {
                Verdict::Score(sum) => raw = sum,
                other => return other,
            }
        }
        Verdict::Score(raw)
    }

    /// Coefficients of L candidates from the normal equations; flags those that are singular.
    ///
    /// `positions` gives the column of each term per candidate; the initial terms are those of all.
    #[inline(always)]
    fn solve<const L: usize>(&self, positions: &[Columns<L>], initial: &[usize], solve: &mut Solve<L>) -> [bool; L] {
        let normal = &self.terms;
        let (free, width) = (self.free.len(), normal.width);
        let k = free + initial.len() * self.parts.len();
        let zero = [0.0; L];
        let Solve { gram, rhs, coefficients, initial: weights } = solve;
        gram.clear();
        gram.resize(packed(k, 0), zero);
        rhs.clear();
        rhs.resize(k, zero);
        for (a, &ta) in self.free.iter().enumerate() {
            let rows = &positions[ta];
            for (b, &tb) in self.free[..=a].iter().enumerate() {
                gram[packed(a, b)] = rows.with(&positions[tb], &normal.correlation, width);
            }
            rhs[a] = rows.of(&normal.rhs);
            for (columns, fixed) in positions.iter().zip(&self.fixed) {
                if let Some(value) = *fixed {
                    let (size, known) = (columns.of(&normal.size), rows.with(columns, &normal.correlation, width));
                    (0..L).for_each(|n| rhs[a][n] -= value * size[n] * known[n]);
                }
            }
        }
        for (r, part) in self.parts.iter().enumerate() {
            for (i, &e) in initial.iter().enumerate() {
                let a = free + r * initial.len() + i;
                let row = &part.correlation[e * width..(e + 1) * width];
                for (b, &tb) in self.free.iter().enumerate() {
                    // This record's share of a term's column, against the size that the column has on all.
                    let columns = &positions[tb];
                    let (c, size, all) = (columns.of(row), columns.of(&part.size), columns.of(&normal.inverse));
                    gram[packed(a, b)] = std::array::from_fn(|n| c[n] * size[n] * all[n]);
                }
                for (j, &f) in initial[..=i].iter().enumerate() {
                    gram[packed(a, free + r * initial.len() + j)] = [row[f]; L];
                }
                rhs[a] = [part.rhs[e]; L];
                for (columns, fixed) in positions.iter().zip(&self.fixed) {
                    if let Some(value) = *fixed {
                        let (size, known) = (columns.of(&part.size), columns.of(row));
                        (0..L).for_each(|n| rhs[a][n] -= value * size[n] * known[n]);
                    }
                }
            }
        }
        let singular = solve_lanes(gram, rhs, free);
        coefficients.clear();
        let mut next = 0;
        for (columns, fixed) in positions.iter().zip(&self.fixed) {
            coefficients.push(match *fixed {
                Some(value) => [value; L],
                None => {
                    let scale = columns.of(&normal.inverse);
                    let x = rhs[next];
                    next += 1;
                    let mut out = [0.0; L];
                    for n in 0..L {
                        out[n] = x[n] * scale[n];
                    }
                    out
                }
            });
        }
        weights.clear();
        for (r, part) in self.parts.iter().enumerate() {
            for (i, &e) in initial.iter().enumerate() {
                let x = rhs[free + r * initial.len() + i];
                weights.push(std::array::from_fn(|n| x[n] * part.inverse[e]));
            }
        }
        singular
    }

    /// Adds |e| or e² of a block to a partial sum.
    fn add(&self, raw: f64, measured: &[f64], response: &[f64]) -> f64 {
        let pairs = measured.iter().zip(response);
        raw + match self.options.norm {
            Norm::L1 => pairs.map(|(y, v)| (y - v).abs()).sum::<f64>(),
            Norm::L2 => pairs.map(|(y, v)| (y - v) * (y - v)).sum::<f64>(),
        }
    }

    #[allow(clippy::too_many_arguments)]
    fn residuals(
        &self,
        r: usize,
        positions: &[usize],
        initial: &[usize],
        first: usize,
        limit: f64,
        mut raw: f64,
        scratch: &mut Scratch,
    ) -> Verdict {
        let bank = &self.banks[r];
        let target = &self.targets[r];
        for lo in (0..target.len()).step_by(BLOCK) {
            let hi = (lo + BLOCK).min(target.len());
            let block = &mut scratch.block[..hi - lo];
            block.fill(0.0);
            for (&p, &c) in positions.iter().zip(&scratch.coefficients) {
                block.iter_mut().zip(&bank.column(p)[lo..hi]).for_each(|(b, v)| *b += c * v);
            }
            for (i, &p) in initial.iter().enumerate() {
                let c = scratch.weights[first + i];
                block.iter_mut().zip(&bank.column(p)[lo..hi]).for_each(|(b, v)| *b += c * v);
            }
            raw = self.add(raw, &target[lo..hi], block);
            if !raw.is_finite() {
                return Verdict::Failed(Failure::Diverged);
            }
            if raw > limit {
                return Verdict::Stopped(raw);
            }
        }
        Verdict::Score(raw)
    }

    /// Marches ŷ = N/D block by block, leaving as soon as the partial sum passes the limit.
    #[allow(clippy::too_many_arguments)]
    fn march(
        &self,
        r: usize,
        positions: &[usize],
        initial: &[usize],
        first: usize,
        limit: f64,
        mut raw: f64,
        scratch: &mut Scratch,
        control: &Control,
    ) -> Verdict {
        let bank = &self.banks[r];
        let target = &self.targets[r];
        let m = target.len();
        let Scratch { weights, divisor, block, division, coefficients, .. } = scratch;
        // Records may differ in length; a division is kept for one.
        let division = match division {
            Some(d) if d.terms() == m => {
                d.reset();
                d
            }
            other => other.insert(Division::new(1, m)),
        };
        divisor.clear();
        let mut inverse = [0.0];
        while division.solved() < m {
            let lo = division.solved();
            let hi = (lo + BLOCK).min(m);
            let from = divisor.len();
            let needed = division.reads().max(from);
            divisor.resize(needed, 0.0);
            for (&p, &c) in positions.iter().zip(coefficients.iter()) {
                let kernel = bank.kernel(p);
                if !kernel.is_empty() {
                    divisor[from..].iter_mut().zip(&kernel[from..needed]).for_each(|(d, v)| *d -= c * v);
                }
            }
            if from == 0 {
                divisor[0] += 1.0;
                if divisor[0] == 0.0 || !divisor[0].is_finite() {
                    return Verdict::Failed(Failure::Singular);
                }
                inverse[0] = 1.0 / divisor[0];
            }
            let block = &mut block[..hi - lo];
            block.fill(0.0);
            for (&p, &c) in positions.iter().zip(coefficients.iter()) {
                if bank.kernel(p).is_empty() {
                    block.iter_mut().zip(&bank.column(p)[lo..hi]).for_each(|(b, v)| *b += c * v);
                }
            }
            for (i, &p) in initial.iter().enumerate() {
                let c = weights[first + i];
                block.iter_mut().zip(&bank.column(p)[lo..hi]).for_each(|(b, v)| *b += c * v);
            }
            division.add(0, lo, block);
            division.solve_block(&inverse, |_, _, len| &divisor[..len]);
            raw = self.add(raw, &target[lo..hi], &division.quotient(0)[lo..hi]);
            if !raw.is_finite() {
                return Verdict::Failed(Failure::Diverged);
            }
            // Written so that the interrupted candidate is never taken for a scored one.
            if raw > limit || control.stop.load(Ordering::Relaxed) {
                return Verdict::Stopped(raw);
            }
            division.join(|_, _, len| &divisor[..len]);
        }
        Verdict::Score(raw)
    }

    /// A raw sum in the norm asked for.
    pub(crate) fn score(&self, raw: f64) -> f64 {
        score(self.options.norm, raw, self.samples)
    }

    fn row(&self, index: u64, raw: f64, initial: usize, scratch: &Scratch) -> Row {
        Row {
            index,
            score: raw,
            coefficients: scratch.coefficients.clone(),
            initial: (0..self.banks.len()).map(|r| scratch.weights[r * initial..(r + 1) * initial].to_vec()).collect(),
        }
    }

    /// Evaluates a structure on its own: the row it makes.
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

fn out_of_range(name: &str, value: f64, range: &str, remedy: &str) -> Error {
    Error::OutOfRange { name: name.into(), value, range: range.into(), remedy: remedy.into() }
}

/// Columns of one term of L candidates.
#[derive(Debug, Clone, Copy)]
struct Columns<const L: usize> {
    at: [usize; L],
    /// Whether they are all one, and whether each is the next one.
    same: bool,
    run: bool,
}

impl<const L: usize> Columns<L> {
    fn new(at: [usize; L]) -> Self {
        Self { at, same: L == 1, run: false }
    }

    #[inline(always)]
    fn compare(&mut self) {
        let first = self.at[0];
        self.same = self.at.iter().all(|&p| p == first);
        self.run = !self.same && self.at.iter().enumerate().all(|(n, &p)| p == first + n);
    }

    /// Elements of a vector at these columns.
    #[inline(always)]
    fn of(&self, vector: &[f64]) -> Lanes<L> {
        if self.same {
            [vector[self.at[0]]; L]
        } else if self.run {
            part_of(&vector[self.at[0]..])
        } else {
            let mut out = [0.0; L];
            out.iter_mut().zip(&self.at).for_each(|(x, &p)| *x = vector[p]);
            out
        }
    }

    /// Elements of a symmetric matrix (row-major) at these columns and those rows.
    #[inline(always)]
    fn with(&self, rows: &Self, matrix: &[f64], stride: usize) -> Lanes<L> {
        if rows.same {
            self.of(&matrix[rows.at[0] * stride..(rows.at[0] + 1) * stride])
        } else if self.same {
            rows.of(&matrix[self.at[0] * stride..(self.at[0] + 1) * stride])
        } else {
            let mut out = [0.0; L];
            for n in 0..L {
                out[n] = matrix[rows.at[n] * stride + self.at[n]];
            }
            out
        }
    }
}

/// The first L elements.
#[inline(always)]
fn part_of<T: Copy, const L: usize>(values: &[T]) -> [T; L] {
    let mut out = [values[0]; L];
    out.copy_from_slice(&values[..L]);
    out
}

/// Gram matrix of a bank's columns and the target, (columns + 1)² row-major.
fn plain_gram(bank: &Bank, target: &[f64]) -> Vec<f64> {
    let mut columns: Vec<&[f64]> = (0..bank.len()).map(|i| bank.column(i)).collect();
    columns.push(target);
    dense::gram(&columns)
}

/// Gives a Gram matrix multi-innovation weights: p on all rows but the last p − 1.
#[allow(clippy::cast_precision_loss)]
fn weigh(gram: &mut [f64], bank: &Bank, target: &[f64], innovation: Innovation) -> Result<()> {
    let width = bank.len() + 1;
    // Φ is orthogonal: the unweighted Gram matrix is the same in Haar coordinates.
    let m = target.len();
    let tail = innovation.length.min(m) - 1;
    gram.iter_mut().for_each(|g| *g *= innovation.length.min(m) as f64);
    let mut rows = vec![vec![0.0; width]; tail];
    for j in 0..width {
        let mut values = if j < bank.len() { bank.column(j) } else { target }.to_vec();
        if innovation.rows == Rows::Haar {
            haar::transform(&mut values)?;
        }
        for (t, row) in rows.iter_mut().enumerate() {
            row[j] = values[m - 1 - t];
        }
    }
    for (t, row) in rows.iter().enumerate() {
        // Row m−1−t is used by t+1 steps instead of p.
        let excess = (innovation.length.min(m) - 1 - t) as f64;
        for (i, &x) in row.iter().enumerate() {
            for (j, &y) in row.iter().enumerate() {
                gram[i * width + j] -= excess * x * y;
            }
        }
    }
    Ok(())
}

/// Adds all regressors that structures of this α with these term orders need.
pub(crate) fn index_orders(
    index: &mut Index,
    seen: &mut HashSet<(i64, usize, i64)>,
    alpha: f64,
    signal: usize,
    order: f64,
    initial: &Initial,
) {
    if seen.insert((grains(alpha), signal, grains(order))) {
        index.insert(Key::integral(signal, alpha - order));
        if *initial == Initial::Caputo {
            let mut i = 0.0;
            while i < order - ORDER_GRAIN {
                index.insert(Key::initial(alpha - order + i));
                i += 1.0;
            }
        }
    }
}

/// Adds the initial terms that every structure of this α needs.
pub(crate) fn index_alpha(index: &mut Index, alpha: f64, initial: &Initial) {
    match initial {
        Initial::Rest => {}
        Initial::Powers(powers) => powers.iter().for_each(|&e| {
            index.insert(Key::initial(e));
        }),
        Initial::Caputo => {
            let mut i = 0.0;
            while i < alpha - ORDER_GRAIN {
                index.insert(Key::initial(i));
                i += 1.0;
            }
        }
    }
}

/// A thread pool of its own for one search: a global one hangs after a fork.
pub(crate) fn pool(threads: usize) -> Result<rayon::ThreadPool> {
    if threads == 0 || threads > MAX_THREADS {
        #[allow(clippy::cast_precision_loss)]
        return Err(out_of_range("threads", threads as f64, "[1, 1024]", "use about the number of cores"));
    }
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|i| format!("ftlm-search-{i}"))
        .build()
        .map_err(|e| Error::Threads { threads, why: e.to_string() })
}

/// One scratch a thread.
pub(crate) struct Scratches(Vec<Mutex<Scratch>>);

impl Scratches {
    pub(crate) fn new(threads: usize) -> Self {
        Self((0..threads).map(|_| Mutex::new(Scratch::new())).collect())
    }

    pub(crate) fn with<T>(&self, work: impl FnOnce(&mut Scratch) -> T) -> T {
        let thread = rayon::current_thread_index().unwrap_or(0) % self.0.len();
        let mut scratch = self.0[thread].lock().unwrap_or_else(PoisonError::into_inner);
        work(&mut scratch)
    }
}

/// An order of visiting that spreads any first part of it over the whole range.
#[allow(clippy::cast_precision_loss)]
fn spread(index: u64) -> f64 {
    (index as f64 * 0.618_033_988_75).fract()
}

/// Visits 0 … count−1 once each, spread over the whole range from the start.
fn visit(count: u64) -> impl Fn(u64) -> u64 {
    // The golden section spreads any prefix evenly; the next stride coprime with the count visits all.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    let mut stride = ((count as f64 * 0.618_033_988_75) as u64).max(1);
    while gcd(stride, count) != 1 {
        stride += 1;
    }
    move |i| {
        #[allow(clippy::cast_possible_truncation)]
        let index = (u128::from(i) * u128::from(stride) % u128::from(count)) as u64;
        index
    }
}

fn gcd(a: u64, b: u64) -> u64 {
    if b == 0 {
        a
    } else {
        gcd(b, a % b)
    }
}

/// A raw sum in the norm asked for.
#[allow(clippy::cast_precision_loss)]
#[must_use]
pub fn score(norm: Norm, raw: f64, samples: usize) -> f64 {
    match norm {
        Norm::L1 => raw,
        Norm::L2 => (raw / samples as f64).sqrt(),
    }
}

/// The kept rows so far.
struct Kept {
    rows: Vec<Row>,
    keep: usize,
    /// No candidate above this raw score can be kept.
    limit: f64,
}

impl Kept {
    fn new(keep: usize, limit: f64) -> Self {
        Self { rows: Vec::new(), keep, limit }
    }

    /// Takes rows in.
    fn take(&mut self, rows: impl Iterator<Item = Row>) {
        self.rows.extend(rows);
        trim(&mut self.rows, self.keep);
    }

    /// Whether this row is among them.
    fn holds(&self, row: &Row) -> bool {
        let place = self.rows.partition_point(|r| r.score.total_cmp(&row.score).then(r.index.cmp(&row.index)).is_lt());
        self.rows.get(place).is_some_and(|r| r.index == row.index)
    }

    /// Lowers the limit to the worst row where `stopping` allows it.
    fn lower(&mut self, stopping: bool) {
        if stopping && self.rows.len() == self.keep {
            self.limit = self.limit.min(self.rows[self.keep - 1].score);
        }
    }
}

/// A candidate that its bound has not excluded.
#[derive(Debug, Clone, Copy)]
struct Open {
    index: u64,
    bound: f64,
    /// A guess at its score, by which visits are ordered.
    guess: f64,
}

/// A search over a lattice, ready for its rounds.
pub struct Search<'a> {
    problem: Problem,
    lattice: Cow<'a, Lattice>,
    /// Column of each value of each term, per block of the lattice.
    tables: Vec<Vec<Vec<usize>>>,
    options: Options,
    /// No candidate above this raw score can be kept, as far as scouts can tell.
    limit: f64,
}

/// Some rounds of a search at work.
struct Hunt<'a> {
    problem: &'a Problem,
    lattice: &'a Lattice,
    tables: &'a [Vec<Vec<usize>>],
    options: &'a Options,
    control: &'a Control,
    pool: &'a rayon::ThreadPool,
    scratches: Scratches,
    /// Of the rounds done, and of the candidates done in this one but for its rows.
    part: Part,
}

/// [`Hunt::screen`] as a kernel.
struct Screening<'a, 'b> {
    hunt: &'a Hunt<'b>,
    lo: u64,
    hi: u64,
    limit: f64,
}

impl lanes::Kernel for Screening<'_, '_> {
    type Output = (Vec<Open>, Vec<u64>);

    #[inline(always)]
    fn run(self) -> Self::Output {
        self.hunt.screen(self.lo, self.hi, self.limit)
    }
}

impl Hunt<'_> {
    fn check_stop(&self) -> Result<()> {
        if self.control.stop.load(Ordering::Relaxed) {
            Err(Error::Interrupted)
        } else {
            Ok(())
        }
    }

    fn done(&self, count: u64, pruned: u64) {
        self.control.done.fetch_add(count, Ordering::Relaxed);
        self.control.pruned.fetch_add(pruned, Ordering::Relaxed);
    }

    fn positions(&self, cursor: &Cursor<'_>, positions: &mut [usize]) {
        let table = &self.tables[cursor.block()];
        cursor.each(0, |term, digit| positions[term] = table[term][digit]);
    }

    fn initial(&self, cursor: &Cursor<'_>, initial: &mut Vec<usize>) {
        if self.options.initial != Initial::Rest {
            self.problem.initial_positions(&cursor.structure(), initial);
        }
    }

    /// Screens candidates `lo … hi − 1` against a limit: the open ones, and the singular ones.
    #[inline(always)]
    fn screen(&self, lo: u64, hi: u64, limit: f64) -> (Vec<Open>, Vec<u64>) {
        let (mut open, mut singular) = (Vec::new(), Vec::new());
        let mut cursor = Cursor::at(self.lattice, lo);
        let mut index = lo;
        let width = self.lattice.width();
        // Candidates differ in their Caputo terms, so they cannot share a layout.
        if self.options.initial != Initial::Caputo {
            let mut screen = Screen::<WIDTH>::new(width);
            self.positions(&cursor, &mut screen.terms);
            while index + WIDTH as u64 <= hi {
                self.screen_some(&mut cursor, index, limit, &mut screen, &mut open, &mut singular);
                index += WIDTH as u64;
            }
        }
        let mut screen = Screen::<1>::new(width);
        self.positions(&cursor, &mut screen.terms);
        while index < hi {
            self.screen_some(&mut cursor, index, limit, &mut screen, &mut open, &mut singular);
            index += 1;
        }
        (open, singular)
    }

    #[inline(always)]
    fn screen_some<const L: usize>(
        &self,
        cursor: &mut Cursor<'_>,
        index: u64,
        limit: f64,
        screen: &mut Screen<L>,
        open: &mut Vec<Open>,
        singular: &mut Vec<u64>,
    ) {
        let Screen { solve, positions, initial, terms, columns, coefficients, weights } = screen;
        self.initial(cursor, initial);
        if let Some((term, digit)) = cursor.stretch(L) {
            for (columns, &column) in positions.iter_mut().zip(terms.iter()) {
                *columns = Columns { at: [column; L], same: true, run: false };
            }
            let table = &self.tables[cursor.block()][term];
            positions[term].at = part_of(&table[digit..]);
            positions[term].compare();
            cursor.skip(L - 1);
            self.next(cursor, terms);
        } else {
            for n in 0..L {
                for (columns, &column) in positions.iter_mut().zip(terms.iter()) {
                    columns.at[n] = column;
                }
                self.next(cursor, terms);
            }
            positions.iter_mut().for_each(Columns::compare);
        }
        let failed = self.problem.solve(positions, initial, solve);
        #[allow(clippy::manual_map)] // a closure would be compiled for the oldest machine
        let squares = match &self.problem.plain {
            Some(plain) => Some(plain.error(positions, &solve.coefficients)),
            None => None,
        };
        for n in 0..L {
            let index = index + n as u64;
            if failed[n] {
                singular.push(index);
                continue;
            }
            let (bound, guess) = match (&squares, &self.problem.bound) {
                (Some((least, guess)), _) => (least[n], guess[n]),
                (None, Some(bound)) => {
                    // Coefficients that are yet to be refined give an order of visiting and prove nothing.
                    let refined = self.problem.refiner.is_some();
                    let limit = if refined { f64::INFINITY } else { limit };
                    columns.iter_mut().zip(positions.iter()).for_each(|(t, p)| *t = p.at[n]);
                    coefficients.iter_mut().zip(&solve.coefficients).for_each(|(c, x)| *c = x[n]);
                    weights.clear();
                    weights.extend(solve.initial.iter().map(|x| x[n]));
                    let e = initial.len();
                    let (least, guess) = bound.evaluate(limit, |r| {
                        (&columns[..], &coefficients[..], &initial[..], &weights[r * e..(r + 1) * e])
                    });
                    (if refined { 0.0 } else { least }, guess)
                }
                (None, None) => (0.0, spread(index)),
            };
            // Written so that a bound that is not a number excludes nothing.
            if bound > limit {
                continue;
            }
            open.push(Open { index, bound, guess });
        }
    }

    /// Goes to the next candidate and its columns.
    #[inline(always)]
    fn next(&self, cursor: &mut Cursor<'_>, terms: &mut [usize]) {
        let changed = cursor.advance();
        let table = &self.tables[cursor.block()];
        cursor.each(changed, |term, digit| terms[term] = table[term][digit]);
    }

    /// Follows open candidates in this order from a place on; what is learnt goes to `kept`, and to the counts and
    /// checkpoints if `counted`.
    fn follow(&mut self, open: &[Open], kept: &mut Kept, mut place: Place, counted: bool) -> Result<()> {
        if open.is_empty() {
            return Ok(());
        }
        let saving = counted && self.control.saving.load(Ordering::Relaxed);
        // A refinement costs about ten times a free run.
        let pulses = if self.problem.refiner.is_some() { PIECE / 8 } else { PIECE };
        let piece =
            if saving { (pulses / self.problem.samples.max(1)).max(4 * self.scratches.0.len()) } else { usize::MAX };
        let (first, largest) = if self.problem.refiner.is_some() { REFINED } else { FOLLOWED };
        let batch = |at: u64| usize::try_from(at).unwrap_or(usize::MAX).min(open.len());
        if place.end == 0 {
            place.size = first;
            place.end = batch(place.size) as u64;
            place.limit = kept.limit;
        }
        loop {
            let limit = place.limit;
            kept.limit = limit;
            while place.followed < place.end {
                let (start, end) = (batch(place.followed), batch(place.end));
                let end = end.min(start.saturating_add(piece));
                let rows = self.follow_some(&open[start..end], limit, counted)?;
                place.followed = end as u64;
                if saving {
                    kept.take(rows.iter().cloned());
                    self.part.failures.sort_unstable();
                    self.part.failures.truncate(LISTED);
                    let rows = rows.into_iter().filter(|row| kept.holds(row)).collect();
                    let part = Part { rows, counts: self.part.counts, failures: self.part.failures.clone() };
                    self.control.save(Checkpoint { place, part });
                } else {
                    kept.take(rows.into_iter());
                }
            }
            kept.lower(self.options.early_stopping);
            if batch(place.end) == open.len() {
                return Ok(());
            }
            place.size = place.size.saturating_mul(2).min(largest);
            place.end = batch(place.end.saturating_add(place.size)) as u64;
            place.limit = kept.limit;
        }
    }

    /// Follows these candidates up to a limit: the rows they make.
    fn follow_some(&mut self, open: &[Open], limit: f64, counted: bool) -> Result<Vec<Row>> {
        let this = &*self;
        let visit = |candidate: &Open| {
            if this.control.stop.load(Ordering::Relaxed) {
                return None;
            }
            if candidate.bound > limit {
                return Some((candidate.index, Verdict::Bounded(candidate.bound), None));
            }
            this.scratches.with(|scratch| {
                let mut positions = std::mem::take(&mut scratch.positions);
                let mut initial = std::mem::take(&mut scratch.initial);
                let cursor = Cursor::at(this.lattice, candidate.index);
                positions.clear();
                positions.resize(this.lattice.width(), 0);
                this.positions(&cursor, &mut positions);
                this.initial(&cursor, &mut initial);
                let verdict = this.problem.evaluate(&positions, &initial, limit, false, scratch, this.control);
                let row = match verdict {
                    Verdict::Score(raw) if raw <= limit => {
                        Some(this.problem.row(candidate.index, raw, initial.len(), scratch))
                    }
                    _ => None,
                };
                scratch.positions = positions;
                scratch.initial = initial;
                // One that is bounded is counted as done with the other bounded ones.
                if counted && !matches!(verdict, Verdict::Bounded(_)) {
                    this.done(1, u64::from(matches!(verdict, Verdict::Stopped(_))));
                }
                Some((candidate.index, verdict, row))
            })
        };
        let results: Vec<_> = self.pool.install(|| {
            open.par_iter().with_min_len(if this.problem.refiner.is_some() { 1 } else { 4 }).map(visit).collect()
        });
        self.check_stop()?;
        let mut rows = Vec::new();
        for (index, verdict, row) in results.into_iter().flatten() {
            if counted {
                self.count(index, verdict);
            }
            rows.extend(row);
        }
        Ok(rows)
    }

    fn count(&mut self, index: u64, verdict: Verdict) {
        match verdict {
            Verdict::Score(_) => self.part.counts.beaten += 1,
            Verdict::Bounded(_) => {
                self.part.counts.bounded += 1;
                self.done(1, 1);
            }
            Verdict::Stopped(_) => self.part.counts.stopped += 1,
            Verdict::Failed(failure) => {
                match failure {
                    Failure::Singular => self.part.counts.singular += 1,
                    Failure::Diverged => self.part.counts.diverged += 1,
                }
                self.part.failures.push((index, failure));
            }
        }
    }

    /// Tries some candidates all over the lattice: the first limit, and the test vectors that exclude most.
    fn scout(&mut self) -> Result<(f64, Option<Vec<usize>>)> {
        let count = self.lattice.count();
        let order = visit(count);
        let refined = self.problem.refiner.is_some();
        let indices: Vec<u64> = (0..count.min(if refined { GUESSED } else { SCOUTS })).map(order).collect();
        let this = &*self;
        let found: Vec<Option<(Open, Vec<f64>)>> = self.pool.install(|| {
            indices
                .par_iter()
                .map(|&index| {
                    let cursor = Cursor::at(this.lattice, index);
                    let mut positions = vec![0; this.lattice.width()];
                    let mut initial = Vec::new();
                    this.positions(&cursor, &mut positions);
                    this.initial(&cursor, &mut initial);
                    let sources: Vec<Columns<1>> = positions.iter().map(|&p| Columns::new([p])).collect();
                    let mut solve = Solve::<1>::new();
                    let [failed] = this.problem.solve(&sources, &initial, &mut solve);
                    if failed {
                        return None;
                    }
                    let coefficients: Vec<f64> = solve.coefficients.iter().map(|c| c[0]).collect();
                    let weights: Vec<f64> = solve.initial.iter().map(|c| c[0]).collect();
                    let columns = |r: usize| {
                        let e = initial.len();
                        (&positions[..], &coefficients[..], &initial[..], &weights[r * e..(r + 1) * e])
                    };
                    let (mut each, mut guess) = (Vec::new(), 0.0);
                    if let Some(bound) = &this.problem.bound {
                        if !refined {
                            each = vec![0.0; bound.len()];
                            bound.each(columns, &mut each);
                        }
                        guess = bound.evaluate(f64::INFINITY, columns).1;
                    } else if let Some(plain) = &this.problem.plain {
                        guess = plain.error(&sources, &solve.coefficients).1[0];
                    }
                    Some((Open { index, bound: 0.0, guess }, each))
                })
                .collect()
        });
        self.check_stop()?;
        let found: Vec<(Open, Vec<f64>)> = found.into_iter().flatten().collect();
        let mut likely: Vec<Open> = found.iter().map(|(open, _)| *open).collect();
        by_guess(&mut likely);
        likely.truncate(4 * self.options.keep.max(16));
        let mut kept = Kept::new(self.options.keep, f64::INFINITY);
        self.follow(&likely, &mut kept, Place::start(0), false)?;
        let limit = kept.limit;
        // Where no coefficients are known yet all test vectors count.
        let which = self.problem.bound.as_ref().filter(|_| !refined).map(|bound| {
            let each: Vec<Vec<f64>> = found.into_iter().map(|(_, each)| each).collect();
            choose(&each, bound.len(), limit)
        });
        Ok((limit, which))
    }

    /// Screens a round and follows what is open, from a place on: its rows.
    fn round(&mut self, bounds: (u64, u64), kept: &mut Kept, place: Place) -> Result<()> {
        let (start, end) = bounds;
        let (limit, resumed) = (kept.limit, place.end > 0);
        let this = &*self;
        let parts: Vec<(Vec<Open>, Vec<u64>)> = self.pool.install(|| {
            (0..(end - start).div_ceil(CHUNK))
                .into_par_iter()
                .map(|chunk| {
                    let (lo, hi) = (start + chunk * CHUNK, end.min(start + (chunk + 1) * CHUNK));
                    if this.control.stop.load(Ordering::Relaxed) {
                        return Default::default();
                    }
                    let found = lanes::widest(Screening { hunt: this, lo, hi, limit });
                    let closed = hi - lo - (found.0.len() + found.1.len()) as u64;
                    if !resumed {
                        this.done(closed + found.1.len() as u64, closed);
                    }
                    found
                })
                .collect()
        });
        self.check_stop()?;
        let mut open: Vec<Open> = Vec::new();
        let mut singular: Vec<u64> = Vec::new();
        for (found, failed) in parts {
            open.extend(found);
            singular.extend(failed);
        }
        if !resumed {
            let failed = singular.len() as u64;
            self.part.counts.singular += failed;
            self.part.counts.bounded += end - start - open.len() as u64 - failed;
            self.part.failures.extend(singular.into_iter().take(LISTED).map(|index| (index, Failure::Singular)));
        }
        let still = place.end > 0 && (place.size == 0 || place.limit.is_nan());
        if still || place.end > open.len() as u64 || place.followed > place.end {
            let what = format!("a checkpoint stands at {} of {} candidates to follow", place.followed, open.len());
            return Err(Error::Structure { what, remedy: "start the search again".into() });
        }
        by_guess(&mut open);
        self.follow(&open, kept, place, true)
    }
}

impl Plain {
    /// Lower bounds of the squared equation error of L candidates, rounding allowed for, and its values.
    #[inline(always)]
    fn error<const L: usize>(&self, positions: &[Columns<L>], coefficients: &[Lanes<L>]) -> (Lanes<L>, Lanes<L>) {
        let (stride, target) = (self.stride, self.stride - 1);
        let mut sum = [self.gram[target * stride + target]; L];
        let mut size = [self.norms[target]; L];
        for (i, (rows, c)) in positions.iter().zip(coefficients).enumerate() {
            let norms = rows.of(&self.norms);
            // c·(c·G_ii + 2 Σ_{j<i} c_j G_ij − 2 b_i)
            let mut inner = rows.of(&self.gram[target * stride..]);
            for (columns, d) in positions[..i].iter().zip(coefficients) {
                let g = rows.with(columns, &self.gram, stride);
                (0..L).for_each(|n| inner[n] -= d[n] * g[n]);
            }
            let diagonal = rows.of(&self.diagonal);
            for n in 0..L {
                sum[n] += c[n] * (c[n] * diagonal[n] - 2.0 * inner[n]);
                size[n] += c[n].abs() * norms[n];
            }
        }
        let mut least = [0.0; L];
        for n in 0..L {
            least[n] = sum[n] - self.unit * size[n] * size[n];
        }
        (least, sum)
    }
}

/// Sorts by guess, ties by index; what has no order comes last.
fn by_guess(open: &mut [Open]) {
    open.sort_unstable_by(|a, b| a.guess.total_cmp(&b.guess).then(a.index.cmp(&b.index)));
}

/// The test vectors that together exclude most of a sample, those that exclude most by themselves first.
fn choose(each: &[Vec<f64>], count: usize, limit: f64) -> Vec<usize> {
    let mut open: Vec<bool> = vec![true; each.len()];
    let mut chosen: Vec<usize> = Vec::new();
    // Where one excludes no more than another the smaller threshold tells: how near it comes.
    let gain = |j: usize, open: &[bool]| -> (usize, f64) {
        let values = each.iter().zip(open).filter(|(_, open)| **open).map(|(e, _)| e[j]);
        values.fold((0, 0.0), |(n, sum), v| (n + usize::from(v > limit), sum + v / (v + limit).max(f64::MIN_POSITIVE)))
    };
    while chosen.len() < VECTORS.min(count) {
        let best = (0..count)
            .filter(|j| !chosen.contains(j))
            .map(|j| (gain(j, &open), j))
            .max_by(|a, b| a.0 .0.cmp(&b.0 .0).then(a.0 .1.total_cmp(&b.0 .1)).then(b.1.cmp(&a.1)));
        let Some((_, j)) = best else { break };
        each.iter().zip(&mut open).filter(|(e, _)| e[j] > limit).for_each(|(_, open)| *open = false);
        chosen.push(j);
    }
    chosen
}

/// Searches a lattice over one equation on one or several records.
///
/// `fixed` gives known coefficients. The table is that of brute force for any number of threads.
///
/// # Errors
/// A setting out of range, a bank beyond the memory limit, threads that do not start, [`Error::Interrupted`].
pub fn search(
    records: &[Record],
    lattice: &Lattice,
    fixed: &[Option<f64>],
    options: &Options,
    control: &Control,
) -> Result<Outcome> {
    let pool = pool(options.threads)?;
    let ready = Search::new(records, Cow::Borrowed(lattice), fixed, options, &pool, control)?;
    let mut all = Part::default();
    let mut first = 0;
    for last in waves(rounds(lattice.count(), options)) {
        let seed = all.seed();
        all.join(ready.rounds(first, last, &seed, None, &pool, control)?, options.keep);
        first = last;
    }
    Ok(all.outcome(options.norm, ready.problem.samples))
}

/// Candidates in a round of a search with these options.
fn round_length(options: &Options) -> u64 {
    let refined = matches!(options.estimator, Estimator::InstrumentalVariables(_));
    if refined || !options.early_stopping {
        ROUND_FOLLOWED
    } else if options.criterion == Criterion::EquationError
        && options.norm == Norm::L2
        && options.initial == Initial::Rest
    {
        ROUND_PLAIN
    } else {
        ROUND_BOUNDED
    }
}

/// Rounds of a search over so many candidates.
#[must_use]
pub fn rounds(candidates: u64, options: &Options) -> u64 {
    candidates.div_ceil(round_length(options))
}

/// Where each wave of so many rounds ends: 1, 3, 7, …
#[must_use]
pub fn waves(rounds: u64) -> Vec<u64> {
    let mut ends = Vec::new();
    let mut end: u64 = 0;
    while end < rounds {
        end = end.saturating_mul(2).saturating_add(1).min(rounds);
        ends.push(end);
    }
    ends
}

impl<'a> Search<'a> {
    /// Builds what all rounds share: regressors, their products, test vectors and a first limit from scouts.
    ///
    /// # Errors
    /// As [`search`].
    pub fn new(
        records: &[Record],
        lattice: Cow<'a, Lattice>,
        fixed: &[Option<f64>],
        options: &Options,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<Self> {
        check_length("fixed coefficients", lattice.width(), fixed.len())?;
        for record in records {
            lattice.structure(0).check(record.len(), |_| true)?;
        }
        let mut index = Index::default();
        let mut seen = HashSet::new();
        for block in lattice.blocks() {
            index_alpha(&mut index, block.alpha, &options.initial);
            for (group, slice) in lattice.groups().iter().zip(&block.slices) {
                for (axis, &first) in group.axes.iter().zip(&slice.first) {
                    for &order in &axis[first..] {
                        index_orders(&mut index, &mut seen, block.alpha, group.signal, order, &options.initial);
                    }
                }
            }
        }
        index.sort();
        let problem = Problem::new(records, lattice.output(), index, fixed, options)?;
        let problem = pool.install(|| problem.with_bound(lattice.count()));
        let tables = tables(&lattice, &problem)?;
        control.total.store(lattice.count(), Ordering::Relaxed);
        let mut ready = Self { problem, lattice, tables, options: options.clone(), limit: f64::INFINITY };
        // Scouts of a few candidates, each refined, would cost as much as the search.
        let few = ready.problem.refiner.is_some() && ready.lattice.count() <= ROUND_FOLLOWED;
        let screened = !few && (ready.problem.bound.is_some() || ready.problem.plain.is_some());
        let mut hunt = ready.hunt(pool, control);
        hunt.check_stop()?;
        if screened {
            let (limit, which) = hunt.scout()?;
            ready.limit = limit;
            if let Some(which) = which {
                ready.problem.bound = ready.problem.bound.take().map(|bound| bound.chosen(&which));
            }
        }
        Ok(ready)
    }

    fn hunt<'b>(&'b self, pool: &'b rayon::ThreadPool, control: &'b Control) -> Hunt<'b> {
        Hunt {
            problem: &self.problem,
            lattice: &self.lattice,
            tables: &self.tables,
            options: &self.options,
            control,
            pool,
            scratches: Scratches::new(pool.current_num_threads()),
            part: Part::default(),
        }
    }

    /// Does rounds `first … last − 1` of one wave.
    ///
    /// `seed` gives index and raw score of the rows kept before the wave. `from` goes on from a checkpoint of the same
    /// stretch and seed that holds all rows found since its start.
    ///
    /// # Errors
    /// [`Error::Interrupted`], or rounds, seed or checkpoint that do not fit this search.
    pub fn rounds(
        &self,
        first: u64,
        last: u64,
        seed: &[(u64, f64)],
        from: Option<Checkpoint>,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<Part> {
        let count = self.lattice.count();
        let (all, length) = (rounds(count, &self.options), round_length(&self.options));
        let from = from.unwrap_or_else(|| Checkpoint { place: Place::start(first), part: Part::default() });
        if !(first <= from.place.round && from.place.round <= last && last <= all) {
            let what = format!("rounds {first} to {last} from {} on are not among {all}", from.place.round);
            return Err(Error::Structure { what, remedy: "start the search again".into() });
        }
        // Rounds are spread over the lattice, so that early waves see all of it and later ones get a good limit.
        let order = visit(all);
        let mut hunt = self.hunt(pool, control);
        let Checkpoint { mut place, part } = from;
        control.total.store(count, Ordering::Relaxed);
        hunt.done(part.counts.done(), 0);
        hunt.part = part;
        let width = self.lattice.width();
        if hunt.part.rows.iter().any(|row| row.coefficients.len() != width || row.index >= count) {
            let what = "a checkpoint holds rows of another search".into();
            return Err(Error::Structure { what, remedy: "start the search again".into() });
        }
        while place.round < last {
            let start = order(place.round) * length;
            let bounds = (start, count.min(start + length));
            let own = |row: &Row| bounds.0 <= row.index && row.index < bounds.1;
            let mut kept = Kept::new(self.options.keep, self.limit);
            let seeds = seed.iter().map(|&(index, score)| Row { index, score, coefficients: vec![], initial: vec![] });
            kept.take(seeds);
            kept.lower(self.options.early_stopping);
            kept.take(hunt.part.rows.iter().filter(|row| own(row)).cloned());
            hunt.part.rows.retain(|row| !own(row));
            hunt.round(bounds, &mut kept, place)?;
            let part = Part {
                rows: kept.rows.into_iter().filter(own).collect(),
                counts: Counts { candidates: bounds.1 - bounds.0, ..Counts::default() },
                failures: Vec::new(),
            };
            hunt.part.join(part, self.options.keep);
            place = Place::start(place.round + 1);
        }
        Ok(hunt.part)
    }
}

/// The column of every value of every term, per block, so that a candidate costs no look-up.
fn tables(lattice: &Lattice, problem: &Problem) -> Result<Vec<Vec<Vec<usize>>>> {
    lattice
        .blocks()
        .iter()
        .map(|block| {
            let mut table = vec![Vec::new(); lattice.width()];
            for (group, slice) in lattice.groups().iter().zip(&block.slices) {
                for ((&term, axis), &first) in group.terms.iter().zip(&group.axes).zip(&slice.first) {
                    table[term] = axis
                        .iter()
                        .enumerate()
                        .map(|(i, &order)| {
                            // Values out of this α's range are never asked for.
                            if i < first {
                                Ok(0)
                            } else {
                                problem.position(group.signal, block.alpha - order)
                            }
                        })
                        .collect::<Result<_>>()?;
                }
            }
            Ok(table)
        })
        .collect()
}

/// The best `keep` rows, ties by index.
pub(crate) fn trim(rows: &mut Vec<Row>, keep: usize) {
    rows.sort_by(|a, b| a.score.total_cmp(&b.score).then(a.index.cmp(&b.index)));
    rows.truncate(keep);
}

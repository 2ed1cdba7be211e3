//! Evaluates the candidates of an order search: in parallel, ordered, stoppable, every one accounted for.
//!
//! Candidates are visited in rounds. Within a round each is measured against the worst score kept *before* the round
//! and left as soon as its partial sum passes it: such a candidate cannot be among the kept ones, so the table is that
//! of brute force, ties by index, for any number of threads, and so are the counts.

use std::collections::HashSet;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use crate::dense;
use crate::equation::{grains, Initial, Structure, ORDER_GRAIN};
use crate::error::{check_length, Error, Result};
use crate::estimate::multi_innovation::{Innovation, Rows};
use crate::haar;
use crate::regressors::{Bank, Index, Key, Record};
use crate::search::lattice::Lattice;
use crate::series::{Division, BLOCK};
use crate::small::{self, Rank};

/// First round: small, so that a good score is known early; rounds double from here.
const FIRST_ROUND: u64 = 256;
/// Largest round: long enough to keep threads busy, short enough that the kept scores stay fresh.
const LAST_ROUND: u64 = 16_384;
/// Failures listed one by one; the rest are only counted.
const LISTED: usize = 100;
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
    /// Whether to leave a candidate as soon as it cannot be kept; `false` is brute force, the oracle.
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

/// What became of the candidates: `kept + beaten + stopped + singular + diverged = candidates`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// All.
    pub candidates: u64,
    /// In the table.
    pub kept: u64,
    /// Evaluated to the end and not kept.
    pub beaten: u64,
    /// Left before the end because they could no longer be kept.
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

/// What one candidate came to, in raw sums (Σ|e| or Σe²).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Verdict {
    Score(f64),
    /// Left at this partial sum, above the limit.
    Stopped(f64),
    Failed(Failure),
}

/// Everything the candidates of one equation share.
pub(crate) struct Problem {
    index: Index,
    banks: Vec<Bank>,
    targets: Vec<Vec<f64>>,
    /// Per record, over the bank's columns and the target, (K+1)² row-major, weighted as the estimator asks.
    grams: Vec<Vec<f64>>,
    fixed: Vec<Option<f64>>,
    options: Options,
    samples: usize,
}

/// Memory of one thread.
pub(crate) struct Scratch {
    gram: Vec<f64>,
    rhs: Vec<f64>,
    scale: Vec<f64>,
    divisor: Vec<f64>,
    block: Vec<f64>,
    division: Option<Division>,
    /// Coefficients of the last candidate's terms.
    pub(crate) coefficients: Vec<f64>,
    tuples: Vec<usize>,
    positions: Vec<usize>,
    initial: Vec<usize>,
}

impl Scratch {
    pub(crate) fn new() -> Self {
        Self {
            gram: Vec::new(),
            rhs: Vec::new(),
            scale: Vec::new(),
            divisor: Vec::new(),
            block: vec![0.0; BLOCK],
            division: None,
            coefficients: Vec::new(),
            tuples: Vec::new(),
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
        let banks = records.iter().map(|r| Bank::new(&index, r, output)).collect::<Result<Vec<_>>>()?;
        let targets: Vec<Vec<f64>> = records.iter().map(|r| r.signal(output).to_vec()).collect();
        let grams = banks
            .iter()
            .zip(&targets)
            .map(|(bank, target)| weighted_gram(bank, target, options.estimator))
            .collect::<Result<Vec<_>>>()?;
        let samples = records.iter().map(Record::m).sum();
        Ok(Self { index, banks, targets, grams, fixed: fixed.to_vec(), options: options.clone(), samples })
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
    pub(crate) fn evaluate(
        &self,
        positions: &[usize],
        initial: &[usize],
        limit: f64,
        scratch: &mut Scratch,
        control: &Control,
    ) -> Verdict {
        if self.solve(positions, initial, scratch).is_err() {
            return Verdict::Failed(Failure::Singular);
        }
        let mut raw = 0.0;
        let free = self.fixed.iter().filter(|f| f.is_none()).count();
        for r in 0..self.banks.len() {
            let first = free + r * initial.len();
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

    /// Coefficients from the Gram matrices, into `scratch.coefficients` and, initial terms, `scratch.rhs`.
    fn solve(&self, positions: &[usize], initial: &[usize], scratch: &mut Scratch) -> Result<Rank> {
        let Scratch { gram, rhs, scale, coefficients, .. } = scratch;
        let free = self.fixed.iter().filter(|f| f.is_none()).count();
        let k = free + initial.len() * self.banks.len();
        gram.clear();
        gram.resize(k * k, 0.0);
        rhs.clear();
        rhs.resize(k, 0.0);
        let terms = || positions.iter().zip(&self.fixed).filter(|(_, f)| f.is_none()).map(|(&p, _)| p);
        for (r, (bank, g)) in self.banks.iter().zip(&self.grams).enumerate() {
            let width = bank.len() + 1;
            let first = free + r * initial.len();
            let columns = || terms().enumerate().chain(initial.iter().enumerate().map(|(i, &p)| (first + i, p)));
            for (a, p) in columns() {
                let row = &g[p * width..(p + 1) * width];
                for (b, q) in columns() {
                    gram[a * k + b] += row[q];
                }
                rhs[a] += row[bank.len()];
                for (&q, fixed) in positions.iter().zip(&self.fixed) {
                    if let Some(value) = fixed {
                        rhs[a] -= value * row[q];
                    }
                }
            }
        }
        if let Estimator::MultiInnovation(innovation) = self.options.estimator {
            for a in 0..k {
                gram[a * k + a] += 1.0 / innovation.prior_covariance;
            }
        }
        let rank = small::solve_gram(gram, rhs, free, scale)?;
        coefficients.clear();
        let mut next = 0;
        for fixed in &self.fixed {
            coefficients.push(match fixed {
                Some(value) => *value,
                None => {
                    next += 1;
                    rhs[next - 1]
                }
            });
        }
        Ok(rank)
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
                let c = scratch.rhs[first + i];
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
        let Scratch { rhs, divisor, block, division, coefficients, .. } = scratch;
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
                let c = rhs[first + i];
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
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn score(&self, raw: f64) -> f64 {
        match self.options.norm {
            Norm::L1 => raw,
            Norm::L2 => (raw / self.samples as f64).sqrt(),
        }
    }

    fn row(&self, index: u64, raw: f64, initial: usize, scratch: &Scratch) -> Row {
        let free = self.fixed.iter().filter(|f| f.is_none()).count();
        Row {
            index,
            score: raw,
            coefficients: scratch.coefficients.clone(),
            initial: (0..self.banks.len())
                .map(|r| scratch.rhs[free + r * initial..free + (r + 1) * initial].to_vec())
                .collect(),
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
        let verdict = self.evaluate(&positions, &initial, limit, scratch, control);
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

/// Gram matrix of a bank's columns and the target; with multi-innovation weights p on all rows but the last p − 1.
#[allow(clippy::cast_precision_loss)]
fn weighted_gram(bank: &Bank, target: &[f64], estimator: Estimator) -> Result<Vec<f64>> {
    let width = bank.len() + 1;
    let mut columns: Vec<&[f64]> = (0..bank.len()).map(|i| bank.column(i)).collect();
    columns.push(target);
    // Φ is orthogonal: the unweighted Gram matrix is the same in Haar coordinates.
    let mut gram = dense::gram(&columns);
    let Estimator::MultiInnovation(innovation) = estimator else { return Ok(gram) };
    let m = target.len();
    let tail = innovation.length.min(m) - 1;
    gram.iter_mut().for_each(|g| *g *= innovation.length.min(m) as f64);
    let mut rows = vec![vec![0.0; width]; tail];
    for (j, column) in columns.iter().enumerate() {
        let mut values = column.to_vec();
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
    Ok(gram)
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
    let width = lattice.structure(0).terms.len();
    check_length("fixed coefficients", width, fixed.len())?;
    let output = lattice.output();
    for record in records {
        lattice.structure(0).check(record.len(), |_| true)?;
    }
    let pool = pool(options.threads)?;
    let mut index = Index::default();
    let mut seen = HashSet::new();
    let signals: Vec<usize> = lattice.structure(0).terms.iter().map(|t| t.signal).collect();
    for block in lattice.blocks() {
        index_alpha(&mut index, block.alpha, &options.initial);
        for group in &block.groups {
            let signal = signals[group.terms[0]];
            for &order in &group.orders {
                index_orders(&mut index, &mut seen, block.alpha, signal, order, &options.initial);
            }
        }
    }
    let problem = Problem::new(records, output, index, fixed, options)?;
    // Positions of each group's tuples, so that a candidate costs no look-up.
    let tables: Vec<Vec<Vec<usize>>> = lattice
        .blocks()
        .iter()
        .map(|block| {
            block
                .groups
                .iter()
                .map(|group| {
                    let signal = signals[group.terms[0]];
                    group.orders.iter().map(|&o| problem.position(signal, block.alpha - o)).collect()
                })
                .collect()
        })
        .collect::<Result<_>>()?;

    let count = lattice.count();
    control.total.store(count, Ordering::Relaxed);
    let order = visit(count);
    let scratches = Scratches::new(options.threads);
    let mut kept: Vec<Row> = Vec::new();
    let mut counts = Counts { candidates: count, ..Counts::default() };
    let mut failures: Vec<(u64, Failure)> = Vec::new();
    let (mut start, mut size) = (0, FIRST_ROUND);
    while start < count {
        let end = count.min(start + size);
        let limit = match kept.last() {
            Some(worst) if options.early_stopping && kept.len() == options.keep => worst.score,
            _ => f64::INFINITY,
        };
        let evaluate = |i: u64| {
            let index = order(i);
            scratches.with(|scratch| {
                let mut tuples = std::mem::take(&mut scratch.tuples);
                let mut positions = std::mem::take(&mut scratch.positions);
                let mut initial = std::mem::take(&mut scratch.initial);
                let block = lattice.locate(index, &mut tuples);
                positions.clear();
                positions.resize(width, 0);
                for ((group, table), &tuple) in lattice.blocks()[block].groups.iter().zip(&tables[block]).zip(&tuples) {
                    let members = group.terms.len();
                    for (j, &term) in group.terms.iter().enumerate() {
                        positions[term] = table[tuple * members + j];
                    }
                }
                if options.initial == Initial::Rest {
                    initial.clear();
                } else {
                    problem.initial_positions(&lattice.structure(index), &mut initial);
                }
                let verdict = problem.evaluate(&positions, &initial, limit, scratch, control);
                let row = match verdict {
                    Verdict::Score(raw) if raw <= limit => Some(problem.row(index, raw, initial.len(), scratch)),
                    _ => None,
                };
                scratch.tuples = tuples;
                scratch.positions = positions;
                scratch.initial = initial;
                control.done.fetch_add(1, Ordering::Relaxed);
                (index, verdict, row)
            })
        };
        let results: Vec<_> = pool.install(|| {
            #[allow(clippy::cast_possible_truncation)]
            let round = (end - start) as usize;
            (0..round)
                .into_par_iter()
                .with_min_len(4)
                .map(|i| if control.stop.load(Ordering::Relaxed) { None } else { Some(evaluate(start + i as u64)) })
                .collect()
        });
        if control.stop.load(Ordering::Relaxed) {
            return Err(Error::Interrupted);
        }
        for (index, verdict, row) in results.into_iter().flatten() {
            match verdict {
                Verdict::Score(_) => counts.beaten += 1,
                Verdict::Stopped(_) => counts.stopped += 1,
                Verdict::Failed(failure) => {
                    match failure {
                        Failure::Singular => counts.singular += 1,
                        Failure::Diverged => counts.diverged += 1,
                    }
                    failures.push((index, failure));
                }
            }
            kept.extend(row);
        }
        trim(&mut kept, options.keep);
        failures.sort_unstable();
        failures.truncate(LISTED);
        start = end;
        size = (2 * size).min(LAST_ROUND);
    }
    counts.kept = kept.len() as u64;
    counts.beaten -= counts.kept;
    for row in &mut kept {
        row.score = problem.score(row.score);
    }
    Ok(Outcome { rows: kept, counts, failures })
}

/// The best `keep` rows, ties by index.
pub(crate) fn trim(rows: &mut Vec<Row>, keep: usize) {
    rows.sort_by(|a, b| a.score.total_cmp(&b.score).then(a.index.cmp(&b.index)));
    rows.truncate(keep);
}

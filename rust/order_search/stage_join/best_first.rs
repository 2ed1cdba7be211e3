//! Order search over coupled equations with best-first evaluation. A tuple is a combination of values of the free
//! orders.
//!
//! Each distinct combination of orders of an equation is evaluated once. At first, scores are only lower bounds,
//! because simulations stop early. They are refined until the score of every tuple that may enter the result table is
//! exact. The result equals that of a full enumeration, and tuples of equal score are ordered by index.

use std::borrow::Cow;
use std::sync::atomic::Ordering;

use rayon::prelude::*;

use crate::equation::Structure;
use crate::error::{check_length, Error, Result};
use crate::order_search::candidate::columns::RequiredRegressors;
use crate::order_search::candidate::problem::{Problem, Scratch};
use crate::order_search::control::{mismatch_error, Control};
use crate::order_search::dual_bound::lower_bound::Bound;
use crate::order_search::grid::order_law::OrderLawGrid;
use crate::order_search::options::{Budget, Norm, Options};
use crate::order_search::result::{Counts, Failure, Row, Verdict};
use crate::order_search::stage_join::join::{
    spans, Candidates, Class, Join, ScoreEntry, ScoreTables, Span, UNEVALUATED_ENTRY,
};
use crate::parallel::{pool, PerThread};
use crate::regressors::Record;

/// Ratio of the score limit to the best score of an equation in the first pass. The first pass evaluates the equations
/// one after the other.
const SCORE_LIMIT_FACTOR: f64 = 4.0;
/// Minimum number of candidates of one equation that are evaluated between two updates of the best score of this
/// equation. The first update follows after 256 candidates.
const CANDIDATES_PER_UPDATE: usize = 4096;

/// Row of the result table: one combination of values of the free orders.
#[derive(Debug, Clone, PartialEq)]
pub struct StageRow {
    /// Index of the combination of free orders in the order grid.
    pub index: u64,
    /// Values of the free orders.
    pub free: Vec<f64>,
    /// Sum of the scores of the equations, each divided by its scale.
    pub score: f64,
    /// Structure of each equation.
    pub structures: Vec<Structure>,
    /// Score and coefficients of each equation. The `index` of these rows is not used.
    pub rows: Vec<Row>,
}

/// Result of a search over coupled equations.
#[derive(Debug, Clone, PartialEq)]
pub struct StageOutcome {
    /// Best rows in ascending order of the score. Rows of equal score are ordered by index.
    pub rows: Vec<StageRow>,
    /// Number of combinations of free orders by outcome.
    pub counts: Counts,
    /// Index and reason of combinations of free orders without a score: the first ones by index, at most 100.
    pub failures: Vec<(u64, Failure)>,
    /// Number of distinct candidates of each equation.
    pub distinct: Vec<u64>,
}

/// Candidates of one equation and the data that they share.
struct Table {
    problem: Problem,
    candidates: Candidates,
    /// Candidates that occur for some combination of free orders, ascending.
    candidate_ids: Vec<usize>,
    /// Divisor of the score of this equation.
    scale: f64,
}

impl Table {
    /// Return the score entry of a candidate with this outcome, with the score divided by the scale of the equation.
    fn entry(&self, verdict: Verdict) -> ScoreEntry {
        let score = |raw: f64| self.problem.score(raw) / self.scale;
        match verdict {
            Verdict::Score(raw) => ScoreEntry { value: score(raw), class: Class::Exact },
            Verdict::Bounded(raw) => ScoreEntry { value: score(raw), class: Class::Bounded },
            Verdict::Stopped(raw) => ScoreEntry { value: score(raw), class: Class::Open },
            Verdict::Failed(failure) => ScoreEntry { value: f64::INFINITY, class: Class::Failed(failure) },
        }
    }
}

/// The coupled equations of an order search, with the data that their candidates share.
pub struct CoupledSearch<'a> {
    grid: Cow<'a, OrderLawGrid>,
    options: Options,
    /// Candidates of each equation.
    tables: Vec<Table>,
    /// Total number of samples of all records.
    samples: f64,
}

/// State of a search over coupled equations: scores of all candidates, and the candidates to evaluate next.
///
/// The next candidates depend only on the outcomes of earlier ones, so candidates may be evaluated on any machine and
/// in any sequence.
pub struct SearchState {
    join: Join,
    entries: ScoreTables,
    /// State of the first pass, which finds the best score of each equation: current equation, number of its candidates
    /// already requested, and smallest score / scale so far.
    pass: (usize, usize, f64),
    /// Ratio of the score limit of the next evaluation of a candidate to the lower bound of its score. It is used while
    /// the result table is not full.
    limit_factor: f64,
    /// Candidates to evaluate next.
    pending_spans: Vec<Span>,
    /// Total number of candidates to evaluate, as far as known.
    total: u64,
    /// Score (sum of score / scale over the equations) and index of the best combinations of free orders that are
    /// evaluated completely. Empty during the first pass.
    best_rows: Vec<(f64, u64)>,
}

impl<'a> CoupledSearch<'a> {
    /// Build the join of the equations under their order law, and the data that the candidates of each equation share.
    ///
    /// `fixed[e]` has one entry per term of equation e, `None` for a free coefficient. `scales[e]` divides the score of
    /// equation e. For the L1 norm, the scale σ(y)·M gives all outputs equal weight, with the standard deviation σ(y)
    /// of the output and the number M of samples.
    ///
    /// # Errors
    /// The errors of [`crate::order_search::batches::search`]: an option out of range, signals that the records lack, a
    /// wrong number of fixed coefficients, too little memory, or a stop request. [`Error::EmptyOrderGrid`] if no
    /// combination of free orders gives valid orders. [`Error::OutOfRange`] for a scale that is not positive.
    pub fn new(
        records: &[Record],
        grid: Cow<'a, OrderLawGrid>,
        fixed: &[Vec<Option<f64>>],
        scales: &[f64],
        options: &Options,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<(Self, SearchState)> {
        let equations = grid.equations();
        check_length("fixed coefficients", equations.len(), fixed.len())?;
        check_length("scales", equations.len(), scales.len())?;
        if let Some(e) = scales.iter().position(|scale| !(*scale > 0.0 && scale.is_finite())) {
            return Err(Error::OutOfRange {
                name: format!("scale of equation {e}"),
                value: scales[e],
                range: "(0, ∞)".into(),
                remedy: "divide its score by a positive scale of its output".into(),
            });
        }
        options.check()?;
        for record in records {
            grid.check_signals(record.len())?;
        }
        let mut candidates: Vec<Candidates> = equations.iter().map(Candidates::new).collect();
        let (join, candidate_ids) = Join::new(&grid, &mut candidates, options.memory, pool, control)?;
        if join.tuples() == 0 {
            return Err(Error::EmptyOrderGrid { reason: "no tuple of free orders gives orders in range".into() });
        }
        #[allow(clippy::cast_precision_loss)]
        let samples = records.iter().map(Record::m).sum::<usize>() as f64;
        let mut indices = Vec::with_capacity(equations.len());
        let mut budget = Budget::default();
        budget.add_layout(join.bytes());
        for (e, (candidates, candidate_ids)) in candidates.into_iter().zip(candidate_ids).enumerate() {
            check_length("fixed coefficients", equations[e].terms.len(), fixed[e].len())?;
            let mut required = RequiredRegressors::new(&options.initial);
            for &id in &candidate_ids {
                let structure = candidates.structure(id);
                required.add_alpha(structure.order);
                structure.terms.iter().for_each(|term| required.add_term(structure.order, term.signal, term.order));
            }
            let index = required.into_index();
            budget.add(records, equations[e].output, &index, options, Bound::MAX_TEST_VECTORS);
            indices.push((index, candidates, candidate_ids));
        }
        budget.check(options.memory)?;
        let mut tables = Vec::with_capacity(equations.len());
        for (e, (index, candidates, candidate_ids)) in indices.into_iter().enumerate() {
            let problem = pool.install(|| {
                let problem = Problem::new(records, equations[e].output, index, &fixed[e], options, &control.stop)?;
                let problem = problem.with_bound(candidate_ids.len() as u64, &control.stop);
                control.check_stop()?;
                Ok(problem)
            })?;
            tables.push(Table { problem, candidates, candidate_ids, scale: scales[e] });
        }
        let search = Self { grid, options: options.clone(), tables, samples };
        let mut state = SearchState {
            join,
            entries: search.tables.iter().map(|t| vec![UNEVALUATED_ENTRY; t.candidates.len()]).collect(),
            pass: (0, 0, f64::INFINITY),
            limit_factor: SCORE_LIMIT_FACTOR,
            pending_spans: Vec::new(),
            total: search.tables.iter().map(|t| t.candidate_ids.len() as u64).sum(),
            best_rows: Vec::new(),
        };
        state.plan_next(&search, pool, control)?;
        Ok((search, state))
    }

    /// Convert a score that is divided by the scale of its equation to a raw score (Σ|e| or Σe²), with a margin for
    /// rounding.
    fn raw_limit(&self, equation: usize, score: f64) -> f64 {
        let scaled = score * self.tables[equation].scale;
        let raw = match self.options.norm {
            Norm::L1 => scaled,
            Norm::L2 => scaled * scaled * self.samples,
        };
        // The margin ensures that a candidate whose scaled sum equals the limit is evaluated completely.
        raw * (1.0 + 1e-12)
    }

    /// Evaluate the candidates of these spans. Return one outcome per candidate, with raw scores (Σ|e| or Σe²), in the
    /// sequence of the spans.
    ///
    /// # Errors
    /// [`Error::Structure`] for candidates of another search, [`Error::Interrupted`] after a stop request.
    pub fn evaluate(&self, spans: &[Span], pool: &rayon::ThreadPool, control: &Control) -> Result<Vec<Verdict>> {
        let mut requests = Vec::new();
        for &Span { equation, first, last, limit } in spans {
            let candidate_ids = self.tables.get(equation).map_or(&[][..], |table| &table.candidate_ids);
            // Candidates that occur for no combination of free orders have no regressors.
            let is_evaluated = first < last
                && last - first <= candidate_ids.len()
                && (first..last).all(|id| candidate_ids.binary_search(&id).is_ok());
            if !is_evaluated || limit.is_nan() {
                let count = candidate_ids.len();
                let what = format!("candidates {first} to {last} of equation {equation} are not among its {count}");
                return Err(mismatch_error(what));
            }
            let limit = self.raw_limit(equation, limit);
            requests.extend((first..last).map(|id| (equation, id, limit)));
        }
        let scratches = PerThread::<Scratch>::new(pool);
        let verdicts: Vec<Verdict> = pool.install(|| {
            requests
                .par_iter()
                .map(|&(e, id, limit)| {
                    control.check_stop()?;
                    let Table { problem, candidates, .. } = &self.tables[e];
                    let structure = candidates.structure(id);
                    let (verdict, _) =
                        scratches.with(|scratch| problem.evaluate_structure(&structure, limit, scratch, control))?;
                    control.count(1, u64::from(matches!(verdict, Verdict::Bounded(_) | Verdict::Stopped(_))));
                    Ok(verdict)
                })
                .collect::<Result<_>>()
        })?;
        control.check_stop()?;
        Ok(verdicts)
    }

    /// Return the result of a completed search.
    ///
    /// # Errors
    /// [`Error::Structure`] if candidates are still to be evaluated or the state belongs to another search.
    /// [`Error::Internal`] for an internal fault.
    pub fn outcome(&self, state: &SearchState, control: &Control) -> Result<StageOutcome> {
        if !state.pending_spans.is_empty() {
            let what = "the search has no result yet, because candidates are still to be evaluated".into();
            return Err(Error::Structure {
                what,
                remedy: "evaluate the pending candidates, and add their verdicts".into(),
            });
        }
        state.check(self)?;
        let (mut counts, failures) = state.join.count_outcomes(&state.states());
        counts.table_rows = state.best_rows.len() as u64;
        counts.beaten -= counts.table_rows;
        let mut scratch = Scratch::default();
        let mut rows = Vec::with_capacity(state.best_rows.len());
        for &(score, index) in &state.best_rows {
            let structures = self
                .grid
                .structures(index)
                .ok_or_else(|| Error::Internal { what: "a tuple of the result table without structures".into() })?;
            let mut parts = Vec::with_capacity(structures.len());
            for (table, structure) in self.tables.iter().zip(&structures) {
                let (_, mut row) = table.problem.evaluate_structure(structure, f64::INFINITY, &mut scratch, control)?;
                row.score = table.problem.score(row.score);
                parts.push(row);
            }
            rows.push(StageRow { index, free: self.grid.free(index), score, structures, rows: parts });
        }
        let distinct = self.tables.iter().map(|t| t.candidate_ids.len() as u64).collect();
        Ok(StageOutcome { rows, counts, failures, distinct })
    }

    /// Return the order grid of the coupled equations.
    #[must_use]
    pub fn grid(&self) -> &OrderLawGrid {
        &self.grid
    }
}

impl SearchState {
    /// Return the candidates to evaluate next. Empty at the end of the search.
    #[must_use]
    pub fn pending_spans(&self) -> &[Span] {
        &self.pending_spans
    }

    /// Return the total number of candidates to evaluate, as far as known. A candidate whose simulation stopped early
    /// may be evaluated again and is then counted again.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.total
    }

    /// Return the smallest sum of score / scale over the equations for any combination of free orders. `None` if no
    /// such sum is known.
    #[must_use]
    pub fn best(&self) -> Option<f64> {
        self.best_rows.first().map(|incumbent| incumbent.0)
    }

    /// Return [`Error::Structure`] if the state belongs to another search.
    fn check(&self, search: &CoupledSearch<'_>) -> Result<()> {
        let candidates = search.tables.iter().map(|table| table.candidates.len());
        if candidates.eq(self.entries.iter().map(Vec::len)) {
            Ok(())
        } else {
            Err(mismatch_error("the state belongs to another coupled search".into()))
        }
    }

    /// Return the sum of scores and the class of every combination of candidates, for each half of the join of the
    /// equations.
    fn states(&self) -> [Vec<ScoreEntry>; 2] {
        std::array::from_fn(|h| self.join.halves[h].states(&self.entries))
    }

    /// Record the outcomes of the pending candidates, in their sequence, and select the next candidates.
    ///
    /// # Errors
    /// [`Error::Structure`] for outcomes that do not match the pending candidates or belong to another search.
    /// [`Error::Interrupted`] after a stop request.
    pub fn record_verdicts(
        &mut self,
        search: &CoupledSearch<'_>,
        verdicts: &[Verdict],
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<()> {
        self.check(search)?;
        let count: usize = self.pending_spans.iter().map(|span| span.last - span.first).sum();
        let is_valid = |verdict: &Verdict| match *verdict {
            Verdict::Score(raw) | Verdict::Bounded(raw) | Verdict::Stopped(raw) => raw >= 0.0,
            Verdict::Failed(_) => true,
        };
        if verdicts.len() != count || !verdicts.iter().all(is_valid) {
            return Err(mismatch_error(format!("{} results do not match {count} candidates", verdicts.len())));
        }
        let first_pass = self.pass.0 < search.tables.len();
        let mut verdicts = verdicts.iter();
        for span in &self.pending_spans {
            let table = &search.tables[span.equation];
            for (entry, &verdict) in self.entries[span.equation][span.first..span.last].iter_mut().zip(&mut verdicts) {
                *entry = table.entry(verdict);
                if first_pass && entry.class == Class::Exact {
                    self.pass.2 = self.pass.2.min(entry.value);
                }
            }
        }
        self.plan_next(search, pool, control)
    }

    /// Select the candidates to evaluate next, and update the best combinations of free orders after the first pass.
    fn plan_next(&mut self, search: &CoupledSearch<'_>, pool: &rayon::ThreadPool, control: &Control) -> Result<()> {
        control.total.store(self.total, Ordering::Relaxed);
        // The first pass finds the best score of each equation. Evaluations stop at a multiple of it.
        while let Some(Table { candidate_ids, .. }) = search.tables.get(self.pass.0) {
            let (equation, start, best) = self.pass;
            if start < candidate_ids.len() {
                let end = candidate_ids
                    .len()
                    .min(start + if start == 0 { 256 } else { CANDIDATES_PER_UPDATE.max(start / 2) });
                let limit = if search.options.pruning { SCORE_LIMIT_FACTOR * best } else { f64::INFINITY };
                self.pending_spans = spans(equation, candidate_ids[start..end].iter().map(|&id| (id, limit)));
                self.pass.1 = end;
                return Ok(());
            }
            self.pass = (equation + 1, 0, f64::INFINITY);
        }
        let top = search.options.top;
        let states = self.states();
        self.best_rows = self.join.best(&states, &self.entries, top, pool, control)?;
        let worst_score = if self.best_rows.len() == top { self.best_rows[top - 1].0 } else { f64::INFINITY };
        self.pending_spans =
            self.join.unresolved_spans(&states, &self.entries, worst_score, self.limit_factor, control)?;
        self.limit_factor *= SCORE_LIMIT_FACTOR;
        self.total += self.pending_spans.iter().map(|span| (span.last - span.first) as u64).sum::<u64>();
        control.total.store(self.total, Ordering::Relaxed);
        Ok(())
    }
}

/// Search for the free orders that minimize the sum of score / scale over the equations.
///
/// # Errors
/// An invalid option, scale or record, or no combination of free orders that gives valid orders
/// ([`CoupledSearch::new`]).
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::order_search::control::Control;
/// # use ftlm::order_search::options::Options;
/// # use ftlm::order_search::stage_join::search;
/// # use ftlm::equation::AffineOrder;
/// # use ftlm::order_search::grid::{LawEquation, OrderLawGrid};
/// let law = |constant: f64| AffineOrder { constant, weights: vec![1.0] };
/// let equation = LawEquation { output: 0, order: law(0.0), terms: vec![(1, law(-1.0))] };
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.8);
/// # let derived: Vec<f64> = input.clone();
/// # let input = Record::new(0.1, PulseMeans::from_signals(vec![derived]), None)?.integral(0, 0.7);
/// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 1.0);
/// // D^α y = D^{α−1} u for any α: y is the integral of u.
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
/// let grid = OrderLawGrid::new(&[vec![1.0, 1.5]], &[equation], &[false, true])?;
/// let fixed = [vec![None]];
/// let found = search(&[record], &grid, &fixed, &[1.0], &Options::default(), &Control::default())?;
/// assert_eq!(found.counts.candidates, 2);
/// assert!((found.rows[0].rows[0].coefficients[0] - 1.0).abs() < 1e-9);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn search(
    records: &[Record],
    grid: &OrderLawGrid,
    fixed: &[Vec<Option<f64>>],
    scales: &[f64],
    options: &Options,
    control: &Control,
) -> Result<StageOutcome> {
    let pool = pool(options.threads)?;
    let (search, mut state) = CoupledSearch::new(records, Cow::Borrowed(grid), fixed, scales, options, &pool, control)?;
    while !state.pending_spans().is_empty() {
        let verdicts = search.evaluate(state.pending_spans(), &pool, control)?;
        state.record_verdicts(&search, &verdicts, &pool, control)?;
    }
    search.outcome(&state, control)
}

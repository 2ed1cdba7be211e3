//! Outcomes of candidates, rows of the result table, and counts of candidates by outcome.

use crate::order_search::options::Norm;

/// Maximum number of failed candidates that a result lists. Further failures are only counted.
pub(crate) const MAX_LISTED_FAILURES: usize = 100;

/// Reason why a candidate has no score.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Failure {
    /// The regressors are linearly dependent to working precision.
    Singular,
    /// The simulated output overflows.
    Diverged,
}

/// Outcome of one candidate. Values are raw scores (Σ|e| or Σe²).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// Raw score (Σ|e| or Σe²) of a complete evaluation.
    Score(f64),
    /// Lower bound of the raw score, above the limit. The candidate was not simulated.
    Bounded(f64),
    /// Partial sum at which the evaluation was stopped, because it exceeded the limit or the caller requested a stop.
    Stopped(f64),
    /// The candidate has no score, for this reason.
    Failed(Failure),
}

/// Row of the result table.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Index of the candidate in the order grid.
    pub index: u64,
    /// Score in the selected norm over all records. In a partial result it is the raw score (Σ|e| or Σe²).
    pub score: f64,
    /// Coefficients of the terms, one per term.
    pub coefficients: Vec<f64>,
    /// Coefficients of the initial terms: one vector per record, in the sequence of the exponents of the structure.
    pub initial: Vec<Vec<f64>>,
}

/// Number of candidates by outcome. At the end of a search the outcomes add up to `candidates`. `excluded_by_box` is
/// part of `excluded_by_bound`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Total number of candidates.
    pub candidates: u64,
    /// Number of candidates in the result table.
    pub table_rows: u64,
    /// Number of candidates that were evaluated completely but did not enter the table.
    pub beaten: u64,
    /// Number of candidates excluded by a lower bound, without simulation.
    pub excluded_by_bound: u64,
    /// Number of candidates that were excluded together with a whole box of orders.
    pub excluded_by_box: u64,
    /// Number of candidates whose evaluation was stopped early because a partial sum exceeded the limit.
    pub stopped: u64,
    /// Number of candidates with linearly dependent regressors.
    pub singular: u64,
    /// Number of candidates whose simulated output is not finite.
    pub diverged: u64,
}

/// Result of an order search over one equation.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Outcome {
    /// Best rows in ascending order of the score. Rows of equal score are ordered by index.
    pub rows: Vec<Row>,
    /// Number of candidates by outcome.
    pub counts: Counts,
    /// Index and reason of failed candidates: the first ones by index, at most 100.
    pub failures: Vec<(u64, Failure)>,
}

/// Partial result of a search, from some of its batches.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Part {
    /// Best rows of the batches, at most as many as the result table holds. Scores are raw scores (Σ|e| or Σe²).
    pub rows: Vec<Row>,
    /// Number of candidates by outcome. Candidates in `rows` count as `beaten` until the search is complete.
    pub counts: Counts,
    /// Index and reason of failed candidates: the first ones by index, at most 100.
    pub failures: Vec<(u64, Failure)>,
}

impl Part {
    /// Merge the result of other batches into this one. Only the best `top` rows remain.
    ///
    /// ```
    /// # use ftlm::order_search::options::Norm;
    /// # use ftlm::order_search::result::{Part, Row};
    /// let part = |index, score| Part {
    ///     rows: vec![Row { index, score, coefficients: vec![], initial: vec![] }],
    ///     ..Part::default()
    /// };
    /// let mut all = part(7, 2.0);
    /// all.merge(part(3, 1.0), 1);
    /// assert_eq!(all.seed(), [(3, 1.0)]);
    /// assert_eq!(all.outcome(Norm::L1, 100).counts.table_rows, 1);
    /// ```
    pub fn merge(&mut self, other: Self, top: usize) {
        self.rows.extend(other.rows);
        truncate_rows(&mut self.rows, top);
        self.counts.add(&other.counts);
        self.failures.extend(other.failures);
        self.failures.sort_unstable();
        self.failures.truncate(MAX_LISTED_FAILURES);
    }

    /// Return index and raw score (Σ|e| or Σe²) of each row. Later batches use the scores as thresholds.
    #[must_use]
    pub fn seed(&self) -> Vec<(u64, f64)> {
        self.rows.iter().map(|row| (row.index, row.score)).collect()
    }

    /// Return the result of a search from the merged result of all its batches. Raw scores become scores in `norm` over
    /// `samples` samples.
    #[must_use]
    pub fn outcome(mut self, norm: Norm, samples: usize) -> Outcome {
        self.counts.table_rows = self.rows.len() as u64;
        self.counts.beaten = self.counts.beaten.saturating_sub(self.counts.table_rows);
        for row in &mut self.rows {
            row.score = norm.score(row.score, samples);
        }
        Outcome { rows: self.rows, counts: self.counts, failures: self.failures }
    }
}

impl Counts {
    /// Add the counts of another result.
    fn add(&mut self, other: &Self) {
        for (sum, n) in [
            (&mut self.candidates, other.candidates),
            (&mut self.table_rows, other.table_rows),
            (&mut self.beaten, other.beaten),
            (&mut self.excluded_by_bound, other.excluded_by_bound),
            (&mut self.excluded_by_box, other.excluded_by_box),
            (&mut self.stopped, other.stopped),
            (&mut self.singular, other.singular),
            (&mut self.diverged, other.diverged),
        ] {
            *sum = sum.saturating_add(n);
        }
    }

    /// Return the number of candidates that have an outcome. At the end of a search it is the total number of
    /// candidates.
    #[must_use]
    pub fn processed_count(&self) -> u64 {
        [self.table_rows, self.beaten, self.excluded_by_bound, self.stopped, self.singular, self.diverged]
            .iter()
            .fold(0, |sum, n| sum.saturating_add(*n))
    }
}

/// Sort the rows by score, then by index, and keep the first `top` rows.
fn truncate_rows(rows: &mut Vec<Row>, top: usize) {
    rows.sort_by(|a, b| a.score.total_cmp(&b.score).then(a.index.cmp(&b.index)));
    rows.truncate(top);
}

/// Best rows found by a search, and the limit that they imply.
pub(crate) struct TopRows {
    pub(crate) rows: Vec<Row>,
    top: usize,
    /// Raw score (Σ|e| or Σe²) above which no candidate can enter the table.
    pub(crate) limit: f64,
}

impl TopRows {
    pub(crate) fn new(top: usize, limit: f64) -> Self {
        Self { rows: Vec::new(), top, limit }
    }

    /// Insert rows, and remove rows that are not among the best `top`.
    pub(crate) fn insert_rows(&mut self, rows: impl Iterator<Item = Row>) {
        self.rows.extend(rows);
        truncate_rows(&mut self.rows, self.top);
    }

    /// Return true if this row is in the table.
    pub(crate) fn contains(&self, row: &Row) -> bool {
        let position =
            self.rows.partition_point(|r| r.score.total_cmp(&row.score).then(r.index.cmp(&row.index)).is_lt());
        self.rows.get(position).is_some_and(|r| r.index == row.index)
    }

    /// Lower the limit to the score of the worst row if `prunes` is true and the table is full.
    pub(crate) fn lower_limit(&mut self, prunes: bool) {
        if prunes && self.rows.len() == self.top {
            self.limit = self.limit.min(self.rows[self.top - 1].score);
        }
    }
}

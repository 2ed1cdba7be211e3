//! Outcomes of candidates, rows of the result table, and counts of candidates by outcome.

use crate::order_search::options::Norm;

/// Maximum number of failures that are listed. Further failures are only counted.
pub(crate) const MAX_LISTED_FAILURES: usize = 100;

/// Reason why a candidate has no score.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Failure {
    /// Regressors are linearly dependent to working precision.
    Singular,
    /// The simulated output overflows.
    Diverged,
}

/// Outcome of one candidate, in raw sums (Σ|e| or Σe²).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// Score of a complete evaluation.
    Score(f64),
    /// Lower bound above the limit, without simulation.
    Bounded(f64),
    /// Partial sum above the limit at which the evaluation was stopped.
    Stopped(f64),
    /// No score, for this reason.
    Failed(Failure),
}

/// Row of the result table.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Index in the order grid.
    pub index: u64,
    /// Score in the selected norm, summed over records.
    pub score: f64,
    /// One coefficient per term.
    pub coefficients: Vec<f64>,
    /// Coefficients of the initial terms, per record, in the order of the structure's exponents.
    pub initial: Vec<Vec<f64>>,
}

/// Number of candidates by outcome. The outcomes add up to `candidates`; `excluded_by_box` is part of
/// `excluded_by_bound`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Total number of candidates.
    pub candidates: u64,
    /// Number of candidates in the table.
    pub table_rows: u64,
    /// Number of complete evaluations that did not enter the table.
    pub beaten: u64,
    /// Number of candidates excluded by a lower bound, without simulation.
    pub excluded_by_bound: u64,
    /// Number of candidates excluded together with their whole box, without a bound of their own.
    pub excluded_by_box: u64,
    /// Number of evaluations stopped early because their partial sum exceeded the limit.
    pub stopped: u64,
    /// Number of candidates with linearly dependent regressors.
    pub singular: u64,
    /// Number of candidates without a finite simulated output.
    pub diverged: u64,
}

/// The result of a search.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Outcome {
    /// Best rows in ascending order of the score, ties by index.
    pub rows: Vec<Row>,
    /// Number of candidates by outcome.
    pub counts: Counts,
    /// First failures by index, at most 100.
    pub failures: Vec<(u64, Failure)>,
}

/// Partial result of some batches.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Part {
    /// Best rows of the batches, at most as many as the table holds. Scores are raw sums (Σ|e| or Σe²).
    pub rows: Vec<Row>,
    /// Number of candidates by outcome. Rows count as `beaten` until the search is complete.
    pub counts: Counts,
    /// First failures by index, at most 100.
    pub failures: Vec<(u64, Failure)>,
}

impl Part {
    /// Merge the result of other batches. The best `keep` rows of all remain.
    ///
    /// ```
    /// # use ftlm::order_search::options::Norm;
    /// # use ftlm::order_search::result::{Part, Row};
    /// let part = |index, score| Part {
    ///     rows: vec![Row { index, score, coefficients: vec![], initial: vec![] }],
    ///     ..Part::default()
    /// };
    /// let mut all = part(7, 2.0);
    /// all.join(part(3, 1.0), 1);
    /// assert_eq!(all.seed(), [(3, 1.0)]);
    /// assert_eq!(all.outcome(Norm::L1, 100).counts.table_rows, 1);
    /// ```
    pub fn join(&mut self, other: Self, keep: usize) {
        self.rows.extend(other.rows);
        trim(&mut self.rows, keep);
        self.counts.add(&other.counts);
        self.failures.extend(other.failures);
        self.failures.sort_unstable();
        self.failures.truncate(MAX_LISTED_FAILURES);
    }

    /// Index and raw score of each row, which later batches use as thresholds.
    #[must_use]
    pub fn seed(&self) -> Vec<(u64, f64)> {
        self.rows.iter().map(|row| (row.index, row.score)).collect()
    }

    /// Result of a search from all of its batches over records with this many samples. Raw sums become scores.
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

    /// Number of candidates with an outcome. At the end of a search it is the total number.
    #[must_use]
    pub fn processed_count(&self) -> u64 {
        [self.table_rows, self.beaten, self.excluded_by_bound, self.stopped, self.singular, self.diverged]
            .iter()
            .fold(0, |sum, n| sum.saturating_add(*n))
    }
}

/// Keep the best `keep` rows, ties by index.
fn trim(rows: &mut Vec<Row>, keep: usize) {
    rows.sort_by(|a, b| a.score.total_cmp(&b.score).then(a.index.cmp(&b.index)));
    rows.truncate(keep);
}

/// Best rows so far, and the limit they imply.
pub(crate) struct TopRows {
    pub(crate) rows: Vec<Row>,
    keep: usize,
    /// Raw score above which no candidate can enter the table.
    pub(crate) limit: f64,
}

impl TopRows {
    pub(crate) fn new(keep: usize, limit: f64) -> Self {
        Self { rows: Vec::new(), keep, limit }
    }

    /// Insert rows, and drop rows that are not among the best.
    pub(crate) fn insert_rows(&mut self, rows: impl Iterator<Item = Row>) {
        self.rows.extend(rows);
        trim(&mut self.rows, self.keep);
    }

    /// Whether this row is in the table.
    pub(crate) fn contains(&self, row: &Row) -> bool {
        let place = self.rows.partition_point(|r| r.score.total_cmp(&row.score).then(r.index.cmp(&row.index)).is_lt());
        self.rows.get(place).is_some_and(|r| r.index == row.index)
    }

    /// Lower the limit to the score of the worst row if `stopping` is set and the table is full.
    pub(crate) fn lower_limit(&mut self, stopping: bool) {
        if stopping && self.rows.len() == self.keep {
            self.limit = self.limit.min(self.rows[self.keep - 1].score);
        }
    }
}

//! What candidates come to: verdicts, kept rows, counts of what became of all, and the table that they make.

use crate::order_search::options::Norm;

/// Failures listed one by one; the rest are only counted.
pub(crate) const LISTED: usize = 100;

/// Why a candidate has no score.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Failure {
    /// Its regressors are linearly dependent to working precision.
    Singular,
    /// Its free run left the range of floating point.
    Diverged,
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
    /// Of these, those that no bound of their own was asked for: their whole box was excluded.
    pub boxed: u64,
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
    /// Takes in what other rounds came to; of all rows the best `keep` stay.
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
    /// assert_eq!(all.outcome(Norm::L1, 100).counts.kept, 1);
    /// ```
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

    /// The result of a search, from all of its rounds over records of so many samples: raw sums become scores.
    #[must_use]
    pub fn outcome(mut self, norm: Norm, samples: usize) -> Outcome {
        self.counts.kept = self.rows.len() as u64;
        self.counts.beaten = self.counts.beaten.saturating_sub(self.counts.kept);
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
            (&mut self.kept, other.kept),
            (&mut self.beaten, other.beaten),
            (&mut self.bounded, other.bounded),
            (&mut self.boxed, other.boxed),
            (&mut self.stopped, other.stopped),
            (&mut self.singular, other.singular),
            (&mut self.diverged, other.diverged),
        ] {
            *sum = sum.saturating_add(n);
        }
    }

    /// Candidates dealt with; at the end of a search all.
    #[must_use]
    pub fn done(&self) -> u64 {
        [self.kept, self.beaten, self.bounded, self.stopped, self.singular, self.diverged]
            .iter()
            .fold(0, |sum, n| sum.saturating_add(*n))
    }
}

/// The best `keep` rows, ties by index.
fn trim(rows: &mut Vec<Row>, keep: usize) {
    rows.sort_by(|a, b| a.score.total_cmp(&b.score).then(a.index.cmp(&b.index)));
    rows.truncate(keep);
}

/// The kept rows so far.
pub(crate) struct Kept {
    pub(crate) rows: Vec<Row>,
    keep: usize,
    /// No candidate above this raw score can be kept.
    pub(crate) limit: f64,
}

impl Kept {
    pub(crate) fn new(keep: usize, limit: f64) -> Self {
        Self { rows: Vec::new(), keep, limit }
    }

    /// Takes rows in.
    pub(crate) fn take(&mut self, rows: impl Iterator<Item = Row>) {
        self.rows.extend(rows);
        trim(&mut self.rows, self.keep);
    }

    /// Whether this row is among them.
    pub(crate) fn holds(&self, row: &Row) -> bool {
        let place = self.rows.partition_point(|r| r.score.total_cmp(&row.score).then(r.index.cmp(&row.index)).is_lt());
        self.rows.get(place).is_some_and(|r| r.index == row.index)
    }

    /// Lowers the limit to the worst row where `stopping` allows it.
    pub(crate) fn lower(&mut self, stopping: bool) {
        if stopping && self.rows.len() == self.keep {
            self.limit = self.limit.min(self.rows[self.keep - 1].score);
        }
    }
}

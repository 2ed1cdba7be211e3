//! What is known of the candidates of each equation: a score, or a bound below it.

use crate::order_search::result::Failure;

/// What is known of one equation's candidate: its scaled score, or a bound below it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    pub(super) value: f64,
    pub(super) class: Class,
}

/// What became of a candidate, or of several together: the first failure, else the largest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Class {
    Exact,
    /// A bound without a run is all that is known.
    Bounded,
    /// Left at a partial sum, or not looked at.
    Open,
    Failed(Failure),
}

impl Class {
    pub(super) fn failed(self) -> bool {
        matches!(self, Self::Failed(_))
    }

    pub(super) fn with(self, later: Self) -> Self {
        if self.failed() {
            self
        } else {
            self.max(later)
        }
    }
}

/// Of a candidate that was not looked at.
pub(super) const OPEN: Entry = Entry { value: 0.0, class: Class::Open };

/// What is known of every candidate of every equation.
pub(super) type Entries = Vec<Vec<Entry>>;

/// Candidates `first … last − 1` of one equation, to be followed up to one limit of its scaled score.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Span {
    /// Equation.
    pub equation: usize,
    /// See above.
    pub first: usize,
    /// See above.
    pub last: usize,
    /// See above.
    pub limit: f64,
}

/// Candidates of an equation with the limit of each, in stretches that share one.
pub(super) fn spans(equation: usize, wanted: impl Iterator<Item = (usize, f64)>) -> Vec<Span> {
    let mut spans: Vec<Span> = Vec::new();
    for (id, limit) in wanted {
        match spans.last_mut() {
            Some(span) if span.last == id && span.limit.to_bits() == limit.to_bits() => span.last = id + 1,
            _ => spans.push(Span { equation, first: id, last: id + 1, limit }),
        }
    }
    spans
}

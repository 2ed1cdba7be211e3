//! Stop request, progress and checkpoints that a search shares with its caller.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use crate::error::{Error, Result};
use crate::order_search::result::Part;
use crate::parallel::Stop;

/// State shared with the caller during a search. From any thread, the caller may read the counters, stop the search and
/// take its checkpoints.
#[derive(Debug, Default)]
pub struct Control {
    /// Stop request. Setting it ends the search with [`Error::Interrupted`].
    pub stop: Stop,
    /// Number of candidates processed so far.
    pub finished_count: AtomicU64,
    /// Total number of candidates, once known.
    pub total: AtomicU64,
    /// Number of processed candidates that a bound excluded or whose evaluation was stopped early.
    pub pruned: AtomicU64,
    /// True if the caller takes checkpoints. Otherwise none are made.
    pub makes_checkpoints: AtomicBool,
    /// Latest checkpoint not yet taken by the caller.
    pub checkpoint: Mutex<Option<Checkpoint>>,
}

impl Control {
    /// Make a checkpoint available to the caller. The rows of an earlier checkpoint that was not taken are added to it.
    pub(crate) fn save(&self, mut checkpoint: Checkpoint) {
        let mut slot = self.checkpoint.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(missed) = slot.take() {
            checkpoint.part.rows.extend(missed.part.rows);
            checkpoint.replaces_previous |= missed.replaces_previous;
        }
        *slot = Some(checkpoint);
    }

    /// Take the latest checkpoint. `None` if there is no new one.
    pub fn take_checkpoint(&self) -> Option<Checkpoint> {
        self.checkpoint.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Return [`Error::Interrupted`] after a stop request.
    pub(crate) fn check_stop(&self) -> Result<()> {
        self.stop.check()
    }

    /// Return true after a stop request.
    pub(crate) fn is_stopped(&self) -> bool {
        self.stop.is_set()
    }

    /// Add `processed` to the count of processed candidates, and `pruned` to the count of pruned candidates.
    pub(crate) fn count(&self, processed: u64, pruned: u64) {
        self.finished_count.fetch_add(processed, Ordering::Relaxed);
        self.pruned.fetch_add(pruned, Ordering::Relaxed);
    }
}

/// Position of the evaluation within a range of batches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BatchPosition {
    /// Number of the batch. Earlier batches of the range are complete.
    pub batch: u64,
    /// Number of evaluated candidates of the batch. The candidates that no bound excluded are evaluated in a fixed
    /// sequence.
    pub evaluated_count: u64,
    /// End of the current chunk of candidates in the evaluation sequence, 0 if the batch has not been screened.
    pub end: u64,
    /// Number of candidates of the current chunk, 0 if the batch has not been screened.
    pub size: u64,
    /// Limit of the raw score (Σ|e| or Σe²) for that chunk.
    pub limit: f64,
    /// Digest of the sequence in which the batch evaluates the candidates that no bound excludes. It is below 2^63, and
    /// 0 if `end` is 0.
    pub order: u64,
}

impl BatchPosition {
    /// Return the position at the start of a batch, before its candidates are screened.
    pub(crate) fn start(batch: u64) -> Self {
        Self { batch, evaluated_count: 0, end: 0, size: 0, limit: f64::INFINITY, order: 0 }
    }

    /// Return true if the fields of the position are consistent.
    pub(crate) fn is_valid(&self) -> bool {
        let has_begun = self.end == 0 || (self.size > 0 && self.limit >= 0.0);
        has_begun && self.evaluated_count <= self.end
    }

    /// Return true if the position is compatible with a batch that has `open` candidates to evaluate, whose evaluation
    /// sequence has the digest `order`.
    pub(crate) fn is_compatible(&self, open: u64, order: u64) -> bool {
        self.end == 0 || (self.end <= open && self.order == order)
    }
}

/// Checkpoint of an evaluation within a range of batches.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    /// Position of the checkpoint.
    pub position: BatchPosition,
    /// True if this is the first checkpoint of this evaluation of the range. It then replaces any earlier result of the
    /// range.
    pub replaces_previous: bool,
    /// Partial result. A checkpoint that the search publishes contains only the rows found since the previous one. A
    /// checkpoint from which a search resumes must contain all rows.
    pub part: Part,
}

/// Return an error for a checkpoint, partial result or verdict that belongs to another search.
pub(crate) fn mismatch_error(what: String) -> Error {
    Error::Structure { what, remedy: "start the search again".into() }
}

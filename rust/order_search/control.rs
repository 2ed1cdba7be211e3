//! Stop request, progress and checkpoints that a search shares with its caller.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use crate::error::{Error, Result};
use crate::order_search::result::Part;
use crate::parallel::Stop;

/// State shared with the caller during a search. Any thread may read the counters, stop the search and take its
/// checkpoints.
#[derive(Debug, Default)]
pub struct Control {
    /// Set to end the search with [`Error::Interrupted`].
    pub stop: Stop,
    /// Number of candidates processed so far.
    pub finished_count: AtomicU64,
    /// Total number of candidates, once known.
    pub total: AtomicU64,
    /// Number of processed candidates whose evaluation was stopped early.
    pub pruned: AtomicU64,
    /// True if the caller takes checkpoints.
    pub saving: AtomicBool,
    /// Latest checkpoint not yet taken by the caller.
    pub checkpoint: Mutex<Option<Checkpoint>>,
}

impl Control {
    /// Publish a checkpoint. Rows of a previous one that was not taken are merged into it.
    pub(crate) fn save(&self, mut checkpoint: Checkpoint) {
        let mut slot = self.checkpoint.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(missed) = slot.take() {
            checkpoint.part.rows.extend(missed.part.rows);
            checkpoint.replaces_previous |= missed.replaces_previous;
        }
        *slot = Some(checkpoint);
    }

    /// Take the latest checkpoint, if there is a new one.
    pub fn take_checkpoint(&self) -> Option<Checkpoint> {
        self.checkpoint.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Return an error once the caller has requested a stop.
    pub(crate) fn check_stop(&self) -> Result<()> {
        self.stop.check()
    }

    pub(crate) fn is_stopped(&self) -> bool {
        self.stop.is_set()
    }

    /// Count candidates as processed, and some of them as pruned.
    pub(crate) fn count(&self, processed: u64, pruned: u64) {
        self.finished_count.fetch_add(processed, Ordering::Relaxed);
        self.pruned.fetch_add(pruned, Ordering::Relaxed);
    }
}

/// Position within a range of batches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BatchPosition {
    /// Number of the batch. Earlier batches of the range are complete.
    pub batch: u64,
    /// Number of its open candidates that have been evaluated, in evaluation order.
    pub evaluated_count: u64,
    /// End of the current chunk of candidates, 0 if the batch has not been screened.
    pub end: u64,
    /// Length of the current chunk, 0 if the batch has not been screened.
    pub size: u64,
    /// Limit of that chunk.
    pub limit: f64,
    /// Digest of the evaluation order of the batch's open candidates, below 2^63. It is 0 if `end` is 0.
    pub order: u64,
}

impl BatchPosition {
    /// Return the position before a batch.
    pub(crate) fn start(batch: u64) -> Self {
        Self { batch, evaluated_count: 0, end: 0, size: 0, limit: f64::INFINITY, order: 0 }
    }

    /// True if the fields of the position are consistent.
    pub(crate) fn is_valid(&self) -> bool {
        let has_begun = self.end == 0 || (self.size > 0 && self.limit >= 0.0);
        has_begun && self.evaluated_count <= self.end
    }

    /// True if the position is before a batch, or in a batch with this digest and at least as many open candidates.
    pub(crate) fn fits(&self, open: u64, order: u64) -> bool {
        self.end == 0 || (self.end <= open && self.order == order)
    }
}

/// Checkpoint within a range of batches.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    /// Position of the checkpoint.
    pub place: BatchPosition,
    /// True if this is the first checkpoint of this evaluation of the range. It then replaces any earlier result.
    pub replaces_previous: bool,
    /// Partial result so far. A checkpoint that is taken holds only the rows found since the previous one. A checkpoint
    /// to resume from must hold all rows.
    pub part: Part,
}

/// Error for a checkpoint, partial result or verdict of another search.
pub(crate) fn mismatch_error(what: String) -> Error {
    Error::Structure { what, remedy: "start the search again".into() }
}

//! What a search and its caller share while it runs: stop, progress and checkpoints.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use crate::error::{Error, Result};
use crate::order_search::result::Part;
use crate::parallel::Stop;

/// Shared with the caller while a search runs: any thread may read the counters, stop the search, take its checkpoints.
#[derive(Debug, Default)]
pub struct Control {
    /// Set to end the search with [`Error::Interrupted`].
    pub stop: Stop,
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
    pub(crate) fn save(&self, mut checkpoint: Checkpoint) {
        let mut slot = self.checkpoint.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(missed) = slot.take() {
            checkpoint.part.rows.extend(missed.part.rows);
            checkpoint.anew |= missed.anew;
        }
        *slot = Some(checkpoint);
    }

    /// Takes the latest checkpoint; none if there is no new one.
    pub fn take(&self) -> Option<Checkpoint> {
        self.checkpoint.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Refuses to go on once the caller has asked to stop.
    pub(crate) fn check_stop(&self) -> Result<()> {
        self.stop.check()
    }

    pub(crate) fn stopped(&self) -> bool {
        self.stop.is_set()
    }

    /// Counts candidates as done, and so many of them as left early.
    pub(crate) fn count(&self, done: u64, pruned: u64) {
        self.done.fetch_add(done, Ordering::Relaxed);
        self.pruned.fetch_add(pruned, Ordering::Relaxed);
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
    /// Digest of the order in which the round's open candidates are visited, below 2^63; 0 where `end` is.
    pub order: u64,
}

impl Place {
    /// Before a round.
    pub(crate) fn start(round: u64) -> Self {
        Self { round, followed: 0, end: 0, size: 0, limit: f64::INFINITY, order: 0 }
    }

    /// Whether a search may stand here.
    pub(crate) fn sound(&self) -> bool {
        let begun = self.end == 0 || (self.size > 0 && self.limit >= 0.0);
        begun && self.followed <= self.end
    }

    /// Whether this lies before a round, or in one that visits so many open candidates in the order of this digest.
    pub(crate) fn fits(&self, open: u64, order: u64) -> bool {
        self.end == 0 || (self.end <= open && self.order == order)
    }
}

/// A stretch of rounds, half done.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    /// Where it stands.
    pub place: Place,
    /// Whether this is the first one of a stretch that was begun at its start: what was kept of it before does not count.
    pub anew: bool,
    /// What it came to so far. A checkpoint that is taken holds only the rows found since the one before; one to go on
    /// from must hold all of them.
    pub part: Part,
}

/// The refusal of a checkpoint, a part or a verdict that does not belong to the search at hand.
pub(crate) fn another(what: String) -> Error {
    Error::Structure { what, remedy: "start the search again".into() }
}

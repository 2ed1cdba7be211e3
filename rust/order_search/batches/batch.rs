//! Evaluation of one batch of candidates: exclude candidates by lower bounds, simulate the remaining ones, and count
//! every outcome.

use std::sync::atomic::Ordering;

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::branch_and_bound::{screen_slice, BranchAndBound, MIN_SLICE_CANDIDATES};
use crate::order_search::candidate::problem::Scratch;
use crate::order_search::candidate_index::CandidateIndex;
use crate::order_search::control::{BatchPosition, Checkpoint, Control};
use crate::order_search::grid::traversal::{low_discrepancy_order, Cursor, GridSlice};
use crate::order_search::result::{Failure, Part, Row, TopRows, Verdict, MAX_LISTED_FAILURES};
use crate::order_search::screening::{screen, sort_by_guess, OpenCandidate};
use crate::parallel::PerThread;

/// Number of samples simulated between two checkpoints, about 0.1 s on one core.
const CHECKPOINT_PULSES: usize = 1 << 21;
/// Number of candidates for which one parallel task computes lower bounds.
const BOUND_CHUNK_CANDIDATES: u64 = 512;
/// Number of candidates that one parallel task ranks by the Gram matrix alone, at about 1 ns per candidate.
const GRAM_CHUNK_CANDIDATES: u64 = 1 << 13;
/// Number of two-dimensional slices of the order grid on which branch and bound over boxes is tried if candidates are
/// hard to exclude. It is used for the search if boxes exclude more than one in [`MAX_CANDIDATES_PER_EXCLUSION`]
/// candidates of these slices. Boxes that exclude nothing make a search 50 % longer.
const TRIAL_SLICES: u64 = 32;
/// Maximum ratio of the number of candidates to the number of candidates that boxes exclude. At a larger ratio, boxes
/// cost more time than they save.
const MAX_CANDIDATES_PER_EXCLUSION: u64 = 8;
/// Initial and largest number of candidates that are simulated between two updates of the limit.
const SIMULATION_CHUNK_RANGE: (u64, u64) = (256, 16_384);
/// Initial and largest number of candidates with refined coefficients that are evaluated between two updates of the
/// limit. One refinement takes about 1 ms, so frequent updates save time.
const REFINEMENT_CHUNK_RANGE: (u64, u64) = (32, 1024);

/// Evaluation of a range of batches.
pub(super) struct BatchEvaluation<'a> {
    pub(super) candidate_index: &'a CandidateIndex<'a>,
    /// Branch and bound over boxes, if it is used.
    boxes: Option<&'a BranchAndBound>,
    pub(super) pool: &'a rayon::ThreadPool,
    control: &'a Control,
    /// Workspace of each thread.
    scratches: PerThread<Scratch>,
    /// Result of the completed batches, and counts and failures of the current batch. The rows of the current batch are
    /// not included.
    pub(super) result: Part,
    /// True if the next checkpoint is the first one of this evaluation of the range of batches.
    pub(super) replaces_previous: bool,
}

impl<'a> BatchEvaluation<'a> {
    pub(super) fn new(
        candidate_index: &'a CandidateIndex<'a>,
        boxes: Option<&'a BranchAndBound>,
        pool: &'a rayon::ThreadPool,
        control: &'a Control,
    ) -> Self {
        Self {
            candidate_index,
            boxes,
            pool,
            control,
            scratches: PerThread::new(pool),
            result: Part::default(),
            replaces_previous: true,
        }
    }

    /// Return true after a stop request.
    pub(super) fn is_stopped(&self) -> bool {
        self.control.is_stopped()
    }

    /// Return [`crate::error::Error::Interrupted`] after a stop request.
    pub(super) fn check_stop(&self) -> Result<()> {
        self.control.check_stop()
    }

    /// Screen the candidates in the index range `bounds` and simulate those that no bound excludes, starting at the
    /// position `position`. Return false if the position belongs to another evaluation sequence, which may occur on
    /// another kind of processor.
    pub(super) fn evaluate_batch(
        &mut self,
        bounds: (u64, u64),
        top_rows: &mut TopRows,
        mut position: BatchPosition,
    ) -> Result<bool> {
        let (start, end) = bounds;
        let (limit, is_resumed) = (top_rows.limit, position.end > 0);
        let (candidate_index, control) = (self.candidate_index, self.control);
        let parts: Vec<(Vec<OpenCandidate>, Vec<u64>, u64)> = self.pool.install(|| {
            self.chunks(start, end, limit)
                .par_iter()
                .with_max_len(1)
                .map(|(lo, hi, slice)| {
                    let (lo, hi) = (*lo, *hi);
                    if control.is_stopped() {
                        return Default::default();
                    }
                    let boxes = slice.as_ref().zip(self.boxes);
                    let boxes_outcome = boxes
                        .and_then(|(slice, boxes)| screen_slice(candidate_index, boxes, slice, (lo, hi), limit))
                        .unwrap_or_else(|| {
                            let (open, singular) = screen(candidate_index, lo, hi, limit);
                            (open, singular, 0)
                        });
                    let excluded_count = hi - lo - (boxes_outcome.0.len() + boxes_outcome.1.len()) as u64;
                    if !is_resumed {
                        control.count(excluded_count + boxes_outcome.1.len() as u64, excluded_count);
                    }
                    boxes_outcome
                })
                .collect()
        });
        self.check_stop()?;
        let mut open: Vec<OpenCandidate> = Vec::new();
        let mut singular: Vec<u64> = Vec::new();
        let mut excluded_by_box = 0;
        for (boxes_outcome, failed, excluded_in_part) in parts {
            open.extend(boxes_outcome);
            singular.extend(failed);
            excluded_by_box += excluded_in_part;
        }
        sort_by_guess(&mut open);
        let order = digest(&open);
        if !position.is_compatible(open.len() as u64, order) {
            return Ok(false);
        }
        position.order = order;
        if !is_resumed {
            let failed = singular.len() as u64;
            self.result.counts.singular += failed;
            self.result.counts.excluded_by_bound += end - start - open.len() as u64 - failed;
            self.result.counts.excluded_by_box += excluded_by_box;
            self.result
                .failures
                .extend(singular.into_iter().take(MAX_LISTED_FAILURES).map(|index| (index, Failure::Singular)));
        }
        self.simulate_open(&open, top_rows, position, true).map(|()| true)
    }

    /// Return true if boxes exclude more than one in [`MAX_CANDIDATES_PER_EXCLUSION`] candidates of trial slices, at a
    /// limit of the raw score (Σ|e| or Σe²).
    pub(super) fn boxes_are_worthwhile(&self, limit: f64) -> Result<bool> {
        let Some(boxes) = self.boxes else { return Ok(false) };
        let (candidate_index, control) = (self.candidate_index, self.control);
        let order = low_discrepancy_order(candidate_index.grid.count());
        let trial_indices: Vec<u64> = (0..TRIAL_SLICES.min(candidate_index.grid.count())).map(order).collect();
        let counts: Vec<(u64, u64)> = self.pool.install(|| {
            trial_indices
                .into_par_iter()
                .with_max_len(1)
                .filter_map(|index| {
                    let slice = candidate_index.grid.slice_at(index).filter(|_| !control.is_stopped())?;
                    let end = slice.hi.min(slice.lo + MIN_SLICE_CANDIDATES);
                    let (.., excluded) = screen_slice(candidate_index, boxes, &slice, (slice.lo, end), limit)?;
                    Some((end - slice.lo, excluded))
                })
                .collect()
        });
        self.check_stop()?;
        let (all, excluded) = counts.iter().fold((0, 0), |sums, counts| (sums.0 + counts.0, sums.1 + counts.1));
        Ok(excluded * MAX_CANDIDATES_PER_EXCLUSION > all)
    }

    /// Split the candidates `start … end − 1` of a batch into chunks, one per parallel task: (first candidate,
    /// candidate after the last one, slice). A chunk with a slice is processed by branch and bound. A chunk without one
    /// has at most [`GRAM_CHUNK_CANDIDATES`] candidates.
    fn chunks(&self, start: u64, end: u64, limit: f64) -> Vec<(u64, u64, Option<GridSlice>)> {
        let mut chunks = Vec::new();
        // With boxes, a chunk must not extend far into the next slice.
        let is_screened_by_gram = self.candidate_index.problem.residual_sums.is_some() && self.boxes.is_none();
        let chunk = if is_screened_by_gram { GRAM_CHUNK_CANDIDATES } else { BOUND_CHUNK_CANDIDATES };
        let mut first = start;
        while first < end {
            let box_slice =
                self.boxes.filter(|_| limit < f64::INFINITY).and_then(|_| self.candidate_index.grid.slice_at(first));
            if let Some(slice) = box_slice {
                let chunk_end = end.min(slice.hi);
                if chunk_end - first >= MIN_SLICE_CANDIDATES {
                    chunks.push((first, chunk_end, Some(slice)));
                    first = chunk_end;
                    continue;
                }
            }
            let chunk_end = end.min(first + chunk);
            chunks.push((first, chunk_end, None));
            first = chunk_end;
        }
        chunks
    }

    /// Simulate the candidates `open` in the given sequence, starting at the position `position`, and add their rows to
    /// `top_rows`. If `counts_outcomes` is true, counts and checkpoints are updated.
    pub(super) fn simulate_open(
        &mut self,
        open: &[OpenCandidate],
        top_rows: &mut TopRows,
        mut position: BatchPosition,
        counts_outcomes: bool,
    ) -> Result<()> {
        if open.is_empty() {
            return Ok(());
        }
        let CandidateIndex { problem, options, .. } = self.candidate_index;
        let makes_checkpoints = counts_outcomes && self.control.makes_checkpoints.load(Ordering::Relaxed);
        // A refinement costs about ten times a simulation.
        let pulses = if problem.refines() { CHECKPOINT_PULSES / 8 } else { CHECKPOINT_PULSES };
        let max_chunk = if makes_checkpoints {
            (pulses / problem.samples().max(1)).max(4 * self.scratches.len())
        } else {
            usize::MAX
        };
        let (initial_size, max_size) = if problem.refines() { REFINEMENT_CHUNK_RANGE } else { SIMULATION_CHUNK_RANGE };
        let to_index = |count: u64| usize::try_from(count).unwrap_or(usize::MAX).min(open.len());
        if position.end == 0 {
            position.size = initial_size;
            position.end = to_index(position.size) as u64;
            position.limit = top_rows.limit;
        }
        loop {
            let limit = position.limit;
            top_rows.limit = limit;
            while position.evaluated_count < position.end {
                let (start, end) = (to_index(position.evaluated_count), to_index(position.end));
                let end = end.min(start.saturating_add(max_chunk));
                let rows = self.simulate_chunk(&open[start..end], limit, counts_outcomes)?;
                position.evaluated_count = end as u64;
                if makes_checkpoints {
                    top_rows.insert_rows(rows.iter().cloned());
                    self.result.failures.sort_unstable();
                    self.result.failures.truncate(MAX_LISTED_FAILURES);
                    let rows = rows.into_iter().filter(|row| top_rows.contains(row)).collect();
                    let part = Part { rows, counts: self.result.counts, failures: self.result.failures.clone() };
                    let replaces_previous = std::mem::take(&mut self.replaces_previous);
                    self.control.save(Checkpoint { position, replaces_previous, part });
                } else {
                    top_rows.insert_rows(rows.into_iter());
                }
            }
            top_rows.lower_limit(options.pruning);
            if to_index(position.end) == open.len() {
                return Ok(());
            }
            position.size = position.size.saturating_mul(2).min(max_size);
            position.end = to_index(position.end.saturating_add(position.size)) as u64;
            position.limit = top_rows.limit;
        }
    }

    /// Simulate these candidates up to a limit of the raw score (Σ|e| or Σe²). Return the rows of candidates whose
    /// score is at most the limit. If `counts_outcomes` is true, counts are updated.
    fn simulate_chunk(&mut self, open: &[OpenCandidate], limit: f64, counts_outcomes: bool) -> Result<Vec<Row>> {
        let (candidate_index, control, scratches) = (self.candidate_index, self.control, &self.scratches);
        let problem = &candidate_index.problem;
        let evaluate = |candidate: &OpenCandidate| {
            if control.is_stopped() {
                return None;
            }
            if candidate.bound > limit {
                return Some((candidate.index, Verdict::Bounded(candidate.bound), None));
            }
            scratches.with(|scratch| {
                let mut positions = std::mem::take(&mut scratch.positions);
                let mut initial = std::mem::take(&mut scratch.initial);
                let cursor = Cursor::at(&candidate_index.grid, candidate.index);
                positions.clear();
                positions.resize(candidate_index.grid.width(), 0);
                candidate_index.positions(&cursor, &mut positions);
                candidate_index.initial(&cursor, &mut initial);
                let verdict = problem.evaluate(&positions, &initial, limit, false, scratch, control);
                let row = match verdict {
                    Verdict::Score(raw) if raw <= limit => {
                        Some(problem.row(candidate.index, raw, initial.len(), scratch))
                    }
                    _ => None,
                };
                scratch.positions = positions;
                scratch.initial = initial;
                // [`Self::count_verdict`] counts candidates that a bound excludes as processed.
                if counts_outcomes && !matches!(verdict, Verdict::Bounded(_)) {
                    control.count(1, u64::from(matches!(verdict, Verdict::Stopped(_))));
                }
                Some((candidate.index, verdict, row))
            })
        };
        let min_items = if problem.refines() { 1 } else { 4 };
        let results: Vec<_> = self.pool.install(|| open.par_iter().with_min_len(min_items).map(evaluate).collect());
        self.check_stop()?;
        let mut rows = Vec::new();
        for (index, verdict, row) in results.into_iter().flatten() {
            if counts_outcomes {
                self.count_verdict(index, verdict);
            }
            rows.extend(row);
        }
        Ok(rows)
    }

    /// Add the outcome of a candidate to the counts, and add a failure to the list of failures.
    fn count_verdict(&mut self, index: u64, verdict: Verdict) {
        match verdict {
            Verdict::Score(_) => self.result.counts.beaten += 1,
            Verdict::Bounded(_) => {
                self.result.counts.excluded_by_bound += 1;
                self.control.count(1, 1);
            }
            Verdict::Stopped(_) => self.result.counts.stopped += 1,
            Verdict::Failed(failure) => {
                match failure {
                    Failure::Singular => self.result.counts.singular += 1,
                    Failure::Diverged => self.result.counts.diverged += 1,
                }
                self.result.failures.push((index, failure));
            }
        }
    }
}

/// Return a digest of the evaluation sequence of candidates, below 2^63 and never 0. It is the 64-bit FNV-1a hash of
/// their indices without the last bit.
fn digest(open: &[OpenCandidate]) -> u64 {
    let bytes = open.iter().flat_map(|candidate| candidate.index.to_le_bytes());
    let hash_value =
        bytes.fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
    (hash_value >> 1).max(1)
}

#[cfg(test)]
mod tests {
    use std::borrow::Cow;

    use super::*;
    use crate::order_search::grid::{OrderGrid, TermAxis};
    use crate::order_search::options::Options;
    use crate::parallel::pool;
    use crate::parallel::Stop;
    use crate::regressors::Record;

    #[test]
    fn boxes_are_used_only_where_they_exclude_candidates() -> Result<()> {
        let input: Vec<f64> = (0..200).map(|k| if k % 40 < 20 { 1.0 } else { -0.5 }).collect();
        let answer = Record::from_rows(0.05, vec![input.clone()], None)?.integral(0, 0.8);
        let size: f64 = answer.iter().map(|y| y.abs()).sum();
        let record = Record::from_rows(0.05, vec![answer, input], None)?;
        let axis = |signal: usize, from: f64| {
            let values = (0..40).map(|i| from + 0.01 * f64::from(i)).collect();
            TermAxis { signal, values, interchangeable: false }
        };
        let grid = OrderGrid::new(0, &[1.4, 1.6], &[axis(0, 0.1), axis(1, 0.6)], |signal| signal == 1)?;
        let (pool, control, options) = (pool(1)?, Control::default(), Options::default());
        let (grid, fixed) = (Cow::Borrowed(&grid), [None, None]);
        let candidate_index = CandidateIndex::new(&[record], grid, &fixed, &options, &pool, &Stop::default())?;
        let boxes = pool.install(|| BranchAndBound::new(&candidate_index));
        let evaluation = BatchEvaluation::new(&candidate_index, boxes.as_ref(), &pool, &control);
        assert!(evaluation.boxes_are_worthwhile(1e-3 * size)?);
        // Nothing exceeds a limit as large.
        assert!(!evaluation.boxes_are_worthwhile(1e3 * size)?);
        assert!(!BatchEvaluation::new(&candidate_index, None, &pool, &control).boxes_are_worthwhile(1e-3 * size)?);
        control.stop.set();
        assert!(evaluation.boxes_are_worthwhile(1e-3 * size).is_err());
        Ok(())
    }
}

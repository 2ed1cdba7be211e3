//! Evaluation of one batch: screen, simulate the candidates that no bound excludes, count every outcome.

use std::sync::atomic::Ordering;

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::branch_and_bound::{screen_slab, Boxes, LEAST};
use crate::order_search::candidate::problem::Scratch;
use crate::order_search::candidate_index::Catalogue;
use crate::order_search::control::{Checkpoint, Control, Place};
use crate::order_search::grid::traversal::{visit, Cursor, Slab};
use crate::order_search::result::{Failure, Kept, Part, Row, Verdict, LISTED};
use crate::order_search::screening::{by_guess, screen, Open};
use crate::parallel::PerThread;

/// Pulses simulated between two checkpoints, about 0.1 s on one core.
const PIECE: usize = 1 << 21;
/// Candidates that a task screens. Ranking by the Gram matrix alone costs about one nanosecond per candidate.
const CHUNK: u64 = 512;
const CHUNK_PLAIN: u64 = 1 << 13;
/// Slices on which boxes are tried if candidates are hard to exclude. Boxes are worthwhile if they exclude at least one
/// in so many candidates. Useless boxes make a search half as long again.
const SLABS: u64 = 32;
const PAYING: u64 = 8;
/// First and largest number of candidates simulated between two updates of the limit.
const FOLLOWED: (u64, u64) = (256, 16_384);
/// First and largest number of refined candidates between two updates of the limit. Each takes about one millisecond,
/// and a lower score excludes many.
const REFINED: (u64, u64) = (32, 1024);

/// Evaluation of a range of batches.
pub(super) struct Hunt<'a> {
    pub(super) catalogue: &'a Catalogue<'a>,
    boxes: Option<&'a Boxes>,
    pub(super) pool: &'a rayon::ThreadPool,
    control: &'a Control,
    scratches: PerThread<Scratch>,
    /// Result of the completed batches, and of the candidates evaluated in the current batch, without its rows.
    pub(super) part: Part,
    /// Whether the next checkpoint is the first one since the range was started.
    pub(super) anew: bool,
}

impl<'a> Hunt<'a> {
    pub(super) fn new(
        catalogue: &'a Catalogue<'a>,
        boxes: Option<&'a Boxes>,
        pool: &'a rayon::ThreadPool,
        control: &'a Control,
    ) -> Self {
        Self { catalogue, boxes, pool, control, scratches: PerThread::new(pool), part: Part::default(), anew: true }
    }

    pub(super) fn stopped(&self) -> bool {
        self.control.stopped()
    }

    pub(super) fn check_stop(&self) -> Result<()> {
        self.control.check_stop()
    }

    /// Screen a batch and simulate its open candidates, starting at a position. Return `false` if the position belongs
    /// to another evaluation order, as on another kind of processor.
    pub(super) fn round(&mut self, bounds: (u64, u64), kept: &mut Kept, mut place: Place) -> Result<bool> {
        let (start, end) = bounds;
        let (limit, resumed) = (kept.limit, place.end > 0);
        let (catalogue, control) = (self.catalogue, self.control);
        let parts: Vec<(Vec<Open>, Vec<u64>, u64)> = self.pool.install(|| {
            self.chunks(start, end, limit)
                .par_iter()
                .with_max_len(1)
                .map(|(lo, hi, slab)| {
                    let (lo, hi) = (*lo, *hi);
                    if control.stopped() {
                        return Default::default();
                    }
                    let boxes = slab.as_ref().zip(self.boxes);
                    let found = boxes
                        .and_then(|(slab, boxes)| screen_slab(catalogue, boxes, slab, (lo, hi), limit))
                        .unwrap_or_else(|| {
                            let (open, singular) = screen(catalogue, lo, hi, limit);
                            (open, singular, 0)
                        });
                    let closed = hi - lo - (found.0.len() + found.1.len()) as u64;
                    if !resumed {
                        control.count(closed + found.1.len() as u64, closed);
                    }
                    found
                })
                .collect()
        });
        self.check_stop()?;
        let mut open: Vec<Open> = Vec::new();
        let mut singular: Vec<u64> = Vec::new();
        let mut boxed = 0;
        for (found, failed, excluded) in parts {
            open.extend(found);
            singular.extend(failed);
            boxed += excluded;
        }
        by_guess(&mut open);
        let order = digest(&open);
        if !place.fits(open.len() as u64, order) {
            return Ok(false);
        }
        place.order = order;
        if !resumed {
            let failed = singular.len() as u64;
            self.part.counts.singular += failed;
            self.part.counts.bounded += end - start - open.len() as u64 - failed;
            self.part.counts.boxed += boxed;
            self.part.failures.extend(singular.into_iter().take(LISTED).map(|index| (index, Failure::Singular)));
        }
        self.follow(&open, kept, place, true).map(|()| true)
    }

    /// Whether boxes exclude more than one in [`MAX_CANDIDATES_PER_EXCLUSION`] candidates on trial slices.
    pub(super) fn boxes_exclude(&self, limit: f64) -> Result<bool> {
        let Some(boxes) = self.boxes else { return Ok(false) };
        let (catalogue, control) = (self.catalogue, self.control);
        let order = visit(catalogue.lattice.count());
        let places: Vec<u64> = (0..SLABS.min(catalogue.lattice.count())).map(order).collect();
        let found: Vec<(u64, u64)> = self.pool.install(|| {
            places
                .into_par_iter()
                .with_max_len(1)
                .filter_map(|at| {
                    let slab = catalogue.lattice.slab(at).filter(|_| !control.stopped())?;
                    let end = slab.hi.min(slab.lo + LEAST);
                    let (.., boxed) = screen_slab(catalogue, boxes, &slab, (slab.lo, end), limit)?;
                    Some((end - slab.lo, boxed))
                })
                .collect()
        });
        self.check_stop()?;
        let (all, boxed) = found.iter().fold((0, 0), |sums, found| (sums.0 + found.0, sums.1 + found.1));
        Ok(boxed * PAYING > all)
    }

    /// Split the candidates of a batch into chunks: a large slice as a whole, others in small numbers.
    fn chunks(&self, start: u64, end: u64, limit: f64) -> Vec<(u64, u64, Option<Slab>)> {
        let mut chunks = Vec::new();
        // With boxes, a chunk must not extend far into the next slice.
        let plain = self.catalogue.problem.squares.is_some() && self.boxes.is_none();
        let chunk = if plain { CHUNK_PLAIN } else { CHUNK };
        let mut at = start;
        while at < end {
            let boxed = self.boxes.filter(|_| limit < f64::INFINITY).and_then(|_| self.catalogue.lattice.slab(at));
            if let Some(slab) = boxed {
                let to = end.min(slab.hi);
                if to - at >= LEAST {
                    chunks.push((at, to, Some(slab)));
                    at = to;
                    continue;
                }
            }
            let to = end.min(at + chunk);
            chunks.push((at, to, None));
            at = to;
        }
        chunks
    }

    /// Simulate open candidates in this order, starting at a position. Rows are added to `kept`, and counts and
    /// checkpoints are updated if `counted`.
    pub(super) fn follow(&mut self, open: &[Open], kept: &mut Kept, mut place: Place, counted: bool) -> Result<()> {
        if open.is_empty() {
            return Ok(());
        }
        let Catalogue { problem, options, .. } = self.catalogue;
        let saving = counted && self.control.saving.load(Ordering::Relaxed);
        // A refinement costs about ten times a simulation.
        let pulses = if problem.refines() { PIECE / 8 } else { PIECE };
        let piece = if saving { (pulses / problem.samples().max(1)).max(4 * self.scratches.len()) } else { usize::MAX };
        let (first, largest) = if problem.refines() { REFINED } else { FOLLOWED };
        let batch = |at: u64| usize::try_from(at).unwrap_or(usize::MAX).min(open.len());
        if place.end == 0 {
            place.size = first;
            place.end = batch(place.size) as u64;
            place.limit = kept.limit;
        }
        loop {
            let limit = place.limit;
            kept.limit = limit;
            while place.followed < place.end {
                let (start, end) = (batch(place.followed), batch(place.end));
                let end = end.min(start.saturating_add(piece));
                let rows = self.follow_some(&open[start..end], limit, counted)?;
                place.followed = end as u64;
                if saving {
                    kept.take(rows.iter().cloned());
                    self.part.failures.sort_unstable();
                    self.part.failures.truncate(LISTED);
                    let rows = rows.into_iter().filter(|row| kept.holds(row)).collect();
                    let part = Part { rows, counts: self.part.counts, failures: self.part.failures.clone() };
                    let anew = std::mem::take(&mut self.anew);
                    self.control.save(Checkpoint { place, anew, part });
                } else {
                    kept.take(rows.into_iter());
                }
            }
            kept.lower(options.early_stopping);
            if batch(place.end) == open.len() {
                return Ok(());
            }
            place.size = place.size.saturating_mul(2).min(largest);
            place.end = batch(place.end.saturating_add(place.size)) as u64;
            place.limit = kept.limit;
        }
    }

    /// Simulate these candidates up to a limit. Return the rows below it.
    fn follow_some(&mut self, open: &[Open], limit: f64, counted: bool) -> Result<Vec<Row>> {
        let (catalogue, control, scratches) = (self.catalogue, self.control, &self.scratches);
        let problem = &catalogue.problem;
        let visit = |candidate: &Open| {
            if control.stopped() {
                return None;
            }
            if candidate.bound > limit {
                return Some((candidate.index, Verdict::Bounded(candidate.bound), None));
            }
            scratches.with(|scratch| {
                let mut positions = std::mem::take(&mut scratch.positions);
                let mut initial = std::mem::take(&mut scratch.initial);
                let cursor = Cursor::at(&catalogue.lattice, candidate.index);
                positions.clear();
                positions.resize(catalogue.lattice.width(), 0);
                catalogue.positions(&cursor, &mut positions);
                catalogue.initial(&cursor, &mut initial);
                let verdict = problem.evaluate(&positions, &initial, limit, false, scratch, control);
                let row = match verdict {
                    Verdict::Score(raw) if raw <= limit => {
                        Some(problem.row(candidate.index, raw, initial.len(), scratch))
                    }
                    _ => None,
                };
                scratch.positions = positions;
                scratch.initial = initial;
                // Candidates excluded by a bound are counted as processed elsewhere.
                if counted && !matches!(verdict, Verdict::Bounded(_)) {
                    control.count(1, u64::from(matches!(verdict, Verdict::Stopped(_))));
                }
                Some((candidate.index, verdict, row))
            })
        };
        let least = if problem.refines() { 1 } else { 4 };
        let results: Vec<_> = self.pool.install(|| open.par_iter().with_min_len(least).map(visit).collect());
        self.check_stop()?;
        let mut rows = Vec::new();
        for (index, verdict, row) in results.into_iter().flatten() {
            if counted {
                self.count(index, verdict);
            }
            rows.extend(row);
        }
        Ok(rows)
    }

    fn count(&mut self, index: u64, verdict: Verdict) {
        match verdict {
            Verdict::Score(_) => self.part.counts.beaten += 1,
            Verdict::Bounded(_) => {
                self.part.counts.bounded += 1;
                self.control.count(1, 1);
            }
            Verdict::Stopped(_) => self.part.counts.stopped += 1,
            Verdict::Failed(failure) => {
                match failure {
                    Failure::Singular => self.part.counts.singular += 1,
                    Failure::Diverged => self.part.counts.diverged += 1,
                }
                self.part.failures.push((index, failure));
            }
        }
    }
}

/// Digest of the evaluation order of candidates, below 2^63 and never 0 (64-bit FNV-1a over their indices).
fn digest(open: &[Open]) -> u64 {
    let bytes = open.iter().flat_map(|candidate| candidate.index.to_le_bytes());
    let whole =
        bytes.fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
    (whole >> 1).max(1)
}

#[cfg(test)]
mod tests {
    use std::borrow::Cow;

    use super::*;
    use crate::order_search::grid::{Lattice, TermAxis};
    use crate::order_search::options::Options;
    use crate::parallel::pool;
    use crate::parallel::Stop;
    use crate::regressors::Record;

    #[test]
    fn boxes_are_used_where_they_exclude_candidates_and_nowhere_else() -> Result<()> {
        let input: Vec<f64> = (0..200).map(|k| if k % 40 < 20 { 1.0 } else { -0.5 }).collect();
        let answer = Record::new(0.05, vec![input.clone()], None)?.integral(0, 0.8);
        let size: f64 = answer.iter().map(|y| y.abs()).sum();
        let record = Record::new(0.05, vec![answer, input], None)?;
        let axis = |signal: usize, from: f64| {
            let values = (0..40).map(|i| from + 0.01 * f64::from(i)).collect();
            TermAxis { signal, values, interchangeable: false }
        };
        let lattice = Lattice::new(0, &[1.4, 1.6], &[axis(0, 0.1), axis(1, 0.6)], |signal| signal == 1)?;
        let (pool, control, options) = (pool(1)?, Control::default(), Options::default());
        let (lattice, fixed) = (Cow::Borrowed(&lattice), [None, None]);
        let catalogue = Catalogue::new(&[record], lattice, &fixed, &options, &pool, &Stop::default())?;
        let boxes = pool.install(|| Boxes::new(&catalogue));
        let hunt = Hunt::new(&catalogue, boxes.as_ref(), &pool, &control);
        assert!(hunt.boxes_exclude(1e-3 * size)?);
        // Nothing exceeds a limit as large.
        assert!(!hunt.boxes_exclude(1e3 * size)?);
        assert!(!Hunt::new(&catalogue, None, &pool, &control).boxes_exclude(1e-3 * size)?);
        control.stop.set();
        assert!(hunt.boxes_exclude(1e-3 * size).is_err());
        Ok(())
    }
}

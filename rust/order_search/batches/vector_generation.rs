//! Generation of tailored and linearized test vectors, as long as they exclude enough candidates.
//!
//! Vectors are built for the candidates in a sample of the grid that no other vector excludes.

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::batches::batch::BatchEvaluation;
use crate::order_search::candidate::problem::SolvedCandidate;
use crate::order_search::dual_bound::linearized_vectors::{LinearizedVector, LinearizedVectors, MAX_OWN_TERMS};
use crate::order_search::dual_bound::tailored_vectors::TailoredVector;
use crate::order_search::grid::traversal::{low_discrepancy_order, Cursor};
use crate::order_search::screening::{screen, sort_by_guess, OpenCandidate};

/// Minimum size of the sample in which open candidates are searched. The first pass uses this size. Later passes use a
/// fraction of a large grid, since few candidates remain open. The sample consists of blocks, because all candidates of
/// a block are usually open, or none.
const MIN_TAILORED_SAMPLE: u64 = 1 << 17;
/// Number of candidates of a large grid per sampled candidate.
const TAILORED_SAMPLE_RATIO: u64 = 512;
/// Number of candidates in a block of this sample.
const TAILORED_SAMPLE_BLOCK: u64 = 16;
const BLOCKS_PER_SCREENING: u64 = 1 << 11;
/// Number of open candidates at which sampling stops.
const OPEN_SAMPLE_CANDIDATES: usize = 512;
/// Maximum number of vectors tried per pass.
const MAX_TRIAL_VECTORS: usize = 32;
/// Maximum number of vectors selected from those tried in a pass.
const MAX_SELECTED_VECTORS: usize = 12;
/// Maximum number of passes.
const MAX_GENERATION_PASSES: u64 = 4;
/// Minimum number of candidates not yet excluded for another pass. One pass costs as much time as simulating this many
/// candidates.
const MIN_OPEN_CANDIDATES: f64 = 16_384.0;
/// Minimum number of candidates that a test vector must exclude to be kept.
const MIN_VECTOR_EXCLUSIONS: f64 = 512.0;
const SELECTION_BIAS_FACTOR: usize = 4;
/// Maximum memory of test vectors, including those on trial \[bytes\].
const MAX_TAILORED_BYTES: u64 = 256 << 20;

/// Result of one pass of vector generation.
#[derive(Default)]
pub(super) struct GeneratedVectors {
    pub(super) vectors: Vec<TailoredVector>,
    /// Candidates of the sample that the vectors leave open.
    pub(super) open: Vec<OpenCandidate>,
    /// True if another pass may be worthwhile.
    pub(super) is_worth_repeating: bool,
}

impl BatchEvaluation<'_> {
    /// Sample of candidates that no bound excludes at this limit, the most promising first. Also returns the number of
    /// candidates that each represents. Each pass draws another sample.
    pub(super) fn sample_open(&self, limit: f64, time: u64) -> Result<(Vec<OpenCandidate>, f64)> {
        let catalogue = self.catalogue;
        let count = catalogue.lattice.count();
        let stretches = count.div_ceil(TAILORED_SAMPLE_BLOCK);
        let share = if time == 0 { 0 } else { count / TAILORED_SAMPLE_RATIO };
        let most = MIN_TAILORED_SAMPLE.max(share).div_ceil(TAILORED_SAMPLE_BLOCK).min(stretches);
        let order = low_discrepancy_order(stretches);
        let (mut open, mut position, mut candidates) = (Vec::new(), 0, 0);
        while position < most && open.len() < OPEN_SAMPLE_CANDIDATES {
            let next = most.min(position + BLOCKS_PER_SCREENING);
            let starts: Vec<u64> =
                (position..next).map(|i| order((time * most + i) % stretches) * TAILORED_SAMPLE_BLOCK).collect();
            candidates += starts.iter().map(|&at| count.min(at + TAILORED_SAMPLE_BLOCK) - at).sum::<u64>();
            let screened = |&at: &u64| screen(catalogue, at, count.min(at + TAILORED_SAMPLE_BLOCK), limit).0;
            open.extend(self.pool.install(|| starts.par_iter().flat_map(screened).collect::<Vec<OpenCandidate>>()));
            self.check_stop()?;
            position = next;
        }
        sort_by_guess(&mut open);
        #[allow(clippy::cast_precision_loss)]
        let each = count as f64 / candidates.max(1) as f64 * open.len() as f64;
        let open = subsample(&open, OPEN_SAMPLE_CANDIDATES);
        #[allow(clippy::cast_precision_loss)]
        let each = each / open.len().max(1) as f64;
        Ok((open, each))
    }

    /// Generate test vectors that together exclude most open candidates at this limit. The first pass includes a vector
    /// for the best row and its neighbors. Empty if the vectors are not worthwhile or memory is lacking.
    pub(super) fn generate_tailored_vectors(
        &self,
        limit: f64,
        time: u64,
        best: Option<u64>,
    ) -> Result<GeneratedVectors> {
        let catalogue = self.catalogue;
        let (lattice, problem) = (&*catalogue.lattice, &catalogue.problem);
        let (mut one, bytes) = problem.empty_tailored_vectors();
        let vector_count = problem.tailored_vectors.as_ref().map_or(0, |adapted| adapted.vectors.len() as u64);
        let room = catalogue.spare_bytes.min(MAX_TAILORED_BYTES.saturating_sub(vector_count * bytes)) / bytes.max(1);
        let room = usize::try_from(room).unwrap_or(MAX_TRIAL_VECTORS).min(MAX_TRIAL_VECTORS);
        if room == 0 {
            return Ok(GeneratedVectors::default());
        }
        let (open, each) = self.sample_open(limit, time)?;
        #[allow(clippy::cast_precision_loss)]
        let all = |count: usize| count as f64 * each;
        let best = best.filter(|_| time == 0);
        if best.is_none() && all(open.len()) < MIN_OPEN_CANDIDATES {
            return Ok(GeneratedVectors { open, ..GeneratedVectors::default() });
        }
        let columns = |index: u64| {
            let mut positions = vec![0; lattice.width()];
            catalogue.positions(&Cursor::at(lattice, index), &mut positions);
            positions
        };
        let some = subsample(&open, room);
        let indices = best.into_iter().chain(some.iter().map(|open| open.index)).take(room);
        let places: Vec<Vec<usize>> = open.iter().map(|open| columns(open.index)).collect();
        let mut excluded: Vec<(TailoredVector, Vec<bool>)> = Vec::new();
        for index in indices {
            one.vectors.extend(self.pool.install(|| problem.tailor_vector(&one, &columns(index))));
            let out = self.pool.install(|| {
                places.par_iter().map(|columns| problem.excluded_by_tailored(&one, columns, limit)).collect()
            });
            excluded.extend(one.vectors.pop().map(|vector| (vector, out)));
            self.check_stop()?;
        }
        let (mut is_open, mut new_vectors) = (vec![true; open.len()], Vec::new());
        let gain = |out: &[bool], is_open: &[bool]| {
            out.iter().zip(is_open).filter(|(out, is_open)| **out && **is_open).count()
        };
        let mut next = best.map(|_| 0);
        while new_vectors.len() < MAX_SELECTED_VECTORS {
            let gains = excluded.iter().map(|(_, out)| gain(out, &is_open)).enumerate();
            let most = gains.max_by(|a, b| a.1.cmp(&b.1).then(b.0.cmp(&a.0)));
            let candidate = next.take().filter(|_| !excluded.is_empty());
            let Some(candidate) =
                candidate.or(most.filter(|(_, most)| all(*most) >= MIN_VECTOR_EXCLUSIONS).map(|(at, _)| at))
            else {
                break;
            };
            let (vector, out) = excluded.swap_remove(candidate);
            new_vectors.push(vector);
            is_open.iter_mut().zip(&out).for_each(|(is_open, out)| *is_open &= !out);
        }
        let is_open: Vec<OpenCandidate> =
            open.into_iter().zip(is_open).filter_map(|(open, is_open)| is_open.then_some(open)).collect();
        // The vectors were selected on this sample, so they leave more of other candidates open.
        let again = time + 1 < MAX_GENERATION_PASSES
            && !new_vectors.is_empty()
            && all(SELECTION_BIAS_FACTOR * is_open.len()) >= MIN_OPEN_CANDIDATES;
        Ok(GeneratedVectors { vectors: new_vectors, open: is_open, is_worth_repeating: again })
    }
}

/// Subsample at most `most` candidates, evenly spaced.
pub(super) fn subsample(all: &[OpenCandidate], most: usize) -> Vec<OpenCandidate> {
    let count = all.len().min(most);
    (0..count).map(|i| all[i * all.len() / count]).collect()
}

/// Maximum size of the sample for linearized vectors. Of a small grid one candidate in eight is sampled.
const MAX_LINEARIZED_SAMPLE: u64 = 1 << 19;
/// Number of candidates of a small grid per sampled candidate.
const LINEARIZED_SAMPLE_RATIO: u64 = 8;
/// Number of candidates in a block of this sample.
const LINEARIZED_SAMPLE_BLOCK: u64 = 8;
/// Minimum number of exclusions per vector, and of open candidates for another vector. Building a vector costs as much
/// as ten to twenty simulations.
const MIN_LINEARIZED_EXCLUSIONS: f64 = 32.0;
/// Maximum number of vectors for the same orders of the output terms.
const MAX_LINEARIZED_VECTORS: usize = 24;
/// Maximum number of vectors in sequence that exclude too few candidates.
const MAX_FAILED_VECTORS: usize = 6;
/// Maximum memory of all vectors \[bytes\].
const MAX_LINEARIZED_BYTES: u64 = 1 << 30;

impl BatchEvaluation<'_> {
    /// Generate vectors for each combination of orders of the output terms, which exclude the open candidates of a
    /// sample. `None` if no vector is worthwhile or memory is lacking.
    pub(super) fn generate_linearized_vectors(&self, limit: f64) -> Result<Option<LinearizedVectors>> {
        let problem = &self.catalogue.problem;
        let mut tangents = problem.empty_linearized_vectors();
        if limit == f64::INFINITY {
            return Ok(None);
        }
        let (open, weight) = self.sample_grid(limit)?;
        let mut groups: BTreeMap<Vec<usize>, Vec<SolvedCandidate>> = BTreeMap::new();
        for (columns, coefficients) in open {
            groups.entry(tangents.own_columns(&columns)).or_default().push((columns, coefficients));
        }
        #[allow(clippy::cast_precision_loss)]
        groups.retain(|own, open| {
            (1..=MAX_OWN_TERMS).contains(&own.len()) && open.len() as f64 * weight >= MIN_LINEARIZED_EXCLUSIONS
        });
        let bytes = groups.keys().map(|own| tangents.bytes(own.len())).max().unwrap_or(1);
        let room = self.catalogue.spare_bytes.min(MAX_LINEARIZED_BYTES) / bytes / (groups.len() as u64).max(1);
        let room = usize::try_from(room).unwrap_or(MAX_LINEARIZED_VECTORS).min(MAX_LINEARIZED_VECTORS);
        let new_vectors: Vec<(Vec<usize>, Vec<LinearizedVector>)> = self.pool.install(|| {
            groups
                .into_iter()
                .collect::<Vec<_>>()
                .into_par_iter()
                .with_max_len(1)
                .map(|(own, open)| {
                    let new_vectors = if self.is_stopped() {
                        Vec::new()
                    } else {
                        self.generate_for_own_columns(&tangents, &own, open, weight, limit, room)
                    };
                    (own, new_vectors)
                })
                .collect()
        });
        self.check_stop()?;
        for (own, new_vectors) in new_vectors {
            if !new_vectors.is_empty() {
                tangents.add(own, new_vectors);
            }
        }
        Ok((tangents.len() > 0).then_some(tangents))
    }

    /// Candidates in a sample of the grid that no bound excludes at this limit, and the number of candidates that each
    /// represents.
    #[allow(clippy::cast_precision_loss)]
    fn sample_grid(&self, limit: f64) -> Result<(Vec<SolvedCandidate>, f64)> {
        let catalogue = self.catalogue;
        let (lattice, problem) = (&*catalogue.lattice, &catalogue.problem);
        let count = lattice.count();
        let stretches = count.div_ceil(LINEARIZED_SAMPLE_BLOCK);
        let order = low_discrepancy_order(stretches);
        let sample_count = (count / LINEARIZED_SAMPLE_RATIO)
            .min(MAX_LINEARIZED_SAMPLE)
            .div_ceil(LINEARIZED_SAMPLE_BLOCK)
            .clamp(1, stretches);
        let open: Vec<SolvedCandidate> = self.pool.install(|| {
            (0..sample_count)
                .into_par_iter()
                .flat_map_iter(|i| {
                    let at = order(i) * LINEARIZED_SAMPLE_BLOCK;
                    let open = if self.is_stopped() {
                        Vec::new()
                    } else {
                        screen(catalogue, at, count.min(at + LINEARIZED_SAMPLE_BLOCK), limit).0
                    };
                    open.into_iter().filter_map(|open| {
                        let mut columns = vec![0; lattice.width()];
                        catalogue.positions(&Cursor::at(lattice, open.index), &mut columns);
                        let coefficients = problem.coefficients(&columns)?;
                        Some((columns, coefficients))
                    })
                })
                .collect()
        });
        self.check_stop()?;
        Ok((open, count as f64 / (sample_count * LINEARIZED_SAMPLE_BLOCK) as f64))
    }

    /// Generate vectors for candidates with the same columns of the output. The first vector is built at the median of
    /// the first coefficient. Then both halves of the candidates are processed likewise.
    fn generate_for_own_columns(
        &self,
        tangents: &LinearizedVectors,
        own: &[usize],
        mut open: Vec<SolvedCandidate>,
        weight: f64,
        limit: f64,
        room: usize,
    ) -> Vec<LinearizedVector> {
        let problem = &self.catalogue.problem;
        let first = |solved: &SolvedCandidate| solved.0.iter().position(|p| *p == own[0]).map_or(0.0, |i| solved.1[i]);
        open.sort_by(|a, b| first(a).total_cmp(&first(b)).then_with(|| a.0.cmp(&b.0)));
        let (mut new_vectors, mut vain) = (Vec::new(), 0);
        let mut parts = vec![open];
        #[allow(clippy::cast_precision_loss)]
        let many = |count: usize| count as f64 * weight >= MIN_LINEARIZED_EXCLUSIONS;
        while let Some(mut part) = parts.pop() {
            if !many(part.len()) || new_vectors.len() >= room || vain >= MAX_FAILED_VECTORS {
                continue;
            }
            let middle = part.remove(part.len() / 2);
            let at = first(&middle);
            let mut gained = false;
            if let Some(tangent) = problem.linearize_vector(tangents, &middle.0, &middle.1, limit) {
                let remaining: Vec<SolvedCandidate> = problem.not_excluded_by(tangents, &tangent, &part, limit);
                gained = many(part.len() + 1 - remaining.len());
                if gained {
                    new_vectors.push(tangent);
                    part = remaining;
                }
            }
            vain += usize::from(!gained);
            let above = part.split_off(part.partition_point(|solved| first(solved) < at));
            parts.push(above);
            parts.push(part);
        }
        new_vectors
    }
}

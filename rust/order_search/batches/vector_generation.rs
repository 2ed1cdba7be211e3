//! Generation of tailored and linearized test vectors, for as long as new vectors exclude enough candidates.
//!
//! A tailored vector is exact for one candidate, and a linearized vector is corrected to first order for others.
//! Vectors are built for the candidates in a sample of the grid that no other vector excludes.

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::batches::batch::BatchEvaluation;
use crate::order_search::candidate::problem::SolvedCandidate;
use crate::order_search::dual_bound::linearized_vectors::{LinearizedVector, LinearizedVectors, MAX_OUTPUT_TERMS};
use crate::order_search::dual_bound::tailored_vectors::TailoredVector;
use crate::order_search::grid::traversal::{low_discrepancy_order, Cursor};
use crate::order_search::screening::{screen, sort_by_guess, OpenCandidate};

/// Minimum number of candidates in the sample from which test vectors are tailored. The first pass samples this number.
/// Later passes sample the number of candidates of the grid divided by [`TAILORED_SAMPLE_RATIO`], if that is more,
/// because most candidates are excluded by then. The sample consists of blocks of consecutive candidates, because
/// usually all candidates of a block are excluded or none.
const MIN_TAILORED_SAMPLE: u64 = 1 << 17;
/// Ratio of the number of candidates of a large grid to the number in the sample for tailored test vectors.
const TAILORED_SAMPLE_RATIO: u64 = 512;
/// Number of consecutive candidates in a block of the sample for tailored test vectors.
const TAILORED_SAMPLE_BLOCK: u64 = 16;
/// Number of blocks of candidates that are screened between two checks of the number of candidates found.
const BLOCKS_PER_SCREENING: u64 = 1 << 11;
/// Number of unexcluded candidates in the sample at which sampling stops.
const OPEN_SAMPLE_CANDIDATES: usize = 512;
/// Maximum number of tailored test vectors that are built in one pass of vector generation.
const MAX_TRIAL_VECTORS: usize = 32;
/// Maximum number of tailored test vectors that are selected from those built in a pass.
const MAX_SELECTED_VECTORS: usize = 12;
/// Maximum number of passes that generate tailored test vectors.
const MAX_GENERATION_PASSES: u64 = 4;
/// Minimum estimated number of candidates of the grid not yet excluded for which another pass of vector generation
/// saves time. One pass takes as long as simulating this many candidates.
const MIN_OPEN_CANDIDATES: f64 = 16_384.0;
/// Minimum estimated number of candidates of the grid that a tailored test vector must exclude to be selected.
const MIN_VECTOR_EXCLUSIONS: f64 = 512.0;
/// Factor on the number of candidates of the sample that the selected test vectors do not exclude. It corrects the bias
/// of the selection: the vectors exclude fewer candidates elsewhere.
const SELECTION_BIAS_FACTOR: usize = 4;
/// Maximum memory of tailored test vectors, including those built but not selected \[bytes\].
const MAX_TAILORED_BYTES: u64 = 256 << 20;

/// Result of one pass that generates tailored test vectors.
#[derive(Default)]
pub(super) struct GeneratedVectors {
    pub(super) vectors: Vec<TailoredVector>,
    /// Candidates of the sample that the vectors do not exclude.
    pub(super) open: Vec<OpenCandidate>,
    /// True if another pass of vector generation may save time.
    pub(super) is_worth_repeating: bool,
}

impl BatchEvaluation<'_> {
    /// Return a sample of candidates that no bound excludes at this limit of the raw score (Σ|e| or Σe²), in ascending
    /// order of their estimated score. Also return the number of candidates of the grid per sampled candidate. Each
    /// pass draws another sample.
    pub(super) fn sample_open(&self, limit: f64, pass: u64) -> Result<(Vec<OpenCandidate>, f64)> {
        let candidate_index = self.candidate_index;
        let count = candidate_index.grid.count();
        let block_count = count.div_ceil(TAILORED_SAMPLE_BLOCK);
        let sample_size = if pass == 0 { 0 } else { count / TAILORED_SAMPLE_RATIO };
        let max_blocks = MIN_TAILORED_SAMPLE.max(sample_size).div_ceil(TAILORED_SAMPLE_BLOCK).min(block_count);
        let order = low_discrepancy_order(block_count);
        let (mut open, mut position, mut candidates) = (Vec::new(), 0, 0);
        while position < max_blocks && open.len() < OPEN_SAMPLE_CANDIDATES {
            let next = max_blocks.min(position + BLOCKS_PER_SCREENING);
            let starts: Vec<u64> = (position..next)
                .map(|i| order((pass * max_blocks + i) % block_count) * TAILORED_SAMPLE_BLOCK)
                .collect();
            candidates += starts.iter().map(|&start| count.min(start + TAILORED_SAMPLE_BLOCK) - start).sum::<u64>();
            let screen_block =
                |&start: &u64| screen(candidate_index, start, count.min(start + TAILORED_SAMPLE_BLOCK), limit).0;
            open.extend(self.pool.install(|| starts.par_iter().flat_map(screen_block).collect::<Vec<OpenCandidate>>()));
            self.check_stop()?;
            position = next;
        }
        sort_by_guess(&mut open);
        #[allow(clippy::cast_precision_loss)]
        let weight = count as f64 / candidates.max(1) as f64 * open.len() as f64;
        let open = subsample(&open, OPEN_SAMPLE_CANDIDATES);
        #[allow(clippy::cast_precision_loss)]
        let weight = weight / open.len().max(1) as f64;
        Ok((open, weight))
    }

    /// Generate tailored test vectors that together exclude as many as possible of the candidates not yet excluded at
    /// this limit of the raw score (Σ|e| or Σe²). The first pass (`pass` 0) includes a vector for the best row. The
    /// result has no vectors if they save no time or memory is lacking.
    pub(super) fn generate_tailored_vectors(
        &self,
        limit: f64,
        pass: u64,
        best: Option<u64>,
    ) -> Result<GeneratedVectors> {
        let candidate_index = self.candidate_index;
        let (grid, problem) = (&*candidate_index.grid, &candidate_index.problem);
        let (mut trial_vectors, bytes) = problem.empty_tailored_vectors();
        let vector_count = problem.tailored_vectors.as_ref().map_or(0, |tailored| tailored.vectors.len() as u64);
        let max_count =
            candidate_index.spare_bytes.min(MAX_TAILORED_BYTES.saturating_sub(vector_count * bytes)) / bytes.max(1);
        let max_count = usize::try_from(max_count).unwrap_or(MAX_TRIAL_VECTORS).min(MAX_TRIAL_VECTORS);
        if max_count == 0 {
            return Ok(GeneratedVectors::default());
        }
        let (open, weight) = self.sample_open(limit, pass)?;
        #[allow(clippy::cast_precision_loss)]
        let total = |count: usize| count as f64 * weight;
        let best = best.filter(|_| pass == 0);
        if best.is_none() && total(open.len()) < MIN_OPEN_CANDIDATES {
            return Ok(GeneratedVectors { open, ..GeneratedVectors::default() });
        }
        let columns = |index: u64| {
            let mut positions = vec![0; grid.width()];
            candidate_index.positions(&Cursor::at(grid, index), &mut positions);
            positions
        };
        let sample = subsample(&open, max_count);
        let indices = best.into_iter().chain(sample.iter().map(|open| open.index)).take(max_count);
        let candidate_columns: Vec<Vec<usize>> = open.iter().map(|open| columns(open.index)).collect();
        let mut exclusions: Vec<(TailoredVector, Vec<bool>)> = Vec::new();
        for index in indices {
            trial_vectors.vectors.extend(self.pool.install(|| problem.tailor_vector(&trial_vectors, &columns(index))));
            let flags = self.pool.install(|| {
                candidate_columns
                    .par_iter()
                    .map(|columns| problem.excluded_by_tailored(&trial_vectors, columns, limit))
                    .collect()
            });
            exclusions.extend(trial_vectors.vectors.pop().map(|vector| (vector, flags)));
            self.check_stop()?;
        }
        let (mut is_open, mut new_vectors) = (vec![true; open.len()], Vec::new());
        let gain = |flags: &[bool], is_open: &[bool]| {
            flags.iter().zip(is_open).filter(|(flag, is_open)| **flag && **is_open).count()
        };
        let mut next = best.map(|_| 0);
        while new_vectors.len() < MAX_SELECTED_VECTORS {
            let gains = exclusions.iter().map(|(_, flags)| gain(flags, &is_open)).enumerate();
            let largest_gain = gains.max_by(|a, b| a.1.cmp(&b.1).then(b.0.cmp(&a.0)));
            let candidate = next.take().filter(|_| !exclusions.is_empty());
            let Some(candidate) = candidate
                .or(largest_gain.filter(|(_, gain)| total(*gain) >= MIN_VECTOR_EXCLUSIONS).map(|(index, _)| index))
            else {
                break;
            };
            let (vector, flags) = exclusions.swap_remove(candidate);
            new_vectors.push(vector);
            is_open.iter_mut().zip(&flags).for_each(|(is_open, flag)| *is_open &= !flag);
        }
        let is_open: Vec<OpenCandidate> =
            open.into_iter().zip(is_open).filter_map(|(open, is_open)| is_open.then_some(open)).collect();
        // The vectors were selected on this sample, so they exclude a smaller fraction of other candidates.
        let is_worth_repeating = pass + 1 < MAX_GENERATION_PASSES
            && !new_vectors.is_empty()
            && total(SELECTION_BIAS_FACTOR * is_open.len()) >= MIN_OPEN_CANDIDATES;
        Ok(GeneratedVectors { vectors: new_vectors, open: is_open, is_worth_repeating })
    }
}

/// Return at most `max_count` of the candidates, evenly spaced in the list.
pub(super) fn subsample(candidates: &[OpenCandidate], max_count: usize) -> Vec<OpenCandidate> {
    let count = candidates.len().min(max_count);
    (0..count).map(|i| candidates[i * candidates.len() / count]).collect()
}

/// Maximum number of candidates in the sample for linearized test vectors. One in eight candidates of a small grid is
/// sampled.
const MAX_LINEARIZED_SAMPLE: u64 = 1 << 19;
/// Ratio of the number of candidates of a small grid to the number in the sample for linearized test vectors.
const LINEARIZED_SAMPLE_RATIO: u64 = 8;
/// Number of consecutive candidates in a block of the sample for linearized test vectors.
const LINEARIZED_SAMPLE_BLOCK: u64 = 8;
/// Minimum number of candidates of the grid that a linearized test vector must exclude. Another vector is built only if
/// at least this number of candidates is not yet excluded. Building a vector costs as much as ten to twenty
/// simulations.
const MIN_LINEARIZED_EXCLUSIONS: f64 = 32.0;
/// Maximum number of linearized test vectors per combination of orders of the output terms.
const MAX_LINEARIZED_VECTORS: usize = 24;
/// Maximum number of linearized test vectors that exclude too few candidates, per combination of orders of the output
/// terms.
const MAX_FAILED_VECTORS: usize = 6;
/// Maximum memory of all linearized test vectors \[bytes\].
const MAX_LINEARIZED_BYTES: u64 = 1 << 30;

impl BatchEvaluation<'_> {
    /// Generate linearized test vectors for each combination of orders of the output terms. They are built for the
    /// candidates of a sample that no other bound excludes at this limit of the raw score (Σ|e| or Σe²). `None` if no
    /// vector saves time or memory is lacking.
    pub(super) fn generate_linearized_vectors(&self, limit: f64) -> Result<Option<LinearizedVectors>> {
        let problem = &self.candidate_index.problem;
        let mut linearized_vectors = problem.empty_linearized_vectors();
        if limit == f64::INFINITY {
            return Ok(None);
        }
        let (open, weight) = self.sample_grid(limit)?;
        let mut groups: BTreeMap<Vec<usize>, Vec<SolvedCandidate>> = BTreeMap::new();
        for (columns, coefficients) in open {
            groups.entry(linearized_vectors.output_columns(&columns)).or_default().push((columns, coefficients));
        }
        #[allow(clippy::cast_precision_loss)]
        groups.retain(|output_columns, open| {
            (1..=MAX_OUTPUT_TERMS).contains(&output_columns.len())
                && open.len() as f64 * weight >= MIN_LINEARIZED_EXCLUSIONS
        });
        let bytes =
            groups.keys().map(|output_columns| linearized_vectors.bytes(output_columns.len())).max().unwrap_or(1);
        let max_count =
            self.candidate_index.spare_bytes.min(MAX_LINEARIZED_BYTES) / bytes / (groups.len() as u64).max(1);
        let max_count = usize::try_from(max_count).unwrap_or(MAX_LINEARIZED_VECTORS).min(MAX_LINEARIZED_VECTORS);
        let new_vectors: Vec<(Vec<usize>, Vec<LinearizedVector>)> = self.pool.install(|| {
            groups
                .into_iter()
                .collect::<Vec<_>>()
                .into_par_iter()
                .with_max_len(1)
                .map(|(output_columns, open)| {
                    let new_vectors = if self.is_stopped() {
                        Vec::new()
                    } else {
                        self.generate_for_output_columns(
                            &linearized_vectors,
                            &output_columns,
                            open,
                            weight,
                            limit,
                            max_count,
                        )
                    };
                    (output_columns, new_vectors)
                })
                .collect()
        });
        self.check_stop()?;
        for (output_columns, new_vectors) in new_vectors {
            if !new_vectors.is_empty() {
                linearized_vectors.add(output_columns, new_vectors);
            }
        }
        Ok((linearized_vectors.len() > 0).then_some(linearized_vectors))
    }

    /// Return columns and coefficients of the candidates in a sample of the grid that no bound excludes at this limit
    /// of the raw score (Σ|e| or Σe²). Also return the number of candidates of the grid per sampled candidate.
    #[allow(clippy::cast_precision_loss)]
    fn sample_grid(&self, limit: f64) -> Result<(Vec<SolvedCandidate>, f64)> {
        let candidate_index = self.candidate_index;
        let (grid, problem) = (&*candidate_index.grid, &candidate_index.problem);
        let count = grid.count();
        let block_count = count.div_ceil(LINEARIZED_SAMPLE_BLOCK);
        let order = low_discrepancy_order(block_count);
        let sample_count = (count / LINEARIZED_SAMPLE_RATIO)
            .min(MAX_LINEARIZED_SAMPLE)
            .div_ceil(LINEARIZED_SAMPLE_BLOCK)
            .clamp(1, block_count);
        let open: Vec<SolvedCandidate> = self.pool.install(|| {
            (0..sample_count)
                .into_par_iter()
                .flat_map_iter(|i| {
                    let start = order(i) * LINEARIZED_SAMPLE_BLOCK;
                    let open = if self.is_stopped() {
                        Vec::new()
                    } else {
                        screen(candidate_index, start, count.min(start + LINEARIZED_SAMPLE_BLOCK), limit).0
                    };
                    open.into_iter().filter_map(|open| {
                        let mut columns = vec![0; grid.width()];
                        candidate_index.positions(&Cursor::at(grid, open.index), &mut columns);
                        let coefficients = problem.coefficients(&columns)?;
                        Some((columns, coefficients))
                    })
                })
                .collect()
        });
        self.check_stop()?;
        Ok((open, count as f64 / (sample_count * LINEARIZED_SAMPLE_BLOCK) as f64))
    }

    /// Generate linearized test vectors for candidates with the same output columns `output_columns`. The first vector
    /// is built for the candidate at the median of the first output coefficient. The remaining candidates on each side
    /// of the median are then processed in the same way. `weight` is the number of candidates of the grid per sampled
    /// candidate, `max_count` the maximum number of vectors.
    fn generate_for_output_columns(
        &self,
        linearized_vectors: &LinearizedVectors,
        output_columns: &[usize],
        mut open: Vec<SolvedCandidate>,
        weight: f64,
        limit: f64,
        max_count: usize,
    ) -> Vec<LinearizedVector> {
        let problem = &self.candidate_index.problem;
        let first = |candidate: &SolvedCandidate| {
            candidate.0.iter().position(|p| *p == output_columns[0]).map_or(0.0, |i| candidate.1[i])
        };
        open.sort_by(|a, b| first(a).total_cmp(&first(b)).then_with(|| a.0.cmp(&b.0)));
        let (mut new_vectors, mut failure_count) = (Vec::new(), 0);
        let mut parts = vec![open];
        #[allow(clippy::cast_precision_loss)]
        let is_worthwhile = |count: usize| count as f64 * weight >= MIN_LINEARIZED_EXCLUSIONS;
        while let Some(mut part) = parts.pop() {
            if !is_worthwhile(part.len()) || new_vectors.len() >= max_count || failure_count >= MAX_FAILED_VECTORS {
                continue;
            }
            let middle = part.remove(part.len() / 2);
            let median = first(&middle);
            let mut is_useful = false;
            if let Some(linearized_vector) = problem.linearize_vector(linearized_vectors, &middle.0, &middle.1, limit) {
                let remaining: Vec<SolvedCandidate> =
                    problem.not_excluded_by(linearized_vectors, &linearized_vector, &part, limit);
                is_useful = is_worthwhile(part.len() + 1 - remaining.len());
                if is_useful {
                    new_vectors.push(linearized_vector);
                    part = remaining;
                }
            }
            failure_count += usize::from(!is_useful);
            let above = part.split_off(part.partition_point(|candidate| first(candidate) < median));
            parts.push(above);
            parts.push(part);
        }
        new_vectors
    }
}

//! Evaluator of an order search. It is parallel, reproducible and interruptible, and it counts the outcome of every
//! candidate.
//!
//! Candidates are processed in batches. The coefficients of all candidates of a batch are computed in parallel SIMD
//! lanes, and a lower bound excludes most candidates. The remaining ones are simulated in ascending order of an
//! estimate of their score. Each simulation stops once its partial sum exceeds the worst score in the result table. An
//! excluded candidate cannot enter the table. The table therefore equals that of brute force. Candidates of equal score
//! are sorted by index.
//!
//! Successive batches form generations of 1, 2, 4, … batches. The result of a batch depends only on the batch and on
//! the rows found before its generation. Result and counts are therefore bitwise reproducible on processors of one
//! kind. They do not depend on the number of threads, the machine (with the same vector instructions), or a restart
//! from a checkpoint. On another kind of processor the last digits may differ, because dense products and transforms
//! select their kernels by instruction set.

use std::borrow::Cow;
use std::sync::atomic::Ordering;

use crate::error::Result;
use crate::order_search::batches::batch::BatchEvaluation;
use crate::order_search::batches::incumbent::InitialIncumbent;
use crate::order_search::batches::vector_generation::GeneratedVectors;
use crate::order_search::branch_and_bound::BranchAndBound;
use crate::order_search::candidate_index::CandidateIndex;
use crate::order_search::control::{mismatch_error, BatchPosition, Checkpoint, Control};
use crate::order_search::grid::independent::OrderGrid;
use crate::order_search::grid::traversal::low_discrepancy_order;
use crate::order_search::options::Options;
use crate::order_search::result::{Counts, Outcome, Part, Row, TopRows};
use crate::parallel::pool;
use crate::regressors::Record;

/// Search an order grid for one equation on one or several records.
///
/// The slice `fixed` has one entry per term, `None` for a free coefficient. The result table equals that of brute force
/// for any number of threads.
///
/// # Errors
/// An option out of range, records that lack a signal of the equation, a wrong number of fixed coefficients, or
/// regressors beyond the memory limit. Also threads that cannot be started, or a stop request
/// ([`crate::error::Error::Interrupted`]).
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::order_search::control::Control;
/// # use ftlm::order_search::grid::{OrderGrid, TermAxis};
/// # use ftlm::order_search::options::Options;
/// # use ftlm::order_search::batches::search;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.8);
/// // y is the integral of order 0.8 of u: D^0.8 y = u.
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
/// let order = TermAxis { signal: 1, values: vec![0.0], interchangeable: false };
/// let grid = OrderGrid::new(0, &[0.6, 0.7, 0.8, 0.9], &[order], |signal| signal == 1)?;
/// let found = search(&[record], &grid, &[None], &Options::default(), &Control::default())?;
/// assert_eq!(grid.structure(found.rows[0].index).order, 0.8);
/// assert!((found.rows[0].coefficients[0] - 1.0).abs() < 1e-9);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn search(
    records: &[Record],
    grid: &OrderGrid,
    fixed: &[Option<f64>],
    options: &Options,
    control: &Control,
) -> Result<Outcome> {
    let pool = pool(options.threads)?;
    let evaluator = BatchEvaluator::new(records, Cow::Borrowed(grid), fixed, options, &pool, control)?;
    let mut all = Part::default();
    let mut first = 0;
    for last in generation_ends(batch_count(grid.count(), options)) {
        let seed = all.seed();
        all.merge(evaluator.evaluate_batches(first, last, &seed, None, &pool, control)?, options.top);
        first = last;
    }
    Ok(all.outcome(options.norm, evaluator.candidate_index.problem.samples()))
}

/// Evaluator of an order search, with the data that all batches share.
pub struct BatchEvaluator<'a> {
    candidate_index: CandidateIndex<'a>,
    /// Branch and bound over boxes of candidates, if it saves time.
    boxes: Option<BranchAndBound>,
    /// Raw score (Σ|e| or Σe²) above which no candidate can enter the table, from an initial sample of candidates.
    limit: f64,
}

impl<'a> BatchEvaluator<'a> {
    /// Build the data shared by all batches: regressors, their inner products, test vectors and an initial limit of the
    /// score.
    ///
    /// # Errors
    /// The errors of [`search`]: an option out of range, signals that the records lack, too little memory, or a stop
    /// request.
    pub fn new(
        records: &[Record],
        grid: Cow<'a, OrderGrid>,
        fixed: &[Option<f64>],
        options: &Options,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<Self> {
        let count = grid.count();
        let mut candidate_index = CandidateIndex::new(records, grid, fixed, options, pool, &control.stop)?;
        control.total.store(count, Ordering::Relaxed);
        control.check_stop()?;
        let problem = &candidate_index.problem;
        // An initial sample of few refined candidates would cost as much as the search.
        let is_small = problem.refines() && count <= MAX_UNSAMPLED_CANDIDATES;
        if is_small || (problem.bound.is_none() && problem.residual_sums.is_none()) {
            return Ok(Self { candidate_index, boxes: None, limit: f64::INFINITY });
        }
        let uses_boxes = count >= MIN_BOX_CANDIDATES && BranchAndBound::is_worthwhile(&candidate_index);
        let may_use_expensive_bounds = uses_expensive_bounds(count, options);
        let InitialIncumbent { mut top_rows, mut evaluated, needs_expensive_bounds, selected_vectors: selected } =
            BatchEvaluation::new(&candidate_index, None, pool, control)
                .find_incumbent(uses_boxes, may_use_expensive_bounds)?;
        if let Some(selected) = selected {
            let problem = &mut candidate_index.problem;
            problem.bound = problem.bound.take().map(|bound| bound.select_vectors(&selected));
        }
        // The Gram matrix determines squared equation errors completely.
        if uses_boxes && candidate_index.problem.residual_sums.is_none() && top_rows.limit < f64::INFINITY {
            let (tailored, bytes) = candidate_index.problem.empty_tailored_vectors();
            candidate_index.problem.tailored_vectors = Some(tailored);
            for pass in 0.. {
                let best = top_rows.rows.first().map(|row| row.index);
                let GeneratedVectors { vectors, open: candidates, is_worth_repeating: repeats } =
                    BatchEvaluation::new(&candidate_index, None, pool, control).generate_tailored_vectors(
                        top_rows.limit,
                        pass,
                        best,
                    )?;
                candidate_index.spare_bytes =
                    candidate_index.spare_bytes.saturating_sub(bytes.saturating_mul(vectors.len() as u64));
                if let Some(tailored) = &mut candidate_index.problem.tailored_vectors {
                    tailored.vectors.extend(vectors);
                }
                // Candidates that no test vector excludes are likely to have a low score.
                BatchEvaluation::new(&candidate_index, None, pool, control).refine_from(
                    &candidates,
                    &mut top_rows,
                    &mut evaluated,
                )?;
                if !repeats {
                    break;
                }
            }
        }
        let limit = top_rows.limit;
        if needs_expensive_bounds {
            let spare_bytes = candidate_index.spare_bytes;
            candidate_index.spare_bytes -= pool.install(|| candidate_index.problem.add_unstable_zeros(spare_bytes));
            let linearized_vectors =
                BatchEvaluation::new(&candidate_index, None, pool, control).generate_linearized_vectors(limit)?;
            if let Some(linearized_vectors) = linearized_vectors {
                candidate_index.spare_bytes =
                    candidate_index.spare_bytes.saturating_sub(linearized_vectors.memory_bytes());
                candidate_index.problem.linearized_vectors = Some(linearized_vectors);
            }
        }
        let mut boxes = pool.install(|| if uses_boxes { BranchAndBound::new(&candidate_index) } else { None });
        control.check_stop()?;
        // Boxes and tailored test vectors may fail to exclude the candidates of the initial sample that are still to be
        // simulated.
        if needs_expensive_bounds
            && boxes.is_some()
            && !BatchEvaluation::new(&candidate_index, boxes.as_ref(), pool, control).boxes_are_worthwhile(limit)?
        {
            boxes = None;
            candidate_index.problem.tailored_vectors = None;
        }
        Ok(Self { candidate_index, boxes, limit })
    }

    /// Evaluate batches `first … last − 1`, and return their counts and best rows. The batches must belong to one
    /// generation ([`generation_ends`]).
    ///
    /// `seed` lists index and raw score (Σ|e| or Σe²) of the best rows found before the generation. `start_checkpoint`
    /// resumes a checkpoint of the same range and seed. The checkpoint must contain all rows found since the start of
    /// the range. The range is restarted if the checkpoint belongs to another evaluation sequence, which may occur on
    /// another kind of processor.
    ///
    /// # Errors
    /// [`crate::error::Error::Interrupted`] after a stop request. [`crate::error::Error::Structure`] for batches, a
    /// seed or a checkpoint of another search.
    ///
    /// ```
    /// # use ftlm::signal::block_pulse::PulseMeans;
    /// # use std::borrow::Cow;
    /// # use ftlm::order_search::control::Control;
    /// # use ftlm::order_search::grid::{OrderGrid, TermAxis};
    /// # use ftlm::order_search::options::Options;
    /// # use ftlm::order_search::result::Part;
    /// # use ftlm::order_search::batches::{batch_count, generation_ends, BatchEvaluator};
    /// # use ftlm::parallel::pool;
    /// # use ftlm::regressors::Record;
    /// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
    /// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.8);
    /// # let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
    /// # let order = TermAxis { signal: 1, values: vec![0.0], interchangeable: false };
    /// # let grid = OrderGrid::new(0, &[0.6, 0.7, 0.8, 0.9], &[order], |signal| signal == 1)?;
    /// let (options, control, pool) = (Options::default(), Control::default(), pool(1)?);
    /// let evaluator = BatchEvaluator::new(&[record], Cow::Borrowed(&grid), &[None], &options, &pool, &control)?;
    /// let (mut all, mut first) = (Part::default(), 0);
    /// for last in generation_ends(batch_count(grid.count(), &options)) {
    ///     let seed = all.seed();
    ///     all.merge(evaluator.evaluate_batches(first, last, &seed, None, &pool, &control)?, options.top);
    ///     first = last;
    /// }
    /// assert_eq!(all.counts.candidates, 4);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn evaluate_batches(
        &self,
        first: u64,
        last: u64,
        seed: &[(u64, f64)],
        start_checkpoint: Option<Checkpoint>,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<Part> {
        let CandidateIndex { grid, options, .. } = &self.candidate_index;
        let count = grid.count();
        let (all, length) = (batch_count(count, options), batch_size(count, options));
        let is_first = start_checkpoint.is_none();
        let start_checkpoint = start_checkpoint.unwrap_or_else(|| Checkpoint {
            position: BatchPosition::start(first),
            replaces_previous: true,
            part: Part::default(),
        });
        if !(first <= start_checkpoint.position.batch && start_checkpoint.position.batch <= last && last <= all) {
            let what =
                format!("batches {first} to {last} from {} on are not among {all}", start_checkpoint.position.batch);
            return Err(mismatch_error(what));
        }
        if !start_checkpoint.position.is_valid() {
            let BatchPosition { evaluated_count: evaluated, end, size, limit, .. } = start_checkpoint.position;
            return Err(mismatch_error(format!(
                "a checkpoint stands at {evaluated} of {end} ({size} at a time, limit {limit})"
            )));
        }
        if let Some((index, score)) = seed.iter().find(|(index, score)| *index >= count || is_invalid_score(*score)) {
            return Err(mismatch_error(format!("a row of score {score} has index {index} among {count} candidates")));
        }
        self.check(&start_checkpoint.part)?;
        // Batches are distributed over the grid. Early generations therefore sample all of it, and later ones start
        // with a low limit.
        let order = low_discrepancy_order(all);
        let mut evaluation = BatchEvaluation::new(&self.candidate_index, self.boxes.as_ref(), pool, control);
        let Checkpoint { mut position, part, .. } = start_checkpoint;
        control.total.store(count, Ordering::Relaxed);
        let processed = part.counts.processed_count();
        control.count(processed, 0);
        evaluation.result = part;
        evaluation.replaces_previous = is_first;
        while position.batch < last {
            let start = order(position.batch) * length;
            let bounds = (start, count.min(start + length));
            let is_in_batch = |row: &Row| bounds.0 <= row.index && row.index < bounds.1;
            let mut top_rows = TopRows::new(options.top, self.limit);
            let seeds = seed.iter().map(|&(index, score)| Row { index, score, coefficients: vec![], initial: vec![] });
            top_rows.insert_rows(seeds);
            top_rows.lower_limit(options.pruning);
            top_rows.insert_rows(evaluation.result.rows.iter().filter(|row| is_in_batch(row)).cloned());
            evaluation.result.rows.retain(|row| !is_in_batch(row));
            if !evaluation.evaluate_batch(bounds, &mut top_rows, position)? {
                // Some candidates would be evaluated twice or never, so the result of the checkpoint is discarded.
                control.finished_count.fetch_sub(processed, Ordering::Relaxed);
                (evaluation.result, evaluation.replaces_previous, position) =
                    (Part::default(), true, BatchPosition::start(first));
                continue;
            }
            let part = Part {
                rows: top_rows.rows.into_iter().filter(is_in_batch).collect(),
                counts: Counts { candidates: bounds.1 - bounds.0, ..Counts::default() },
                failures: Vec::new(),
            };
            evaluation.result.merge(part, options.top);
            position = BatchPosition::start(position.batch + 1);
        }
        Ok(evaluation.result)
    }

    /// Return [`crate::error::Error::Structure`] for a partial result that belongs to another search.
    fn check(&self, part: &Part) -> Result<()> {
        let (count, width) = (self.candidate_index.grid.count(), self.candidate_index.grid.width());
        let other = |row: &Row| row.coefficients.len() != width || row.index >= count || is_invalid_score(row.score);
        if part.rows.iter().any(other) || part.failures.iter().any(|failure| failure.0 >= count) {
            return Err(mismatch_error("a checkpoint holds rows of another search".into()));
        }
        let processed = part.counts.processed_count();
        if part.counts.excluded_by_box > part.counts.excluded_by_bound {
            let Counts { excluded_by_box: boxed, excluded_by_bound: bounded, .. } = part.counts;
            return Err(mismatch_error(format!(
                "a checkpoint has {boxed} candidates in boxes among {bounded} excluded ones"
            )));
        }
        if processed > count || part.counts.candidates > count {
            return Err(mismatch_error(format!(
                "a checkpoint accounts for {processed} candidates, but there are {count}"
            )));
        }
        Ok(())
    }
}

/// Return true if a value cannot be a raw score (Σ|e| or Σe²).
fn is_invalid_score(score: f64) -> bool {
    score.is_nan() || score < 0.0
}

/// Number of candidates per batch if they are ranked by the Gram matrix alone (16 ns per candidate). A batch takes long
/// enough to justify sending it to another machine, and is short enough that its loss is acceptable.
const BATCH_SIZE_GRAM: u64 = 1 << 18;
/// Number of candidates per batch if lower bounds exclude candidates before simulation (about 1 µs per candidate).
const BATCH_SIZE_BOUNDED: u64 = 1 << 16;
/// Number of candidates per batch if all are simulated.
const BATCH_SIZE_SIMULATED: u64 = 1 << 12;
/// Minimum number of candidates in a search that uses branch and bound over boxes. Above it, the batch size grows with
/// the grid up to [`MAX_BATCH_SIZE`], because tables of a slice that two batches share are computed twice.
pub(super) const MIN_BOX_CANDIDATES: u64 = 1 << 25;
/// Maximum number of candidates per batch.
const MAX_BATCH_SIZE: u64 = 1 << 22;
/// Minimum number of candidates in a search that uses the expensive bounds (unstable zeros and linearized test
/// vectors). These bounds apply only if candidates are ranked by simulation. A smaller search would end before these
/// bounds are built.
const MIN_CLOSE_BOUND_CANDIDATES: u64 = 1 << 18;
/// Maximum number of candidates, one batch, of a search with refined coefficients that skips the initial sample.
pub(super) const MAX_UNSAMPLED_CANDIDATES: u64 = BATCH_SIZE_SIMULATED;

/// Return true if a search over `candidates` candidates may use the expensive bounds (unstable zeros and linearized
/// test vectors).
pub(super) fn uses_expensive_bounds(candidates: u64, options: &Options) -> bool {
    candidates >= MIN_CLOSE_BOUND_CANDIDATES && options.ranks_by_simulation()
}

/// Return the number of candidates per batch for a search over `candidates` candidates.
pub(super) fn batch_size(candidates: u64, options: &Options) -> u64 {
    if options.refines() || !options.pruning {
        BATCH_SIZE_SIMULATED
    } else if candidates >= MIN_BOX_CANDIDATES {
        (candidates / (MIN_BOX_CANDIDATES / BATCH_SIZE_BOUNDED))
            .next_power_of_two()
            .clamp(BATCH_SIZE_BOUNDED, MAX_BATCH_SIZE)
    } else if options.ranks_by_gram_matrix() {
        BATCH_SIZE_GRAM
    } else {
        BATCH_SIZE_BOUNDED
    }
}

/// Return the number of batches of a search over this many candidates.
#[must_use]
pub fn batch_count(candidates: u64, options: &Options) -> u64 {
    candidates.div_ceil(batch_size(candidates, options))
}

/// Return the end of each generation of batches: 1, 3, 7, … and finally the number `rounds` of batches. Each of these
/// numbers is that of the first batch after the generation.
///
/// ```
/// # use ftlm::order_search::options::Options;
/// # use ftlm::order_search::batches::{batch_count, generation_ends};
/// let batches = batch_count(400_000, &Options::default());
/// assert_eq!((batches, generation_ends(batches)), (7, vec![1, 3, 7]));
/// ```
#[must_use]
pub fn generation_ends(rounds: u64) -> Vec<u64> {
    let mut ends = Vec::new();
    let mut end: u64 = 0;
    while end < rounds {
        end = end.saturating_mul(2).saturating_add(1).min(rounds);
        ends.push(end);
    }
    ends
}

//! Evaluator of an order search: parallel, reproducible, stoppable, with every candidate counted.
//!
//! Candidates are processed in batches. All candidates of a batch get coefficients in parallel lanes, and a lower
//! bound excludes most of them. The others are simulated in the order of their score estimates. Each simulation stops
//! once its partial sum exceeds the worst score in the table. An excluded candidate cannot enter the table, so the
//! table equals that of brute force, ties by index.
//!
//! Generations hold 1, 2, 4, … batches. A batch depends only on the rows found before its generation and on its own.
//! Its result and counts are therefore bitwise reproducible on processors of one kind: with any number of threads, on
//! another machine with the same vector instructions, or after resuming from a checkpoint. On another kind of
//! processor the last digits may differ, because dense products and transforms select their kernels by instruction
//! set.

use std::borrow::Cow;
use std::sync::atomic::Ordering;

use crate::error::Result;
use crate::order_search::batches::batch::Hunt;
use crate::order_search::batches::incumbent::Scouted;
use crate::order_search::batches::vector_generation::Made;
use crate::order_search::branch_and_bound::Boxes;
use crate::order_search::candidate_index::Catalogue;
use crate::order_search::control::{another, Checkpoint, Control, Place};
use crate::order_search::grid::independent::Lattice;
use crate::order_search::grid::traversal::visit;
use crate::order_search::options::{Criterion, Options};
use crate::order_search::result::{Counts, Kept, Outcome, Part, Row};
use crate::parallel::pool;
use crate::regressors::Record;

/// Search an order grid for one equation on one or several records.
///
/// The slice `fixed` holds the fixed coefficients, one entry per term. The table equals that of brute force for any
/// number of threads.
///
/// # Errors
/// An option out of range, records without the signals of the equation, a number of fixed coefficients unlike the
/// number of terms, regressors beyond the memory limit, threads that do not start,
/// [`crate::error::Error::Interrupted`].
///
/// ```
/// # use ftlm::order_search::control::Control;
/// # use ftlm::order_search::grid::{Lattice, TermAxis};
/// # use ftlm::order_search::options::Options;
/// # use ftlm::order_search::batches::evaluator::search;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output = Record::new(0.1, vec![input.clone()], None)?.integral(0, 0.8);
/// // y is the integral of order 0.8 of u: D^0.8 y = u.
/// let record = Record::new(0.1, vec![output, input], None)?;
/// let order = TermAxis { signal: 1, values: vec![0.0], interchangeable: false };
/// let lattice = OrderGrid::new(0, &[0.6, 0.7, 0.8, 0.9], &[order], |signal| signal == 1)?;
/// let found = search(&[record], &lattice, &[None], &Options::default(), &Control::default())?;
/// assert_eq!(lattice.structure(found.rows[0].index).order, 0.8);
/// assert!((found.rows[0].coefficients[0] - 1.0).abs() < 1e-9);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn search(
    records: &[Record],
    lattice: &Lattice,
    fixed: &[Option<f64>],
    options: &Options,
    control: &Control,
) -> Result<Outcome> {
    let pool = pool(options.threads)?;
    let ready = Search::new(records, Cow::Borrowed(lattice), fixed, options, &pool, control)?;
    let mut all = Part::default();
    let mut first = 0;
    for last in waves(rounds(lattice.count(), options)) {
        let seed = all.seed();
        all.join(ready.rounds(first, last, &seed, None, &pool, control)?, options.keep);
        first = last;
    }
    Ok(all.outcome(options.norm, ready.catalogue.problem.samples()))
}

/// Evaluator of an order search, prepared for its batches.
pub struct Search<'a> {
    catalogue: Catalogue<'a>,
    /// Branch and bound, if it excludes whole boxes of candidates.
    boxes: Option<Boxes>,
    /// Raw score above which no candidate can enter the table, from the initial sample.
    limit: f64,
}

impl<'a> Search<'a> {
    /// Build the data shared by all batches: regressors, their products, test vectors and an initial limit.
    ///
    /// # Errors
    /// As [`search`].
    pub fn new(
        records: &[Record],
        lattice: Cow<'a, Lattice>,
        fixed: &[Option<f64>],
        options: &Options,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<Self> {
        let count = lattice.count();
        let mut catalogue = Catalogue::new(records, lattice, fixed, options, pool, &control.stop)?;
        control.total.store(count, Ordering::Relaxed);
        control.check_stop()?;
        let problem = &catalogue.problem;
        // An initial sample of few refined candidates would cost as much as the search.
        let few = problem.refines() && count <= FEW;
        if few || (problem.bound.is_none() && problem.squares.is_none()) {
            return Ok(Self { catalogue, boxes: None, limit: f64::INFINITY });
        }
        let pay = count >= BOXED && Boxes::pay(&catalogue);
        let closely = proved_closely(count, options);
        let Scouted { mut kept, mut tried, hard, which } =
            Hunt::new(&catalogue, None, pool, control).scout(pay, closely)?;
        if let Some(which) = which {
            let problem = &mut catalogue.problem;
            problem.bound = problem.bound.take().map(|bound| bound.chosen(&which));
        }
        // The Gram matrix determines squared equation errors completely.
        if pay && catalogue.problem.squares.is_none() && kept.limit < f64::INFINITY {
            let (adapted, bytes) = catalogue.problem.no_adapted();
            catalogue.problem.adapted = Some(adapted);
            for time in 0.. {
                let best = kept.rows.first().map(|row| row.index);
                let Made { vectors, left, again } =
                    Hunt::new(&catalogue, None, pool, control).made(kept.limit, time, best)?;
                catalogue.spare = catalogue.spare.saturating_sub(bytes.saturating_mul(vectors.len() as u64));
                if let Some(adapted) = &mut catalogue.problem.adapted {
                    adapted.each.extend(vectors);
                }
                // Candidates that no vector excludes are likely to be good.
                Hunt::new(&catalogue, None, pool, control).on_from(&left, &mut kept, &mut tried)?;
                if !again {
                    break;
                }
            }
        }
        let limit = kept.limit;
        if hard {
            let spare = catalogue.spare;
            catalogue.spare -= pool.install(|| catalogue.problem.with_roots(spare));
            let along = Hunt::new(&catalogue, None, pool, control).along(limit)?;
            if let Some(along) = along {
                catalogue.spare = catalogue.spare.saturating_sub(along.held());
                catalogue.problem.tangents = Some(along);
            }
        }
        let mut boxes = pool.install(|| if pay { Boxes::new(&catalogue) } else { None });
        control.check_stop()?;
        // Boxes, and tailored test vectors with them, may fail on the candidates that are open in the initial sample.
        if hard && boxes.is_some() && !Hunt::new(&catalogue, boxes.as_ref(), pool, control).boxes_exclude(limit)? {
            boxes = None;
            catalogue.problem.adapted = None;
        }
        Ok(Self { catalogue, boxes, limit })
    }

    /// Evaluate batches `first … last − 1` of one generation.
    ///
    /// `seed` holds index and raw score of the rows found before the generation. `from` resumes a checkpoint of the
    /// same range and seed that holds all rows found since its start. The range is restarted if the checkpoint belongs
    /// to another evaluation order, as on another kind of processor.
    ///
    /// # Errors
    /// [`crate::error::Error::Interrupted`], or batches, seed or checkpoint of another search.
    ///
    /// ```
    /// # use std::borrow::Cow;
    /// # use ftlm::order_search::control::Control;
    /// # use ftlm::order_search::grid::{Lattice, TermAxis};
    /// # use ftlm::order_search::options::Options;
    /// # use ftlm::order_search::result::Part;
    /// # use ftlm::order_search::batches::evaluator::{batch_count, generation_ends, BatchEvaluator};
    /// # use ftlm::parallel::pool;
    /// # use ftlm::regressors::Record;
    /// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
    /// # let output = Record::new(0.1, vec![input.clone()], None)?.integral(0, 0.8);
    /// # let record = Record::new(0.1, vec![output, input], None)?;
    /// # let order = TermAxis { signal: 1, values: vec![0.0], interchangeable: false };
    /// # let lattice = OrderGrid::new(0, &[0.6, 0.7, 0.8, 0.9], &[order], |signal| signal == 1)?;
    /// let (options, control, pool) = (Options::default(), Control::default(), pool(1)?);
    /// let evaluator = BatchEvaluator::new(&[record], Cow::Borrowed(&lattice), &[None], &options, &pool, &control)?;
    /// let (mut all, mut first) = (Part::default(), 0);
    /// for last in generation_ends(batch_count(lattice.count(), &options)) {
    ///     let seed = all.seed();
    ///     all.join(evaluator.evaluate_batches(first, last, &seed, None, &pool, &control)?, options.top);
    ///     first = last;
    /// }
    /// assert_eq!(all.counts.candidates, 4);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn rounds(
        &self,
        first: u64,
        last: u64,
        seed: &[(u64, f64)],
        from: Option<Checkpoint>,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<Part> {
        let Catalogue { lattice, options, .. } = &self.catalogue;
        let count = lattice.count();
        let (all, length) = (rounds(count, options), round_length(count, options, algorithm(count, options)));
        let begun = from.is_none();
        let from = from.unwrap_or_else(|| Checkpoint { place: Place::start(first), anew: true, part: Part::default() });
        if !(first <= from.place.round && from.place.round <= last && last <= all) {
            let what = format!("rounds {first} to {last} from {} on are not among {all}", from.place.round);
            return Err(another(what));
        }
        if !from.place.sound() {
            let Place { followed, end, size, limit, .. } = from.place;
            return Err(another(format!(
                "a checkpoint stands at {followed} of {end} ({size} at a time, limit {limit})"
            )));
        }
        if let Some((index, score)) = seed.iter().find(|(index, score)| *index >= count || strange(*score)) {
            return Err(another(format!("a row of score {score} has index {index} among {count} candidates")));
        }
        self.check(&from.part)?;
        // Batches are distributed over the grid, so that early generations sample all of it and later ones start with a
        // good limit.
        let order = visit(all);
        let mut hunt = Hunt::new(&self.catalogue, self.boxes.as_ref(), pool, control);
        let Checkpoint { mut place, part, .. } = from;
        control.total.store(count, Ordering::Relaxed);
        let known = part.counts.done();
        control.count(known, 0);
        hunt.part = part;
        hunt.anew = begun;
        while place.round < last {
            let start = order(place.round) * length;
            let bounds = (start, count.min(start + length));
            let own = |row: &Row| bounds.0 <= row.index && row.index < bounds.1;
            let mut kept = Kept::new(options.keep, self.limit);
            let seeds = seed.iter().map(|&(index, score)| Row { index, score, coefficients: vec![], initial: vec![] });
            kept.take(seeds);
            kept.lower(options.early_stopping);
            kept.take(hunt.part.rows.iter().filter(|row| own(row)).cloned());
            hunt.part.rows.retain(|row| !own(row));
            if !hunt.round(bounds, &mut kept, place)? {
                // Its candidates would be evaluated twice or never, so the foreign result is discarded.
                control.done.fetch_sub(known, Ordering::Relaxed);
                (hunt.part, hunt.anew, place) = (Part::default(), true, Place::start(first));
                continue;
            }
            let part = Part {
                rows: kept.rows.into_iter().filter(own).collect(),
                counts: Counts { candidates: bounds.1 - bounds.0, ..Counts::default() },
                failures: Vec::new(),
            };
            hunt.part.join(part, options.keep);
            place = Place::start(place.round + 1);
        }
        Ok(hunt.part)
    }

    /// Raise an error for a partial result of another search.
    fn check(&self, part: &Part) -> Result<()> {
        let (count, width) = (self.catalogue.lattice.count(), self.catalogue.lattice.width());
        let other = |row: &Row| row.coefficients.len() != width || row.index >= count || strange(row.score);
        if part.rows.iter().any(other) || part.failures.iter().any(|failure| failure.0 >= count) {
            return Err(another("a checkpoint holds rows of another search".into()));
        }
        let done = part.counts.done();
        if part.counts.boxed > part.counts.bounded {
            let Counts { boxed, bounded, .. } = part.counts;
            return Err(another(format!("a checkpoint has {boxed} candidates in boxes among {bounded} excluded ones")));
        }
        if done > count || part.counts.candidates > count {
            return Err(another(format!("a checkpoint accounts for {done} candidates, but there are {count}")));
        }
        Ok(())
    }
}

/// Whether a value cannot be a raw sum of errors.
fn strange(score: f64) -> bool {
    score.is_nan() || score < 0.0
}

/// Candidates per batch: ranked by the Gram matrix alone (16 ns each), screened by bounds (about 1 µs), all simulated.
/// A batch is long enough to be sent to another machine, and short enough to be lost.
const ROUND_PLAIN: u64 = 1 << 18;
const ROUND_BOUNDED: u64 = 1 << 16;
const ROUND_FOLLOWED: u64 = 1 << 12;
/// Minimum candidates for branch and bound, and maximum batch size. Batches grow with the grid because the tables of
/// boxes shared by two batches are computed twice.
pub(super) const BOXED: u64 = 1 << 25;
const ROUND_LONGEST: u64 = 1 << 22;
/// Minimum candidates for close bounds if simulation ranks: unstable zeros and linearized test vectors. A smaller
/// search ends before these are built.
const PROVED: u64 = 1 << 18;
/// Maximum refined candidates that are evaluated without an initial sample, one batch.
pub(super) const FEW: u64 = ROUND_FOLLOWED;

/// Version of the algorithm that divides and evaluates a search over this many candidates.
#[must_use]
pub fn algorithm(candidates: u64, options: &Options) -> u64 {
    let bounded = options.criterion == Criterion::OutputError || (candidates >= BOXED && !options.refines());
    if options.early_stopping && bounded {
        5
    } else {
        1
    }
}

/// Whether a search over this many candidates uses close bounds.
pub(super) fn proved_closely(candidates: u64, options: &Options) -> bool {
    candidates >= PROVED && options.scored_by_free_runs()
}

/// Number of candidates per batch of a search, for this version of the algorithm.
pub(super) fn round_length(candidates: u64, options: &Options, algorithm: u64) -> u64 {
    if options.refines() || !options.early_stopping {
        ROUND_FOLLOWED
    } else if options.scored_by_products() && algorithm < 3 {
        ROUND_PLAIN
    } else if algorithm < 2 || candidates < BOXED {
        ROUND_BOUNDED
    } else {
        (candidates / (BOXED / ROUND_BOUNDED)).next_power_of_two().clamp(ROUND_BOUNDED, ROUND_LONGEST)
    }
}

/// Number of batches of a search over this many candidates.
#[must_use]
pub fn rounds(candidates: u64, options: &Options) -> u64 {
    rounds_by(algorithm(candidates, options), candidates, options)
}

/// Number of batches for an earlier version of the algorithm, whose completed batches must be read.
#[must_use]
pub fn rounds_by(algorithm: u64, candidates: u64, options: &Options) -> u64 {
    candidates.div_ceil(round_length(candidates, options, algorithm))
}

/// End of each generation for this number of batches: 1, 3, 7, …
///
/// ```
/// # use ftlm::order_search::options::Options;
/// # use ftlm::order_search::batches::evaluator::{rounds, waves};
/// let batches = batch_count(400_000, &Options::default());
/// assert_eq!((batches, generation_ends(batches)), (7, vec![1, 3, 7]));
/// ```
#[must_use]
pub fn waves(rounds: u64) -> Vec<u64> {
    let mut ends = Vec::new();
    let mut end: u64 = 0;
    while end < rounds {
        end = end.saturating_mul(2).saturating_add(1).min(rounds);
        ends.push(end);
    }
    ends
}

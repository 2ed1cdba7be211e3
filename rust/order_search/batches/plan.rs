//! How a search is cut into rounds, and its rounds into waves.
//!
//! Rounds form waves of 1, 2, 4, … A round knows the rows kept before its wave and what it finds itself, nothing else,
//! so it comes to the same bits, counts too, whenever it is done on processors of one kind: on any number of threads, on
//! another machine with the same vector instructions, or continued from a checkpoint. On another kind of processor the
//! last digits may differ: the dense products and the transforms choose their kernels by the instructions they find.

use crate::order_search::options::{Criterion, Options};

/// Candidates of one round where the Gram matrix alone ranks (16 ns each), where bounds screen (a microsecond or so), and
/// where every candidate is followed: a round is long enough to be worth sending away, and short enough to be lost.
const ROUND_PLAIN: u64 = 1 << 18;
const ROUND_BOUNDED: u64 = 1 << 16;
const ROUND_FOLLOWED: u64 = 1 << 12;
/// Candidates from which on boxes may screen ([`crate::order_search::branch_and_bound`]), in rounds that grow with the
/// lattice up to the longest: the tables of boxes that two rounds share are made twice.
pub(super) const BOXED: u64 = 1 << 25;
const ROUND_LONGEST: u64 = 1 << 22;
/// Candidates from which on those that are ranked by free runs are proved closely: by the zeros of their divisors and by
/// test vectors that follow coefficients ([`crate::order_search::batches`]). A smaller search is done before these are
/// made.
const PROVED: u64 = 1 << 18;
/// Refined candidates that are followed without scouts, one round of them.
pub(super) const FEW: u64 = ROUND_FOLLOWED;

/// Number of the algorithm by which the rounds of a search over so many candidates are cut and done.
#[must_use]
pub fn algorithm(candidates: u64, options: &Options) -> u64 {
    let bounded = options.criterion == Criterion::OutputError || (candidates >= BOXED && !options.refines());
    if options.early_stopping && bounded {
        5
    } else {
        1
    }
}

/// Whether so many candidates are proved closely.
pub(super) fn proved_closely(candidates: u64, options: &Options) -> bool {
    candidates >= PROVED && options.scored_by_free_runs()
}

/// Candidates in a round of a search over so many, by this algorithm.
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

/// Rounds of a search over so many candidates.
#[must_use]
pub fn rounds(candidates: u64, options: &Options) -> u64 {
    rounds_by(algorithm(candidates, options), candidates, options)
}

/// The same by an earlier algorithm, whose finished rounds are still to be read.
#[must_use]
pub fn rounds_by(algorithm: u64, candidates: u64, options: &Options) -> u64 {
    candidates.div_ceil(round_length(candidates, options, algorithm))
}

/// Where each wave of so many rounds ends: 1, 3, 7, …
///
/// ```
/// # use ftlm::order_search::options::Options;
/// # use ftlm::order_search::batches::plan::{rounds, waves};
/// let rounds = rounds(400_000, &Options::default());
/// assert_eq!((rounds, waves(rounds)), (7, vec![1, 3, 7]));
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

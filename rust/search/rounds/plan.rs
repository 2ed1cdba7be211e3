//! How a search is cut into rounds, and its rounds into waves.
//!
//! Rounds form waves of 1, 2, 4, … A round knows the rows kept before its wave and what it finds itself, nothing else,
//! so it comes to the same bits, counts too, whenever it is done on processors of one kind: on any number of threads, on
//! another machine with the same vector instructions, or continued from a checkpoint. On another kind of processor the
//! last digits may differ: the dense products and the transforms choose their kernels by the instructions they find.

use crate::search::options::Options;

/// Candidates of one round where the Gram matrix alone ranks (16 ns each), where bounds screen (a microsecond or so), and
/// where every candidate is followed: a round is long enough to be worth sending away, and short enough to be lost.
const ROUND_PLAIN: u64 = 1 << 18;
const ROUND_BOUNDED: u64 = 1 << 16;
const ROUND_FOLLOWED: u64 = 1 << 12;
/// Refined candidates that are followed without scouts, one round of them.
pub(super) const FEW: u64 = ROUND_FOLLOWED;

/// Candidates in a round of a search with these options.
pub(super) fn round_length(options: &Options) -> u64 {
    if options.refines() || !options.early_stopping {
        ROUND_FOLLOWED
    } else if options.scored_by_products() {
        ROUND_PLAIN
    } else {
        ROUND_BOUNDED
    }
}

/// Rounds of a search over so many candidates.
#[must_use]
pub fn rounds(candidates: u64, options: &Options) -> u64 {
    candidates.div_ceil(round_length(options))
}

/// Where each wave of so many rounds ends: 1, 3, 7, …
///
/// ```
/// # use ftlm::search::{options::Options, rounds::{rounds, waves}};
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

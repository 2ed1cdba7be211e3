//! Combinations of the free orders of coupled equations (tuples): the best tuples, the tuples without an exact score,
//! and counts by outcome.
//!
//! Each pair of rows in a bucket of the join is a tuple. All results are computed bucket by bucket.

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::control::Control;
use crate::order_search::result::{Counts, Failure, MAX_LISTED_FAILURES};
use crate::order_search::stage_join::join::{spans, Bucket, Class, HalfRow, Join, ScoreEntry, ScoreTables, Span};

/// Relative tolerance of sums of scores, which may have been added in another sequence.
const SCORE_TOLERANCE: f64 = 1e-12;

impl Join {
    /// Return the smallest score of each half of the join among those rows of a bucket whose class satisfies
    /// `includes`. `None` if a half has no such row with a finite score.
    fn least_scores(
        &self,
        bucket: &Bucket,
        states: &[Vec<ScoreEntry>; 2],
        includes: impl Fn(Class) -> bool,
    ) -> Option<[f64; 2]> {
        let mut min_scores = [f64::INFINITY; 2];
        for h in 0..2 {
            for row in &self.halves[h].rows[bucket.rows[h].clone()] {
                let state = states[h][row.combination as usize];
                if includes(state.class) && state.value < min_scores[h] {
                    min_scores[h] = state.value;
                }
            }
        }
        min_scores.iter().all(|v| v.is_finite()).then_some(min_scores)
    }

    /// Return the sum of the scores of all equations, for one combination of candidates per half of the join. Scores
    /// are added in the same sequence as in an enumeration.
    fn score(&self, scores: &ScoreTables, pair: [u32; 2]) -> f64 {
        let halves = self.halves.iter().zip(pair);
        halves
            .flat_map(|(half, combination)| half.equations.clone().zip(half.ids(combination)))
            .map(|(e, &id)| scores[e][id as usize].value)
            .sum()
    }

    /// Return score and index of the best `top` combinations of free orders whose candidates are evaluated completely.
    /// They are sorted by score, then by index.
    pub(super) fn best(
        &self,
        states: &[Vec<ScoreEntry>; 2],
        scores: &ScoreTables,
        top: usize,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<Vec<(f64, u64)>> {
        let exact = |class: Class| class == Class::Exact;
        let mut order: Vec<(f64, usize, [f64; 2])> = pool.install(|| {
            let candidates = self.buckets.par_iter().enumerate().filter_map(|(i, bucket)| {
                self.least_scores(bucket, states, exact)
                    .map(|min_scores| (min_scores[0] + min_scores[1], i, min_scores))
            });
            let mut order: Vec<_> = candidates.collect();
            order.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            order
        });
        order.dedup_by_key(|o| o.1);
        let mut best_pairs: Vec<(f64, u64)> = Vec::new();
        let truncate_rows = |best_pairs: &mut Vec<(f64, u64)>| {
            best_pairs.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            best_pairs.truncate(top);
            if best_pairs.len() == top {
                best_pairs[top - 1].0 * (1.0 + SCORE_TOLERANCE)
            } else {
                f64::INFINITY
            }
        };
        let mut worst_score = f64::INFINITY;
        let capacity = top.max(512).saturating_mul(2);
        for (bound, i, min_scores) in order {
            control.check_stop()?;
            if bound > worst_score {
                break;
            }
            let rows: [Vec<(f64, HalfRow)>; 2] = std::array::from_fn(|h| {
                let rows_of_bucket = self.halves[h].rows[self.buckets[i].rows[h].clone()].iter();
                let mut rows: Vec<(f64, HalfRow)> = rows_of_bucket
                    .map(|&row| (states[h][row.combination as usize], row))
                    .filter(|(state, _)| exact(state.class) && state.value + min_scores[1 - h] <= worst_score)
                    .map(|(state, row)| (state.value, row))
                    .collect();
                rows.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.index.cmp(&b.1.index)));
                rows
            });
            for (a, first) in &rows[0] {
                if a + min_scores[1] > worst_score {
                    break;
                }
                for (b, second) in &rows[1] {
                    if a + b > worst_score {
                        break;
                    }
                    let pair = [first.combination, second.combination];
                    best_pairs.push((self.score(scores, pair), first.index + second.index));
                    if best_pairs.len() >= capacity {
                        worst_score = truncate_rows(&mut best_pairs);
                    }
                }
            }
            if worst_score == f64::INFINITY && best_pairs.len() >= top {
                worst_score = truncate_rows(&mut best_pairs);
            }
        }
        truncate_rows(&mut best_pairs);
        Ok(best_pairs)
    }

    /// Return the candidates whose scores are only lower bounds and that may still belong to a row of the result table.
    /// Each has a limit of the score for its next evaluation. `worst_score` is the score of the last row, infinite if
    /// the table is not full. In that case the limit is `limit_factor` times the lower bound.
    pub(super) fn unresolved_spans(
        &self,
        states: &[Vec<ScoreEntry>; 2],
        scores: &ScoreTables,
        worst_score: f64,
        limit_factor: f64,
        control: &Control,
    ) -> Result<Vec<Span>> {
        let mut limits: Vec<Vec<f64>> = scores.iter().map(|k| vec![f64::NEG_INFINITY; k.len()]).collect();
        for bucket in &self.buckets {
            control.check_stop()?;
            // `None` if all candidates of one half have failed.
            let Some(least) = self.least_scores(bucket, states, |class| !class.is_failed()) else { continue };
            if least[0] + least[1] > worst_score * (1.0 + SCORE_TOLERANCE) {
                continue;
            }
            for (h, half) in self.halves.iter().enumerate() {
                for row in &half.rows[bucket.rows[h].clone()] {
                    let state = states[h][row.combination as usize];
                    let open = matches!(state.class, Class::Bounded | Class::Open);
                    if !open || state.value + least[1 - h] > worst_score * (1.0 + SCORE_TOLERANCE) {
                        continue;
                    }
                    for (e, &id) in half.equations.clone().zip(half.ids(row.combination)) {
                        let entry = scores[e][id as usize];
                        if entry.class == Class::Exact {
                            continue;
                        }
                        // If the table is not full, any tuple may enter it. The limit is then a multiple of the lower
                        // bound.
                        let limit = if worst_score.is_finite() {
                            worst_score - least[1 - h] - (state.value - entry.value)
                        } else {
                            limit_factor * entry.value
                        };
                        // If the limit is not above the lower bound because of rounding, the candidate must be
                        // evaluated completely.
                        let limit = if limit > entry.value { limit } else { f64::INFINITY };
                        let span_limit = &mut limits[e][id as usize];
                        *span_limit = span_limit.max(limit);
                    }
                }
            }
        }
        let requests = limits
            .into_iter()
            .enumerate()
            .flat_map(|(e, all)| spans(e, all.into_iter().enumerate().filter(|(_, limit)| *limit > f64::NEG_INFINITY)));
        Ok(requests.collect())
    }

    /// Return the number of combinations of free orders by outcome. Also return index and reason of failed
    /// combinations: the first ones by index.
    pub(super) fn count_outcomes(&self, states: &[Vec<ScoreEntry>; 2]) -> (Counts, Vec<(u64, Failure)>) {
        let mut counts = Counts::default();
        let mut failures = FirstFailures::new();
        for bucket in &self.buckets {
            let rows_of_bucket: [&[HalfRow]; 2] = std::array::from_fn(|h| &self.halves[h].rows[bucket.rows[h].clone()]);
            let class_counts: [Vec<(Class, u64)>; 2] = std::array::from_fn(|h| {
                let mut class_counts: Vec<(Class, u64)> = Vec::new();
                for row in rows_of_bucket[h] {
                    let class = states[h][row.combination as usize].class;
                    match class_counts.iter_mut().find(|t| t.0 == class) {
                        Some(t) => t.1 += 1,
                        None => class_counts.push((class, 1)),
                    }
                }
                class_counts
            });
            let mut has_failure = false;
            for &(a, x) in &class_counts[0] {
                for &(b, y) in &class_counts[1] {
                    let count = x * y;
                    counts.candidates += count;
                    *match a.combine(b) {
                        Class::Exact => &mut counts.beaten,
                        Class::Bounded => &mut counts.excluded_by_bound,
                        Class::Open => &mut counts.stopped,
                        Class::Failed(Failure::Singular) => &mut counts.singular,
                        Class::Failed(Failure::Diverged) => &mut counts.diverged,
                    } += count;
                    has_failure |= a.combine(b).is_failed();
                }
            }
            if has_failure {
                list_failures(rows_of_bucket, states, &mut failures);
            }
        }
        (counts, failures.into_sorted())
    }
}

/// Add the failed combinations of free orders in one bucket that may be among the first by index. `rows_of_bucket` are
/// the rows of both halves, sorted by index.
fn list_failures(rows_of_bucket: [&[HalfRow]; 2], states: &[Vec<ScoreEntry>; 2], failures: &mut FirstFailures) {
    for first in rows_of_bucket[0] {
        for second in rows_of_bucket[1] {
            let index = first.index + second.index;
            if index > failures.limit {
                break;
            }
            let [a, b] = [(0, first), (1, second)].map(|(h, p)| states[h][p.combination as usize].class);
            if let Class::Failed(failure) = a.combine(b) {
                failures.push(index, failure);
            }
        }
    }
}

/// Collector of the failed combinations of free orders with the lowest indices. Combinations may be added in any
/// sequence.
struct FirstFailures {
    entries: Vec<(u64, Failure)>,
    /// Index above which a combination cannot be among the listed failures.
    limit: u64,
}

impl FirstFailures {
    fn new() -> Self {
        Self { entries: Vec::new(), limit: u64::MAX }
    }

    fn push(&mut self, index: u64, failure: Failure) {
        self.entries.push((index, failure));
        if self.entries.len() >= 8 * MAX_LISTED_FAILURES {
            self.truncate();
        }
    }

    /// Keep the first entries, sorted by index.
    fn truncate(&mut self) {
        self.entries.sort_unstable();
        self.entries.truncate(MAX_LISTED_FAILURES);
        if self.entries.len() == MAX_LISTED_FAILURES {
            self.limit = self.entries[MAX_LISTED_FAILURES - 1].0;
        }
    }

    /// Return the first entries, sorted by index.
    fn into_sorted(mut self) -> Vec<(u64, Failure)> {
        self.truncate();
        self.entries
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_failures_are_independent_of_arrival_order() {
        // Index k of the permutation 0..2000 with the multiplier 1103, which is coprime to 2000.
        for begin in [0, 500, 1999] {
            let mut failures = FirstFailures::new();
            for k in 0..2000_u64 {
                let index = (begin + 1103 * k) % 2000;
                if index <= failures.limit {
                    failures.push(index, Failure::Diverged);
                }
            }
            let listed: Vec<u64> = failures.into_sorted().into_iter().map(|(index, _)| index).collect();
            assert_eq!(listed, (0..MAX_LISTED_FAILURES as u64).collect::<Vec<_>>());
        }
    }
}

//! Initial incumbent of a search, from a sample of the order grid and a local search around its best candidates.
//!
//! The test vectors of the dual bound are selected by the candidates of the sample that they exclude.

use std::collections::HashSet;

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::batches::batch::BatchEvaluation;
use crate::order_search::batches::vector_generation::subsample;
use crate::order_search::candidate::columns::Columns;
use crate::order_search::candidate::normal_equations::Solve;
use crate::order_search::control::BatchPosition;
use crate::order_search::grid::traversal::{low_discrepancy_order, Cursor};
use crate::order_search::result::TopRows;
use crate::order_search::screening::{screen, sort_by_guess, OpenCandidate};

/// Number of candidates of the initial sample, distributed over the grid. The sample determines the test vectors and
/// the first incumbent.
const INITIAL_SAMPLE_CANDIDATES: u64 = 2048;
/// Maximum number of fixed test vectors used in a search.
const MAX_SEARCH_VECTORS: usize = 16;
/// Number of candidates whose score is estimated if coefficients are refined. Candidates with low estimates are refined
/// first. Estimates are cheap, and low scores from a large part of the grid exclude most of it.
const RANKED_CANDIDATES: u64 = 1 << 18;

/// Ratio of the number of candidates in the sample to the number that the other bounds do not exclude. Up to this
/// ratio, the expensive bounds (unstable zeros and linearized test vectors) save time. In measurements, 0.3 to 2 % of
/// the candidates were not excluded (9 % at twice the noise) if the grid contained a true equation, and 53 to 100 %
/// otherwise.
const HARD_SEARCH_OPEN_RATIO: usize = 8;

/// Best candidates of the initial sample, the selected test vectors, and whether expensive bounds save time.
pub(super) struct InitialIncumbent {
    /// Best rows of the result table, which give the initial limit of the score.
    pub(super) top_rows: TopRows,
    /// Indices of the candidates that have been evaluated.
    pub(super) evaluated: HashSet<u64>,
    /// True if the bounds exclude so few candidates of the sample that the expensive bounds (unstable zeros and
    /// linearized test vectors) save time.
    pub(super) needs_expensive_bounds: bool,
    /// Indices of the selected test vectors, the best first. `None` if all are used.
    pub(super) selected_vectors: Option<Vec<usize>>,
}

impl BatchEvaluation<'_> {
    /// Find an initial incumbent, and select the test vectors of the lower bounds that save time.
    ///
    /// If `searches_neighbors` is true, the neighbors of the best candidates are also evaluated. If
    /// `may_use_expensive_bounds` is true, also decide whether the expensive bounds (by unstable zeros and by
    /// linearized test vectors) save time.
    pub(super) fn find_incumbent(
        &mut self,
        searches_neighbors: bool,
        may_use_expensive_bounds: bool,
    ) -> Result<InitialIncumbent> {
        let candidate_index = self.candidate_index;
        let (grid, problem) = (&*candidate_index.grid, &candidate_index.problem);
        let count = grid.count();
        let order = low_discrepancy_order(count);
        let refines = problem.refines();
        let indices: Vec<u64> =
            (0..count.min(if refines { RANKED_CANDIDATES } else { INITIAL_SAMPLE_CANDIDATES })).map(order).collect();
        let candidates: Vec<Option<(OpenCandidate, Vec<f64>)>> = self.pool.install(|| {
            indices
                .par_iter()
                .map(|&index| {
                    let cursor = Cursor::at(grid, index);
                    let mut positions = vec![0; grid.width()];
                    let mut initial = Vec::new();
                    candidate_index.positions(&cursor, &mut positions);
                    candidate_index.initial(&cursor, &mut initial);
                    let sources: Vec<Columns<1>> = positions.iter().map(|&p| Columns::new([p])).collect();
                    let mut solve = Solve::<1>::new();
                    let [failed] = problem.equations.solve(&sources, &initial, &mut solve);
                    if failed {
                        return None;
                    }
                    let coefficients: Vec<f64> = solve.coefficients.iter().map(|c| c[0]).collect();
                    let weights: Vec<f64> = solve.initial.iter().map(|c| c[0]).collect();
                    let columns = |r: usize| {
                        let e = initial.len();
                        (&positions[..], &coefficients[..], &initial[..], &weights[r * e..(r + 1) * e])
                    };
                    let (mut vector_bounds, mut guess) = (Vec::new(), 0.0);
                    if let Some(bound) = &problem.bound {
                        if !refines {
                            vector_bounds = vec![0.0; bound.len()];
                            bound.bound_per_vector(columns, &mut vector_bounds);
                        }
                        guess = bound.evaluate(f64::INFINITY, columns).1;
                    } else if let Some(squares) = &problem.residual_sums {
                        guess = squares.error(&sources, &solve.coefficients).1[0];
                    }
                    Some((OpenCandidate { index, bound: 0.0, guess }, vector_bounds))
                })
                .collect()
        });
        self.check_stop()?;
        let candidates: Vec<(OpenCandidate, Vec<f64>)> = candidates.into_iter().flatten().collect();
        let mut best_candidates: Vec<OpenCandidate> = candidates.iter().map(|(open, _)| *open).collect();
        sort_by_guess(&mut best_candidates);
        let top = candidate_index.options.top;
        best_candidates.truncate(top.max(16).saturating_mul(4));
        let mut top_rows = TopRows::new(top, f64::INFINITY);
        self.simulate_open(&best_candidates, &mut top_rows, BatchPosition::start(0), false)?;
        let mut evaluated: HashSet<u64> = best_candidates.iter().map(|open| open.index).collect();
        let has_many_open = |limit: f64| {
            let open_count = candidates
                .iter()
                .filter(|(_, vector_bounds)| !vector_bounds.iter().any(|bound| *bound > limit))
                .count();
            open_count * HARD_SEARCH_OPEN_RATIO >= candidates.len()
        };
        let mut needs_expensive_bounds = false;
        if searches_neighbors {
            self.refine_incumbent(&mut top_rows, &mut evaluated)?;
            needs_expensive_bounds = may_use_expensive_bounds && has_many_open(top_rows.limit);
        } else if may_use_expensive_bounds && top_rows.rows.first().is_some_and(|best| has_many_open(best.score)) {
            // In a small sample the best score is near the final limit. The score of the worst row of the table is far
            // above it.
            self.refine_incumbent(&mut top_rows, &mut evaluated)?;
            needs_expensive_bounds = has_many_open(top_rows.limit);
        }
        let limit = top_rows.limit;
        // Without initial coefficients, all test vectors are used.
        let selected_vectors = problem.bound.as_ref().filter(|_| !refines).map(|bound| {
            let vector_bounds: Vec<Vec<f64>> = candidates.into_iter().map(|(_, vector_bounds)| vector_bounds).collect();
            select_test_vectors(&vector_bounds, MAX_SEARCH_VECTORS.min(bound.len()), limit)
        });
        Ok(InitialIncumbent { top_rows, evaluated, needs_expensive_bounds, selected_vectors })
    }
}

/// Select at most `max_count` test vectors by a greedy algorithm, so that together they exclude as many candidates of a
/// sample as possible. `vector_bounds` gives the bound of each test vector for each candidate. Return the indices of
/// the selected vectors.
fn select_test_vectors(vector_bounds: &[Vec<f64>], max_count: usize, limit: f64) -> Vec<usize> {
    let mut open: Vec<bool> = vec![true; vector_bounds.len()];
    let mut selection: Vec<usize> = Vec::new();
    // Among vectors with equal exclusions, the one with the larger bounds is preferred.
    let gain = |j: usize, open: &[bool]| -> (usize, f64) {
        let values = vector_bounds.iter().zip(open).filter(|(_, open)| **open).map(|(e, _)| e[j]);
        values.fold((0, 0.0), |(n, sum), v| (n + usize::from(v > limit), sum + v / (v + limit).max(f64::MIN_POSITIVE)))
    };
    let count = vector_bounds.first().map_or(0, Vec::len);
    while selection.len() < max_count.min(count) {
        let best = (0..count)
            .filter(|j| !selection.contains(j))
            .map(|j| (gain(j, &open), j))
            .max_by(|a, b| a.0 .0.cmp(&b.0 .0).then(a.0 .1.total_cmp(&b.0 .1)).then(b.1.cmp(&a.1)));
        let Some((_, j)) = best else { break };
        vector_bounds.iter().zip(&mut open).filter(|(e, _)| e[j] > limit).for_each(|(_, open)| *open = false);
        selection.push(j);
    }
    selection
}

/// Number of best rows of the result table whose neighbors on the order grid are evaluated.
const LOCAL_SEARCH_ROWS: usize = 64;
/// Maximum number of neighbors on the order grid that are evaluated around the best rows.
const MAX_NEIGHBOR_EVALUATIONS: usize = 1 << 14;
/// Maximum number of directions to neighbors on the order grid. Up to five varying orders, all combinations of changes
/// are used. With more orders, only two orders change at a time.
const MAX_NEIGHBOR_DIRECTIONS: usize = 243;
/// Number of sampled blocks of consecutive candidates, and number of candidates in a block.
const SAMPLE_BLOCKS_AND_LENGTH: (u64, u64) = (2048, 64);
/// Maximum number of candidates not excluded by bounds that are evaluated to improve the incumbent.
const MAX_OPEN_EVALUATIONS: usize = 512;

impl BatchEvaluation<'_> {
    /// Improve the incumbent: evaluate neighbors of the best rows, then a sample of candidates from the whole grid that
    /// no bound excludes, then neighbors again.
    pub(super) fn refine_incumbent(&mut self, top_rows: &mut TopRows, evaluated: &mut HashSet<u64>) -> Result<()> {
        self.search_neighbors(top_rows, evaluated)?;
        let unexcluded = self.sample_unexcluded(top_rows)?;
        self.refine_from(&unexcluded, top_rows, evaluated)
    }

    /// Evaluate the candidates `open` that are not in `evaluated`, then search around the best rows.
    pub(super) fn refine_from(
        &mut self,
        open: &[OpenCandidate],
        top_rows: &mut TopRows,
        evaluated: &mut HashSet<u64>,
    ) -> Result<()> {
        let unevaluated: Vec<OpenCandidate> =
            open.iter().filter(|open| evaluated.insert(open.index)).copied().collect();
        self.simulate_open(&unevaluated, top_rows, BatchPosition::start(0), false)?;
        self.search_neighbors(top_rows, evaluated)
    }

    /// Evaluate neighbors of the best rows that are not in `evaluated`. The distance is halved whenever no neighbor
    /// improves the best rows. The search ends at distance 1 or after [`MAX_NEIGHBOR_EVALUATIONS`] evaluations.
    pub(super) fn search_neighbors(&mut self, top_rows: &mut TopRows, evaluated: &mut HashSet<u64>) -> Result<()> {
        let grid = &*self.candidate_index.grid;
        let max_length = grid.groups().iter().flat_map(|group| &group.axes).map(Vec::len);
        let max_length = max_length.chain([grid.blocks().len()]).max().unwrap_or(1);
        let mut stride = (max_length / 8).max(1).next_power_of_two();
        let first = evaluated.len();
        while stride > 0 {
            let best = |top_rows: &TopRows| {
                top_rows.rows.iter().take(LOCAL_SEARCH_ROWS).map(|row| row.index).collect::<Vec<u64>>()
            };
            let previous = best(top_rows);
            let mut neighbors: Vec<u64> =
                previous.iter().flat_map(|&index| self.grid_neighbors(index, stride)).collect();
            neighbors.retain(|&index| evaluated.insert(index));
            let open: Vec<OpenCandidate> =
                neighbors.iter().map(|&index| OpenCandidate { index, bound: 0.0, guess: 0.0 }).collect();
            self.simulate_open(&open, top_rows, BatchPosition::start(0), false)?;
            if best(top_rows) == previous {
                stride /= 2;
            }
            if evaluated.len() - first > MAX_NEIGHBOR_EVALUATIONS {
                break;
            }
        }
        Ok(())
    }

    /// Return the indices of the candidates at a distance of `stride` grid values in one or more of the varying orders.
    fn grid_neighbors(&self, index: u64, stride: usize) -> Vec<u64> {
        let grid = &*self.candidate_index.grid;
        let cursor = Cursor::at(grid, index);
        let mut digits = vec![0; grid.width()];
        cursor.for_each_term(0, |term, digit| digits[term] = digit);
        let mut lengths = vec![0; grid.width()];
        for group in grid.groups() {
            group.terms.iter().zip(&group.axes).for_each(|(&term, axis)| lengths[term] = axis.len());
        }
        // The order α of the equation comes last.
        digits.push(cursor.block());
        lengths.push(grid.blocks().len());
        let varying: Vec<usize> = (0..digits.len()).filter(|&i| lengths[i] > 1).collect();
        let direction_count = u32::try_from(varying.len())
            .ok()
            .and_then(|n| 3_usize.checked_pow(n))
            .filter(|n| *n <= MAX_NEIGHBOR_DIRECTIONS);
        let moves: Vec<Vec<(usize, usize)>> = match direction_count {
            Some(count) => (1..count)
                .map(|number| {
                    let digit = |axis: usize| number / 3_usize.pow(u32::try_from(axis).unwrap_or(0)) % 3;
                    varying.iter().enumerate().map(|(axis, &i)| (i, digit(axis))).collect()
                })
                .collect(),
            None => varying
                .iter()
                .enumerate()
                .flat_map(|(n, &i)| varying[n..].iter().map(move |&j| (i, j)))
                .flat_map(|(i, j)| {
                    (0..9).map(move |direction| vec![(i, direction % 3), (j, if i == j { 0 } else { direction / 3 })])
                })
                .collect(),
        };
        let neighbor = |moves: Vec<(usize, usize)>| {
            let mut neighbor_digits = digits.clone();
            for (i, direction) in moves {
                neighbor_digits[i] = match direction {
                    0 => neighbor_digits[i],
                    1 => neighbor_digits[i].checked_add(stride).filter(|&digit| digit < lengths[i])?,
                    _ => neighbor_digits[i].checked_sub(stride)?,
                };
            }
            let block = neighbor_digits.pop()?;
            Cursor::find(grid, block, &neighbor_digits)
        };
        moves.into_iter().filter_map(neighbor).collect()
    }

    /// Return a sample of candidates that no bound excludes, in ascending order of their estimated score.
    fn sample_unexcluded(&mut self, top_rows: &TopRows) -> Result<Vec<OpenCandidate>> {
        let candidate_index = self.candidate_index;
        if candidate_index.problem.residual_sums.is_none() {
            return Ok(self.sample_open(top_rows.limit, 0)?.0);
        }
        let (count, (block_count, length)) = (candidate_index.grid.count(), SAMPLE_BLOCKS_AND_LENGTH);
        let order = low_discrepancy_order(count.div_ceil(length));
        let starts: Vec<u64> = (0..block_count.min(count.div_ceil(length))).map(|i| order(i) * length).collect();
        let mut unexcluded: Vec<OpenCandidate> = self.pool.install(|| {
            starts
                .par_iter()
                .flat_map(|&start| screen(candidate_index, start, count.min(start + length), top_rows.limit).0)
                .collect()
        });
        self.check_stop()?;
        sort_by_guess(&mut unexcluded);
        Ok(subsample(&unexcluded, MAX_OPEN_EVALUATIONS))
    }
}

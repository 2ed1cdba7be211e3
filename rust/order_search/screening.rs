//! Screening of candidates: coefficients in parallel SIMD lanes, then exclusion by lower bounds.

use crate::order_search::candidate::columns::{part_of, Columns};
use crate::order_search::candidate::normal_equations::{ResidualSumOfSquares, Solve};
use crate::order_search::candidate::problem::Problem;
use crate::order_search::candidate::row_bound::CommonFactor;
use crate::order_search::candidate_index::CandidateIndex;
use crate::order_search::dual_bound::linearized_vectors::VectorLookup;
use crate::order_search::dual_bound::tailored_vectors::NormCache;
use crate::order_search::grid::traversal::{low_discrepancy_position, Cursor, GridSlice};
use crate::simd::{self, LANE_COUNT};

/// Candidate that no bound has excluded.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OpenCandidate {
    /// Index of the candidate in the order grid.
    pub(crate) index: u64,
    /// Lower bound of the raw score (Σ|e| or Σe²).
    pub(crate) bound: f64,
    /// Estimate of the raw score. Candidates are evaluated in ascending order of it.
    pub(crate) guess: f64,
}

/// Sort candidates by the estimate of their score, then by index, with NaN last.
pub(crate) fn sort_by_guess(open: &mut [OpenCandidate]) {
    open.sort_unstable_by(|a, b| a.guess.total_cmp(&b.guess).then(a.index.cmp(&b.index)));
}

/// Screen candidates `lo … hi − 1` against a limit of the raw score (Σ|e| or Σe²). Return the candidates that no bound
/// excludes, and the indices of the singular ones. The screening is compiled for the widest vector instructions
/// available.
pub(crate) fn screen(
    candidate_index: &CandidateIndex<'_>,
    lo: u64,
    hi: u64,
    limit: f64,
) -> (Vec<OpenCandidate>, Vec<u64>) {
    simd::dispatch_simd(Screening { candidate_index, lo, hi, limit })
}

/// Arguments of [`screen`] as a task that is compiled for the widest vector instructions available.
struct Screening<'a> {
    candidate_index: &'a CandidateIndex<'a>,
    lo: u64,
    hi: u64,
    limit: f64,
}

impl simd::SimdKernel for Screening<'_> {
    type Output = (Vec<OpenCandidate>, Vec<u64>);

    #[inline(always)]
    fn run(self) -> Self::Output {
        let Self { candidate_index, lo, hi, limit } = self;
        let mut outcome = (Vec::new(), Vec::new());
        let mut cursor = Cursor::at(&candidate_index.grid, lo);
        let mut index = lo;
        let width = candidate_index.grid.width();
        // Candidates differ in their Caputo terms and in the exponent of an offset. They therefore cannot be solved in
        // parallel lanes.
        if !candidate_index.options.initial.follows_orders() {
            let mut screen = Screen::<LANE_COUNT>::new(width);
            candidate_index.positions(&cursor, &mut screen.terms);
            let row_bound = RowBoundContext::of(candidate_index, limit);
            while index < hi {
                let common_factor = row_bound.as_ref().and_then(|row_bound| {
                    screen.screen_row(candidate_index, row_bound, &mut cursor, (index, hi), &mut outcome)
                });
                if let Some(candidates) = common_factor {
                    index += candidates;
                } else if index + LANE_COUNT as u64 <= hi {
                    screen.screen_next(candidate_index, &mut cursor, index, limit, &mut outcome);
                    index += LANE_COUNT as u64;
                } else {
                    break;
                }
            }
        }
        let mut screen = Screen::<1>::new(width);
        candidate_index.positions(&cursor, &mut screen.terms);
        while index < hi {
            screen.screen_next(candidate_index, &mut cursor, index, limit, &mut outcome);
            index += 1;
        }
        outcome
    }
}

/// Data for the common bound of candidates that differ in one term only. It is applied before all other bounds, and
/// only if candidates are ranked by squared equation error.
struct RowBoundContext<'a> {
    squares: &'a ResidualSumOfSquares,
    limit: f64,
}

impl<'a> RowBoundContext<'a> {
    /// Return the data of a search. `None` if the limit is infinite, a coefficient is fixed, or candidates are not
    /// ranked by squared equation error.
    fn of(candidate_index: &'a CandidateIndex<'_>, limit: f64) -> Option<Self> {
        let Problem { residual_sums: squares, equations, .. } = &candidate_index.problem;
        let squares =
            squares.as_ref().filter(|_| limit < f64::INFINITY && equations.unconstrained_equations().is_some())?;
        Some(Self { squares, limit })
    }
}

/// Workspace for screening L candidates in parallel SIMD lanes.
pub(crate) struct Screen<const L: usize> {
    solve: Solve<L>,
    /// Regressor columns (indices in the banks) of each term for the L candidates.
    positions: Vec<Columns<L>>,
    /// Regressor columns (indices in the banks) of the initial terms.
    initial: Vec<usize>,
    /// Regressor columns (indices in the banks) of the terms of the next candidate.
    terms: Vec<usize>,
    /// Regressor columns (indices in the banks) of the terms of one candidate.
    columns: Vec<usize>,
    coefficients: Vec<f64>,
    weights: Vec<f64>,
    /// Cache of norms for the tailored test vectors.
    norm_cache: NormCache,
    /// Positions in a row of candidates that the row bound does not exclude.
    open_positions: Vec<usize>,
    /// Cache of the most recent lookup of test vectors that are linearized in the orders.
    lookup: VectorLookup,
    /// Index of the path on which the test for unstable zeros excluded the most recent candidate.
    unstable_zero_path: usize,
}

impl<const L: usize> Screen<L> {
    /// Return a workspace for candidates with `width` terms.
    pub(crate) fn new(width: usize) -> Self {
        Self {
            solve: Solve::new(),
            positions: vec![Columns::new([0; L]); width],
            initial: Vec::new(),
            terms: vec![0; width],
            columns: vec![0; width],
            coefficients: vec![0.0; width],
            weights: Vec::new(),
            norm_cache: NormCache::for_adjacent_candidates(),
            open_positions: Vec::new(),
            lookup: VectorLookup::default(),
            unstable_zero_path: 0,
        }
    }

    /// Screen the next candidates, which differ only in one term, by their common lower bound. Return their number.
    /// `None` if there are fewer than L such candidates or no common bound.
    #[inline(always)]
    fn screen_row(
        &mut self,
        candidate_index: &CandidateIndex<'_>,
        &RowBoundContext { squares, limit }: &RowBoundContext<'_>,
        cursor: &mut Cursor<'_>,
        (index, hi): (u64, u64),
        outcome: &mut (Vec<OpenCandidate>, Vec<u64>),
    ) -> Option<u64> {
        let (term, digit, len) = cursor.adjacent_run()?;
        let len = usize::try_from(hi - index).map_or(len, |all| len.min(all));
        if len < L {
            return None;
        }
        let columns = &candidate_index.term_columns(cursor, term)[digit..digit + len];
        let common_factor = CommonFactor::new(squares, &self.terms, term)?;
        let mut open_positions = std::mem::take(&mut self.open_positions);
        open_positions.clear();
        common_factor.append_open::<L>(columns, limit, &mut open_positions);
        for part in open_positions.chunks(L) {
            for (positions, &column) in self.positions.iter_mut().zip(&self.terms) {
                *positions = Columns::uniform(column);
            }
            let mut lane_columns = [part[0]; L];
            lane_columns[..part.len()].copy_from_slice(part);
            let indices = lane_columns.map(|n| index + n as u64);
            self.positions[term] = Columns::new(lane_columns.map(|n| columns[n]));
            self.positions[term].compare();
            self.screen_positions(candidate_index, indices, part.len(), limit, outcome);
        }
        self.open_positions = open_positions;
        cursor.skip(len - 1);
        candidate_index.next(cursor, &mut self.terms);
        Some(len as u64)
    }

    /// Compute coefficients and lower bounds of the next L candidates, and advance the cursor.
    #[inline(always)]
    fn screen_next(
        &mut self,
        candidate_index: &CandidateIndex<'_>,
        cursor: &mut Cursor<'_>,
        index: u64,
        limit: f64,
        outcome: &mut (Vec<OpenCandidate>, Vec<u64>),
    ) {
        let Self { positions, initial, terms, .. } = self;
        candidate_index.initial(cursor, initial);
        if let Some((term, digit)) = cursor.adjacent_block(L) {
            for (columns, &column) in positions.iter_mut().zip(terms.iter()) {
                *columns = Columns::uniform(column);
            }
            positions[term].indices = part_of(&candidate_index.term_columns(cursor, term)[digit..]);
            positions[term].compare();
            cursor.skip(L - 1);
            candidate_index.next(cursor, terms);
        } else {
            for n in 0..L {
                for (columns, &column) in positions.iter_mut().zip(terms.iter()) {
                    columns.indices[n] = column;
                }
                candidate_index.next(cursor, terms);
            }
            positions.iter_mut().for_each(Columns::compare);
        }
        self.screen_positions(candidate_index, std::array::from_fn(|n| index + n as u64), L, limit, outcome);
    }

    /// Screen the first `count` of the L candidates whose columns have been set. Append the candidates that no bound
    /// excludes to `open`, and the indices of singular candidates to `singular`.
    #[inline(always)]
    fn screen_positions(
        &mut self,
        candidate_index: &CandidateIndex<'_>,
        indices: [u64; L],
        count: usize,
        limit: f64,
        (open, singular): &mut (Vec<OpenCandidate>, Vec<u64>),
    ) {
        let Self {
            solve,
            positions,
            initial,
            columns,
            coefficients,
            weights,
            norm_cache: memory,
            lookup,
            unstable_zero_path,
            ..
        } = self;
        let failed = candidate_index.problem.equations.solve(positions, initial, solve);
        #[allow(clippy::manual_map)] // a closure would be compiled for the oldest machine
        let squares = match &candidate_index.problem.residual_sums {
            Some(squares) => Some(squares.error(positions, &solve.coefficients)),
            None => None,
        };
        for (n, &index) in indices.iter().enumerate().take(count) {
            if failed[n] {
                singular.push(index);
                continue;
            }
            let (bound, guess) = match (&squares, &candidate_index.problem.bound) {
                (Some((lower_bound, guess)), _) => (lower_bound[n], guess[n]),
                (None, Some(bound)) => {
                    // Unrefined coefficients give an estimate of the score but no valid bound.
                    let refines = candidate_index.problem.refines();
                    let limit = if refines { f64::INFINITY } else { limit };
                    columns.iter_mut().zip(positions.iter()).for_each(|(t, p)| *t = p.indices[n]);
                    coefficients.iter_mut().zip(&solve.coefficients).for_each(|(c, x)| *c = x[n]);
                    weights.clear();
                    weights.extend(solve.initial.iter().map(|x| x[n]));
                    let e = initial.len();
                    let (lower_bound, guess) = bound.evaluate(limit, |r| {
                        (&columns[..], &coefficients[..], &initial[..], &weights[r * e..(r + 1) * e])
                    });
                    (if refines { 0.0 } else { lower_bound }, guess)
                }
                (None, None) => (0.0, low_discrepancy_position(index)),
            };
            // This form of the condition lets a NaN bound exclude nothing.
            if bound > limit {
                continue;
            }
            if let Some(tailored) = &candidate_index.problem.tailored_vectors
                && tailored.excludes_candidate(columns, coefficients, limit, memory)
            {
                continue;
            }
            if let (Some(linearized_vectors), true) =
                (&candidate_index.problem.linearized_vectors, limit < f64::INFINITY)
                && linearized_vectors.excludes_candidate(columns, coefficients, limit, lookup)
            {
                continue;
            }
            if let (Some(unstable_zeros), true) = (&candidate_index.problem.unstable_zeros, limit < f64::INFINITY)
                && unstable_zeros.excludes_candidate(columns, coefficients, limit, unstable_zero_path)
            {
                continue;
            }
            open.push(OpenCandidate { index, bound, guess });
        }
    }

    /// Screen at most L candidates of a slice, with zero initial conditions. `candidates` lists the index and the
    /// columns of the two varying terms. `columns` gives the columns of all other terms.
    #[inline(always)]
    pub(crate) fn screen_slice_candidates(
        &mut self,
        candidate_index: &CandidateIndex<'_>,
        slice: &GridSlice,
        columns: &[usize],
        candidates: &[(u64, usize, usize)],
        limit: f64,
        outcome: &mut (Vec<OpenCandidate>, Vec<u64>),
    ) {
        for (positions, &column) in self.positions.iter_mut().zip(columns) {
            *positions = Columns::uniform(column);
        }
        let Some(last) = candidates.last() else { return };
        let candidate_or_last = |n: usize| candidates.get(n).unwrap_or(last);
        let outer: [usize; L] = std::array::from_fn(|n| candidate_or_last(n).1);
        let inner: [usize; L] = std::array::from_fn(|n| candidate_or_last(n).2);
        for (term, column) in [(slice.outer, outer), (slice.inner, inner)] {
            self.positions[term].indices = column;
            self.positions[term].compare();
        }
        self.screen_positions(
            candidate_index,
            std::array::from_fn(|n| candidate_or_last(n).0),
            candidates.len().min(L),
            limit,
            outcome,
        );
    }
}

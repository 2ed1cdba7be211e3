//! Bisection of the boxes of a slice until they are excluded or small, and screening of the remaining candidates.

use std::borrow::Cow;
use std::ops::Range;

use crate::error::Result;
use crate::linalg::small;
use crate::order_search::branch_and_bound::axis_table::{AxisTable, RemainingColumns};
use crate::order_search::branch_and_bound::box_bound::{
    Interval, RowCoefficients, SearchConstants, SliceTables, MAX_REMAINING_COLUMNS,
};
use crate::order_search::candidate::problem::Problem;
use crate::order_search::candidate_index::CandidateIndex;
use crate::order_search::dual_bound::lower_bound::Bound;
use crate::order_search::dual_bound::test_vectors::{TestVectors, NO_INDEX};
use crate::order_search::grid::traversal::{self, Cursor};
use crate::order_search::grid::OrderGrid;
use crate::order_search::options::{Criterion, Options};
use crate::order_search::screening::{OpenCandidate, Screen};
use crate::parallel::{pool, Stop};
use crate::regressors::Record;
use crate::simd::{self, LANE_COUNT};

/// Minimum number of candidates of a slice of the order grid for which building axis tables saves time.
pub(crate) const MIN_SLICE_CANDIDATES: u64 = 4096;
/// Base-2 logarithm of the initial number of grid values along each side of a box of orders.
const INITIAL_BOX_LEVEL: usize = 5;
/// Sum of the base-2 logarithms of both side lengths of a box of orders at or below which its candidates are screened
/// one by one.
const SCREENING_LEVEL_SUM: usize = 4;

/// Constants of branch and bound that all boxes of a search share.
pub(crate) struct BranchAndBound {
    common: SearchConstants,
    /// Upper bound of the rounding error in the inner product of two unit-norm columns.
    rounding: f64,
}

impl BranchAndBound {
    /// Return true if branch and bound applies to a search and saves time. Candidates must be ranked by simulation from
    /// zero initial conditions, or by squared equation error. Their coefficients must follow from the normal equations,
    /// and some slice must have at least [`MIN_SLICE_CANDIDATES`] candidates.
    pub(crate) fn is_worthwhile(candidate_index: &CandidateIndex<'_>) -> bool {
        let (options, grid) = (&candidate_index.options, &*candidate_index.grid);
        options.pruning
            && !options.refines()
            && (options.criterion == Criterion::OutputError || options.ranks_by_gram_matrix())
            && candidate_index.problem.box_equations().is_some()
            && (2..=MAX_REMAINING_COLUMNS + 2).contains(&grid.width())
            && grid.blocks().iter().any(|block| {
                grid.slice_at(block.start)
                    .is_some_and(|slice| grid.max_slice_candidates(&slice) >= MIN_SLICE_CANDIDATES)
            })
    }

    /// Compute the constants of a search. `None` if there is no dual bound. Runs on the current thread pool.
    pub(crate) fn new(candidate_index: &CandidateIndex<'_>) -> Option<Self> {
        let problem = &candidate_index.problem;
        let (test_vectors, normal) = (test_vectors_of(problem)?, problem.box_equations()?);
        // A column may differ from 0 only in rows of weight 1, where it is the difference of large numbers.
        #[allow(clippy::cast_precision_loss)]
        let (samples, weights) = (problem.samples() as f64, candidate_index.options.weights() as f64);
        let rounding = f64::EPSILON * samples * weights;
        let remaining = RemainingColumns {
            normal,
            test_vectors,
            columns: &[],
            inverse: &[],
            trace: 0.0,
            rounding,
            fixed_output_column: None,
        };
        let (norm, ranks_equation_error) = (candidate_index.options.norm, problem.residual_sums.is_some());
        let common = SearchConstants::new(&remaining, norm, ranks_equation_error, problem.size(), weights.sqrt());
        Some(Self { common, rounding })
    }

    /// Return the columns of a slice of the order grid whose orders do not vary, with the inverse of their correlation
    /// matrix. `None` if there is no dual bound.
    fn remaining_columns<'a>(
        &self,
        candidate_index: &'a CandidateIndex<'_>,
        columns: &'a [usize],
        inverse: &'a [f64],
    ) -> Option<RemainingColumns<'a>> {
        let (k, test_vectors) = (columns.len(), test_vectors_of(&candidate_index.problem)?);
        let fixed_output_column = test_vectors
            .first()
            .and_then(|test_vectors| columns.iter().position(|&p| test_vectors.rows[p] != NO_INDEX));
        Some(RemainingColumns {
            normal: candidate_index.problem.box_equations()?,
            test_vectors,
            fixed_output_column,
            columns,
            inverse,
            trace: (0..k).map(|i| inverse[i * k + i]).sum::<f64>().max(1.0),
            rounding: self.rounding,
        })
    }
}

/// Return the test vectors of a search, by record. Empty if candidates are ranked by squared equation error, `None` if
/// there is no dual bound.
fn test_vectors_of(problem: &Problem) -> Option<&[TestVectors]> {
    match (&problem.residual_sums, &problem.bound) {
        (Some(_), _) => Some(&[]),
        (None, bound) => bound.as_ref().map(Bound::test_vectors),
    }
}

/// Screen candidates `lo … hi − 1` of a slice of the order grid against a limit of the raw score (Σ|e| or Σe²). Return
/// the candidates that are not excluded, the indices of singular candidates outside excluded boxes, and the number of
/// candidates in excluded boxes. `None` if no box of this slice has a bound.
pub(crate) fn screen_slice(
    candidate_index: &CandidateIndex<'_>,
    boxes: &BranchAndBound,
    slice: &traversal::GridSlice,
    (lo, hi): (u64, u64),
    limit: f64,
) -> Option<(Vec<OpenCandidate>, Vec<u64>, u64)> {
    simd::dispatch_simd(SliceScreening { candidate_index, boxes, slice, lo, hi, limit })
}

/// Arguments of [`screen_slice`] as a task that is compiled for the widest vector instructions available.
struct SliceScreening<'a> {
    candidate_index: &'a CandidateIndex<'a>,
    boxes: &'a BranchAndBound,
    slice: &'a traversal::GridSlice,
    lo: u64,
    hi: u64,
    limit: f64,
}

impl simd::SimdKernel for SliceScreening<'_> {
    type Output = Option<(Vec<OpenCandidate>, Vec<u64>, u64)>;

    #[inline(always)]
    fn run(self) -> Self::Output {
        let Self { candidate_index, boxes, slice, lo, hi, limit } = self;
        let len = slice.len as u64;
        #[allow(clippy::cast_possible_truncation)]
        let rows = ((lo - slice.lo) / len) as usize..((hi - slice.lo).div_ceil(len)) as usize;
        let columns = first_columns(candidate_index, slice);
        let (remaining, inverse) = factor_remaining_columns(candidate_index, slice, &columns)?;
        let remaining = boxes.remaining_columns(candidate_index, &remaining, &inverse)?;
        let tables = build_slice_tables(candidate_index, boxes, slice, &remaining, rows.clone())?;
        let start = slice.lo + rows.start as u64 * len;
        let mut screen = Screen::<LANE_COUNT>::new(columns.len());
        let (mut outcome, mut pending) = ((Vec::new(), Vec::new()), [(0, 0, 0); LANE_COUNT]);
        let (mut count, mut excluded) = (0, hi - lo);
        let lengths = [rows.len(), slice.len];
        let coarse = lengths.map(|n| INITIAL_BOX_LEVEL.min(n.next_power_of_two().trailing_zeros() as usize));
        let (mut stack, mut row_coefficients) = (Vec::new(), RowCoefficients::default());
        for outer_position in 0..lengths[0].div_ceil(1 << coarse[0]) {
            tables.compute_coefficients(
                &mut row_coefficients,
                outer_position << coarse[0]..lengths[0].min((outer_position + 1) << coarse[0]),
            );
            for inner_position in 0..lengths[1].div_ceil(1 << coarse[1]) {
                stack.push([
                    Interval { level: coarse[0], position: outer_position },
                    Interval { level: coarse[1], position: inner_position },
                ]);
                while let Some([u, v]) = stack.pop() {
                    if let Some(cell) = tables.box_quantities(&row_coefficients, [u, v])
                        && tables.bound([u, v], &cell, limit) > limit
                    {
                        continue;
                    }
                    if u.level + v.level > SCREENING_LEVEL_SUM {
                        let part = usize::from(v.level > u.level);
                        let interval = [u, v][part];
                        for position in [2 * interval.position + 1, 2 * interval.position] {
                            if position << (interval.level - 1) < lengths[part] {
                                let mut next = [u, v];
                                next[part] = Interval { level: interval.level - 1, position };
                                stack.push(next);
                            }
                        }
                        continue;
                    }
                    let ((u0, u1), (v0, v1)) = (u.ends(lengths[0]), v.ends(lengths[1]));
                    for row in u0..=u1 {
                        for value in v0..=v1 {
                            let index = start + row as u64 * len + value as u64;
                            if index < lo || index >= hi {
                                continue;
                            }
                            excluded -= 1;
                            pending[count] = (index, tables.sides[0].columns[row], tables.sides[1].columns[value]);
                            count += 1;
                            if count == LANE_COUNT {
                                screen.screen_slice_candidates(
                                    candidate_index,
                                    slice,
                                    &columns,
                                    &pending[..count],
                                    limit,
                                    &mut outcome,
                                );
                                count = 0;
                            }
                        }
                    }
                }
            }
        }
        if count > 0 {
            screen.screen_slice_candidates(candidate_index, slice, &columns, &pending[..count], limit, &mut outcome);
        }
        let (open, singular) = outcome;
        Some((open, singular, excluded))
    }
}

/// Return the column index of every term at the first candidate of a slice of the order grid.
#[inline(always)]
fn first_columns(candidate_index: &CandidateIndex<'_>, slice: &traversal::GridSlice) -> Vec<usize> {
    slice.digits.iter().enumerate().map(|(term, &digit)| candidate_index.columns(slice.block, term)[digit]).collect()
}

/// Return the column indices of the terms whose orders do not vary in a slice of the order grid, and the inverse of
/// their correlation matrix. `None` without a dual bound, or if the matrix is singular.
#[inline(always)]
fn factor_remaining_columns(
    candidate_index: &CandidateIndex<'_>,
    slice: &traversal::GridSlice,
    columns: &[usize],
) -> Option<(Vec<usize>, Vec<f64>)> {
    let remaining: Vec<usize> =
        (0..columns.len()).filter(|&t| t != slice.outer && t != slice.inner).map(|t| columns[t]).collect();
    let normal = candidate_index.problem.box_equations()?;
    let inverse = inverse_correlation(&remaining, |a, b| normal.product(a, b)).ok()?;
    Some((remaining, inverse))
}

/// Build the tables of some rows of a slice of the order grid. `None` if a varying column is nearly a combination of
/// the fixed-order columns.
#[inline(always)]
fn build_slice_tables<'a>(
    candidate_index: &CandidateIndex<'_>,
    boxes: &'a BranchAndBound,
    slice: &traversal::GridSlice,
    remaining: &'a RemainingColumns<'a>,
    rows: Range<usize>,
) -> Option<SliceTables<'a>> {
    let columns_of = |term: usize| candidate_index.columns(slice.block, term);
    let outer = slice.rows[rows].iter().map(|&digit| columns_of(slice.outer)[digit]).collect();
    let inner = columns_of(slice.inner)[slice.first..slice.first + slice.len].to_vec();
    let sides = [AxisTable::new(remaining, outer)?, AxisTable::new(remaining, inner)?];
    Some(SliceTables::new(remaining, &boxes.common, sides))
}

/// Return the inverse of the correlation matrix of some columns, row-major. `product` returns the correlation of two
/// columns.
fn inverse_correlation(columns: &[usize], product: impl Fn(usize, usize) -> f64) -> Result<Vec<f64>> {
    if columns.is_empty() {
        return Ok(Vec::new());
    }
    let matrix: Vec<f64> =
        columns.iter().flat_map(|&a| columns.iter().map(move |&b| (a, b))).map(|(a, b)| product(a, b)).collect();
    small::inverse(&matrix, columns.len())
}

/// Lower bound of the error that holds for every candidate of a box of orders.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoxBound {
    /// Index of the first candidate. The box contains the candidates `first + i·stride + j` with i below `rows` and j
    /// below `values`.
    pub first: u64,
    /// Number of rows, indexed by i.
    pub rows: u64,
    /// Number of candidates in a row, indexed by j.
    pub values: u64,
    /// Difference of the candidate indices of two adjacent rows.
    pub stride: u64,
    /// Lower bound of the raw error (Σ|e| or Σe², from zero initial conditions) of every candidate of the box of
    /// orders. 0 if nothing is proved.
    pub bound: f64,
}

/// Return a lower bound for every box of the slice of the order grid that contains candidate `index`. The boxes have
/// all sizes down to single candidates. The bounds apply to output errors in either norm, or to squared equation
/// errors.
///
/// Empty if no box of the slice of the order grid has a bound, or if there is no slice. A slice exists if the fastest
/// varying signal has a single term and the order of another signal varies.
///
/// # Errors
/// The errors of [`crate::order_search::batches::search`]: an option out of range, signals that the records lack, or
/// too little memory.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::order_search::branch_and_bound::box_bounds;
/// # use ftlm::order_search::grid::{OrderGrid, TermAxis};
/// # use ftlm::order_search::options::Options;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.8);
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
/// let axis = |signal, values: &[f64]| TermAxis { signal, values: values.to_vec(), interchangeable: false };
/// let grid = OrderGrid::new(0, &[1.6], &[axis(0, &[0.1, 0.3, 0.5]), axis(1, &[0.0, 0.4])], |s| s == 1)?;
/// let boxes = box_bounds(&[record], &grid, &Options::default(), 0)?;
/// assert!(boxes.iter().any(|b| b.rows * b.values == 6) && boxes.iter().any(|b| b.rows * b.values == 1));
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn box_bounds(records: &[Record], grid: &OrderGrid, options: &Options, index: u64) -> Result<Vec<BoxBound>> {
    with_slice(records, grid, options, index, |candidate_index, boxes, slice| {
        let columns = first_columns(candidate_index, slice);
        let (remaining, inverse) = factor_remaining_columns(candidate_index, slice, &columns)?;
        let remaining = boxes.remaining_columns(candidate_index, &remaining, &inverse)?;
        let tables = build_slice_tables(candidate_index, boxes, slice, &remaining, 0..slice.rows.len())?;
        let mut row_coefficients = RowCoefficients::default();
        tables.compute_coefficients(&mut row_coefficients, 0..slice.rows.len());
        let mut bounds = Vec::new();
        let levels = [0, 1].map(|side: usize| tables.sides[side].levels.len());
        for (a, b) in (0..levels[0]).flat_map(|a| (0..levels[1]).map(move |b| (a, b))) {
            for outer_position in 0..tables.sides[0].levels[a].coefficient_sums.len() {
                for inner_position in 0..tables.sides[1].levels[b].coefficient_sums.len() {
                    let intervals = [
                        Interval { level: a, position: outer_position },
                        Interval { level: b, position: inner_position },
                    ];
                    let ((u0, u1), (v0, v1)) = (intervals[0].ends(slice.rows.len()), intervals[1].ends(slice.len));
                    let cell = tables.box_quantities(&row_coefficients, intervals);
                    let bound = cell.map_or(0.0, |cell| tables.bound(intervals, &cell, f64::INFINITY));
                    bounds.push(BoxBound {
                        first: slice.lo + (u0 * slice.len + v0) as u64,
                        rows: (u1 - u0 + 1) as u64,
                        values: (v1 - v0 + 1) as u64,
                        stride: slice.len as u64,
                        bound,
                    });
                }
            }
        }
        Some(bounds)
    })
}

/// Return the candidates in the index range `range` that no bound excludes, limited to the slice of the order grid that
/// contains candidate `index`. They include all candidates whose raw error (Σ|e| or Σe²) is at most `limit`. Empty if
/// [`box_bounds`] is empty.
///
/// # Errors
/// The errors of [`crate::order_search::batches::search`]: an option out of range, signals that the records lack, or
/// too little memory.
pub fn open_candidates(
    records: &[Record],
    grid: &OrderGrid,
    options: &Options,
    index: u64,
    range: Range<u64>,
    limit: f64,
) -> Result<Vec<u64>> {
    with_slice(records, grid, options, index, |candidate_index, boxes, slice| {
        let range = (range.start.clamp(slice.lo, slice.hi), range.end.clamp(slice.lo, slice.hi));
        let (open, ..) = screen_slice(candidate_index, boxes, slice, range, limit)?;
        Some(open.iter().map(|open| open.index).collect())
    })
}

/// Apply `work` to the slice of the order grid that contains candidate `index`, after all test vectors are built.
/// Return an empty list if there is no such slice or `work` returns `None`.
fn with_slice<T>(
    records: &[Record],
    grid: &OrderGrid,
    options: &Options,
    index: u64,
    work: impl FnOnce(&CandidateIndex<'_>, &BranchAndBound, &traversal::GridSlice) -> Option<Vec<T>> + Send,
) -> Result<Vec<T>>
where
    T: Send,
{
    let pool = pool(1)?;
    let fixed = vec![None; grid.width()];
    let mut candidate_index =
        CandidateIndex::new(records, Cow::Borrowed(grid), &fixed, options, &pool, &Stop::default())?;
    candidate_index.problem = pool.install(|| candidate_index.problem.with_bound(u64::MAX >> 8, &Stop::default()));
    if options.criterion == Criterion::OutputError {
        let mut tailored = candidate_index.problem.empty_tailored_vectors().0;
        for vector_index in [index, 0, grid.count() / 2, grid.count() - 1] {
            let mut positions = vec![0; grid.width()];
            candidate_index.positions(&Cursor::at(grid, vector_index), &mut positions);
            tailored.vectors.extend(pool.install(|| candidate_index.problem.tailor_vector(&tailored, &positions)));
        }
        candidate_index.problem.tailored_vectors = Some(tailored);
    }
    let slice = grid.slice_at(index).filter(|_| (2..=MAX_REMAINING_COLUMNS + 2).contains(&grid.width()));
    let Some(slice) = slice else { return Ok(Vec::new()) };
    Ok(pool.install(|| work(&candidate_index, &BranchAndBound::new(&candidate_index)?, &slice)).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;
    use crate::order_search::branch_and_bound::axis_table::Wide;
    use crate::order_search::branch_and_bound::box_bound::{BoxQuantities, CornerValues};
    use crate::order_search::dual_bound::test_vectors::TestVectors;
    use crate::order_search::grid::TermAxis;
    use crate::order_search::options::Norm;

    /// Return record and order grid of a test case: two joint angles and a link deflection under steps, with closely or
    /// widely spaced orders.
    fn problem(case: u32) -> Result<(Record, OrderGrid)> {
        let m = 150;
        let time = |k: i32| f64::from(k) * 0.03;
        let signal = |of: &dyn Fn(i32) -> f64| (0..m).map(of).collect::<Vec<f64>>();
        let step = |every: i32| signal(&move |k| if (k / every) % 2 == 0 { 1.0 } else { -0.6 });
        let signals = vec![signal(&|k| libm::sin(2.0 * time(k)) * libm::exp(-0.2 * time(k))), step(31), step(47)];
        let grain = [0.2, 0.05, 0.01, 0.002][case as usize % 4];
        let some = |from: f64, count: u32| (0..count).map(|i| from + grain * f64::from(i)).collect::<Vec<f64>>();
        let axis = |signal: usize, values: Vec<f64>| TermAxis { signal, values, interchangeable: true };
        let output_orders = some(0.1 * f64::from(case % 3), 7);
        let mut axes = vec![axis(0, output_orders.clone()), axis(1, some(0.2, 9))];
        match case % 5 {
            0 | 1 => axes.insert(1, axis(0, output_orders)),
            // The output term has a fixed order.
            2 => axes = vec![axis(0, vec![0.3]), axis(1, some(0.2, 9)), axis(2, some(0.1, 6))],
            _ => axes.push(axis(2, vec![0.4])),
        }
        Ok((Record::from_rows(0.03, signals, None)?, OrderGrid::new(0, &[1.7], &axes, |s| s == 2)?))
    }

    /// Return the value at (s, t) of the bilinear function with these values at the corners of −1 ≤ s, t ≤ 1.
    fn interpolate_bilinear(corners: [f64; 4], (s, t): (f64, f64)) -> f64 {
        let shares = [(1.0 - s) * (1.0 - t), (1.0 + s) * (1.0 - t), (1.0 - s) * (1.0 + t), (1.0 + s) * (1.0 + t)];
        corners.iter().zip(shares).map(|(c, share)| 0.25 * c * share).sum()
    }

    /// Return the deviations of products and denominators of a candidate from their bilinear approximations over the
    /// box of orders, relative to the proved bounds. Each has one value per test vector.
    fn relative_deviations(whole: &CornerValues, one: &CornerValues, place: (f64, f64)) -> [Wide; 2] {
        let corners = |of: &dyn Fn(usize) -> f64| interpolate_bilinear(std::array::from_fn(of), place);
        let apart = |part: usize, n: usize| one.values[0][part][n] - corners(&|c| whole.values[c][part][n]);
        let ratio = |n: usize| apart(0, n).hypot(apart(1, n)) / whole.remainders[0][n];
        let more = |n: usize| (one.slack[0][n] - corners(&|c| whole.slack[c][n])).max(0.0);
        let size = |n: usize| (apart(2, n).hypot(apart(3, n)) + more(n)) / whole.remainders[1][n];
        [std::array::from_fn(ratio), std::array::from_fn(size)]
    }

    #[test]
    fn bilinear_deviation_is_within_the_box_bound() -> Result<()> {
        let mut nearest: Vec<[f64; 2]> = Vec::new();
        for case in 0..40 {
            let (record, grid) = problem(case)?;
            let options = Options { norm: [Norm::L1, Norm::L2][case as usize / 4 % 2], ..Options::default() };
            let bounds =
                with_slice(&[record], &grid, &options, u64::from(case) * 7, |candidate_index, boxes, slice| {
                    let columns = first_columns(candidate_index, slice);
                    let (others, inverse) = factor_remaining_columns(candidate_index, slice, &columns)?;
                    let others = boxes.remaining_columns(candidate_index, &others, &inverse)?;
                    let tables = build_slice_tables(candidate_index, boxes, slice, &others, 0..slice.rows.len())?;
                    let mut row_coefficients = RowCoefficients::default();
                    tables.compute_coefficients(&mut row_coefficients, 0..slice.rows.len());
                    let groups = others.test_vectors.first().map_or(0, |p: &TestVectors| p.groups);
                    let deviation_bound =
                        |intervals: [Interval; 2],
                         cell: &BoxQuantities,
                         group: usize,
                         joint_column: Option<Option<usize>>| {
                            let moduli = tables.moduli(intervals, cell);
                            let joint_column =
                                joint_column.unwrap_or_else(|| tables.joint_column(intervals, cell, &moduli, group));
                            (tables.corner_values(intervals, cell, &moduli, (0, group), joint_column), joint_column)
                        };
                    let mut most = Vec::new();
                    let levels = [0, 1].map(|side: usize| tables.sides[side].levels.len());
                    for (a, b) in (0..levels[0]).flat_map(|a| (0..levels[1]).map(move |b| (a, b))) {
                        for (at, by) in (0..tables.sides[0].levels[a].coefficient_sums.len()).flat_map(|at| {
                            (0..tables.sides[1].levels[b].coefficient_sums.len()).map(move |by| (at, by))
                        }) {
                            let intervals = [Interval { level: a, position: at }, Interval { level: b, position: by }];
                            let ends = [intervals[0].ends(slice.rows.len()), intervals[1].ends(slice.len)];
                            let Some(cell) = tables.box_quantities(&row_coefficients, intervals) else { continue };
                            for group in (0..groups).filter(|_| a + b > 0) {
                                let (whole, joint_column) = deviation_bound(intervals, &cell, group, None);
                                let mut nearest = [0.0_f64; 2];
                                for (i, j) in
                                    (ends[0].0..=ends[0].1).flat_map(|i| (ends[1].0..=ends[1].1).map(move |j| (i, j)))
                                {
                                    let alone =
                                        [Interval { level: 0, position: i }, Interval { level: 0, position: j }];
                                    let Some(cell) = tables.box_quantities(&row_coefficients, alone) else { continue };
                                    let (one, _) = deviation_bound(alone, &cell, group, Some(joint_column));
                                    let place = |x: usize, (from, to): (usize, usize)| {
                                        2.0 * (x - from) as f64 / (to - from).max(1) as f64 - 1.0
                                    };
                                    let far = relative_deviations(&whole, &one, (place(i, ends[0]), place(j, ends[1])));
                                    for (nearest, far) in nearest.iter_mut().zip(far) {
                                        // NaN counts as a failed bound.
                                        let far = far.map(|v| if v.is_nan() { f64::INFINITY } else { v });
                                        *nearest = far.into_iter().fold(*nearest, f64::max);
                                    }
                                }
                                most.push(nearest);
                            }
                        }
                    }
                    Some(most)
                })?;
            if bounds.is_empty() {
                return Err(Error::Internal { what: format!("nothing was proved of case {case}") });
            }
            nearest.extend(bounds);
        }
        for (part, name) in ["the projection", "the divisor"].into_iter().enumerate() {
            let most = nearest.iter().map(|near| near[part]).fold(0.0, f64::max);
            let close = nearest.iter().filter(|near| near[part] > 0.5).count();
            println!("{name}: {close} of {} boxes use half of what is allowed, at most {most:.4}", nearest.len());
            assert!(most <= 1.0 && close > nearest.len() / 20, "{name}");
        }
        Ok(())
    }
}

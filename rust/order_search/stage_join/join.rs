//! Join of the score tables of coupled equations, over orders that are compatible under the order law.
//!
//! The order law makes all orders affine functions of a few free orders x. Many values of x give the same orders of one
//! equation. A combination of values of all free orders is called a tuple.
//!
//! The free orders are divided into two halves, x = (a, b). The first half of the join contains the first equation, the
//! second half the other equations. The orders of the equations of one half are a sum: the contribution of the free
//! orders of this half, plus an addend from the free orders of the other half. This addend has few distinct values. A
//! row of the first half is (a, addend from b), a row of the second half (b, addend from a). Two rows of different
//! halves are compatible if the free orders in each row contribute the addend in the other row. Compatible rows are
//! stored in the same bucket. Every pair of rows in a bucket is a tuple, and every tuple occurs once. The product of
//! the axes is never enumerated.

use std::collections::hash_map::Entry as Slot;
use std::collections::HashMap;
use std::ops::Range;

use rayon::prelude::*;

use crate::equation::{grains, round_order, Structure, Term};
use crate::error::{Error, Result};
use crate::order_search::control::Control;
use crate::order_search::grid::order_law::{LawEquation, OrderLawGrid};
use crate::order_search::result::Failure;

/// Row of one half of the join of coupled equations. It combines values of the free orders of this half with an addend.
/// The free orders of the other half contribute this addend to the orders of the equations of this half.
#[derive(Debug, Clone, Copy)]
pub(super) struct HalfRow {
    /// Number of the bucket, computed from the two addends that compatible rows have in common. Rows of both halves in
    /// the same bucket are compatible.
    bucket_id: u64,
    /// Contribution of the free orders of this half to the index of a combination of all free orders.
    pub(super) index: u64,
    /// Index of the combination of candidates in [`Half`], with one candidate per equation of this half.
    pub(super) combination: u32,
}

/// One half of the join of coupled equations: some of the equations and some of the free orders.
pub(super) struct Half {
    /// Equations of this half.
    pub(super) equations: Range<usize>,
    /// Candidate index for each equation of this half, one combination after another.
    combinations: Vec<u32>,
    /// Rows of this half, sorted by bucket, then by index.
    pub(super) rows: Vec<HalfRow>,
}

impl Half {
    /// Return the sum of the scores and the class of every combination of candidates of this half.
    pub(super) fn states(&self, scores: &ScoreTables) -> Vec<ScoreEntry> {
        let width = self.equations.len();
        if width == 0 {
            return vec![ScoreEntry { value: 0.0, class: Class::Exact }];
        }
        self.combinations
            .chunks_exact(width)
            .map(|ids| {
                let entries = self.equations.clone().zip(ids).map(|(e, &id)| scores[e][id as usize]);
                entries.fold(ScoreEntry { value: 0.0, class: Class::Exact }, |sum, entry| ScoreEntry {
                    value: sum.value + entry.value,
                    class: sum.class.combine(entry.class),
                })
            })
            .collect()
    }

    /// Return the candidate index of each equation of this half in a combination.
    pub(super) fn ids(&self, combination: u32) -> &[u32] {
        let width = self.equations.len();
        &self.combinations[combination as usize * width..][..width]
    }
}

/// Row ranges of both halves of the join. A row of the first range and a row of the second range together give values
/// of all free orders that are compatible under the order law.
pub(super) struct Bucket {
    pub(super) rows: [Range<usize>; 2],
}

/// Join of the two halves of coupled equations under their order law.
pub(super) struct Join {
    pub(super) halves: [Half; 2],
    /// Buckets that contain rows of both halves of the join.
    pub(super) buckets: Vec<Bucket>,
}

/// Maximum number of rows of both halves of the join of coupled equations together, about 1 GB.
const MAX_HALF_ROWS: u128 = 40_000_000;
/// Memory per row of the join of coupled equations \[bytes\]. It is twice the size of a row, because a growing list is
/// copied.
const BYTES_PER_HALF_ROW: u128 = 2 * size_of::<HalfRow>() as u128;
/// Maximum number of free orders with several values for which all divisions into two halves of the join are tried.
/// Further free orders belong to the second half.
const MAX_SPLIT_ORDERS: usize = 10;

/// Return the free orders of the first half of the join for which the total number of rows is smallest. Return an error
/// if the rows are too many or need more than `memory` bytes.
fn split_free_orders(
    grid: &OrderLawGrid,
    rows: &[OrderLawSums; 2],
    memory: u64,
    control: &Control,
) -> Result<Vec<usize>> {
    let axes: Vec<usize> = (0..grid.axes().len()).collect();
    let size = |axes: &[usize]| axes.iter().map(|&a| grid.axes()[a].len() as u128).product::<u128>();
    let shared_axes: Vec<usize> =
        axes.iter().copied().filter(|&a| grid.axes()[a].len() > 1).take(MAX_SPLIT_ORDERS).collect();
    let mut plans: Vec<(u128, Vec<usize>, Vec<usize>)> = (0..1usize << shared_axes.len())
        .map(|mask| {
            let private_axes: Vec<usize> =
                shared_axes.iter().enumerate().filter(|(i, _)| mask >> i & 1 == 1).map(|(_, &axis)| axis).collect();
            let other: Vec<usize> = axes.iter().copied().filter(|axis| !private_axes.contains(axis)).collect();
            (size(&private_axes) + size(&other), private_axes, other)
        })
        .collect();
    plans.sort();
    let (mut min_size, mut best) = (u128::MAX, Vec::new());
    for (floor, private_axes, other) in plans {
        control.check_stop()?;
        if floor >= min_size {
            break;
        }
        let limit = |size: u128| usize::try_from((min_size / size).min(MAX_HALF_ROWS)).unwrap_or(usize::MAX);
        let Some(first) = rows[0].distinct_sums(grid, &other, limit(size(&private_axes)), control)? else { continue };
        let Some(second) = rows[1].distinct_sums(grid, &private_axes, limit(size(&other)), control)? else { continue };
        let count = size(&private_axes) * first.len() as u128 + size(&other) * second.len() as u128;
        if count < min_size {
            (min_size, best) = (count, private_axes);
        }
    }
    if min_size > MAX_HALF_ROWS {
        return Err(Error::OrderGridTooLarge { count: min_size.min(u128::from(grid.product())), limit: MAX_HALF_ROWS });
    }
    let (bytes, limit) = (BYTES_PER_HALF_ROW * min_size, u128::from(memory));
    if bytes > limit {
        return Err(Error::Memory { what: format!("{min_size} rows of the join of coupled equations"), bytes, limit });
    }
    Ok(best)
}

impl Join {
    /// Build the join and the distinct candidates of every equation. Also return the candidates of each equation that
    /// occur for some values of the free orders. Return [`Error::Memory`] if the rows need more than `memory` bytes,
    /// [`Error::OrderGridTooLarge`] for more than [`MAX_HALF_ROWS`] rows.
    pub(super) fn new(
        grid: &OrderLawGrid,
        candidates: &mut [Candidates],
        memory: u64,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<(Self, Vec<Vec<usize>>)> {
        let count = candidates.len();
        let ranges = [0..count.min(1), count.min(1)..count];
        let rows = ranges.clone().map(|range| OrderLawSums::new(grid, range));
        let private_axes = split_free_orders(grid, &rows, memory, control)?;
        let other: Vec<usize> = (0..grid.axes().len()).filter(|axis| !private_axes.contains(axis)).collect();
        let full = |axes: &[usize], rows: &OrderLawSums| {
            rows.distinct_sums(grid, axes, usize::MAX, control)?.ok_or_else(|| Error::Internal {
                what: "no contributions of free orders, although their number is unlimited".into(),
            })
        };
        let addends = [full(&other, &rows[0])?, full(&private_axes, &rows[1])?];
        let stride = addends[1].len() as u64;
        let mut halves = Vec::with_capacity(2);
        for (h, axes) in [&private_axes, &other].into_iter().enumerate() {
            let equations = ranges[h].clone();
            let mut half = Half { equations: equations.clone(), combinations: Vec::new(), rows: Vec::new() };
            let mut ids_by_key: HashMap<Box<[u32]>, u32> = HashMap::new();
            let (mut orders, mut key, mut ids) = (Vec::new(), Vec::new(), Vec::new());
            rows[h].for_each_choice(grid, axes, &rows[1 - h], |index, sums, other_sums| {
                control.check_stop()?;
                let Some(other_index) = addends[1 - h].find(other_sums) else { return Ok(()) };
                for (number_of_addend, addend) in addends[h].iter().enumerate() {
                    if number_of_addend % ROWS_PER_STOP_CHECK == ROWS_PER_STOP_CHECK - 1 {
                        control.check_stop()?;
                    }
                    if !rows[h].orders(grid, sums, addend, &mut orders) {
                        continue;
                    }
                    let combination =
                        combination(grid, candidates, &mut half, &mut ids_by_key, &orders, &mut key, &mut ids)?;
                    let (addend_index, other_index) = (number_of_addend as u64, u64::from(other_index));
                    let bucket_id =
                        if h == 0 { addend_index * stride + other_index } else { other_index * stride + addend_index };
                    half.rows.push(HalfRow { bucket_id, index, combination });
                }
                Ok(())
            })?;
            control.check_stop()?;
            pool.install(|| half.rows.par_sort_unstable_by_key(|row| (row.bucket_id, row.index)));
            halves.push(half);
        }
        let [first, second] =
            <[Half; 2]>::try_from(halves).map_err(|_| Error::Internal { what: "a join without two halves".into() })?;
        let mut join = Self { halves: [first, second], buckets: Vec::new() };
        join.match_buckets(control)?;
        let mut occurs: Vec<Vec<bool>> = candidates.iter().map(|c| vec![false; c.len()]).collect();
        for (i, bucket) in join.buckets.iter().enumerate() {
            if i % ROWS_PER_STOP_CHECK == 0 {
                control.check_stop()?;
            }
            for (half, rows) in join.halves.iter().zip(&bucket.rows) {
                for row in &half.rows[rows.clone()] {
                    for (e, &id) in half.equations.clone().zip(half.ids(row.combination)) {
                        occurs[e][id as usize] = true;
                    }
                }
            }
        }
        let candidate_ids = occurs.iter().map(|flags| (0..flags.len()).filter(|&id| flags[id]).collect()).collect();
        Ok((join, candidate_ids))
    }

    /// Find the buckets that contain rows of both halves of the join. Any two such rows in a bucket are compatible
    /// under the order law.
    fn match_buckets(&mut self, control: &Control) -> Result<()> {
        let [a, b] = [&self.halves[0].rows, &self.halves[1].rows];
        let end = |rows_of_bucket: &[HalfRow], start: usize| {
            start
                + rows_of_bucket[start..]
                    .iter()
                    .take_while(|row| row.bucket_id == rows_of_bucket[start].bucket_id)
                    .count()
        };
        let (mut i, mut j) = (0, 0);
        for step in 0usize.. {
            if i >= a.len() || j >= b.len() {
                break;
            }
            if step % ROWS_PER_STOP_CHECK == 0 {
                control.check_stop()?;
            }
            match a[i].bucket_id.cmp(&b[j].bucket_id) {
                std::cmp::Ordering::Less => i += 1,
                std::cmp::Ordering::Greater => j += 1,
                std::cmp::Ordering::Equal => {
                    let rows = [i..end(a, i), j..end(b, j)];
                    (i, j) = (rows[0].end, rows[1].end);
                    self.buckets.push(Bucket { rows });
                }
            }
        }
        Ok(())
    }

    /// Return the memory of the rows of both halves of the join \[bytes\].
    pub(super) fn bytes(&self) -> u128 {
        self.halves.iter().map(|half| (half.rows.capacity() * size_of::<HalfRow>()) as u128).sum()
    }

    /// Return the number of valid combinations of values of the free orders.
    pub(super) fn tuples(&self) -> u64 {
        self.buckets.iter().map(|b| b.rows[0].len() as u64 * b.rows[1].len() as u64).sum()
    }
}

/// Return the index of the combination of candidates that gives the equations of one half of the join these orders. A
/// new combination is appended. `key` and `ids` are workspace.
fn combination(
    grid: &OrderLawGrid,
    candidates: &mut [Candidates],
    half: &mut Half,
    ids_by_key: &mut HashMap<Box<[u32]>, u32>,
    orders: &[f64],
    key: &mut Vec<i64>,
    ids: &mut Vec<u32>,
) -> Result<u32> {
    ids.clear();
    let mut remaining_orders = orders;
    for e in half.equations.clone() {
        let (equation_orders, other_orders) = remaining_orders.split_at(grid.equations()[e].terms.len() + 1);
        ids.push(candidates[e].id(equation_orders, key)?);
        remaining_orders = other_orders;
    }
    match ids_by_key.entry(ids.as_slice().into()) {
        Slot::Occupied(slot) => Ok(*slot.get()),
        Slot::Vacant(slot) => {
            // Without free orders of their own, equations add candidates in the order of combinations.
            let next = to_u32(if ids.is_empty() { 0 } else { half.combinations.len() / ids.len() })?;
            half.combinations.extend_from_slice(ids);
            Ok(*slot.insert(next))
        }
    }
}

/// Score of one equation's candidate divided by the scale of the equation, or a lower bound of it.
#[derive(Debug, Clone, Copy)]
pub(super) struct ScoreEntry {
    /// Score divided by the scale of the equation, or a lower bound of it according to `class`. Infinite for a failure.
    pub(super) value: f64,
    pub(super) class: Class,
}

/// Class of a score entry: how reliable its value is. The class of a sum is its first failure, or without a failure the
/// last of the classes in the sequence below.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Class {
    /// The score is exact.
    Exact,
    /// Only a lower bound is known. The candidate was not simulated.
    Bounded,
    /// The simulation was stopped early at a partial sum, or has not been run.
    Open,
    /// The candidate has no score, for this reason.
    Failed(Failure),
}

impl Class {
    /// Return true for a candidate without a score.
    pub(super) fn is_failed(self) -> bool {
        matches!(self, Self::Failed(_))
    }

    /// Return the class of a sum of two entries.
    pub(super) fn combine(self, later: Self) -> Self {
        if self.is_failed() {
            self
        } else {
            self.max(later)
        }
    }
}

/// Score entry of a candidate that has not been evaluated.
pub(super) const UNEVALUATED_ENTRY: ScoreEntry = ScoreEntry { value: 0.0, class: Class::Open };

/// Score entries by equation, then by candidate.
pub(super) type ScoreTables = Vec<Vec<ScoreEntry>>;

/// Candidates `first … last − 1` of one equation, to be evaluated up to a limit of their score.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Span {
    /// Index of the equation.
    pub equation: usize,
    /// First candidate.
    pub first: usize,
    /// Candidate after the last one of the span.
    pub last: usize,
    /// Limit of the score, divided by the scale of the equation, at which an evaluation stops.
    pub limit: f64,
}

/// Group candidates of an equation, given as (candidate, limit) in ascending order, into spans of consecutive
/// candidates with the same limit.
pub(super) fn spans(equation: usize, requests: impl Iterator<Item = (usize, f64)>) -> Vec<Span> {
    let mut spans: Vec<Span> = Vec::new();
    for (id, limit) in requests {
        match spans.last_mut() {
            Some(span) if span.last == id && span.limit.to_bits() == limit.to_bits() => span.last = id + 1,
            _ => spans.push(Span { equation, first: id, last: id + 1, limit }),
        }
    }
    spans
}

/// Distinct candidates of one equation: its orders α and ν.
pub(super) struct Candidates {
    output: usize,
    signals: Vec<usize>,
    /// Order α and the orders ν of the terms, one candidate after another.
    orders: Vec<f64>,
    /// Candidate number by rounded orders.
    ids: HashMap<Box<[i64]>, u32>,
}

impl Candidates {
    pub(super) fn new(equation: &LawEquation) -> Self {
        let signals = equation.terms.iter().map(|t| t.0).collect();
        Self { output: equation.output, signals, orders: Vec::new(), ids: HashMap::new() }
    }

    pub(super) fn len(&self) -> usize {
        self.ids.len()
    }

    /// Return the index of the candidate with these orders (α, then the terms). A new candidate is appended. `key` is
    /// workspace.
    pub(super) fn id(&mut self, orders: &[f64], key: &mut Vec<i64>) -> Result<u32> {
        key.clear();
        key.extend(orders.iter().map(|&v| grains(v)));
        if let Some(&id) = self.ids.get(key.as_slice()) {
            return Ok(id);
        }
        let id = to_u32(self.ids.len())?;
        self.ids.insert(key.as_slice().into(), id);
        self.orders.extend_from_slice(orders);
        Ok(id)
    }

    /// Return the structure of a candidate.
    pub(super) fn structure(&self, id: usize) -> Structure {
        let width = self.signals.len() + 1;
        let orders = &self.orders[id * width..(id + 1) * width];
        let terms = self.signals.iter().zip(&orders[1..]).map(|(&signal, &order)| Term { signal, order }).collect();
        Structure { output: self.output, order: orders[0], terms }
    }
}

/// Convert a count to the 32-bit type of the tables. Return [`Error::Internal`] if it is too large.
pub(super) fn to_u32(count: usize) -> Result<u32> {
    u32::try_from(count).map_err(|_| Error::Internal { what: "more than 2^32 distinct orders".into() })
}

/// Number of rows between two checks for a stop request.
pub(super) const ROWS_PER_STOP_CHECK: usize = 4096;

/// Set of distinct contributions of some free orders to the order laws. Each is a vector with one value per law, and
/// has a number.
#[derive(Debug)]
pub(super) struct DistinctSums {
    /// Number of order laws.
    width: usize,
    count: usize,
    /// Vectors of contributions, one after another.
    values: Vec<f64>,
    /// Number of each vector of contributions, by its rounded values.
    ids: HashMap<Box<[i64]>, u32>,
}

impl Drop for DistinctSums {
    /// Deallocate the keys in a background thread. There may be millions, and deallocation would delay the response to
    /// Ctrl-C.
    fn drop(&mut self) {
        if self.count > 8 * ROWS_PER_STOP_CHECK {
            let ids = std::mem::take(&mut self.ids);
            // If no thread can be started, the keys are deallocated here.
            drop(std::thread::Builder::new().spawn(move || drop(ids)));
        }
    }
}

impl DistinctSums {
    fn of(width: usize) -> Self {
        Self { width, count: 0, values: Vec::new(), ids: HashMap::new() }
    }

    /// Return the key of a vector of sums, in units of 1e-12, which is a thousandth of the order resolution. This
    /// absorbs the rounding of the sums.
    #[allow(clippy::cast_possible_truncation)]
    fn key(sums: &[f64]) -> Box<[i64]> {
        sums.iter().map(|v| (v * 1e12).round() as i64).collect()
    }

    /// Insert a vector of contributions if it is new.
    fn insert(&mut self, sums: &[f64]) {
        #[allow(clippy::cast_possible_truncation)]
        let next = self.count as u32;
        if let Slot::Vacant(slot) = self.ids.entry(Self::key(sums)) {
            slot.insert(next);
            self.values.extend_from_slice(sums);
            self.count += 1;
        }
    }

    pub(super) fn len(&self) -> usize {
        self.count
    }

    /// Return the index of a vector of contributions in this set; `None` if it is not in the set.
    pub(super) fn find(&self, sums: &[f64]) -> Option<u32> {
        self.ids.get(&Self::key(sums)).copied()
    }

    /// Iterate over the vectors of contributions in the sequence of their indices.
    pub(super) fn iter(&self) -> impl Iterator<Item = &[f64]> {
        (0..self.count).map(|i| &self.values[i * self.width..(i + 1) * self.width])
    }
}

/// Order laws of some of the coupled equations. An order law gives the order α of an equation or the order ν of a term
/// as an affine function of the free orders.
pub(super) struct OrderLawSums {
    equations: Range<usize>,
    /// Constant of each order law.
    constants: Vec<f64>,
    /// Weight of each free order in each order law, by free order.
    weights: Vec<Vec<f64>>,
}

impl OrderLawSums {
    pub(super) fn new(grid: &OrderLawGrid, equations: Range<usize>) -> Self {
        let laws = || grid.equations()[equations.clone()].iter().flat_map(LawEquation::laws);
        let constants = laws().map(|law| law.constant).collect();
        let weights = (0..grid.axes().len())
            .map(|axis| laws().map(|law| law.weights.get(axis).copied().unwrap_or(0.0)).collect())
            .collect();
        Self { constants, weights, equations }
    }

    /// Return the distinct contributions of the free orders `axes` to the order laws of these equations. `None` if
    /// there are more than `limit`.
    ///
    /// # Errors
    /// [`crate::error::Error::Interrupted`] after a stop request.
    pub(super) fn distinct_sums(
        &self,
        grid: &OrderLawGrid,
        axes: &[usize],
        limit: usize,
        control: &Control,
    ) -> Result<Option<DistinctSums>> {
        let width = self.constants.len();
        let mut distinct = DistinctSums::of(width);
        distinct.insert(&vec![0.0; width]);
        for &axis in axes {
            let mut next = DistinctSums::of(width);
            for sums in distinct.iter() {
                for (i, value) in grid.axes()[axis].iter().enumerate() {
                    if i % ROWS_PER_STOP_CHECK == 0 {
                        control.check_stop()?;
                    }
                    let sums: Vec<f64> = sums.iter().zip(&self.weights[axis]).map(|(s, w)| s + w * value).collect();
                    next.insert(&sums);
                }
                if next.len() > limit {
                    return Ok(None);
                }
            }
            distinct = next;
        }
        Ok(Some(distinct))
    }

    /// Call `visit(index, sums, other_sums)` for every combination of values of the free orders `axes`. `index` is its
    /// contribution to the index of a combination of all free orders. `sums` are the values of the order laws of these
    /// equations, with constants. `other_sums` are the contributions to the order laws of `other_rows`, without
    /// constants.
    ///
    /// # Errors
    /// The first error of `visit`.
    pub(super) fn for_each_choice(
        &self,
        grid: &OrderLawGrid,
        axes: &[usize],
        other_rows: &Self,
        mut visit: impl FnMut(u64, &[f64], &[f64]) -> Result<()>,
    ) -> Result<()> {
        let strides: Vec<u64> =
            axes.iter().map(|&axis| grid.axes()[axis + 1..].iter().map(|a| a.len() as u64).product()).collect();
        let mut digits = vec![0usize; axes.len()];
        let (mut sums, mut other_sums) = (Vec::new(), Vec::new());
        loop {
            let value = |i: usize| grid.axes()[axes[i]][digits[i]];
            let add = |base: &[f64], weights: &[Vec<f64>], out: &mut Vec<f64>| {
                out.clear();
                out.extend_from_slice(base);
                for (i, &axis) in axes.iter().enumerate() {
                    out.iter_mut().zip(&weights[axis]).for_each(|(s, w)| *s += w * value(i));
                }
            };
            add(&self.constants, &self.weights, &mut sums);
            add(&vec![0.0; other_rows.constants.len()], &other_rows.weights, &mut other_sums);
            let index = digits.iter().zip(&strides).map(|(&digit, stride)| digit as u64 * stride).sum();
            visit(index, &sums, &other_sums)?;
            let Some(i) = (0..axes.len()).rev().find(|&i| digits[i] + 1 < grid.axes()[axes[i]].len()) else {
                return Ok(());
            };
            digits[i] += 1;
            digits[i + 1..].fill(0);
        }
    }

    /// Write the orders `sums` + `addend` of these equations to `orders`. Return true if all orders are valid.
    pub(super) fn orders(&self, grid: &OrderLawGrid, sums: &[f64], addend: &[f64], orders: &mut Vec<f64>) -> bool {
        orders.clear();
        orders.extend(sums.iter().zip(addend).map(|(s, a)| round_order(s + a)));
        let mut remaining_orders = &orders[..];
        grid.equations()[self.equations.clone()].iter().all(|equation| {
            let (equation_orders, other_orders) = remaining_orders.split_at(equation.terms.len() + 1);
            remaining_orders = other_orders;
            grid.are_valid_orders(equation, equation_orders)
        })
    }
}

//! Traversal of an order grid: by ascending index, by two-dimensional slices, or in a low-discrepancy sequence.
//!
//! A slice is a contiguous range of candidate indices over which only two orders vary, each through all of its values.
//! The first candidates of a low-discrepancy sequence, however many, are evenly distributed over the grid.

use crate::equation::{Structure, Term};
use crate::order_search::grid::independent::{BitSet, OrderGrid, PREFIX_STRIDE};

impl OrderGrid {
    /// Return the structure of a candidate. An index beyond the end gives the last candidate.
    ///
    /// ```
    /// # use ftlm::order_search::grid::{OrderGrid, TermAxis};
    /// let output_axis = TermAxis { signal: 0, values: vec![0.0, 0.5], interchangeable: false };
    /// let grid = OrderGrid::new(0, &[0.8], &[output_axis], |_| false)?;
    /// let orders: Vec<f64> = (0..grid.count()).map(|index| grid.structure(index).terms[0].order).collect();
    /// assert_eq!(orders, [0.5, 0.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn structure(&self, index: u64) -> Structure {
        Cursor::at(self, index).structure()
    }
}

/// Position in a traversal of an order grid. The terms of one signal form a group. A block has one order α of the
/// equation.
#[derive(Debug, Clone)]
pub(crate) struct Cursor<'a> {
    grid: &'a OrderGrid,
    /// Index of the block, which has one order α of the equation.
    block: usize,
    /// For each group, the index of the combination of all its orders but the last.
    prefixes: Vec<usize>,
    /// For each group, the axis positions of its last order that are allowed with its other orders.
    completions: Vec<BitSet>,
    /// Axis position of the order of each term, by group.
    digits: Vec<Vec<usize>>,
}

impl<'a> Cursor<'a> {
    /// Return a cursor at a candidate. An index beyond the end gives the last candidate.
    pub(crate) fn at(grid: &'a OrderGrid, index: u64) -> Self {
        let index = index.min(grid.count - 1);
        let block = grid.blocks.partition_point(|b| b.start <= index).saturating_sub(1);
        let groups = grid.groups.len();
        let mut cursor = Self {
            grid,
            block,
            prefixes: vec![0; groups],
            completions: vec![BitSet(Vec::new()); groups],
            digits: grid.groups.iter().map(|g| vec![0; g.terms.len()]).collect(),
        };
        let mut remaining = index - grid.blocks[block].start;
        for g in (0..groups).rev() {
            let count = grid.blocks[block].tuples[g].count;
            cursor.seek(g, remaining % count);
            remaining /= count;
        }
        cursor
    }

    /// Return the index of the candidate in a block whose orders have these axis positions, one per term. `None` if
    /// there is no such candidate.
    pub(crate) fn find(grid: &'a OrderGrid, block: usize, digits: &[usize]) -> Option<u64> {
        let mut cursor = Self::at(grid, grid.blocks.get(block)?.start);
        let mut index = 0;
        for (g, group) in grid.groups.iter().enumerate() {
            let count = grid.blocks[block].tuples[g].count;
            let digits_of_group = || group.terms.iter().map(|&term| digits[term]);
            let (mut lo, mut hi) = (0, count);
            while lo < hi {
                let rank = lo + (hi - lo) / 2;
                cursor.seek(g, rank);
                if cursor.digits[g].iter().copied().lt(digits_of_group()) {
                    lo = rank + 1;
                } else {
                    hi = rank;
                }
            }
            if lo == count {
                return None;
            }
            cursor.seek(g, lo);
            if !cursor.digits[g].iter().copied().eq(digits_of_group()) {
                return None;
            }
            index = index * count + lo;
        }
        Some(grid.blocks[block].start + index)
    }

    /// Move a group (the terms of one signal) to its combination of orders with this rank.
    fn seek(&mut self, g: usize, rank: u64) {
        let (group, slice) = (&self.grid.groups[g], &self.grid.blocks[self.block].tuples[g]);
        let block = slice.cumulative_counts.partition_point(|&b| b <= rank).saturating_sub(1);
        let mut remaining = rank - slice.cumulative_counts[block];
        for prefix in block * PREFIX_STRIDE..slice.prefixes {
            group.decode(&slice.first, prefix, &mut self.digits[g]);
            let completions = group.count_completions(&slice.first, &self.digits[g]);
            if remaining < completions {
                self.enter(g, prefix);
                self.digits[g][group.last()] = self.completions[g].select(remaining).unwrap_or(0);
                return;
            }
            remaining -= completions;
        }
    }

    /// Set all orders of a group (the terms of one signal) but the last to combination number `prefix`. Return true if
    /// any value of the last order is allowed with them.
    fn enter(&mut self, g: usize, prefix: usize) -> bool {
        let group = &self.grid.groups[g];
        let first = &self.grid.blocks[self.block].tuples[g].first;
        group.decode(first, prefix, &mut self.digits[g]);
        let words = &mut self.completions[g].0;
        words.clear();
        words.resize(group.axes[group.last()].len().div_ceil(64), 0);
        let mut union = 0;
        group.completions(first, &self.digits[g], |word, bits| {
            words[word] = bits;
            union |= bits;
        });
        self.prefixes[g] = prefix;
        union != 0
    }

    /// Advance to the next candidate, if there is one. Return the index of the first group (terms of one signal) that
    /// has changed. Return 0 after a change of α.
    pub(crate) fn advance(&mut self) -> usize {
        let groups = self.grid.groups.len();
        for g in (0..groups).rev() {
            if self.grid.blocks[self.block].tuples[g].count == 1 {
                continue;
            }
            if self.step(g) {
                return g;
            }
            self.seek(g, 0);
        }
        if self.block + 1 < self.grid.blocks.len() {
            self.block += 1;
            (0..groups).for_each(|g| self.seek(g, 0));
        }
        0
    }

    /// Return the term whose order alone changes over `len` candidates, from this one on, and its axis position. The
    /// order changes by one axis position per candidate. `None` if there is no such term.
    #[inline]
    pub(crate) fn adjacent_block(&self, len: usize) -> Option<(usize, usize)> {
        let slices = &self.grid.blocks[self.block].tuples;
        let g = (0..slices.len()).rev().find(|&g| slices[g].count > 1)?;
        let group = &self.grid.groups[g];
        let digit = self.digits[g][group.last()];
        let is_within = digit + len <= group.axes[group.last()].len();
        (is_within && (digit..digit + len).all(|i| self.completions[g].has(i)))
            .then(|| (group.terms[group.last()], digit))
    }

    /// Return the term whose order alone changes over the next candidates, its axis position, and the number of these
    /// candidates, including this one. The order changes by one axis position per candidate. `None` if no order varies.
    #[inline]
    pub(crate) fn adjacent_run(&self) -> Option<(usize, usize, usize)> {
        let slices = &self.grid.blocks[self.block].tuples;
        let g = (0..slices.len()).rev().find(|&g| slices[g].count > 1)?;
        let group = &self.grid.groups[g];
        let digit = self.digits[g][group.last()];
        Some((group.terms[group.last()], digit, self.completions[g].run(digit)))
    }

    /// Advance by `count` candidates, within the run of candidates over which only one term changes.
    #[inline]
    pub(crate) fn skip(&mut self, count: usize) {
        let slices = &self.grid.blocks[self.block].tuples;
        if let Some(g) = (0..slices.len()).rev().find(|&g| slices[g].count > 1) {
            self.digits[g][self.grid.groups[g].last()] += count;
        }
    }

    /// Advance a group (the terms of one signal) to its next combination of orders. Return true if there is one.
    fn step(&mut self, g: usize) -> bool {
        let last = self.grid.groups[g].last();
        if let Some(next) = self.completions[g].next(self.digits[g][last] + 1) {
            self.digits[g][last] = next;
            return true;
        }
        let prefixes = self.grid.blocks[self.block].tuples[g].prefixes;
        if !(self.prefixes[g] + 1..prefixes).any(|prefix| self.enter(g, prefix)) {
            return false;
        }
        self.digits[g][last] = self.completions[g].next(0).unwrap_or(0);
        true
    }

    /// Return the axis positions of the last order of a group (the terms of one signal) that are allowed with its other
    /// orders.
    pub(crate) fn completions(&self, group: usize) -> Vec<usize> {
        let set = &self.completions[group];
        std::iter::successors(set.next(0), |&digit| set.next(digit + 1)).collect()
    }

    /// Return the index of the block, which has one order α of the equation.
    pub(crate) fn block(&self) -> usize {
        self.block
    }

    /// Call `visit(term, axis position)` for each order of group `first_term` and all later groups. The terms of one
    /// signal form a group.
    #[inline(always)]
    pub(crate) fn for_each_term(&self, first_term: usize, mut visit: impl FnMut(usize, usize)) {
        for (group, digits) in self.grid.groups[first_term..].iter().zip(&self.digits[first_term..]) {
            group.terms.iter().zip(digits).for_each(|(&term, &digit)| visit(term, digit));
        }
    }

    /// Return the structure of the current candidate.
    pub(crate) fn structure(&self) -> Structure {
        let mut terms = vec![Term { signal: 0, order: 0.0 }; self.grid.width()];
        for (group, digits) in self.grid.groups.iter().zip(&self.digits) {
            for ((&k, axis), &digit) in group.terms.iter().zip(&group.axes).zip(digits) {
                terms[k] = Term { signal: group.signal, order: axis[digit] };
            }
        }
        Structure { output: self.grid.output(), order: self.grid.blocks[self.block].alpha, terms }
    }
}

/// Slice of candidates `lo … hi − 1` in which the orders of two terms vary. Each row has one order of the outer term
/// and consecutive orders of the inner term.
#[derive(Debug, Clone)]
pub(crate) struct GridSlice {
    pub(crate) lo: u64,
    pub(crate) hi: u64,
    /// Index of the block, which has one order α of the equation.
    pub(crate) block: usize,
    /// Axis position of each term at the first candidate.
    pub(crate) digits: Vec<usize>,
    /// Index of the term whose order changes from row to row.
    pub(crate) outer: usize,
    /// Axis position of the outer term in each row.
    pub(crate) rows: Vec<usize>,
    /// Index of the term whose order varies along a row.
    pub(crate) inner: usize,
    /// First axis position of the inner term.
    pub(crate) first: usize,
    /// Number of candidates in a row.
    pub(crate) len: usize,
}

impl OrderGrid {
    /// Return the first axis position of a term whose order is in range for the order α of a block.
    pub(crate) fn first_in_range(&self, block: usize, term: usize) -> usize {
        let pairs = self.groups.iter().zip(&self.blocks[block].tuples);
        let mut all = pairs.flat_map(|(group, slice)| group.terms.iter().zip(&slice.first));
        all.find(|(t, _)| **t == term).map_or(0, |(_, first)| *first)
    }

    /// Return an upper bound of the number of candidates of any slice that lies in the same block as `slice` and varies
    /// the same two terms.
    pub(crate) fn max_slice_candidates(&self, slice: &GridSlice) -> u64 {
        let outer_group = self.groups.iter().find(|group| group.terms.contains(&slice.outer));
        let axis = outer_group
            .map_or(0, |group| group.axes[group.last()].len() - self.first_in_range(slice.block, slice.outer));
        (axis * slice.len) as u64
    }

    /// Return the slice that contains a candidate. `None` if the fastest varying signal has several terms, or if the
    /// order of no other signal varies.
    pub(crate) fn slice_at(&self, index: u64) -> Option<GridSlice> {
        let cursor = Cursor::at(self, index);
        let block = &self.blocks[cursor.block()];
        let mut varying = (0..self.groups.len()).rev().filter(|&g| block.tuples[g].count > 1);
        let (inner, outer) = (varying.next()?, varying.next()?);
        let (fast, slow) = (&self.groups[inner], &self.groups[outer]);
        if fast.terms.len() != 1 {
            return None;
        }
        let first = block.tuples[inner].first[0];
        let len = fast.axes[0].len() - first;
        let rows = cursor.completions(outer);
        let mut digits = vec![0; self.width()];
        cursor.for_each_term(0, |term, digit| digits[term] = digit);
        let (u, v) = (slow.terms[slow.last()], fast.terms[0]);
        let before = rows.iter().position(|&row| row == digits[u])? * len + (digits[v] - first);
        let lo = index - before as u64;
        digits[u] = rows[0];
        digits[v] = first;
        let hi = lo + (rows.len() * len) as u64;
        Some(GridSlice { lo, hi, block: cursor.block(), digits, outer: u, rows, inner: v, first, len })
    }
}
/// Fractional part of the golden ratio. Its multiples modulo 1 are evenly distributed.
const GOLDEN_FRACTION: f64 = 0.618_033_988_75;

/// Return a position in [0, 1) for an index. The positions of any number of consecutive indices are evenly distributed.
#[allow(clippy::cast_precision_loss)]
pub(crate) fn low_discrepancy_position(index: u64) -> f64 {
    (index as f64 * GOLDEN_FRACTION).fract()
}

/// Return a permutation of 0 … count − 1. Its first values, whatever their number, are evenly distributed.
pub(crate) fn low_discrepancy_order(count: u64) -> impl Fn(u64) -> u64 {
    // Multiples of the golden ratio modulo 1 are evenly distributed. A stride that is coprime with the count visits all
    // indices.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    let mut stride = ((count as f64 * GOLDEN_FRACTION) as u64).max(1);
    while gcd(stride, count) != 1 {
        stride += 1;
    }
    move |i| {
        #[allow(clippy::cast_possible_truncation)]
        let index = (u128::from(i) * u128::from(stride) % u128::from(count)) as u64;
        index
    }
}

/// Return the greatest common divisor.
fn gcd(a: u64, b: u64) -> u64 {
    if b == 0 {
        a
    } else {
        gcd(b, a % b)
    }
}

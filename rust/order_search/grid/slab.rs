//! Slabs of a lattice: runs of indices over which two orders alone vary, each through all of its values.

use crate::order_search::grid::independent::Lattice;
use crate::order_search::grid::traversal::Cursor;

/// Candidates `lo … hi − 1`: for each row, an order of one term, a run of orders of another.
#[derive(Debug, Clone)]
pub(crate) struct Slab {
    pub(crate) lo: u64,
    pub(crate) hi: u64,
    /// Number of the block, and position of every term's order in its axis at `lo`.
    pub(crate) block: usize,
    pub(crate) digits: Vec<usize>,
    /// The term whose order changes from row to row, and its orders.
    pub(crate) outer: usize,
    pub(crate) rows: Vec<usize>,
    /// The term whose order runs along a row, the first of its orders and their number.
    pub(crate) inner: usize,
    pub(crate) first: usize,
    pub(crate) len: usize,
}

impl Lattice {
    /// First value in range of a term's axis in a block.
    pub(crate) fn first(&self, block: usize, term: usize) -> usize {
        let place = self.groups.iter().zip(&self.blocks[block].slices);
        let mut all = place.flat_map(|(group, slice)| group.terms.iter().zip(&slice.first));
        all.find(|(t, _)| **t == term).map_or(0, |(_, first)| *first)
    }

    /// Most candidates of a slab of the same block.
    pub(crate) fn largest(&self, slab: &Slab) -> u64 {
        let whole = self.groups.iter().find(|group| group.terms.contains(&slab.outer));
        let axis = whole.map_or(0, |group| group.axes[group.last()].len() - self.first(slab.block, slab.outer));
        (axis * slab.len) as u64
    }

    /// The slab that holds a candidate; none where the signal that runs fastest has several terms, or where no other
    /// signal has orders to vary.
    pub(crate) fn slab(&self, index: u64) -> Option<Slab> {
        let cursor = Cursor::at(self, index);
        let block = &self.blocks[cursor.block()];
        let mut varying = (0..self.groups.len()).rev().filter(|&g| block.slices[g].count > 1);
        let (inner, outer) = (varying.next()?, varying.next()?);
        let (fast, slow) = (&self.groups[inner], &self.groups[outer]);
        if fast.terms.len() != 1 {
            return None;
        }
        let first = block.slices[inner].first[0];
        let len = fast.axes[0].len() - first;
        let rows = cursor.completions(outer);
        let mut digits = vec![0; self.width()];
        cursor.each(0, |term, digit| digits[term] = digit);
        let (u, v) = (slow.terms[slow.last()], fast.terms[0]);
        let before = rows.iter().position(|&row| row == digits[u])? * len + (digits[v] - first);
        let lo = index - before as u64;
        digits[u] = rows[0];
        digits[v] = first;
        let hi = lo + (rows.len() * len) as u64;
        Some(Slab { lo, hi, block: cursor.block(), digits, outer: u, rows, inner: v, first, len })
    }
}

//! Regressors that the candidates of a search require, and the columns of several candidates in parallel SIMD lanes.

use std::collections::HashSet;

use crate::equation::{grains, Initial, ORDER_GRAIN};
use crate::regressors::{Index, Key};
use crate::simd::Lanes;

/// Set of the regressors that candidates require, collected from their orders.
pub(crate) struct RequiredRegressors<'a> {
    initial: &'a Initial,
    index: Index,
    /// Orders α of equations whose regressors have been added, in units of the order resolution.
    alphas: HashSet<i64>,
    /// Order α of the equation, signal and order ν of each term whose regressors have been added.
    orders: HashSet<(i64, usize, i64)>,
}

impl<'a> RequiredRegressors<'a> {
    pub(crate) fn new(initial: &'a Initial) -> Self {
        Self { initial, index: Index::default(), alphas: HashSet::new(), orders: HashSet::new() }
    }

    /// Add the initial terms that every equation of order α = `alpha` requires.
    pub(crate) fn add_alpha(&mut self, alpha: f64) {
        if !self.alphas.insert(grains(alpha)) {
            return;
        }
        for exponent in self.initial.offset_exponents(alpha).into_iter().chain(self.initial.impulses()) {
            self.index.insert(Key::initial(exponent));
        }
        match self.initial.base() {
            Initial::Rest | Initial::Offset { .. } | Initial::Level { .. } | Initial::Filtered { .. } => {}
            Initial::Powers(powers) => powers.iter().for_each(|&e| {
                self.index.insert(Key::initial(e));
            }),
            Initial::Caputo => self.add_powers(0.0, alpha),
        }
    }

    /// Add all regressors that a term of a signal with this order requires in an equation of order `alpha`.
    pub(crate) fn add_term(&mut self, alpha: f64, signal: usize, order: f64) {
        if self.orders.insert((grains(alpha), signal, grains(order))) {
            self.index.insert(Key::integral(signal, alpha - order));
            if *self.initial.base() == Initial::Caputo {
                self.add_powers(alpha - order, order);
            }
        }
    }

    /// Add the initial terms t^{`integration` + i} for all integers i ≥ 0 below `order`.
    fn add_powers(&mut self, integration: f64, order: f64) {
        let mut i = 0.0;
        while i < order - ORDER_GRAIN {
            self.index.insert(Key::initial(integration + i));
            i += 1.0;
        }
    }

    /// Return all regressors, sorted. Neighbors on the order grid are adjacent.
    pub(crate) fn into_index(mut self) -> Index {
        self.index.sort();
        self.index
    }
}

/// Regressor columns (indices in a bank) of one term for L candidates.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Columns<const L: usize> {
    /// Regressor column of each candidate.
    pub(crate) indices: [usize; L],
    /// True if all candidates have the same column.
    is_uniform: bool,
    /// True if the columns are consecutive in ascending order.
    is_consecutive: bool,
}

impl<const L: usize> Columns<L> {
    /// Build the columns of L candidates, which may be arbitrary.
    pub(crate) fn new(indices: [usize; L]) -> Self {
        Self { indices, is_uniform: L == 1, is_consecutive: false }
    }

    /// Build the columns of L candidates that all have the same column.
    #[inline(always)]
    pub(crate) fn uniform(column: usize) -> Self {
        Self { indices: [column; L], is_uniform: true, is_consecutive: false }
    }

    /// Build the columns of L candidates, which must ascend.
    #[inline(always)]
    pub(super) fn from_ascending(indices: [usize; L]) -> Self {
        Self { indices, is_uniform: L == 1, is_consecutive: indices[L - 1] - indices[0] == L - 1 }
    }

    /// Determine whether the columns are equal or consecutive, because such columns are read faster.
    #[inline(always)]
    pub(crate) fn compare(&mut self) {
        let first = self.indices[0];
        self.is_uniform = self.indices.iter().all(|&p| p == first);
        self.is_consecutive = !self.is_uniform && self.indices.iter().enumerate().all(|(n, &p)| p == first + n);
    }

    /// Return the elements of a vector at the columns of the L candidates.
    #[inline(always)]
    pub(super) fn gather(&self, vector: &[f64]) -> Lanes<L> {
        if self.is_uniform {
            [vector[self.indices[0]]; L]
        } else if self.is_consecutive {
            part_of(&vector[self.indices[0]..])
        } else {
            let mut out = [0.0; L];
            out.iter_mut().zip(&self.indices).for_each(|(x, &p)| *x = vector[p]);
            out
        }
    }

    /// Return the elements of a symmetric matrix (row-major, `stride` values per row) at these columns and the columns
    /// `rows`, one per candidate.
    #[inline(always)]
    pub(super) fn gather_pairs(&self, rows: &Self, matrix: &[f64], stride: usize) -> Lanes<L> {
        if rows.is_uniform {
            self.gather(&matrix[rows.indices[0] * stride..(rows.indices[0] + 1) * stride])
        } else if self.is_uniform {
            rows.gather(&matrix[self.indices[0] * stride..(self.indices[0] + 1) * stride])
        } else {
            let mut out = [0.0; L];
            for n in 0..L {
                out[n] = matrix[rows.indices[n] * stride + self.indices[n]];
            }
            out
        }
    }
}

/// Return the first L elements of a slice.
#[inline(always)]
pub(crate) fn part_of<T: Copy, const L: usize>(values: &[T]) -> [T; L] {
    let mut out = [values[0]; L];
    out.copy_from_slice(&values[..L]);
    out
}

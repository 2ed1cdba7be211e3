//! What free orders add to the order laws of some equations: the addends by which the halves of a join meet.

use std::collections::hash_map::Entry;
use std::collections::HashMap;
use std::ops::Range;

use crate::equation::tidy;
use crate::error::Result;
use crate::order_search::control::Control;
use crate::order_search::grid::order_law::{LawEquation, LawLattice};

/// Rows of a layout between two looks at whether it is to stop.
pub(super) const LOOK: usize = 4096;

/// Vectors of sums, each once.
#[derive(Debug)]
pub(super) struct Distinct {
    width: usize,
    count: usize,
    values: Vec<f64>,
    ids: HashMap<Box<[i64]>, u32>,
}

impl Drop for Distinct {
    /// Millions of keys take longer to give back than Ctrl-C may take, so nobody waits for it.
    fn drop(&mut self) {
        if self.count > 8 * LOOK {
            let ids = std::mem::take(&mut self.ids);
            // Where no thread can be had they are given back here.
            drop(std::thread::Builder::new().spawn(move || drop(ids)));
        }
    }
}

impl Distinct {
    fn of(width: usize) -> Self {
        Self { width, count: 0, values: Vec::new(), ids: HashMap::new() }
    }

    /// Sums are of multiples of the grain by short weights: a thousandth of it tells them apart and forgives rounding.
    #[allow(clippy::cast_possible_truncation)]
    fn key(sums: &[f64]) -> Box<[i64]> {
        sums.iter().map(|v| (v * 1e12).round() as i64).collect()
    }

    fn insert(&mut self, sums: &[f64]) {
        #[allow(clippy::cast_possible_truncation)]
        let next = self.count as u32;
        if let Entry::Vacant(slot) = self.ids.entry(Self::key(sums)) {
            slot.insert(next);
            self.values.extend_from_slice(sums);
            self.count += 1;
        }
    }

    pub(super) fn len(&self) -> usize {
        self.count
    }

    pub(super) fn find(&self, sums: &[f64]) -> Option<u32> {
        self.ids.get(&Self::key(sums)).copied()
    }

    pub(super) fn each(&self) -> impl Iterator<Item = &[f64]> {
        (0..self.count).map(|i| &self.values[i * self.width..(i + 1) * self.width])
    }
}

/// The order laws of some equations of a stage, whose free orders come in two parts.
pub(super) struct Sums {
    equations: Range<usize>,
    constants: Vec<f64>,
    /// Weights of each free order.
    weights: Vec<Vec<f64>>,
}

impl Sums {
    pub(super) fn new(lattice: &LawLattice, equations: Range<usize>) -> Self {
        let laws = || lattice.equations()[equations.clone()].iter().flat_map(LawEquation::laws);
        let constants = laws().map(|law| law.constant).collect();
        let weights = (0..lattice.axes().len())
            .map(|axis| laws().map(|law| law.weights.get(axis).copied().unwrap_or(0.0)).collect())
            .collect();
        Self { constants, weights, equations }
    }

    /// What these free orders add to the laws: distinct sums, or none where there are more than the limit.
    ///
    /// # Errors
    /// [`crate::error::Error::Interrupted`].
    pub(super) fn image(
        &self,
        lattice: &LawLattice,
        axes: &[usize],
        limit: usize,
        control: &Control,
    ) -> Result<Option<Distinct>> {
        let width = self.constants.len();
        let mut found = Distinct::of(width);
        found.insert(&vec![0.0; width]);
        for &axis in axes {
            let mut next = Distinct::of(width);
            for sums in found.each() {
                for (i, value) in lattice.axes()[axis].iter().enumerate() {
                    if i % LOOK == 0 {
                        control.check_stop()?;
                    }
                    let sums: Vec<f64> = sums.iter().zip(&self.weights[axis]).map(|(s, w)| s + w * value).collect();
                    next.insert(&sums);
                }
                if next.len() > limit {
                    return Ok(None);
                }
            }
            found = next;
        }
        Ok(Some(found))
    }

    /// Calls `take` for every choice of these free orders with its part of a tuple's index, its sums in these laws
    /// (constants included) and its sums in the others (without).
    ///
    /// # Errors
    /// The first of `take`.
    pub(super) fn each(
        &self,
        lattice: &LawLattice,
        axes: &[usize],
        others: &Self,
        mut take: impl FnMut(u64, &[f64], &[f64]) -> Result<()>,
    ) -> Result<()> {
        let strides: Vec<u64> =
            axes.iter().map(|&axis| lattice.axes()[axis + 1..].iter().map(|a| a.len() as u64).product()).collect();
        let mut digits = vec![0usize; axes.len()];
        let (mut sums, mut theirs) = (Vec::new(), Vec::new());
        loop {
            let value = |i: usize| lattice.axes()[axes[i]][digits[i]];
            let add = |base: &[f64], weights: &[Vec<f64>], out: &mut Vec<f64>| {
                out.clear();
                out.extend_from_slice(base);
                for (i, &axis) in axes.iter().enumerate() {
                    out.iter_mut().zip(&weights[axis]).for_each(|(s, w)| *s += w * value(i));
                }
            };
            add(&self.constants, &self.weights, &mut sums);
            add(&vec![0.0; others.constants.len()], &others.weights, &mut theirs);
            let index = digits.iter().zip(&strides).map(|(&digit, stride)| digit as u64 * stride).sum();
            take(index, &sums, &theirs)?;
            let Some(i) = (0..axes.len()).rev().find(|&i| digits[i] + 1 < lattice.axes()[axes[i]].len()) else {
                return Ok(());
            };
            digits[i] += 1;
            digits[i + 1..].fill(0);
        }
    }

    /// The orders of these equations from own sums and an addend; tells whether they make equations.
    pub(super) fn orders(&self, lattice: &LawLattice, sums: &[f64], addend: &[f64], orders: &mut Vec<f64>) -> bool {
        orders.clear();
        orders.extend(sums.iter().zip(addend).map(|(s, a)| tidy(s + a)));
        let mut rest = &orders[..];
        lattice.equations()[self.equations.clone()].iter().all(|equation| {
            let (mine, others) = rest.split_at(equation.terms.len() + 1);
            rest = others;
            lattice.fits(equation, mine)
        })
    }
}

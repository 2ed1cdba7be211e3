//! The regressors that the candidates of a search need, each once.

use std::collections::HashSet;

use crate::equation::{grains, Initial, ORDER_GRAIN};
use crate::regressors::{Index, Key};

/// Collects the regressors of candidates from their orders.
pub(crate) struct Needed<'a> {
    initial: &'a Initial,
    index: Index,
    alphas: HashSet<i64>,
    orders: HashSet<(i64, usize, i64)>,
}

impl<'a> Needed<'a> {
    pub(crate) fn new(initial: &'a Initial) -> Self {
        Self { initial, index: Index::default(), alphas: HashSet::new(), orders: HashSet::new() }
    }

    /// Adds the initial terms that every structure of this α needs.
    pub(crate) fn alpha(&mut self, alpha: f64) {
        if !self.alphas.insert(grains(alpha)) {
            return;
        }
        for exponent in self.initial.offset_exponents(alpha).into_iter().chain(self.initial.impulses()) {
            self.index.insert(Key::initial(exponent));
        }
        match self.initial.under() {
            Initial::Rest | Initial::Offset { .. } | Initial::Filtered { .. } => {}
            Initial::Powers(powers) => powers.iter().for_each(|&e| {
                self.index.insert(Key::initial(e));
            }),
            Initial::Caputo => self.powers(0.0, alpha),
        }
    }

    /// Adds all regressors that a term of this order needs under this α.
    pub(crate) fn term(&mut self, alpha: f64, signal: usize, order: f64) {
        if self.orders.insert((grains(alpha), signal, grains(order))) {
            self.index.insert(Key::integral(signal, alpha - order));
            if *self.initial.under() == Initial::Caputo {
                self.powers(alpha - order, order);
            }
        }
    }

    /// Adds t^{from + i} for i = 0, 1, … below an order.
    fn powers(&mut self, from: f64, order: f64) {
        let mut i = 0.0;
        while i < order - ORDER_GRAIN {
            self.index.insert(Key::initial(from + i));
            i += 1.0;
        }
    }

    /// All of them, neighbours on a lattice beside each other.
    pub(crate) fn index(mut self) -> Index {
        self.index.sort();
        self.index
    }
}

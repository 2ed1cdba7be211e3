//! The distinct orders that an order law gives one equation: the candidates of a stage, by number.

use std::collections::HashMap;

use crate::equation::{grains, Structure, Term};
use crate::error::{Error, Result};
use crate::order_search::grid::order_law::LawEquation;

/// Distinct orders of one equation.
pub(super) struct Candidates {
    output: usize,
    signals: Vec<usize>,
    /// α and the terms' orders, one candidate after the other.
    orders: Vec<f64>,
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

    /// Number of the candidate with these orders, added at the end if new.
    pub(super) fn id(&mut self, orders: &[f64], key: &mut Vec<i64>) -> Result<u32> {
        key.clear();
        key.extend(orders.iter().map(|&v| grains(v)));
        if let Some(&id) = self.ids.get(key.as_slice()) {
            return Ok(id);
        }
        let id = number(self.ids.len())?;
        self.ids.insert(key.as_slice().into(), id);
        self.orders.extend_from_slice(orders);
        Ok(id)
    }

    pub(super) fn structure(&self, id: usize) -> Structure {
        let width = self.signals.len() + 1;
        let orders = &self.orders[id * width..(id + 1) * width];
        let terms = self.signals.iter().zip(&orders[1..]).map(|(&signal, &order)| Term { signal, order }).collect();
        Structure { output: self.output, order: orders[0], terms }
    }
}

/// A count as a number of 32 bits, which is what tables hold.
pub(super) fn number(count: usize) -> Result<u32> {
    u32::try_from(count).map_err(|_| Error::Internal { what: "more than 2^32 distinct orders".into() })
}

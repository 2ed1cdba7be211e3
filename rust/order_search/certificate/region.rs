//! The orders that a certificate speaks of, and which cells hold some of them.

use crate::error::{Error, Result};

/// What rounding may do to an order.
const ROUNDED: f64 = 1e-9;

/// Orders of one term.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Its signal.
    pub signal: usize,
    /// Lowest and highest order; equal where it is known.
    pub lowest: f64,
    /// See `lowest`.
    pub highest: f64,
}

/// All orders within some intervals of one equation.
#[derive(Debug, Clone, PartialEq)]
pub struct Region {
    /// The signal that the equation is of.
    pub output: usize,
    /// Lowest and highest order of the equation itself.
    pub alpha: (f64, f64),
    /// Orders of its terms, none above the equation's own.
    pub terms: Vec<Range>,
    /// Orders of the output stay this far below the equation's own, and orders of one signal this far apart: where they
    /// meet any equation is fulfilled, or its terms are one.
    pub apart: f64,
}

impl Region {
    /// Refuses what is no region.
    pub(super) fn check(&self) -> Result<()> {
        let range = |name: &str, value: f64, range: &str| Error::OutOfRange {
            name: name.into(),
            value,
            range: range.into(),
            remedy: "give intervals from low to high".into(),
        };
        let (low, high) = self.alpha;
        if !(0.0 < low && low <= high && high <= 10.0) {
            return Err(range("the interval of alpha", low, "0 < low <= high <= 10"));
        }
        if !(self.apart > 0.0 && self.apart <= 1.0) {
            return Err(range("apart", self.apart, "(0, 1]"));
        }
        for term in &self.terms {
            if !(-3.0 <= term.lowest && term.lowest <= term.highest && term.highest <= 10.0) {
                return Err(range("the interval of a term", term.lowest, "-3 <= low <= high <= 10"));
            }
        }
        Ok(())
    }

    /// Whether a term is of the output itself.
    fn own(&self, term: usize) -> bool {
        self.terms[term].signal == self.output
    }

    /// Orders of integration of a term: lowest and highest.
    pub(super) fn integrations(&self, term: usize) -> (f64, f64) {
        let least = if self.own(term) { self.apart } else { 0.0 };
        ((self.alpha.0 - self.terms[term].highest).max(least), self.alpha.1 - self.terms[term].lowest)
    }

    /// Whether two terms may change places.
    fn alike(&self, a: usize, b: usize) -> bool {
        self.terms[a] == self.terms[b] && self.terms[a].lowest < self.terms[a].highest
    }

    /// The equation's own orders with which orders of integration between these, of the first terms, may be had; none
    /// where there are none.
    pub(super) fn alphas(&self, within: &[(f64, f64)]) -> Option<(f64, f64)> {
        let (mut low, mut high) = self.alpha;
        for (term, &(a, b)) in within.iter().enumerate() {
            let (least, most) = self.integrations(term);
            let (a, b) = (a.max(least), b.min(most));
            if a > b + ROUNDED {
                return None;
            }
            low = low.max(a + self.terms[term].lowest);
            high = high.min(b + self.terms[term].highest);
            for (other, &(c, d)) in within.iter().enumerate().take(term) {
                if self.terms[other].signal != self.terms[term].signal {
                    continue;
                }
                // Terms that may change places are told apart by their order.
                let ways = [d - a, if self.alike(other, term) { f64::NEG_INFINITY } else { b - c }];
                if ways[0].max(ways[1]) < self.apart - ROUNDED {
                    return None;
                }
            }
        }
        (low <= high + ROUNDED).then_some((low, high))
    }

    /// The orders of integration as those of an equation and its terms.
    pub(super) fn orders(&self, etas: &[f64]) -> Option<(f64, Vec<f64>)> {
        let points: Vec<(f64, f64)> = etas.iter().map(|&eta| (eta, eta)).collect();
        let (low, high) = self.alphas(&points)?;
        let alpha = ((low + high) / 2.0).clamp(self.alpha.0, self.alpha.1);
        Some((alpha, etas.iter().map(|eta| alpha - eta).collect()))
    }

    /// Orders of integration near these that are of the region, where a cell holds some.
    pub(super) fn near(&self, within: &[(f64, f64)]) -> Option<Vec<f64>> {
        let (low, high) = self.alphas(within)?;
        let alpha = ((low + high) / 2.0).clamp(self.alpha.0, self.alpha.1);
        let etas: Vec<f64> = within.iter().map(|(a, b)| (a + b) / 2.0).collect();
        self.of_orders(alpha, &etas.iter().map(|eta| alpha - eta).collect::<Vec<_>>())
    }

    /// Orders of integration of an equation's order and those of its terms, each moved into its interval.
    pub(super) fn of_orders(&self, alpha: f64, orders: &[f64]) -> Option<Vec<f64>> {
        let alpha = alpha.clamp(self.alpha.0, self.alpha.1);
        let inside = |(term, order): (usize, &f64)| {
            let (least, range) = (self.integrations(term).0, self.terms[term]);
            (alpha - order.clamp(range.lowest, range.highest)).max(least)
        };
        let etas: Vec<f64> = orders.iter().enumerate().map(inside).collect();
        self.orders(&etas).map(|_| etas)
    }
}

//! The problem of lower order behind a pole that is too fast to see.

use std::collections::BTreeSet;

use crate::equation::Initial;
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::runner::Runner;
use crate::estimation::joint_fit::structure::{Coefficient, Equation, Structure};

/// A pole of this many radians a sample is faster than the samples see.
const FAST_POLE: f64 = 0.2;
/// Powers of t closer than this are one.
const SAME_POWER: f64 = 1e-9;

/// A problem one of whose equations ends with its highest own term: what is left of it behind a fast pole.
///
/// The coefficient of that term, but for its known factor, is 1 there, and `fast` where the pole is; `others` are the
/// coefficients of the equation's other terms.
#[derive(Debug, Clone, PartialEq)]
pub struct LowerOrder {
    /// What is free.
    pub free: Free,
    coefficient: String,
    factor: f64,
    others: BTreeSet<String>,
    fast: f64,
}

impl LowerOrder {
    /// The same dynamics in the whole problem, but for what is faster than the sampling.
    #[must_use]
    pub fn embedded(&self, runner: &Runner, whole: &Free) -> Runner {
        let point = &runner.attempt.place.point;
        let value = |name: &String| {
            if *name == self.coefficient {
                return -self.fast / self.factor;
            }
            let at = self.free.coefficients.iter().position(|c| c == name);
            let value = at.map_or(0.0, |at| point.coefficients[at]);
            if self.others.contains(name) {
                self.fast * value
            } else {
                value
            }
        };
        let order = |name: &String| self.free.orders.iter().position(|o| o == name).map_or(0.0, |at| point.orders[at]);
        let mut found = runner.clone();
        found.attempt.place.point.orders = whole.orders.iter().map(order).collect();
        found.attempt.place.point.coefficients = whole.coefficients.iter().map(value).collect();
        found.origin = format!("{}, from the equation of lower order", runner.origin);
        found
    }
}

/// The problem of lower order of one equation whose own orders are numbers, on samples so far apart \[s\]; free orders get
/// there by themselves.
#[must_use]
pub fn lower_order(free: &Free, step: f64) -> Option<LowerOrder> {
    let structure = &free.structure;
    let [item] = structure.equations.as_slice() else { return None };
    if structure.has_order_law() || !free.products.is_empty() || item.order.is_free() {
        return None;
    }
    if item.own().any(|term| term.order.is_free()) {
        return None;
    }
    let own = item.terms.iter().enumerate().filter(|(_, term)| term.signal == item.output);
    let (place, highest) =
        own.reduce(|best, next| if next.1.order.constant > best.1.order.constant { next } else { best })?;
    let Coefficient::Free(name) = &highest.coefficient else { return None };
    let mut rest = item.terms.clone();
    rest.remove(place);
    let order = highest.order.constant;
    if order <= 0.0 || rest.iter().any(|term| term.fixed().is_some() || term.coefficient == highest.coefficient) {
        return None;
    }
    let mut driving = rest.iter().filter(|term| term.signal != item.output && !term.order.is_free());
    if driving.any(|term| term.order.constant > order) {
        // Another signal would stand above the order of the lower equation: it cannot where it holds between samples.
        return None;
    }
    let others = rest.iter().filter_map(|term| term.coefficient.name().cloned()).collect();
    let initial = if structure.history { structure.initial.clone() } else { below(&structure.initial, order)? };
    let lower = Equation { order: highest.order.clone(), terms: rest, ..item.clone() };
    // A term of another signal may differentiate more often than the equation of lower order integrates.
    let reduced = Free::of(Structure { initial, ..structure.with_equation(0, lower) }).ok()?;
    let fast = libm::pow(FAST_POLE / step, item.order.constant - order);
    Some(LowerOrder { free: reduced, coefficient: name.clone(), factor: highest.factor, others, fast })
}

/// Initial terms whose exponents are given without those that the equation of lower order integrates to a drive; none where
/// one of the rest is what its offset is, too.
fn below(initial: &Initial, order: f64) -> Option<Initial> {
    let Initial::Powers(powers) = initial.under() else { return Some(initial.clone()) };
    let powers: Vec<f64> = powers.iter().copied().filter(|power| *power < order).collect();
    let offsets = initial.offset_exponents(order);
    if powers.iter().any(|power| offsets.iter().any(|offset| (power - offset).abs() < SAME_POWER)) {
        return None;
    }
    let under = if powers.is_empty() { Initial::Rest } else { Initial::Powers(powers) };
    Some(initial.with_under(under))
}

//! Problems with one term less, or known.
//!
//! The problem of lower order behind a pole that is too fast to see.
//!
//! A problem with whole orders.
//!
//! A problem with one of its orders known.

use std::collections::{BTreeMap, BTreeSet};

use crate::equation::Initial;
use crate::estimation::joint_fit::format::short;
use crate::estimation::joint_fit::parameter_set::{Clock, Free};
use crate::estimation::joint_fit::problem::{Attempt, Place, Runner};
use crate::estimation::joint_fit::structure::{Coefficient, Equation, Order, Structure};
use crate::estimation::output_error::Point;

/// A problem with one term less, or known: its coefficient, and the highest order of the equation that lacks it.
#[derive(Debug, Clone, PartialEq)]
pub struct Simpler {
    /// What is still free.
    pub free: Free,
    coefficient: String,
    order: Order,
    value: f64,
    /// Whether it is an equation driven by measured signals, all of which it still has.
    pub driven: bool,
}

impl Simpler {
    /// A point of the whole problem as a start of this one.
    #[must_use]
    pub fn without(&self, runner: &Runner, whole: &Free) -> Runner {
        let Point { orders, coefficients, inputs } = &runner.attempt.place.point;
        let order = |name: &String| whole.orders.iter().position(|o| o == name).map(|at| orders[at]);
        let value = |name: &String| whole.coefficients.iter().position(|c| c == name).map(|at| coefficients[at]);
        let point = Point {
            orders: self.free.orders.iter().filter_map(order).collect(),
            coefficients: self.free.coefficients.iter().filter_map(value).collect(),
            inputs: inputs.clone(),
        };
        Runner::at(Place { point, states: Vec::new() }, runner.origin.clone())
    }

    /// The same point of the whole problem; the order of a term that is 0 may be any, so it is half the highest.
    #[must_use]
    pub fn embedded(&self, runner: &Runner, whole: &Free) -> Runner {
        let Point { orders, coefficients, inputs } = &runner.attempt.place.point;
        let known: BTreeMap<&String, f64> = self.free.orders.iter().zip(orders.iter().copied()).collect();
        let highest = self.order.at(|name| known.get(&name.to_owned()).copied().unwrap_or(0.0));
        let values: BTreeMap<&String, f64> = self.free.coefficients.iter().zip(coefficients.iter().copied()).collect();
        let point = Point {
            orders: whole.orders.iter().map(|name| known.get(name).copied().unwrap_or(0.5 * highest)).collect(),
            coefficients: whole.coefficients.iter().map(|n| values.get(n).copied().unwrap_or(self.value)).collect(),
            inputs: inputs.clone(),
        };
        let origin = format!("{}, from {} = {}", runner.origin, self.coefficient, short(self.value, 6));
        let place = Place { point, states: runner.attempt.place.states.clone() };
        Runner { attempt: Attempt { place, ..runner.attempt.clone() }, origin, alike: runner.alike.clone() }
    }
}

/// Problems with one term less; none under a law, where no coefficient can be 0 by itself.
///
/// A term of a measured signal is left out where it is not the only one that drives: signals of one machine go with each
/// other, and where one stands for the rest there is an optimum that tells nothing of the machine. For the same reason a
/// coefficient that physics knows is held there first.
#[must_use]
pub fn simpler(free: &Free) -> Vec<Simpler> {
    let structure = &free.structure;
    if structure.has_order_law() || !free.products.is_empty() {
        return Vec::new();
    }
    let mut out = Vec::new();
    let mut add = |reduced, name: &String, order: &Order, value, driven| {
        // Some make no equation.
        if let Ok(free) = Free::of(reduced) {
            out.push(Simpler { free, coefficient: name.clone(), order: order.clone(), value, driven });
        }
    };
    for (place, item) in structure.equations.iter().enumerate() {
        let several = item.own().count() > 1;
        for (k, term) in item.terms.iter().enumerate().filter(|(_, term)| several && term.signal == item.output) {
            if let Coefficient::Free(name) = &term.coefficient {
                let mut terms = item.terms.clone();
                terms.remove(k);
                let rest = Equation { terms, ..item.clone() };
                add(structure.with_equation(place, rest), name, &item.order, 0.0, false);
            }
        }
        let driving: Vec<_> = item.driving().filter(|term| term.coefficient.name().is_some()).collect();
        for term in driving.iter().filter(|term| !structure.coupled && driving.len() > 1 && !term.order.is_free()) {
            if let Some(name) = term.coefficient.name() {
                // The signal stays, at 0: records have it.
                let known = BTreeMap::from([(name.clone(), 0.0)]);
                add(structure.with_coefficients(&known), name, &item.order, 0.0, true);
            }
        }
        for name in item.coefficient_names() {
            if let Some(&value) = structure.hints.known.get(name) {
                let known = BTreeMap::from([(name.clone(), value)]);
                add(structure.with_coefficients(&known), name, &item.order, value, true);
            }
        }
    }
    out
}

/// One of those that are one equation but for the names of its free numbers: of two terms alike either may go.
#[must_use]
pub fn unlike(problems: Vec<Simpler>) -> Vec<Simpler> {
    let mut seen = BTreeSet::new();
    problems.into_iter().filter(|less| nameless(less).is_none_or(|key| seen.insert(key))).collect()
}

/// The equation of a problem, its terms in an order of their own, and bounds in place of the names of orders; none where
/// another one may still be another problem.
fn nameless(less: &Simpler) -> Option<String> {
    let structure = &less.free.structure;
    let [item] = structure.equations.as_slice() else { return None };
    if less.driven || structure.delayed {
        return None;
    }
    let bound = |name: &String| less.free.orders.iter().position(|o| o == name).map(|at| less.free.bounds()[at]);
    let of = |order: &Order| {
        let weights: Vec<_> = order.weights.iter().map(|(name, weight)| (*weight, bound(name))).collect();
        format!("{:?} {weights:?}", order.constant)
    };
    let term = |t: &crate::estimation::joint_fit::structure::Term| {
        format!("{} {} {:?} {:?}", t.signal, of(&t.order), t.fixed(), t.factor)
    };
    let mut terms: Vec<String> = item.terms.iter().map(term).collect();
    terms.sort();
    Some(format!("{} {} {terms:?}", item.output, of(&item.order)))
}

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

/// Whole orders that stand for a free one, and how many points of them a race looks at.
const WHOLE: [f64; 4] = [0.0, 1.0, 2.0, 3.0];
const MOST_WHOLE: usize = 12;

/// A problem with every free order at a whole value: what a fractional one is to be better than.
#[derive(Debug, Clone, PartialEq)]
pub struct Whole {
    /// What is still free.
    pub free: Free,
    /// The orders.
    pub orders: Vec<f64>,
}

impl Whole {
    /// The same point of the whole problem.
    #[must_use]
    pub fn embedded(&self, runner: &Runner) -> Runner {
        let mut found = runner.clone();
        found.attempt.place.point.orders.clone_from(&self.orders);
        found.origin = format!("{}, from whole orders", runner.origin);
        found
    }
}

/// The problem with whole orders: the usual ones, those nearest to a point, and each with one of them at another.
///
/// Between two whole orders the coefficient of what drives may change its sign, and no descent crosses that: what is nearest
/// need not be what is lowest. None where they make no equation.
#[must_use]
#[allow(clippy::float_cmp)]
pub fn whole(free: &Free, near: &[f64]) -> Vec<Whole> {
    let natural = &free.structure.hints.natural;
    let values: Vec<Vec<f64>> = (free.orders.iter().zip(free.bounds()))
        .map(|(name, &(low, high))| {
            let known: Vec<f64> =
                natural.get(name).into_iter().flatten().copied().filter(|v| *v == v.round()).collect();
            let known = if known.is_empty() { WHOLE.to_vec() } else { known };
            known.into_iter().filter(|v| (low..=high).contains(v)).collect()
        })
        .collect();
    if values.is_empty() || values.iter().any(Vec::is_empty) {
        return Vec::new();
    }
    let mut points: Vec<Vec<f64>> = Vec::new();
    let mut add = |point: Vec<f64>| {
        if !points.contains(&point) {
            points.push(point);
        }
    };
    for point in [free.whole_orders().as_slice(), near] {
        let first: Vec<f64> = values.iter().zip(point).map(|(v, at)| nearest(v, *at)).collect();
        add(first.clone());
        for (k, choices) in values.iter().enumerate() {
            for &other in choices.iter().filter(|v| **v != first[k]) {
                let mut moved = first.clone();
                moved[k] = other;
                add(moved);
            }
        }
    }
    points.into_iter().filter_map(|orders| at(free, orders)).take(MOST_WHOLE).collect()
}

fn nearest(values: &[f64], at: f64) -> f64 {
    values.iter().copied().reduce(|best, v| if (v - at).abs() < (best - at).abs() { v } else { best }).unwrap_or(at)
}

/// The problem at some whole orders, if they make an equation.
fn at(free: &Free, orders: Vec<f64>) -> Option<Whole> {
    let known: BTreeMap<String, f64> = free.orders.iter().cloned().zip(orders.iter().copied()).collect();
    let reduced = free.structure.with_orders(&known).and_then(Free::of).ok()?;
    // Terms in the order in which they stand, so coefficients keep their places.
    (reduced.coefficients == free.coefficients).then_some(Whole { free: reduced, orders })
}

/// A problem with one free order at the whole value that the equation would have, the others still free.
#[derive(Debug, Clone, PartialEq)]
pub struct Held {
    /// What is still free.
    pub free: Free,
    /// Place of the order in the whole problem.
    pub order: usize,
    /// Its value.
    pub value: f64,
}

impl Held {
    /// A point of the whole problem as a start of this one: coefficients keep their numbers in the clock's unit.
    #[must_use]
    pub fn without(&self, runner: &Runner, clock: &Clock) -> Runner {
        let mut told = clock.told(&runner.attempt.values());
        told[self.order] = self.value;
        let mut values = clock.untold(&told);
        values.remove(self.order);
        let (orders, rest) = values.split_at(self.free.orders.len());
        let (coefficients, inputs) = rest.split_at(self.free.coefficients.len());
        let point = Point { orders: orders.into(), coefficients: coefficients.into(), inputs: inputs.into() };
        Runner::at(Place { point, states: Vec::new() }, runner.origin.clone())
    }

    /// The same point of the whole problem.
    #[must_use]
    pub fn embedded(&self, runner: &Runner, whole: &Free) -> Runner {
        let mut found = runner.clone();
        found.attempt.place.point.orders.insert(self.order, self.value);
        found.origin = format!("{}, from {} = {}", runner.origin, whole.orders[self.order], short(self.value, 6));
        found
    }
}

/// Problems with one order less, where there are several: none may end below the whole one.
#[must_use]
#[allow(clippy::float_cmp)]
pub fn held(free: &Free) -> Vec<Held> {
    let mut out = Vec::new();
    for (order, value) in free.whole_orders().into_iter().enumerate() {
        if free.orders.len() < 2 || value != value.round() {
            continue;
        }
        let known = BTreeMap::from([(free.orders[order].clone(), value)]);
        // Some make no equation.
        let Ok(reduced) = free.structure.with_orders(&known).and_then(Free::of) else { continue };
        let rest = free.orders.iter().enumerate().filter(|(k, _)| *k != order).map(|(_, name)| name);
        if reduced.coefficients == free.coefficients && reduced.orders.iter().eq(rest) {
            out.push(Held { free: reduced, order, value });
        }
    }
    out
}

//! Problems with one term less, or known.

use std::collections::{BTreeMap, BTreeSet};

use crate::estimation::joint_fit::attempt::{Attempt, Place};
use crate::estimation::joint_fit::format::short;
use crate::estimation::joint_fit::order::Order;
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::runner::Runner;
use crate::estimation::joint_fit::structure::{Coefficient, Equation};
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

//! A problem with one of its orders known.

use std::collections::BTreeMap;

use crate::estimation::joint_fit::attempt::Place;
use crate::estimation::joint_fit::clock::Clock;
use crate::estimation::joint_fit::format::short;
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::runner::Runner;
use crate::estimation::output_error::Point;

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

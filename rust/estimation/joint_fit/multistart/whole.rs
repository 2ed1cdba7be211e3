//! A problem with whole orders.

use std::collections::BTreeMap;

use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::runner::Runner;

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

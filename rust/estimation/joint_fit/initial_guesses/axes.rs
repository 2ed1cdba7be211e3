//! Coarse lattices of free orders.

use std::collections::BTreeSet;

use crate::estimation::joint_fit::order::Order;
use crate::estimation::joint_fit::parameter_set::{Free, ALPHA_BOUNDS, SEARCHED_ORDER};
use crate::estimation::joint_fit::structure::Equation;

/// Step of the lattice on which starts are searched; a start within half of it leads to the optimum.
const START_STEP: f64 = 0.2;
/// Candidates of the start's lattice beyond which orders of other signals get fewer values.
const START_CANDIDATES: u128 = 200_000;
/// The lowest of the intervals that are usual for highest orders where nothing is known of them.
const LOWEST: f64 = 0.2;
/// Highest order that any term but the highest is started from.
const BELOW: f64 = 2.0;
/// Orders are kept to one in so many.
const GRAINS: f64 = 1e9;

/// Values of free orders, by name.
pub(super) type Axes = Vec<(String, Vec<f64>)>;

/// A coarse lattice of the free orders within their bounds.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn start_axes(free: &Free) -> Axes {
    let equations = &free.structure.equations;
    let alone = equations.iter().filter(|e| e.order.is_single());
    let highest: BTreeSet<&String> = alone.flat_map(|e| e.order.names()).collect();
    let usual = free.structure.hints.highest.unwrap_or((LOWEST, SEARCHED_ORDER));
    let axis = |(name, &bounds): (&String, &(f64, f64))| {
        let above = highest.contains(name);
        let (low, mut high) = if above && bounds == ALPHA_BOUNDS { usual } else { bounds };
        if !above {
            high = high.min(BELOW);
        }
        if high <= low {
            return (name.clone(), vec![low]);
        }
        let count = ((high - low) / START_STEP).round_ties_even() as usize;
        let tidied = |v: &f64| (v * GRAINS).round_ties_even() / GRAINS;
        let values = between(low, high, count + 1).iter().map(tidied).collect();
        (name.clone(), values)
    };
    let mut axes: Axes = free.orders.iter().zip(free.bounds()).map(axis).collect();
    // Orders at which other signals enter matter less for where the optimum is than the output's own.
    let driving: BTreeSet<&String> = equations
        .iter()
        .flat_map(|e| e.driving().flat_map(|term| term.order.names()))
        .filter(|name| !highest.contains(name))
        .collect();
    for kept in [&[0.0, 1.0][..], &[0.0]] {
        if equations.iter().all(|e| size(e, &axes) <= START_CANDIDATES) {
            break;
        }
        for (_, values) in axes.iter_mut().filter(|(name, _)| driving.contains(name)) {
            let (low, high) = (values[0], values[values.len() - 1]);
            let inside: Vec<f64> = kept.iter().copied().filter(|v| low <= *v && *v <= high).collect();
            *values = if inside.is_empty() { vec![low] } else { inside };
        }
    }
    axes
}

/// A small lattice beside the whole orders of a structure's physics, or none where it knows of none.
pub(super) fn natural_axes(free: &Free) -> Option<Axes> {
    let natural = &free.structure.hints.natural;
    let axis = |(name, &(low, high)): (&String, &(f64, f64))| {
        let values: Vec<f64> =
            natural.get(name).into_iter().flatten().copied().filter(|v| low <= *v && *v <= high).collect();
        (!values.is_empty()).then(|| (name.clone(), values))
    };
    let axes = free.orders.iter().zip(free.bounds()).map(axis).collect::<Option<Axes>>()?;
    (!natural.is_empty()).then_some(axes)
}

/// Evenly spaced values from one to another, both ends as they are.
#[allow(clippy::cast_precision_loss)]
pub(super) fn between(low: f64, high: f64, count: usize) -> Vec<f64> {
    let intervals = count.saturating_sub(1);
    let step = (high - low) / intervals.max(1) as f64;
    let value = |k: usize| if k == intervals && k > 0 { high } else { k as f64 * step + low };
    (0..count).map(value).collect()
}

/// The values of an order; none where it is not among them.
pub(super) fn values<'a>(axes: &'a Axes, name: &str) -> &'a [f64] {
    axes.iter().find(|(n, _)| n == name).map_or(&[], |(_, values)| values)
}

/// Candidates of an equation's lattice, whether they make an equation or not.
fn size(equation: &Equation, axes: &Axes) -> u128 {
    let names: BTreeSet<&String> = equation.orders().flat_map(Order::names).collect();
    names.iter().fold(1, |size, name| size.saturating_mul(values(axes, name).len() as u128))
}

#[cfg(test)]
mod tests {
    use super::{between, start_axes, values};
    use crate::equation::Initial;
    use crate::error::Result;
    use crate::estimation::joint_fit::order::Order;
    use crate::estimation::joint_fit::parameter_set::Free;
    use crate::estimation::joint_fit::structure::{Coefficient, Equation, Hints, Structure, Term};

    #[test]
    fn orders_lie_on_a_coarse_lattice_within_their_bounds() -> Result<()> {
        let term = |signal, order| {
            let coefficient = Coefficient::Free(format!("c_{order}"));
            Term { signal, order: Order::free(order), coefficient, factor: 1.0 }
        };
        let terms = vec![term(0, "nu"), term(1, "beta")];
        let equations = vec![Equation { output: 0, order: Order::free("alpha"), terms, friction: None }];
        let structure = Structure {
            signals: vec!["y".into(), "u".into()],
            equations,
            bounds: [("beta".into(), (0.5, 0.5))].into(),
            coupled: false,
            delayed: false,
            initial: Initial::Rest,
            history: false,
            inputs: Vec::new(),
            laws: Vec::new(),
            hints: Hints::default(),
        };
        let axes = start_axes(&Free::of(structure)?);
        let alphas = values(&axes, "alpha");
        assert_eq!((alphas.len(), alphas[0], alphas[1], alphas[14]), (15, 0.2, 0.4, 3.0));
        assert_eq!((values(&axes, "nu").len(), values(&axes, "nu")[10]), (11, 2.0));
        assert_eq!(values(&axes, "beta"), [0.5]);
        assert_eq!(between(1.0, 2.0, 1), [1.0]);
        Ok(())
    }
}

//! Submodels of a structure: without one term, with one fixed order, or with integer orders.

use std::collections::BTreeMap;

use crate::estimation::joint_fit::format::format_general;
use crate::estimation::joint_fit::parameter_set::{ParameterSet, TimeScaling};
use crate::estimation::joint_fit::problem::{Candidate, Iterate, OptimizationResult};
use crate::estimation::joint_fit::structure::{Coefficient, Order, ParametricEquation};
use crate::estimation::output_error::ParameterPoint;

/// Submodel with one term removed, or with one coefficient fixed.
#[derive(Debug, Clone, PartialEq)]
pub struct ReducedProblem {
    /// Remaining free parameters.
    pub parameter_set: ParameterSet,
    coefficient: String,
    order: Order,
    value: f64,
    /// True if the coefficient is fixed, so that all signals remain in the equation. False if the term is removed.
    pub keeps_signals: bool,
}

impl ReducedProblem {
    /// Restrict a candidate of the full problem, which has the parameter set `full_set`, to this submodel.
    #[must_use]
    pub fn restrict(&self, source: &Candidate, full_set: &ParameterSet) -> Candidate {
        let ParameterPoint { orders, coefficients, inputs } = &source.result.iterate.point;
        let order_value = |name: &String| full_set.orders.iter().position(|o| o == name).map(|index| orders[index]);
        let coefficient_value =
            |name: &String| full_set.coefficients.iter().position(|c| c == name).map(|index| coefficients[index]);
        let point = ParameterPoint {
            orders: self.parameter_set.orders.iter().filter_map(order_value).collect(),
            coefficients: self.parameter_set.coefficients.iter().filter_map(coefficient_value).collect(),
            inputs: inputs.clone(),
        };
        Candidate::at(Iterate { point, states: Vec::new() }, source.origin.clone())
    }

    /// Embed a candidate of this submodel in the full problem, which has the parameter set `full_set`.
    ///
    /// The free order of a removed term is set to half of the highest order of its equation.
    #[must_use]
    pub fn embed(&self, source: &Candidate, full_set: &ParameterSet) -> Candidate {
        let ParameterPoint { orders, coefficients, inputs } = &source.result.iterate.point;
        let values_by_name: BTreeMap<&String, f64> =
            self.parameter_set.orders.iter().zip(orders.iter().copied()).collect();
        let highest = self.order.at(|name| values_by_name.get(&name.to_owned()).copied().unwrap_or(0.0));
        let values: BTreeMap<&String, f64> =
            self.parameter_set.coefficients.iter().zip(coefficients.iter().copied()).collect();
        let point = ParameterPoint {
            orders: full_set
                .orders
                .iter()
                .map(|name| values_by_name.get(name).copied().unwrap_or(0.5 * highest))
                .collect(),
            coefficients: full_set.coefficients.iter().map(|n| values.get(n).copied().unwrap_or(self.value)).collect(),
            inputs: inputs.clone(),
        };
        let origin = format!("{}, from {} = {}", source.origin, self.coefficient, format_general(self.value, 6));
        let iterate = Iterate { point, states: source.result.iterate.states.clone() };
        Candidate {
            result: OptimizationResult { iterate, ..source.result.clone() },
            origin,
            duplicates: source.duplicates.clone(),
            cost_before: f64::INFINITY,
        }
    }
}

/// Return the submodels with one term removed or one coefficient fixed; empty if the structure has an order law or a
/// coefficient law.
///
/// One submodel per autoregressive term lacks this term, if its equation has several autoregressive terms. The
/// coefficient of an input term of fixed order is set to 0 if there are several input terms and the equations are not
/// coupled. The signals of one machine are correlated, so there can be optima in which one signal replaces the others.
/// For the same reason, there is one submodel per coefficient of known physical value, in which this coefficient is
/// fixed at that value.
#[must_use]
pub fn reduced_problems(parameter_set: &ParameterSet) -> Vec<ReducedProblem> {
    let structure = &parameter_set.structure;
    if structure.has_order_law() || !parameter_set.products.is_empty() {
        return Vec::new();
    }
    let mut out = Vec::new();
    let mut add_submodel = |submodel, name: &String, order: &Order, value, keeps_signals| {
        // Some submodels are no valid structure.
        if let Ok(parameter_set) = ParameterSet::from_structure(submodel) {
            out.push(ReducedProblem {
                parameter_set,
                coefficient: name.clone(),
                order: order.clone(),
                value,
                keeps_signals,
            });
        }
    };
    for (index, equation) in structure.equations.iter().enumerate() {
        let has_several_terms = equation.autoregressive_terms().count() > 1;
        for (k, term) in
            equation.terms.iter().enumerate().filter(|(_, term)| has_several_terms && term.signal == equation.output)
        {
            if let Coefficient::Free(name) = &term.coefficient {
                let mut terms = equation.terms.clone();
                terms.remove(k);
                let equation_without_term = ParametricEquation { terms, ..equation.clone() };
                add_submodel(structure.with_equation(index, equation_without_term), name, &equation.order, 0.0, false);
            }
        }
        let free_input_terms: Vec<_> =
            equation.input_terms().filter(|term| term.coefficient.name().is_some()).collect();
        for term in free_input_terms
            .iter()
            .filter(|term| !structure.coupled && free_input_terms.len() > 1 && !term.order.is_free())
        {
            if let Some(name) = term.coefficient.name() {
                // The term remains with coefficient 0, because the records contain its signal.
                let values_by_name = BTreeMap::from([(name.clone(), 0.0)]);
                add_submodel(structure.with_coefficients(&values_by_name), name, &equation.order, 0.0, true);
            }
        }
        for name in equation.coefficient_names() {
            if let Some(&value) = structure.hints.physical_values.get(name) {
                let values_by_name = BTreeMap::from([(name.clone(), value)]);
                add_submodel(structure.with_coefficients(&values_by_name), name, &equation.order, value, true);
            }
        }
    }
    out
}

/// Integer values of a free order that are tried by default.
const DEFAULT_INTEGER_ORDERS: [f64; 4] = [0.0, 1.0, 2.0, 3.0];
/// Maximum number of combinations of integer orders that are tried.
const MAX_INTEGER_ORDER_PROBLEMS: usize = 12;

/// Submodel with every free order fixed at an integer value.
#[derive(Debug, Clone, PartialEq)]
pub struct IntegerOrderProblem {
    /// Remaining free parameters.
    pub parameter_set: ParameterSet,
    /// Integer values of the free orders of the full problem.
    pub orders: Vec<f64>,
}

impl IntegerOrderProblem {
    /// Embed a candidate of this problem in the full problem.
    #[must_use]
    pub fn embed(&self, source: &Candidate) -> Candidate {
        let mut candidate = source.clone();
        candidate.result.iterate.point.orders.clone_from(&self.orders);
        candidate.origin = format!("{}, from integer orders", source.origin);
        candidate
    }
}

/// Return submodels with integer orders: [`ParameterSet::integer_orders`], the integers nearest to `reference_orders`,
/// and all variants of these two sets in which one order has another integer value.
///
/// An input coefficient may have opposite signs at two integer orders, and an optimization cannot pass through zero
/// between them. The nearest integer orders therefore need not be the best. Combinations without a valid equation are
/// omitted.
#[must_use]
#[allow(clippy::float_cmp)]
pub fn integer_order_problems(parameter_set: &ParameterSet, reference_orders: &[f64]) -> Vec<IntegerOrderProblem> {
    let typical_values = &parameter_set.structure.hints.typical_orders;
    let values: Vec<Vec<f64>> = (parameter_set.orders.iter().zip(parameter_set.bounds()))
        .map(|(name, &(low, high))| {
            let integers: Vec<f64> =
                typical_values.get(name).into_iter().flatten().copied().filter(|v| *v == v.round()).collect();
            let integers = if integers.is_empty() { DEFAULT_INTEGER_ORDERS.to_vec() } else { integers };
            integers.into_iter().filter(|v| (low..=high).contains(v)).collect()
        })
        .collect();
    if values.is_empty() || values.iter().any(Vec::is_empty) {
        return Vec::new();
    }
    let mut points: Vec<Vec<f64>> = Vec::new();
    let mut add_point = |point: Vec<f64>| {
        if !points.contains(&point) {
            points.push(point);
        }
    };
    for point in [parameter_set.integer_orders().as_slice(), reference_orders] {
        let nearest_orders: Vec<f64> =
            values.iter().zip(point).map(|(v, reference)| nearest_value(v, *reference)).collect();
        add_point(nearest_orders.clone());
        for (k, choices) in values.iter().enumerate() {
            for &other_value in choices.iter().filter(|v| **v != nearest_orders[k]) {
                let mut neighbor = nearest_orders.clone();
                neighbor[k] = other_value;
                add_point(neighbor);
            }
        }
    }
    points
        .into_iter()
        .filter_map(|orders| integer_order_problem(parameter_set, orders))
        .take(MAX_INTEGER_ORDER_PROBLEMS)
        .collect()
}

fn nearest_value(values: &[f64], target: f64) -> f64 {
    values
        .iter()
        .copied()
        .reduce(|nearest, v| if (v - target).abs() < (nearest - target).abs() { v } else { nearest })
        .unwrap_or(target)
}

/// Return the submodel at given integer orders; None if they give no valid equation.
fn integer_order_problem(parameter_set: &ParameterSet, orders: Vec<f64>) -> Option<IntegerOrderProblem> {
    let values_by_name: BTreeMap<String, f64> =
        parameter_set.orders.iter().cloned().zip(orders.iter().copied()).collect();
    let submodel = parameter_set.structure.with_orders(&values_by_name).and_then(ParameterSet::from_structure).ok()?;
    // The sequence of the terms is unchanged, so the coefficients keep their indices.
    (submodel.coefficients == parameter_set.coefficients)
        .then_some(IntegerOrderProblem { parameter_set: submodel, orders })
}

/// Submodel with one free order fixed at an integer value.
#[derive(Debug, Clone, PartialEq)]
pub struct FixedOrderProblem {
    /// Remaining free parameters.
    pub parameter_set: ParameterSet,
    /// Index of the fixed order among the free orders of the full problem.
    pub order: usize,
    /// Value at which the order is fixed.
    pub value: f64,
}

impl FixedOrderProblem {
    /// Restrict a candidate of the full problem to this submodel. The coefficients in scaled time are unchanged.
    #[must_use]
    pub fn restrict(&self, source: &Candidate, time_scaling: &TimeScaling) -> Candidate {
        let mut scaled_values = time_scaling.to_scaled(&source.result.values());
        scaled_values[self.order] = self.value;
        let mut values = time_scaling.to_unscaled(&scaled_values);
        values.remove(self.order);
        let (orders, rest) = values.split_at(self.parameter_set.orders.len());
        let (coefficients, inputs) = rest.split_at(self.parameter_set.coefficients.len());
        let point = ParameterPoint { orders: orders.into(), coefficients: coefficients.into(), inputs: inputs.into() };
        Candidate::at(Iterate { point, states: Vec::new() }, source.origin.clone())
    }

    /// Embed a candidate of this submodel in the full problem, which has the parameter set `full_set`.
    #[must_use]
    pub fn embed(&self, source: &Candidate, full_set: &ParameterSet) -> Candidate {
        let mut candidate = source.clone();
        candidate.result.iterate.point.orders.insert(self.order, self.value);
        candidate.origin =
            format!("{}, from {} = {}", source.origin, full_set.orders[self.order], format_general(self.value, 6));
        candidate
    }
}

/// Return the submodels with one order fixed at an integer, if there are several free orders.
///
/// The optima of the submodels become candidates of the full problem, so that no submodel fits better than the full
/// problem.
#[must_use]
#[allow(clippy::float_cmp)]
pub fn fixed_order_problems(parameter_set: &ParameterSet) -> Vec<FixedOrderProblem> {
    let mut out = Vec::new();
    for (order, value) in parameter_set.integer_orders().into_iter().enumerate() {
        if parameter_set.orders.len() < 2 || value != value.round() {
            continue;
        }
        let values_by_name = BTreeMap::from([(parameter_set.orders[order].clone(), value)]);
        // Some submodels are no valid structure.
        let Ok(submodel) = parameter_set.structure.with_orders(&values_by_name).and_then(ParameterSet::from_structure)
        else {
            continue;
        };
        let other_orders = parameter_set.orders.iter().enumerate().filter(|(k, _)| *k != order).map(|(_, name)| name);
        if submodel.coefficients == parameter_set.coefficients && submodel.orders.iter().eq(other_orders) {
            out.push(FixedOrderProblem { parameter_set: submodel, order, value });
        }
    }
    out
}

//! Coarse order grids, and least-squares coefficients at their best points.

use std::collections::{BTreeMap, BTreeSet};

use crate::equation::Initial;
use crate::error::{Error, Result};
use crate::estimation::joint_fit::format::format_general;
use crate::estimation::joint_fit::parameter_set::{ParameterSet, ALPHA_BOUNDS, SEARCHED_ORDER};
use crate::estimation::joint_fit::problem::{Candidate, Iterate};
use crate::estimation::joint_fit::structure::{Law, Order, ParametricEquation, ParametricStructure, ParametricTerm};
use crate::estimation::output_error::ParameterPoint;
use crate::order_search::batches;
use crate::order_search::control::Control;
use crate::order_search::grid::{LawEquation, OrderGrid, OrderLawGrid, TermAxis};
use crate::order_search::options::Options;
use crate::order_search::stage_join;
use crate::parallel::Stop;
use crate::regressors::Record;
use crate::signal::statistics::mean;

/// Result of an order grid at one point: orders and unconstrained coefficient estimates, by name.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct GridRow {
    /// Orders by name, in the sequence of the axes.
    pub orders: Vec<(String, f64)>,
    /// Coefficients by name.
    pub coefficients: BTreeMap<String, f64>,
}

impl GridRow {
    /// Return the orders with the given names; NaN for a name without an order.
    pub(super) fn values(&self, names: &[String]) -> Vec<f64> {
        let value = |name: &String| self.orders.iter().find(|(n, _)| n == name).map_or(f64::NAN, |(_, value)| *value);
        names.iter().map(value).collect()
    }

    /// Merge the orders and coefficients of another row into this one. Values of the other row take precedence.
    fn merge(&mut self, other: &Self) {
        for (name, value) in &other.orders {
            match self.orders.iter_mut().find(|(n, _)| n == name) {
                Some((_, value_of_row)) => *value_of_row = *value,
                None => self.orders.push((name.clone(), *value)),
            }
        }
        self.coefficients.extend(other.coefficients.iter().map(|(name, value)| (name.clone(), *value)));
    }
}

/// Settings of the least-squares search of coarse order grids.
#[derive(Clone, Copy)]
pub(super) struct GridSearch<'a> {
    /// Block-pulse records that are fitted.
    pub records: &'a [Record],
    /// One flag per signal; true if it is an input.
    pub inputs: &'a [bool],
    /// Initial terms of each record.
    pub initial: &'a Initial,
    /// Number of threads.
    pub threads: usize,
    /// Memory budget in bytes.
    pub memory: u64,
    /// Cancellation flag.
    pub stop: &'a Stop,
}

impl GridSearch<'_> {
    /// Return the same search on other records.
    pub(super) fn with_records<'b>(&'b self, records: &'b [Record]) -> GridSearch<'b> {
        GridSearch { records, ..*self }
    }

    /// Return the best rows of a coarse order grid by least squares, at most `top`.
    pub(super) fn best_rows(&self, structure: &ParametricStructure, axes: &Axes, top: usize) -> Result<Vec<GridRow>> {
        if !structure.has_order_law() {
            let tables: Result<Vec<_>> =
                structure.equations.iter().map(|e| self.search_equation(structure, e, axes, top)).collect();
            return Ok(merge_tables(&tables?, structure));
        }
        let stages = independent_groups(structure);
        if stages.len() <= 1 {
            return self.search_coupled(structure, axes, top);
        }
        // Groups of equations without common orders are searched separately; their best rows are combined.
        let table = |stage: &ParametricStructure| {
            let names = stage.order_names();
            let stage_axes: Axes = axes.iter().filter(|(name, _)| names.contains(name)).cloned().collect();
            self.best_rows(stage, &stage_axes, top)
        };
        Ok(merge_tables(&stages.iter().map(table).collect::<Result<Vec<_>>>()?, structure))
    }

    fn options(&self, top: usize) -> Options {
        let (initial, threads, memory) = (self.initial.clone(), self.threads, self.memory);
        Options { initial, top, threads, memory, ..Options::default() }
    }

    fn control(&self) -> Control {
        Control { stop: self.stop.clone(), ..Control::default() }
    }

    /// Return the best rows of coupled equations with an order law, at most `top`.
    #[allow(clippy::cast_precision_loss)]
    fn search_coupled(&self, structure: &ParametricStructure, axes: &Axes, top: usize) -> Result<Vec<GridRow>> {
        let (names, axis_values_of_orders): (Vec<String>, Vec<Vec<f64>>) = axes.iter().cloned().unzip();
        let law = |e: &ParametricEquation| LawEquation {
            output: e.output,
            order: e.order.affine(&names),
            terms: e.terms.iter().map(|t| (t.signal, t.order.affine(&names))).collect(),
        };
        let equations = &structure.equations;
        let laws: Vec<LawEquation> = equations.iter().map(law).collect();
        let fixed: Vec<Vec<Option<f64>>> = equations.iter().map(fixed_coefficients).collect();
        let output_sum = |e: &ParametricEquation| {
            self.records.iter().map(|r| standard_deviation(r.signal(e.output)) * r.m() as f64).sum()
        };
        let scales: Vec<f64> = equations.iter().map(output_sum).collect();
        let grid = OrderLawGrid::new(&axis_values_of_orders, &laws, self.inputs)?.with_fixed_coefficients(&fixed);
        let result = stage_join::search(self.records, &grid, &fixed, &scales, &self.options(top), &self.control())?;
        let row = |result: stage_join::StageRow| {
            let pairs = equations.iter().zip(&result.rows);
            let coefficients = pairs
                .flat_map(|(equation, equation_row)| named_coefficients(equation, &equation_row.coefficients))
                .collect();
            GridRow { orders: names.iter().cloned().zip(result.free).collect(), coefficients }
        };
        Ok(result.rows.into_iter().map(row).collect())
    }

    /// Return the best rows of one equation with independent free orders, at most `top`.
    fn search_equation(
        &self,
        structure: &ParametricStructure,
        equation: &ParametricEquation,
        axes: &Axes,
        top: usize,
    ) -> Result<Vec<GridRow>> {
        check_linear(structure, equation, "an order search")?;
        let axis = |order: &Order| match order.names().next() {
            Some(name) => axis_values(axes, name).to_vec(),
            None => vec![order.constant],
        };
        let term = |t: &ParametricTerm| TermAxis {
            signal: t.signal,
            values: axis(&t.order),
            interchangeable: t.order.is_free() && t.fixed_coefficient().is_none(),
        };
        let terms: Vec<TermAxis> = equation.terms.iter().map(term).collect();
        let is_input = |signal: usize| self.inputs.get(signal).copied().unwrap_or(false);
        let with_signal_names = |error| name_signals(error, &structure.signals);
        let grid =
            OrderGrid::new(equation.output, &axis(&equation.order), &terms, is_input).map_err(with_signal_names)?;
        let (options, control) = (self.options(top), self.control());
        let result = batches::search(self.records, &grid, &fixed_coefficients(equation), &options, &control)
            .map_err(with_signal_names)?;
        let row = |result: crate::order_search::result::Row| {
            let structure_of_row = grid.structure(result.index);
            let term_orders =
                std::iter::once(structure_of_row.order).chain(structure_of_row.terms.iter().map(|term| term.order));
            let pairs = equation.orders().zip(term_orders);
            let orders = pairs.filter_map(|(order, value)| Some((order.names().next()?.clone(), value))).collect();
            GridRow { orders, coefficients: named_coefficients(equation, &result.coefficients).collect() }
        };
        Ok(result.rows.into_iter().map(row).collect())
    }
}

/// Merge the rows of the same rank (index) from independent tables into one row. A shorter table repeats its last row.
///
/// Merged rows that lack a coefficient are omitted.
pub(super) fn merge_tables(tables: &[Vec<GridRow>], structure: &ParametricStructure) -> Vec<GridRow> {
    let count = structure.coefficient_names().len();
    let merge_rank = |rank: usize| {
        let mut row = GridRow::default();
        tables.iter().filter_map(|table| table.get(rank).or(table.last())).for_each(|table_row| row.merge(table_row));
        row
    };
    let ranks = tables.iter().map(Vec::len).max().unwrap_or(0);
    (0..ranks).map(merge_rank).filter(|row| row.coefficients.len() == count).collect()
}

/// Return the free coefficients by name, from the products of factor and coefficient of all terms.
pub(super) fn named_coefficients<'a>(
    equation: &'a ParametricEquation,
    products: &'a [f64],
) -> impl Iterator<Item = (String, f64)> + 'a {
    let pairs = equation.terms.iter().zip(products);
    pairs.filter_map(|(term, c)| Some((term.coefficient.name()?.clone(), c / term.factor)))
}

/// Return the product of factor and coefficient of each term; None if the coefficient is free.
pub(super) fn fixed_coefficients(equation: &ParametricEquation) -> Vec<Option<f64>> {
    equation.terms.iter().map(ParametricTerm::fixed_coefficient).collect()
}

/// Return [`Error::Structure`] if an equation has friction, which the method `what` does not support.
pub(super) fn check_linear(structure: &ParametricStructure, equation: &ParametricEquation, what: &str) -> Result<()> {
    if equation.friction.is_none() {
        return Ok(());
    }
    let output = &structure.signals[equation.output];
    Err(Error::Structure {
        what: format!("the equation of {output} has friction, which {what} does not support"),
        remedy: "rank by the output error, or remove the friction".into(),
    })
}

/// Replace signal numbers by signal names in an error message.
fn name_signals(error: Error, signals: &[String]) -> Error {
    let with_signal_names = |mut text: String| {
        // In descending order, because the text of a number may be a prefix of a larger number.
        for (i, signal) in signals.iter().enumerate().rev() {
            text = text.replace(&format!("signal {i}"), &format!("signal '{signal}'"));
        }
        text
    };
    match error {
        Error::EmptyOrderGrid { reason } => Error::EmptyOrderGrid { reason: with_signal_names(reason) },
        Error::Structure { what, remedy } => Error::Structure { what: with_signal_names(what), remedy },
        other => other,
    }
}

/// Standard deviation of values.
fn standard_deviation(values: &[f64]) -> f64 {
    let centre = mean(values);
    let squares: Vec<f64> = values.iter().map(|v| (v - centre) * (v - centre)).collect();
    mean(&squares).sqrt()
}

/// Number of best rows of an order grid whose coefficients are computed by a coefficient law.
const ROWS_BY_LAW: usize = 4;
/// Maximum number of initial guesses from one order grid under an order law.
const MAX_GUESSES_UNDER_ORDER_LAW: usize = 8;
/// Number of best rows of an order grid from which the initial guesses under an order law are chosen.
const ROWS_UNDER_ORDER_LAW: usize = 4000;
/// Minimum difference in at least one order between two initial guesses; larger than one increment of the grid.
const MIN_ORDER_SEPARATION: f64 = 0.35;
/// Trial values of all factors of a coefficient law except the first.
///
/// A coefficient law states that a coefficient is a product of factors. The first factor is a coefficient of another
/// equation. It follows from the law if the coefficient and the other factors are given.
const LAW_RATIOS: [f64; 3] = [0.25, 1.0, 4.0];
/// Absolute and relative difference below which two orders count as equal.
const ORDER_TOLERANCES: (f64, f64) = (1e-9, 1e-5);

/// Candidate at the given orders and coefficients, without input parameters.
pub(super) fn new_candidate(orders: Vec<f64>, coefficients: Vec<f64>, origin: &str) -> Candidate {
    Candidate::at(
        Iterate { point: ParameterPoint { orders, coefficients, inputs: Vec::new() }, states: Vec::new() },
        origin,
    )
}

/// Return initial guesses from the best rows of an order grid.
///
/// Without an order law, the only guess is the best row. Under an order law the equation error has several minima, so
/// several rows are returned. Each row differs from every better one by [`MIN_ORDER_SEPARATION`] in at least one order.
/// A row with the orders of a guess in `previous_guesses` is omitted, but counts toward the maximum number.
pub(super) fn grid_candidates(
    parameter_set: &ParameterSet,
    coarse: &GridSearch<'_>,
    axes: &Axes,
    origin: &str,
    previous_guesses: &[Candidate],
) -> Result<Vec<Candidate>> {
    let (max_guesses, row_count) = if parameter_set.structure.has_order_law() {
        (MAX_GUESSES_UNDER_ORDER_LAW, ROWS_UNDER_ORDER_LAW)
    } else {
        (1, 1)
    };
    let mut candidates: Vec<Candidate> = Vec::new();
    let mut selected: Vec<Vec<f64>> = Vec::new();
    for row in coarse.best_rows(&parameter_set.structure, axes, row_count)? {
        let values = row.values(&parameter_set.orders);
        let differs = |guess_values: &Vec<f64>| {
            values.iter().zip(guess_values).any(|(a, b)| (a - b).abs() >= MIN_ORDER_SEPARATION)
        };
        if !selected.iter().all(differs) {
            continue;
        }
        if !previous_guesses.iter().any(|guess| are_orders_close(&values, &guess.result.iterate.point.orders)) {
            candidates.push(new_candidate(values.clone(), parameter_set.free_coefficients(&row.coefficients), origin));
        }
        selected.push(values);
        if selected.len() == max_guesses {
            break;
        }
    }
    Ok(candidates)
}

fn are_orders_close(first: &[f64], second: &[f64]) -> bool {
    first.iter().zip(second).all(|(a, b)| (a - b).abs() <= ORDER_TOLERANCES.0 + ORDER_TOLERANCES.1 * b.abs())
}

/// Return candidates in which coefficients of one equation follow from those of another equation by a coefficient law.
///
/// The other coefficients are estimated by least squares. The law is needed if unconstrained estimates have the wrong
/// sign. An example is the motor hub of a flexible arm, which is overdamped. Current and friction nearly cancel, and
/// the link equation explains the rest of the acceleration equally well. An unconstrained estimate of the hub equation
/// then converges to the link equation with the sign of the stiffness reversed.
pub(super) fn law_candidates(
    parameter_set: &ParameterSet,
    coarse: &GridSearch<'_>,
    axes: &Axes,
    origin: &str,
) -> Result<Vec<Candidate>> {
    let (structure, signs) = (&parameter_set.structure, &parameter_set.structure.hints.positive);
    let sign_laws: Vec<(&Law, &String, usize)> = (parameter_set.products.iter())
        .filter_map(|law| law.factors.split_first().map(|(first, others)| (law, first, others.len())))
        .filter(|(_, first, _)| signs.contains(*first))
        .collect();
    if sign_laws.is_empty() {
        return Ok(Vec::new());
    }
    let with_signal_names = structure.coefficient_names();
    let mut candidates = Vec::new();
    for row in coarse.best_rows(structure, axes, ROWS_BY_LAW)? {
        let point: Axes = row.orders.iter().map(|(name, value)| (name.clone(), vec![*value])).collect();
        for ratio in LAW_RATIOS {
            let value = |(law, first, others): &(&Law, &String, usize)| {
                let magnitude = row.coefficients.get(&law.name).copied().unwrap_or(f64::NAN).abs();
                ((*first).clone(), (0..*others).fold(magnitude, |magnitude, _| magnitude / ratio))
            };
            let values_by_name: BTreeMap<String, f64> = sign_laws.iter().map(value).collect();
            if !values_by_name.values().all(|v| v.is_finite() && *v != 0.0) {
                continue;
            }
            if let Some(missing_name) = values_by_name.keys().find(|name| !with_signal_names.contains(name)) {
                let what = format!("coefficient {missing_name} is not a free coefficient");
                return Err(Error::Structure {
                    what,
                    remedy: "use the name of a free coefficient of the equations".into(),
                });
            }
            for other_row in coarse.best_rows(&structure.with_coefficients(&values_by_name), &point, 1)? {
                let value_of = |name: &String| {
                    values_by_name.get(name).or(other_row.coefficients.get(name)).copied().unwrap_or(ratio)
                };
                let coefficients = parameter_set.coefficients.iter().map(value_of).collect();
                let guess_origin = format!(
                    "{origin}, by the coefficient law with its free parameters at {}",
                    format_general(ratio, 6)
                );
                candidates.push(new_candidate(row.values(&parameter_set.orders), coefficients, &guess_origin));
            }
        }
    }
    Ok(candidates)
}

/// Increment of the orders in the grid of initial guesses. A fit that starts within half an increment converges.
const START_INCREMENT: f64 = 0.2;
/// Maximum number of grid points of an equation. If there are more, the orders of the input terms get fewer grid
/// values.
const MAX_START_CANDIDATES: u128 = 200_000;
/// Lowest grid value of the highest order of an equation, if there is no prior knowledge of this order.
const MIN_TYPICAL_ORDER: f64 = 0.2;
/// Maximum initial guess of an order other than the highest order of an equation.
const MAX_LOWER_TERM_ORDER: f64 = 2.0;
/// Number of rounding steps per unit of order. Grid values are rounded to a whole number of these steps.
const ROUNDING_STEPS_PER_ORDER: f64 = 1e9;

/// Grid values of the free orders, by name.
pub(super) type Axes = Vec<(String, Vec<f64>)>;

/// Return the coarse grid of the free orders within their bounds.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn start_axes(parameter_set: &ParameterSet) -> Axes {
    let equations = &parameter_set.structure.equations;
    let with_single_order = equations.iter().filter(|e| e.order.is_single());
    let highest: BTreeSet<&String> = with_single_order.flat_map(|e| e.order.names()).collect();
    let typical_range = parameter_set.structure.hints.highest.unwrap_or((MIN_TYPICAL_ORDER, SEARCHED_ORDER));
    let axis = |(name, &bounds): (&String, &(f64, f64))| {
        let is_highest = highest.contains(name);
        let (low, mut high) = if is_highest && bounds == ALPHA_BOUNDS { typical_range } else { bounds };
        if !is_highest {
            high = high.min(MAX_LOWER_TERM_ORDER);
        }
        if high <= low {
            return (name.clone(), vec![low]);
        }
        let count = ((high - low) / START_INCREMENT).round_ties_even() as usize;
        let round_value = |v: &f64| (v * ROUNDING_STEPS_PER_ORDER).round_ties_even() / ROUNDING_STEPS_PER_ORDER;
        let values = linspace(low, high, count + 1).iter().map(round_value).collect();
        (name.clone(), values)
    };
    let mut axes: Axes = parameter_set.orders.iter().zip(parameter_set.bounds()).map(axis).collect();
    // The orders of input terms affect the location of the optimum less than the autoregressive orders.
    let input_orders: BTreeSet<&String> = equations
        .iter()
        .flat_map(|e| e.input_terms().flat_map(|term| term.order.names()))
        .filter(|name| !highest.contains(name))
        .collect();
    for exponent_values in [&[0.0, 1.0][..], &[0.0]] {
        if equations.iter().all(|e| candidate_count(e, &axes) <= MAX_START_CANDIDATES) {
            break;
        }
        for (_, values) in axes.iter_mut().filter(|(name, _)| input_orders.contains(name)) {
            let (low, high) = (values[0], values[values.len() - 1]);
            let valid_values: Vec<f64> = exponent_values.iter().copied().filter(|v| low <= *v && *v <= high).collect();
            *values = if valid_values.is_empty() { vec![low] } else { valid_values };
        }
    }
    axes
}

/// Return a small grid of the typical orders of a structure; None if an order has no typical value.
pub(super) fn typical_order_axes(parameter_set: &ParameterSet) -> Option<Axes> {
    let typical_orders = &parameter_set.structure.hints.typical_orders;
    let axis = |(name, &(low, high)): (&String, &(f64, f64))| {
        let values: Vec<f64> =
            typical_orders.get(name).into_iter().flatten().copied().filter(|v| low <= *v && *v <= high).collect();
        (!values.is_empty()).then(|| (name.clone(), values))
    };
    let axes = parameter_set.orders.iter().zip(parameter_set.bounds()).map(axis).collect::<Option<Axes>>()?;
    (!typical_orders.is_empty()).then_some(axes)
}

/// Return `count` evenly spaced values including both exact ends.
#[allow(clippy::cast_precision_loss)]
pub(super) fn linspace(low: f64, high: f64, count: usize) -> Vec<f64> {
    let intervals = count.saturating_sub(1);
    let step = (high - low) / intervals.max(1) as f64;
    let value = |k: usize| if k == intervals && k > 0 { high } else { k as f64 * step + low };
    (0..count).map(value).collect()
}

/// Return the grid values of an order; empty if it is not in the grid.
pub(super) fn axis_values<'a>(axes: &'a Axes, name: &str) -> &'a [f64] {
    axes.iter().find(|(n, _)| n == name).map_or(&[], |(_, values)| values)
}

/// Number of grid points of an equation, including invalid ones.
fn candidate_count(equation: &ParametricEquation, axes: &Axes) -> u128 {
    let names: BTreeSet<&String> = equation.orders().flat_map(Order::names).collect();
    names.iter().fold(1, |size, name| size.saturating_mul(axis_values(axes, name).len() as u128))
}

/// Groups of equations that share no free order, so that an order search can treat them separately.
///
/// Equations with a common order law form one group. Equations without free orders are omitted.
pub(super) fn independent_groups(structure: &ParametricStructure) -> Vec<ParametricStructure> {
    let mut groups: Vec<(BTreeSet<&String>, Vec<&ParametricEquation>)> = Vec::new();
    for equation in &structure.equations {
        let own_names: BTreeSet<&String> = equation.orders().flat_map(Order::names).collect();
        let (mut names, mut group, mut separate_groups) = (own_names.clone(), vec![equation], Vec::new());
        for (group_names, equations) in groups {
            if own_names.is_disjoint(&group_names) {
                separate_groups.push((group_names, equations));
            } else {
                names.extend(group_names);
                group = [equations, group].concat();
            }
        }
        separate_groups.push((names, group));
        groups = separate_groups;
    }
    let groups_with_orders = groups.into_iter().filter(|(names, _)| !names.is_empty());
    let group_structure = |(_, equations): (_, Vec<&ParametricEquation>)| ParametricStructure {
        equations: equations.into_iter().cloned().collect(),
        laws: Vec::new(),
        ..structure.clone()
    };
    groups_with_orders.map(group_structure).collect()
}

#[cfg(test)]
mod tests {
    use super::{axis_values, linspace, start_axes};
    use crate::equation::Initial;
    use crate::error::Result;
    use crate::estimation::joint_fit::parameter_set::ParameterSet;
    use crate::estimation::joint_fit::structure::{
        Coefficient, Hints, Order, ParametricEquation, ParametricStructure, ParametricTerm,
    };

    #[test]
    fn order_grid_is_within_bounds() -> Result<()> {
        let term = |signal, order| {
            let coefficient = Coefficient::Free(format!("c_{order}"));
            ParametricTerm { signal, order: Order::free(order), coefficient, factor: 1.0 }
        };
        let terms = vec![term(0, "nu"), term(1, "beta")];
        let equations = vec![ParametricEquation { output: 0, order: Order::free("alpha"), terms, friction: None }];
        let structure = ParametricStructure {
            signals: vec!["y".into(), "u".into()],
            derived: Vec::new(),
            equations,
            bounds: [("beta".into(), (0.5, 0.5))].into(),
            priors: [].into(),
            coupled: false,
            delayed: false,
            initial: Initial::Rest,
            history: false,
            inputs: Vec::new(),
            laws: Vec::new(),
            hints: Hints::default(),
        };
        let axes = start_axes(&ParameterSet::from_structure(structure)?);
        let alphas = axis_values(&axes, "alpha");
        assert_eq!((alphas.len(), alphas[0], alphas[1], alphas[14]), (15, 0.2, 0.4, 3.0));
        assert_eq!((axis_values(&axes, "nu").len(), axis_values(&axes, "nu")[10]), (11, 2.0));
        assert_eq!(axis_values(&axes, "beta"), [0.5]);
        assert_eq!(linspace(1.0, 2.0, 1), [1.0]);
        Ok(())
    }
}

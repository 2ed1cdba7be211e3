//! Parameter set of a joint fit: free parameters with bounds, coordinates and time scaling.
//!
//! A coefficient of D^ν y in an equation for D^α y has the unit time^−(α − ν), which changes with the free orders.

use std::collections::BTreeMap;

use super::problem::{Iterate, Problem};
use super::structure::{unique, Coefficient, Input, Law, ParametricEquation, ParametricStructure};
use crate::equation::Initial;
use crate::error::Result;
use crate::estimation::optimization::prior::Prior;
use crate::estimation::output_error::parameterization::TimeUnit as Unit;
use crate::estimation::output_error::{Coordinate, FreeEquation, FreeModel, Monomial};
use crate::fractional::kernels::MAX_ORDER;
use crate::nonlinear::FreeFrictionLaw;
use crate::signal::statistics::median;

/// Default upper bound of free orders. It is higher if the structure contains a higher fixed order.
pub const SEARCHED_ORDER: f64 = 3.0;
/// Default bounds of the highest order of an equation.
pub const ALPHA_BOUNDS: (f64, f64) = (0.05, SEARCHED_ORDER);
/// Default bounds of the highest order of an equation with friction.
const FRICTION_BOUNDS: (f64, f64) = (1.001, 2.0);
/// Minimum difference between an estimated ratio and its lower bound.
///
/// A ratio is a factor of a coefficient law that is not itself a coefficient of the equations.
const MIN_RATIO_EXCESS: f64 = 0.05;
/// Maximum estimated ratio.
const MAX_RATIO: f64 = 20.0;
/// Difference between the initial guess of a ratio and its lower bound if no equation determines it.
const DEFAULT_RATIO_EXCESS: f64 = 0.5;

/// Free parameters of a structure, with bounds and coordinates.
///
/// Orders are affine functions of the free orders. Coefficients are products of free coefficients.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterSet {
    /// Structure to which the free parameters belong.
    pub structure: ParametricStructure,
    /// Names of the free orders.
    pub orders: Vec<String>,
    /// Names of the free coefficients, including the factors of coefficient laws.
    pub coefficients: Vec<String>,
    /// Coefficient laws: each determines one coefficient as a product of factors.
    pub products: Vec<Law>,
    /// Optimization problem over the free parameters.
    pub problem: Problem,
}

impl ParameterSet {
    /// Return the parameter set of a structure.
    ///
    /// # Errors
    /// An error if an equation, signal or order is invalid ([`ParametricStructure::check`]), or if bounds are crossed
    /// ([`Problem::new`]).
    pub fn from_structure(structure: ParametricStructure) -> Result<Self> {
        structure.check()?;
        let coefficient_names = structure.coefficient_names();
        let law = |name: &String| structure.laws.iter().rev().find(|law| law.name == *name).cloned();
        let products: Vec<Law> = coefficient_names.iter().filter_map(law).collect();
        let free_names = coefficient_names.iter().filter(|name| !products.iter().any(|law| law.name == **name));
        let factors = products.iter().flat_map(|law| &law.factors).filter(|factor| !coefficient_names.contains(factor));
        let coefficients = unique(free_names.chain(factors));
        let orders = structure.order_names();
        let bounds = bounds(&structure, &orders);
        let powers = |name: &String| -> (f64, Vec<(usize, i32)>) {
            let law = products.iter().find(|law| law.name == *name);
            let single_name = std::slice::from_ref(name);
            let (sign, factors) = law.map_or((1.0, single_name), |law| (law.sign, law.factors.as_slice()));
            let mut powers: Vec<(usize, i32)> = Vec::new();
            for index in factors.iter().filter_map(|factor| coefficients.iter().position(|c| c == factor)) {
                match powers.iter_mut().find(|(i, _)| *i == index) {
                    Some((_, n)) => *n += 1,
                    None => powers.push((index, 1)),
                }
            }
            (sign, powers)
        };
        let monomial = |coefficient: &Coefficient, factor: f64| match coefficient {
            Coefficient::Fixed(value) => Monomial { factor: factor * value, powers: Vec::new() },
            Coefficient::Free(name) => {
                let (sign, powers) = powers(name);
                Monomial { factor: factor * sign, powers }
            }
        };
        let equation = |e: &ParametricEquation| FreeEquation {
            output: e.output,
            order: e.order.affine(&orders),
            terms: (e.terms.iter())
                .map(|t| (t.signal, t.order.affine(&orders), monomial(&t.coefficient, t.factor)))
                .collect(),
        };
        let frictions = structure.equations.iter().enumerate().filter_map(|(equation, e)| {
            let [coulomb, stribeck, speed] = e.friction.as_ref()?.parameters().map(|(factor, c)| monomial(c, *factor));
            Some((equation, FreeFrictionLaw { coulomb, stribeck, speed }))
        });
        let inputs = structure.inputs.iter().map(|input| &input.name);
        let prior = |(parameter, name): (usize, &String)| {
            let (mean, deviation) = *structure.priors.get(name)?;
            Some(Prior { parameter, mean, deviation })
        };
        let model = FreeModel {
            priors: orders.iter().chain(&coefficients).chain(inputs).enumerate().filter_map(prior).collect(),
            equations: structure.equations.iter().map(equation).collect(),
            order_bounds: bounds,
            coordinates: vec![Coordinate::Plain; coefficients.len()],
            inputs: structure.inputs.iter().map(|input| input.parameter).collect(),
            coupled: structure.coupled,
            initial: structure.initial.clone(),
        };
        let outputs = structure.equations.iter().map(|e| structure.signals[e.output].clone()).collect();
        let problem = Problem::new(outputs, model, frictions.collect())?.with_derived(structure.derived.clone());
        Ok(Self { orders, coefficients, products, problem, structure })
    }

    /// Lower and upper bound of each free order.
    #[must_use]
    pub fn bounds(&self) -> &[(f64, f64)] {
        &self.problem.model.order_bounds
    }

    /// Return true if an equation has friction.
    #[must_use]
    pub fn has_friction(&self) -> bool {
        !self.problem.frictions.is_empty()
    }

    /// Names of all free parameters: orders, coefficients, then input parameters.
    pub fn names(&self) -> impl Iterator<Item = &String> {
        let inputs = self.structure.inputs.iter().map(|Input { name, .. }| name);
        self.orders.iter().chain(&self.coefficients).chain(inputs)
    }

    /// Return the problem with coordinates for an optimization from `start`.
    ///
    /// The coordinate of a nonzero coefficient is its logarithm. With nonlinear terms or `plain`, it is the coefficient
    /// itself, because initial guesses may have wrong signs. The coordinate of a Stribeck velocity is always its
    /// logarithm. The parameters with the indices `fixed` are fixed at their values in `start`.
    #[must_use]
    pub fn problem_at(&self, start: &Iterate, plain: bool, fixed: &[usize]) -> Problem {
        let mut problem = self.problem.clone();
        let coefficient_names = self.structure.coefficient_names();
        let plain = plain || !problem.derived.is_empty();
        for (j, (name, &value)) in self.coefficients.iter().zip(&start.point.coefficients).enumerate() {
            let is_speed = problem.frictions.iter().any(|(_, law)| law.speed.powers.iter().any(|&(i, _)| i == j));
            let is_ratio = !coefficient_names.contains(name) && self.ratio_lower_bound(name) == 1.0;
            problem.model.coordinates[j] = match () {
                // The Stribeck velocity is always positive.
                () if (plain || value == 0.0) && !is_speed => Coordinate::Plain,
                () if is_ratio && value > 1.0 => Coordinate::ExcessLogarithm,
                () => Coordinate::Logarithm,
            };
        }
        let (orders, coefficients) = (self.orders.len(), self.coefficients.len());
        for &parameter in fixed {
            match parameter.checked_sub(orders) {
                None => {
                    problem.model.order_bounds[parameter] =
                        (start.point.orders[parameter], start.point.orders[parameter])
                }
                Some(j) if j < coefficients => problem.model.coordinates[j] = Coordinate::Fixed,
                Some(j) => {
                    let value = start.point.inputs[j - coefficients];
                    problem.model.inputs[j - coefficients].bounds = (value, value);
                }
            }
        }
        problem
    }

    /// Return all coefficients of the structure by name, from the values of the free coefficients.
    #[must_use]
    pub fn coefficients_by_name(&self, values: &[f64]) -> BTreeMap<String, f64> {
        let values_by_name: BTreeMap<&String, f64> = self.coefficients.iter().zip(values.iter().copied()).collect();
        let coefficient_value = |name: &String| values_by_name.get(name).copied().unwrap_or(f64::NAN);
        let named_value = |name: String| {
            let law = self.products.iter().find(|law| law.name == name);
            let value = law.map_or_else(
                || coefficient_value(&name),
                |law| law.sign * law.factors.iter().map(coefficient_value).product::<f64>(),
            );
            (name, value)
        };
        self.structure.coefficient_names().into_iter().map(named_value).collect()
    }

    /// Return the values of the free coefficients, given unconstrained estimates of coefficients by name.
    ///
    /// A ratio without an estimate is the median of its values from all coefficient laws that contain it.
    #[must_use]
    pub fn free_coefficients(&self, estimated: &BTreeMap<String, f64>) -> Vec<f64> {
        let value_or_ratio = |name: &String| {
            if let Some(&value) = estimated.get(name) {
                return value;
            }
            let lower_bound = self.ratio_lower_bound(name);
            let ratios = self.products.iter().filter(|law| law.factors.contains(name)).filter_map(|law| {
                let other_factors = law.factors.iter().filter(|factor| *factor != name);
                let product: f64 = other_factors.filter_map(|factor| estimated.get(factor)).product();
                (product != 0.0).then(|| law.sign * estimated.get(&law.name).copied().unwrap_or(f64::NAN) / product)
            });
            let valid_ratios: Vec<f64> =
                ratios.filter(|v| v.is_finite() && *v > lower_bound + MIN_RATIO_EXCESS && *v < MAX_RATIO).collect();
            if valid_ratios.is_empty() {
                lower_bound + DEFAULT_RATIO_EXCESS
            } else {
                median(valid_ratios)
            }
        };
        self.coefficients.iter().map(value_or_ratio).collect()
    }

    /// Return the usual integer values of the free orders, limited to their bounds.
    ///
    /// The highest order of each equation is 2. Its autoregressive terms have the orders 1 and 0, and its input terms
    /// have the order 0.
    #[must_use]
    pub fn integer_orders(&self) -> Vec<f64> {
        let mut usual_orders: BTreeMap<&String, f64> = BTreeMap::new();
        for equation in &self.structure.equations {
            usual_orders.extend(equation.order.names().map(|name| (name, 2.0)));
            let autoregressive_names = equation.autoregressive_terms().flat_map(|term| term.order.names()).enumerate();
            let value = |i| if i == 0 { 1.0 } else { 0.0 };
            let autoregressive_orders: Vec<_> = autoregressive_names
                .map(|(i, name)| (name, usual_orders.get(name).copied().unwrap_or(value(i))))
                .collect();
            usual_orders.extend(autoregressive_orders);
        }
        let pairs = self.orders.iter().zip(self.bounds());
        // `clamp` would panic on crossed bounds, which are rejected elsewhere.
        pairs.map(|(name, (low, high))| usual_orders.get(name).copied().unwrap_or(0.0).max(*low).min(*high)).collect()
    }

    /// Return the parameter set of the same structure with other initial terms.
    ///
    /// `history` is true if the initial terms represent inputs before the start of a run.
    ///
    /// # Errors
    /// An error if an equation, signal, order or bound is invalid ([`ParameterSet::from_structure`]).
    pub fn with_initial_terms(&self, initial: Initial, history: bool) -> Result<Self> {
        Self::from_structure(ParametricStructure { initial, history, ..self.structure.clone() })
    }

    /// Lower bound of a ratio, which is a factor of a coefficient law; 1 by default.
    fn ratio_lower_bound(&self, ratio: &String) -> f64 {
        self.structure.hints.ratio_lower_bounds.get(ratio).copied().unwrap_or(1.0)
    }
}

/// Return the bounds of the free orders: the given ones, or else the defaults.
fn bounds(structure: &ParametricStructure, orders: &[String]) -> Vec<(f64, f64)> {
    let highest: Vec<&String> =
        structure.equations.iter().filter(|e| e.order.is_single()).flat_map(|e| e.order.names()).collect();
    let inertia: Vec<&String> = structure
        .equations
        .iter()
        .filter(|e| e.friction.is_some() && e.order.is_single())
        .flat_map(|e| e.order.names())
        .collect();
    let order_bounds = |name: &String| {
        let is_highest = highest.contains(&name);
        let default_bounds =
            || (if is_highest { ALPHA_BOUNDS.0 } else { 0.0 }, upper_order_bound(structure, name, is_highest));
        let (low, high) = structure.bounds.get(name).copied().unwrap_or_else(default_bounds);
        if inertia.contains(&name) {
            // Friction needs a velocity state, and is defined for orders up to 2.
            return (low.max(FRICTION_BOUNDS.0), high.min(FRICTION_BOUNDS.1));
        }
        (low, high)
    };
    orders.iter().map(order_bounds).collect()
}

/// Default upper bound of a free order, which is at least 3.
///
/// If the equations that contain the free order have a fixed order n > 3, the bound is raised to n. For the highest
/// order of an equation (`is_highest`), it is raised to n + 1 for n > 2.
fn upper_order_bound(structure: &ParametricStructure, name: &String, is_highest: bool) -> f64 {
    let equations_with_name =
        structure.equations.iter().filter(|e| e.orders().any(|order| order.names().any(|n| n == name)));
    let fixed_orders = equations_with_name
        .flat_map(ParametricEquation::orders)
        .filter(|order| !order.is_free())
        .map(|order| order.constant);
    fixed_orders.map(|n| n + f64::from(u8::from(is_highest))).fold(SEARCHED_ORDER, f64::max).min(MAX_ORDER)
}

/// Time scaling of a problem: a unit of time, and the exponent of this unit in the unit of each parameter.
#[derive(Debug, Clone)]
pub struct TimeScaling {
    unit: Unit,
    orders: usize,
    coefficients: usize,
    size: usize,
}

impl TimeScaling {
    /// Return the time scaling for runs with the given (sampling interval, duration) \[s\].
    ///
    /// The unit is the inverse of the geometric mean of the lowest frequency of the runs and the Nyquist frequency.
    #[must_use]
    pub fn from_runs(problem: &Problem, intervals_and_durations: &[(f64, f64)]) -> Self {
        let log_spans: Vec<f64> =
            intervals_and_durations.iter().map(|(step, duration)| libm::log(*step) + libm::log(*duration)).collect();
        Self {
            unit: Unit::from_log_spans(&problem.model, &log_spans),
            orders: problem.model.order_bounds.len(),
            coefficients: problem.model.coordinates.len(),
            size: problem.size(),
        }
    }

    /// Natural logarithm of the scaled unit of time, expressed in seconds.
    #[must_use]
    pub fn unit(&self) -> f64 {
        self.unit.log_unit()
    }

    /// Factors that convert the parameters from seconds to the scaled unit of time. They depend on the orders only.
    fn factors(&self, values: &[f64]) -> Vec<f64> {
        let factor = |i: usize| match i.checked_sub(self.orders) {
            Some(j) if j < self.coefficients => self.unit.factor(j, &values[..self.orders]),
            _ => 1.0,
        };
        (0..self.size).map(factor).collect()
    }

    /// Return the relative decrease of the value of parameter `i` in seconds if the orders change by `step`.
    ///
    /// The value of the parameter in the scaled unit of time is kept constant.
    fn relative_decrease(&self, i: usize, step: &[f64]) -> f64 {
        match i.checked_sub(self.orders) {
            Some(j) if j < self.coefficients => step[..self.orders]
                .iter()
                .enumerate()
                .map(|(k, order_step)| self.unit.relative_decrease(j, k) * order_step)
                .sum(),
            _ => 0.0,
        }
    }

    /// Convert parameter values from seconds to the scaled unit of time.
    #[must_use]
    pub fn to_scaled(&self, values: &[f64]) -> Vec<f64> {
        values.iter().zip(self.factors(values)).map(|(v, f)| v * f).collect()
    }

    /// Convert parameter values from the scaled unit of time to seconds.
    #[must_use]
    pub fn to_unscaled(&self, values: &[f64]) -> Vec<f64> {
        values.iter().zip(self.factors(values)).map(|(v, f)| v / f).collect()
    }

    /// Convert small changes of the parameters from the scaled unit of time to seconds, at the given values.
    #[must_use]
    pub fn step(&self, values: &[f64], changes: &[f64]) -> Vec<f64> {
        let factors = self.factors(values);
        let unscaled_step =
            |(i, value): (usize, &f64)| changes[i] / factors[i] - value * self.relative_decrease(i, changes);
        values.iter().enumerate().map(unscaled_step).collect()
    }

    /// Return the standard errors in the scaled unit of time from a row-major covariance matrix in seconds.
    ///
    /// The error is infinite for a parameter that is not identifiable.
    #[must_use]
    pub fn standard_errors(&self, values: &[f64], covariance: &[f64]) -> Vec<f64> {
        let (n, factors) = (values.len(), self.factors(values));
        let is_finite: Vec<bool> = (0..n).map(|i| covariance[i * n + i].is_finite()).collect();
        let standard_error = |i: usize| {
            let mut row = vec![0.0; n];
            row[i] = factors[i];
            for (k, entry) in row.iter_mut().enumerate().take(self.orders) {
                let mut unit_step = vec![0.0; self.orders];
                unit_step[k] = 1.0;
                *entry += factors[i] * values[i] * self.relative_decrease(i, &unit_step);
            }
            if row.iter().zip(&is_finite).any(|(entry, is_finite)| !is_finite && *entry != 0.0) {
                return f64::INFINITY;
            }
            let mut variance = 0.0;
            for j in (0..n).filter(|&j| is_finite[j]) {
                for k in (0..n).filter(|&k| is_finite[k]) {
                    variance += row[j] * covariance[j * n + k] * row[k];
                }
            }
            variance.max(0.0).sqrt()
        };
        (0..n).map(standard_error).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::joint_fit::structure::{Order, ParametricTerm};

    #[test]
    fn time_scaling_converts_values_steps_and_errors() -> Result<()> {
        let term = |signal, order, name: &str| ParametricTerm {
            signal,
            order,
            coefficient: Coefficient::Free(name.into()),
            factor: 1.0,
        };
        let terms = vec![
            term(0, Order::free("mu"), "d"),
            term(0, Order::number(0.0), "a"),
            term(1, Order::free("gamma"), "b0"),
            term(1, Order::number(0.0), "b1"),
        ];
        let equation = ParametricEquation { output: 0, order: Order::free("alpha"), terms, friction: None };
        let structure = ParametricStructure::new(vec!["y".into(), "u".into()], vec![equation], Initial::Rest);
        let problem = ParameterSet::from_structure(structure)?.problem;
        let (time_scaling, minutes) =
            (TimeScaling::from_runs(&problem, &[(0.02, 4.8)]), TimeScaling::from_runs(&problem, &[(1.2, 288.0)]));
        let unit = libm::exp(minutes.unit());
        assert!((unit / libm::exp(time_scaling.unit()) / 60.0 - 1.0).abs() < 1e-12);
        let values = [1.9, 0.7, 0.4, -2.0, -30.0, 4.0, 0.0];
        let powers = [0.0, 0.0, 0.0, 1.2, 1.9, 1.5, 1.9];
        let scaled = minutes.to_scaled(&values);
        for ((value, power), scaled) in values.iter().zip(powers).zip(&scaled) {
            assert!((value * libm::pow(unit, power) - scaled).abs() <= 1e-12 * scaled.abs());
        }
        let unscaled = minutes.to_unscaled(&scaled);
        assert!(unscaled.iter().zip(values).all(|(a, b)| (a - b).abs() <= 1e-12 * b.abs()));
        let tiny = [1e-7, -2e-7, 3e-7, 4e-7, -5e-7, 6e-7, 7e-7];
        let shifted: Vec<f64> = values.iter().zip(tiny).map(|(v, by)| v + by).collect();
        let change: Vec<f64> = minutes.to_scaled(&shifted).iter().zip(&scaled).map(|(a, b)| a - b).collect();
        let step = minutes.step(&values, &change);
        assert!(step.iter().zip(tiny).all(|(a, b)| (a - b).abs() < 1e-9));
        // Slopes by finite differences yield the standard errors of independent parameters.
        let n = values.len();
        let deviations = [0.1, 0.2, 0.05, 0.3, 2.0, 0.5, 0.4];
        let covariance: Vec<f64> =
            (0..n * n).map(|k| if k % (n + 1) == 0 { deviations[k / n] * deviations[k / n] } else { 0.0 }).collect();
        let slope = |i: usize, j: usize| {
            let mut perturbed_values = values;
            perturbed_values[j] += 1e-6;
            (minutes.to_scaled(&perturbed_values)[i] - scaled[i]) / 1e-6
        };
        for (i, error) in minutes.standard_errors(&values, &covariance).into_iter().enumerate() {
            let expected = (0..n).map(|j| (slope(i, j) * deviations[j]).powi(2)).sum::<f64>().sqrt();
            assert!((error - expected).abs() <= 1e-3 * expected);
        }
        // If an order is not identifiable, its coefficients have no finite error either.
        let mut with_unidentifiable = covariance;
        with_unidentifiable[2 * n + 2] = f64::INFINITY;
        let errors = minutes.standard_errors(&values, &with_unidentifiable);
        assert_eq!(
            errors.iter().map(|e| e.is_infinite()).collect::<Vec<_>>(),
            [false, false, true, false, false, true, false]
        );
        Ok(())
    }
}

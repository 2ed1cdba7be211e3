//! Derivatives of the residuals with respect to the parameters of the equations A y = b.
//!
//! A contains the operators of the simulated outputs y, and b is the contribution of the inputs. Each derivative A⁻¹(∂b
//! − ∂A y) is a product of three spectra, with one inverse FFT per parameter and output.

use std::borrow::Cow;
use std::rc::Rc;

use super::evaluation::Evaluation;
use super::evaluation_cache::EvaluationCache;
use super::experiment::Experiment;
use super::parameterization::{FreeModel, ParameterPoint};
use super::residuals::Linearization;
use crate::equation::AffineOrder;
use crate::error::{Error, Result};
use crate::linalg::orthogonal::project_out;
use crate::series::Kernel;

impl FreeModel {
    /// Derivatives of the residuals, one row per order, coefficient (in plain coordinates) and input parameter.
    ///
    /// Initial terms are projected out. The derivatives with respect to the linear coefficients are taken from the
    /// evaluation. [`Error::Diverged`] if a derivative is not finite.
    pub(crate) fn jacobian(
        &self,
        experiments: &[Experiment],
        caches: &mut [EvaluationCache],
        linear: &[usize],
        evaluation: &Evaluation<Linearization>,
    ) -> Result<Vec<Vec<f64>>> {
        let point = &evaluation.point;
        let count = point.orders.len() + point.coefficients.len() + point.inputs.len();
        let mut jacobian = vec![Vec::with_capacity(evaluation.residuals.len()); count];
        for (index, ((experiment, part), cache)) in experiments.iter().zip(&evaluation.parts).zip(caches).enumerate() {
            self.sensitivities(experiment, cache, part, point, &evaluation.initial[index], linear, &mut jacobian)?;
        }
        if jacobian.iter().flatten().any(|v| !v.is_finite()) {
            return Err(Error::Diverged { what: "sensitivity of the simulation".into(), index: 0 });
        }
        Ok(jacobian)
    }

    /// Append the derivatives of the residuals of one experiment to the rows of the Jacobian.
    #[allow(clippy::too_many_arguments)]
    fn sensitivities(
        &self,
        experiment: &Experiment,
        cache: &mut EvaluationCache,
        part: &Linearization,
        point: &ParameterPoint,
        initial: &[Vec<f64>],
        linear: &[usize],
        jacobian: &mut [Vec<f64>],
    ) -> Result<()> {
        let record = &experiment.record;
        let (orders, coefficients) = (&point.orders, &point.coefficients);
        let (m, n) = (record.m(), self.equations.len());
        let mut responses: Vec<Option<Rc<Kernel>>> = part.response.iter().map(|_| None).collect();
        let mut columns: Vec<Option<Vec<f64>>> = vec![None; jacobian.len()];
        for (&coefficient, effect) in linear.iter().zip(&part.linear_effects) {
            columns[orders.len() + coefficient] = Some(effect.samples.clone());
        }
        let parameters: Vec<usize> = (0..columns.len()).filter(|&parameter| columns[parameter].is_none()).collect();
        part.system.inverse()?.solve_each(
            (n, m),
            parameters.len(),
            |index, right_hand_sides| {
                cache.stop.check()?;
                let parameter = parameters[index];
                for (i, equation) in self.equations.iter().enumerate() {
                    for (k, (signal, _, _)) in equation.terms.iter().enumerate() {
                        let is_order = parameter < orders.len();
                        let weight = self.right_hand_side_weight((i, k), point, parameter);
                        if weight == 0.0 {
                            continue;
                        }
                        let operator = &part.operators[i][k];
                        if let Some(input) = parameter.checked_sub(orders.len() + coefficients.len()) {
                            let slope = &part.input_means[input].1;
                            right_hand_sides.add(
                                i,
                                weight,
                                (operator, false),
                                || Cow::Borrowed(slope),
                                || cache.spectrum(slope),
                            );
                        } else if let Some(j) = self.output_index(i, *signal) {
                            let (response, spectrum) = (&part.response[j], &mut responses[j]);
                            let make_spectrum = || spectrum.get_or_insert_with(|| cache.spectrum(response)).clone();
                            right_hand_sides.add(
                                i,
                                weight,
                                (operator, is_order),
                                || Cow::Borrowed(response),
                                make_spectrum,
                            );
                        } else {
                            let series = || {
                                Cow::Borrowed(self.input_means(record, (*signal, operator.eta()), &part.input_means))
                            };
                            let make_spectrum =
                                || cache.input_spectrum(self, experiment, (*signal, operator.eta()), &part.input_means);
                            right_hand_sides.add(i, weight, (operator, is_order), series, make_spectrum);
                        }
                    }
                    if parameter < orders.len()
                        && let Some(initial_slope) =
                            initial_term_derivative(self, (i, parameter), orders, &initial[i], (experiment, cache))
                    {
                        let series = || Cow::Owned(cache.filter_series(&initial_slope));
                        right_hand_sides.add_series(i, series, || cache.filtered_spectrum(&initial_slope));
                    }
                }
                Ok(())
            },
            |index, means| {
                if let Some(means) = means {
                    columns[parameters[index]] =
                        Some(part.parameter_effect(parameters[index], means, (self, experiment, point))?.samples);
                }
                Ok(())
            },
        )?;
        for (column, out) in columns.into_iter().zip(jacobian) {
            match column {
                None => out.extend(std::iter::repeat_n(0.0, n * experiment.compared_count())),
                Some(mut column) => {
                    project_out(&part.basis, &mut column);
                    // Residuals are measured minus simulated samples.
                    out.extend(column.iter().map(|v| -v));
                }
            }
        }
        Ok(())
    }

    /// Weight of term `k` of equation `i` in the derivative of the right-hand side with respect to a parameter.
    ///
    /// For a coefficient, the weight multiplies the operator. For an order, it multiplies the derivative of the
    /// operator. For an input parameter, it multiplies the derivative of the input.
    fn right_hand_side_weight(&self, (i, k): (usize, usize), point: &ParameterPoint, parameter: usize) -> f64 {
        let (equation, (orders, coefficients)) = (&self.equations[i], (&point.orders, &point.coefficients));
        let (signal, order, monomial) = &equation.terms[k];
        if let Some(input) = parameter.checked_sub(orders.len() + coefficients.len()) {
            // An input parameter does not change kernels and coefficients.
            return if self.inputs[input].signal == *signal { monomial.at(coefficients) } else { 0.0 };
        }
        match parameter.checked_sub(orders.len()) {
            Some(coefficient) => monomial.slope(coefficients, coefficient),
            None => {
                let order_weight = |law: &AffineOrder| law.weights.get(parameter).copied().unwrap_or(0.0);
                monomial.at(coefficients) * (order_weight(&equation.order) - order_weight(order))
            }
        }
    }
}

/// Derivatives of the exponents of the initial terms of equation `i` with respect to a free order.
///
/// None if they do not depend on the order, or if the number `count` of exponents changes at this order.
pub(crate) fn initial_exponent_slopes(
    model: &FreeModel,
    (i, parameter): (usize, usize),
    orders: &[f64],
    count: usize,
    experiment: &Experiment,
) -> Option<Vec<f64>> {
    // Exponents are linear in the orders, so a difference with any shift is their derivative.
    const SHIFT: f64 = 1e-4;
    if count == 0 || !model.initial.follows_orders() {
        return None;
    }
    let exponents = |shift: f64| {
        let mut shifted_orders = orders.to_vec();
        shifted_orders[parameter] += shift;
        model.exponents(experiment, i, &model.structures(&shifted_orders)[i])
    };
    let (exponents_below, exponents, exponents_above) = (exponents(-SHIFT), exponents(0.0), exponents(SHIFT));
    if [&exponents_below, &exponents, &exponents_above].iter().any(|list| list.len() != count) {
        // The number of initial terms changes at this order. The projection adapts to it in the next evaluation.
        return None;
    }
    let slopes = exponents_below.iter().zip(&exponents_above).map(|(below, above)| (above - below) / (2.0 * SHIFT));
    // Smaller differences are rounding.
    Some(slopes.map(|slope| if slope.abs() < SHIFT { 0.0 } else { slope }).collect())
}

/// Derivative of the sum of the initial terms of equation `i` with respect to a free order, before the filter.
///
/// `values` contains the coefficients of the terms. Return None if the terms do not depend on the order.
fn initial_term_derivative(
    model: &FreeModel,
    (i, parameter): (usize, usize),
    orders: &[f64],
    values: &[f64],
    (experiment, cache): (&Experiment, &EvaluationCache),
) -> Option<Vec<f64>> {
    let slopes = initial_exponent_slopes(model, (i, parameter), orders, values.len(), experiment)?;
    let exponents = model.exponents(experiment, i, &model.structures(orders)[i]);
    let mut out = Vec::new();
    for ((&exponent, &x), slope) in exponents.iter().zip(values).zip(&slopes) {
        if *slope == 0.0 || x == 0.0 {
            continue;
        }
        out.resize(experiment.record.m(), 0.0);
        let power = cache.initial_term(exponent);
        out.iter_mut().zip(power.slope()).for_each(|(v, slope_of_power)| *v += x * slope * slope_of_power);
    }
    Some(out).filter(|out| !out.is_empty())
}

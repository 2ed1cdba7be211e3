//! Derivatives of the residuals: A⁻¹(∂b − ∂A y) as products of three spectra, one inverse transform a parameter and output.

use super::experiment::Experiment;
use super::free_run::Evaluation;
use super::linear::project_out;
use super::model::{FreeModel, Point};
use super::part::Part;
use super::shelf::Shelf;
use crate::equation::AffineOrder;
use crate::error::{Error, Result};
use crate::series::Kernel;
use std::borrow::Cow;
use std::rc::Rc;

impl FreeModel {
    /// Derivatives of the residuals at an evaluated point with respect to orders, coefficients (plain coordinates),
    /// then inputs' numbers, initial terms projected out; those of linear coefficients are there already.
    pub(super) fn jacobian(
        &self,
        experiments: &[Experiment],
        shelves: &mut [Shelf],
        linear: &[usize],
        at: &Evaluation,
    ) -> Result<Vec<Vec<f64>>> {
        let point = &at.point;
        let count = point.orders.len() + point.coefficients.len() + point.inputs.len();
        let mut jacobian = vec![Vec::with_capacity(at.residuals.len()); count];
        for (index, ((experiment, part), shelf)) in experiments.iter().zip(&at.parts).zip(shelves).enumerate() {
            self.sensitivities(experiment, shelf, part, point, &at.initial[index], linear, &mut jacobian)?;
        }
        if jacobian.iter().flatten().any(|v| !v.is_finite()) {
            return Err(Error::Diverged { what: "sensitivity of the free run".into(), index: 0 });
        }
        Ok(jacobian)
    }

    /// One experiment's rows of the Jacobian: A⁻¹(∂b − ∂A y) as products of three spectra.
    #[allow(clippy::too_many_arguments)]
    fn sensitivities(
        &self,
        experiment: &Experiment,
        shelf: &mut Shelf,
        part: &Part,
        point: &Point,
        initial: &[Vec<f64>],
        linear: &[usize],
        jacobian: &mut [Vec<f64>],
    ) -> Result<()> {
        let record = &experiment.record;
        let (orders, coefficients) = (&point.orders, &point.coefficients);
        let (m, n) = (record.m(), self.equations.len());
        let mut responses: Vec<Option<Rc<Kernel>>> = part.response.iter().map(|_| None).collect();
        let mut columns: Vec<Option<Vec<f64>>> = vec![None; jacobian.len()];
        for (&coefficient, driven) in linear.iter().zip(&part.driven) {
            columns[orders.len() + coefficient] = Some(driven.samples.clone());
        }
        let open: Vec<usize> = (0..columns.len()).filter(|&parameter| columns[parameter].is_none()).collect();
        part.solved.inverse()?.each(
            (n, m),
            open.len(),
            |place, rights| {
                let parameter = open[place];
                for (i, equation) in self.equations.iter().enumerate() {
                    for (k, (signal, _, _)) in equation.terms.iter().enumerate() {
                        let turns = parameter < orders.len();
                        let weight = self.pull((i, k), point, parameter);
                        if weight == 0.0 {
                            continue;
                        }
                        let operator = &part.operators[i][k];
                        if let Some(input) = parameter.checked_sub(orders.len() + coefficients.len()) {
                            let slope = &part.acted[input].1;
                            rights.add(i, weight, (operator, false), || Cow::Borrowed(slope), || shelf.spectrum(slope));
                        } else if let Some(j) = self.unknown(i, *signal) {
                            let (response, known) = (&part.response[j], &mut responses[j]);
                            let made = || known.get_or_insert_with(|| shelf.spectrum(response)).clone();
                            rights.add(i, weight, (operator, turns), || Cow::Borrowed(response), made);
                        } else {
                            let series = || Cow::Borrowed(self.drives(record, *signal, &part.acted));
                            let made = || shelf.driver(self, experiment, *signal, &part.acted);
                            rights.add(i, weight, (operator, turns), series, made);
                        }
                    }
                    if parameter < orders.len() {
                        if let Some(moved) =
                            initial_slope(self, (i, parameter), orders, &initial[i], (experiment, shelf))?
                        {
                            rights.add_series(i, Cow::Owned(moved), |series| shelf.spectrum(series));
                        }
                    }
                }
                Ok(())
            },
            |place, means| {
                if let Some(means) = means {
                    columns[open[place]] = Some(part.moved_by(open[place], means, (self, experiment, point))?.samples);
                }
                Ok(())
            },
        )?;
        for (column, out) in columns.into_iter().zip(jacobian) {
            match column {
                None => out.extend(std::iter::repeat_n(0.0, n * experiment.compared())),
                Some(mut column) => {
                    project_out(&part.basis, &mut column);
                    // Residuals fall where the response rises.
                    out.extend(column.iter().map(|v| -v));
                }
            }
        }
        Ok(())
    }

    /// How a parameter moves the right-hand side by term k of equation i: the weight of the term's operator, of its
    /// derivative for an order, of the slope of what drives for a number of an input.
    fn pull(&self, (i, k): (usize, usize), point: &Point, parameter: usize) -> f64 {
        let (equation, (orders, coefficients)) = (&self.equations[i], (&point.orders, &point.coefficients));
        let (signal, order, monomial) = &equation.terms[k];
        if let Some(input) = parameter.checked_sub(orders.len() + coefficients.len()) {
            // It moves only what it drives: kernel and coefficient stay.
            return if self.inputs[input].signal == *signal { monomial.at(coefficients) } else { 0.0 };
        }
        match parameter.checked_sub(orders.len()) {
            Some(coefficient) => monomial.slope(coefficients, coefficient),
            None => {
                let of = |law: &AffineOrder| law.weights.get(parameter).copied().unwrap_or(0.0);
                monomial.at(coefficients) * (of(&equation.order) - of(order))
            }
        }
    }
}

/// How the initial terms of equation i move with a free order, weighted by their coefficients; none if they do not.
fn initial_slope(
    model: &FreeModel,
    (i, parameter): (usize, usize),
    orders: &[f64],
    values: &[f64],
    (experiment, shelf): (&Experiment, &Shelf),
) -> Result<Option<Vec<f64>>> {
    // Exponents move linearly with orders, and powers of t smoothly with exponents: a central difference of the
    // powers has an error of 1e−10, far below what a Jacobian needs.
    const SHIFT: f64 = 1e-5;
    if values.is_empty() || !model.initial.follows_orders() {
        return Ok(None);
    }
    let mut lists = Vec::with_capacity(2);
    for sign in [1.0, -1.0] {
        let mut moved = orders.to_vec();
        moved[parameter] += sign * SHIFT;
        lists.push(model.exponents(experiment, i, &model.structures(&moved)[i]));
    }
    if lists.iter().any(|l| l.len() != values.len()) {
        // An exponent appears or merges here: the projection follows it in the next evaluation.
        return Ok(None);
    }
    let record = &experiment.record;
    let mut out = vec![0.0; record.m()];
    let mut moved = false;
    for ((&up, &down), &x) in lists[0].iter().zip(&lists[1]).zip(values) {
        if (up - down).abs() < 1e-9 || x == 0.0 {
            continue;
        }
        moved = true;
        let (above, below) = (shelf.power(up), shelf.power(down));
        out.iter_mut()
            .zip(above.series.iter().zip(&below.series))
            .for_each(|(v, (a, b))| *v += x * (a - b) / (2.0 * SHIFT));
    }
    Ok(moved.then_some(out))
}

//! The free run of a model at a point, its residuals on every experiment, and the initial terms that are projected out.

use super::corners::Corners;
use super::experiment::Experiment;
use super::feedthrough::{Direct, Early};
use super::model::{FreeModel, Point};
use crate::dense;
use crate::equation::Structure;
use crate::error::{Error, Result};
use crate::estimate::least_squares;
use crate::excess::{kernel_and_slope, MAX_EXCESS};
use crate::series::{Buffers, Kernel, Solver, SumOfProducts};

/// Own-output orders closer to α than this make the equation say that the output equals itself.
const LEAST_INTEGRATION: f64 = 1e-3;

/// An initial term whose response lies in the span of the others up to this share adds nothing to the projection.
const SPANNED: f64 = 1e-12;

/// Residuals at a point, and what their derivatives there are made of.
pub(super) struct Evaluation {
    pub(super) residuals: Vec<f64>,
    /// Norm of the weighted samples, of which the residuals are differences.
    pub(super) size: f64,
    pub(super) initial: Vec<Vec<Vec<f64>>>,
    pub(super) exponents: Vec<Vec<f64>>,
    pub(super) parts: Vec<Part>,
}

/// Coefficient of a term, kernel of its integral, and the kernel's derivative with respect to the order.
pub(super) type Operator = (f64, Vec<f64>, Vec<f64>);

/// What one experiment leaves behind for its sensitivities.
pub(super) struct Part {
    /// A of A y = b.
    pub(super) matrix: Vec<Vec<Vec<f64>>>,
    /// Spectra of A⁻¹ where initial terms needed them already.
    pub(super) inverse: Option<Vec<Vec<Kernel>>>,
    /// Of each term of each equation.
    pub(super) operators: Vec<Vec<Operator>>,
    /// Simulated pulse means, initial terms included.
    pub(super) response: Vec<Vec<f64>>,
    /// Orthonormal basis of the sampled responses to the initial terms.
    pub(super) basis: Vec<Vec<f64>>,
    /// Pulse means of each input with a free number once it acts, and their derivative with respect to it.
    pub(super) acted: Vec<(Vec<f64>, Vec<f64>)>,
    /// What feeds through at once.
    pub(super) direct: Option<Direct>,
    /// What pulses see too early.
    pub(super) early: Early,
    /// Corners near samples that were read at times of their own.
    pub(super) corners: Option<Corners>,
}

/// Terms of a product of three series of m terms: spectra of this length multiply without wrapping onto the first m.
pub(super) const FACTORS: usize = 3;

impl FreeModel {
    /// Residuals at a point.
    pub(super) fn evaluate(&self, experiments: &[Experiment], point: &Point) -> Result<Evaluation> {
        let structures = self.structures(&point.orders);
        let mut out = Evaluation {
            residuals: Vec::new(),
            size: 0.0,
            initial: Vec::new(),
            exponents: structures.iter().map(|s| s.initial_exponents(&self.initial)).collect(),
            parts: Vec::with_capacity(experiments.len()),
        };
        for experiment in experiments {
            self.evaluate_one(experiment, &structures, point, &mut out)?;
        }
        Ok(out)
    }

    fn evaluate_one(
        &self,
        experiment: &Experiment,
        structures: &[Structure],
        point: &Point,
        out: &mut Evaluation,
    ) -> Result<()> {
        let record = &experiment.record;
        let acted = (self.inputs.iter().zip(&point.inputs))
            .map(|(&input, &value)| self.acted(record, input, value))
            .collect::<Result<Vec<_>>>()?;
        let (m, n) = (record.m(), structures.len());
        let mut matrix = vec![vec![vec![0.0; m]; n]; n];
        let mut rhs = vec![vec![0.0; m]; n];
        let mut buffers = Buffers::default();
        let mut drivers: Vec<Option<Kernel>> = (0..record.len()).map(|_| None).collect();
        let mut operators = Vec::with_capacity(n);
        let mut sum = SumOfProducts::new(m);
        for (i, structure) in structures.iter().enumerate() {
            matrix[i][i][0] += 1.0;
            let mut row = Vec::with_capacity(structure.terms.len());
            for (k, term) in structure.terms.iter().enumerate() {
                let eta = structure.order - term.order;
                let held = experiment.instants.get(term.signal).is_some_and(|instant| instant.held);
                let least = if term.signal == structure.output {
                    LEAST_INTEGRATION
                } else if held {
                    // The derivative of a jump is infinite.
                    0.0
                } else {
                    LEAST_INTEGRATION - MAX_EXCESS
                };
                if eta < least {
                    // Reported like a step too far, so that the search shortens it.
                    return Err(Error::Diverged { what: "order of a term above alpha; the free run".into(), index: 0 });
                }
                let c = self.equations[i].terms[k].2.at(&point.coefficients);
                let (kernel, slope) = kernel_and_slope(eta, m, record.step());
                if let Some(j) = self.unknown(i, term.signal) {
                    matrix[i][j].iter_mut().zip(&kernel).for_each(|(a, v)| *a -= c * v);
                } else {
                    let driver = drivers[term.signal].get_or_insert_with(|| {
                        Kernel::new(self.law_of(term.signal).map_or(record.signal(term.signal), |d| &acted[d].0))
                    });
                    sum.add(c, &Kernel::new(&kernel), driver);
                }
                row.push((c, kernel, slope));
            }
            sum.take(&mut rhs[i], &mut buffers);
            operators.push(row);
        }
        let mut response = Solver::new(&matrix)?.solve(&rhs)?;
        let mut residuals = experiment.measured();
        out.size = out.size.hypot(residuals.iter().map(|v| v * v).sum::<f64>().sqrt());
        let mut sampled = experiment.sampled(&response);
        let early = Early::of(self, experiment, &acted);
        early.correct(self, experiment, point, &mut sampled)?;
        residuals.iter_mut().zip(sampled).for_each(|(e, v)| *e -= v);
        let direct = Direct::of(self, experiment, structures, point, &acted)?;
        if let Some(direct) = &direct {
            residuals.iter_mut().zip(direct.samples(experiment)).for_each(|(e, v)| *e -= v);
        }
        let corners = Corners::of(self, experiment, structures);
        if let Some(corners) = &corners {
            let there = corners.samples(self, experiment, point, direct.as_ref());
            residuals.iter_mut().zip(there).for_each(|(e, v)| *e -= v);
        }
        if let Some(index) = residuals.iter().position(|e| !e.is_finite()) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }

        // Initial terms: the projection of the residuals on their responses.
        let mut initial: Vec<Vec<f64>> = vec![Vec::new(); n];
        let mut basis = Vec::new();
        let mut inverse = None;
        if out.exponents.iter().any(|list| !list.is_empty()) {
            let made = inverse_spectra(&matrix)?;
            let mut target = SumOfProducts::with_length(FACTORS * m);
            let mut terms = Vec::new();
            for (i, list) in out.exponents.iter().enumerate() {
                for &exponent in list {
                    let power = Kernel::with_length(&record.initial_term(exponent), FACTORS * m);
                    let means: Vec<Vec<f64>> = made
                        .iter()
                        .map(|row| {
                            let mut means = vec![0.0; m];
                            target.add(1.0, &row[i], &power);
                            target.take(&mut means, &mut buffers);
                            means
                        })
                        .collect();
                    let mut column = experiment.sampled(&means);
                    if experiment.own.is_some() {
                        let corner = Corners::of_power(experiment, i, exponent);
                        column.iter_mut().zip(corner).for_each(|(v, c)| *v += c);
                    }
                    terms.push((i, column, means));
                }
            }
            inverse = Some(made);
            let columns: Vec<Vec<f64>> = terms.iter().map(|t| t.1.clone()).collect();
            let (values, _) = least_squares::solve(&columns, &residuals, 0)?;
            for ((i, column, means), x) in terms.iter().zip(&values) {
                initial[*i].push(*x);
                residuals.iter_mut().zip(column).for_each(|(e, v)| *e -= x * v);
                for (total, part) in response.iter_mut().zip(means) {
                    total.iter_mut().zip(part).for_each(|(y, v)| *y += x * v);
                }
            }
            for column in columns {
                dense::extend_orthonormal(&mut basis, column, SPANNED);
            }
        }
        out.residuals.extend(residuals);
        out.initial.push(initial);
        out.parts.push(Part { matrix, inverse, operators, response, basis, acted, direct, early, corners });
        Ok(())
    }
}

/// Spectra of the series of A⁻¹, ready for products of [`FACTORS`] series.
pub(super) fn inverse_spectra(matrix: &[Vec<Vec<f64>>]) -> Result<Vec<Vec<Kernel>>> {
    let n = matrix.len();
    let m = matrix.first().and_then(|row| row.first()).map_or(0, Vec::len);
    let mut solver = Solver::new(matrix)?;
    let mut rows: Vec<Vec<Kernel>> = (0..n).map(|_| Vec::with_capacity(n)).collect();
    for j in 0..n {
        let mut unit = vec![vec![0.0; m]; n];
        if let Some(first) = unit[j].first_mut() {
            *first = 1.0;
        }
        for (row, series) in rows.iter_mut().zip(solver.solve(&unit)?) {
            row.push(Kernel::with_length(&series, FACTORS * m));
        }
    }
    Ok(rows)
}

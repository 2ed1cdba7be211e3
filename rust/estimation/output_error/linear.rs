//! Coefficients in which the residuals are linear: those of what drives, once everything else is given.
//!
//! They are solved for at every point of the search (variable projection, Golub & Pereyra, doi:10.1137/0710036), so that
//! only own terms, orders and inputs' numbers are searched: no sign to guess, no valley between what drives alike.

use std::borrow::Cow;

use super::evaluation_cache::Shelf;
use super::experiment::Experiment;
use super::parameterization::{Coordinate, FreeModel, Point};
use super::part::{Driven, Part};
use crate::error::{Error, Result};
use crate::linalg::dense;
use crate::linalg::orthogonal::{norm, project_out};
use crate::linalg::small::back_substitute;

/// What is not told from the rest by this share of its column stays where it was: there rounding is as large.
const UNTOLD: f64 = 1e-7;

impl FreeModel {
    /// Coefficients that stand alone, once, and before nothing but what drives from outside.
    pub(crate) fn linear(&self) -> Vec<usize> {
        let stands = |j: usize| {
            let mut found = false;
            for (i, equation) in self.equations.iter().enumerate() {
                for (signal, _, monomial) in &equation.terms {
                    if monomial.powers.iter().any(|&(k, _)| k == j) {
                        if monomial.powers != [(j, 1)] || self.unknown(i, *signal).is_some() {
                            return false;
                        }
                        found = true;
                    }
                }
            }
            found
        };
        let moves = |j: usize| matches!(self.coordinates[j], Coordinate::Plain | Coordinate::Logarithm);
        (0..self.coordinates.len()).filter(|&j| moves(j) && stands(j)).collect()
    }

    /// What one more of each coefficient does that stands before what drives.
    pub(crate) fn driven_by(
        &self,
        experiment: &Experiment,
        shelf: &mut Shelf,
        part: &Part,
        point: &Point,
        coefficients: &[usize],
    ) -> Result<Vec<Driven>> {
        if coefficients.is_empty() {
            return Ok(Vec::new());
        }
        let (record, n) = (&experiment.record, self.equations.len());
        let mut driven = Vec::with_capacity(coefficients.len());
        part.solved.inverse()?.each(
            (n, record.m()),
            coefficients.len(),
            |place, rights| {
                for (i, equation) in self.equations.iter().enumerate() {
                    for (k, (signal, _, monomial)) in equation.terms.iter().enumerate() {
                        let weight = monomial.slope(&point.coefficients, coefficients[place]);
                        if weight != 0.0 {
                            let eta = part.operators[i][k].eta();
                            let series = || Cow::Borrowed(self.drives(record, (*signal, eta), &part.acted));
                            rights.add(i, weight, (&part.operators[i][k], false), series, || {
                                shelf.driver(self, experiment, (*signal, eta), &part.acted)
                            });
                        }
                    }
                }
                Ok(())
            },
            |place, means| {
                let parameter = point.orders.len() + coefficients[place];
                let means = means.unwrap_or_else(|| vec![vec![0.0; record.m()]; n]);
                let found = part.moved_by(parameter, means, (self, experiment, point))?;
                if let Some(index) = found.samples.iter().position(|v| !v.is_finite()) {
                    return Err(Error::Diverged { what: "free run".into(), index });
                }
                driven.push(found);
                Ok(())
            },
        )?;
        Ok(driven)
    }
}

/// How far linear coefficients move to where the residuals of all experiments are least, each experiment's initial terms
/// projected out.
pub(crate) fn best_moves(sides: &[(&[f64], &Part)]) -> Result<Vec<f64>> {
    let count = sides.first().map_or(0, |(_, part)| part.driven.len());
    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); count + 1];
    for (residuals, run) in sides {
        for (column, part) in columns.iter_mut().zip(run.driven.iter().map(|d| &d.samples[..]).chain([*residuals])) {
            let first = column.len();
            column.extend_from_slice(part);
            project_out(&run.basis, &mut column[first..]);
        }
    }
    let mut scales = Vec::with_capacity(count);
    for (place, column) in columns.iter_mut().enumerate() {
        let size = norm(column);
        if place < count {
            let scale = if size > 0.0 && size.is_finite() { 1.0 / size } else { 0.0 };
            column.iter_mut().for_each(|v| *v *= scale);
            scales.push(scale);
        }
        let rows = column.len();
        column.resize(rows + count, 0.0);
        if place < count {
            column[rows + place] = UNTOLD;
        }
    }
    let r = dense::triangular_factor(&columns);
    let stride = count + 1;
    let rhs: Vec<f64> = (0..count).map(|i| r[i * stride + count]).collect();
    let moves: Vec<f64> = back_substitute(&r, stride, &rhs).iter().zip(&scales).map(|(s, scale)| s * scale).collect();
    match moves.iter().position(|v| !v.is_finite()) {
        Some(index) => Err(Error::Diverged { what: "linear coefficient".into(), index }),
        None => Ok(moves),
    }
}

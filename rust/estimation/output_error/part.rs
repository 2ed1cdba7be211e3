//! What a free run leaves behind for the derivatives of its residuals.

use std::rc::Rc;

use super::experiment::Experiment;
use super::feedthrough::{add_slope, Direct, Early};
use super::kink_correction::Corners;
use super::operator::Operator;
use super::parameterization::{FreeModel, Point};
use super::system_inverse::Solved;
use crate::error::Result;

/// What one experiment leaves behind for its sensitivities.
pub(crate) struct Part {
    /// What solves the equations.
    pub(crate) solved: Rc<Solved>,
    /// Of each term of each equation.
    pub(crate) operators: Vec<Vec<Rc<Operator>>>,
    /// Simulated pulse means, initial terms included.
    pub(crate) response: Vec<Vec<f64>>,
    /// Orthonormal basis of the sampled responses to the initial terms.
    pub(crate) basis: Vec<Vec<f64>>,
    /// What each coefficient does that the residuals are linear in.
    pub(crate) driven: Vec<Driven>,
    /// Pulse means of each input with a free number once it acts, and their derivative with respect to it.
    pub(crate) acted: Vec<(Vec<f64>, Vec<f64>)>,
    /// What feeds through at once.
    pub(crate) direct: Option<Direct>,
    /// What pulses see too early.
    pub(crate) early: Early,
    /// Corners near samples that were read at times of their own.
    pub(crate) corners: Option<Corners>,
}

impl Part {
    /// What one more of a parameter does to weighted samples, from what it does to pulse means. Orders come first among
    /// the parameters, coefficients next, numbers of inputs last.
    pub(crate) fn moved_by(
        &self,
        parameter: usize,
        means: Vec<Vec<f64>>,
        (model, experiment, point): (&FreeModel, &Experiment, &Point),
    ) -> Result<Driven> {
        let mut samples = experiment.sampled(&means);
        self.early.correct_slope(model, experiment, point, parameter, &mut samples)?;
        if let Some(direct) = &self.direct {
            add_slope(model, experiment, direct, point, parameter, &mut samples);
        }
        if let Some(corners) = &self.corners {
            corners.add_slope(model, experiment, self.direct.as_ref(), point, parameter, &mut samples);
        }
        Ok(Driven { samples, means })
    }
}

/// What a coefficient of 1 more does to an experiment.
pub(crate) struct Driven {
    /// To its weighted samples.
    pub(crate) samples: Vec<f64>,
    /// To the pulse means of each output; empty once it was moved.
    pub(crate) means: Vec<Vec<f64>>,
}

impl Driven {
    /// Moves the coefficient: residuals and pulse means follow.
    pub(crate) fn moved(&mut self, by: f64, residuals: &mut [f64], response: &mut [Vec<f64>]) {
        if by != 0.0 {
            residuals.iter_mut().zip(&self.samples).for_each(|(e, v)| *e -= by * v);
            for (total, more) in response.iter_mut().zip(&self.means) {
                total.iter_mut().zip(more).for_each(|(y, v)| *y += by * v);
            }
        }
        self.means = Vec::new();
    }
}

//! What is free in a joint fit, with friction and without.

use super::attempt::{Attempt, Place};
use crate::equation::AffineOrder;
use crate::error::{check_length, Error, Result};
use crate::estimation::output_error::{fit_until, Coordinate, Experiment, FreeModel, Monomial, Point, Settings};
use crate::friction::{self, FreeLaw, FrictionModel, Start};
use crate::stop::Stop;

/// Equations on their runs, and the friction of their bodies.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// Names of the outputs, an equation each, for words about them.
    pub outputs: Vec<String>,
    /// The equations; an optimum is followed in its coordinates.
    pub model: FreeModel,
    /// Which equations have friction, and how much.
    pub frictions: Vec<(usize, FreeLaw)>,
}

impl Problem {
    /// Equations whose coefficients have coordinates of their own, but for speeds, which are positive wherever they go.
    ///
    /// # Errors
    /// [`Error::Length`], [`Error::Structure`] where something is named that is not there, or bounds do not rise.
    pub fn new(outputs: Vec<String>, mut model: FreeModel, frictions: Vec<(usize, FreeLaw)>) -> Result<Self> {
        check_length("outputs", model.equations.len(), outputs.len())?;
        let (orders, coefficients) = (model.order_bounds.len(), model.coordinates.len());
        let refuse = |what: String, remedy: &str| Err(Error::Structure { what, remedy: remedy.into() });
        let weighs = |order: &AffineOrder| check_length("weights of an order", orders, order.weights.len());
        let missing = |number: &Monomial| number.powers.iter().any(|&(i, _)| i >= coefficients);
        for equation in &model.equations {
            weighs(&equation.order)?;
            for (_, order, coefficient) in &equation.terms {
                weighs(order)?;
                if missing(coefficient) {
                    return refuse("an equation names a coefficient that is not there".into(), "number them from 0");
                }
            }
        }
        for (place, law) in &frictions {
            if *place >= model.equations.len() || [&law.coulomb, &law.stribeck, &law.speed].into_iter().any(missing) {
                let what = format!("friction of equation {place} names what is not there");
                return refuse(what, "number equations and coefficients from 0");
            }
        }
        let bounds = model.order_bounds.iter().copied().chain(model.inputs.iter().map(|input| input.bounds));
        if let Some((low, high)) = bounds.into_iter().find(|(low, high)| low.is_nan() || high.is_nan() || low > high) {
            return refuse(format!("bounds {low} to {high}"), "give two rising numbers");
        }
        for (_, law) in &frictions {
            law.speed.powers.iter().for_each(|&(j, _)| model.coordinates[j] = Coordinate::Logarithm);
        }
        Ok(Self { outputs, model, frictions })
    }

    /// How many orders, coefficients and numbers of inputs are free.
    #[must_use]
    pub fn size(&self) -> usize {
        self.model.order_bounds.len() + self.model.coordinates.len() + self.model.inputs.len()
    }

    /// Values of everything free as a point.
    ///
    /// # Errors
    /// [`Error::Length`].
    pub fn point(&self, values: &[f64]) -> Result<Point> {
        check_length("values of what is free", self.size(), values.len())?;
        let (orders, rest) = values.split_at(self.model.order_bounds.len());
        let (coefficients, inputs) = rest.split_at(self.model.coordinates.len());
        Ok(Point { orders: orders.into(), coefficients: coefficients.into(), inputs: inputs.into() })
    }

    /// Bounds of everything that is free; those of coefficients are infinite, but friction takes energy.
    #[must_use]
    pub fn bounds(&self) -> Vec<(f64, f64)> {
        let mut coefficients = vec![(f64::NEG_INFINITY, f64::INFINITY); self.model.coordinates.len()];
        for (_, law) in &self.frictions {
            for &(j, _) in law.coulomb.powers.iter().chain(&law.stribeck.powers) {
                coefficients[j].0 = 0.0;
            }
        }
        for (_, law) in &self.frictions {
            law.speed.powers.iter().for_each(|&(j, _)| coefficients[j].0 = f64::MIN_POSITIVE);
        }
        let ends = self.model.inputs.iter().map(|input| input.bounds);
        self.model.order_bounds.iter().copied().chain(coefficients).chain(ends).collect()
    }

    /// Whether the free run of an equation grows at a point, and initial terms may take away what it becomes.
    #[must_use]
    pub fn grows(&self, point: &Point) -> bool {
        self.frictions.is_empty() && !self.model.initial.at_rest() && self.model.grows(point)
    }

    /// Levenberg–Marquardt from a place; a steady one goes from a free run that dies away to none that grows.
    ///
    /// # Errors
    /// Those of [`fit_until`] and, with friction, of [`crate::friction::fit_until`].
    pub fn descend(
        &self,
        experiments: &[Experiment],
        start: &Place,
        settings: Settings,
        steady: bool,
        stop: &Stop,
    ) -> Result<Attempt> {
        if self.frictions.is_empty() {
            let found = fit_until(&self.model, experiments, &start.point, settings, steady, stop)?;
            return Ok(Attempt {
                place: Place { point: found.point, states: Vec::new() },
                cost: found.cost,
                residuals: found.residuals,
                jacobian: found.jacobian,
                initial: found.initial,
                evaluations: found.evaluations,
                status: found.status,
            });
        }
        let model = FrictionModel {
            equations: self.model.equations.clone(),
            frictions: self.frictions.clone(),
            inputs: self.model.inputs.clone(),
            order_bounds: self.model.order_bounds.clone(),
            coordinates: self.model.coordinates.clone(),
            initial: self.model.initial.clone(),
            filtered: friction::passing(experiments),
        };
        let Place { point: Point { orders, coefficients, inputs }, states } = start.clone();
        let start = Start { orders, coefficients, inputs, states };
        let found = friction::fit_until(&model, experiments, &start, settings, stop)?;
        let point = Point { orders: found.orders, coefficients: found.coefficients, inputs: found.inputs };
        Ok(Attempt {
            initial: found.states.iter().map(|states| vec![states.clone()]).collect(),
            place: Place { point, states: found.states },
            cost: found.cost,
            residuals: found.residuals,
            jacobian: found.jacobian,
            evaluations: found.evaluations,
            status: found.status,
        })
    }
}

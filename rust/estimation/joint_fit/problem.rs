//! What is free in a joint fit, with friction and without.
//!
//! A point in the space of parameters, and what a descent said about it.
//!
//! How far an extrapolated estimate may go: bounds, and orders that stay below the highest of their equation.
//!
//! An attempt in a race: where it is, and where it came from.

use crate::equation::AffineOrder;
use crate::error::{check_length, Error, Result};
use crate::estimation::output_error::{
    fit_until, Coordinate, Experiment, FreeModel, Monomial, Point, Settings, Status,
};
use crate::friction::{self, FreeLaw, FrictionModel, Start};
use crate::linalg::dense;
use crate::parallel::Stop;
use crate::signal::statistics::inner;

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

/// Where a descent starts.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Place {
    /// Free orders, coefficients and numbers of inputs.
    pub point: Point,
    /// States of each run with friction, where they are known.
    pub states: Vec<Vec<f64>>,
}

/// Where it ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Attempt {
    /// The point.
    pub place: Place,
    /// Half the weighted sum of squared residuals.
    pub cost: f64,
    /// Weighted residuals, runs one after the other, outputs within.
    pub residuals: Vec<f64>,
    /// Their derivatives, a row a parameter; none where only residuals were asked for.
    pub jacobian: Vec<Vec<f64>>,
    /// Coefficients of the initial terms by run and equation; of bodies with friction their states.
    pub initial: Vec<Vec<Vec<f64>>>,
    /// Evaluations of residuals.
    pub evaluations: usize,
    /// How it ended.
    pub status: Status,
}

impl Attempt {
    /// A place before any descent: none costs more.
    #[must_use]
    pub fn unrun(place: Place) -> Self {
        let (cost, evaluations, status) = (f64::INFINITY, 0, Status::Exhausted);
        let (residuals, jacobian, initial) = (Vec::new(), Vec::new(), Vec::new());
        Self { place, cost, residuals, jacobian, initial, evaluations, status }
    }

    /// Cost per residual: 1 at the noise floor if the weights are right.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn level(&self) -> f64 {
        2.0 * self.cost / self.residuals.len() as f64
    }

    /// Whether the gradient vanished, but for what pushes out of a bound; a fit stopped at a wall has not.
    #[must_use]
    pub fn converged(&self) -> bool {
        self.status == Status::Converged
    }

    /// Orders, coefficients, numbers of inputs.
    #[must_use]
    pub fn values(&self) -> Vec<f64> {
        let Point { orders, coefficients, inputs } = &self.place.point;
        [orders.as_slice(), coefficients, inputs].concat()
    }

    /// The same place at other values.
    #[must_use]
    pub fn at(&self, values: &[f64]) -> Place {
        let point = &self.place.point;
        let (orders, rest) = values.split_at(point.orders.len());
        let (coefficients, inputs) = rest.split_at(point.coefficients.len());
        let point = Point { orders: orders.into(), coefficients: coefficients.into(), inputs: inputs.into() };
        Place { point, states: self.place.states.clone() }
    }
}

/// What the core keeps between the highest order of an equation and those of its own terms.
const LEAST_INTEGRATION: f64 = 1e-3;
/// Orders of a model are rounded to 1e-9, two of them apart; another signal's may reach the highest but not pass it.
const ROUNDED: f64 = 2e-9;
/// A direction shorter than this share of the longest is none.
const ALONG: f64 = 1e-9;

/// a·x + b ≥ m.
struct Constraint {
    normal: Vec<f64>,
    offset: f64,
    margin: f64,
}

impl Problem {
    /// The last point on the way from a feasible one to another that keeps the bounds and the constraints of orders.
    ///
    /// A constraint that already holds with equality is kept by going along it. Every constraint is affine, so the last
    /// point is exact.
    ///
    /// # Errors
    /// [`Error::Length`].
    pub fn feasible(&self, at: &[f64], towards: &[f64]) -> Result<Vec<f64>> {
        check_length("values to go from", self.size(), at.len())?;
        check_length("values to go to", self.size(), towards.len())?;
        let constraints = self.constraints();
        let room: Vec<f64> = (constraints.iter())
            .map(|c| {
                let room = inner(&c.normal, at) + c.offset;
                // A point that the core let pass closer than a margin keeps what it has.
                (room - c.margin.min(room)).max(0.0)
            })
            .collect();
        let mut step: Vec<f64> = towards.iter().zip(at).map(|(b, a)| b - a).collect();
        let mut active = vec![false; constraints.len()];
        loop {
            let blocked = |i: usize| room[i] <= ROUNDED && inner(&constraints[i].normal, &step) < -1e-15 && !active[i];
            let more: Vec<usize> = (0..constraints.len()).filter(|&i| blocked(i)).collect();
            if more.is_empty() {
                break;
            }
            more.iter().for_each(|&i| active[i] = true);
            let kept = constraints.iter().zip(&active).filter(|(_, active)| **active);
            let normals: Vec<Vec<f64>> = kept.map(|(c, _)| c.normal.clone()).collect();
            let dense::Singular { left: basis, sizes, .. } = dense::singular(&normals)
                .ok_or_else(|| Error::Internal { what: "constraints of orders without a basis".into() })?;
            let whole = step.clone();
            for (direction, _) in basis.iter().zip(&sizes).filter(|(_, size)| **size > ALONG * sizes[0]) {
                let along = inner(direction, &whole);
                step.iter_mut().zip(direction).for_each(|(s, d)| *s -= along * d);
            }
        }
        let mut share: f64 = 1.0;
        for (i, constraint) in constraints.iter().enumerate().filter(|(i, _)| !active[*i]) {
            let change = inner(&constraint.normal, &step);
            if change < 0.0 && room[i] + change < 0.0 {
                share = share.min(room[i] / -change);
            }
        }
        Ok(at.iter().zip(&step).map(|(a, s)| a + share * s).collect())
    }

    fn constraints(&self) -> Vec<Constraint> {
        let size = self.size();
        let wide = |weights: &dyn Fn(usize) -> f64| (0..size).map(weights).collect::<Vec<_>>();
        let of = |order: &AffineOrder, k: usize| order.weights.get(k).copied().unwrap_or(0.0);
        let mut found = Vec::new();
        for (i, (low, high)) in self.bounds().into_iter().enumerate() {
            let along = |sign: f64| wide(&|k| if k == i { sign } else { 0.0 });
            if low.is_finite() {
                found.push(Constraint { normal: along(1.0), offset: -low, margin: 0.0 });
            }
            if high.is_finite() {
                found.push(Constraint { normal: along(-1.0), offset: high, margin: 0.0 });
            }
        }
        for equation in &self.model.equations {
            for (signal, order, _) in &equation.terms {
                let own = *signal == equation.output;
                found.push(Constraint {
                    normal: wide(&|k| of(&equation.order, k) - of(order, k)),
                    offset: equation.order.constant - order.constant,
                    margin: if own { LEAST_INTEGRATION } else { ROUNDED },
                });
                if own {
                    found.push(Constraint { normal: wide(&|k| of(order, k)), offset: order.constant, margin: 0.0 });
                }
            }
        }
        found.retain(|c| c.normal.iter().any(|v| *v != 0.0));
        found
    }
}

/// An attempt with the start that led to it, and those of others that came to the same place.
#[derive(Debug, Clone, PartialEq)]
pub struct Runner {
    /// Where it is.
    pub attempt: Attempt,
    /// Its start, in words.
    pub origin: String,
    /// Those of the others.
    pub alike: Vec<String>,
}

impl Runner {
    /// Before its first descent.
    #[must_use]
    pub fn at(place: Place, origin: impl Into<String>) -> Self {
        Self { attempt: Attempt::unrun(place), origin: origin.into(), alike: Vec::new() }
    }

    /// The same where a descent led it.
    #[must_use]
    pub fn moved(&self, attempt: Attempt) -> Self {
        Self { attempt, ..self.clone() }
    }

    /// Cost per residual.
    #[must_use]
    pub fn level(&self) -> f64 {
        self.attempt.level()
    }
}

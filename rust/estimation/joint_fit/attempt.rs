//! A point in the space of parameters, and what a descent said about it.

use crate::estimation::output_error::{Point, Status};

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

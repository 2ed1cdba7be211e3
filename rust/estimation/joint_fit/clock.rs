//! Numbers of a fit in a unit of time of the runs' own, so that nothing hangs on the unit in which time is told.
//!
//! A coefficient before D^ν y beside D^α y is a time to the power of −(α − ν), which free orders change.

use super::problem::Problem;
use crate::estimation::output_error::clock::Clock as Unit;

/// The unit of time of some runs, and which numbers of a problem are powers of it.
#[derive(Debug, Clone)]
pub struct Clock {
    unit: Unit,
    orders: usize,
    coefficients: usize,
    size: usize,
}

impl Clock {
    /// The unit is that of a frequency half way, in logarithms, between that of the runs and Nyquist's; each run is told
    /// by its sample interval and its duration.
    #[must_use]
    pub fn of(problem: &Problem, spans: &[(f64, f64)]) -> Self {
        let spans: Vec<f64> = spans.iter().map(|(step, duration)| libm::log(*step) + libm::log(*duration)).collect();
        Self {
            unit: Unit::of_spans(&problem.model, &spans),
            orders: problem.model.order_bounds.len(),
            coefficients: problem.model.coordinates.len(),
            size: problem.size(),
        }
    }

    /// ln of the unit of time.
    #[must_use]
    pub fn unit(&self) -> f64 {
        self.unit.unit()
    }

    /// By what each number is to be multiplied for its value in the unit; only orders change that, and they are the same
    /// in any unit.
    fn factors(&self, values: &[f64]) -> Vec<f64> {
        let of = |i: usize| match i.checked_sub(self.orders) {
            Some(j) if j < self.coefficients => self.unit.factor(j, &values[..self.orders]),
            _ => 1.0,
        };
        (0..self.size).map(of).collect()
    }

    /// Share of itself by which each number falls with a step of the orders, its value in the unit kept.
    fn fall(&self, i: usize, moved: &[f64]) -> f64 {
        match i.checked_sub(self.orders) {
            Some(j) if j < self.coefficients => {
                moved[..self.orders].iter().enumerate().map(|(k, by)| self.unit.fall(j, k) * by).sum()
            }
            _ => 0.0,
        }
    }

    /// Parameters in the unit.
    #[must_use]
    pub fn told(&self, values: &[f64]) -> Vec<f64> {
        values.iter().zip(self.factors(values)).map(|(v, f)| v * f).collect()
    }

    /// Parameters from those in the unit.
    #[must_use]
    pub fn untold(&self, values: &[f64]) -> Vec<f64> {
        values.iter().zip(self.factors(values)).map(|(v, f)| v / f).collect()
    }

    /// A small step of the parameters at some values, from the one in the unit.
    #[must_use]
    pub fn step(&self, values: &[f64], moved: &[f64]) -> Vec<f64> {
        let factors = self.factors(values);
        let of = |(i, value): (usize, &f64)| moved[i] / factors[i] - value * self.fall(i, moved);
        values.iter().enumerate().map(of).collect()
    }

    /// Standard errors in the unit, from a covariance by rows; infinite where the runs do not see all that takes part.
    #[must_use]
    pub fn errors(&self, values: &[f64], covariance: &[f64]) -> Vec<f64> {
        let (n, factors) = (values.len(), self.factors(values));
        let seen: Vec<bool> = (0..n).map(|i| covariance[i * n + i].is_finite()).collect();
        let of = |i: usize| {
            let mut row = vec![0.0; n];
            row[i] = factors[i];
            for (k, by) in row.iter_mut().enumerate().take(self.orders) {
                let mut one = vec![0.0; self.orders];
                one[k] = 1.0;
                *by += factors[i] * values[i] * self.fall(i, &one);
            }
            if row.iter().zip(&seen).any(|(by, seen)| !seen && *by != 0.0) {
                return f64::INFINITY;
            }
            let mut variance = 0.0;
            for j in (0..n).filter(|&j| seen[j]) {
                for k in (0..n).filter(|&k| seen[k]) {
                    variance += row[j] * covariance[j * n + k] * row[k];
                }
            }
            variance.max(0.0).sqrt()
        };
        (0..n).map(of).collect()
    }
}

//! How far an extrapolated estimate may go: bounds, and orders that stay below the highest of their equation.

use super::problem::Problem;
use crate::equation::AffineOrder;
use crate::error::{check_length, Error, Result};
use crate::linalg::dense;
use crate::signal::statistics::inner;

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

//! Time in a unit of the records' own, so that no search depends on the unit in which time is told.
//!
//! Before D^ν y beside D^α y a coefficient is a time to the power of −(α − ν): moved at free orders, it means something else
//! in seconds than in minutes, and along a flat valley a search would end elsewhere. So its number in a unit between sample
//! and record is what is moved, where a resonance that the record shows is near 1 and orders are least like coefficients.

use super::experiment::Experiment;
use super::parameterization::{Coordinate, FreeModel};
use crate::equation::AffineOrder;

/// ln of the largest power of the unit that counts.
const LARGEST: f64 = 300.0;
/// Powers of time closer than this are the same.
const SAME: f64 = 1e-9;

/// A power of time: its constant, and the weights of the free orders in it.
type Power = (f64, Vec<f64>);

/// ln of the unit of time, and of each coefficient that stands alone before a term the weights of the free orders in α − ν,
/// behind its constant; none of others, which keep their number.
#[derive(Debug, Clone)]
pub(crate) struct Clock {
    unit: f64,
    powers: Vec<Option<Power>>,
}

impl Clock {
    /// The unit of some experiments.
    pub(crate) fn of(model: &FreeModel, experiments: &[Experiment]) -> Self {
        Self::of_spans(model, &experiments.iter().map(span).collect::<Vec<_>>())
    }

    /// The same from ln of the product of each run's sample interval and duration.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn of_spans(model: &FreeModel, spans: &[f64]) -> Self {
        // A frequency half way, in logarithms, between that of the record and Nyquist's.
        let unit = spans.iter().sum::<f64>() / (2.0 * spans.len().max(1) as f64) - libm::log(std::f64::consts::PI);
        Self { unit, powers: powers(model) }
    }

    /// ln of the unit of time.
    pub(crate) fn unit(&self) -> f64 {
        self.unit
    }

    /// By what a coefficient is to be multiplied at some orders for its number in the unit.
    pub(crate) fn factor(&self, coefficient: usize, orders: &[f64]) -> f64 {
        self.powers[coefficient].as_ref().map_or(1.0, |(constant, weights)| {
            let power = constant + weights.iter().zip(orders).map(|(w, o)| w * o).sum::<f64>();
            // Of units beyond all measure no number is left.
            libm::exp((power * self.unit).clamp(-LARGEST, LARGEST))
        })
    }

    /// Share of itself by which a coefficient falls with one more of a free order, its number in the unit kept.
    pub(crate) fn fall(&self, coefficient: usize, order: usize) -> f64 {
        let weight = |(_, weights): &Power| weights.get(order).copied().unwrap_or(0.0);
        self.powers[coefficient].as_ref().map_or(0.0, weight) * self.unit
    }
}

/// ln of the product of a sample interval and the duration.
fn span(experiment: &Experiment) -> f64 {
    let (m, step) = (experiment.record.m() as f64, experiment.record.step());
    let interval = step * experiment.every as f64;
    libm::log(interval) + libm::log(m * step)
}

/// The power of time that each coefficient is: the constant, then the weights of the free orders.
fn powers(model: &FreeModel) -> Vec<Option<Power>> {
    agreed(model).unwrap_or_else(|| {
        // One number stands before terms of several orders: under a law it keeps its own unit, as its companions must then.
        let lawful = model.equations.iter().flat_map(|e| &e.terms).any(|(_, _, c)| c.powers.len() > 1);
        (0..model.coordinates.len()).map(|j| if lawful { None } else { power(model, j) }).collect()
    })
}

/// Whether the number of a coefficient is moved as a power of time; one that is held keeps it, a ratio has none.
fn moves(model: &FreeModel, coefficient: usize) -> bool {
    matches!(model.coordinates[coefficient], Coordinate::Plain | Coordinate::Logarithm)
}

/// α − ν of the first term before which a coefficient stands alone.
fn power(model: &FreeModel, coefficient: usize) -> Option<Power> {
    if !moves(model, coefficient) {
        return None;
    }
    model.equations.iter().find_map(|equation| {
        let (_, order, _) = equation.terms.iter().find(|(_, _, c)| c.powers == [(coefficient, 1)])?;
        let mut power = between(&equation.order, order);
        let constant = power.remove(0);
        Some((constant, power))
    })
}

/// α − ν: the constant, then the weights of the free orders.
fn between(highest: &AffineOrder, order: &AffineOrder) -> Vec<f64> {
    let weights = highest.weights.iter().zip(&order.weights).map(|(a, b)| a - b);
    std::iter::once(highest.constant - order.constant).chain(weights).collect()
}

/// Powers of time on which all products of coefficients agree, by elimination; none where they contradict one another.
fn agreed(model: &FreeModel) -> Option<Vec<Option<Power>>> {
    let (count, orders) = (model.coordinates.len(), model.order_bounds.len());
    // A row says how often each coefficient stands in a product, and what power of time that is.
    let mut rows: Vec<(Vec<f64>, Vec<f64>)> = Vec::new();
    for equation in &model.equations {
        for (_, order, coefficient) in &equation.terms {
            let mut often = vec![0.0; count];
            for &(j, n) in coefficient.powers.iter().filter(|(j, _)| moves(model, *j)) {
                often[j] += f64::from(n);
            }
            if often.iter().any(|&n| n != 0.0) {
                rows.push((often, between(&equation.order, order)));
            }
        }
    }
    let mut pivots = Vec::new();
    for j in 0..count {
        let done = pivots.len();
        let Some(at) = (done..rows.len()).find(|&i| rows[i].0[j].abs() > SAME) else { continue };
        rows.swap(done, at);
        let pivot = rows[done].clone();
        for (i, (often, power)) in rows.iter_mut().enumerate() {
            // The pivot's own row is divided by what stands there.
            let by = if i == done { 1.0 - 1.0 / pivot.0[j] } else { often[j] / pivot.0[j] };
            often.iter_mut().zip(&pivot.0).for_each(|(v, p)| *v -= by * p);
            power.iter_mut().zip(&pivot.1).for_each(|(v, p)| *v -= by * p);
        }
        pivots.push(j);
    }
    if rows[pivots.len()..].iter().flat_map(|(_, power)| power).any(|v| v.abs() > SAME) {
        return None;
    }
    // What the products leave open is a number.
    let mut found: Vec<_> = (0..count).map(|j| moves(model, j).then(|| (0.0, vec![0.0; orders]))).collect();
    for ((_, mut power), j) in rows.into_iter().zip(pivots) {
        let constant = power.remove(0);
        found[j] = Some((constant, power));
    }
    Some(found)
}

//! Time in a unit of the records' own, so that no search depends on the unit in which time is told.
//!
//! Before D^ν y beside D^α y a coefficient is a time to the power of −(α − ν): moved at free orders, it means something else
//! in seconds than in minutes, and along a flat valley a search would end elsewhere. So its number in a unit between sample
//! and record is what is moved, where a resonance that the record shows is near 1 and orders are least like coefficients.

use super::experiment::Experiment;
use super::model::{Coordinate, FreeModel};

/// ln of the largest power of the unit that counts.
const LARGEST: f64 = 300.0;

/// ln of the unit of time, and of each coefficient that stands alone before a term the weights of the free orders in α − ν,
/// behind its constant; none of others, which keep their number.
#[derive(Debug, Clone)]
pub(crate) struct Clock {
    unit: f64,
    powers: Vec<Option<(f64, Vec<f64>)>>,
}

impl Clock {
    /// The unit of some experiments.
    pub(super) fn of(model: &FreeModel, experiments: &[Experiment]) -> Self {
        Self::of_spans(model, &experiments.iter().map(span).collect::<Vec<_>>())
    }

    /// The same from ln of the product of each run's sample interval and duration.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn of_spans(model: &FreeModel, spans: &[f64]) -> Self {
        // A frequency half way, in logarithms, between that of the record and Nyquist's.
        let unit = spans.iter().sum::<f64>() / (2.0 * spans.len().max(1) as f64) - libm::log(std::f64::consts::PI);
        // Under a law between coefficients one number stands before terms of several orders: it keeps its own unit, as its
        // companions must then.
        let lawful = model.equations.iter().flat_map(|e| &e.terms).any(|(_, _, c)| c.powers.len() > 1);
        let powers = (0..model.coordinates.len()).map(|j| if lawful { None } else { power(model, j) }).collect();
        Self { unit, powers }
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
        let weight = |(_, weights): &(f64, Vec<f64>)| weights.get(order).copied().unwrap_or(0.0);
        self.powers[coefficient].as_ref().map_or(0.0, weight) * self.unit
    }
}

/// ln of the product of a sample interval and the duration.
fn span(experiment: &Experiment) -> f64 {
    let (m, step) = (experiment.record.m() as f64, experiment.record.step());
    let interval = step * experiment.every as f64;
    libm::log(interval) + libm::log(m * step)
}

/// α − ν of the first term before which a coefficient stands alone.
fn power(model: &FreeModel, coefficient: usize) -> Option<(f64, Vec<f64>)> {
    if !matches!(model.coordinates[coefficient], Coordinate::Plain | Coordinate::Logarithm) {
        return None;
    }
    model.equations.iter().find_map(|equation| {
        let (_, order, _) = equation.terms.iter().find(|(_, _, c)| c.powers == [(coefficient, 1)])?;
        let weights = equation.order.weights.iter().zip(&order.weights).map(|(a, b)| a - b).collect();
        Some((equation.order.constant - order.constant, weights))
    })
}

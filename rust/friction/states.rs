//! What a run starts with, and the constant on its right-hand side, as powers of t that drive output and velocity.

use crate::equation::{Initial, Structure, ORDER_GRAIN};
use crate::kernels::power_means;

/// What drives a body besides its inputs: on the level of its output and of its velocity.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Forcing {
    /// Pulse means on the level of the output.
    pub(super) output: Vec<f64>,
    /// Pulse means on the level of the velocity.
    pub(super) velocity: Vec<f64>,
    /// The same at the ends of the pulses.
    pub(super) edges: Vec<f64>,
    /// The velocity at the start.
    pub(super) start: f64,
    /// The output at the start.
    pub(super) level: f64,
}

impl Forcing {
    pub(super) fn none(m: usize) -> Self {
        Self { output: vec![0.0; m], velocity: vec![0.0; m], edges: vec![0.0; m], start: 0.0, level: 0.0 }
    }

    /// Adds another one, weighted.
    pub(super) fn add(&mut self, weight: f64, other: &Self) {
        for (sum, part) in
            [(&mut self.output, &other.output), (&mut self.velocity, &other.velocity), (&mut self.edges, &other.edges)]
        {
            sum.iter_mut().zip(part).for_each(|(s, v)| *s += weight * v);
        }
        self.start += weight * other.start;
        self.level += weight * other.level;
    }

    /// Powers of t on the level of the output, as (exponent, coefficient), for own terms (integration, coefficient).
    ///
    /// A level x₀ at the start is integrated by the own terms, and so is the jump to it: to the velocity it is
    /// c x₀ t^{η−1}/Γ(η).
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn of(powers: &[(f64, f64)], own: &[(f64, f64)], m: usize, step: f64) -> Self {
        let mut out = Self::none(m);
        let mut rates: Vec<(f64, f64, f64)> = Vec::new();
        let mut rate = |exponent: f64, value: f64| match rates.iter_mut().find(|r| (r.0 - exponent).abs() < ORDER_GRAIN)
        {
            Some(known) => (known.1, known.2) = (known.1 + value, known.2.max(value.abs())),
            None => rates.push((exponent, value, value.abs())),
        };
        let mut level = 0.0;
        for &(exponent, value) in powers {
            if value != 0.0 {
                let means = power_means(exponent, m, step);
                out.output.iter_mut().zip(means).for_each(|(s, v)| *s += value * v);
            }
            if exponent.abs() < ORDER_GRAIN {
                level += value;
            } else {
                rate(exponent - 1.0, value * exponent);
            }
        }
        for &(eta, c) in own.iter().filter(|(eta, _)| *eta > 0.0) {
            rate(eta - 1.0, c * level / libm::tgamma(eta));
        }
        out.level = level;
        for (exponent, value, largest) in rates {
            // What a jump adds and an initial term takes away again is nothing, but for rounding.
            if value.abs() <= 1e-13 * largest {
                continue;
            }
            let means = power_means(exponent, m, step);
            out.velocity.iter_mut().zip(means).for_each(|(s, v)| *s += value * v);
            let ends = (1..=m).map(|k| libm::pow(k as f64 * step, exponent));
            out.edges.iter_mut().zip(ends).for_each(|(s, v)| *s += value * v);
            if exponent.abs() < ORDER_GRAIN {
                out.start += value;
            }
        }
        out
    }
}

/// What is free of a run's start: each a combination of powers of t.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum State {
    /// The level at which the body stood before, and moved on from.
    Level,
    /// Its velocity.
    Rate,
    /// The power of t by which a term starts whose signal did not start at 0.
    Jump {
        /// The term.
        term: usize,
        /// One more for each derivative of the signal.
        more: u32,
    },
    /// A constant on the right-hand side, or a ramp (1).
    Offset(u32),
    /// A power of t that was asked for.
    Power(f64),
}

impl State {
    /// Those of a run; `free` says of which term or of α (none) the integration moves with an order.
    pub(super) fn all(structure: &Structure, initial: &Initial, free: impl Fn(usize) -> bool) -> Vec<Self> {
        let mut all = match initial.under() {
            Initial::Rest | Initial::Offset { .. } | Initial::Filtered { .. } => Vec::new(),
            Initial::Powers(powers) => powers.iter().map(|&e| Self::Power(e)).collect(),
            Initial::Caputo => {
                let mut all = vec![Self::Level, Self::Rate];
                for (term, driver) in structure.terms.iter().enumerate().filter(|(_, t)| t.signal != structure.output) {
                    for more in (0_u32..).take_while(|&i| f64::from(i) < driver.order - ORDER_GRAIN) {
                        let exponent = structure.order - driver.order + f64::from(more);
                        let known = [0.0, 1.0].iter().any(|e: &f64| (e - exponent).abs() < ORDER_GRAIN);
                        if free(term) || !known {
                            all.push(Self::Jump { term, more });
                        }
                    }
                }
                all
            }
        };
        let offsets = initial.offset_exponents(structure.order).len();
        all.extend((0..offsets).filter_map(|i| u32::try_from(i).ok()).map(Self::Offset));
        all
    }

    /// The powers of t that a unit of it is, on the level of the output: (exponent, coefficient).
    pub(super) fn powers(self, structure: &Structure, own: &[(f64, f64)]) -> Vec<(f64, f64)> {
        match self {
            // Caputo's derivative of a level is 0, so an own term does not see it unless its order is 0.
            Self::Level => std::iter::once((0.0, 1.0))
                .chain(
                    own.iter()
                        .filter(|(eta, _)| *eta < structure.order - ORDER_GRAIN)
                        .map(|&(eta, c)| (eta, -c / libm::tgamma(eta + 1.0))),
                )
                .collect(),
            Self::Rate => std::iter::once((1.0, 1.0))
                .chain(
                    own.iter()
                        .filter(|(eta, _)| *eta < structure.order - 1.0 - ORDER_GRAIN)
                        .map(|&(eta, c)| (eta + 1.0, -c / libm::tgamma(eta + 2.0))),
                )
                .collect(),
            Self::Jump { term, more } => {
                vec![(structure.order - structure.terms[term].order + f64::from(more), 1.0)]
            }
            Self::Offset(more) => vec![(structure.order + f64::from(more), 1.0)],
            Self::Power(exponent) => vec![(exponent, 1.0)],
        }
    }
}

/// Powers of t of several states together, equal exponents merged.
pub(super) fn together(parts: impl IntoIterator<Item = (f64, f64)>) -> Vec<(f64, f64)> {
    let mut out: Vec<(f64, f64)> = Vec::new();
    for (exponent, value) in parts {
        match out.iter_mut().find(|known| (known.0 - exponent).abs() < ORDER_GRAIN) {
            Some(known) => known.1 += value,
            None => out.push((exponent, value)),
        }
    }
    out.sort_by(|a, b| a.0.total_cmp(&b.0));
    out
}

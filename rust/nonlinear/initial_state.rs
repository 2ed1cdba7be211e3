//! Initial states and constant forces of a run, as powers of t in outputs and velocities.

use super::channels::uses_output_means;
use crate::equation::{Equation, Initial, ORDER_GRAIN};
use crate::error::{Error, Result};
use crate::fractional::kernels::{kernel, power_means};
use crate::linalg::small;
use crate::regressors::is_impulse;

/// Coupling term: term of an equation whose signal is a simulated output.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Link {
    /// Index of the equation that simulates the signal.
    pub(super) output: usize,
    pub(super) order: f64,
    /// Integration order: order α of the equation minus order of the term.
    pub(super) integration: f64,
    pub(super) coefficient: f64,
}

/// Effect of initial terms on outputs and on velocities at the ends of pulses. Every field has one entry per output.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct EndVelocityForcing {
    /// Contribution of the initial terms to the velocity of each output at the end of each pulse, minus the initial
    /// velocity.
    pub(super) velocities: Vec<Vec<f64>>,
    /// Velocity of each output at t = 0.
    pub(super) initial_velocities: Vec<f64>,
    /// Value of each output at t = 0.
    pub(super) initial_outputs: Vec<f64>,
}

impl EndVelocityForcing {
    /// Return the effect of powers of t in the outputs. `powers` holds (exponent, coefficient) of each power, by
    /// equation, and `links` the coupling terms of each equation.
    ///
    /// A coupling term with coefficient c and integration order η integrates the initial level x₀ of its signal,
    /// including the jump to that level. It adds c x₀ t^{η−1}/Γ(η) to the velocity. An initial velocity v₀ of the
    /// signal adds c v₀ t^η/Γ(η + 1).
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a power whose derivative has no finite mean over the first pulse;
    /// [`Error::LeadingZero`] if the initial levels or velocities are not determined by the equations.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn new(powers: &[Vec<(f64, f64)>], links: &[Vec<Link>], m: usize, step: f64) -> Result<Self> {
        let n = powers.len();
        let constant =
            |terms: &Vec<(f64, f64)>| terms.iter().filter(|p| p.0.abs() < ORDER_GRAIN).map(|p| p.1).sum::<f64>();
        let initial_outputs = solve_feedthrough(&powers.iter().map(constant).collect::<Vec<f64>>(), links)?;
        let mut rates = vec![PowerSum::default(); n];
        for (i, terms) in powers.iter().enumerate() {
            for &(exponent, value) in terms.iter().filter(|power| power.0.abs() >= ORDER_GRAIN) {
                rates[i].add(exponent - 1.0, value * exponent);
            }
            for link in links[i].iter().filter(|link| link.integration.abs() >= ORDER_GRAIN) {
                let eta = link.integration;
                rates[i].add(eta - 1.0, link.coefficient * initial_outputs[link.output] / libm::tgamma(eta));
            }
            if let Some((exponent, _)) = rates[i].powers().find(|power| power.0 <= -1.0) {
                return Err(Error::OutOfRange {
                    name: "exponent of an initial term".into(),
                    value: exponent + 1.0,
                    range: "(0, ∞) or 0".into(),
                    remedy: "the initial value of a signal that is differentiated more often than the order of its equation \
                             requires that term's power of t as well; start at rest, or estimate the initial conditions"
                        .into(),
                });
            }
        }
        let constants: Vec<f64> =
            rates.iter().map(|terms| terms.powers().filter(|p| p.0.abs() < ORDER_GRAIN).map(|p| p.1).sum()).collect();
        let initial_velocities = solve_feedthrough(&constants, links)?;
        let mut velocities = vec![vec![0.0; m]; n];
        for (i, terms) in rates.iter_mut().enumerate() {
            terms.add(0.0, -initial_velocities[i]);
            for link in &links[i] {
                let eta = link.integration;
                terms.add(eta, link.coefficient * initial_velocities[link.output] / libm::tgamma(eta + 1.0));
            }
            for (exponent, value) in terms.powers() {
                let ends = (1..=m).map(|k| libm::pow(k as f64 * step, exponent));
                velocities[i].iter_mut().zip(ends).for_each(|(s, v)| *s += value * v);
            }
        }
        Ok(Self { velocities, initial_velocities, initial_outputs })
    }
}

/// Sum of powers of t with distinct exponents: (exponent, coefficient, largest magnitude of an added coefficient).
#[derive(Debug, Clone, Default)]
pub(super) struct PowerSum(Vec<(f64, f64, f64)>);

impl PowerSum {
    pub(super) fn add(&mut self, exponent: f64, value: f64) {
        match self.0.iter_mut().find(|r| (r.0 - exponent).abs() < ORDER_GRAIN) {
            Some(power) => (power.1, power.2) = (power.1 + value, power.2.max(value.abs())),
            None => self.0.push((exponent, value, value.abs())),
        }
    }

    /// Iterate over the powers as (exponent, coefficient). Powers that cancel up to rounding are omitted.
    pub(super) fn powers(&self) -> impl Iterator<Item = (f64, f64)> + '_ {
        self.0.iter().filter(|r| r.1.abs() > 1e-13 * r.2).map(|r| (r.0, r.1))
    }
}

/// Return the powers of t in the derivative D^ρ of an equation's output as (exponent, coefficient). `order` is ρ, and
/// `powers` holds the powers of t in every output. Return an error if the derivative has no mean over the first pulse.
///
/// D^ρ I^η y equals I^η D^ρ y plus powers of t with coefficients from y(0), y′(0), …. These powers are added for terms
/// that enter as I^η D^ρ y (`uses_output_means`). They cancel against those in the initial terms of Caputo
/// derivatives.
pub(super) fn derivative_powers(
    equation: usize,
    order: f64,
    links: &[Vec<Link>],
    powers: &[Vec<(f64, f64)>],
) -> Result<Vec<(f64, f64)>> {
    let mut sum = PowerSum::default();
    powers[equation].iter().for_each(|&(exponent, value)| sum.add(exponent, value));
    let mut integer_order = 0.0;
    while integer_order < order - ORDER_GRAIN {
        let coefficient_at = |terms: &Vec<(f64, f64)>| -> f64 {
            terms.iter().filter(|p| (p.0 - integer_order).abs() < ORDER_GRAIN).map(|p| p.1).sum()
        };
        let constants: Vec<f64> = powers.iter().map(coefficient_at).collect();
        let initial_outputs = solve_feedthrough(&constants, links)?;
        let integrates_derivative =
            |link: &&Link| link.integration.abs() >= ORDER_GRAIN && !uses_output_means(link.integration, order);
        for link in links[equation].iter().filter(integrates_derivative) {
            let exponent = link.integration + integer_order;
            let value = initial_outputs[link.output] * libm::tgamma(integer_order + 1.0);
            sum.add(exponent, link.coefficient * value / libm::tgamma(exponent + 1.0));
        }
        integer_order += 1.0;
    }
    let mut out = Vec::new();
    for (exponent, value) in sum.powers() {
        if order < ORDER_GRAIN {
            out.push((exponent, value));
            continue;
        }
        let is_integer = (exponent - exponent.round()).abs() < ORDER_GRAIN;
        if value == 0.0 || (is_integer && exponent < order - ORDER_GRAIN) {
            continue;
        }
        if exponent - order <= -1.0 {
            return Err(Error::OutOfRange {
                name: "exponent of an initial term".into(),
                value: exponent,
                range: format!("above {}, or 0, 1, …", order - 1.0),
                remedy: "the derivative in a non-linear term has no mean over the first pulse".into(),
            });
        }
        let scale = libm::tgamma(exponent + 1.0) / libm::tgamma(exponent - order + 1.0);
        out.push((exponent - order, value * scale));
    }
    Ok(out)
}

/// Return `m` pulse means of t^e, where e is `exponent`. For e < 0 they are Γ(e + 1) times the derivative of order −e
/// of a unit step.
pub(super) fn power_term_means(exponent: f64, m: usize, step: f64) -> Vec<f64> {
    if exponent >= 0.0 {
        return power_means(exponent, m, step);
    }
    let (mut sum, scale) = (0.0, libm::tgamma(exponent + 1.0));
    let cumulative = |v: f64| {
        sum += v;
        scale * sum
    };
    kernel(exponent, m, step).into_iter().map(cumulative).collect()
}

/// Solve x = `constants` + C x for the initial outputs or velocities x of all equations. C holds the coefficients of
/// the terms with direct feedthrough (integration order 0). Return an error if the equations do not determine x.
pub(super) fn solve_feedthrough(constants: &[f64], links: &[Vec<Link>]) -> Result<Vec<f64>> {
    let n = constants.len();
    if !links.iter().flatten().any(|link| link.integration.abs() < ORDER_GRAIN) {
        return Ok(constants.to_vec());
    }
    let mut matrix = vec![0.0; n * n];
    for (i, row) in links.iter().enumerate() {
        matrix[i * n + i] += 1.0;
        for link in row.iter().filter(|link| link.integration.abs() < ORDER_GRAIN) {
            matrix[i * n + link.output] -= link.coefficient;
        }
    }
    let inverse = small::inverse(&matrix, n)?;
    Ok((0..n).map(|i| (0..n).map(|j| inverse[i * n + j] * constants[j]).sum()).collect())
}

/// Free initial state of a run, which adds powers of t to the outputs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum InitialTerm {
    /// Initial level of the output of the equation with this index.
    Level(usize),
    /// Initial velocity of the output of the equation with this index.
    Rate(usize),
    /// Power of t that is due to the initial value of an input, or of a derivative of it.
    Jump {
        /// Indices of the equation and of the term in it.
        term: (usize, usize),
        /// Order of the derivative of the input whose initial value enters: 0 for the input itself.
        derivative_order: u32,
    },
    /// Constant (0) or ramp (1) on the right-hand side of the equation with the first index.
    Offset(usize, u32),
    /// Explicit exponent of t in the output of the equation with this index. The exponents −1, −2, … denote an impulse,
    /// and derivatives of an impulse, at the sensor filter of the output.
    Power(usize, f64),
    /// Level that is added to the samples of the output of the equation with this index, and does not enter the
    /// equations. The exponent ∞ marks it, because the power t^0 is an initial value of the equation.
    OutputLevel(usize),
}

impl InitialTerm {
    /// Return the initial states of a run.
    ///
    /// `free(i, k)` is true if the integration order of term k of equation i depends on a free order. `filtered` flags
    /// the outputs with a sensor filter, whose transients are additional states. It is empty without filters.
    pub(super) fn all(
        equations: &[Equation],
        initial: &Initial,
        filtered: &[bool],
        free: impl Fn(usize, usize) -> bool,
    ) -> Vec<Self> {
        let is_simulated = |signal: usize| equations.iter().any(|e| e.structure.output == signal);
        let mut all: Vec<Self> = Vec::new();
        for (i, Equation { structure, .. }) in equations.iter().enumerate() {
            match initial.base() {
                Initial::Rest | Initial::Offset { .. } | Initial::Level { .. } | Initial::Filtered { .. } => {}
                Initial::Powers(powers) => all.extend(powers.iter().map(|&e| Self::Power(i, e))),
                Initial::Caputo => {
                    all.push(Self::Level(i));
                    if structure.order > 1.0 + ORDER_GRAIN {
                        all.push(Self::Rate(i));
                    }
                    for (term, input) in structure.terms.iter().enumerate().filter(|(_, t)| !is_simulated(t.signal)) {
                        for derivative_order in (0_u32..).take_while(|&k| f64::from(k) < input.order - ORDER_GRAIN) {
                            let exponent = structure.order - input.order + f64::from(derivative_order);
                            let is_represented = [0.0, 1.0].iter().any(|e: &f64| (e - exponent).abs() < ORDER_GRAIN);
                            if free(i, term) || !is_represented {
                                all.push(Self::Jump { term: (i, term), derivative_order });
                            }
                        }
                    }
                }
            }
        }
        for (i, Equation { structure, .. }) in equations.iter().enumerate() {
            let offsets = initial.offset_exponents(structure.order).len();
            all.extend((0..offsets).filter_map(|k| u32::try_from(k).ok()).map(|k| Self::Offset(i, k)));
        }
        if initial.has_level() {
            all.extend((0..equations.len()).map(Self::OutputLevel));
        }
        for i in (0..equations.len()).filter(|&i| filtered.get(i).is_some_and(|&is_filtered| is_filtered)) {
            all.extend(initial.impulses().map(|e| Self::Power(i, e)));
        }
        all
    }

    /// True if the state affects only the sensor filter of an output.
    pub(super) fn is_impulse(&self) -> bool {
        matches!(self, Self::Power(_, e) if is_impulse(*e))
    }

    /// Return the powers of t in the outputs per unit of this state, as (equation, exponent, coefficient).
    pub(super) fn powers(self, equations: &[Equation], links: &[Vec<Link>]) -> Vec<(usize, f64, f64)> {
        // Caputo derivatives of a constant are zero, so only terms of order 0 respond to a level.
        let powers_of_value = |output: usize, degree: f64| {
            let mut powers = vec![(output, degree, 1.0)];
            for (i, row) in links.iter().enumerate() {
                for link in row.iter().filter(|link| link.output == output && link.order > degree + ORDER_GRAIN) {
                    let exponent = link.integration + degree;
                    powers.push((i, exponent, -link.coefficient / libm::tgamma(exponent + 1.0)));
                }
            }
            powers
        };
        match self {
            Self::Level(i) => powers_of_value(i, 0.0),
            Self::Rate(i) => powers_of_value(i, 1.0),
            Self::Jump { term: (i, term), derivative_order } => {
                let structure = &equations[i].structure;
                vec![(i, structure.order - structure.terms[term].order + f64::from(derivative_order), 1.0)]
            }
            Self::Offset(i, degree) => vec![(i, equations[i].structure.order + f64::from(degree), 1.0)],
            Self::Power(i, exponent) => vec![(i, exponent, 1.0)],
            Self::OutputLevel(i) => vec![(i, f64::INFINITY, 1.0)],
        }
    }
}

/// Sum powers of t, given as (equation, exponent, coefficient), by equation and exponent. Return (exponent,
/// coefficient) for each of `n` equations, with ascending exponents.
pub(super) fn merge_powers(n: usize, parts: impl IntoIterator<Item = (usize, f64, f64)>) -> Vec<Vec<(f64, f64)>> {
    let mut out: Vec<Vec<(f64, f64)>> = vec![Vec::new(); n];
    for (i, exponent, value) in parts {
        match out[i].iter_mut().find(|power| (power.0 - exponent).abs() < ORDER_GRAIN) {
            Some(power) => power.1 += value,
            None => out[i].push((exponent, value)),
        }
    }
    out.iter_mut().for_each(|terms| terms.sort_by(|a, b| a.0.total_cmp(&b.0)));
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn initial_values_have_the_powers_of_caputo_derivatives() -> Result<()> {
        // D² y = −0.7 D^1.7 y from y = 3 + 2 t: y is 3 + 2 t plus −0.7 I^0.3 (y − 3), whose 3 t^0.3 cancels in D y.
        let links = vec![vec![Link { output: 0, order: 1.7, integration: 0.3, coefficient: -0.7 }]];
        let taken = 0.7 * 3.0 / libm::tgamma(1.3);
        let powers = vec![vec![(0.0, 3.0), (1.0, 2.0), (0.3, taken)]];
        assert_eq!(derivative_powers(0, 1.0, &links, &powers)?, [(0.0, 2.0)]);
        // D^0.5 y is computed from y, of which the term differentiates the jump to 3 as well.
        let half = derivative_powers(0, 0.5, &links, &powers)?;
        assert!(half.len() == 2 && (half[0].0 - 0.5).abs() < 1e-12 && (half[1].0 + 0.2).abs() < 1e-12);
        assert!((half[0].1 - 2.0 / libm::tgamma(1.5)).abs() < 1e-12);
        assert!((half[1].1 - taken * libm::tgamma(1.3) / libm::tgamma(0.8)).abs() < 1e-12);
        assert_eq!(derivative_powers(0, 0.0, &links, &powers)?.len(), 3);
        Ok(())
    }
}

//! What is estimated: equations whose orders and coefficients follow from free ones, free numbers of inputs,
//! coordinates, bounds.

use super::experiment::Experiment;
use super::input::FreeInput;
use super::stability::grows;
use crate::equation::{AffineOrder, Initial, Structure, Term};
use crate::error::{check_length, Error, Result};
use crate::regressors::Record;
use crate::simulate::nyquist_margin;

/// In which coordinate a coefficient is estimated: scales decide whether the optimum is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coordinate {
    /// As it is.
    Plain,
    /// ln|c|, the sign of the start kept.
    Logarithm,
    /// ln(c − 1), for a ratio that exceeds 1.
    ExcessLogarithm,
    /// It stays where it starts, as an order or a delay does between two equal bounds.
    Held,
}

/// Logarithm of the share of its start to which a coefficient that keeps its sign may fall.
const VANISHED: f64 = 20.0;

impl Coordinate {
    /// Whether a coefficient of this value can be moved in its coordinate.
    pub(crate) fn holds(self, value: f64) -> bool {
        match self {
            Self::Plain | Self::Held => value.is_finite(),
            Self::Logarithm => value != 0.0 && value.is_finite(),
            Self::ExcessLogarithm => value > 1.0 && value.is_finite(),
        }
    }

    /// A coefficient moved by `delta` in its coordinate.
    pub(crate) fn shifted(self, value: f64, delta: f64) -> f64 {
        // A factor of e^5 in one step has left the region in which the linearisation means anything.
        let bounded = delta.clamp(-5.0, 5.0);
        match self {
            Self::Plain => value + delta,
            Self::Logarithm => value * libm::exp(bounded),
            Self::ExcessLogarithm => 1.0 + (value - 1.0) * libm::exp(bounded),
            Self::Held => value,
        }
    }

    /// How far a coefficient may fall in its coordinate, from its start on: none of its terms shows any more behind that,
    /// and a descent would go on towards 0 for ever.
    pub(crate) fn room(self, value: f64, start: f64) -> f64 {
        match self {
            Self::Logarithm => libm::log(value / start) + VANISHED,
            Self::Plain | Self::ExcessLogarithm | Self::Held => f64::INFINITY,
        }
    }

    /// Derivative of a coefficient with respect to its coordinate.
    pub(crate) fn stretch(self, value: f64) -> f64 {
        match self {
            Self::Plain => 1.0,
            Self::Logarithm => value,
            Self::ExcessLogarithm => value - 1.0,
            Self::Held => 0.0,
        }
    }
}

/// A signed product of powers of coefficients: factor·Π c_i^{n_i}.
#[derive(Debug, Clone, PartialEq)]
pub struct Monomial {
    /// Known factor.
    pub factor: f64,
    /// Free coefficients and their powers.
    pub powers: Vec<(usize, i32)>,
}

impl Monomial {
    pub(crate) fn at(&self, coefficients: &[f64]) -> f64 {
        self.powers.iter().fold(self.factor, |product, &(i, n)| product * coefficients[i].powi(n))
    }

    /// Derivative with respect to coefficient i.
    pub(crate) fn slope(&self, coefficients: &[f64], i: usize) -> f64 {
        let Some(&(_, n)) = self.powers.iter().find(|&&(j, _)| j == i) else { return 0.0 };
        let rest = self.powers.iter().filter(|&&(j, _)| j != i);
        let others = rest.fold(self.factor, |product, &(j, k)| product * coefficients[j].powi(k));
        others * f64::from(n) * coefficients[i].powi(n - 1)
    }
}

/// One equation whose orders and coefficients follow from shared free ones.
#[derive(Debug, Clone, PartialEq)]
pub struct FreeEquation {
    /// Index of the output in the record.
    pub output: usize,
    /// α.
    pub order: AffineOrder,
    /// Signal, order and coefficient of each term.
    pub terms: Vec<(usize, AffineOrder, Monomial)>,
}

/// Values of all that is free.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Point {
    /// Free orders.
    pub orders: Vec<f64>,
    /// Free coefficients.
    pub coefficients: Vec<f64>,
    /// Free numbers of inputs: delays, limits.
    pub inputs: Vec<f64>,
}

/// What is estimated.
#[derive(Debug, Clone, PartialEq)]
pub struct FreeModel {
    /// The equations.
    pub equations: Vec<FreeEquation>,
    /// Bounds of each free order.
    pub order_bounds: Vec<(f64, f64)>,
    /// Coordinate of each free coefficient.
    pub coordinates: Vec<Coordinate>,
    /// What is free of inputs, one number of an input at most.
    pub inputs: Vec<FreeInput>,
    /// Whether the equations' outputs drive each other as simulated, or as measured.
    pub coupled: bool,
    /// Initial terms of each record.
    pub initial: Initial,
}

/// Least response of the divisor at Nyquist's frequency, as a share of its leading coefficient, that a step may end at.
const RESOLVED: f64 = 0.02;

impl FreeModel {
    /// Refuses a model that these experiments cannot tell anything about.
    ///
    /// # Errors
    /// [`Error::Structure`] for a signal or a coefficient that is not there, a delay of what is no input, or bounds that
    /// do not rise; [`Error::Length`] for experiments or weights of other lengths.
    pub fn check(&self, experiments: &[Experiment]) -> Result<()> {
        let Some(signals) = experiments.iter().map(|e| e.record.len()).min() else {
            return Err(Error::Length { name: "experiments".into(), expected: 1, found: 0 });
        };
        let refuse = |what: String, remedy: &str| Err(Error::Structure { what, remedy: remedy.into() });
        let (orders, coefficients) = (self.order_bounds.len(), self.coordinates.len());
        for equation in &self.equations {
            let missing = |(signal, _, c): &(usize, AffineOrder, Monomial)| {
                *signal >= signals || c.powers.iter().any(|&(i, _)| i >= coefficients)
            };
            if equation.output >= signals || equation.terms.iter().any(missing) {
                let what = "an equation names a signal or a coefficient that is not there".to_owned();
                return refuse(what, "number them from 0");
            }
            for (_, order, _) in &equation.terms {
                check_length("weights of an order", orders, order.weights.len())?;
            }
        }
        for (k, &FreeInput { signal, bounds: (low, high), .. }) in self.inputs.iter().enumerate() {
            if signal >= signals || self.equations.iter().any(|e| e.output == signal) {
                let what = format!("signal {signal} has a free delay or limit and is no input");
                return refuse(what, "delay and limit inputs only");
            }
            if self.law_of(signal) != Some(k) {
                return refuse(format!("signal {signal} has two free numbers"), "free one of an input");
            }
            if !(0.0 <= low && low <= high && high.is_finite()) {
                return refuse(format!("bounds {low} to {high} of a delay or limit"), "give two rising values from 0");
            }
        }
        if let Some((low, high)) =
            self.order_bounds.iter().find(|(low, high)| low.is_nan() || high.is_nan() || low > high)
        {
            return refuse(format!("bounds {low} to {high} of an order"), "give two rising orders");
        }
        for experiment in experiments {
            experiment.check()?;
            check_length("outputs", self.equations.len(), experiment.samples.len())?;
            if experiment.own.is_some() && !self.inputs.is_empty() {
                let what = "a free delay or limit with samples at times of their own".to_owned();
                return refuse(what, "give its value, or samples at regular times");
            }
        }
        self.initial.check()
    }

    /// Place of a signal's law among the free ones, if it has one.
    pub(crate) fn law_of(&self, signal: usize) -> Option<usize> {
        self.inputs.iter().position(|d| d.signal == signal)
    }

    /// Pulse means of an input once it acts, and their derivative with respect to the number of its law.
    pub(crate) fn acted(&self, record: &Record, input: FreeInput, value: f64) -> Result<(Vec<f64>, Vec<f64>)> {
        let means = record.signal(input.signal);
        let before = if self.initial.at_rest() { 0.0 } else { means.first().copied().unwrap_or(0.0) };
        input.law.acted(means, value, record.step(), before)
    }

    pub(crate) fn structures(&self, orders: &[f64]) -> Vec<Structure> {
        self.equations
            .iter()
            .map(|e| Structure {
                output: e.output,
                order: raw(&e.order, orders),
                terms: e.terms.iter().map(|(s, o, _)| Term { signal: *s, order: raw(o, orders) }).collect(),
            })
            .collect()
    }

    /// Exponents of the initial terms of equation i, of a structure of it, on an experiment: of impulses only where its
    /// output passes a filter that may still have held something.
    pub(crate) fn exponents(&self, experiment: &Experiment, i: usize, structure: &Structure) -> Vec<f64> {
        structure.initial_exponents(if experiment.behind_filter(i) { &self.initial } else { self.initial.unfiltered() })
    }

    /// The unknown that a signal of equation i is, if it is one.
    pub(crate) fn unknown(&self, i: usize, signal: usize) -> Option<usize> {
        if self.coupled {
            self.equations.iter().position(|e| e.output == signal)
        } else {
            (signal == self.equations[i].output).then_some(i)
        }
    }

    /// Order of each equation, and coefficients and orders of its own terms.
    fn own_terms(&self, point: &Point) -> Vec<(f64, Vec<(f64, f64)>)> {
        let own = |(structure, equation): (&Structure, &FreeEquation)| {
            let terms = structure.terms.iter().zip(&equation.terms);
            let own = terms.filter(|(term, _)| term.signal == structure.output);
            (structure.order, own.map(|(term, (_, _, c))| (c.at(&point.coefficients), term.order)).collect())
        };
        self.structures(&point.orders).iter().zip(&self.equations).map(own).collect()
    }

    /// Whether the free run of an equation grows, as far as equations stand alone.
    pub(crate) fn grows(&self, point: &Point) -> bool {
        let alone = !self.coupled || self.equations.len() == 1;
        alone && self.own_terms(point).iter().any(|(order, own)| grows(*order, own))
    }

    /// Whether every grid sees what the own terms of each equation do, as far as equations stand alone.
    ///
    /// At Nyquist's frequency the divisor is [`nyquist_margin`] beside its leading coefficient: negative, the scheme has
    /// a mode that grows from pulse to pulse; near 0, one that hardly decays. A fit would follow noise with it.
    pub(crate) fn resolved(&self, experiments: &[Experiment], point: &Point) -> bool {
        if self.coupled && self.equations.len() > 1 {
            return true;
        }
        self.own_terms(point).iter().all(|(order, terms)| {
            let own: Vec<(f64, f64)> = terms.iter().map(|(c, nu)| (*c, order - nu)).collect();
            experiments.iter().all(|experiment| {
                let h = experiment.record.step();
                let first = |&(c, eta): &(f64, f64)| c * libm::pow(h, eta) / libm::tgamma(eta + 2.0);
                let leading = 1.0 - own.iter().map(first).sum::<f64>();
                nyquist_margin(&own, h) / leading >= RESOLVED
            })
        })
    }
}

/// An affine order without rounding to the grain: it moves continuously here.
fn raw(law: &AffineOrder, free: &[f64]) -> f64 {
    law.constant + law.weights.iter().zip(free).map(|(w, x)| w * x).sum::<f64>()
}

//! What is estimated: equations whose orders and coefficients follow from free ones, free numbers of inputs,
//! coordinates, bounds.
//!
//! What an actuator does to an input before it drives an equation: a delay, a saturation, a dead zone, its number free.
//!
//! Time in a unit of the records' own, so that no search depends on the unit in which time is told.
//!
//! Before D^ν y beside D^α y a coefficient is a time to the power of −(α − ν): moved at free orders, it means something else
//! in seconds than in minutes, and along a flat valley a search would end elsewhere. So its number in a unit between sample
//! and record is what is moved, where a resonance that the record shows is near 1 and orders are least like coefficients.

use super::experiment::Experiment;
use super::stability::grows;
use crate::equation::{AffineOrder, Initial, Structure, Term};
use crate::error::{check_length, Error, Result};
use crate::regressors::Record;
use crate::signal::block_pulse::delayed;
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

/// How an input acts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputLaw {
    /// Later, by a time \[s\].
    Delay,
    /// No further than a limit on either side of 0, in the input's unit.
    Saturation,
    /// By what exceeds a threshold on either side of 0, in the input's unit.
    DeadZone,
}

/// The free number of an input's law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FreeInput {
    /// Index of the input in the record; no equation's output.
    pub signal: usize,
    /// How it acts.
    pub law: InputLaw,
    /// Least and largest value: \[s\] of a delay, else in the input's unit.
    pub bounds: (f64, f64),
}

impl InputLaw {
    /// Pulse means of an input once it acts, and their derivative with respect to the number of its law.
    ///
    /// A delay shifts held inputs exactly, one that is linear in between to second order in the step; its derivative is
    /// that towards longer delays where it is a whole number of steps. A limit bends every pulse by itself, which is
    /// exact for what holds in between.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a number that is negative or none.
    ///
    /// ```
    /// use ftlm::estimation::output_error::InputLaw;
    /// # fn main() -> ftlm::error::Result<()> {
    /// let (means, slope) = InputLaw::Saturation.acted(&[0.5, 2.0, -3.0], 1.5, 0.1, 0.0)?;
    /// assert_eq!((means, slope), (vec![0.5, 1.5, -1.5], vec![0.0, 1.0, -1.0]));
    /// let (means, slope) = InputLaw::DeadZone.acted(&[0.5, 2.0, -3.0], 1.5, 0.1, 0.0)?;
    /// assert_eq!((means, slope), (vec![0.0, 0.5, -1.5], vec![0.0, -1.0, 1.0]));
    /// # Ok(())
    /// # }
    /// ```
    pub fn acted(self, means: &[f64], value: f64, step: f64, before: f64) -> Result<(Vec<f64>, Vec<f64>)> {
        if !(value >= 0.0 && value.is_finite()) {
            return Err(Error::OutOfRange {
                name: "number of an input".into(),
                value,
                range: "[0, ∞)".into(),
                remedy: "an input acts after it is given, and alike on both sides of 0".into(),
            });
        }
        let beyond = |v: f64| if v.abs() > value { v.signum() } else { 0.0 };
        Ok(match self {
            Self::Delay => {
                let steps = value / step;
                let whole = steps.floor();
                let (near, far) = (delayed(means, whole, before)?, delayed(means, whole + 1.0, before)?);
                let slope = near.iter().zip(&far).map(|(near, far)| (far - near) / step).collect();
                (delayed(means, steps, before)?, slope)
            }
            Self::Saturation => means.iter().map(|&v| (v.clamp(-value, value), beyond(v))).unzip(),
            Self::DeadZone => means
                .iter()
                .map(|&v| {
                    let side = beyond(v);
                    (if side == 0.0 { 0.0 } else { v - value * side }, -side)
                })
                .unzip(),
        })
    }
}

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

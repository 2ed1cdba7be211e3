//! Equations over numbered signals whose orders and coefficients go by names.
//!
//! Orders as affine functions of named free ones.
//!
//! What is free in a joint fit, by name: structures that lose terms, orders and coefficients on the way to simpler ones.

use std::collections::{BTreeMap, BTreeSet};

use crate::equation::{alpha_fits, tidy, AffineOrder, Initial};
use crate::error::{Error, Result};
use crate::estimation::output_error::FreeInput;
use crate::fractional::kernels::{MAX_EXCESS, MIN_INPUT_ORDER};

/// Orders closer than this are one order.
const GRAIN: f64 = 1e-9;

/// A coefficient: to be estimated, or a number.
#[derive(Debug, Clone, PartialEq)]
pub enum Coefficient {
    /// Its name.
    Free(String),
    /// Its value.
    Known(f64),
}

impl Coefficient {
    /// Its name where it is free.
    #[must_use]
    pub fn name(&self) -> Option<&String> {
        match self {
            Self::Free(name) => Some(name),
            Self::Known(_) => None,
        }
    }

    fn with(&self, values: &BTreeMap<String, f64>) -> Self {
        self.name().and_then(|name| values.get(name)).map_or_else(|| self.clone(), |&value| Self::Known(value))
    }
}

/// factor · coefficient · D^order signal.
#[derive(Debug, Clone, PartialEq)]
pub struct Term {
    /// Index of the signal.
    pub signal: usize,
    /// ν.
    pub order: Order,
    /// The coefficient.
    pub coefficient: Coefficient,
    /// Its known factor.
    pub factor: f64,
}

impl Term {
    /// factor · coefficient, where that is known.
    #[must_use]
    pub fn fixed(&self) -> Option<f64> {
        match self.coefficient {
            Coefficient::Known(value) => Some(self.factor * value),
            Coefficient::Free(_) => None,
        }
    }
}

/// Friction of an equation's own output: fc, fs and vs as a factor times a coefficient.
#[derive(Debug, Clone, PartialEq)]
pub struct Rubs {
    /// fc.
    pub coulomb: (f64, Coefficient),
    /// fs; 0 where it does not fall with speed.
    pub stribeck: (f64, Coefficient),
    /// vs.
    pub speed: (f64, Coefficient),
}

impl Rubs {
    pub(super) fn numbers(&self) -> [&(f64, Coefficient); 3] {
        [&self.coulomb, &self.stribeck, &self.speed]
    }
}

/// D^order output = Σ terms.
#[derive(Debug, Clone, PartialEq)]
pub struct Equation {
    /// Index of the output.
    pub output: usize,
    /// α.
    pub order: Order,
    /// The right-hand side.
    pub terms: Vec<Term>,
    /// Friction of the output's velocity, if there is some.
    pub friction: Option<Rubs>,
}

impl Equation {
    /// Free coefficients in order of appearance, those of friction last.
    pub fn coefficient_names(&self) -> impl Iterator<Item = &String> {
        let rubs = self.friction.iter().flat_map(|rubs| rubs.numbers()).filter_map(|(_, number)| number.name());
        self.terms.iter().filter_map(|term| term.coefficient.name()).chain(rubs)
    }

    /// α, then the order of each term.
    pub fn orders(&self) -> impl Iterator<Item = &Order> {
        std::iter::once(&self.order).chain(self.terms.iter().map(|term| &term.order))
    }

    /// Terms of its output.
    pub fn own(&self) -> impl Iterator<Item = &Term> {
        self.terms.iter().filter(|term| term.signal == self.output)
    }

    /// Terms of other signals.
    pub fn driving(&self) -> impl Iterator<Item = &Term> {
        self.terms.iter().filter(|term| term.signal != self.output)
    }

    fn check(&self) -> Result<()> {
        let refuse = |what: String, remedy: &str| Err(Error::Structure { what, remedy: remedy.into() });
        if self.terms.is_empty() {
            return refuse(format!("the equation of output {} has no term", self.output), "add one");
        }
        if self.order.is_free() {
            return Ok(());
        }
        let alpha = self.order.constant;
        if !alpha_fits(alpha) || (self.friction.is_some() && !(alpha > 1.0 && alpha <= 2.0)) {
            return refuse(format!("order alpha = {alpha} of output {}", self.output), "choose another order");
        }
        for term in self.terms.iter().filter(|term| !term.order.is_free()) {
            let order = term.order.constant;
            let fits = if term.signal == self.output {
                (0.0..alpha).contains(&order)
            } else {
                order >= MIN_INPUT_ORDER && order < alpha + MAX_EXCESS - GRAIN
            };
            if !fits {
                let what = format!("order {order} of signal {} beside alpha = {alpha}", term.signal);
                return refuse(what, "lower it");
            }
        }
        Ok(())
    }
}

/// A free number of an input, and what it is called.
#[derive(Debug, Clone, PartialEq)]
pub struct Input {
    /// Its name, such as `delay_u`.
    pub name: String,
    /// Where it acts.
    pub free: FreeInput,
}

/// A coefficient that others give: sign · Π factors.
#[derive(Debug, Clone, PartialEq)]
pub struct Law {
    /// The coefficient.
    pub name: String,
    /// ±1.
    pub sign: f64,
    /// Names of the factors, one more than once where it stands in a power.
    pub factors: Vec<String>,
}

/// What is known of where orders lie; it tells a fit where to start, and bounds nothing.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Hints {
    /// Usual interval of highest orders.
    pub highest: Option<(f64, f64)>,
    /// Values beside the whole orders of its physics, by order.
    pub natural: BTreeMap<String, Vec<f64>>,
    /// What a ratio of the coefficient law exceeds by its physics; 1 where nothing is said.
    pub exceeds: BTreeMap<String, f64>,
    /// Coefficients that the law ties to another equation's and physics makes positive.
    pub positive: BTreeSet<String>,
    /// Values of coefficients by a physics that is nearly right.
    pub known: BTreeMap<String, f64>,
}

/// Equations with what is known about them; some orders or coefficients may be free.
#[derive(Debug, Clone, PartialEq)]
pub struct Structure {
    /// Names of the signals, for words about them.
    pub signals: Vec<String>,
    /// One for each output.
    pub equations: Vec<Equation>,
    /// Least and largest value of free orders that have been given some.
    pub bounds: BTreeMap<String, (f64, f64)>,
    /// Whether outputs drive each other as simulated, or as measured.
    pub coupled: bool,
    /// Whether an input acts later by a known time.
    pub delayed: bool,
    /// Initial terms, decided.
    pub initial: Initial,
    /// Whether their powers of time stand for what a run did before its start.
    pub history: bool,
    /// Free numbers of inputs.
    pub inputs: Vec<Input>,
    /// What ties coefficients.
    pub laws: Vec<Law>,
    /// Where orders lie.
    pub hints: Hints,
}

impl Structure {
    /// Equations driven by what was measured; nothing else is known.
    #[must_use]
    pub fn new(signals: Vec<String>, equations: Vec<Equation>, initial: Initial) -> Self {
        Self {
            signals,
            equations,
            bounds: BTreeMap::new(),
            coupled: false,
            delayed: false,
            initial,
            history: false,
            inputs: Vec::new(),
            laws: Vec::new(),
            hints: Hints::default(),
        }
    }

    /// Free orders: those that stand alone in order of appearance, then those seen only through a law.
    #[must_use]
    pub fn order_names(&self) -> Vec<String> {
        let orders = || self.equations.iter().flat_map(Equation::orders);
        let alone = orders().filter(|order| order.is_single()).flat_map(Order::names);
        unique(alone.chain(orders().flat_map(Order::names)))
    }

    /// Free coefficients.
    #[must_use]
    pub fn coefficient_names(&self) -> Vec<String> {
        self.equations.iter().flat_map(Equation::coefficient_names).cloned().collect()
    }

    /// Whether orders depend on one another: one is no plain name, or two are the same.
    #[must_use]
    pub fn has_order_law(&self) -> bool {
        let orders: Vec<_> = self.equations.iter().flat_map(Equation::orders).filter(|order| order.is_free()).collect();
        let names = unique(orders.iter().filter_map(|order| order.names().next()));
        orders.iter().any(|order| !order.is_single()) || names.len() < orders.len()
    }

    /// Whether the output of an equation may stick.
    #[must_use]
    pub fn has_friction(&self) -> bool {
        self.equations.iter().any(|equation| equation.friction.is_some())
    }

    /// Refuses orders that make no equation.
    ///
    /// # Errors
    /// [`Error::Structure`] for an equation without terms, or a number outside the range of its order.
    pub fn check(&self) -> Result<()> {
        if self.equations.is_empty() {
            return Err(Error::Structure { what: "a model without an equation".into(), remedy: "add one".into() });
        }
        self.equations.iter().try_for_each(Equation::check)
    }

    /// The same with some free orders replaced by values.
    ///
    /// # Errors
    /// Those of [`Structure::check`].
    pub fn with_orders(&self, values: &BTreeMap<String, f64>) -> Result<Self> {
        let mut out = self.clone();
        for equation in &mut out.equations {
            equation.order = equation.order.partly(values);
            equation.terms.iter_mut().for_each(|term| term.order = term.order.partly(values));
        }
        out.bounds.retain(|name, _| !values.contains_key(name));
        out.check()?;
        Ok(out)
    }

    /// The same with some free coefficients replaced by values.
    #[must_use]
    pub fn with_coefficients(&self, values: &BTreeMap<String, f64>) -> Self {
        let mut out = self.clone();
        for equation in &mut out.equations {
            equation.terms.iter_mut().for_each(|term| term.coefficient = term.coefficient.with(values));
            if let Some(rubs) = &mut equation.friction {
                for (_, number) in [&mut rubs.coulomb, &mut rubs.stribeck, &mut rubs.speed] {
                    *number = number.with(values);
                }
            }
        }
        out
    }

    /// The same with every input acting as it was given.
    #[must_use]
    pub fn without_inputs(&self) -> Self {
        Self { inputs: Vec::new(), ..self.clone() }
    }

    /// Equation number `place` with other terms, bounds of orders that are gone left out.
    #[must_use]
    pub fn with_equation(&self, place: usize, equation: Equation) -> Self {
        let mut out = self.clone();
        out.equations[place] = equation;
        let names: BTreeSet<String> = out.order_names().into_iter().collect();
        out.bounds.retain(|name, _| names.contains(name));
        out
    }
}

/// Each name once, in order of appearance.
pub(super) fn unique<'a>(names: impl Iterator<Item = &'a String>) -> Vec<String> {
    let mut seen = BTreeSet::new();
    names.filter(|name| seen.insert(*name)).cloned().collect()
}

/// A number, or an affine function of free orders.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Order {
    /// Constant part.
    pub constant: f64,
    /// Weight of each free order, names rising, without zeros.
    pub weights: Vec<(String, f64)>,
}

impl Order {
    /// A number.
    ///
    /// ```
    /// use ftlm::estimation::joint_fit::structure::Order;
    /// assert!(Order::free("alpha").is_single() && !Order::number(2.0).is_free());
    /// ```
    #[must_use]
    pub fn number(constant: f64) -> Self {
        Self { constant, weights: Vec::new() }
    }

    /// One free order.
    #[must_use]
    pub fn free(name: &str) -> Self {
        Self { constant: 0.0, weights: vec![(name.to_owned(), 1.0)] }
    }

    /// Free orders that this one depends on.
    pub fn names(&self) -> impl Iterator<Item = &String> {
        self.weights.iter().map(|(name, _)| name)
    }

    /// Whether it depends on free orders.
    #[must_use]
    pub fn is_free(&self) -> bool {
        !self.weights.is_empty()
    }

    /// Whether it is one free order and nothing else.
    #[must_use]
    pub fn is_single(&self) -> bool {
        self.constant == 0.0 && matches!(self.weights.as_slice(), [(_, 1.0)])
    }

    /// Its value where every free order has one; those that have none count 0.
    #[must_use]
    pub fn at(&self, value: impl Fn(&str) -> f64) -> f64 {
        self.constant + self.weights.iter().map(|(name, weight)| weight * value(name)).sum::<f64>()
    }

    /// The same with some free orders replaced by values.
    #[must_use]
    pub fn partly(&self, values: &BTreeMap<String, f64>) -> Self {
        let known = self.weights.iter().filter_map(|(name, weight)| values.get(name).map(|value| weight * value));
        let constant = tidy(self.constant + known.sum::<f64>());
        let weights = self.weights.iter().filter(|(name, _)| !values.contains_key(name)).cloned().collect();
        Self { constant, weights }
    }

    /// As the estimators take it, the free orders in this order.
    #[must_use]
    pub fn affine(&self, names: &[String]) -> AffineOrder {
        let weight = |name: &String| self.weights.iter().find(|(n, _)| n == name).map_or(0.0, |(_, weight)| *weight);
        AffineOrder { constant: self.constant, weights: names.iter().map(weight).collect() }
    }
}

//! Structure of a joint fit: equations over numbered signals with named orders and coefficients.

use std::collections::{BTreeMap, BTreeSet};

use crate::equation::{alpha_fits, missing_signal_error, tidy, AffineOrder, Initial};
use crate::error::{Error, Result};
use crate::estimation::output_error::FreeInput;
use crate::expression::DerivedSignal;
use crate::fractional::kernels::{MAX_EXCESS, MIN_INPUT_ORDER};

/// Difference below which two orders are equal.
const ORDER_TOLERANCE: f64 = 1e-9;

/// Coefficient of a term: free or fixed.
#[derive(Debug, Clone, PartialEq)]
pub enum Coefficient {
    /// Name of the free coefficient.
    Free(String),
    /// Value of the fixed coefficient.
    Known(f64),
}

impl Coefficient {
    /// Name of a free coefficient; None if fixed.
    #[must_use]
    pub fn name(&self) -> Option<&String> {
        match self {
            Self::Free(name) => Some(name),
            Self::Known(_) => None,
        }
    }

    fn substitute(&self, values: &BTreeMap<String, f64>) -> Self {
        self.name().and_then(|name| values.get(name)).map_or_else(|| self.clone(), |&value| Self::Known(value))
    }
}

/// Term factor · coefficient · D^order signal.
#[derive(Debug, Clone, PartialEq)]
pub struct ParametricTerm {
    /// Index of the signal.
    pub signal: usize,
    /// Order ν of the derivative.
    pub order: Order,
    /// Coefficient, free or fixed.
    pub coefficient: Coefficient,
    /// Factor of the coefficient, a given number.
    pub factor: f64,
}

impl ParametricTerm {
    /// Value of factor · coefficient if fixed; None if free.
    #[must_use]
    pub fn fixed_coefficient(&self) -> Option<f64> {
        match self.coefficient {
            Coefficient::Known(value) => Some(self.factor * value),
            Coefficient::Free(_) => None,
        }
    }
}

/// Friction parameters fc, fs and vs of the output of an equation, each a factor times a coefficient.
#[derive(Debug, Clone, PartialEq)]
pub struct FrictionParameters {
    /// Coulomb friction fc.
    pub coulomb: (f64, Coefficient),
    /// Stribeck friction fs, the excess of static over Coulomb friction; 0 without a Stribeck effect.
    pub stribeck: (f64, Coefficient),
    /// Stribeck velocity vs.
    pub speed: (f64, Coefficient),
}

impl FrictionParameters {
    pub(super) fn parameters(&self) -> [&(f64, Coefficient); 3] {
        [&self.coulomb, &self.stribeck, &self.speed]
    }
}

/// Equation D^order output = Σ terms.
#[derive(Debug, Clone, PartialEq)]
pub struct ParametricEquation {
    /// Index of the output.
    pub output: usize,
    /// Highest order α.
    pub order: Order,
    /// Terms of the right-hand side.
    pub terms: Vec<ParametricTerm>,
    /// Friction on the velocity of the output, if any.
    pub friction: Option<FrictionParameters>,
}

impl ParametricEquation {
    /// Equation D^order output = 0, to which [`Self::with_term`] adds terms.
    #[must_use]
    pub fn new(output: usize, order: Order) -> Self {
        Self { output, order, terms: Vec::new(), friction: None }
    }

    /// Add a term coefficient · D^order signal with a free coefficient of this name.
    #[must_use]
    pub fn with_term(mut self, coefficient: &str, order: Order, signal: usize) -> Self {
        self.terms.push(ParametricTerm {
            signal,
            order,
            coefficient: Coefficient::Free(coefficient.into()),
            factor: 1.0,
        });
        self
    }

    /// Names of the free coefficients in order of appearance, friction last.
    pub fn coefficient_names(&self) -> impl Iterator<Item = &String> {
        let rubs = self.friction.iter().flat_map(|rubs| rubs.parameters()).filter_map(|(_, number)| number.name());
        self.terms.iter().filter_map(|term| term.coefficient.name()).chain(rubs)
    }

    /// α, then the order of each term.
    pub fn orders(&self) -> impl Iterator<Item = &Order> {
        std::iter::once(&self.order).chain(self.terms.iter().map(|term| &term.order))
    }

    /// Terms of the output of the equation.
    pub fn autoregressive_terms(&self) -> impl Iterator<Item = &ParametricTerm> {
        self.terms.iter().filter(|term| term.signal == self.output)
    }

    /// Terms of other signals.
    pub fn input_terms(&self) -> impl Iterator<Item = &ParametricTerm> {
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
                order >= MIN_INPUT_ORDER && order < alpha + MAX_EXCESS - ORDER_TOLERANCE
            };
            if !fits {
                let what = format!("order {order} of signal {} with order alpha = {alpha} of the output", term.signal);
                return refuse(what, "lower it");
            }
        }
        Ok(())
    }
}

/// Free parameter of an input and its name.
#[derive(Debug, Clone, PartialEq)]
pub struct Input {
    /// Name of the parameter, such as `delay_u`.
    pub name: String,
    /// Kind of the parameter and its input.
    pub free: FreeInput,
}

/// Coefficient law: a coefficient that equals sign · Π factors.
#[derive(Debug, Clone, PartialEq)]
pub struct Law {
    /// Name of the coefficient.
    pub name: String,
    /// Sign, ±1.
    pub sign: f64,
    /// Names of the factors, repeated for powers.
    pub factors: Vec<String>,
}

/// Prior knowledge of orders and coefficients for initial guesses; it does not bound the fit.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Hints {
    /// Typical interval of the highest orders.
    pub highest: Option<(f64, f64)>,
    /// Typical values besides integer orders, by order name.
    pub natural: BTreeMap<String, Vec<f64>>,
    /// Physical lower bound of each ratio of the coefficient law; default 1.
    pub ratio_lower_bounds: BTreeMap<String, f64>,
    /// Coefficients that the law determines from another equation and that are positive by physics.
    pub positive: BTreeSet<String>,
    /// Approximate physical values of coefficients.
    pub known: BTreeMap<String, f64>,
}

/// Structure of a joint fit: equations, bounds, initial terms, input non-linearities and laws.
#[derive(Debug, Clone, PartialEq)]
pub struct ParametricStructure {
    /// Names of the signals, for messages: recorded ones, then derived ones.
    pub signals: Vec<String>,
    /// Signals of the non-linear terms: expressions, numbered after the recorded signals.
    pub derived: Vec<DerivedSignal>,
    /// One equation per output.
    pub equations: Vec<ParametricEquation>,
    /// Lower and upper bound of free orders, if given.
    pub bounds: BTreeMap<String, (f64, f64)>,
    /// True if outputs enter other equations as simulated; false if as measured.
    pub coupled: bool,
    /// True if an input has a fixed delay.
    pub delayed: bool,
    /// Initial terms.
    pub initial: Initial,
    /// True if the initial terms represent inputs before the start of a run.
    pub history: bool,
    /// Free parameters of the inputs.
    pub inputs: Vec<Input>,
    /// Laws between coefficients.
    pub laws: Vec<Law>,
    /// Prior knowledge for initial guesses.
    pub hints: Hints,
}

impl ParametricStructure {
    /// Structure with measured signals as inputs and no further assumptions.
    #[must_use]
    pub fn new(signals: Vec<String>, equations: Vec<ParametricEquation>, initial: Initial) -> Self {
        Self {
            signals,
            derived: Vec::new(),
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

    /// Number of recorded signals.
    #[must_use]
    pub fn recorded_count(&self) -> usize {
        self.signals.len() - self.derived.len().min(self.signals.len())
    }

    /// Names of the free orders: single ones in order of appearance, then those that occur only in a law.
    #[must_use]
    pub fn order_names(&self) -> Vec<String> {
        let orders = || self.equations.iter().flat_map(ParametricEquation::orders);
        let alone = orders().filter(|order| order.is_single()).flat_map(Order::names);
        unique(alone.chain(orders().flat_map(Order::names)))
    }

    /// Names of the free coefficients.
    #[must_use]
    pub fn coefficient_names(&self) -> Vec<String> {
        self.equations.iter().flat_map(ParametricEquation::coefficient_names).cloned().collect()
    }

    /// True if orders depend on one another: one is not a single free order, or two are the same.
    #[must_use]
    pub fn has_order_law(&self) -> bool {
        let orders: Vec<_> =
            self.equations.iter().flat_map(ParametricEquation::orders).filter(|order| order.is_free()).collect();
        let names = unique(orders.iter().filter_map(|order| order.names().next()));
        orders.iter().any(|order| !order.is_single()) || names.len() < orders.len()
    }

    /// True if an equation has friction.
    #[must_use]
    pub fn has_friction(&self) -> bool {
        self.equations.iter().any(|equation| equation.friction.is_some())
    }

    /// Check that signals have names and orders form valid equations.
    ///
    /// # Errors
    /// [`Error::Structure`] for an equation without terms, a signal that does not exist, or an order out of range.
    pub fn check(&self) -> Result<()> {
        if self.equations.is_empty() {
            return Err(Error::Structure { what: "a model without an equation".into(), remedy: "add one".into() });
        }
        let of_equation = |e: &ParametricEquation| e.terms.iter().map(|t| t.signal).chain([e.output]).max();
        let inputs = self.inputs.iter().map(|input| input.free.signal);
        let highest = self.equations.iter().filter_map(of_equation).chain(inputs).max();
        if let Some(signal) = highest.filter(|&signal| signal >= self.signals.len()) {
            return Err(missing_signal_error(signal, self.signals.len()));
        }
        let channels = self.derived.iter().flat_map(|derived| &derived.channels).map(|channel| channel.0);
        let outputs = self.equations.iter().map(|e| e.output);
        if let Some(signal) = channels.chain(outputs).find(|&signal| signal >= self.recorded_count()) {
            return Err(missing_signal_error(signal, self.recorded_count()));
        }
        self.equations.iter().try_for_each(ParametricEquation::check)
    }

    /// Return the structure with values for some free orders.
    ///
    /// # Errors
    /// [`Error::Structure`] for an order out of range ([`ParametricStructure::check`]).
    pub fn with_orders(&self, values: &BTreeMap<String, f64>) -> Result<Self> {
        let mut out = self.clone();
        for equation in &mut out.equations {
            equation.order = equation.order.substitute(values);
            equation.terms.iter_mut().for_each(|term| term.order = term.order.substitute(values));
        }
        out.bounds.retain(|name, _| !values.contains_key(name));
        out.check()?;
        Ok(out)
    }

    /// Return the structure with values for some free coefficients.
    #[must_use]
    pub fn with_coefficients(&self, values: &BTreeMap<String, f64>) -> Self {
        let mut out = self.clone();
        for equation in &mut out.equations {
            equation.terms.iter_mut().for_each(|term| term.coefficient = term.coefficient.substitute(values));
            if let Some(rubs) = &mut equation.friction {
                for (_, number) in [&mut rubs.coulomb, &mut rubs.stribeck, &mut rubs.speed] {
                    *number = number.substitute(values);
                }
            }
        }
        out
    }

    /// Structure without free input parameters.
    #[must_use]
    pub fn without_inputs(&self) -> Self {
        Self { inputs: Vec::new(), ..self.clone() }
    }

    /// Return the structure with another equation at index `place`, without the bounds of orders that no longer occur.
    #[must_use]
    pub fn with_equation(&self, place: usize, equation: ParametricEquation) -> Self {
        let mut out = self.clone();
        out.equations[place] = equation;
        let names: BTreeSet<String> = out.order_names().into_iter().collect();
        out.bounds.retain(|name, _| names.contains(name));
        out
    }
}

/// Each name once, in order of appearance.
pub(super) fn unique<'a>(names: impl Iterator<Item = &'a String>) -> Vec<String> {
    let mut names_so_far = BTreeSet::new();
    names.filter(|name| names_so_far.insert(*name)).cloned().collect()
}

/// Order of a derivative: a number, or an affine function of free orders.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Order {
    /// Constant part.
    pub constant: f64,
    /// Nonzero weight of each free order, sorted by name.
    pub weights: Vec<(String, f64)>,
}

impl Order {
    /// Order with a fixed value.
    ///
    /// ```
    /// use ftlm::estimation::joint_fit::structure::Order;
    /// assert!(Order::free("alpha").is_single() && !Order::number(2.0).is_free());
    /// ```
    #[must_use]
    pub fn number(constant: f64) -> Self {
        Self { constant, weights: Vec::new() }
    }

    /// Single free order.
    #[must_use]
    pub fn free(name: &str) -> Self {
        Self { constant: 0.0, weights: vec![(name.to_owned(), 1.0)] }
    }

    /// Names of the free orders that this order depends on.
    pub fn names(&self) -> impl Iterator<Item = &String> {
        self.weights.iter().map(|(name, _)| name)
    }

    /// Whether it depends on free orders.
    #[must_use]
    pub fn is_free(&self) -> bool {
        !self.weights.is_empty()
    }

    /// True if it is a single free order with weight 1 and no constant.
    #[must_use]
    pub fn is_single(&self) -> bool {
        self.constant == 0.0 && matches!(self.weights.as_slice(), [(_, 1.0)])
    }

    /// Value at the given values of the free orders.
    #[must_use]
    pub fn at(&self, value: impl Fn(&str) -> f64) -> f64 {
        self.constant + self.weights.iter().map(|(name, weight)| weight * value(name)).sum::<f64>()
    }

    /// Return the order with values for some free orders.
    #[must_use]
    pub fn substitute(&self, values: &BTreeMap<String, f64>) -> Self {
        let weighted = self.weights.iter().filter_map(|(name, weight)| values.get(name).map(|value| weight * value));
        let constant = tidy(self.constant + weighted.sum::<f64>());
        let weights = self.weights.iter().filter(|(name, _)| !values.contains_key(name)).cloned().collect();
        Self { constant, weights }
    }

    /// Convert to an order with unnamed weights, in the sequence of `names`.
    #[must_use]
    pub fn affine(&self, names: &[String]) -> AffineOrder {
        let weight = |name: &String| self.weights.iter().find(|(n, _)| n == name).map_or(0.0, |(_, weight)| *weight);
        AffineOrder { constant: self.constant, weights: names.iter().map(weight).collect() }
    }
}

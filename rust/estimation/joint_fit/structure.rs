//! Structure of a joint fit: equations over numbered signals with named orders and coefficients.

use std::collections::{BTreeMap, BTreeSet};

use crate::equation::{alpha_fits, missing_signal_error, round_order, AffineOrder, Initial};
use crate::error::{Error, Result};
use crate::estimation::output_error::FreeInput;
use crate::expression::DerivedSignal;
use crate::fractional::kernels::{MAX_ORDER_EXCESS, MIN_INPUT_ORDER};

/// Difference below which two orders count as equal.
const ORDER_TOLERANCE: f64 = 1e-9;

/// Coefficient of a term: free or fixed.
#[derive(Debug, Clone, PartialEq)]
pub enum Coefficient {
    /// Name of the free coefficient.
    Free(String),
    /// Value of the fixed coefficient.
    Fixed(f64),
}

impl Coefficient {
    /// Name of a free coefficient; None if fixed.
    #[must_use]
    pub fn name(&self) -> Option<&String> {
        match self {
            Self::Free(name) => Some(name),
            Self::Fixed(_) => None,
        }
    }

    fn substitute(&self, values: &BTreeMap<String, f64>) -> Self {
        self.name().and_then(|name| values.get(name)).map_or_else(|| self.clone(), |&value| Self::Fixed(value))
    }
}

/// Term of an equation: factor · coefficient · D^ν signal.
#[derive(Debug, Clone, PartialEq)]
pub struct ParametricTerm {
    /// Index of the signal.
    pub signal: usize,
    /// Order ν of the derivative.
    pub order: Order,
    /// Coefficient, free or fixed.
    pub coefficient: Coefficient,
    /// The known factor of the coefficient.
    pub factor: f64,
}

impl ParametricTerm {
    /// Return factor · coefficient if the coefficient is fixed, else None.
    #[must_use]
    pub fn fixed_coefficient(&self) -> Option<f64> {
        match self.coefficient {
            Coefficient::Fixed(value) => Some(self.factor * value),
            Coefficient::Free(_) => None,
        }
    }
}

/// Friction parameters of the output of an equation, each as a known factor and a coefficient.
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

/// Equation D^α output = Σ terms.
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
    /// Return the equation D^α output = 0 with the order α = `order`, to which [`Self::with_term`] adds terms.
    #[must_use]
    pub fn new(output: usize, order: Order) -> Self {
        Self { output, order, terms: Vec::new(), friction: None }
    }

    /// Add a term coefficient · D^order signal, whose coefficient is free and has the given name.
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
        let friction_names = self
            .friction
            .iter()
            .flat_map(|friction| friction.parameters())
            .filter_map(|(_, coefficient)| coefficient.name());
        self.terms.iter().filter_map(|term| term.coefficient.name()).chain(friction_names)
    }

    /// Order α of the equation, then the order of each term.
    pub fn orders(&self) -> impl Iterator<Item = &Order> {
        std::iter::once(&self.order).chain(self.terms.iter().map(|term| &term.order))
    }

    /// Autoregressive terms: those of the output of the equation.
    pub fn autoregressive_terms(&self) -> impl Iterator<Item = &ParametricTerm> {
        self.terms.iter().filter(|term| term.signal == self.output)
    }

    /// Terms of other signals than the output.
    pub fn input_terms(&self) -> impl Iterator<Item = &ParametricTerm> {
        self.terms.iter().filter(|term| term.signal != self.output)
    }

    fn check(&self) -> Result<()> {
        let structure_error = |what: String, remedy: &str| Err(Error::Structure { what, remedy: remedy.into() });
        if self.terms.is_empty() {
            return structure_error(format!("the equation of output {} has no term", self.output), "add one");
        }
        if self.order.is_free() {
            return Ok(());
        }
        let alpha = self.order.constant;
        if !alpha_fits(alpha) || (self.friction.is_some() && !(alpha > 1.0 && alpha <= 2.0)) {
            return structure_error(format!("order alpha = {alpha} of output {}", self.output), "choose another order");
        }
        for term in self.terms.iter().filter(|term| !term.order.is_free()) {
            let order = term.order.constant;
            let is_in_range = if term.signal == self.output {
                (0.0..alpha).contains(&order)
            } else {
                order >= MIN_INPUT_ORDER && order < alpha + MAX_ORDER_EXCESS - ORDER_TOLERANCE
            };
            if !is_in_range {
                let what = format!("order {order} of signal {} with order alpha = {alpha} of the output", term.signal);
                return structure_error(what, "lower it");
            }
        }
        Ok(())
    }
}

/// Free parameter of an input, with its name.
#[derive(Debug, Clone, PartialEq)]
pub struct Input {
    /// Name of the parameter, such as `delay_u`.
    pub name: String,
    /// Kind of the parameter, its bounds and its input.
    pub parameter: FreeInput,
}

/// Coefficient law: a coefficient equals sign · Π factors.
#[derive(Debug, Clone, PartialEq)]
pub struct Law {
    /// Name of the coefficient.
    pub name: String,
    /// Sign, ±1.
    pub sign: f64,
    /// Names of the factors. A factor is repeated for a power.
    pub factors: Vec<String>,
}

/// Prior knowledge of orders and coefficients for initial guesses. It does not bound the fit.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Hints {
    /// Typical interval of the highest orders of the equations.
    pub highest: Option<(f64, f64)>,
    /// Typical values of free orders, by name.
    pub typical_orders: BTreeMap<String, Vec<f64>>,
    /// Physical lower bound of each ratio (factor of a coefficient law), by name; 1 by default.
    pub ratio_lower_bounds: BTreeMap<String, f64>,
    /// Names of coefficients that a coefficient law determines from another equation and that are physically positive.
    pub positive: BTreeSet<String>,
    /// Approximate physical values of coefficients, by name.
    pub physical_values: BTreeMap<String, f64>,
}

/// Structure of a joint fit: equations, bounds, initial terms, input nonlinearities and coefficient laws.
#[derive(Debug, Clone, PartialEq)]
pub struct ParametricStructure {
    /// Names of the signals, for messages: recorded signals, then derived signals.
    pub signals: Vec<String>,
    /// Expressions that are the signals of nonlinear terms. They are numbered after the recorded signals.
    pub derived: Vec<DerivedSignal>,
    /// One equation per output.
    pub equations: Vec<ParametricEquation>,
    /// The given lower and upper bounds of free orders, by name.
    pub bounds: BTreeMap<String, (f64, f64)>,
    /// Mean and standard deviation of the normal priors of free parameters, by name.
    ///
    /// Priors of parameters that are not free have no effect.
    pub priors: BTreeMap<String, (f64, f64)>,
    /// True if simulated outputs enter the other equations, false if measured outputs do.
    pub coupled: bool,
    /// True if an input has a fixed delay.
    pub delayed: bool,
    /// Initial terms of the equations.
    pub initial: Initial,
    /// True if the initial terms represent inputs before the start of a run.
    pub history: bool,
    /// Free parameters of inputs: delays, saturation limits and dead-zone half-widths.
    pub inputs: Vec<Input>,
    /// Coefficient laws.
    pub laws: Vec<Law>,
    /// Prior knowledge for initial guesses.
    pub hints: Hints,
}

impl ParametricStructure {
    /// Return a structure of uncoupled equations without bounds, laws or free input parameters.
    ///
    /// The output of another equation enters an equation with its measured values.
    #[must_use]
    pub fn new(signals: Vec<String>, equations: Vec<ParametricEquation>, initial: Initial) -> Self {
        Self {
            signals,
            derived: Vec::new(),
            equations,
            bounds: BTreeMap::new(),
            priors: BTreeMap::new(),
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

    /// Names of the free orders.
    ///
    /// Orders that stand alone come first, in order of appearance. Those that occur only in an order law follow.
    #[must_use]
    pub fn order_names(&self) -> Vec<String> {
        let orders = || self.equations.iter().flat_map(ParametricEquation::orders);
        let single_orders = orders().filter(|order| order.is_single()).flat_map(Order::names);
        unique(single_orders.chain(orders().flat_map(Order::names)))
    }

    /// Names of the free coefficients.
    #[must_use]
    pub fn coefficient_names(&self) -> Vec<String> {
        self.equations.iter().flat_map(ParametricEquation::coefficient_names).cloned().collect()
    }

    /// Return true if orders depend on one another.
    ///
    /// This is the case if an order is not a single free order, or if two orders are the same free order.
    #[must_use]
    pub fn has_order_law(&self) -> bool {
        let orders: Vec<_> =
            self.equations.iter().flat_map(ParametricEquation::orders).filter(|order| order.is_free()).collect();
        let names = unique(orders.iter().filter_map(|order| order.names().next()));
        orders.iter().any(|order| !order.is_single()) || names.len() < orders.len()
    }

    /// Return true if an equation has friction.
    #[must_use]
    pub fn has_friction(&self) -> bool {
        self.equations.iter().any(|equation| equation.friction.is_some())
    }

    /// Check that there are equations, that their signals exist and that their orders are valid.
    ///
    /// # Errors
    /// [`Error::Structure`] if there is no equation, for an equation without terms, a signal that does not exist, or an
    /// order out of range.
    pub fn check(&self) -> Result<()> {
        if self.equations.is_empty() {
            return Err(Error::Structure { what: "a model without an equation".into(), remedy: "add one".into() });
        }
        let highest_signal_of = |e: &ParametricEquation| e.terms.iter().map(|t| t.signal).chain([e.output]).max();
        let inputs = self.inputs.iter().map(|input| input.parameter.signal);
        let highest_signal = self.equations.iter().filter_map(highest_signal_of).chain(inputs).max();
        if let Some(signal) = highest_signal.filter(|&signal| signal >= self.signals.len()) {
            return Err(missing_signal_error(signal, self.signals.len()));
        }
        let channels = self.derived.iter().flat_map(|derived| &derived.channels).map(|channel| channel.0);
        let outputs = self.equations.iter().map(|e| e.output);
        if let Some(signal) = channels.chain(outputs).find(|&signal| signal >= self.recorded_count()) {
            return Err(missing_signal_error(signal, self.recorded_count()));
        }
        self.equations.iter().try_for_each(ParametricEquation::check)
    }

    /// Return the structure with fixed values for some free orders, given by name.
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

    /// Return the structure with fixed values for some free coefficients, given by name.
    #[must_use]
    pub fn with_coefficients(&self, values: &BTreeMap<String, f64>) -> Self {
        let mut out = self.clone();
        for equation in &mut out.equations {
            equation.terms.iter_mut().for_each(|term| term.coefficient = term.coefficient.substitute(values));
            if let Some(friction) = &mut equation.friction {
                for (_, coefficient) in [&mut friction.coulomb, &mut friction.stribeck, &mut friction.speed] {
                    *coefficient = coefficient.substitute(values);
                }
            }
        }
        out
    }

    /// Return the structure without free input parameters.
    #[must_use]
    pub fn without_inputs(&self) -> Self {
        Self { inputs: Vec::new(), ..self.clone() }
    }

    /// Return the structure with another equation at index `index`, without the bounds of orders that no longer occur.
    #[must_use]
    pub fn with_equation(&self, index: usize, equation: ParametricEquation) -> Self {
        let mut out = self.clone();
        out.equations[index] = equation;
        let names: BTreeSet<String> = out.order_names().into_iter().collect();
        out.bounds.retain(|name, _| names.contains(name));
        out
    }
}

/// Return each name once, in order of appearance.
pub(super) fn unique<'a>(names: impl Iterator<Item = &'a String>) -> Vec<String> {
    let mut names_so_far = BTreeSet::new();
    names.filter(|name| names_so_far.insert(*name)).cloned().collect()
}

/// Order of a derivative: a number, or an affine function of free orders.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Order {
    /// Constant part.
    pub constant: f64,
    /// Name and nonzero weight of each free order, sorted by name.
    pub weights: Vec<(String, f64)>,
}

impl Order {
    /// Return an order with a fixed value.
    ///
    /// ```
    /// use ftlm::estimation::joint_fit::structure::Order;
    /// assert!(Order::free("alpha").is_single() && !Order::number(2.0).is_free());
    /// ```
    #[must_use]
    pub fn number(constant: f64) -> Self {
        Self { constant, weights: Vec::new() }
    }

    /// Return an order expression that consists only of the free order `name`.
    #[must_use]
    pub fn free(name: &str) -> Self {
        Self { constant: 0.0, weights: vec![(name.to_owned(), 1.0)] }
    }

    /// Names of the free orders that this order depends on.
    pub fn names(&self) -> impl Iterator<Item = &String> {
        self.weights.iter().map(|(name, _)| name)
    }

    /// Return true if the order depends on free orders.
    #[must_use]
    pub fn is_free(&self) -> bool {
        !self.weights.is_empty()
    }

    /// Return true if the order is a single free order with weight 1 and no constant.
    #[must_use]
    pub fn is_single(&self) -> bool {
        self.constant == 0.0 && matches!(self.weights.as_slice(), [(_, 1.0)])
    }

    /// Return the value of the order; `value` returns the value of a free order by its name.
    #[must_use]
    pub fn at(&self, value: impl Fn(&str) -> f64) -> f64 {
        self.constant + self.weights.iter().map(|(name, weight)| weight * value(name)).sum::<f64>()
    }

    /// Return the order with fixed values for some free orders, given by name.
    #[must_use]
    pub fn substitute(&self, values: &BTreeMap<String, f64>) -> Self {
        let weighted = self.weights.iter().filter_map(|(name, weight)| values.get(name).map(|value| weight * value));
        let constant = round_order(self.constant + weighted.sum::<f64>());
        let weights = self.weights.iter().filter(|(name, _)| !values.contains_key(name)).cloned().collect();
        Self { constant, weights }
    }

    /// Convert to an order without names, whose weights are in the sequence of `names`.
    #[must_use]
    pub fn affine(&self, names: &[String]) -> AffineOrder {
        let weight = |name: &String| self.weights.iter().find(|(n, _)| n == name).map_or(0.0, |(_, weight)| *weight);
        AffineOrder { constant: self.constant, weights: names.iter().map(weight).collect() }
    }
}

//! Parameterization of a model: free parameters with coordinates and bounds, and time scaling.
//!
//! A coefficient of D^ν y in an equation for D^α y has the unit time^−(α − ν), which changes with free orders. Without
//! scaling, the result of an optimization along a flat valley would depend on the unit of time. The optimization
//! therefore uses a unit between the sampling interval and the duration. In this unit the resonance frequencies of a
//! record are near 1, and orders and coefficients are least correlated.

use super::experiment::Experiment;
use super::stability::is_unstable;
use crate::equation::{AffineOrder, Initial, Structure, Term};
use crate::error::{check_length, Error, Result};
use crate::estimation::optimization::prior::Prior;
use crate::regressors::Record;
use crate::signal::block_pulse::{delay_samples, PulseJump};
use crate::simulate::nyquist_margin;

/// Coordinate of a coefficient in an optimization. It affects the convergence, not the optimum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coordinate {
    /// The coefficient itself.
    Plain,
    /// Logarithm ln|c|, with the sign of the initial guess.
    Logarithm,
    /// Logarithm ln(c − 1), for a ratio above 1.
    ExcessLogarithm,
    /// No coordinate: fixed at the initial value, like an order between equal bounds.
    Fixed,
}

/// Maximum decrease of ln|c| of a coefficient c from its initial value.
const MAX_LOG_DECREASE: f64 = 20.0;

impl Coordinate {
    /// Return true if a value is in the range of the coordinate.
    pub(crate) fn contains(self, value: f64) -> bool {
        match self {
            Self::Plain | Self::Fixed => value.is_finite(),
            Self::Logarithm => value != 0.0 && value.is_finite(),
            Self::ExcessLogarithm => value > 1.0 && value.is_finite(),
        }
    }

    /// Return a coefficient after a shift by `delta` in its coordinate.
    pub(crate) fn shift(self, value: f64, delta: f64) -> f64 {
        // The linearization is meaningless beyond a factor of e^5.
        let limited_delta = delta.clamp(-5.0, 5.0);
        match self {
            Self::Plain => value + delta,
            Self::Logarithm => value * libm::exp(limited_delta),
            Self::ExcessLogarithm => 1.0 + (value - 1.0) * libm::exp(limited_delta),
            Self::Fixed => value,
        }
    }

    /// Distance of a coefficient from its lower bound in its coordinate; infinite if it has no bound.
    ///
    /// Below the bound, the terms of the coefficient have no effect, and an optimization would not terminate.
    pub(crate) fn distance_to_bound(self, value: f64, start: f64) -> f64 {
        match self {
            Self::Logarithm => libm::log(value / start) + MAX_LOG_DECREASE,
            Self::Plain | Self::ExcessLogarithm | Self::Fixed => f64::INFINITY,
        }
    }

    /// Derivative of a coefficient with respect to its coordinate.
    pub(crate) fn derivative(self, value: f64) -> f64 {
        match self {
            Self::Plain => 1.0,
            Self::Logarithm => value,
            Self::ExcessLogarithm => value - 1.0,
            Self::Fixed => 0.0,
        }
    }
}

/// Monomial of the free coefficients: factor·Π c_i^{n_i}.
#[derive(Debug, Clone, PartialEq)]
pub struct Monomial {
    /// The fixed factor.
    pub factor: f64,
    /// Index and power of each free coefficient that occurs.
    pub powers: Vec<(usize, i32)>,
}

impl Monomial {
    pub(crate) fn at(&self, coefficients: &[f64]) -> f64 {
        self.powers.iter().fold(self.factor, |product, &(i, n)| product * coefficients[i].powi(n))
    }

    /// Derivative of the monomial with respect to coefficient `i`.
    pub(crate) fn slope(&self, coefficients: &[f64], i: usize) -> f64 {
        let Some(&(_, n)) = self.powers.iter().find(|&&(j, _)| j == i) else { return 0.0 };
        let other_powers = self.powers.iter().filter(|&&(j, _)| j != i);
        let other_factors = other_powers.fold(self.factor, |product, &(j, k)| product * coefficients[j].powi(k));
        other_factors * f64::from(n) * coefficients[i].powi(n - 1)
    }
}

/// Equation whose orders and coefficients are functions of the free parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct FreeEquation {
    /// Index of the output in the record.
    pub output: usize,
    /// Highest order α.
    pub order: AffineOrder,
    /// Index of the signal, order and coefficient of each term.
    pub terms: Vec<(usize, AffineOrder, Monomial)>,
}

/// Values of all free parameters.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParameterPoint {
    /// Free orders.
    pub orders: Vec<f64>,
    /// Free coefficients.
    pub coefficients: Vec<f64>,
    /// Free input parameters: delays \[s\], and saturation and dead-zone limits in the unit of the input.
    pub inputs: Vec<f64>,
}

impl ParameterPoint {
    /// Value of the parameter with this index, in the order: orders, coefficients, input parameters; NaN if there is
    /// none.
    pub(crate) fn value(&self, parameter: usize) -> f64 {
        let mut values = self.orders.iter().chain(&self.coefficients).chain(&self.inputs);
        values.nth(parameter).copied().unwrap_or(f64::NAN)
    }
}

/// Model with free orders, coefficients and input parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct FreeModel {
    /// Equations, one per output.
    pub equations: Vec<FreeEquation>,
    /// Lower and upper bound of each free order.
    pub order_bounds: Vec<(f64, f64)>,
    /// Coordinate of each free coefficient.
    pub coordinates: Vec<Coordinate>,
    /// Free input parameters, at most one per input.
    pub inputs: Vec<FreeInput>,
    /// True if simulated outputs enter the other equations, false if measured outputs do.
    pub coupled: bool,
    /// Initial terms of each record.
    pub initial: Initial,
    /// Normal priors of free parameters, whose indices count orders, then coefficients, then input parameters.
    pub priors: Vec<Prior>,
}

/// Minimum ratio of the denominator of the block-pulse scheme at the Nyquist frequency to its leading coefficient. A
/// point with a smaller ratio is not admissible.
const MIN_NYQUIST_RESPONSE_RATIO: f64 = 0.02;

impl FreeModel {
    /// Check that the model matches the experiments.
    ///
    /// # Errors
    /// [`Error::Structure`] for an unknown signal or coefficient, a nonlinearity of a signal that is not an input, or a
    /// lower bound above the upper bound. [`Error::Length`] if there is no experiment, or if the data of an experiment
    /// have wrong lengths. [`Error::NotFinite`] if a value is not finite. [`Error::OutOfRange`] for an order or
    /// exponent out of range ([`AffineOrder::check`]).
    pub fn check(&self, experiments: &[Experiment]) -> Result<()> {
        let Some(signals) = experiments.iter().map(|e| e.record.len()).min() else {
            return Err(Error::Length { name: "experiments".into(), expected: 1, found: 0 });
        };
        self.check_structure(signals, 0)?;
        experiments.iter().try_for_each(|experiment| self.check_experiment(experiment))?;
        self.initial.check()
    }

    /// Check signals, coefficients and bounds for records with `signals` recorded and `derived` derived signals.
    ///
    /// [`Error::Structure`] if one of them is invalid.
    pub(crate) fn check_structure(&self, signals: usize, derived: usize) -> Result<()> {
        let structure_error = |what: String, remedy: &str| Err(Error::Structure { what, remedy: remedy.into() });
        let coefficients = self.coordinates.len();
        for equation in &self.equations {
            let has_missing_item = |(signal, _, c): &(usize, AffineOrder, Monomial)| {
                *signal >= signals + derived || c.powers.iter().any(|&(i, _)| i >= coefficients)
            };
            if equation.output >= signals || equation.terms.iter().any(has_missing_item) {
                let what = "an equation contains a signal or a coefficient that does not exist".to_owned();
                return structure_error(what, "number them from 0");
            }
            for order in equation.terms.iter().map(|term| &term.1).chain([&equation.order]) {
                order.check(&self.order_bounds)?;
            }
        }
        for (k, &FreeInput { signal, law, bounds: (low, high) }) in self.inputs.iter().enumerate() {
            if signal >= signals || self.equations.iter().any(|e| e.output == signal) {
                let what = format!("signal {signal} has a free delay or limit but is not an input");
                return structure_error(what, "delay and limit inputs only");
            }
            if self.law_of(signal) != Some(k) {
                return structure_error(
                    format!("signal {signal} has two free parameters"),
                    "free only one parameter of an input",
                );
            }
            let min_bound = if law == InputLaw::Delay { f64::MIN } else { 0.0 };
            if !(min_bound <= low && low <= high && high.is_finite()) {
                return structure_error(
                    format!("bounds {low} to {high} of a delay or limit"),
                    "give two increasing values",
                );
            }
        }
        if let Some((low, high)) =
            self.order_bounds.iter().find(|(low, high)| low.is_nan() || high.is_nan() || low > high)
        {
            return structure_error(format!("bounds {low} to {high} of an order"), "give two increasing orders");
        }
        self.check_priors()
    }

    /// Check that an experiment is valid and has the outputs of the model.
    ///
    /// [`Error::Structure`] if samples are nonuniform and an input parameter is free.
    pub(crate) fn check_experiment(&self, experiment: &Experiment) -> Result<()> {
        experiment.check()?;
        check_length("outputs", self.equations.len(), experiment.samples.len())?;
        if experiment.nonuniform.is_some() && !self.inputs.is_empty() {
            let what = "a free delay or limit with samples at nonuniform times".into();
            return Err(Error::Structure { what, remedy: "fix its value, or resample the signal uniformly".into() });
        }
        Ok(())
    }

    /// Check that each prior is a normal distribution of a parameter that exists; [`Error::Structure`] if not.
    fn check_priors(&self) -> Result<()> {
        let size = self.order_bounds.len() + self.coordinates.len() + self.inputs.len();
        for Prior { parameter, mean, deviation } in &self.priors {
            let what = format!("the prior {mean} ± {deviation} of parameter {parameter} of {size}");
            if *parameter >= size || !mean.is_finite() || !(deviation.is_finite() && *deviation > 0.0) {
                let remedy = "number parameters from 0, and give a finite mean and a positive standard deviation";
                return Err(Error::Structure { what, remedy: remedy.into() });
            }
        }
        Ok(())
    }

    /// Return true if a coefficient has a prior.
    pub(crate) fn has_prior(&self, coefficient: usize) -> bool {
        self.priors.iter().any(|prior| prior.parameter == self.order_bounds.len() + coefficient)
    }

    /// Index of the free input parameter of a signal; None if it has none.
    pub(crate) fn law_of(&self, signal: usize) -> Option<usize> {
        self.inputs.iter().position(|d| d.signal == signal)
    }

    /// Return the pulse means of an input after its nonlinearity, and their derivative with respect to its parameter.
    pub(crate) fn apply_input_law(
        &self,
        record: &Record,
        input: FreeInput,
        value: f64,
    ) -> Result<(Vec<f64>, Vec<f64>)> {
        let means = record.signal(input.signal);
        input.law.apply(means, value, record.step(), self.value_before(means))
    }

    /// Return the jumps that an input has within pulses after its nonlinearity, each with its derivative.
    ///
    /// The derivatives are those with respect to the free parameter of the input.
    pub(crate) fn apply_input_law_to_jumps(
        &self,
        record: &Record,
        input: FreeInput,
        value: f64,
    ) -> Result<Vec<(PulseJump, PulseJump)>> {
        let means = record.signal(input.signal);
        let before = self.value_before(means);
        input.law.apply_to_jumps(means, record.jumps(input.signal), value, record.step(), before)
    }

    /// Value of a delayed input before its first pulse: 0 for a record at rest, else its first pulse mean.
    fn value_before(&self, means: &[f64]) -> f64 {
        if self.initial.is_at_rest() {
            0.0
        } else {
            means.first().copied().unwrap_or(0.0)
        }
    }

    pub(crate) fn structures(&self, orders: &[f64]) -> Vec<Structure> {
        self.equations
            .iter()
            .map(|e| Structure {
                output: e.output,
                order: unrounded_order(&e.order, orders),
                terms: e.terms.iter().map(|(s, o, _)| Term { signal: *s, order: unrounded_order(o, orders) }).collect(),
            })
            .collect()
    }

    /// Exponents of the initial terms of equation `i` on an experiment.
    ///
    /// Impulses are included only if the output passes a sensor filter. They represent the initial state of the filter.
    pub(crate) fn exponents(&self, experiment: &Experiment, i: usize, structure: &Structure) -> Vec<f64> {
        structure.initial_exponents(if experiment.is_filtered(i) {
            &self.initial
        } else {
            self.initial.without_filter()
        })
    }

    /// Index of the equation that simulates a signal which occurs in equation `i`; None for an input.
    pub(crate) fn output_index(&self, i: usize, signal: usize) -> Option<usize> {
        if self.coupled {
            self.equations.iter().position(|e| e.output == signal)
        } else {
            (signal == self.equations[i].output).then_some(i)
        }
    }

    /// Order of each equation, and pairs of coefficient and order of its autoregressive terms.
    fn autoregressive_terms(&self, point: &ParameterPoint) -> Vec<(f64, Vec<(f64, f64)>)> {
        let autoregressive_terms_of = |(structure, equation): (&Structure, &FreeEquation)| {
            let terms = structure.terms.iter().zip(&equation.terms);
            let autoregressive_pairs = terms.filter(|(term, _)| term.signal == structure.output);
            (
                structure.order,
                autoregressive_pairs.map(|(term, (_, _, c))| (c.at(&point.coefficients), term.order)).collect(),
            )
        };
        self.structures(&point.orders).iter().zip(&self.equations).map(autoregressive_terms_of).collect()
    }

    /// Return true if an equation is unstable. Coupled equations are not checked, and the result is false.
    pub(crate) fn is_unstable(&self, point: &ParameterPoint) -> bool {
        let is_uncoupled = !self.coupled || self.equations.len() == 1;
        is_uncoupled && self.autoregressive_terms(point).iter().any(|(order, terms)| is_unstable(*order, terms))
    }

    /// Return true if the pulses of every experiment resolve the autoregressive terms of each equation, or if equations
    /// are coupled.
    ///
    /// The check compares the denominator at the Nyquist frequency ([`nyquist_margin`]) with its leading coefficient.
    /// If their ratio is negative, the discretization has an unstable mode that alternates from pulse to pulse. If it
    /// is near 0, such a mode hardly decays. A fit would use this mode to follow noise.
    pub(crate) fn is_resolved(&self, experiments: &[Experiment], point: &ParameterPoint) -> bool {
        if self.coupled && self.equations.len() > 1 {
            return true;
        }
        self.autoregressive_terms(point).iter().all(|(order, terms)| {
            let eta_terms: Vec<(f64, f64)> = terms.iter().map(|(c, nu)| (*c, order - nu)).collect();
            experiments.iter().all(|experiment| {
                let h = experiment.record.step();
                let first_coefficient = |&(c, eta): &(f64, f64)| c * libm::pow(h, eta) / libm::tgamma(eta + 2.0);
                let leading = 1.0 - eta_terms.iter().map(first_coefficient).sum::<f64>();
                nyquist_margin(&eta_terms, h) / leading >= MIN_NYQUIST_RESPONSE_RATIO
            })
        })
    }
}

/// Value of an affine order without rounding, which is continuous in the free orders.
fn unrounded_order(law: &AffineOrder, free_orders: &[f64]) -> f64 {
    law.constant + law.weights.iter().zip(free_orders).map(|(w, x)| w * x).sum::<f64>()
}

/// Kind of input nonlinearity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputLaw {
    /// Delay by a time \[s\].
    Delay,
    /// Symmetric saturation, with a limit in the unit of the input.
    Saturation,
    /// Symmetric dead zone, with a half-width in the unit of the input.
    DeadZone,
}

/// Free parameter of an input nonlinearity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FreeInput {
    /// Index of the input in the record; not an output of an equation.
    pub signal: usize,
    /// Kind of the nonlinearity.
    pub law: InputLaw,
    /// Lower and upper bound: \[s\] for a delay, else in the unit of the input.
    pub bounds: (f64, f64),
}

impl InputLaw {
    /// Apply the nonlinearity to pulse means. Return the new means and their derivative with respect to the parameter.
    ///
    /// `value` is the parameter, `step` the pulse width \[s\], and `before` the value of the input before the first
    /// pulse. A delay is exact for a zero-order hold, and of second order in the step for linear interpolation. At an
    /// integer number of steps, its derivative is one-sided, toward longer delays. Saturation and dead zone act on
    /// every pulse separately, which is exact for a zero-order hold.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a negative saturation or dead zone, or a parameter that is not finite.
    ///
    /// ```
    /// use ftlm::estimation::output_error::InputLaw;
    /// # fn main() -> ftlm::error::Result<()> {
    /// let (means, slope) = InputLaw::Saturation.apply(&[0.5, 2.0, -3.0], 1.5, 0.1, 0.0)?;
    /// assert_eq!((means, slope), (vec![0.5, 1.5, -1.5], vec![0.0, 1.0, -1.0]));
    /// let (means, slope) = InputLaw::DeadZone.apply(&[0.5, 2.0, -3.0], 1.5, 0.1, 0.0)?;
    /// assert_eq!((means, slope), (vec![0.0, 0.5, -1.5], vec![0.0, -1.0, 1.0]));
    /// # Ok(())
    /// # }
    /// ```
    pub fn apply(self, means: &[f64], value: f64, step: f64, before: f64) -> Result<(Vec<f64>, Vec<f64>)> {
        if !(value.is_finite() && (value >= 0.0 || self == Self::Delay)) {
            return Err(Error::OutOfRange {
                name: "input parameter".into(),
                value,
                range: "[0, ∞)".into(),
                remedy: "give a delay of at least 0, and symmetric limits of at least 0".into(),
            });
        }
        let excess_sign = |v: f64| if v.abs() > value { v.signum() } else { 0.0 };
        Ok(match self {
            Self::Delay => {
                let steps = value / step;
                let whole_steps = steps.floor();
                let (delayed, delayed_further) =
                    (delay_samples(means, whole_steps, before)?, delay_samples(means, whole_steps + 1.0, before)?);
                let slope = delayed
                    .iter()
                    .zip(&delayed_further)
                    .map(|(delayed, delayed_further)| (delayed_further - delayed) / step)
                    .collect();
                (delay_samples(means, steps, before)?, slope)
            }
            Self::Saturation => means.iter().map(|&v| (v.clamp(-value, value), excess_sign(v))).unzip(),
            Self::DeadZone => means
                .iter()
                .map(|&v| {
                    let side = excess_sign(v);
                    (if side == 0.0 { 0.0 } else { v - value * side }, -side)
                })
                .unzip(),
        })
    }

    /// Return the jumps of a zero-order hold within pulses after the nonlinearity, each with its derivatives.
    ///
    /// The second of each pair contains the derivatives of `fraction`, `before` and `after` with respect to the
    /// parameter.
    /// Saturation and dead zone act on both values of each of `jumps`. A delay ignores `jumps`: the input is assumed to
    /// jump at pulse edges, and the delay moves these jumps into the pulses. `before` is the input before the record.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a negative saturation or dead zone, or a parameter that is not finite.
    #[allow(clippy::float_cmp)]
    pub(crate) fn apply_to_jumps(
        self,
        means: &[f64],
        jumps: &[PulseJump],
        value: f64,
        step: f64,
        before: f64,
    ) -> Result<Vec<(PulseJump, PulseJump)>> {
        if self == Self::Delay {
            let steps = value / step;
            let (whole_steps, fraction) = (steps.floor(), steps - steps.floor());
            if fraction == 0.0 {
                return Ok(Vec::new());
            }
            let (delayed, delayed_further) =
                (delay_samples(means, whole_steps, before)?, delay_samples(means, whole_steps + 1.0, before)?);
            let slope = |pulse| PulseJump { pulse, fraction: 1.0 / step, before: 0.0, after: 0.0 };
            let pairs =
                delayed_further.into_iter().zip(delayed).enumerate().filter(|(_, (before, after))| before != after);
            let jump = |(pulse, (before, after))| (PulseJump { pulse, fraction, before, after }, slope(pulse));
            return Ok(pairs.map(jump).collect());
        }
        let values: Vec<f64> = jumps.iter().flat_map(|jump| [jump.before, jump.after]).collect();
        let (values, slopes) = self.apply(&values, value, step, before)?;
        let jump = |(jump, (values, slopes)): (&PulseJump, (&[f64], &[f64]))| {
            (
                PulseJump { before: values[0], after: values[1], ..*jump },
                PulseJump { pulse: jump.pulse, fraction: 0.0, before: slopes[0], after: slopes[1] },
            )
        };
        Ok(jumps.iter().zip(values.chunks(2).zip(slopes.chunks(2))).map(jump).collect())
    }
}

/// Maximum magnitude of the logarithm of a scaling factor. Larger logarithms are clipped.
const MAX_LOG_FACTOR: f64 = 300.0;
/// Difference below which two exponents of time count as equal.
const EXPONENT_TOLERANCE: f64 = 1e-9;

/// Exponent of the unit of time in the scaling factor of a coefficient, as an affine function of the free orders: the
/// constant, and one weight per free order.
type TimePower = (f64, Vec<f64>);

/// Unit of time in which coefficients are scaled: its logarithm, and its exponent in the scaling factor of each
/// coefficient. The exponent is None for an unscaled coefficient.
#[derive(Debug, Clone)]
pub(crate) struct TimeUnit {
    log_unit: f64,
    exponents: Vec<Option<TimePower>>,
}

impl TimeUnit {
    /// Return the unit of time for the runs of `experiments`, with its exponent for each coefficient of the model.
    pub(crate) fn from_experiments(model: &FreeModel, experiments: &[Experiment]) -> Self {
        Self::from_log_spans(model, &experiments.iter().map(log_span).collect::<Vec<_>>())
    }

    /// Return the unit of time for runs with the given `spans`, with its exponent for each coefficient of the model.
    ///
    /// The unit is the geometric mean of sampling interval and duration over all runs, divided by π. `spans` contains
    /// ln(sampling interval × duration) of each run, in seconds.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn from_log_spans(model: &FreeModel, spans: &[f64]) -> Self {
        // Inverse of the geometric mean of the lowest frequency, π/duration, and the Nyquist frequency, π/interval.
        let log_unit = spans.iter().sum::<f64>() / (2.0 * spans.len().max(1) as f64) - libm::log(std::f64::consts::PI);
        Self { log_unit, exponents: time_powers(model) }
    }

    /// Natural logarithm of the unit of time in seconds.
    pub(crate) fn log_unit(&self) -> f64 {
        self.log_unit
    }

    /// Factor that converts a coefficient from seconds to the scaled unit of time, at the given orders.
    pub(crate) fn factor(&self, coefficient: usize, orders: &[f64]) -> f64 {
        self.exponents[coefficient].as_ref().map_or(1.0, |(constant, weights)| {
            let power = constant + weights.iter().zip(orders).map(|(w, o)| w * o).sum::<f64>();
            // Clipping avoids overflow with extreme units.
            libm::exp((power * self.log_unit).clamp(-MAX_LOG_FACTOR, MAX_LOG_FACTOR))
        })
    }

    /// Return the relative decrease −∂ln c/∂ν of a coefficient c, in units of seconds, with respect to a free order ν.
    ///
    /// The derivative is taken at a constant value of the coefficient in the scaled unit of time.
    pub(crate) fn relative_decrease(&self, coefficient: usize, order: usize) -> f64 {
        let weight = |(_, weights): &TimePower| weights.get(order).copied().unwrap_or(0.0);
        self.exponents[coefficient].as_ref().map_or(0.0, weight) * self.log_unit
    }
}

/// Natural logarithm of sampling interval times duration, in seconds.
fn log_span(experiment: &Experiment) -> f64 {
    let (m, step) = (experiment.record.m() as f64, experiment.record.step());
    let interval = step * experiment.pulses_per_sample as f64;
    libm::log(interval) + libm::log(m * step)
}

/// Return the exponent of the unit of time in the scaling factor of each coefficient; None for an unscaled coefficient.
fn time_powers(model: &FreeModel) -> Vec<Option<TimePower>> {
    consistent_powers(model).unwrap_or_else(|| {
        // Exponents conflict if one coefficient occurs with several orders. Under a coefficient law, no coefficient is
        // then scaled.
        let has_coefficient_law = model.equations.iter().flat_map(|e| &e.terms).any(|(_, _, c)| c.powers.len() > 1);
        (0..model.coordinates.len()).map(|j| if has_coefficient_law { None } else { time_power(model, j) }).collect()
    })
}

/// Return true if a coefficient is scaled. Fixed coefficients and ratios are not.
fn is_scaled(model: &FreeModel, coefficient: usize) -> bool {
    matches!(model.coordinates[coefficient], Coordinate::Plain | Coordinate::Logarithm)
}

/// Return the exponent α − ν of the first term whose coefficient is this one alone, not a product; None if there is no
/// such term or the coefficient is unscaled.
fn time_power(model: &FreeModel, coefficient: usize) -> Option<TimePower> {
    if !is_scaled(model, coefficient) {
        return None;
    }
    model.equations.iter().find_map(|equation| {
        let (_, order, _) = equation.terms.iter().find(|(_, _, c)| c.powers == [(coefficient, 1)])?;
        let mut power = order_difference(&equation.order, order);
        let constant = power.remove(0);
        Some((constant, power))
    })
}

/// Difference α − ν of two affine orders: the constant, then the weights of the free orders.
fn order_difference(highest: &AffineOrder, order: &AffineOrder) -> Vec<f64> {
    let weights = highest.weights.iter().zip(&order.weights).map(|(a, b)| a - b);
    std::iter::once(highest.constant - order.constant).chain(weights).collect()
}

/// Solve for the exponent of the unit of time of each coefficient, such that the product of the coefficients of every
/// term has the exponent α − ν; None if the terms conflict.
fn consistent_powers(model: &FreeModel) -> Option<Vec<Option<TimePower>>> {
    let (count, orders) = (model.coordinates.len(), model.order_bounds.len());
    // One row per product: exponents of the coefficients, and the exponent of time of the product.
    let mut rows: Vec<(Vec<f64>, Vec<f64>)> = Vec::new();
    for equation in &model.equations {
        for (_, order, coefficient) in &equation.terms {
            let mut powers_of_coefficients = vec![0.0; count];
            for &(j, n) in coefficient.powers.iter().filter(|(j, _)| is_scaled(model, *j)) {
                powers_of_coefficients[j] += f64::from(n);
            }
            if powers_of_coefficients.iter().any(|&n| n != 0.0) {
                rows.push((powers_of_coefficients, order_difference(&equation.order, order)));
            }
        }
    }
    let mut pivots = Vec::new();
    for j in 0..count {
        let pivot_count = pivots.len();
        let Some(pivot_row) = (pivot_count..rows.len()).find(|&i| rows[i].0[j].abs() > EXPONENT_TOLERANCE) else {
            continue;
        };
        rows.swap(pivot_count, pivot_row);
        let pivot = rows[pivot_count].clone();
        for (i, (powers_of_coefficients, power)) in rows.iter_mut().enumerate() {
            let factor = if i == pivot_count { 1.0 - 1.0 / pivot.0[j] } else { powers_of_coefficients[j] / pivot.0[j] };
            powers_of_coefficients.iter_mut().zip(&pivot.0).for_each(|(v, p)| *v -= factor * p);
            power.iter_mut().zip(&pivot.1).for_each(|(v, p)| *v -= factor * p);
        }
        pivots.push(j);
    }
    if rows[pivots.len()..].iter().flat_map(|(_, power)| power).any(|v| v.abs() > EXPONENT_TOLERANCE) {
        return None;
    }
    // Exponents that the products do not determine are 0.
    let mut powers: Vec<_> = (0..count).map(|j| is_scaled(model, j).then(|| (0.0, vec![0.0; orders]))).collect();
    for ((_, mut power), j) in rows.into_iter().zip(pivots) {
        let constant = power.remove(0);
        powers[j] = Some((constant, power));
    }
    Some(powers)
}

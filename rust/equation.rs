//! Equations of fractional order: terms, orders, order laws, initial terms, sensor filters, solvability.
//!
//! An equation is D^α y = Σ_k c_k D^{ν_k} s_k over the signals s_k of a record, with coefficients c_k. Integrated by
//! I^α it becomes y = Σ_k c_k I^{α−ν_k} s_k + initial terms. All other modules use this form.

use crate::error::{check_finite, check_length, check_points, check_step, Error, Result};
use crate::fractional::kernels::{block_pulse_kernel, MAX_ORDER, MAX_ORDER_EXCESS, MIN_INPUT_ORDER};
use crate::series;

/// Difference below which two orders count as equal. Orders on an order grid are multiples of its increment only up to
/// rounding.
pub const ORDER_GRAIN: f64 = 1e-9;

/// Term D^ν s of an equation. The [`Equation`] stores its coefficient.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Term {
    /// Index of the signal in the record.
    pub signal: usize,
    /// Order ν of the derivative. Only the order of an input may be negative, which is an integration.
    pub order: f64,
}

/// Equation D^α y = Σ c_k D^{ν_k} s_k without its coefficients c_k.
#[derive(Debug, Clone, PartialEq)]
pub struct Structure {
    /// Index of the output y in the record.
    pub output: usize,
    /// Order α of the equation.
    pub order: f64,
    /// Terms of the right-hand side.
    pub terms: Vec<Term>,
}

/// Equation: a structure with its coefficients.
#[derive(Debug, Clone, PartialEq)]
pub struct Equation {
    /// Output, orders and signals of the equation.
    pub structure: Structure,
    /// Coefficient of each term.
    pub coefficients: Vec<f64>,
}

/// Minimum difference between the exponent of an initial term and the exponent of an offset. Closer exponents are not
/// separately identifiable.
const OFFSET_EXPONENT_TOLERANCE: f64 = 0.05;

/// Initial conditions of a record.
#[derive(Debug, Clone, PartialEq)]
pub enum Initial {
    /// Zero initial conditions, without initial terms.
    Rest,
    /// Initial values of Caputo derivatives, as powers of the time t. An equation of order α has t^i for i = 0, …, ⌈α⌉
    /// − 1. Each of its terms of order ν adds t^{α−ν+i} for i = 0, …, ⌈ν⌉ − 1.
    Caputo,
    /// Powers of t with explicit exponents.
    Powers(Vec<f64>),
    /// Offset: an unknown constant on the right-hand side, one per record and equation, in addition to other initial
    /// conditions.
    ///
    /// Integration of an equation of order α turns a constant c into c t^α/Γ(α+1), and a ramp r t into r
    /// t^{α+1}/Γ(α+2).
    Offset {
        /// Other initial conditions, without an offset.
        base: Box<Initial>,
        /// True if there is an unknown ramp in addition to the constant.
        ramp: bool,
    },
    /// Output level: an unknown constant that is added to the simulated output, one per record and equation.
    ///
    /// It is not a term of the equation, so its value does not depend on the orders. The signals of the record are
    /// deviations from reference values, so the equation error needs no term for the level.
    Level {
        /// Other initial conditions, without an offset.
        base: Box<Initial>,
    },
    /// Sensor filter with nonzero initial conditions.
    ///
    /// Filtered signals lack the response of the filter to inputs before the record. This transient is a sum of the
    /// filter's responses to an impulse and to derivatives of an impulse.
    Filtered {
        /// Other initial conditions, which may include an offset or a level, but no filter transient.
        base: Box<Initial>,
        /// Number of filter responses in the transient, which is the relative degree of the filter.
        states: u8,
    },
}

impl Equation {
    /// Equation with one finite coefficient per term.
    ///
    /// # Errors
    /// [`Error::Length`] if the number of coefficients differs from the number of terms; [`Error::NotFinite`] for a
    /// coefficient that is not finite.
    ///
    /// ```
    /// use ftlm::equation::{Equation, Structure, Term};
    /// let structure = Structure { output: 0, order: 2.0, terms: vec![Term { signal: 0, order: 0.5 }] };
    /// assert!(Equation::new(structure.clone(), vec![-3.0]).is_ok());
    /// assert!(Equation::new(structure, vec![]).is_err());
    /// ```
    pub fn new(structure: Structure, coefficients: Vec<f64>) -> Result<Self> {
        let equation = Self { structure, coefficients };
        equation.check_coefficients()?;
        Ok(equation)
    }

    /// Return an error for an invalid equation. `signals` is the number of signals in the record. All of them except
    /// the output may have the negative orders of inputs.
    ///
    /// # Errors
    /// [`Error::Structure`] for a signal that does not exist, [`Error::OutOfRange`] for an invalid order.
    /// [`Error::Length`] for a wrong number of coefficients, [`Error::NotFinite`] for a coefficient that is not finite.
    pub fn check(&self, signals: usize) -> Result<()> {
        self.structure.check(signals, |_| true)?;
        self.check_coefficients()
    }

    fn check_coefficients(&self) -> Result<()> {
        check_length("coefficients", self.structure.terms.len(), self.coefficients.len())?;
        check_finite("coefficients", &self.coefficients)
    }
}

impl Initial {
    /// Add an unknown constant on the right-hand side (`offset` = 1), a constant and a ramp (2), or an output level
    /// (3). 0 adds nothing.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for any other value of `offset`.
    ///
    /// ```
    /// use ftlm::equation::{Initial, Structure, Term};
    /// let plant = Structure { output: 0, order: 0.8, terms: vec![Term { signal: 1, order: 0.0 }] };
    /// assert_eq!(plant.initial_exponents(&Initial::Caputo.with_offset(2)?), [0.0, 0.8, 1.8]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn with_offset(self, offset: u8) -> Result<Self> {
        match offset {
            0 => Ok(self),
            1 | 2 => Ok(Self::Offset { base: Box::new(self.base().clone()), ramp: offset == 2 }),
            3 => Ok(Self::Level { base: Box::new(self.base().clone()) }),
            _ => Err(Error::OutOfRange {
                name: "offset".into(),
                value: f64::from(offset),
                range: "{0, 1, 2, 3}".into(),
                remedy: "0 is none, 1 a constant, 2 a constant and a ramp, 3 an output level".into(),
            }),
        }
    }

    /// Add the initial transient of a sensor filter whose relative degree is `states`. 0 adds nothing.
    ///
    /// ```
    /// use ftlm::equation::{Initial, Structure};
    /// let plant = Structure { output: 0, order: 1.0, terms: vec![] };
    /// assert_eq!(plant.initial_exponents(&Initial::Caputo.with_states(2)), [-2.0, -1.0, 0.0]);
    /// ```
    #[must_use]
    pub fn with_states(self, states: u8) -> Self {
        match (self, states) {
            (initial, 0) => initial,
            (Self::Filtered { base, .. }, _) => Self::Filtered { base, states },
            (initial, _) => Self::Filtered { base: Box::new(initial), states },
        }
    }

    /// Return the initial conditions without offset, output level and filter transient.
    #[must_use]
    pub fn base(&self) -> &Self {
        match self {
            Self::Offset { base, .. } | Self::Level { base } | Self::Filtered { base, .. } => base.base(),
            other => other,
        }
    }

    /// True if an output level is unknown.
    #[must_use]
    pub fn has_level(&self) -> bool {
        match self {
            Self::Level { .. } => true,
            Self::Filtered { base, .. } => base.has_level(),
            _ => false,
        }
    }

    /// Return the initial conditions `start` with the offset, output level and filter transient of `self`.
    ///
    /// ```
    /// use ftlm::equation::Initial;
    /// let ramped = Initial::Caputo.with_offset(2)?.with_states(1);
    /// assert_eq!(ramped.with_base(Initial::Rest), Initial::Rest.with_offset(2)?.with_states(1));
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn with_base(&self, start: Self) -> Self {
        match self {
            Self::Offset { ramp, .. } => Self::Offset { base: Box::new(start), ramp: *ramp },
            Self::Level { .. } => Self::Level { base: Box::new(start) },
            Self::Filtered { base, states } => {
                Self::Filtered { base: Box::new(base.with_base(start)), states: *states }
            }
            _ => start,
        }
    }

    /// Return the initial conditions without the offset on the right-hand side. An output level remains.
    ///
    /// ```
    /// use ftlm::equation::Initial;
    /// let ramped = Initial::Caputo.with_offset(2)?.with_states(1);
    /// assert_eq!(ramped.without_offset(), Initial::Caputo.with_states(1));
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn without_offset(&self) -> Self {
        match self {
            Self::Offset { base, .. } => Self::clone(base),
            Self::Filtered { base, states } => {
                Self::Filtered { base: Box::new(base.without_offset()), states: *states }
            }
            other => other.clone(),
        }
    }

    /// True if all signals were zero before the record, apart from an offset, an output level and the filter transient.
    #[must_use]
    pub fn is_at_rest(&self) -> bool {
        *self.base() == Self::Rest
    }

    /// Return the initial conditions without the transient of a sensor filter.
    #[must_use]
    pub(crate) fn without_filter(&self) -> &Self {
        match self {
            Self::Filtered { base, .. } => base,
            other => other,
        }
    }

    /// True if exponents of the initial terms depend on the orders of the equation.
    #[must_use]
    pub fn follows_orders(&self) -> bool {
        match self {
            Self::Filtered { base, .. } | Self::Level { base } => base.follows_orders(),
            other => matches!(other, Self::Caputo | Self::Offset { .. }),
        }
    }

    /// Return the exponents of the powers of t that represent the offset in an equation of order `alpha`. The list is
    /// empty without an offset.
    pub(crate) fn offset_exponents(&self, alpha: f64) -> Vec<f64> {
        match self {
            Self::Offset { ramp: true, .. } => vec![round_order(alpha), round_order(alpha + 1.0)],
            Self::Offset { ramp: false, .. } => vec![round_order(alpha)],
            Self::Filtered { base, .. } => base.offset_exponents(alpha),
            _ => Vec::new(),
        }
    }

    /// Iterate over the exponents of the filter transient: −1 for an impulse, −2, −3, … for its derivatives.
    pub(crate) fn impulses(&self) -> impl Iterator<Item = f64> {
        let states = if let Self::Filtered { states, .. } = self { *states } else { 0 };
        (1..=states).map(|k| -f64::from(k))
    }

    /// Return an error for an explicit exponent whose power of t has no mean over the first pulse.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for an exponent of −1 or less, [`Error::NotFinite`] for an exponent that is not finite.
    pub fn check(&self) -> Result<()> {
        let Self::Powers(exponents) = self.base() else { return Ok(()) };
        check_finite("exponents of the initial terms", exponents)?;
        match exponents.iter().find(|&&e| e <= -1.0) {
            None => Ok(()),
            Some(&exponent) => Err(Error::OutOfRange {
                name: "exponent of an initial term".into(),
                value: exponent,
                range: "(-1, ∞)".into(),
                remedy: "t to this power has no mean over the first pulse".into(),
            }),
        }
    }
}

impl Structure {
    /// Return an error for invalid orders or signals. `signals` is the number of signals, and `is_input` is true for
    /// inputs.
    ///
    /// The order α must be in (0, 10], orders of output terms in [0, α), orders of inputs in [−3, α + 1), and orders of
    /// other signals in [0, α + 1).
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for an order that is out of range, [`Error::Structure`] for a signal that does not exist.
    pub fn check(&self, signals: usize, is_input: impl Fn(usize) -> bool) -> Result<()> {
        let out_of_range = |name: String, value: f64, range: String, remedy: &str| Error::OutOfRange {
            name,
            value,
            range,
            remedy: remedy.to_owned(),
        };
        if !alpha_fits(self.order) {
            return Err(out_of_range(
                "order alpha".into(),
                self.order,
                format!("(0, {MAX_ORDER}]"),
                "choose another order",
            ));
        }
        if self.output >= signals {
            return Err(missing_signal_error(self.output, signals));
        }
        for (k, term) in self.terms.iter().enumerate() {
            if term.signal >= signals {
                return Err(missing_signal_error(term.signal, signals));
            }
            let name = format!("order of term {k}");
            if term.signal == self.output {
                if !order_fits(self.order, term.order, true, false) {
                    let allowed = format!("[0, {})", self.order);
                    return Err(out_of_range(name, term.order, allowed, "an own-output order must stay below alpha"));
                }
            } else {
                let lowest = if is_input(term.signal) { MIN_INPUT_ORDER } else { 0.0 };
                let limit_order = self.order + MAX_ORDER_EXCESS;
                if !(term.order >= lowest && term.order < limit_order - ORDER_GRAIN) {
                    let allowed = format!("[{lowest}, {limit_order})");
                    return Err(out_of_range(name, term.order, allowed, "an order must stay below alpha + 1"));
                }
            }
        }
        Ok(())
    }

    /// Return the integration order α − ν of term `k`: order of the equation minus order of the term. A negative value
    /// is a differentiation.
    ///
    /// # Panics
    /// If there is no term `k`.
    #[must_use]
    pub fn integration(&self, k: usize) -> f64 {
        round_order(self.order - self.terms[k].order)
    }

    /// Return the distinct exponents of the initial terms, ascending.
    ///
    /// With an offset, powers from Caputo derivatives within 0.05 of its exponents are omitted, because they are nearly
    /// collinear with it. An example is t^1 with an equation of order 1.0003, whose offset is t^1.0003.
    #[must_use]
    pub fn initial_exponents(&self, initial: &Initial) -> Vec<f64> {
        let mut exponents = match initial.base() {
            Initial::Rest | Initial::Offset { .. } | Initial::Level { .. } | Initial::Filtered { .. } => Vec::new(),
            Initial::Powers(powers) => powers.clone(),
            Initial::Caputo => {
                let mut powers: Vec<f64> = integers_below(self.order).collect();
                for (k, term) in self.terms.iter().enumerate() {
                    powers.extend(integers_below(term.order).map(|i| round_order(self.integration(k) + i)));
                }
                powers
            }
        };
        let offset = initial.offset_exponents(self.order);
        if *initial.base() == Initial::Caputo {
            exponents.retain(|e| *e == 0.0 || offset.iter().all(|o| (e - o).abs() > OFFSET_EXPONENT_TOLERANCE));
        }
        exponents.extend(offset);
        exponents.extend(initial.impulses());
        exponents.sort_by(f64::total_cmp);
        exponents.dedup_by(|a, b| (*a - *b).abs() < ORDER_GRAIN);
        exponents
    }
}

/// True if an order α of an equation is in (0, 10].
#[must_use]
pub fn alpha_fits(alpha: f64) -> bool {
    alpha > 0.0 && alpha <= MAX_ORDER
}

/// True if an order search may use a term of this order in an equation of order `alpha`.
///
/// Orders must be in [0, α) for the output (`is_output`), in [−3, α] for an input, and in [0, α] for other signals.
/// [`Structure::check`] also admits orders up to α + 1 for other signals. A search must not use them, because a free
/// term of an order above α nearly reproduces the output.
#[must_use]
pub fn order_fits(alpha: f64, order: f64, is_output: bool, is_input: bool) -> bool {
    if is_output {
        order >= 0.0 && order < alpha - ORDER_GRAIN
    } else {
        order >= if is_input { MIN_INPUT_ORDER } else { 0.0 } && order <= alpha + ORDER_GRAIN
    }
}

pub(crate) fn missing_signal_error(signal: usize, signals: usize) -> Error {
    Error::Structure {
        what: format!("the equation contains signal {signal}, but the record has {signals} signals"),
        remedy: "give the record all signals of the equation".into(),
    }
}

/// Iterate over the integers 0, 1, … below `order`: the exponents of the powers of t whose Caputo derivative D^order is
/// zero.
fn integers_below(order: f64) -> impl Iterator<Item = f64> {
    (0_u32..).map(f64::from).take_while(move |&i| i < order.min(MAX_ORDER) - ORDER_GRAIN)
}

/// Round an order to a multiple of 1e−9, so that equal orders have equal bits.
///
/// NaN and orders of a magnitude above 9·10⁶ are returned unchanged. Floating-point numbers of this magnitude are
/// farther apart than 1e−9.
///
/// ```
/// assert_eq!(ftlm::equation::round_order(0.1 + 0.2), 0.3);
/// assert_eq!(ftlm::equation::round_order(1e12), 1e12);
/// ```
#[must_use]
pub fn round_order(order: f64) -> f64 {
    const EXACT_INTEGER_LIMIT: f64 = 9_007_199_254_740_992.0; // 2⁵³
    let units = (order * 1e9).round();
    if units.abs() < EXACT_INTEGER_LIMIT {
        // Adding 0 turns −0 into 0, so that equal orders have equal bits.
        units / 1e9 + 0.0
    } else {
        order
    }
}

/// Return an order as an integer number of units of 1e−9. This integer is the key of the regressor of this order. The
/// result saturates for magnitudes beyond 9·10⁹ and is 0 for NaN.
#[must_use]
#[allow(clippy::cast_possible_truncation)]
pub fn grains(order: f64) -> i64 {
    (order * 1e9).round() as i64
}

/// Maximum magnitude that an order law may attain within the bounds of its free orders. It is wider than the valid
/// range of an order, because that range is checked separately at every point. The memory of tables that are indexed by
/// integer order is proportional to this limit.
pub const MAX_REACHED_ORDER: f64 = 100.0;

/// Affine order law: constant + Σ weight × free order.
#[derive(Debug, Clone, PartialEq)]
pub struct AffineOrder {
    /// Constant part of the order.
    pub constant: f64,
    /// Weight of each free order.
    pub weights: Vec<f64>,
}

impl AffineOrder {
    /// Return an error for an invalid order law. `bounds` holds the lower and upper bound of each free order.
    ///
    /// # Errors
    /// [`Error::Length`] for a wrong number of weights. [`Error::OutOfRange`] if the law may exceed
    /// [`MAX_REACHED_ORDER`] in magnitude within the bounds.
    pub fn check(&self, bounds: &[(f64, f64)]) -> Result<()> {
        check_length("weights of an order", bounds.len(), self.weights.len())?;
        let free = self.weights.iter().zip(bounds).map(|(w, (low, high))| w.abs() * low.abs().max(high.abs()));
        let magnitude = self.constant.abs() + free.sum::<f64>();
        if magnitude <= MAX_REACHED_ORDER {
            return Ok(());
        }
        Err(Error::OutOfRange {
            name: "largest magnitude of an order within its bounds".into(),
            value: magnitude,
            range: format!("[0, {MAX_REACHED_ORDER}]"),
            remedy: format!("bound free orders by {MIN_INPUT_ORDER} and {MAX_ORDER}"),
        })
    }

    /// Return the value of the law at the given free orders.
    #[must_use]
    pub fn at(&self, free: &[f64]) -> f64 {
        round_order(self.constant + self.weights.iter().zip(free).map(|(w, x)| w * x).sum::<f64>())
    }
}

/// Rational filter Σ b D^ν / Σ a D^ν with coefficients b and a, such as the low-pass filter of a sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct Filter {
    /// Terms of the numerator as (coefficient, order).
    pub numerator: Vec<(f64, f64)>,
    /// Terms of the denominator as (coefficient, order).
    pub denominator: Vec<(f64, f64)>,
}

impl Filter {
    /// Return the filter as a power series in the one-step delay, with `m` coefficients, for pulses of length `step`
    /// \[s\] and zero initial conditions. O(terms · m + m log² m).
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for an improper filter, an order outside [0, 10], a step that is not positive, or too many
    /// pulses. [`Error::NotFinite`] for a coefficient that is not finite. [`Error::LeadingZero`] for a denominator that
    /// starts with zero.
    ///
    /// ```
    /// # fn main() -> ftlm::error::Result<()> {
    /// use ftlm::equation::Filter;
    /// // 1/(D + 1): a unit step rises like 1 − e^{−t}.
    /// let low_pass = Filter { numerator: vec![(1.0, 0.0)], denominator: vec![(1.0, 1.0), (1.0, 0.0)] };
    /// let rise: f64 = low_pass.series(100, 0.01)?.iter().sum();
    /// assert!((rise - (1.0 - (-0.995_f64).exp())).abs() < 1e-4);
    /// # Ok(())
    /// # }
    /// ```
    pub fn series(&self, m: usize, step: f64) -> Result<Vec<f64>> {
        check_points("m", m)?;
        check_step(step)?;
        for terms in [&self.numerator, &self.denominator] {
            let coefficients: Vec<f64> = terms.iter().map(|t| t.0).collect();
            check_finite("coefficients of the sensor filter", &coefficients)?;
        }
        let highest = self.denominator.iter().map(|t| t.1).fold(0.0, f64::max);
        let mut parts = [vec![0.0; m], vec![0.0; m]];
        for (series, terms) in parts.iter_mut().zip([&self.numerator, &self.denominator]) {
            for &(coefficient, order) in terms {
                if !(order >= 0.0 && order <= highest && highest <= MAX_ORDER) {
                    return Err(Error::OutOfRange {
                        name: "order of the sensor filter".into(),
                        value: order,
                        range: format!("[0, {}]", highest.min(MAX_ORDER)),
                        remedy: "a filter's numerator must not exceed its denominator in order".into(),
                    });
                }
                for (p, k) in series.iter_mut().zip(block_pulse_kernel(round_order(highest - order), m, step)) {
                    *p += coefficient * k;
                }
            }
        }
        let [numerator, denominator] = parts;
        series::divide(&numerator, &denominator)
    }
}

/// Maximum number n of equations that [`check_regular`] tests. The test examines all 2^n sets of columns, so larger
/// systems are not tested.
const MAX_EQUATIONS: usize = 16;

/// Leading term of a polynomial: its order, its coefficient, and the sum of the magnitudes of the products that add up
/// to the coefficient. None for the zero polynomial.
type Leading = Option<(f64, f64, f64)>;

fn add_leading_term(sum: Leading, order: f64, value: f64, size: f64) -> Leading {
    match sum {
        Some((highest, v, s)) if (order - highest).abs() < ORDER_GRAIN => Some((highest, v + value, s + size)),
        Some((highest, ..)) if order < highest => sum,
        _ => Some((order, value, size)),
    }
}

/// Return an error if coupled equations do not determine every output.
///
/// The determinant of the equations is a sum of products of powers of the Laplace variable s. The products of highest
/// order must not cancel. If they do, the equations repeat or contradict each other. Systems of more than 16 equations
/// are not tested.
///
/// # Errors
/// [`Error::Structure`] if the equations cannot be solved for all outputs.
///
/// ```
/// use ftlm::equation::{Equation, Structure, Term};
/// // D x = c D^1.5 y, D^1.5 y = D x + u: singular for c = 1.
/// let pair = |c: f64| {
///     let of = |output, order, terms, c| Equation::new(Structure { output, order, terms }, c);
///     let first = of(0, 1.0, vec![Term { signal: 1, order: 1.5 }], vec![c])?;
///     let input = Term { signal: 2, order: 0.0 };
///     ftlm::equation::check_regular(&[first, of(1, 1.5, vec![Term { signal: 0, order: 1.0 }, input], vec![1.0,
/// 1.0])?]) };
/// assert!(pair(0.5).is_ok() && pair(1.0).is_err());
/// ```
pub fn check_regular(equations: &[Equation]) -> Result<()> {
    let n = equations.len();
    if !(2..=MAX_EQUATIONS).contains(&n) {
        return Ok(());
    }
    let entry = |i: usize, j: usize| -> Leading {
        let Equation { structure, coefficients } = &equations[i];
        let output = equations[j].structure.output;
        let mut sum = (i == j).then_some((structure.order, 1.0, 1.0));
        for (term, &c) in structure.terms.iter().zip(coefficients) {
            if term.signal == output && c != 0.0 {
                sum = add_leading_term(sum, term.order, -c, c.abs());
            }
        }
        sum
    };
    let entries: Vec<Vec<Leading>> = (0..n).map(|i| (0..n).map(|j| entry(i, j)).collect()).collect();
    // Rows are processed in order, so the set of used columns is the only state.
    let mut leading: Vec<Leading> = vec![None; 1 << n];
    leading[0] = Some((0.0, 1.0, 1.0));
    for columns in 0..(1usize << n) {
        let Some((order, value, size)) = leading[columns] else { continue };
        let row = columns.count_ones() as usize;
        for j in (0..n).filter(|j| columns & (1 << j) == 0) {
            let Some((o, v, s)) = entries[row][j] else { continue };
            let later = (columns >> j).count_ones();
            let sign = if later % 2 == 0 { 1.0 } else { -1.0 };
            let next = columns | (1 << j);
            leading[next] = add_leading_term(leading[next], order + o, sign * value * v, size * s);
        }
    }
    match leading[(1 << n) - 1] {
        Some((_, value, size)) if value.abs() > 1e-12 * size => Ok(()),
        _ => Err(Error::Structure {
            what:
                "the leading matrix of the equations is singular: their terms of highest order cancel, so they do not \
                   determine their outputs"
                    .into(),
            remedy: "remove an equation that repeats another one, or change an order or a coefficient".into(),
        }),
    }
}

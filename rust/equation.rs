//! Equations of fractional order: terms, orders, order laws, initial terms, sensor filters.
//!
//! An equation is D^α y = Σ_k c_k D^{ν_k} s_k over the signals of a record. Divided by D^α it is a series equation,
//! y = Σ_k c_k I^{α−ν_k} s_k + initial terms, which is how everything else reads it.
//!
//! Whether coupled equations tell their outputs apart: the leading matrix of the system.

use crate::error::{check_finite, check_length, check_points, check_step, Error, Result};
use crate::fractional::kernels::{block_pulse_kernel, MAX_EXCESS, MAX_ORDER, MIN_INPUT_ORDER};
use crate::series;

/// Orders closer than this are one order: lattices are written in steps, not in rounding errors.
pub const ORDER_GRAIN: f64 = 1e-9;

/// One term D^ν s; its coefficient lives beside the structure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Term {
    /// Index of the signal in the record.
    pub signal: usize,
    /// Order ν; negative only for an input (an integration).
    pub order: f64,
}

/// D^α y = Σ c_k D^{ν_k} s_k without its coefficients.
#[derive(Debug, Clone, PartialEq)]
pub struct Structure {
    /// Index of the output y in the record.
    pub output: usize,
    /// Highest order α.
    pub order: f64,
    /// Terms of the right-hand side.
    pub terms: Vec<Term>,
}

/// A structure with its coefficients.
#[derive(Debug, Clone, PartialEq)]
pub struct Equation {
    /// Orders and signals.
    pub structure: Structure,
    /// One coefficient a term.
    pub coefficients: Vec<f64>,
}

/// A power of t this close to that of an offset cannot be told from it.
const STAND_IN: f64 = 0.05;

/// How a record that does not start at rest is treated.
#[derive(Debug, Clone, PartialEq)]
pub enum Initial {
    /// At rest: no initial terms.
    Rest,
    /// All powers of t that Caputo derivatives leave behind: t^i, i < ⌈α⌉, and t^{α−ν+i}, i < ⌈ν⌉.
    Caputo,
    /// These exponents.
    Powers(Vec<f64>),
    /// A constant on the right-hand side, unknown and one a record, beside what else the record starts with. Integrated
    /// with the equation it is c t^α/Γ(α + 1), so it is one more power of t; a ramp r t is r t^{α+1}/Γ(α + 2).
    Offset {
        /// How the record starts; not again an offset.
        under: Box<Initial>,
        /// Whether the constant grows in proportion to time as well.
        ramp: bool,
    },
    /// A sensor filter that is not at rest when the record starts. What the filter makes of signals from then on lacks
    /// what it still holds of the time before: free motions of the filter, which are its answers to an impulse and to
    /// derivatives of one.
    Filtered {
        /// How the record starts otherwise, an offset included; not again filtered.
        under: Box<Initial>,
        /// Number of these answers.
        states: u8,
    },
}

impl Equation {
    /// A structure with one finite coefficient a term.
    ///
    /// # Errors
    /// [`Error::Length`], [`Error::NotFinite`].
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

    /// Refuses an equation that a record of so many signals cannot carry, any of them being an input.
    ///
    /// # Errors
    /// As [`Structure::check`] and [`Equation::new`].
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
    /// The same with an unknown constant on the right-hand side (1), or a constant and a ramp (2); 0 for neither.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for another number.
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
            1 | 2 => Ok(Self::Offset { under: Box::new(self.under().clone()), ramp: offset == 2 }),
            _ => Err(Error::OutOfRange {
                name: "offset".into(),
                value: f64::from(offset),
                range: "{0, 1, 2}".into(),
                remedy: "0 is none, 1 a constant, 2 a constant and a ramp".into(),
            }),
        }
    }

    /// The same where signals passed a filter of this relative degree that was not at rest; 0 for one that was.
    ///
    /// ```
    /// use ftlm::equation::{Initial, Structure};
    /// let plant = Structure { output: 0, order: 1.0, terms: vec![] };
    /// assert_eq!(plant.initial_exponents(&Initial::Caputo.with_states(2)), [-2.0, -1.0, 0.0]);
    /// ```
    #[must_use]
    pub fn with_states(self, states: u8) -> Self {
        match (self, states) {
            (whole, 0) => whole,
            (Self::Filtered { under, .. }, _) => Self::Filtered { under, states },
            (whole, _) => Self::Filtered { under: Box::new(whole), states },
        }
    }

    /// How the record starts, an offset and a filter left aside.
    #[must_use]
    pub fn under(&self) -> &Self {
        match self {
            Self::Offset { under, .. } | Self::Filtered { under, .. } => under.under(),
            other => other,
        }
    }

    /// Another start under the same offset and filter.
    ///
    /// ```
    /// use ftlm::equation::Initial;
    /// let ramped = Initial::Caputo.with_offset(2)?.with_states(1);
    /// assert_eq!(ramped.with_under(Initial::Rest), Initial::Rest.with_offset(2)?.with_states(1));
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn with_under(&self, start: Self) -> Self {
        match self {
            Self::Offset { ramp, .. } => Self::Offset { under: Box::new(start), ramp: *ramp },
            Self::Filtered { under, states } => {
                Self::Filtered { under: Box::new(under.with_under(start)), states: *states }
            }
            _ => start,
        }
    }

    /// The same start without an offset.
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
            Self::Offset { under, .. } => Self::clone(under),
            Self::Filtered { under, states } => {
                Self::Filtered { under: Box::new(under.without_offset()), states: *states }
            }
            other => other.clone(),
        }
    }

    /// Whether the record starts at rest: before it all signals were zero.
    #[must_use]
    pub fn at_rest(&self) -> bool {
        *self.under() == Self::Rest
    }

    /// The same of an output that no filter stands behind.
    #[must_use]
    pub(crate) fn unfiltered(&self) -> &Self {
        match self {
            Self::Filtered { under, .. } => under,
            other => other,
        }
    }

    /// Whether exponents depend on the orders of the equation.
    #[must_use]
    pub fn follows_orders(&self) -> bool {
        match self {
            Self::Filtered { under, .. } => under.follows_orders(),
            other => matches!(other, Self::Caputo | Self::Offset { .. }),
        }
    }

    /// Powers of t that an offset is, integrated under this α.
    pub(crate) fn offset_exponents(&self, alpha: f64) -> Vec<f64> {
        match self {
            Self::Offset { ramp: true, .. } => vec![tidy(alpha), tidy(alpha + 1.0)],
            Self::Offset { ramp: false, .. } => vec![tidy(alpha)],
            Self::Filtered { under, .. } => under.offset_exponents(alpha),
            _ => Vec::new(),
        }
    }

    /// Exponents that stand for an impulse, −1, and its derivatives, −2 and on.
    pub(crate) fn impulses(&self) -> impl Iterator<Item = f64> {
        let states = if let Self::Filtered { states, .. } = self { *states } else { 0 };
        (1..=states).map(|k| -f64::from(k))
    }

    /// Refuses exponents whose power of t has no mean over the first pulse.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for an exponent of −1 or less, [`Error::NotFinite`].
    pub fn check(&self) -> Result<()> {
        let Self::Powers(exponents) = self.under() else { return Ok(()) };
        check_finite("exponents of the initial terms", exponents)?;
        match exponents.iter().find(|&&e| e <= -1.0) {
            None => Ok(()),
            Some(&bad) => Err(Error::OutOfRange {
                name: "exponent of an initial term".into(),
                value: bad,
                range: "(-1, ∞)".into(),
                remedy: "t to this power has no mean over the first pulse".into(),
            }),
        }
    }
}

impl Structure {
    /// Refuses orders that make no equation: α outside (0, 10], an own-output order outside [0, α), another outside
    /// [0, α + 1) (an input's may be negative down to −3).
    ///
    /// # Errors
    /// [`Error::OutOfRange`] naming the term, [`Error::Structure`] for a signal that is not there.
    pub fn check(&self, signals: usize, is_input: impl Fn(usize) -> bool) -> Result<()> {
        let range = |name: String, value: f64, range: String, remedy: &str| Error::OutOfRange {
            name,
            value,
            range,
            remedy: remedy.to_owned(),
        };
        if !alpha_fits(self.order) {
            return Err(range("order alpha".into(), self.order, format!("(0, {MAX_ORDER}]"), "choose another order"));
        }
        if self.output >= signals {
            return Err(missing(self.output, signals));
        }
        for (k, term) in self.terms.iter().enumerate() {
            if term.signal >= signals {
                return Err(missing(term.signal, signals));
            }
            let name = format!("order of term {k}");
            if term.signal == self.output {
                if !order_fits(self.order, term.order, true, false) {
                    let allowed = format!("[0, {})", self.order);
                    return Err(range(name, term.order, allowed, "an own-output order must stay below alpha"));
                }
            } else {
                let lowest = if is_input(term.signal) { MIN_INPUT_ORDER } else { 0.0 };
                let beyond = self.order + MAX_EXCESS;
                if !(term.order >= lowest && term.order < beyond - ORDER_GRAIN) {
                    let allowed = format!("[{lowest}, {beyond})");
                    return Err(range(name, term.order, allowed, "an order must stay below alpha + 1"));
                }
            }
        }
        Ok(())
    }

    /// Order α − ν by which term k is integrated; below 0 it is differentiated.
    #[must_use]
    pub fn integration(&self, k: usize) -> f64 {
        tidy(self.order - self.terms[k].order)
    }

    /// Exponents of the initial terms, distinct and ascending.
    ///
    /// Beside an offset, which is t^α, Caputo's powers within 0.05 of it are left out: an order just above a whole one
    /// brings a power that just below it is not there, and t beside D^1.0003 is the offset by another name.
    #[must_use]
    pub fn initial_exponents(&self, initial: &Initial) -> Vec<f64> {
        let mut exponents = match initial.under() {
            Initial::Rest | Initial::Offset { .. } | Initial::Filtered { .. } => Vec::new(),
            Initial::Powers(powers) => powers.clone(),
            Initial::Caputo => {
                let mut all: Vec<f64> = whole_below(self.order).collect();
                for (k, term) in self.terms.iter().enumerate() {
                    all.extend(whole_below(term.order).map(|i| tidy(self.integration(k) + i)));
                }
                all
            }
        };
        let offset = initial.offset_exponents(self.order);
        if *initial.under() == Initial::Caputo {
            exponents.retain(|e| *e == 0.0 || offset.iter().all(|o| (e - o).abs() > STAND_IN));
        }
        exponents.extend(offset);
        exponents.extend(initial.impulses());
        exponents.sort_by(f64::total_cmp);
        exponents.dedup_by(|a, b| (*a - *b).abs() < ORDER_GRAIN);
        exponents
    }
}

/// Whether a highest order is in (0, 10].
#[must_use]
pub fn alpha_fits(alpha: f64) -> bool {
    alpha > 0.0 && alpha <= MAX_ORDER
}

/// Whether a search tries a term of this order under α: of the output itself in [0, α), of another signal in [0, α], of
/// an input in [−3, α]. Of another signal [`Structure::check`] lets more pass: beyond α a freely chosen term is a way to
/// say that the output nearly equals itself.
#[must_use]
pub fn order_fits(alpha: f64, order: f64, own: bool, input: bool) -> bool {
    if own {
        order >= 0.0 && order < alpha - ORDER_GRAIN
    } else {
        order >= if input { MIN_INPUT_ORDER } else { 0.0 } && order <= alpha + ORDER_GRAIN
    }
}

fn missing(signal: usize, signals: usize) -> Error {
    Error::Structure {
        what: format!("the equation names signal {signal}, but the record holds {signals}"),
        remedy: "give the record all signals of the equation".into(),
    }
}

/// 0, 1, … below `order`: the powers of t that D^order annihilates.
fn whole_below(order: f64) -> impl Iterator<Item = f64> {
    (0_u32..).map(f64::from).take_while(move |&i| i < order.min(MAX_ORDER) - ORDER_GRAIN)
}

/// An order rounded to the grain, so that equal orders are equal bits.
#[must_use]
pub fn tidy(order: f64) -> f64 {
    let units = grains(order);
    #[allow(clippy::cast_precision_loss)]
    let tidied = units as f64 / 1e9;
    tidied
}

/// An order in units of the grain: the key under which its regressor is kept.
#[must_use]
#[allow(clippy::cast_possible_truncation)]
pub fn grains(order: f64) -> i64 {
    (order * 1e9).round() as i64
}

/// An affine order law: constant + Σ weight·free order.
#[derive(Debug, Clone, PartialEq)]
pub struct AffineOrder {
    /// Constant part.
    pub constant: f64,
    /// Weight of each free order.
    pub weights: Vec<f64>,
}

impl AffineOrder {
    /// Value at these free orders.
    #[must_use]
    pub fn at(&self, free: &[f64]) -> f64 {
        tidy(self.constant + self.weights.iter().zip(free).map(|(w, x)| w * x).sum::<f64>())
    }
}

/// A rational filter Σ b D^ν / Σ a D^ν, such as the low-pass that a logged deflection went through.
#[derive(Debug, Clone, PartialEq)]
pub struct Filter {
    /// (coefficient, order) of the numerator.
    pub numerator: Vec<(f64, f64)>,
    /// (coefficient, order) of the denominator.
    pub denominator: Vec<(f64, f64)>,
}

impl Filter {
    /// The filter as a series of m pulses of `step` s, at rest before the record. O(terms · m + m log² m).
    ///
    /// # Errors
    /// An improper filter, an order outside [0, 10], a denominator that starts with zero, a number that is not finite, a
    /// step that is not positive, more points than memory holds.
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
        for (part, terms) in parts.iter_mut().zip([&self.numerator, &self.denominator]) {
            for &(coefficient, order) in terms {
                if !(order >= 0.0 && order <= highest && highest <= MAX_ORDER) {
                    return Err(Error::OutOfRange {
                        name: "order of the sensor filter".into(),
                        value: order,
                        range: format!("[0, {}]", highest.min(MAX_ORDER)),
                        remedy: "a filter's numerator must not exceed its denominator in order".into(),
                    });
                }
                for (p, k) in part.iter_mut().zip(block_pulse_kernel(tidy(highest - order), m, step)) {
                    *p += coefficient * k;
                }
            }
        }
        let [numerator, denominator] = parts;
        series::divide(&numerator, &denominator)
    }
}

/// All choices of columns are looked at, 2^n of them; a larger system goes unlooked.
const MOST_EQUATIONS: usize = 16;

/// Highest order of an entry of the system, its coefficient, and the sum of sizes that this coefficient is made of.
type Leading = Option<(f64, f64, f64)>;

fn added(sum: Leading, order: f64, value: f64, size: f64) -> Leading {
    match sum {
        Some((highest, v, s)) if (order - highest).abs() < ORDER_GRAIN => Some((highest, v + value, s + size)),
        Some((highest, ..)) if order < highest => sum,
        _ => Some((order, value, size)),
    }
}

/// Refuses equations that together leave some output undetermined: as operators in s their determinant must be of the
/// order that its largest products say. Where those cancel, the equations repeat or contradict each other.
///
/// # Errors
/// [`Error::Structure`].
///
/// ```
/// use ftlm::equation::{Equation, Structure, Term};
/// // D x = c D^1.5 y, D^1.5 y = D x + u: the same twice where c is 1.
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
    if !(2..=MOST_EQUATIONS).contains(&n) {
        return Ok(());
    }
    let entry = |i: usize, j: usize| -> Leading {
        let Equation { structure, coefficients } = &equations[i];
        let output = equations[j].structure.output;
        let mut sum = (i == j).then_some((structure.order, 1.0, 1.0));
        for (term, &c) in structure.terms.iter().zip(coefficients) {
            if term.signal == output && c != 0.0 {
                sum = added(sum, term.order, -c, c.abs());
            }
        }
        sum
    };
    let entries: Vec<Vec<Leading>> = (0..n).map(|i| (0..n).map(|j| entry(i, j)).collect()).collect();
    // Rows are taken in order; which columns they took is all that the rest needs to know.
    let mut taken: Vec<Leading> = vec![None; 1 << n];
    taken[0] = Some((0.0, 1.0, 1.0));
    for columns in 0..(1usize << n) {
        let Some((order, value, size)) = taken[columns] else { continue };
        let row = columns.count_ones() as usize;
        for j in (0..n).filter(|j| columns & (1 << j) == 0) {
            let Some((o, v, s)) = entries[row][j] else { continue };
            let later = (columns >> j).count_ones();
            let sign = if later % 2 == 0 { 1.0 } else { -1.0 };
            let next = columns | (1 << j);
            taken[next] = added(taken[next], order + o, sign * value * v, size * s);
        }
    }
    match taken[(1 << n) - 1] {
        Some((_, value, size)) if value.abs() > 1e-12 * size => Ok(()),
        _ => Err(Error::Structure {
            what:
                "the leading matrix of the equations is singular: their highest orders cancel each other, so they do \
                   not tell their outputs apart"
                    .into(),
            remedy: "take out an equation that repeats another, or change an order or a coefficient".into(),
        }),
    }
}

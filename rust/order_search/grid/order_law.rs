//! Order grid under an order law: a few free orders determine the orders of all coupled equations.

use crate::equation::{alpha_fits, order_fits, round_order, AffineOrder, Structure, Term, ORDER_GRAIN};
use crate::error::{check_finite, Error, Result};
use crate::fractional::kernels::MAX_ORDER_EXCESS;

/// Maximum number of combinations of values of the free orders. The cost of a search depends on the distinct orders of
/// its equations.
pub const MAX_TUPLES: u128 = 5_000_000_000;

/// Equation under an order law. Its highest order α and the orders of its terms are affine functions of the free
/// orders.
#[derive(Debug, Clone, PartialEq)]
pub struct LawEquation {
    /// Signal index of the output.
    pub output: usize,
    /// Order law of the highest order α.
    pub order: AffineOrder,
    /// Signal index and order law of each term.
    pub terms: Vec<(usize, AffineOrder)>,
}

/// Grid of free orders under an order law. Combinations of free orders that give an invalid equation are excluded.
#[derive(Debug, Clone)]
pub struct OrderLawGrid {
    /// Values of each free order, ascending.
    axes: Vec<Vec<f64>>,
    equations: Vec<LawEquation>,
    /// True for each signal that is an input.
    inputs: Vec<bool>,
    /// Number of combinations of values of the free orders.
    product: u64,
    /// Output and term index of each term with a fixed coefficient.
    fixed_coefficient_terms: Vec<(usize, usize)>,
}

impl OrderLawGrid {
    /// Build the grid from the values of each free order and the equations. `inputs[s]` is true if signal s is an
    /// input.
    ///
    /// # Errors
    /// [`Error::EmptyOrderGrid`] for a free order without values. [`Error::OrderGridTooLarge`] for more than
    /// [`MAX_TUPLES`] combinations. [`Error::NotFinite`] for an order or a law that is not finite. [`Error::Structure`]
    /// without an equation, or for a signal or free order that does not exist.
    ///
    /// ```
    /// # use ftlm::equation::AffineOrder;
    /// # use ftlm::order_search::grid::{LawEquation, OrderLawGrid};
    /// // D^α y = c D^{α−1} u for a free α.
    /// let law = |constant: f64| AffineOrder { constant, weights: vec![1.0] };
    /// let equation = LawEquation { output: 0, order: law(0.0), terms: vec![(1, law(-1.0))] };
    /// let grid = OrderLawGrid::new(&[vec![0.5, 1.5]], &[equation], &[false, false])?;
    /// assert_eq!((grid.product(), grid.free(1)), (2, vec![1.5]));
    /// // Only inputs may have an order below 0.
    /// assert!(grid.structures(0).is_none());
    /// assert_eq!(grid.structures(1).map(|all| all[0].terms[0].order), Some(0.5));
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn new(axes: &[Vec<f64>], equations: &[LawEquation], inputs: &[bool]) -> Result<Self> {
        for (axis, values) in axes.iter().enumerate() {
            check_finite(&format!("values of free order {axis}"), values)?;
        }
        if equations.is_empty() {
            let what = "the coupled search has no equation".into();
            return Err(Error::Structure { what, remedy: "give at least one equation".into() });
        }
        equations.iter().try_for_each(|equation| equation.check(axes.len(), inputs.len()))?;
        let axes: Vec<Vec<f64>> = axes
            .iter()
            .map(|axis| {
                let mut axis: Vec<f64> = axis.iter().map(|&v| round_order(v)).collect();
                axis.sort_by(f64::total_cmp);
                axis.dedup();
                axis
            })
            .collect();
        if let Some(empty) = axes.iter().position(Vec::is_empty) {
            return Err(Error::EmptyOrderGrid { reason: format!("free order {empty} has no value") });
        }
        let product = axes.iter().fold(1u128, |p, a| p.saturating_mul(a.len() as u128));
        match u64::try_from(product) {
            Ok(count) if product <= MAX_TUPLES => Ok(Self {
                axes,
                equations: equations.to_vec(),
                inputs: inputs.to_vec(),
                product: count,
                fixed_coefficient_terms: Vec::new(),
            }),
            _ => Err(Error::OrderGridTooLarge { count: product, limit: MAX_TUPLES }),
        }
    }

    /// Return the grid with fixed coefficients: `fixed[e]` has one entry per term of equation e, `None` for a free
    /// coefficient. A term of another output with a fixed coefficient may have an order above the α of its equation.
    ///
    /// A term above α with a free coefficient is excluded, because it would nearly equate an output with itself.
    #[must_use]
    pub fn with_fixed_coefficients(mut self, fixed: &[Vec<Option<f64>>]) -> Self {
        let terms = self.equations.iter().zip(fixed).flat_map(|(equation, fixed)| {
            let fixed_terms = fixed.iter().enumerate().filter(|(_, value)| value.is_some());
            fixed_terms.map(|(k, _)| (equation.output, k))
        });
        self.fixed_coefficient_terms = terms.collect();
        self
    }

    /// Return [`Error::Structure`] if an equation refers to a signal that does not exist among `signals` signals.
    pub(crate) fn check_signals(&self, signals: usize) -> Result<()> {
        self.equations.iter().try_for_each(|equation| equation.check(self.axes.len(), signals))
    }

    /// Return the number of combinations of values of the free orders. Candidates are those for which
    /// [`Self::structures`] is not `None`.
    #[must_use]
    pub fn product(&self) -> u64 {
        self.product
    }

    /// Return the coupled equations.
    #[must_use]
    pub fn equations(&self) -> &[LawEquation] {
        &self.equations
    }

    /// Return the free orders at an index of the grid. The first free order varies slowest. An index beyond the end
    /// wraps around.
    #[must_use]
    pub fn free(&self, index: u64) -> Vec<f64> {
        let mut remaining = index;
        let mut free: Vec<f64> = self
            .axes
            .iter()
            .rev()
            .map(|axis| {
                let len = axis.len() as u64;
                #[allow(clippy::cast_possible_truncation)]
                let value = axis[(remaining % len) as usize];
                remaining /= len;
                value
            })
            .collect();
        free.reverse();
        free
    }

    /// Return the structure of each equation at an index of the grid. `None` if an order is out of range or two orders
    /// of a signal coincide.
    #[must_use]
    pub fn structures(&self, index: u64) -> Option<Vec<Structure>> {
        let free = self.free(index);
        self.equations
            .iter()
            .map(|equation| {
                let orders: Vec<f64> = equation.laws().map(|law| law.at(&free)).collect();
                self.are_valid_orders(equation, &orders).then(|| {
                    let terms = equation.terms.iter().zip(&orders[1..]);
                    let terms = terms.map(|(&(signal, _), &order)| Term { signal, order }).collect();
                    Structure { output: equation.output, order: orders[0], terms }
                })
            })
            .collect()
    }

    /// Return the values of each free order, ascending.
    pub(crate) fn axes(&self) -> &[Vec<f64>] {
        &self.axes
    }

    /// Return true if α and the orders of the terms are valid, and the orders of each signal are distinct. `orders`
    /// contains α, then one order per term.
    pub(crate) fn are_valid_orders(&self, equation: &LawEquation, orders: &[f64]) -> bool {
        let alpha = orders[0];
        let input = |s: usize| self.inputs.get(s).copied().unwrap_or(false);
        let fit = |k: usize, signal: usize, order: f64| {
            let is_output = signal == equation.output;
            order_fits(alpha, order, is_output, input(signal))
                || !is_output
                    && !input(signal)
                    && order > alpha
                    && order < alpha + MAX_ORDER_EXCESS - ORDER_GRAIN
                    && self.fixed_coefficient_terms.contains(&(equation.output, k))
        };
        alpha_fits(alpha)
            && equation.terms.iter().zip(&orders[1..]).enumerate().all(|(k, (term, &order))| fit(k, term.0, order))
            && equation.terms.iter().enumerate().all(|(a, (signal, _))| {
                let before = equation.terms[..a].iter().zip(&orders[1..]);
                before.into_iter().all(|((s, _), v)| s != signal || (v - orders[a + 1]).abs() > ORDER_GRAIN)
            })
    }
}

impl LawEquation {
    /// Return an error if the equation refers to a signal or free order that does not exist, or if a law is not finite.
    /// `free` and `signals` are the numbers of free orders and signals.
    fn check(&self, free: usize, signals: usize) -> Result<()> {
        for signal in std::iter::once(self.output).chain(self.terms.iter().map(|term| term.0)) {
            if signal >= signals {
                return Err(Error::Structure {
                    what: format!("an equation contains signal {signal}, but the number of signals is {signals}"),
                    remedy: "give the values of all signals, and number them from 0".into(),
                });
            }
        }
        for law in self.laws() {
            check_finite("order law", std::slice::from_ref(&law.constant))?;
            check_finite("weights of an order law", &law.weights)?;
            if law.weights.len() > free {
                return Err(Error::Structure {
                    what: format!(
                        "an order law has {} weights, but the number of free orders is {free}",
                        law.weights.len()
                    ),
                    remedy: "give values for every free order that the law contains".into(),
                });
            }
        }
        Ok(())
    }

    /// Iterate over the order laws: of α, then of each term.
    pub(crate) fn laws(&self) -> impl Iterator<Item = &AffineOrder> {
        std::iter::once(&self.order).chain(self.terms.iter().map(|t| &t.1))
    }
}

//! The candidates of an order search, enumerable by index without being stored.

use crate::equation::{tidy, AffineOrder, Structure, Term, ORDER_GRAIN};
use crate::error::{Error, Result};
use crate::fractional::MAX_ORDER;

/// Most candidates that one search takes; at a microsecond each this is minutes.
pub const MAX_CANDIDATES: u128 = 500_000_000;

/// Values that the order of one term may take.
#[derive(Debug, Clone, PartialEq)]
pub struct TermAxis {
    /// Signal of the term.
    pub signal: usize,
    /// Allowed orders, in any order; those outside an α's range are left out for that α.
    pub values: Vec<f64>,
    /// Whether this term may be swapped with another of the same signal (both coefficients free).
    pub interchangeable: bool,
}

/// All orders of one equation: α from a list, each term's order from its axis.
///
/// Own-output orders satisfy 0 ≤ ν < α, others 0 ≤ ν ≤ α (a value below 0 is allowed for inputs). Orders of one signal
/// are distinct; interchangeable ones are unordered (the larger first).
#[derive(Debug, Clone)]
pub struct Lattice {
    output: usize,
    signals: Vec<usize>,
    blocks: Vec<Block>,
    count: u64,
}

/// All candidates of one α: the product of its groups.
#[derive(Debug, Clone)]
pub(crate) struct Block {
    pub(crate) alpha: f64,
    pub(crate) start: u64,
    pub(crate) groups: Vec<Group>,
}

/// The order tuples of the terms of one signal.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    /// Terms, by position in the equation.
    pub(crate) terms: Vec<usize>,
    /// Tuples, one after the other.
    pub(crate) orders: Vec<f64>,
}

impl Group {
    pub(crate) fn count(&self) -> usize {
        self.orders.len() / self.terms.len()
    }
}

impl Lattice {
    /// Enumerates; `is_input` tells which signals may carry a negative order.
    ///
    /// # Errors
    /// [`Error::EmptyLattice`], [`Error::LatticeTooLarge`], or an α outside (0, 3].
    pub fn new(output: usize, alphas: &[f64], terms: &[TermAxis], is_input: impl Fn(usize) -> bool) -> Result<Self> {
        let mut alphas: Vec<f64> = alphas.iter().map(|&a| tidy(a)).collect();
        alphas.sort_by(f64::total_cmp);
        alphas.dedup();
        if let Some(&bad) = alphas.iter().find(|&&a| !(a > 0.0 && a <= MAX_ORDER)) {
            return Err(Error::OutOfRange {
                name: "order alpha".into(),
                value: bad,
                range: format!("(0, {MAX_ORDER}]"),
                remedy: "move the interval of alpha".into(),
            });
        }
        let mut signals: Vec<usize> = Vec::new();
        for term in terms {
            if !signals.contains(&term.signal) {
                signals.push(term.signal);
            }
        }
        let mut blocks = Vec::new();
        let mut count: u128 = 0;
        let mut why = "no value of alpha".to_owned();
        for &alpha in &alphas {
            let mut groups = Vec::with_capacity(signals.len());
            let mut size: u128 = 1;
            for &signal in &signals {
                let own = signal == output;
                let lowest = if is_input(signal) { -MAX_ORDER } else { 0.0 };
                let members: Vec<usize> = (0..terms.len()).filter(|&k| terms[k].signal == signal).collect();
                let axes: Vec<Vec<f64>> = members.iter().map(|&k| values(&terms[k], alpha, own, lowest)).collect();
                let largest: u128 = axes.iter().map(|a| a.len() as u128).product();
                if largest > MAX_CANDIDATES {
                    return Err(Error::LatticeTooLarge {
                        count: largest * alphas.len() as u128,
                        limit: MAX_CANDIDATES,
                    });
                }
                let swappable: Vec<bool> = members.iter().map(|&k| terms[k].interchangeable).collect();
                let orders = tuples(&axes, &swappable);
                if orders.is_empty() {
                    why = format!("no orders of signal {signal} fit below alpha = {alpha}");
                }
                let group = Group { terms: members, orders };
                size *= group.count() as u128;
                groups.push(group);
            }
            if size > 0 {
                let start =
                    u64::try_from(count).map_err(|_| Error::LatticeTooLarge { count, limit: MAX_CANDIDATES })?;
                blocks.push(Block { alpha, start, groups });
                count += size;
            }
        }
        if count == 0 {
            return Err(Error::EmptyLattice { why });
        }
        match u64::try_from(count) {
            Ok(count) if u128::from(count) <= MAX_CANDIDATES => Ok(Self { output, signals, blocks, count }),
            _ => Err(Error::LatticeTooLarge { count, limit: MAX_CANDIDATES }),
        }
    }

    /// Number of candidates.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Output of the equation.
    #[must_use]
    pub fn output(&self) -> usize {
        self.output
    }

    pub(crate) fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    /// The block of a candidate and the tuple of each of its groups.
    pub(crate) fn locate(&self, index: u64, tuples: &mut Vec<usize>) -> usize {
        let block = self.blocks.partition_point(|b| b.start <= index).saturating_sub(1);
        let mut rest = index - self.blocks[block].start;
        tuples.clear();
        for group in self.blocks[block].groups.iter().rev() {
            let count = group.count() as u64;
            #[allow(clippy::cast_possible_truncation)]
            tuples.push((rest % count) as usize);
            rest /= count;
        }
        tuples.reverse();
        block
    }

    /// Orders of a candidate: its structure.
    #[must_use]
    pub fn structure(&self, index: u64) -> Structure {
        let mut tuples = Vec::new();
        let block = &self.blocks[self.locate(index, &mut tuples)];
        let size = block.groups.iter().map(|g| g.terms.len()).sum();
        let mut terms = vec![Term { signal: 0, order: 0.0 }; size];
        for ((group, &tuple), &signal) in block.groups.iter().zip(&tuples).zip(&self.signals) {
            let width = group.terms.len();
            for (position, &k) in group.terms.iter().enumerate() {
                terms[k] = Term { signal, order: group.orders[tuple * width + position] };
            }
        }
        Structure { output: self.output, order: block.alpha, terms }
    }
}

fn values(term: &TermAxis, alpha: f64, own: bool, lowest: f64) -> Vec<f64> {
    let mut values: Vec<f64> = term
        .values
        .iter()
        .map(|&v| tidy(v))
        .filter(|&v| v >= lowest - ORDER_GRAIN && if own { v < alpha - ORDER_GRAIN } else { v <= alpha + ORDER_GRAIN })
        .collect();
    values.sort_by(|a, b| b.total_cmp(a));
    values.dedup();
    values
}

/// Distinct tuples of the axes' product, those that only swap interchangeable members left out; flat.
fn tuples(axes: &[Vec<f64>], swappable: &[bool]) -> Vec<f64> {
    let width = axes.len();
    let mut out = Vec::new();
    let mut at = vec![0usize; width];
    if axes.iter().any(Vec::is_empty) {
        return out;
    }
    loop {
        let tuple: Vec<f64> = at.iter().zip(axes).map(|(&i, axis)| axis[i]).collect();
        let distinct = (0..width).all(|a| tuple[..a].iter().all(|v| (v - tuple[a]).abs() > ORDER_GRAIN));
        // Of two tuples that a swap turns into each other the one with the larger order first stands for both.
        let smaller_twin = || {
            (0..width).any(|a| {
                (a + 1..width).any(|b| {
                    swappable[a]
                        && swappable[b]
                        && tuple[a] < tuple[b]
                        && axes[a].contains(&tuple[b])
                        && axes[b].contains(&tuple[a])
                })
            })
        };
        if distinct && !smaller_twin() {
            out.extend_from_slice(&tuple);
        }
        let mut digit = width;
        loop {
            if digit == 0 {
                return out;
            }
            digit -= 1;
            at[digit] += 1;
            if at[digit] < axes[digit].len() {
                break;
            }
            at[digit] = 0;
        }
    }
}

/// One equation of a stage: its α and its terms' orders as affine functions of the stage's free orders.
#[derive(Debug, Clone, PartialEq)]
pub struct LawEquation {
    /// Output of the equation.
    pub output: usize,
    /// α.
    pub order: AffineOrder,
    /// Signal and order of each term.
    pub terms: Vec<(usize, AffineOrder)>,
}

/// The product of free orders under an order law; tuples that make no equation are left out.
#[derive(Debug, Clone)]
pub struct LawLattice {
    axes: Vec<Vec<f64>>,
    equations: Vec<LawEquation>,
    inputs: Vec<bool>,
    product: u64,
}

impl LawLattice {
    /// Takes the values of each free order and the equations; `inputs[s]` tells whether signal s is an input.
    ///
    /// # Errors
    /// [`Error::EmptyLattice`] where an axis is empty, [`Error::LatticeTooLarge`] for the product of the axes.
    pub fn new(axes: &[Vec<f64>], equations: &[LawEquation], inputs: &[bool]) -> Result<Self> {
        let axes: Vec<Vec<f64>> = axes
            .iter()
            .map(|axis| {
                let mut axis: Vec<f64> = axis.iter().map(|&v| tidy(v)).collect();
                axis.sort_by(f64::total_cmp);
                axis.dedup();
                axis
            })
            .collect();
        if let Some(empty) = axes.iter().position(Vec::is_empty) {
            return Err(Error::EmptyLattice { why: format!("free order {empty} has no value") });
        }
        let product: u128 = axes.iter().map(|a| a.len() as u128).product();
        match u64::try_from(product) {
            Ok(count) if product <= MAX_CANDIDATES => {
                Ok(Self { axes, equations: equations.to_vec(), inputs: inputs.to_vec(), product: count })
            }
            _ => Err(Error::LatticeTooLarge { count: product, limit: MAX_CANDIDATES }),
        }
    }

    /// Size of the product of the axes; candidates are those of its indices that [`LawLattice::structures`] accepts.
    #[must_use]
    pub fn product(&self) -> u64 {
        self.product
    }

    /// The equations.
    #[must_use]
    pub fn equations(&self) -> &[LawEquation] {
        &self.equations
    }

    /// Free orders at an index of the product, the first the slowest.
    #[must_use]
    pub fn free(&self, index: u64) -> Vec<f64> {
        let mut rest = index;
        let mut free: Vec<f64> = self
            .axes
            .iter()
            .rev()
            .map(|axis| {
                let len = axis.len() as u64;
                #[allow(clippy::cast_possible_truncation)]
                let value = axis[(rest % len) as usize];
                rest /= len;
                value
            })
            .collect();
        free.reverse();
        free
    }

    /// The structures at an index, or none where an order is out of range or two orders of a signal coincide.
    #[must_use]
    pub fn structures(&self, index: u64) -> Option<Vec<Structure>> {
        let free = self.free(index);
        self.equations
            .iter()
            .map(|equation| {
                let terms: Vec<Term> =
                    equation.terms.iter().map(|(signal, law)| Term { signal: *signal, order: law.at(&free) }).collect();
                let structure = Structure { output: equation.output, order: equation.order.at(&free), terms };
                let distinct = structure.terms.iter().enumerate().all(|(a, t)| {
                    structure.terms[..a].iter().all(|s| s.signal != t.signal || (s.order - t.order).abs() > ORDER_GRAIN)
                });
                let fits = structure.check(self.inputs.len(), |s| self.inputs[s]).is_ok();
                (distinct && fits).then_some(structure)
            })
            .collect()
    }
}

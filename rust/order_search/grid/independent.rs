//! The independent lattice: α from a list, the order of each term from an axis of its own.

use crate::equation::{tidy, ORDER_GRAIN};
use crate::error::{check_finite, Error, Result};
use crate::fractional::excess::MAX_EXCESS;
use crate::fractional::kernels::{MAX_ORDER, MIN_INPUT_ORDER};
use crate::order_search::grid::tuples::{Group, Slice};

/// Most candidates that one search takes: an hour or so where bounds and early stopping do their work.
pub const MAX_CANDIDATES: u128 = 10_000_000_000;
/// Most prefixes of tuples whose completions are counted when a lattice is laid out: a few seconds.
const MAX_PREFIXES: u128 = 1 << 28;
/// Most terms of one signal: the number of ways to swap so many just fits 128 bits.
const MAX_TERMS: usize = 34;

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
/// are distinct; interchangeable ones are unordered (the larger first). Indices ascend in α; within an α the last
/// signal's tuple runs fastest, within a tuple its last order, both from the largest down.
#[derive(Debug, Clone)]
pub struct Lattice {
    output: usize,
    width: usize,
    pub(super) groups: Vec<Group>,
    pub(super) blocks: Vec<Block>,
    pub(super) count: u64,
}

/// All candidates of one α: the product of its groups' tuples.
#[derive(Debug, Clone)]
pub(crate) struct Block {
    pub(crate) alpha: f64,
    pub(crate) start: u64,
    pub(crate) slices: Vec<Slice>,
}

impl Lattice {
    /// Lays out the axes; `is_input` tells which signals may carry a negative order.
    ///
    /// # Errors
    /// [`Error::EmptyLattice`], [`Error::LatticeTooLarge`] before anything of that size is gone through, an α outside
    /// (0, 10], [`Error::NotFinite`] for an order that is no number, [`Error::Structure`] for more than 34 terms of one
    /// signal.
    ///
    /// ```
    /// # use ftlm::order_search::grid::independent::{Lattice, TermAxis};
    /// // Two own terms that may be swapped, and the input at order 0.
    /// let own = TermAxis { signal: 0, values: vec![0.0, 0.5, 1.0], interchangeable: true };
    /// let input = TermAxis { signal: 1, values: vec![0.0], interchangeable: false };
    /// let lattice = Lattice::new(0, &[0.8, 1.2], &[own.clone(), own, input], |signal| signal == 1)?;
    /// // (0.5, 0) below 0.8; (1, 0.5), (1, 0), (0.5, 0) below 1.2.
    /// assert_eq!(lattice.count(), 4);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn new(output: usize, alphas: &[f64], terms: &[TermAxis], is_input: impl Fn(usize) -> bool) -> Result<Self> {
        check_finite("values of alpha", alphas)?;
        for (k, term) in terms.iter().enumerate() {
            check_finite(&format!("orders of term {k}"), &term.values)?;
        }
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
        let members =
            |signal: usize| -> Vec<usize> { (0..terms.len()).filter(|&k| terms[k].signal == signal).collect() };
        let axes: Vec<Vec<Vec<f64>>> = signals
            .iter()
            .map(|&signal| {
                let lowest = if is_input(signal) { MIN_INPUT_ORDER } else { 0.0 };
                members(signal).iter().map(|&k| values(&terms[k], lowest)).collect()
            })
            .collect();
        let only = alphas.len() == 1;
        // First position in range of every axis, per α and signal.
        let firsts: Vec<Vec<Vec<usize>>> = alphas
            .iter()
            .map(|&alpha| {
                // What is searched stays at alpha or below; an order that is asked for beside one alpha need not.
                let highest = |own: bool, count: usize| match (own, only && count == 1) {
                    (true, _) => alpha - ORDER_GRAIN,
                    (false, false) => alpha + ORDER_GRAIN,
                    (false, true) => alpha + MAX_EXCESS - ORDER_GRAIN,
                };
                let first = |own: bool, axis: &Vec<f64>| {
                    let highest = highest(own, axis.len());
                    axis.partition_point(|&v| if own { v >= highest } else { v > highest })
                };
                let group = |(axes, &s): (&Vec<Vec<f64>>, &usize)| axes.iter().map(|a| first(s == output, a)).collect();
                axes.iter().zip(&signals).map(group).collect()
            })
            .collect();
        if let Some(group) = axes.iter().position(|group| group.len() > MAX_TERMS) {
            let what = format!("signal {} has {} terms, more than {MAX_TERMS}", signals[group], axes[group].len());
            return Err(Error::Structure { what, remedy: "leave terms out".into() });
        }
        check_size(&axes, &firsts)?;
        let groups: Vec<Group> = signals
            .iter()
            .zip(axes)
            .map(|(&signal, axes)| {
                let members = members(signal);
                let swappable: Vec<bool> = members.iter().map(|&k| terms[k].interchangeable).collect();
                Group::new(signal, members, axes, &swappable)
            })
            .collect();
        let mut blocks = Vec::new();
        let mut count: u128 = 0;
        let mut why = "no value of alpha".to_owned();
        for (&alpha, firsts) in alphas.iter().zip(firsts) {
            let slices: Vec<Slice> = groups.iter().zip(firsts).map(|(group, first)| group.slice(first)).collect();
            if let Some(empty) = slices.iter().position(|slice| slice.count == 0) {
                why = format!("no orders of signal {} fit below alpha = {alpha}", groups[empty].signal);
                continue;
            }
            let size = slices.iter().fold(1u128, |size, slice| size.saturating_mul(u128::from(slice.count)));
            #[allow(clippy::cast_possible_truncation)]
            blocks.push(Block { alpha, start: count as u64, slices });
            count = count.saturating_add(size);
            if count > MAX_CANDIDATES {
                return Err(Error::LatticeTooLarge { count, limit: MAX_CANDIDATES });
            }
        }
        if count == 0 {
            return Err(Error::EmptyLattice { why });
        }
        #[allow(clippy::cast_possible_truncation)]
        Ok(Self { output, width: terms.len(), groups, blocks, count: count as u64 })
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

    /// Number of terms of the equation.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    pub(crate) fn groups(&self) -> &[Group] {
        &self.groups
    }

    pub(crate) fn blocks(&self) -> &[Block] {
        &self.blocks
    }
}

/// Refuses a lattice from the lengths of its axes alone, before a walk through it could take its time.
fn check_size(axes: &[Vec<Vec<f64>>], firsts: &[Vec<Vec<usize>>]) -> Result<()> {
    let lengths = |axes: &[Vec<f64>], first: &[usize]| -> Vec<u128> {
        axes.iter().zip(first).map(|(a, f)| (a.len() - f) as u128).collect()
    };
    let product = |lengths: &[u128]| lengths.iter().fold(1u128, |p, &l| p.saturating_mul(l));
    let (mut all, mut prefixes) = (0u128, 0u128);
    for firsts in firsts {
        let groups: Vec<Vec<u128>> = axes.iter().zip(firsts).map(|(axes, first)| lengths(axes, first)).collect();
        all = all.saturating_add(groups.iter().fold(1, |p, g| p.saturating_mul(product(g))));
        prefixes = groups.iter().fold(prefixes, |sum, g| sum.saturating_add(product(&g[..g.len() - 1])));
    }
    // Unordered tuples are at most so many times fewer than the product of the axes.
    let folds = axes.iter().fold(1u128, |p, group| p.saturating_mul((1..=group.len() as u128).product()));
    if all / folds / 2 > MAX_CANDIDATES || prefixes > MAX_PREFIXES {
        return Err(Error::LatticeTooLarge { count: all, limit: MAX_CANDIDATES });
    }
    Ok(())
}

/// Values of an axis from the largest down, each once.
fn values(term: &TermAxis, lowest: f64) -> Vec<f64> {
    let mut values: Vec<f64> = term.values.iter().map(|&v| tidy(v)).filter(|&v| v >= lowest - ORDER_GRAIN).collect();
    values.sort_by(|a, b| b.total_cmp(a));
    values.dedup();
    values
}

//! The independent lattice: α from a list, the order of each term from an axis of its own.
//!
//! The tuples of orders that the terms of one signal may take: counted and found by number, none stored.

use crate::equation::{tidy, ORDER_GRAIN};
use crate::error::{check_finite, Error, Result};
use crate::fractional::kernels::{MAX_EXCESS, MAX_ORDER, MIN_INPUT_ORDER};

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
    /// # use ftlm::order_search::grid::{Lattice, TermAxis};
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

/// The count before every so many prefixes is kept; those between are counted again when a tuple is looked up.
pub(super) const STRIDE: usize = 64;

/// The terms of one signal, their axes and which pairs of values exclude each other.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    pub(crate) signal: usize,
    /// Terms, by position in the equation.
    pub(crate) terms: Vec<usize>,
    /// Values of each term, from the largest down.
    pub(crate) axes: Vec<Vec<f64>>,
    /// `allowed[b][a][i]`, a < b: the values of term b that may stand beside value i of term a.
    allowed: Vec<Vec<Vec<Bits>>>,
}

/// What an α leaves of a group.
#[derive(Debug, Clone)]
pub(crate) struct Slice {
    /// First value of each axis that is in range.
    pub(crate) first: Vec<usize>,
    /// Number of prefixes (all orders but the last), and of tuples.
    pub(super) prefixes: usize,
    pub(super) count: u64,
    /// Number of tuples before every [`STRIDE`]th prefix.
    pub(super) before: Vec<u64>,
}

/// A set of positions in an axis.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Bits(pub(super) Vec<u64>);

impl Bits {
    fn from(len: usize, member: impl Fn(usize) -> bool) -> Self {
        let mut words = vec![0u64; len.div_ceil(64)];
        (0..len).filter(|&i| member(i)).for_each(|i| words[i / 64] |= 1 << (i % 64));
        Self(words)
    }

    pub(super) fn has(&self, i: usize) -> bool {
        self.0[i / 64] >> (i % 64) & 1 == 1
    }

    /// Smallest member that is at least `from`.
    pub(super) fn next(&self, from: usize) -> Option<usize> {
        let mut word = from / 64;
        let mut bits = *self.0.get(word)? & (!0 << (from % 64));
        loop {
            if bits != 0 {
                return Some(word * 64 + bits.trailing_zeros() as usize);
            }
            word += 1;
            bits = *self.0.get(word)?;
        }
    }

    /// How many members follow one another from here on, it included.
    pub(super) fn run(&self, from: usize) -> usize {
        let mut at = from;
        while let Some(&word) = self.0.get(at / 64) {
            let left = 64 - at % 64;
            let here = (!word >> (at % 64)).trailing_zeros() as usize;
            if here < left {
                return at + here - from;
            }
            at += left;
        }
        at - from
    }

    /// The member with `rank` members before it.
    pub(super) fn select(&self, mut rank: u64) -> Option<usize> {
        for (word, &bits) in self.0.iter().enumerate() {
            let here = u64::from(bits.count_ones());
            if rank < here {
                let mut bits = bits;
                for _ in 0..rank {
                    bits &= bits - 1;
                }
                return Some(word * 64 + bits.trailing_zeros() as usize);
            }
            rank -= here;
        }
        None
    }
}

impl Group {
    pub(super) fn new(signal: usize, terms: Vec<usize>, axes: Vec<Vec<f64>>, swappable: &[bool]) -> Self {
        // Axes run from the largest down.
        let holds = |axis: &[f64], value: f64| axis.binary_search_by(|v| value.total_cmp(v)).is_ok();
        let allowed = (0..terms.len())
            .map(|b| {
                (0..b)
                    .map(|a| {
                        let swappable = swappable[a] && swappable[b];
                        let twins: Vec<bool> = axes[b].iter().map(|&y| swappable && holds(&axes[a], y)).collect();
                        let completions = |&x: &f64| {
                            let twin = holds(&axes[b], x);
                            // Of two tuples that a swap turns into each other the one with the larger order first
                            // stands for both.
                            Bits::from(axes[b].len(), |j| {
                                let y = axes[b][j];
                                (x - y).abs() > ORDER_GRAIN && !(twin && twins[j] && x < y)
                            })
                        };
                        axes[a].iter().map(completions).collect()
                    })
                    .collect()
            })
            .collect();
        Self { signal, terms, axes, allowed }
    }

    pub(super) fn last(&self) -> usize {
        self.terms.len() - 1
    }

    /// Orders of a prefix by its number, as positions in the axes.
    pub(super) fn decode(&self, first: &[usize], prefix: usize, digits: &mut [usize]) {
        let mut rest = prefix;
        for a in (0..self.last()).rev() {
            let len = self.axes[a].len() - first[a];
            digits[a] = first[a] + rest % len;
            rest /= len;
        }
    }

    /// Calls `take` with the words of the set of last values that complete a prefix, and their place; none where the
    /// prefix excludes itself.
    #[inline]
    pub(super) fn completions(&self, first: &[usize], digits: &[usize], mut take: impl FnMut(usize, u64)) {
        let last = self.last();
        if (0..last).any(|b| (0..b).any(|a| !self.allowed[b][a][digits[a]].has(digits[b]))) {
            return;
        }
        let len = self.axes[last].len();
        for word in first[last] / 64..len.div_ceil(64) {
            let mut bits = !0u64;
            if word == first[last] / 64 {
                bits &= !0 << (first[last] % 64);
            }
            if word == len / 64 {
                bits &= !(!0 << (len % 64));
            }
            (0..last).for_each(|a| bits &= self.allowed[last][a][digits[a]].0[word]);
            take(word, bits);
        }
    }

    pub(super) fn count_completions(&self, first: &[usize], digits: &[usize]) -> u64 {
        let mut count = 0;
        self.completions(first, digits, |_, bits| count += u64::from(bits.count_ones()));
        count
    }

    /// The part of this group below an α; completions are counted, none is stored.
    pub(super) fn slice(&self, first: Vec<usize>) -> Slice {
        let prefixes: usize = (0..self.last()).map(|a| self.axes[a].len() - first[a]).product();
        let mut digits = vec![0; self.terms.len()];
        let mut before = Vec::with_capacity(prefixes / STRIDE + 1);
        let mut count = 0;
        for prefix in 0..prefixes {
            if prefix % STRIDE == 0 {
                before.push(count);
            }
            self.decode(&first, prefix, &mut digits);
            count += self.count_completions(&first, &digits);
        }
        Slice { first, prefixes, count, before }
    }
}

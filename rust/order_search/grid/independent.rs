//! Order grid with independent orders: the order α of the equation from a list, the order of each term from its own
//! axis.
//!
//! The combinations of orders of one signal are counted, and found by rank, without being stored.

use crate::equation::{round_order, ORDER_GRAIN};
use crate::error::{check_finite, Error, Result};
use crate::fractional::kernels::{MAX_ORDER, MAX_ORDER_EXCESS, MIN_INPUT_ORDER};

/// Maximum number of candidates of one search. Such a search takes about one hour with dual bounds and pruning.
pub const MAX_CANDIDATES: u128 = 10_000_000_000;
/// Maximum number of combinations of all orders of a signal but the last. For each of them, the allowed values of the
/// last order are counted when a grid is built, which takes a few seconds at most.
const MAX_PREFIXES: u128 = 1 << 28;
/// Maximum number of terms of one signal. The factorial of this number fits into 128 bits.
const MAX_TERMS: usize = 34;

/// Candidate orders of one term of an equation.
#[derive(Debug, Clone, PartialEq)]
pub struct TermAxis {
    /// Signal index of the term.
    pub signal: usize,
    /// Orders ν in any sequence. Orders outside the range for an α are excluded for that α.
    pub values: Vec<f64>,
    /// True if this term may be interchanged with another interchangeable term of the same signal, because both
    /// coefficients are free.
    pub interchangeable: bool,
}

/// Grid of all orders of one equation: α from a list, the order ν of each term from its own axis.
///
/// Orders of output terms satisfy 0 ≤ ν < α, other orders 0 ≤ ν ≤ α. If the grid has a single α, a fixed order of a
/// signal other than the output may exceed it by less than 1. Terms on inputs may have a negative order. The orders of
/// one signal are distinct. Of interchangeable terms, the first has the larger order. Candidates are indexed in
/// ascending order of α. For the same α, the last signal varies fastest, and the last of its orders fastest of all.
/// Within an axis, orders descend.
#[derive(Debug, Clone)]
pub struct OrderGrid {
    output: usize,
    /// Number of terms.
    width: usize,
    pub(super) groups: Vec<Group>,
    pub(super) blocks: Vec<Block>,
    pub(super) count: u64,
}

/// Candidates with one order α of the equation: all combinations of the orders of the signals.
#[derive(Debug, Clone)]
pub(crate) struct Block {
    /// Order α of the equation.
    pub(crate) alpha: f64,
    /// Index of the first candidate with this α.
    pub(crate) start: u64,
    /// The allowed combinations of orders for each signal.
    pub(crate) tuples: Vec<GroupTuples>,
}

impl OrderGrid {
    /// Build the grid from its axes. `is_input` selects the signals that may have a negative order.
    ///
    /// # Errors
    /// [`Error::EmptyOrderGrid`] if no orders are in range. [`Error::OrderGridTooLarge`] for too many candidates,
    /// before a grid of that size is enumerated. [`Error::OutOfRange`] for an α outside (0, 10]. [`Error::NotFinite`]
    /// for an order that is not finite. [`Error::Structure`] for more than 34 terms of one signal.
    ///
    /// ```
    /// # use ftlm::order_search::grid::{OrderGrid, TermAxis};
    /// // Two interchangeable output terms, and the input with order 0.
    /// let output_axis = TermAxis { signal: 0, values: vec![0.0, 0.5, 1.0], interchangeable: true };
    /// let input = TermAxis { signal: 1, values: vec![0.0], interchangeable: false };
    /// let grid = OrderGrid::new(0, &[0.8, 1.2], &[output_axis.clone(), output_axis, input], |signal| signal == 1)?;
    /// // Orders (0.5, 0) for α = 0.8, and (1, 0.5), (1, 0), (0.5, 0) for α = 1.2.
    /// assert_eq!(grid.count(), 4);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn new(output: usize, alphas: &[f64], terms: &[TermAxis], is_input: impl Fn(usize) -> bool) -> Result<Self> {
        check_finite("values of alpha", alphas)?;
        for (k, term) in terms.iter().enumerate() {
            check_finite(&format!("orders of term {k}"), &term.values)?;
        }
        let mut alphas: Vec<f64> = alphas.iter().map(|&a| round_order(a)).collect();
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
        let is_alpha_fixed = alphas.len() == 1;
        // First axis position in range, per α, signal and term.
        let firsts: Vec<Vec<Vec<usize>>> = alphas
            .iter()
            .map(|&alpha| {
                // Varied orders stay at or below alpha. A fixed order with a single alpha may exceed it.
                let highest = |is_output: bool, count: usize| match (is_output, is_alpha_fixed && count == 1) {
                    (true, _) => alpha - ORDER_GRAIN,
                    (false, false) => alpha + ORDER_GRAIN,
                    (false, true) => alpha + MAX_ORDER_EXCESS - ORDER_GRAIN,
                };
                let first = |is_output: bool, axis: &Vec<f64>| {
                    let highest = highest(is_output, axis.len());
                    axis.partition_point(|&v| if is_output { v >= highest } else { v > highest })
                };
                let group = |(axes, &s): (&Vec<Vec<f64>>, &usize)| axes.iter().map(|a| first(s == output, a)).collect();
                axes.iter().zip(&signals).map(group).collect()
            })
            .collect();
        if let Some(group) = axes.iter().position(|group| group.len() > MAX_TERMS) {
            let what = format!("signal {} has {} terms, more than {MAX_TERMS}", signals[group], axes[group].len());
            return Err(Error::Structure { what, remedy: "remove terms".into() });
        }
        check_size(&axes, &firsts)?;
        let groups: Vec<Group> = signals
            .iter()
            .zip(axes)
            .map(|(&signal, axes)| {
                let members = members(signal);
                let interchangeable: Vec<bool> = members.iter().map(|&k| terms[k].interchangeable).collect();
                Group::new(signal, members, axes, &interchangeable)
            })
            .collect();
        let mut blocks = Vec::new();
        let mut count: u128 = 0;
        let mut reason = "no value of alpha".to_owned();
        for (&alpha, firsts) in alphas.iter().zip(firsts) {
            let slices: Vec<GroupTuples> =
                groups.iter().zip(firsts).map(|(group, first)| group.tuples_below(first)).collect();
            if let Some(empty) = slices.iter().position(|slice| slice.count == 0) {
                reason = format!("no orders of signal {} fit below alpha = {alpha}", groups[empty].signal);
                continue;
            }
            let size = slices.iter().fold(1u128, |size, slice| size.saturating_mul(u128::from(slice.count)));
            #[allow(clippy::cast_possible_truncation)]
            blocks.push(Block { alpha, start: count as u64, tuples: slices });
            count = count.saturating_add(size);
            if count > MAX_CANDIDATES {
                return Err(Error::OrderGridTooLarge { count, limit: MAX_CANDIDATES });
            }
        }
        if count == 0 {
            return Err(Error::EmptyOrderGrid { reason });
        }
        #[allow(clippy::cast_possible_truncation)]
        Ok(Self { output, width: terms.len(), groups, blocks, count: count as u64 })
    }

    /// Return the number of candidates.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Return the signal index of the output.
    #[must_use]
    pub fn output(&self) -> usize {
        self.output
    }

    /// Return the number of terms of the equation.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Return the terms of the equation, grouped by signal.
    pub(crate) fn groups(&self) -> &[Group] {
        &self.groups
    }

    /// Return the candidates, grouped by the order α of the equation.
    pub(crate) fn blocks(&self) -> &[Block] {
        &self.blocks
    }
}

/// Return [`Error::OrderGridTooLarge`] for a grid whose axes are too long, before it is enumerated. `axes` lists the
/// values by signal and term, and `firsts` the first position in range by α, signal and term.
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
    // The number of unordered tuples is smaller than the product of the axes by at most this factor.
    let folds = axes.iter().fold(1u128, |p, group| p.saturating_mul((1..=group.len() as u128).product()));
    if all / folds / 2 > MAX_CANDIDATES || prefixes > MAX_PREFIXES {
        return Err(Error::OrderGridTooLarge { count: all, limit: MAX_CANDIDATES });
    }
    Ok(())
}

/// Return the distinct orders of an axis that are at least `lowest`, in descending order.
fn values(term: &TermAxis, lowest: f64) -> Vec<f64> {
    let mut values: Vec<f64> =
        term.values.iter().map(|&v| round_order(v)).filter(|&v| v >= lowest - ORDER_GRAIN).collect();
    values.sort_by(|a, b| b.total_cmp(a));
    values.dedup();
    values
}

/// Number of prefixes (combinations of all orders of a signal but the last) between two stored counts of allowed
/// combinations. Counts in between are computed when needed.
pub(super) const PREFIX_STRIDE: usize = 64;

/// Terms of one signal, their axes, and the pairs of orders that exclude each other.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    pub(crate) signal: usize,
    /// Index of each term in the equation.
    pub(crate) terms: Vec<usize>,
    /// Candidate orders of each term, descending.
    pub(crate) axes: Vec<Vec<f64>>,
    /// Pairs of orders that are allowed. The set `allowed[b][a][i]` contains the orders of term b that are allowed with
    /// order number i of term a, a < b.
    allowed: Vec<Vec<Vec<BitSet>>>,
}

/// Combinations of the orders of one signal that are allowed for one order α of the equation.
#[derive(Debug, Clone)]
pub(crate) struct GroupTuples {
    /// First axis position whose order is in range, for each term.
    pub(crate) first: Vec<usize>,
    /// Number of combinations of all orders but the last. Such a combination is called a prefix.
    pub(super) prefixes: usize,
    /// Number of allowed combinations of all orders of the signal.
    pub(super) count: u64,
    /// Number of allowed combinations before the prefixes 0, [`PREFIX_STRIDE`], 2·[`PREFIX_STRIDE`], …
    pub(super) cumulative_counts: Vec<u64>,
}

/// Set of positions in an axis (list of orders), as a bit set of 64-bit words.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct BitSet(pub(super) Vec<u64>);

impl BitSet {
    /// Return the set of positions below `len` for which `member` is true.
    fn from(len: usize, member: impl Fn(usize) -> bool) -> Self {
        let mut words = vec![0u64; len.div_ceil(64)];
        (0..len).filter(|&i| member(i)).for_each(|i| words[i / 64] |= 1 << (i % 64));
        Self(words)
    }

    /// Return true if the position is in the set.
    pub(super) fn has(&self, i: usize) -> bool {
        self.0[i / 64] >> (i % 64) & 1 == 1
    }

    /// Return the smallest position in the set that is at least `start`. `None` if there is none.
    pub(super) fn next(&self, start: usize) -> Option<usize> {
        let mut word = start / 64;
        let mut bits = *self.0.get(word)? & (!0 << (start % 64));
        loop {
            if bits != 0 {
                return Some(word * 64 + bits.trailing_zeros() as usize);
            }
            word += 1;
            bits = *self.0.get(word)?;
        }
    }

    /// Return the number of consecutive positions in the set from `start` on.
    pub(super) fn run(&self, start: usize) -> usize {
        let mut position = start;
        while let Some(&word) = self.0.get(position / 64) {
            let remaining = 64 - position % 64;
            let run_length = (!word >> (position % 64)).trailing_zeros() as usize;
            if run_length < remaining {
                return position + run_length - start;
            }
            position += remaining;
        }
        position - start
    }

    /// Return the position in the set with `rank` smaller positions in the set. `None` if there is none.
    pub(super) fn select(&self, mut rank: u64) -> Option<usize> {
        for (word, &bits) in self.0.iter().enumerate() {
            let bit_count = u64::from(bits.count_ones());
            if rank < bit_count {
                let mut bits = bits;
                for _ in 0..rank {
                    bits &= bits - 1;
                }
                return Some(word * 64 + bits.trailing_zeros() as usize);
            }
            rank -= bit_count;
        }
        None
    }
}

impl Group {
    /// Build the terms of one signal. `axes` lists the orders of each term in descending order, and `interchangeable`
    /// is true for interchangeable terms.
    pub(super) fn new(signal: usize, terms: Vec<usize>, axes: Vec<Vec<f64>>, interchangeable: &[bool]) -> Self {
        // Orders descend within an axis.
        let contains = |axis: &[f64], value: f64| axis.binary_search_by(|v| value.total_cmp(v)).is_ok();
        let allowed = (0..terms.len())
            .map(|b| {
                (0..b)
                    .map(|a| {
                        let is_interchangeable = interchangeable[a] && interchangeable[b];
                        let is_shared: Vec<bool> =
                            axes[b].iter().map(|&y| is_interchangeable && contains(&axes[a], y)).collect();
                        let completions = |&x: &f64| {
                            let is_shared_value = contains(&axes[b], x);
                            // Of two combinations that differ by an interchange, only the one with the larger order
                            // first is a candidate.
                            BitSet::from(axes[b].len(), |j| {
                                let y = axes[b][j];
                                (x - y).abs() > ORDER_GRAIN && !(is_shared_value && is_shared[j] && x < y)
                            })
                        };
                        axes[a].iter().map(completions).collect()
                    })
                    .collect()
            })
            .collect();
        Self { signal, terms, axes, allowed }
    }

    /// Return the index of the last term of this signal.
    pub(super) fn last(&self) -> usize {
        self.terms.len() - 1
    }

    /// Write the axis positions of all orders but the last to `digits`, for combination number `prefix`. `first` gives
    /// the first axis position in range for each order.
    pub(super) fn decode(&self, first: &[usize], prefix: usize, digits: &mut [usize]) {
        let mut remaining = prefix;
        for a in (0..self.last()).rev() {
            let len = self.axes[a].len() - first[a];
            digits[a] = first[a] + remaining % len;
            remaining /= len;
        }
    }

    /// Enumerate the axis positions of the last order that are allowed with the axis positions `digits` of the other
    /// orders. Their set is a bit set: `visit` receives the index and the bits of each 64-bit word. `first` gives the
    /// first axis position in range for each order. `visit` is not called if the other orders exclude each other.
    #[inline]
    pub(super) fn completions(&self, first: &[usize], digits: &[usize], mut visit: impl FnMut(usize, u64)) {
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
            visit(word, bits);
        }
    }

    /// Return the number of allowed values of the last order, with the arguments of [`Self::completions`].
    pub(super) fn count_completions(&self, first: &[usize], digits: &[usize]) -> u64 {
        let mut count = 0;
        self.completions(first, digits, |_, bits| count += u64::from(bits.count_ones()));
        count
    }

    /// Count the combinations of orders of this signal that are allowed for one order α, and return the counts. `first`
    /// gives the first axis position in range for each order.
    pub(super) fn tuples_below(&self, first: Vec<usize>) -> GroupTuples {
        let prefixes: usize = (0..self.last()).map(|a| self.axes[a].len() - first[a]).product();
        let mut digits = vec![0; self.terms.len()];
        let mut cumulative_counts = Vec::with_capacity(prefixes / PREFIX_STRIDE + 1);
        let mut count = 0;
        for prefix in 0..prefixes {
            if prefix % PREFIX_STRIDE == 0 {
                cumulative_counts.push(count);
            }
            self.decode(&first, prefix, &mut digits);
            count += self.count_completions(&first, &digits);
        }
        GroupTuples { first, prefixes, count, cumulative_counts }
    }
}

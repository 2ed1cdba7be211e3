//! The tuples of orders that the terms of one signal may take: counted and found by number, none stored.

use crate::equation::ORDER_GRAIN;

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

//! Test vectors made for candidates at hand: t = D⁻ᵀ sign(e), of a candidate with divisor D and output error e.
//!
//! For that candidate ⟨t, w⟩/‖Dᵀt‖ is its score itself; for any other one the bound holds as for every test vector. Dᵀt
//! is formed in full here, so that neither coefficients that are huge and of opposite sign nor noise that all candidates
//! share loosen it. Records are one vector after the other: one bound for the error on all of them.
//!
//! What rounding may do to inner products with test vectors made for candidates, and to their norms.

use rayon::prelude::*;

use crate::linalg::dense;
use crate::order_search::dual_bound::test_vectors::NONE;
use crate::order_search::options::Norm;
use crate::parallel::Stop;
use crate::regressors::Bank;
use crate::series::{divide, Buffers, Kernel};
use crate::simd::{self, WIDTH};

/// Values that are summed before a look at the limit.
const STRETCH: usize = 8 * WIDTH;
/// Products and sums of numbers below this do not overflow.
const HUGE: f64 = 1e100;

/// Most own terms of candidates of which it is remembered what a vector came to, and how much is remembered.
const PAIR: usize = 2;
const REMEMBERED: usize = 256;

/// A column's row in [`Fitted::acted`] with a coefficient.
type Weighted = (usize, f64);

/// One test vector over all records: what it makes of each column.
pub(crate) struct Fitted {
    /// The vector, no value larger than 1, filled up with zeros to a multiple of [`STRETCH`].
    vector: Vec<f64>,
    /// ⟨t, x⟩ of every column, and of the target.
    products: Vec<f64>,
    target: f64,
    /// Fᵀt of every own column, one after the other, each as long as the vector.
    acted: Vec<f64>,
}

/// What a vector came to for a candidate: hardly less than for those with the same own columns and nearly its
/// coefficients.
#[derive(Clone, Copy)]
struct Near {
    which: usize,
    own: [Weighted; PAIR],
    /// ‖Dᵀt‖ and what rounding may do to it.
    norm: f64,
    /// a₂ = share·a₁ + g for the a = Fᵀt of both columns; ‖a₁‖ and ‖g‖, which are not numbers until somebody asks.
    share: f64,
    sizes: [f64; PAIR],
    /// What rounding may do, per unit that a coefficient is off.
    slack: [f64; PAIR],
}

/// What is remembered from one candidate to the next.
#[derive(Default)]
pub(crate) struct Memory {
    own: Vec<Weighted>,
    /// The vector that excluded a candidate last.
    last: usize,
    /// What vectors came to, by own columns, if that is to be remembered.
    near: Option<Vec<Option<Near>>>,
}

impl Memory {
    /// For candidates one after the other.
    pub(crate) fn of_neighbours() -> Self {
        Self { near: Some(Vec::new()), ..Self::default() }
    }
}

/// Some of them, and what rounding may do to all.
pub(crate) struct Adapted {
    losses: Losses,
    /// Row of an own column; [`NONE`] of another.
    rows: Vec<usize>,
    pub(crate) each: Vec<Fitted>,
}

impl Adapted {
    /// Bytes of one.
    pub(crate) fn bytes(banks: &[Bank]) -> u64 {
        let samples: usize = banks.iter().map(samples).sum();
        let own = banks.first().map_or(0, |bank| own(bank).len());
        8 * (samples.next_multiple_of(STRETCH) as u64 * (own as u64 + 1) + banks.first().map_or(0, Bank::len) as u64)
    }

    /// None yet, for these records.
    pub(crate) fn new(banks: &[Bank], targets: &[Vec<f64>], norm: Norm) -> Self {
        let mut rows = vec![NONE; banks.first().map_or(0, Bank::len)];
        if let Some(bank) = banks.first() {
            own(bank).into_iter().enumerate().for_each(|(row, p)| rows[p] = row);
        }
        Self { losses: Losses::new(banks, targets, norm), rows, each: Vec::new() }
    }

    /// The test vector of the candidate with these columns and coefficients; none where its run or the vector leaves the
    /// range of floating point. Runs on the current thread pool.
    pub(crate) fn fit(&self, banks: &[Bank], targets: &[Vec<f64>], terms: &[usize], c: &[f64]) -> Option<Fitted> {
        let backwards = |x: &[f64]| -> Vec<f64> { x.iter().rev().copied().collect() };
        let mut vectors: Vec<Vec<f64>> = Vec::new();
        for (bank, target) in banks.iter().zip(targets) {
            let (mut divisor, mut driven) = (vec![0.0; target.len()], vec![0.0; target.len()]);
            divisor[0] = 1.0;
            for (&p, &c) in terms.iter().zip(c) {
                let kernel = bank.kernel(p);
                if kernel.is_empty() {
                    driven.iter_mut().zip(bank.column(p)).for_each(|(n, x)| *n += c * x);
                } else {
                    divisor.iter_mut().zip(kernel).for_each(|(d, x)| *d -= c * x);
                }
            }
            let error: Vec<f64> = divide(&driven, &divisor).ok()?.iter().zip(target).map(|(v, y)| y - v).collect();
            let wanted: Vec<f64> = match self.losses.norm {
                Norm::L1 => error.iter().map(|e| if *e < 0.0 { -1.0 } else { 1.0 }).collect(),
                Norm::L2 => error,
            };
            vectors.push(backwards(&divide(&backwards(&wanted), &divisor).ok()?));
        }
        let top = vectors.iter().flatten().fold(0.0_f64, |top, v| top.max(v.abs()));
        if !vectors.iter().flatten().all(|v| v.is_finite()) || top < f64::MIN_POSITIVE {
            return None;
        }
        vectors.iter_mut().flatten().for_each(|v| *v /= top);
        let (mut products, mut target) = (vec![0.0; self.rows.len()], 0.0);
        for ((bank, y), t) in banks.iter().zip(targets).zip(&vectors) {
            let mut columns: Vec<&[f64]> = (0..bank.len()).map(|p| bank.column(p)).collect();
            columns.push(y);
            let inner = dense::inner_products(&columns, &[t], &Stop::default());
            products.iter_mut().zip(&inner).for_each(|(sum, x)| *sum += x);
            target += inner[bank.len()];
        }
        let spectra: Vec<Kernel> = vectors.iter().map(|t| Kernel::new(&backwards(t))).collect();
        let mut vector: Vec<f64> = vectors.concat();
        let length = vector.len().next_multiple_of(STRETCH);
        vector.resize(length, 0.0);
        let own: Vec<usize> = (0..self.rows.len()).filter(|&p| self.rows[p] != NONE).collect();
        let mut acted = vec![0.0; own.len() * length];
        acted.par_chunks_mut(length).zip(&own).for_each(|(acted, &p)| {
            let (mut at, mut buffers) = (0, Buffers::default());
            for (bank, spectrum) in banks.iter().zip(&spectra) {
                let part = &mut acted[at..at + samples(bank)];
                Kernel::new(bank.kernel(p)).times(spectrum, part, &mut buffers);
                part.reverse();
                at += part.len();
            }
        });
        let sound = products.iter().chain(&acted).all(|v| v.abs() < HUGE) && target.is_finite();
        sound.then_some(Fitted { vector, products, target, acted })
    }

    /// Whether some vector proves that a candidate's raw score exceeds the limit; the one that did so last is asked first.
    #[inline(always)]
    pub(crate) fn exclude(&self, terms: &[usize], coefficients: &[f64], limit: f64, memory: &mut Memory) -> bool {
        let limit = self.losses.limit(limit);
        let Memory { own, last, near } = memory;
        let (mut rounding, mut length) = (self.losses.target_rounding, self.size());
        own.clear();
        for (&p, &c) in terms.iter().zip(coefficients) {
            rounding += c.abs() * self.losses.rounding[p];
            length += c.abs() * self.losses.lengths[p];
            if self.rows[p] != NONE {
                own.push((self.rows[p], c));
            }
        }
        let lost = self.losses.unit * length;
        let allowed = |which: usize| {
            let fitted = &self.each[which];
            let seen = terms.iter().zip(coefficients).fold(fitted.target, |sum, (&p, &c)| sum - c * fitted.products[p]);
            (seen.abs() - rounding) / limit - lost
        };
        let pair: [Weighted; PAIR] = std::array::from_fn(|n| own.get(n).copied().unwrap_or((NONE, 0.0)));
        let mut place = None;
        if let (Some(near), 1..=PAIR) = (near, own.len()) {
            near.resize(REMEMBERED, None);
            let at = pair[0].0.wrapping_mul(97).wrapping_add(pair[1].0) % REMEMBERED;
            let known = &mut near[at];
            if known.is_some_and(|known| known.own[0].0 != pair[0].0 || known.own[1].0 != pair[1].0) {
                *known = None;
            }
            if let Some(known) = known {
                if known.sizes[0].is_nan() {
                    self.spread(known);
                }
                *last = known.which;
                if self.at_most(known, &pair) <= allowed(known.which) {
                    return true;
                }
            }
            place = Some(known);
        }
        for turn in 0..self.each.len() {
            let which = (*last + turn) % self.each.len();
            let Some(norm) = self.within(&self.each[which], own, allowed(which)) else { continue };
            *last = which;
            if let Some(place) = place {
                let lengths = |n: usize| {
                    terms.iter().find(|p| self.rows[**p] == pair[n].0).map_or(0.0, |p| self.losses.lengths[*p])
                };
                let norm = norm + lost;
                *place = Some(match *place {
                    Some(known) if known.which == which => Near { own: pair, norm, ..known },
                    _ => Near {
                        which,
                        own: pair,
                        norm,
                        share: 0.0,
                        sizes: [f64::NAN; PAIR],
                        slack: [lengths(0), lengths(1)],
                    },
                });
            }
            return true;
        }
        false
    }

    /// At least ‖Dᵀt‖ of a candidate with the same own columns.
    #[inline(always)]
    fn at_most(&self, known: &Near, own: &[Weighted; PAIR]) -> f64 {
        let off = [own[0].1 - known.own[0].1, own[1].1 - known.own[1].1];
        let [first, second] = known.sizes;
        let along = (off[0] + known.share * off[1]).abs() * first + off[1].abs() * second;
        let rounding = off[0].abs() * known.slack[0] + off[1].abs() * known.slack[1];
        (known.norm + along + self.losses.unit * rounding) * (1.0 + self.losses.unit)
    }

    /// What coefficients that are off may do to ‖Dᵀt‖.
    #[inline(always)]
    fn spread(&self, known: &mut Near) {
        let fitted = &self.each[known.which];
        let length = fitted.vector.len();
        let row = |n: usize| match known.own[n].0 {
            NONE => &[][..],
            row => &fitted.acted[row * length..(row + 1) * length],
        };
        let (first, second) = (row(0), row(1));
        let (square, inner) = (simd::dot(first, first), simd::dot(&first[..second.len()], second));
        // Any number will do.
        let share = if square > 0.0 && (inner / square).abs() < HUGE { inner / square } else { 0.0 };
        known.share = share;
        known.sizes = [self.size_of(first, first, 0.0), self.size_of(second, first, share)];
        known.slack[1] += share.abs() * known.slack[0];
    }

    /// ‖a − share·b‖ in the dual norm, of rows whose length is a multiple of [`STRETCH`].
    #[inline(always)]
    fn size_of(&self, a: &[f64], b: &[f64], share: f64) -> f64 {
        let mut all = [0.0_f64; WIDTH];
        for (a, b) in a.chunks_exact(WIDTH).zip(b.chunks_exact(WIDTH)) {
            for n in 0..WIDTH {
                let value = a[n] - share * b[n];
                all[n] = match self.losses.norm {
                    Norm::L1 if value.abs() > all[n] => value.abs(),
                    Norm::L1 => all[n],
                    Norm::L2 => all[n] + value * value,
                };
            }
        }
        match self.losses.norm {
            Norm::L1 => all.into_iter().fold(0.0, f64::max),
            Norm::L2 => all.into_iter().sum::<f64>().sqrt(),
        }
    }

    /// Largest ‖t‖ in the dual norm.
    #[inline(always)]
    #[allow(clippy::cast_precision_loss)]
    fn size(&self) -> f64 {
        match (self.losses.norm, self.each.first()) {
            (Norm::L2, Some(fitted)) => (fitted.vector.len() as f64).sqrt(),
            _ => 1.0,
        }
    }

    /// ‖t − Σ c Fᵀt‖ in the dual norm if it is at most `most`; none where it cannot be told.
    #[inline(always)]
    fn within(&self, fitted: &Fitted, own: &[Weighted], most: f64) -> Option<f64> {
        // What is not a number proves nothing, and nothing overflows below.
        if most.is_nan() || most <= 0.0 || !own.iter().all(|(_, c)| c.abs() < HUGE) {
            return None;
        }
        let length = fitted.vector.len();
        let squares = most * most;
        let mut all = [0.0_f64; WIDTH];
        for (at, vector) in (0..length).step_by(STRETCH).zip(fitted.vector.chunks_exact(STRETCH)) {
            let mut sums = [0.0; STRETCH];
            sums.copy_from_slice(vector);
            for &(row, c) in own {
                let acted = &fitted.acted[row * length + at..row * length + at + STRETCH];
                for i in 0..STRETCH {
                    sums[i] -= c * acted[i];
                }
            }
            for part in sums.chunks_exact(WIDTH) {
                for n in 0..WIDTH {
                    all[n] = match self.losses.norm {
                        Norm::L1 if part[n].abs() > all[n] => part[n].abs(),
                        Norm::L1 => all[n],
                        Norm::L2 => all[n] + part[n] * part[n],
                    };
                }
            }
            let beyond = match self.losses.norm {
                Norm::L1 => all.iter().any(|v| *v > most),
                Norm::L2 => all.iter().sum::<f64>() > squares,
            };
            if beyond {
                return None;
            }
        }
        Some(match self.losses.norm {
            Norm::L1 => all.into_iter().fold(0.0, f64::max),
            Norm::L2 => all.into_iter().sum::<f64>().sqrt(),
        })
    }
}

fn samples(bank: &Bank) -> usize {
    if bank.is_empty() {
        0
    } else {
        bank.column(0).len()
    }
}

fn own(bank: &Bank) -> Vec<usize> {
    (0..bank.len()).filter(|&p| !bank.kernel(p).is_empty()).collect()
}

/// Over all records together.
pub(super) struct Losses {
    pub(super) norm: Norm,
    /// What rounding may add to |⟨t, w⟩| per unit of a column's coefficient, and for the target, where no |t| exceeds 1.
    pub(super) rounding: Vec<f64>,
    pub(super) target_rounding: f64,
    /// Sum of the moduli of an own column's kernel, times [`Self::size`]; 0 of another.
    pub(super) lengths: Vec<f64>,
    /// Largest dual norm of a vector none of whose values exceeds 1.
    pub(super) size: f64,
    /// What rounding may add to a sum of as many terms as there are samples, per unit.
    pub(super) unit: f64,
}

impl Losses {
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn new(banks: &[Bank], targets: &[Vec<f64>], norm: Norm) -> Self {
        let width = banks.first().map_or(0, Bank::len);
        let all: usize = targets.iter().map(Vec::len).sum();
        let unit = 16.0 * f64::EPSILON * all as f64;
        let (mut rounding, mut lengths) = (vec![0.0; width], vec![0.0_f64; width]);
        let size = match norm {
            Norm::L1 => 1.0,
            Norm::L2 => (all as f64).sqrt(),
        };
        for (bank, target) in banks.iter().zip(targets) {
            let target = modulus(target);
            for p in 0..width {
                let length = modulus(bank.kernel(p));
                rounding[p] += unit * (modulus(bank.column(p)) + length * target);
                lengths[p] = lengths[p].max(length * size);
            }
        }
        let target_rounding = 2.0 * unit * targets.iter().map(|y| modulus(y)).sum::<f64>();
        Self { norm, rounding, target_rounding, lengths, size, unit }
    }

    /// What a norm must exceed for a raw score to exceed this limit; a hair more, for the rounding of the score itself.
    #[inline(always)]
    pub(super) fn limit(&self, raw: f64) -> f64 {
        (1.0 + self.unit)
            * match self.norm {
                Norm::L1 => raw,
                Norm::L2 => raw.sqrt(),
            }
    }
}

/// Σ |x|.
pub(super) fn modulus(x: &[f64]) -> f64 {
    x.iter().map(|v| v.abs()).sum()
}

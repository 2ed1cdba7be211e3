//! Test vectors made for candidates at hand: t = D⁻ᵀ sign(e), of a candidate with divisor D and output error e.
//!
//! For that candidate ⟨t, w⟩/‖Dᵀt‖ is its score itself; for any other one the bound holds as for every test vector. Dᵀt
//! is formed in full here, so that neither coefficients that are huge and of opposite sign nor noise that all candidates
//! share loosen it. Records are one vector after the other: one bound for the error on all of them.

use rayon::prelude::*;

use crate::dense;
use crate::lanes::WIDTH;
use crate::regressors::Bank;
use crate::search::bound::losses::Losses;
use crate::search::bound::probes::NONE;
use crate::search::options::Norm;
use crate::series::{divide, Buffers, Kernel};

/// Values that are summed before a look at the limit.
const STRETCH: usize = 8 * WIDTH;
/// Products and sums of numbers below this do not overflow.
const HUGE: f64 = 1e100;

/// A column's row in [`Fitted::acted`] with a coefficient.
pub(crate) type Weighted = (usize, f64);

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
            let inner = dense::inner_products(&columns, &[t]);
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
    pub(crate) fn exclude(
        &self,
        terms: &[usize],
        coefficients: &[f64],
        limit: f64,
        own: &mut Vec<Weighted>,
        last: &mut usize,
    ) -> bool {
        let limit = self.losses.limit(limit);
        let (mut rounding, mut length) = (self.losses.target_rounding, self.size());
        own.clear();
        for (&p, &c) in terms.iter().zip(coefficients) {
            rounding += c.abs() * self.losses.rounding[p];
            length += c.abs() * self.losses.lengths[p];
            if self.rows[p] != NONE {
                own.push((self.rows[p], c));
            }
        }
        for turn in 0..self.each.len() {
            let which = (*last + turn) % self.each.len();
            let fitted = &self.each[which];
            let seen = terms.iter().zip(coefficients).fold(fitted.target, |sum, (&p, c)| sum - c * fitted.products[p]);
            let allowed = (seen.abs() - rounding) / limit - self.losses.unit * length;
            if self.within(fitted, own, allowed) {
                *last = which;
                return true;
            }
        }
        false
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

    /// Whether ‖t − Σ c Fᵀt‖ is at most `most` in the dual norm; no where it cannot be told.
    #[inline(always)]
    fn within(&self, fitted: &Fitted, own: &[Weighted], most: f64) -> bool {
        // What is not a number proves nothing, and nothing overflows below.
        if most.is_nan() || most <= 0.0 || !own.iter().all(|(_, c)| c.abs() < HUGE) {
            return false;
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
                return false;
            }
        }
        true
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

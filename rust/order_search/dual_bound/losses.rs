//! What rounding may do to inner products with test vectors made for candidates, and to their norms.

use crate::order_search::options::Norm;
use crate::regressors::Bank;

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

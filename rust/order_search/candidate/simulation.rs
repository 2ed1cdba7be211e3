//! Blockwise simulation ŷ = N/D of one candidate, compared with the measurement block by block.

use crate::order_search::control::Control;
use crate::order_search::options::Norm;
use crate::order_search::result::{Failure, Verdict};
use crate::series::{Division, BLOCK_TERMS};

/// Column and its coefficient.
type Weighted<'a> = (&'a [f64], f64);

/// Workspace of simulations, reused from one candidate to the next.
pub(crate) struct BlockSimulation {
    divisor: Vec<f64>,
    block: Vec<f64>,
    division: Option<Division>,
}

impl Default for BlockSimulation {
    fn default() -> Self {
        Self { divisor: Vec::new(), block: vec![0.0; BLOCK_TERMS], division: None }
    }
}

impl BlockSimulation {
    /// Add the error of a simulation to a raw sum. Stops once the sum exceeds the limit or the caller requests a stop.
    ///
    /// D = 1 − Σ c F over the kernels in `own`, N = Σ c x over the columns in `driven`. Only the part of a kernel up to
    /// the current block is read.
    #[allow(clippy::too_many_arguments)]
    pub(crate) fn accumulate_error<'a>(
        &mut self,
        target: &[f64],
        own: impl Iterator<Item = Weighted<'a>> + Clone,
        driven: impl Iterator<Item = Weighted<'a>> + Clone,
        norm: Norm,
        mut raw: f64,
        limit: f64,
        control: &Control,
    ) -> Verdict {
        let m = target.len();
        let Self { divisor, block, division } = self;
        // Records may differ in length, but a division has a fixed one.
        let division = match division {
            Some(d) if d.terms() == m => {
                d.reset();
                d
            }
            other => other.insert(Division::new(1, m)),
        };
        divisor.clear();
        let mut inverse = [0.0];
        while division.solved_terms() < m {
            let lo = division.solved_terms();
            let hi = (lo + BLOCK_TERMS).min(m);
            let from = divisor.len();
            let needed = division.required_terms().max(from);
            divisor.resize(needed, 0.0);
            for (kernel, c) in own.clone() {
                divisor[from..].iter_mut().zip(&kernel[from..needed]).for_each(|(d, v)| *d -= c * v);
            }
            if from == 0 {
                divisor[0] += 1.0;
                if divisor[0] == 0.0 || !divisor[0].is_finite() {
                    return Verdict::Failed(Failure::Singular);
                }
                inverse[0] = 1.0 / divisor[0];
            }
            let block = &mut block[..hi - lo];
            combine(block, lo, driven.clone());
            division.add(0, lo, block);
            division.solve_block(&inverse, |_, _, len| &divisor[..len]);
            raw = norm.add(raw, &target[lo..hi], &division.quotient(0)[lo..hi]);
            if !raw.is_finite() {
                return Verdict::Failed(Failure::Diverged);
            }
            // An interrupted candidate must not be taken for a scored one.
            if raw > limit || control.is_stopped() {
                return Verdict::Stopped(raw);
            }
            division.join(|_, _, len| &divisor[..len]);
        }
        Verdict::Score(raw)
    }

    /// Add the residuals y − Σ c x to a raw sum. Stops once the sum exceeds the limit.
    pub(crate) fn residuals<'a>(
        &mut self,
        target: &[f64],
        columns: impl Iterator<Item = Weighted<'a>> + Clone,
        norm: Norm,
        mut raw: f64,
        limit: f64,
    ) -> Verdict {
        for (i, target) in target.chunks(BLOCK_TERMS).enumerate() {
            let block = &mut self.block[..target.len()];
            combine(block, i * BLOCK_TERMS, columns.clone());
            raw = norm.add(raw, target, block);
            if !raw.is_finite() {
                return Verdict::Failed(Failure::Diverged);
            }
            if raw > limit {
                return Verdict::Stopped(raw);
            }
        }
        Verdict::Score(raw)
    }
}

/// Sum Σ c x of the weighted columns over the block that starts at `lo`.
#[inline]
fn combine<'a>(block: &mut [f64], lo: usize, columns: impl Iterator<Item = Weighted<'a>>) {
    block.fill(0.0);
    let hi = lo + block.len();
    for (column, c) in columns {
        block.iter_mut().zip(&column[lo..hi]).for_each(|(b, v)| *b += c * v);
    }
}

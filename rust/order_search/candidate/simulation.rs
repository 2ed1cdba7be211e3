//! Blockwise simulation ŷ = N/D of one candidate, compared with the measured output block by block. N is the input part
//! of the equation, D its denominator.

use crate::order_search::control::Control;
use crate::order_search::options::Norm;
use crate::order_search::result::{Failure, Verdict};
use crate::series::{Division, BLOCK_TERMS};

/// Regressor column or kernel, and its coefficient.
type Weighted<'a> = (&'a [f64], f64);

/// Workspace of simulations, reused for all candidates.
pub(crate) struct BlockSimulation {
    /// Denominator of the simulated output as a series, as far as computed.
    divisor: Vec<f64>,
    /// Input part of the equation (numerator) in the current block.
    block: Vec<f64>,
    division: Option<Division>,
}

impl Default for BlockSimulation {
    fn default() -> Self {
        Self { divisor: Vec::new(), block: vec![0.0; BLOCK_TERMS], division: None }
    }
}

impl BlockSimulation {
    /// Simulate a candidate and add its error Σ|e| or Σe² to the sum `raw`. The simulation stops once the sum exceeds
    /// the limit or the caller requests a stop.
    ///
    /// The simulated output is N/D. The denominator D = 1 − Σ c F is summed over the kernels F in `output_terms`. The
    /// numerator N = Σ c x is summed over the columns x in `input_terms`. Only the part of a kernel up to the current
    /// block is read.
    #[allow(clippy::too_many_arguments)]
    pub(crate) fn accumulate_error<'a>(
        &mut self,
        target: &[f64],
        output_terms: impl Iterator<Item = Weighted<'a>> + Clone,
        input_terms: impl Iterator<Item = Weighted<'a>> + Clone,
        norm: Norm,
        mut raw: f64,
        limit: f64,
        control: &Control,
    ) -> Verdict {
        let m = target.len();
        let Self { divisor, block, division } = self;
        // Records may differ in length, but the length of a division is fixed.
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
            let computed_terms = divisor.len();
            let required_terms = division.required_terms().max(computed_terms);
            divisor.resize(required_terms, 0.0);
            for (kernel, c) in output_terms.clone() {
                divisor[computed_terms..]
                    .iter_mut()
                    .zip(&kernel[computed_terms..required_terms])
                    .for_each(|(d, v)| *d -= c * v);
            }
            if computed_terms == 0 {
                divisor[0] += 1.0;
                if divisor[0] == 0.0 || !divisor[0].is_finite() {
                    return Verdict::Failed(Failure::Singular);
                }
                inverse[0] = 1.0 / divisor[0];
            }
            let block = &mut block[..hi - lo];
            combine(block, lo, input_terms.clone());
            division.add(0, lo, block);
            division.solve_block(&inverse, |_, _, len| &divisor[..len]);
            raw = norm.add(raw, &target[lo..hi], &division.quotient(0)[lo..hi]);
            if !raw.is_finite() {
                return Verdict::Failed(Failure::Diverged);
            }
            // An interrupted candidate must not be ranked by its partial sum.
            if raw > limit || control.is_stopped() {
                return Verdict::Stopped(raw);
            }
            division.subtract_contributions(|_, _, len| &divisor[..len]);
        }
        Verdict::Score(raw)
    }

    /// Add Σ|ε| or Σε² of the equation error ε = y − Σ c x to the sum `raw`. The computation stops once the sum exceeds
    /// the limit.
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

/// Write the sum Σ c x of the weighted columns x to the block that starts at sample `lo`.
#[inline]
fn combine<'a>(block: &mut [f64], lo: usize, columns: impl Iterator<Item = Weighted<'a>>) {
    block.fill(0.0);
    let hi = lo + block.len();
    for (column, c) in columns {
        block.iter_mut().zip(&column[lo..hi]).for_each(|(b, v)| *b += c * v);
    }
}

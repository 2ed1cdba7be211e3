//! Options of an order search: criterion, norm, estimator, pruning and memory budget.
//!
//! The budget counts memory that grows with records and order grid: columns, kernels, their products, spectra and test
//! vectors of every equation and record, and the rows of the join of coupled equations. Tables of boxes and tailored
//! test vectors use the remaining memory, or are not built. The records themselves and the workspace of each thread,
//! some vectors of the record's length, are not counted.

use crate::equation::Initial;
use crate::error::{check_finite, Error, Result};
use crate::estimation::instrumental_variables::InstrumentalSettings;
use crate::estimation::multi_innovation::Innovation;
use crate::fft::{fast_length, Bin};
use crate::regressors::{Bank, Index, Record, BANK_LIMIT};
use crate::simd::LANE_COUNT;

/// Error that ranks the candidates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Criterion {
    /// Output error e = y − ŷ, ŷ the simulated output.
    OutputError,
    /// Equation error ε = y − Σ c I^{α−ν} s with measured signals s.
    EquationError,
}

/// Norm of an error over all samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Norm {
    /// Sum of absolute errors Σ|e| (equation (45) of the paper).
    L1,
    /// Root mean square √(Σe²/M) (equation (46) of the paper).
    L2,
}

impl Norm {
    /// Add |e| or e² of a block to a raw sum.
    #[inline]
    pub(crate) fn add(self, raw: f64, measured: &[f64], response: &[f64]) -> f64 {
        raw + match self {
            Self::L1 => sum_side_by_side(measured, response, |y, v| (y - v).abs()),
            Self::L2 => sum_side_by_side(measured, response, |y, v| (y - v) * (y - v)),
        }
    }

    /// Score of a raw sum (Σ|e| or Σe²) over this many samples.
    ///
    /// ```
    /// # use ftlm::order_search::options::Norm;
    /// assert_eq!((Norm::L1.score(36.0, 4), Norm::L2.score(36.0, 4)), (36.0, 3.0));
    /// ```
    #[allow(clippy::cast_precision_loss)]
    #[must_use]
    pub fn score(self, raw: f64, samples: usize) -> f64 {
        match self {
            Self::L1 => raw,
            Self::L2 => (raw / samples as f64).sqrt(),
        }
    }
}

/// Sum over pairs of values in [`LANE_COUNT`] independent partial sums.
#[inline(always)]
fn sum_side_by_side(a: &[f64], b: &[f64], term: impl Fn(f64, f64) -> f64) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANE_COUNT>(), b.as_chunks::<LANE_COUNT>());
    let mut sums = [0.0; LANE_COUNT];
    for (a, b) in a.iter().zip(b) {
        for l in 0..LANE_COUNT {
            sums[l] += term(a[l], b[l]);
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(&a, &b)| term(a, b)).sum();
    sums.iter().sum::<f64>() + rest
}

/// Estimator of a candidate's coefficients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Estimator {
    /// Least squares on the equation error.
    LeastSquares,
    /// Multi-innovation least squares in closed form.
    MultiInnovation(Innovation),
    /// Instrumental variables, refined from the records' noise-free signals.
    InstrumentalVariables(InstrumentalSettings),
}

/// Options of an order search.
///
/// Defaults: output error in the L1 norm, least-squares coefficients, zero initial conditions, 20 rows, one thread.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Error that ranks the candidates.
    pub criterion: Criterion,
    /// Norm of the error.
    pub norm: Norm,
    /// Estimator of the coefficients.
    pub estimator: Estimator,
    /// Initial terms of each record.
    pub initial: Initial,
    /// Number of rows in the table, at least one.
    pub top: usize,
    /// Number of threads, 1 to `MAX_THREADS`. The result is bitwise identical for any number.
    pub threads: usize,
    /// True to stop the evaluation of a candidate once its bound or partial sum excludes it. `false` evaluates all
    /// candidates completely, as a reference for tests.
    pub pruning: bool,
    /// Limit \[bytes\] of the memory for regressors, their products, test vectors and the join of coupled equations.
    pub memory: u64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            criterion: Criterion::OutputError,
            norm: Norm::L1,
            estimator: Estimator::LeastSquares,
            initial: Initial::Rest,
            top: 20,
            threads: 1,
            pruning: true,
            memory: BANK_LIMIT,
        }
    }
}

impl Options {
    /// Raise an error if no search is possible with these options.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for an empty table, an estimator's settings or the exponent of an initial term.
    /// [`Error::NotFinite`] for exponents that are not finite.
    ///
    /// ```
    /// # use ftlm::order_search::options::Options;
    /// assert!(Options::default().check().is_ok());
    /// assert!(Options { top: 0, ..Options::default() }.check().is_err());
    /// ```
    pub fn check(&self) -> Result<()> {
        if self.top == 0 {
            return Err(out_of_range("keep", 0.0, "[1, ∞)", "keep at least one row"));
        }
        match self.estimator {
            Estimator::LeastSquares => {}
            Estimator::MultiInnovation(innovation) => innovation.check()?,
            Estimator::InstrumentalVariables(settings) => {
                if settings.iterations == 0 {
                    let remedy = "use at least one iteration, or rank by least squares";
                    return Err(out_of_range("iterations of instrumental variables", 0.0, "[1, ∞)", remedy));
                }
                settings.check()?;
            }
        }
        if let Initial::Powers(powers) = self.initial.under() {
            check_finite("exponents of the initial terms", powers)?;
            if let Some(&bad) = powers.iter().find(|&&e| e <= -1.0) {
                let remedy = "t to this power has no mean over the first pulse";
                return Err(out_of_range("exponent of an initial term", bad, "(-1, ∞)", remedy));
            }
        }
        Ok(())
    }

    /// True if the coefficients of each candidate are refined after an initial estimate.
    pub(crate) fn refines(&self) -> bool {
        matches!(self.estimator, Estimator::InstrumentalVariables(_))
    }

    /// Return the maximum weight of a row in the normal equations: the innovation length, or 1 without multi-innovation.
    pub(crate) fn weights(&self) -> usize {
        match self.estimator {
            Estimator::MultiInnovation(innovation) => innovation.length,
            Estimator::LeastSquares | Estimator::InstrumentalVariables(_) => 1,
        }
    }

    /// Whether candidates are ranked by simulation with zero initial conditions and coefficients from the normal
    /// equations.
    pub(crate) fn ranks_by_simulation(&self) -> bool {
        self.pruning && !self.refines() && self.criterion == Criterion::OutputError && self.initial == Initial::Rest
    }

    /// Whether a candidate's score follows from the Gram matrix alone. This is the squared equation error with zero
    /// initial conditions.
    pub(crate) fn ranks_by_gram_matrix(&self) -> bool {
        self.pruning
            && !self.refines()
            && self.criterion == Criterion::EquationError
            && self.norm == Norm::L2
            && self.initial == Initial::Rest
    }
}

fn out_of_range(name: &str, value: f64, range: &str, remedy: &str) -> Error {
    Error::OutOfRange { name: name.into(), value, range: range.into(), remedy: remedy.into() }
}

const BYTES_PER_VALUE: u128 = size_of::<f64>() as u128;

/// Total memory that a search needs.
#[derive(Debug, Default)]
pub(crate) struct Budget {
    bytes: u128,
    columns: usize,
    layout: u128,
}

impl Budget {
    /// Add the memory of the rows of a join \[bytes\].
    pub(crate) fn add_layout(&mut self, bytes: u128) {
        self.layout += bytes;
        self.bytes += bytes;
    }

    /// Add the data shared by the candidates of one equation, with at most `vectors` test vectors.
    pub(crate) fn add(&mut self, records: &[Record], output: usize, index: &Index, options: &Options, vectors: usize) {
        let width = index.keys().len() as u128;
        let own = Bank::own(index, output) as u128;
        let refined = options.refines();
        let bounded = options.pruning && !options.ranks_by_gram_matrix() && vectors > 0;
        let mut largest = 0;
        for record in records {
            let m = record.m();
            let bank = BYTES_PER_VALUE * m as u128 * (width + own);
            largest = bank.max(largest);
            // Add the target.
            self.bytes += bank + BYTES_PER_VALUE * m as u128;
            if refined {
                let spectrum = (size_of::<Bin>() * (fast_length(2 * m) / 2 + 1)) as u128;
                self.bytes += spectrum * (width + own + 1);
                // D e = w holds for integrals of the measured output, which need another bank.
                if bounded && options.criterion == Criterion::OutputError {
                    self.bytes += bank;
                }
            }
            if bounded {
                // Real and imaginary parts with every column and the target, before and after regrouping, four numbers
                // per own column, and the vectors.
                let vectors = vectors as u128;
                self.bytes += BYTES_PER_VALUE * vectors * (4 * (width + 1) + 4 * own + 2 * m as u128);
            }
        }
        // Products of all columns and the target: per record for the initial terms, summed over records, and
        // temporaries.
        let products = BYTES_PER_VALUE * (3 + records.len() as u128) * (width + 1).pow(2);
        // Only one bank for initial coefficients exists at a time.
        self.bytes += products + if refined { largest } else { 0 };
        self.columns += index.keys().len();
    }

    /// Memory that remains of a limit \[bytes\].
    pub(crate) fn remaining_bytes(&self, limit: u64) -> u64 {
        u128::from(limit).saturating_sub(self.bytes).try_into().unwrap_or(u64::MAX)
    }

    /// Raise an error if the memory exceeds the limit.
    ///
    /// # Errors
    /// [`Error::Memory`] if the memory exceeds the limit.
    pub(crate) fn check(&self, limit: u64) -> Result<()> {
        let limit = u128::from(limit);
        if self.bytes <= limit {
            return Ok(());
        }
        let layout = if self.layout > 0 { " and the layout of the order law" } else { "" };
        let what = format!("{} regressors of all runs, their products and test vectors{layout}", self.columns);
        Err(Error::Memory { what, bytes: self.bytes, limit })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_of_a_limit_is_never_below_nothing() {
        let mut budget = Budget::default();
        assert_eq!(budget.remaining_bytes(u64::MAX), u64::MAX);
        budget.add_layout(1000);
        assert_eq!([999, 1000, 1500].map(|limit| budget.remaining_bytes(limit)), [0, 0, 500]);
        budget.add_layout(u128::from(u64::MAX));
        assert_eq!(budget.remaining_bytes(u64::MAX), 0);
    }
}

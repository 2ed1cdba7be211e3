//! Options of an order search: criterion, norm, estimator, pruning and memory budget.
//!
//! The memory budget counts all memory that grows with records and order grid. It includes columns, kernels, their
//! inner products, spectra and test vectors of every equation and record. It also includes the rows of the join of
//! coupled equations. Tables of boxes and tailored test vectors use the remaining memory, or are not built. The budget
//! excludes the records and the workspace of each thread, which is a few vectors of the record's length.

use crate::equation::Initial;
use crate::error::{check_finite, Error, Result};
use crate::estimation::instrumental_variables::InstrumentalSettings;
use crate::estimation::multi_innovation::Innovation;
use crate::fft::{fast_length, Bin};
use crate::regressors::{Bank, Index, Record, BANK_LIMIT};
use crate::simd::LANE_COUNT;

/// Kind of error by which the candidates are ranked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Criterion {
    /// Output error e = y − ŷ with measured output y and simulated output ŷ.
    OutputError,
    /// Equation error ε = y − Σ c I^{α−ν} s over the terms with coefficient c, order ν and measured signal s. I^{α−ν}
    /// is the fractional integral for an equation of order α.
    EquationError,
}

/// Norm of an error over all samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Norm {
    /// Sum of absolute errors Σ|e|, eq. (45) of the paper.
    L1,
    /// Root mean square √(Σe²/M) over M samples, eq. (46) of the paper.
    L2,
}

impl Norm {
    /// Return the sum `raw` plus Σ|e| or Σe² over a block, with the error e = measured − response.
    #[inline]
    pub(crate) fn add(self, raw: f64, measured: &[f64], response: &[f64]) -> f64 {
        raw + match self {
            Self::L1 => sum_side_by_side(measured, response, |y, v| (y - v).abs()),
            Self::L2 => sum_side_by_side(measured, response, |y, v| (y - v) * (y - v)),
        }
    }

    /// Return the score of a raw sum (Σ|e| or Σe²) over this many samples.
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

/// Return the sum of `term(a, b)` over pairs of values, computed in [`LANE_COUNT`] independent partial sums.
#[inline(always)]
fn sum_side_by_side(a: &[f64], b: &[f64], term: impl Fn(f64, f64) -> f64) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANE_COUNT>(), b.as_chunks::<LANE_COUNT>());
    let mut sums = [0.0; LANE_COUNT];
    for (a, b) in a.iter().zip(b) {
        for l in 0..LANE_COUNT {
            sums[l] += term(a[l], b[l]);
        }
    }
    let tail: f64 = a_rest.iter().zip(b_rest).map(|(&a, &b)| term(a, b)).sum();
    sums.iter().sum::<f64>() + tail
}

/// Estimator of a candidate's coefficients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Estimator {
    /// Least squares on the equation error.
    LeastSquares,
    /// Multi-innovation least squares in closed form.
    MultiInnovation(Innovation),
    /// Estimation by refined instrumental variables, with instruments from the noise-free signals of the records.
    InstrumentalVariables(InstrumentalSettings),
}

/// Options of an order search.
///
/// The defaults are the output error in the L1 norm, least-squares coefficients, zero initial conditions, 20 rows and
/// one thread.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Kind of error by which the candidates are ranked.
    pub criterion: Criterion,
    /// Norm of the error.
    pub norm: Norm,
    /// Estimator of the coefficients.
    pub estimator: Estimator,
    /// Initial terms that are estimated for each record.
    pub initial: Initial,
    /// Number of rows in the result table, at least one.
    pub top: usize,
    /// Number of threads, 1 to `MAX_THREADS`. The result is bitwise identical for any number of threads.
    pub threads: usize,
    /// True to exclude candidates by lower bounds and to stop an evaluation once its partial sum exceeds the limit.
    /// `false` evaluates all candidates completely, as a reference for tests.
    pub pruning: bool,
    /// Limit of the memory for regressors, their inner products, test vectors and the join of coupled equations
    /// \[bytes\].
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
    /// Return an error if no search is possible with these options.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a table without rows, invalid settings of the estimator, or an exponent of an initial
    /// term that is not above −1. [`Error::NotFinite`] for exponents that are not finite.
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
        if let Initial::Powers(powers) = self.initial.base() {
            check_finite("exponents of the initial terms", powers)?;
            if let Some(&bad) = powers.iter().find(|&&e| e <= -1.0) {
                let remedy = "t to this power has no mean over the first pulse";
                return Err(out_of_range("exponent of an initial term", bad, "(-1, ∞)", remedy));
            }
        }
        Ok(())
    }

    /// Return true if the coefficients of each candidate are refined after an initial estimate.
    pub(crate) fn refines(&self) -> bool {
        matches!(self.estimator, Estimator::InstrumentalVariables(_))
    }

    /// Return the largest weight of a row (sample) in the normal equations. It is the innovation length, or 1 for other
    /// estimators.
    pub(crate) fn weights(&self) -> usize {
        match self.estimator {
            Estimator::MultiInnovation(innovation) => innovation.length,
            Estimator::LeastSquares | Estimator::InstrumentalVariables(_) => 1,
        }
    }

    /// Return true if candidates are ranked by simulation with pruning, zero initial conditions and coefficients from
    /// the normal equations.
    pub(crate) fn ranks_by_simulation(&self) -> bool {
        self.pruning && !self.refines() && self.criterion == Criterion::OutputError && self.initial == Initial::Rest
    }

    /// Return true if the Gram matrix alone determines the score of a candidate. The score is then the squared equation
    /// error with zero initial conditions.
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

/// Memory that a search needs.
#[derive(Debug, Default)]
pub(crate) struct Budget {
    /// Total memory \[bytes\].
    bytes: u128,
    /// Total number of regressor columns of all equations.
    columns: usize,
    /// Part of the memory for the join of coupled equations \[bytes\].
    join_bytes: u128,
}

impl Budget {
    /// Add the memory of the rows of the join of coupled equations \[bytes\].
    pub(crate) fn add_layout(&mut self, bytes: u128) {
        self.join_bytes += bytes;
        self.bytes += bytes;
    }

    /// Add the memory of the data that the candidates of one equation share, with at most `vectors` test vectors.
    pub(crate) fn add(&mut self, records: &[Record], output: usize, index: &Index, options: &Options, vectors: usize) {
        let width = index.keys().len() as u128;
        let output_integrals = Bank::output_integral_count(index, output) as u128;
        let refined = options.refines();
        let has_dual_bound = options.pruning && !options.ranks_by_gram_matrix() && vectors > 0;
        let mut largest = 0;
        for record in records {
            let m = record.m();
            let bank = BYTES_PER_VALUE * m as u128 * (width + output_integrals);
            largest = bank.max(largest);
            // Add the target.
            self.bytes += bank + BYTES_PER_VALUE * m as u128;
            if refined {
                let spectrum = (size_of::<Bin>() * (fast_length(2 * m) / 2 + 1)) as u128;
                self.bytes += spectrum * (width + output_integrals + 1);
                // The dual bound uses D e = w with denominator D, output error e and equation error w. It requires
                // integrals of the measured output, which need another bank.
                if has_dual_bound && options.criterion == Criterion::OutputError {
                    self.bytes += bank;
                }
            }
            if has_dual_bound {
                // Products of real and imaginary parts with every column and the target are stored twice while they are
                // regrouped. Further memory is for four numbers per output column and for the vectors.
                let vectors = vectors as u128;
                self.bytes += BYTES_PER_VALUE * vectors * (4 * (width + 1) + 4 * output_integrals + 2 * m as u128);
            }
        }
        // Inner products of all columns and the target: per record for the initial terms, summed over records, and
        // temporary copies.
        let products = BYTES_PER_VALUE * (3 + records.len() as u128) * (width + 1).pow(2);
        // Only one bank for initial coefficients exists at a time.
        self.bytes += products + if refined { largest } else { 0 };
        self.columns += index.keys().len();
    }

    /// Return the part of a memory limit that remains \[bytes\], 0 if the limit is exceeded.
    pub(crate) fn remaining_bytes(&self, limit: u64) -> u64 {
        u128::from(limit).saturating_sub(self.bytes).try_into().unwrap_or(u64::MAX)
    }

    /// Return an error if the memory exceeds a limit \[bytes\].
    ///
    /// # Errors
    /// [`Error::Memory`] if the memory exceeds the limit.
    pub(crate) fn check(&self, limit: u64) -> Result<()> {
        let limit = u128::from(limit);
        if self.bytes <= limit {
            return Ok(());
        }
        let join = if self.join_bytes > 0 { " and the join of coupled equations" } else { "" };
        let what = format!("{} regressors of all runs, their products and test vectors{join}", self.columns);
        Err(Error::Memory { what, bytes: self.bytes, limit })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remaining_limit_is_not_negative() {
        let mut budget = Budget::default();
        assert_eq!(budget.remaining_bytes(u64::MAX), u64::MAX);
        budget.add_layout(1000);
        assert_eq!([999, 1000, 1500].map(|limit| budget.remaining_bytes(limit)), [0, 0, 500]);
        budget.add_layout(u128::from(u64::MAX));
        assert_eq!(budget.remaining_bytes(u64::MAX), 0);
    }
}

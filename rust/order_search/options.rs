//! What a search is asked for: which error ranks the candidates, how it is summed, where coefficients come from.
//!
//! What a search will hold at once, counted before any of it is made, and the one limit that it keeps to.
//!
//! Counted is what grows with records and lattice: columns, kernels, their products, spectra and test vectors of every
//! equation and record, rows of the layout of an order law; tables of boxes and vectors made for candidates take of what is
//! left, or there are none. Not counted are the records themselves, and what each thread needs for one candidate: some
//! vectors of the record's length.

use crate::equation::Initial;
use crate::error::{check_finite, Error, Result};
use crate::estimation::instrumental_variables::Settings;
use crate::estimation::multi_innovation::Innovation;
use crate::fft::{fast_length, Bin};
use crate::regressors::{Bank, Index, Record, BANK_LIMIT};

/// Which error ranks the candidates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Criterion {
    /// e = y − ŷ, ŷ the free run.
    OutputError,
    /// ε = y − Σ c I^{α−ν} s, measured signals on the right-hand side.
    EquationError,
}

/// How an error becomes a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Norm {
    /// Σ|e| (paper (45)).
    L1,
    /// √(Σe²/M) (paper (46)).
    L2,
}

impl Norm {
    /// Adds |e| or e² of a block to a raw sum.
    #[inline]
    pub(crate) fn add(self, raw: f64, measured: &[f64], response: &[f64]) -> f64 {
        let pairs = measured.iter().zip(response);
        raw + match self {
            Self::L1 => pairs.map(|(y, v)| (y - v).abs()).sum::<f64>(),
            Self::L2 => pairs.map(|(y, v)| (y - v) * (y - v)).sum::<f64>(),
        }
    }

    /// A raw sum (Σ|e| or Σe²) over so many samples as the number that this norm gives.
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

/// How a candidate gets its coefficients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Estimator {
    /// Least squares on the equation error.
    LeastSquares,
    /// Multi-innovation least squares in closed form.
    MultiInnovation(Innovation),
    /// Refined instrumental variables from the records' clean signals ([`crate::regressors::Record::with_clean`]).
    InstrumentalVariables(Settings),
}

/// The settings of a search.
///
/// By default the output error in the norm of (45) ranks, coefficients are least squares', records start at rest, twenty
/// rows are kept and one thread is used.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Which error ranks.
    pub criterion: Criterion,
    /// How it is summed.
    pub norm: Norm,
    /// Where coefficients come from.
    pub estimator: Estimator,
    /// Initial terms of each record.
    pub initial: Initial,
    /// How many rows to keep, at least one.
    pub keep: usize,
    /// Threads, 1 to [`crate::parallel::MAX_THREADS`]; any number gives the same bits.
    pub threads: usize,
    /// Whether to leave a candidate as soon as it cannot be kept, by bound or partial sum; `false` is brute force, the
    /// oracle.
    pub early_stopping: bool,
    /// Bytes that regressors, their products, test vectors and the layout of an order law may take together.
    pub memory: u64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            criterion: Criterion::OutputError,
            norm: Norm::L1,
            estimator: Estimator::LeastSquares,
            initial: Initial::Rest,
            keep: 20,
            threads: 1,
            early_stopping: true,
            memory: BANK_LIMIT,
        }
    }
}

impl Options {
    /// Refuses settings with which no search can begin.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for no row to keep, for an estimator's settings and for an exponent of an initial term;
    /// [`Error::NotFinite`] for exponents that are no numbers.
    ///
    /// ```
    /// # use ftlm::order_search::options::Options;
    /// assert!(Options::default().check().is_ok());
    /// assert!(Options { keep: 0, ..Options::default() }.check().is_err());
    /// ```
    pub fn check(&self) -> Result<()> {
        if self.keep == 0 {
            return Err(out_of_range("keep", 0.0, "[1, ∞)", "keep at least one row"));
        }
        match self.estimator {
            Estimator::LeastSquares => {}
            Estimator::MultiInnovation(innovation) => innovation.check()?,
            Estimator::InstrumentalVariables(settings) => {
                if settings.iterations == 0 {
                    let remedy = "take at least one step, or rank by least squares";
                    return Err(out_of_range("steps of instrumental variables", 0.0, "[1, ∞)", remedy));
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

    /// Whether coefficients are refined, one candidate at a time, after a first estimate.
    pub(crate) fn refines(&self) -> bool {
        matches!(self.estimator, Estimator::InstrumentalVariables(_))
    }

    /// How many times another a row may weigh in the equations that give the coefficients.
    pub(crate) fn weights(&self) -> usize {
        match self.estimator {
            Estimator::MultiInnovation(innovation) => innovation.length,
            Estimator::LeastSquares | Estimator::InstrumentalVariables(_) => 1,
        }
    }

    /// Whether candidates are ranked by free runs at rest with coefficients by least squares.
    pub(crate) fn scored_by_free_runs(&self) -> bool {
        self.early_stopping
            && self.estimator == Estimator::LeastSquares
            && self.criterion == Criterion::OutputError
            && self.initial == Initial::Rest
    }

    /// Whether a candidate's score follows from the Gram matrix alone: the squared equation error at rest.
    pub(crate) fn scored_by_products(&self) -> bool {
        self.early_stopping
            && !self.refines()
            && self.criterion == Criterion::EquationError
            && self.norm == Norm::L2
            && self.initial == Initial::Rest
    }
}

fn out_of_range(name: &str, value: f64, range: &str, remedy: &str) -> Error {
    Error::OutOfRange { name: name.into(), value, range: range.into(), remedy: remedy.into() }
}

const VALUE: u128 = size_of::<f64>() as u128;

/// What was asked for, summed up.
#[derive(Debug, Default)]
pub(crate) struct Budget {
    bytes: u128,
    columns: usize,
    layout: u128,
}

impl Budget {
    /// Rows of a layout, in bytes.
    pub(crate) fn add_layout(&mut self, bytes: u128) {
        self.layout += bytes;
        self.bytes += bytes;
    }

    /// What the candidates of one equation share; `vectors` test vectors at most.
    pub(crate) fn add(&mut self, records: &[Record], output: usize, index: &Index, options: &Options, vectors: usize) {
        let width = index.keys().len() as u128;
        let own = Bank::own(index, output) as u128;
        let refined = options.refines();
        let bounded = options.early_stopping && !options.scored_by_products() && vectors > 0;
        let mut largest = 0;
        for record in records {
            let m = record.m();
            let bank = VALUE * m as u128 * (width + own);
            largest = bank.max(largest);
            // The target beside it.
            self.bytes += bank + VALUE * m as u128;
            if refined {
                let spectrum = (size_of::<Bin>() * (fast_length(2 * m) / 2 + 1)) as u128;
                self.bytes += spectrum * (width + own + 1);
                // D e = w holds for integrals of the output as it was measured: another bank.
                if bounded && options.criterion == Criterion::OutputError {
                    self.bytes += bank;
                }
            }
            if bounded {
                // Real and imaginary part with every column and the target, once as they come and once as they are kept;
                // four numbers an own column; the vectors.
                let vectors = vectors as u128;
                self.bytes += VALUE * vectors * (4 * (width + 1) + 4 * own + 2 * m as u128);
            }
        }
        // Products of all columns and the target: of each record at rest apart, of all, as they are summed.
        let products = VALUE * (3 + records.len() as u128) * (width + 1).pow(2);
        // Of the banks behind which the first coefficients are estimated there is one at a time.
        self.bytes += products + if refined { largest } else { 0 };
        self.columns += index.keys().len();
    }

    /// Bytes that are left of a limit.
    pub(crate) fn left(&self, limit: u64) -> u64 {
        u128::from(limit).saturating_sub(self.bytes).try_into().unwrap_or(u64::MAX)
    }

    /// Refuses what does not fit.
    ///
    /// # Errors
    /// [`Error::Memory`].
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
        assert_eq!(budget.left(u64::MAX), u64::MAX);
        budget.add_layout(1000);
        assert_eq!([999, 1000, 1500].map(|limit| budget.left(limit)), [0, 0, 500]);
        budget.add_layout(u128::from(u64::MAX));
        assert_eq!(budget.left(u64::MAX), 0);
    }
}

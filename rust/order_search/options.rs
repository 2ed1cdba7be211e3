//! What a search is asked for: which error ranks the candidates, how it is summed, where coefficients come from.

use crate::equation::Initial;
use crate::error::{check_finite, Error, Result};
use crate::estimation::instrumental_variables::Settings;
use crate::estimation::multi_innovation::Innovation;
use crate::regressors::BANK_LIMIT;

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
    /// Threads, 1 to [`crate::threads::MAX_THREADS`]; any number gives the same bits.
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

//! Multi-innovation least squares, eqs. (42)–(44) of the paper: the recursion as published, and its exact closed form.
//!
//! Eq. (44) estimates X in m = Q X with rows m_i = q_iᵀX. One step with the p newest rows is a block step of recursive
//! least squares. After all M rows, the recursion has minimized Σ w_i (m_i − q_iᵀX)² + (X − X₀)ᵀK₀⁻¹(X − X₀). X₀ is the
//! initial estimate and K₀ its covariance. The weight is w_i = min(p, M − i + 1), because a row is used in every step
//! in which it is one of the p newest. Apart from the last rows, the innovation length p therefore only weights the
//! data relative to the prior.

use crate::equation::{Initial, Structure};
use crate::error::{check_finite, check_length, Error, Result};
use crate::estimation::least_squares::{self, Estimate, Regression};
use crate::fractional::operational_matrices;
use crate::linalg::small::{Recursion, SlidingGram};
use crate::parallel::Stop;
use crate::regressors::Record;

/// Basis of the rows of the regression.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RowBasis {
    /// Haar coefficients, from coarse to fine, as in the paper. The number of pulses must be a power of two.
    Haar,
    /// Block-pulse means in the sequence of time.
    Time,
}

/// Prior covariance K₀ of the coefficients, a diagonal matrix.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Prior {
    /// The same covariance for every coefficient.
    Absolute(f64),
    /// Product of the prior variance of a coefficient and the sum of squares of its regressor column. It does not
    /// depend on units.
    Relative(f64),
}

impl Prior {
    /// Weak prior, which affects only coefficients that the data hardly determine.
    pub const WEAK: Self = Self::Relative(1e10);

    /// Return the inverse prior covariance of a coefficient whose column has the sum of squares `squares`.
    #[must_use]
    pub fn precision(self, squares: f64) -> f64 {
        match self {
            Self::Absolute(covariance) => 1.0 / covariance,
            Self::Relative(covariance) => squares / covariance,
        }
    }

    /// Return the inverse prior covariance of the coefficient of each column.
    fn precisions(self, columns: &[Vec<f64>]) -> Vec<f64> {
        columns.iter().map(|column| self.precision(column.iter().map(|v| v * v).sum())).collect()
    }

    pub(crate) fn check(self) -> Result<()> {
        let (Self::Absolute(value) | Self::Relative(value)) = self;
        if value > 0.0 && value.is_finite() {
            return Ok(());
        }
        Err(Error::OutOfRange {
            name: "prior covariance K0".into(),
            value,
            range: "(0, ∞)".into(),
            remedy: "use a large number for a weak prior".into(),
        })
    }
}

/// Settings of the recursion, eq. (44) of the paper.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation {
    /// Innovation length p ≥ 1: number of newest rows in each step.
    pub length: usize,
    /// Prior covariance K₀ of the coefficients.
    pub prior: Prior,
    /// Basis of the rows.
    pub row_basis: RowBasis,
}

impl Innovation {
    /// Check that p and the prior covariance are positive.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] if p or the prior covariance is not positive.
    pub fn check(&self) -> Result<()> {
        if self.length == 0 {
            return Err(Error::OutOfRange {
                name: "innovation length p".into(),
                value: 0.0,
                range: "[1, ∞)".into(),
                remedy: "use p = 1 for ordinary recursive least squares".into(),
            });
        }
        self.prior.check()
    }

    /// Weight of row `i` (from 0) of `m` rows: the number of steps that use it.
    #[must_use]
    pub fn weight(&self, i: usize, m: usize) -> usize {
        self.length.min(m - i)
    }
}

/// Return the final estimate of the recursion in closed form.
///
/// It follows from a QR factorization of the weighted rows and the rows of the prior.
///
/// # Errors
/// [`Error::OutOfRange`] for invalid settings or orders. [`Error::NotPowerOfTwo`] if the Haar basis is used and the
/// number of pulses is not a power of two. [`Error::Length`] if `fixed` does not have one entry per term or there is no
/// record. [`Error::Singular`] if a free term is zero.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::equation::{Initial, Structure, Term};
/// use ftlm::estimation::multi_innovation::{closed_form, recursion, Innovation, Prior, RowBasis};
/// use ftlm::regressors::Record;
/// let input: Vec<f64> = (0..64).map(|k| f64::from(k % 7)).collect();
/// let excitation = Record::new(0.1, PulseMeans::from_signals(vec![vec![0.0; 64], input.clone()]), None)?;
/// let output = excitation.integral(1, 0.5).iter().map(|v| 3.0 * v).collect();
/// let run = [Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?];
/// let structure = Structure { output: 0, order: 0.5, terms: vec![Term { signal: 1, order: 0.0 }] };
/// let innovation = Innovation { length: 4, prior: Prior::WEAK, row_basis: RowBasis::Time };
/// let end = closed_form(&run, &structure, &[None], &Initial::Rest, &innovation)?;
/// let (last, trace) = recursion(&run, &structure, &[None], &Initial::Rest, &innovation)?;
/// assert_eq!(trace.len(), 64);
/// assert!((end.coefficients[0] - last.coefficients[0]).abs() < 1e-9);
/// # Ok(())
/// # }
/// ```
pub fn closed_form(
    records: &[Record],
    structure: &Structure,
    fixed: &[Option<f64>],
    initial: &Initial,
    innovation: &Innovation,
) -> Result<Estimate> {
    let regression = regression_in_basis(records, structure, fixed, initial, innovation)?;
    let Regression { columns, target, starts, .. } = &regression;
    let prior = innovation.prior.precisions(columns);
    let (solution, excluded_columns) =
        weighted_solution((columns, target, starts), innovation.length, &prior, regression.free_count())?;
    regression.estimate(&solution, &excluded_columns)
}

/// Return the least-squares solution of the weighted rows and the prior rows, and the linearly dependent columns.
///
/// `prior` contains the inverse prior covariances. The first `required` columns must be independent.
fn weighted_solution(
    (columns, target, starts): (&[impl AsRef<[f64]>], &[f64], &[usize]),
    length: usize,
    prior: &[f64],
    required: usize,
) -> Result<(Vec<f64>, Vec<usize>)> {
    let columns = columns.iter().map(|column| column.as_ref().to_vec()).collect();
    let (columns, target) = weighted_rows(columns, target.to_vec(), starts, length, prior);
    // With a prior, only a zero column under a relative prior is linearly dependent in exact arithmetic.
    let (solution, excluded_columns) = least_squares::solve(&columns, &target, 0)?;
    match excluded_columns.iter().find(|&&column| column < required) {
        Some(&index) => Err(Error::Singular { index, count: columns.len() }),
        None => Ok((solution, excluded_columns)),
    }
}

/// Return the rows times the square roots of their weights, followed by the rows of the prior.
fn weighted_rows(
    mut columns: Vec<Vec<f64>>,
    mut target: Vec<f64>,
    starts: &[usize],
    length: usize,
    prior: &[f64],
) -> (Vec<Vec<f64>>, Vec<f64>) {
    for series in columns.iter_mut().chain(std::iter::once(&mut target)) {
        for pair in starts.windows(2) {
            let m = pair[1] - pair[0];
            for (i, value) in series[pair[0]..pair[1]].iter_mut().enumerate() {
                #[allow(clippy::cast_precision_loss)]
                let weight = length.min(m - i) as f64;
                *value *= weight.sqrt();
            }
        }
    }
    let (k, end) = (columns.len(), target.len());
    for (j, (column, precision)) in columns.iter_mut().zip(prior).enumerate() {
        column.resize(end + k, 0.0);
        column[end + j] = precision.sqrt();
    }
    target.resize(end + k, 0.0);
    (columns, target)
}

/// Return the multi-innovation estimate of X in m = Q X in closed form, eq. (44) of the paper.
///
/// `columns` are the columns of Q, and `target` is m with M elements. The initial estimate is X₀ = 0, with a prior
/// covariance of each coefficient. The cost is O(M k²) for k columns.
///
/// # Errors
/// [`Error::OutOfRange`] if the innovation length is 0, or a prior covariance is not positive and finite.
/// [`Error::NotFinite`] if a value is not finite. [`Error::Length`] if the lengths do not match.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// let (q, m) = ([1.0, 2.0, 3.0], [2.0, 4.0, 6.0]);
/// let found = ftlm::estimation::multi_innovation::estimate(&[q], &m, 2, &[1e9])?;
/// assert!((found[0] - 2.0).abs() < 1e-8);
/// # Ok(())
/// # }
/// ```
pub fn estimate(
    columns: &[impl AsRef<[f64]>],
    target: &[f64],
    length: usize,
    prior_covariance: &[f64],
) -> Result<Vec<f64>> {
    let prior = check_problem(columns, target, length, prior_covariance)?;
    let starts = [0, target.len()];
    Ok(weighted_solution((columns, target, &starts), length, &prior, columns.len())?.0)
}

/// Return the coefficients after every step of the recursion, eq. (44) of the paper, with the regressors `columns`.
///
/// The steps are concatenated, with k coefficients each. The last coefficients equal [`estimate`]. The cost is O(M k³)
/// for M rows and k columns.
///
/// # Errors
/// [`Error::OutOfRange`], [`Error::NotFinite`] and [`Error::Length`] as for [`estimate`]. [`Error::Diverged`] if
/// rounding makes the covariance indefinite. [`Error::Interrupted`] after a stop request.
pub fn path(
    columns: &[impl AsRef<[f64]>],
    target: &[f64],
    length: usize,
    prior_covariance: &[f64],
    stop: &Stop,
) -> Result<Vec<f64>> {
    let prior = check_problem(columns, target, length, prior_covariance)?;
    run_recursion((columns, target, &[0, target.len()]), length, &prior, stop)
}

/// Return the coefficients after every step of the recursion, with all steps concatenated.
///
/// `starts` contains the first row of each record, then the number of rows. `prior` contains the inverse prior
/// covariances.
fn run_recursion(
    (columns, target, starts): (&[impl AsRef<[f64]>], &[f64], &[usize]),
    length: usize,
    prior: &[f64],
    stop: &Stop,
) -> Result<Vec<f64>> {
    let mut state = Recursion::new(prior)?;
    let mut window = SlidingGram::new(columns.len(), length);
    let mut row = vec![0.0; columns.len()];
    let mut trace = Vec::with_capacity(target.len() * columns.len());
    for pair in starts.windows(2) {
        window.clear();
        for (row_index, &measured) in target.iter().enumerate().take(pair[1]).skip(pair[0]) {
            stop.check()?;
            row.iter_mut().zip(columns).for_each(|(value, column)| *value = column.as_ref()[row_index]);
            window.push(&row, measured)?;
            state
                .step(&window)
                .map_err(|_| Error::Diverged { what: "covariance of the recursion".into(), index: row_index })?;
            trace.extend_from_slice(state.coefficients());
        }
    }
    Ok(trace)
}

/// Return the inverse prior covariances, or an error if a length, a setting or a value is invalid.
fn check_problem(
    columns: &[impl AsRef<[f64]>],
    target: &[f64],
    length: usize,
    prior_covariance: &[f64],
) -> Result<Vec<f64>> {
    check_length("prior covariances", columns.len(), prior_covariance.len())?;
    for &covariance in prior_covariance {
        Innovation { length, prior: Prior::Absolute(covariance), row_basis: RowBasis::Time }.check()?;
    }
    check_finite("m", target)?;
    columns.iter().try_for_each(|column| {
        check_length("column of Q", target.len(), column.as_ref().len())?;
        check_finite("Q", column.as_ref())
    })?;
    Ok(prior_covariance.iter().map(|covariance| 1.0 / covariance).collect())
}

/// Run the recursion, eq. (44) of the paper, from X₀ = 0 over all records in sequence.
///
/// Return the last estimate and the coefficients after every step. An innovation never spans two records. The cost is
/// O(k³) per step for k columns.
///
/// # Errors
/// The errors of [`closed_form`]: settings or orders out of range, lengths that do not match. [`Error::Diverged`] if
/// rounding makes the covariance indefinite.
pub fn recursion(
    records: &[Record],
    structure: &Structure,
    fixed: &[Option<f64>],
    initial: &Initial,
    innovation: &Innovation,
) -> Result<(Estimate, Vec<Vec<f64>>)> {
    let regression = regression_in_basis(records, structure, fixed, initial, innovation)?;
    let Regression { columns, target, starts, .. } = &regression;
    let prior = innovation.prior.precisions(columns);
    let trace = run_recursion((columns, target, starts), innovation.length, &prior, &Stop::default())?;
    let steps = (0..target.len()).map(|step| &trace[step * columns.len()..][..columns.len()]);
    let zeros = vec![0.0; columns.len()];
    let last = regression.estimate(steps.clone().next_back().unwrap_or(&zeros), &[])?;
    let coefficients = |step: &[f64]| Ok(regression.estimate(step, &[])?.coefficients);
    Ok((last, steps.map(coefficients).collect::<Result<_>>()?))
}

fn regression_in_basis(
    records: &[Record],
    structure: &Structure,
    fixed: &[Option<f64>],
    initial: &Initial,
    innovation: &Innovation,
) -> Result<Regression> {
    innovation.check()?;
    let mut regression = Regression::new(records, structure, fixed, initial)?;
    if innovation.row_basis == RowBasis::Haar {
        for series in regression.columns.iter_mut().chain(std::iter::once(&mut regression.target)) {
            for pair in regression.starts.windows(2) {
                operational_matrices::haar_transform(&mut series[pair[0]..pair[1]])?;
            }
        }
    }
    Ok(regression)
}

//! Multi-innovation least squares (paper (42)–(44)): the recursion as published, and its exact closed form.
//!
//! One step of (44) with the p newest rows is a block step of recursive least squares. After all rows the recursion has
//! minimized Σ w_i (m_i − q_iᵀX)² + (X − X₀)ᵀK₀⁻¹(X − X₀) with w_i = min(p, M − i + 1), because a row is used in every
//! step in which it is one of the p newest. Apart from the last rows, the innovation length p therefore only weights
//! the data relative to the prior.

use crate::equation::{Initial, Structure};
use crate::error::{check_finite, check_length, Error, Result};
use crate::estimation::least_squares::{self, Estimate, Regression};
use crate::fractional::operational_matrices;
use crate::linalg::small::{Recursion, SlidingGram};
use crate::parallel::Stop;
use crate::regressors::Record;

/// Row basis of the recursion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RowBasis {
    /// Haar coefficients, coarse to fine, as in the paper; m a power of two.
    Haar,
    /// Pulse means in the sequence of time.
    Time,
}

/// Prior covariance K₀ of the coefficients, a diagonal matrix.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Prior {
    /// Covariance of every coefficient.
    Absolute(f64),
    /// Prior covariance of a coefficient times the sum of squares of its column. It does not depend on units.
    Relative(f64),
}

impl Prior {
    /// Prior that changes coefficients only where the data hardly determine them.
    pub const WEAK: Self = Self::Relative(1e10);

    /// Return the inverse prior covariance of the coefficient of a column whose sum of squares is given.
    #[must_use]
    pub fn precision(self, squares: f64) -> f64 {
        match self {
            Self::Absolute(covariance) => 1.0 / covariance,
            Self::Relative(covariance) => squares / covariance,
        }
    }

    /// Return the inverse prior covariance of each column's coefficient.
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

/// Settings of the recursion (44) of the paper.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation {
    /// Innovation length p ≥ 1.
    pub length: usize,
    /// Initial covariance K₀ > 0.
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

    /// Weight of row i of m (from 0): the number of steps that use it.
    #[must_use]
    pub fn weight(&self, i: usize, m: usize) -> usize {
        self.length.min(m - i)
    }
}

/// Final estimate of the recursion in closed form, by QR of the weighted rows stacked on the prior.
///
/// # Errors
/// Settings out of range, m not a power of two with the Haar basis, [`Error::Length`].
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::equation::{Initial, Structure, Term};
/// use ftlm::estimation::multi_innovation::{closed_form, recursion, Innovation, Prior, RowBasis};
/// use ftlm::regressors::Record;
/// let input: Vec<f64> = (0..64).map(|k| f64::from(k % 7)).collect();
/// let driven = Record::new(0.1, PulseMeans::from_signals(vec![vec![0.0; 64], input.clone()]), None)?;
/// let output = driven.integral(1, 0.5).iter().map(|v| 3.0 * v).collect();
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
    let (solution, dropped) =
        weighted_solution((columns, target, starts), innovation.length, &prior, regression.free_count())?;
    regression.estimate(&solution, &dropped)
}

/// Least-squares solution of the weighted rows and of prior rows with the inverse covariances `prior`; also the
/// linearly dependent columns. The first `needed` columns must be independent.
fn weighted_solution(
    (columns, target, starts): (&[impl AsRef<[f64]>], &[f64], &[usize]),
    length: usize,
    prior: &[f64],
    needed: usize,
) -> Result<(Vec<f64>, Vec<usize>)> {
    let columns = columns.iter().map(|column| column.as_ref().to_vec()).collect();
    let (columns, target) = weighted_rows(columns, target.to_vec(), starts, length, prior);
    // With a prior no column but a zero one under a relative prior is linearly dependent in exact arithmetic.
    let (solution, dropped) = least_squares::solve(&columns, &target, 0)?;
    match dropped.iter().find(|&&column| column < needed) {
        Some(&index) => Err(Error::Singular { index, count: columns.len() }),
        None => Ok((solution, dropped)),
    }
}

/// Rows times the square roots of their weights, with the rows of the prior below them.
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

/// Multi-innovation estimate of X in m = Q X in closed form, (44) of the paper. It starts from X₀ = 0 with a prior
/// covariance of each coefficient.
///
/// `columns` are those of Q. O(M k²).
///
/// # Errors
/// An innovation length of 0, a prior covariance that is not positive and finite, values that are not finite,
/// [`Error::Length`].
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

/// Coefficients after every step of the paper's recursion (44) on m = Q X. The last ones equal [`estimate`]. O(M k³).
///
/// # Errors
/// As [`estimate`], and [`Error::Diverged`] if rounding makes the covariance indefinite.
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

/// Coefficients after every step of the recursion through records whose first rows are `starts`.
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
        for (newest, &measured) in target.iter().enumerate().take(pair[1]).skip(pair[0]) {
            stop.check()?;
            row.iter_mut().zip(columns).for_each(|(value, column)| *value = column.as_ref()[newest]);
            window.push(&row, measured)?;
            state
                .step(&window)
                .map_err(|_| Error::Diverged { what: "covariance of the recursion".into(), index: newest })?;
            trace.extend_from_slice(state.coefficients());
        }
    }
    Ok(trace)
}

/// Check a problem; return the inverse prior covariances.
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

/// Run the paper's recursion (44) from X₀ = 0. Return the last estimate and the coefficients after every step.
///
/// The steps run through the records in sequence. An innovation never spans two records. O(k³) per step.
///
/// # Errors
/// As [`closed_form`], and [`Error::Diverged`] if rounding makes the covariance indefinite.
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

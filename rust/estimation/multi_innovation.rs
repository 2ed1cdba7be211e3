//! Multi-innovation least squares (paper (42)–(44)): the recursion as published, and its exact closed form.
//!
//! One step of (44) with the p newest rows is a block step of recursive least squares, so after all rows the recursion
//! has minimised Σ w_i (m_i − q_iᵀX)² + (X − X₀)ᵀK₀⁻¹(X − X₀) with w_i = min(p, M − i + 1), each row having been used
//! by every step of which it was one of the p newest. The innovation length p is therefore a weight of the data
//! against the prior, nothing else.

use crate::equation::{Initial, Structure};
use crate::error::{Error, Result};
use crate::estimation::least_squares::{self, Estimate, Regression};
use crate::fractional::operational_matrices;
use crate::linalg::small::Recursion;
use crate::regressors::Record;

/// In which coordinates the rows come, one after the other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rows {
    /// Haar coefficients, coarse to fine, as the paper has it; m a power of two.
    Haar,
    /// Pulse means in the order of time.
    Time,
}

/// The settings of (44).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation {
    /// Innovation length p ≥ 1.
    pub length: usize,
    /// Initial covariance K₀ (times the unit matrix) > 0.
    pub prior_covariance: f64,
    /// Coordinates of the rows.
    pub rows: Rows,
}

impl Innovation {
    /// Refuses p = 0 and a prior covariance that is not positive.
    ///
    /// # Errors
    /// [`Error::OutOfRange`].
    pub fn check(&self) -> Result<()> {
        if self.length == 0 {
            return Err(Error::OutOfRange {
                name: "innovation length p".into(),
                value: 0.0,
                range: "[1, ∞)".into(),
                remedy: "use p = 1 for ordinary recursive least squares".into(),
            });
        }
        if !(self.prior_covariance > 0.0 && self.prior_covariance.is_finite()) {
            return Err(Error::OutOfRange {
                name: "prior covariance K0".into(),
                value: self.prior_covariance,
                range: "(0, ∞)".into(),
                remedy: "use a large number for a weak prior".into(),
            });
        }
        Ok(())
    }

    /// Weight of row i of m (from 0): how many steps use it.
    #[must_use]
    pub fn weight(&self, i: usize, m: usize) -> usize {
        self.length.min(m - i)
    }
}

/// Closed form of the recursion's end, by QR of the weighted rows over the prior's.
///
/// # Errors
/// Settings out of range, m not a power of two where Haar rows are asked for, [`Error::Length`].
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::equation::{Initial, Structure, Term};
/// use ftlm::estimation::multi_innovation::{closed_form, recursion, Innovation, Rows};
/// use ftlm::regressors::Record;
/// let input: Vec<f64> = (0..64).map(|k| f64::from(k % 7)).collect();
/// let driven = Record::new(0.1, vec![vec![0.0; 64], input.clone()], None)?;
/// let output = driven.integral(1, 0.5).iter().map(|v| 3.0 * v).collect();
/// let run = [Record::new(0.1, vec![output, input], None)?];
/// let structure = Structure { output: 0, order: 0.5, terms: vec![Term { signal: 1, order: 0.0 }] };
/// let innovation = Innovation { length: 4, prior_covariance: 1e6, rows: Rows::Time };
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
    let regression = rows(records, structure, fixed, initial, innovation)?;
    let mut columns = regression.columns.clone();
    let mut target = regression.target.clone();
    for series in columns.iter_mut().chain(std::iter::once(&mut target)) {
        for pair in regression.starts.windows(2) {
            let m = pair[1] - pair[0];
            for (i, value) in series[pair[0]..pair[1]].iter_mut().enumerate() {
                #[allow(clippy::cast_precision_loss)]
                let weight = innovation.weight(i, m) as f64;
                *value *= weight.sqrt();
            }
        }
    }
    let (k, end) = (columns.len(), target.len());
    let prior = 1.0 / innovation.prior_covariance.sqrt();
    for (j, column) in columns.iter_mut().enumerate() {
        column.resize(end + k, 0.0);
        column[end + j] = prior;
    }
    target.resize(end + k, 0.0);
    // With a prior no column is dependent in exact arithmetic, so none is needed to be.
    let (solution, dropped) = least_squares::solve(&columns, &target, 0)?;
    if let Some(&index) = dropped.iter().find(|&&d| d < regression.free()) {
        return Err(Error::Singular { index, count: k });
    }
    Ok(regression.estimate(&solution, &dropped))
}

/// The recursion (44) itself, from X₀ = 0: the estimate after every step, O(k³) a step.
///
/// The steps run through the records one after the other; an innovation never spans two records.
///
/// # Errors
/// As [`closed_form`], and [`Error::Diverged`] where the covariance loses its sign to rounding.
pub fn recursion(
    records: &[Record],
    structure: &Structure,
    fixed: &[Option<f64>],
    initial: &Initial,
    innovation: &Innovation,
) -> Result<(Estimate, Vec<Vec<f64>>)> {
    let regression = rows(records, structure, fixed, initial, innovation)?;
    let k = regression.columns.len();
    let mut state = Recursion::new(&vec![0.0; k], innovation.prior_covariance)?;
    let end = regression.target.len();
    let matrix: Vec<Vec<f64>> = (0..end).map(|i| regression.columns.iter().map(|c| c[i]).collect()).collect();
    let mut trace = Vec::with_capacity(end);
    for pair in regression.starts.windows(2) {
        for newest in pair[0]..pair[1] {
            let oldest = (newest + 1).saturating_sub(innovation.length).max(pair[0]);
            let innovations = (oldest..=newest).rev().map(|i| (matrix[i].as_slice(), regression.target[i]));
            state
                .step(innovations)
                .map_err(|_| Error::Diverged { what: "covariance of the recursion".into(), index: newest })?;
            trace.push(regression.estimate(state.coefficients(), &[]).coefficients);
        }
    }
    Ok((regression.estimate(state.coefficients(), &[]), trace))
}

fn rows(
    records: &[Record],
    structure: &Structure,
    fixed: &[Option<f64>],
    initial: &Initial,
    innovation: &Innovation,
) -> Result<Regression> {
    innovation.check()?;
    let mut regression = Regression::new(records, structure, fixed, initial)?;
    if innovation.rows == Rows::Haar {
        for series in regression.columns.iter_mut().chain(std::iter::once(&mut regression.target)) {
            for pair in regression.starts.windows(2) {
                operational_matrices::transform(&mut series[pair[0]..pair[1]])?;
            }
        }
    }
    Ok(regression)
}

//! Quotients of series, and systems of series solved for one right-hand side or for many.

use std::borrow::Cow;

use super::division::Division;
use super::product::Kernel;
use crate::error::{check_length, Error, Result};
use crate::linalg::small;

/// Quotient mod z^m, m the numerator's length; exact whether or not the divisor is stable. O(m log² m).
///
/// # Errors
/// [`Error::LeadingZero`] where the divisor starts with zero, [`Error::Length`] where it is shorter than m.
pub fn divide(numerator: &[f64], divisor: &[f64]) -> Result<Vec<f64>> {
    let quotient = solve(&[vec![divisor]], &[numerator])?;
    quotient.into_iter().next().ok_or_else(|| Error::Internal { what: "a division without a quotient".into() })
}

/// 1 over a series, mod z^m; not finite where it starts with zero. O(m log² m).
///
/// ```
/// assert_eq!(ftlm::series::system::reciprocal(&[1.0, -1.0, 0.0]), [1.0, 1.0, 1.0]);
/// ```
#[must_use]
pub fn reciprocal(series: &[f64]) -> Vec<f64> {
    let mut unit = vec![0.0; series.len()];
    unit.first_mut().into_iter().for_each(|first| *first = 1.0);
    let mut division = Division::new(1, series.len());
    let inverse = [1.0 / series.first().copied().unwrap_or(f64::NAN)];
    division.run(&[vec![series]], &inverse, &[&unit]);
    division.into_quotients().pop().unwrap_or_default()
}

/// Solves the n × n system Σ_j A_ij y_j = b_i of series mod z^m, A_ij of length m at least. O(n² m log² m).
///
/// # Errors
/// [`Error::LeadingZero`] where the matrix of leading coefficients is singular, [`Error::Length`].
pub fn solve<S: AsRef<[f64]>>(matrix: &[Vec<S>], rhs: &[&[f64]]) -> Result<Vec<Vec<f64>>> {
    let n = rhs.len();
    let m = rhs.first().map_or(0, |b| b.len());
    check_length("matrix of series", n, matrix.len())?;
    for row in matrix {
        check_length("row of the matrix of series", n, row.len())?;
        for series in row {
            if series.as_ref().len() < m {
                return Err(Error::Length { name: "series".into(), expected: m, found: series.as_ref().len() });
            }
        }
    }
    for b in rhs {
        check_length("right-hand side", m, b.len())?;
    }
    // An empty series starts with nothing, which cannot be divided by either.
    let first = |s: &S| s.as_ref().first().copied().unwrap_or(0.0);
    let leading: Vec<f64> = matrix.iter().flat_map(|row| row.iter().map(first)).collect();
    let inverse = small::inverse(&leading, n)?;
    let mut division = Division::new(n, m);
    division.run(matrix, &inverse, rhs);
    Ok(division.into_quotients())
}

/// A system of series that is solved for many right-hand sides: the spectra of its matrix are made once.
pub struct Solver<'a> {
    matrix: Cow<'a, [Vec<Vec<f64>>]>,
    inverse: Vec<f64>,
    division: Division,
}

impl<'a> Solver<'a> {
    /// Takes an n × n matrix of series of m terms.
    ///
    /// # Errors
    /// [`Error::LeadingZero`] where the matrix of leading coefficients is singular, [`Error::Length`].
    pub fn new(matrix: &'a [Vec<Vec<f64>>]) -> Result<Self> {
        Self::of(Cow::Borrowed(matrix))
    }

    /// The same of a matrix that it keeps.
    ///
    /// # Errors
    /// As [`Solver::new`].
    pub fn keeping(matrix: Vec<Vec<Vec<f64>>>) -> Result<Solver<'static>> {
        Solver::of(Cow::Owned(matrix))
    }

    fn of(matrix: Cow<'a, [Vec<Vec<f64>>]>) -> Result<Self> {
        let n = matrix.len();
        let m = matrix.first().and_then(|row| row.first()).map_or(0, Vec::len);
        for row in matrix.iter() {
            check_length("row of the matrix of series", n, row.len())?;
            for series in row {
                check_length("series", m, series.len())?;
            }
        }
        let first = |s: &Vec<f64>| s.first().copied().unwrap_or(0.0);
        let leading: Vec<f64> = matrix.iter().flat_map(|row| row.iter().map(first)).collect();
        let inverse = small::inverse(&leading, n)?;
        Ok(Self { matrix, inverse, division: Division::new(n, m) })
    }

    /// Number of terms m.
    #[must_use]
    pub fn terms(&self) -> usize {
        self.division.terms()
    }

    /// Solves for one right-hand side of n series of m terms, or of fewer, as many for all.
    ///
    /// # Errors
    /// [`Error::Length`].
    pub fn solve(&mut self, rhs: &[Vec<f64>]) -> Result<Vec<Vec<f64>>> {
        check_length("right-hand sides", self.matrix.len(), rhs.len())?;
        let asked = rhs.first().map_or(0, Vec::len).min(self.division.terms());
        for b in rhs {
            check_length("right-hand side", asked, b.len())?;
        }
        let borrowed: Vec<&[f64]> = rhs.iter().map(Vec::as_slice).collect();
        self.division.restart();
        self.division.run_to(asked, &self.matrix, &self.inverse, &borrowed);
        Ok(self.division.quotients().iter().map(|quotient| quotient[..asked].to_vec()).collect())
    }

    /// Series of A⁻¹: `[j][i]` is what a unit pulse in the error of equation i does to unknown j. n solutions.
    ///
    /// # Errors
    /// As [`Solver::solve`].
    pub fn inverse(&mut self) -> Result<Vec<Vec<Vec<f64>>>> {
        let (m, n) = (self.division.terms(), self.matrix.len());
        let mut rows = vec![Vec::with_capacity(n); n];
        for i in 0..n {
            let mut unit = vec![vec![0.0; m]; n];
            unit[i].first_mut().into_iter().for_each(|first| *first = 1.0);
            for (row, answer) in rows.iter_mut().zip(self.solve(&unit)?) {
                row.push(answer);
            }
        }
        Ok(rows)
    }

    /// Spectra of A⁻¹ for products of up to `total` terms in all factors together, see [`Solver::inverse`].
    ///
    /// # Errors
    /// As [`Solver::solve`].
    pub fn inverse_spectra(&mut self, total: usize) -> Result<Vec<Vec<Kernel>>> {
        let spectra = |row: Vec<Vec<f64>>| row.iter().map(|series| Kernel::with_length(series, total)).collect();
        Ok(self.inverse()?.into_iter().map(spectra).collect())
    }
}

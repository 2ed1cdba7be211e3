//! Equation-error least squares at given orders, by QR factorization of the regressors.

use crate::equation::{Initial, Structure};
use crate::error::{check_finite, check_length, Error, Result};
use crate::linalg::dense;
use crate::linalg::small::back_substitute;
use crate::regressors::Record;

/// Norm of the component of a unit column outside the span of the previous columns, below which the column counts as
/// linearly dependent.
const RANK_TOLERANCE: f64 = 1e-12;

/// Least-squares estimate of one equation.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Estimate {
    /// Coefficients, one per term. A fixed coefficient has the given value.
    pub coefficients: Vec<f64>,
    /// Coefficients of the initial terms by record, in the sequence of `exponents`; 0 for an excluded term.
    pub initial: Vec<Vec<f64>>,
    /// Exponents of the initial terms (powers of time).
    pub exponents: Vec<f64>,
    /// Initial terms excluded as linearly dependent, as pairs of record index and exponent index.
    pub excluded_terms: Vec<(usize, usize)>,
}

/// Regression of an equation over several records, which are stacked in columns and target.
pub struct Regression {
    /// Columns of the free terms, then of the initial terms of each record.
    pub columns: Vec<Vec<f64>>,
    /// Output minus the terms with fixed coefficients.
    pub target: Vec<f64>,
    /// Index of the first row of each record, then the total number of rows.
    pub starts: Vec<usize>,
    exponents: Vec<f64>,
    fixed: Vec<Option<f64>>,
}

impl Regression {
    /// Return the regression of an equation on given records.
    ///
    /// The regressors are the signals of the terms, each integrated with order α − ν, and the powers of time of each
    /// record. α is the order of the equation, and ν that of the term.
    ///
    /// # Errors
    /// [`Error::Length`] if `fixed` does not have one entry per term or there is no record. [`Error::NotFinite`] if a
    /// fixed coefficient is not finite. [`Error::OutOfRange`] for an invalid order or exponent. [`Error::Structure`]
    /// for a signal that does not exist.
    pub fn new(records: &[Record], structure: &Structure, fixed: &[Option<f64>], initial: &Initial) -> Result<Self> {
        check_length("fixed coefficients", structure.terms.len(), fixed.len())?;
        if records.is_empty() {
            return Err(Error::Length { name: "records".into(), expected: 1, found: 0 });
        }
        let fixed_values: Vec<f64> = fixed.iter().flatten().copied().collect();
        check_finite("fixed coefficients", &fixed_values)?;
        records.iter().try_for_each(|record| structure.check(record.len(), |_| true))?;
        initial.check()?;
        let exponents = structure.initial_exponents(initial);
        let mut starts = vec![0];
        for record in records {
            starts.push(starts[starts.len() - 1] + record.m());
        }
        let rows = starts[records.len()];
        let mut target: Vec<f64> = Vec::with_capacity(rows);
        for record in records {
            target.extend_from_slice(record.signal(structure.output));
        }
        let mut columns = Vec::new();
        for (k, (term, fixed)) in structure.terms.iter().zip(fixed).enumerate() {
            let mut column = Vec::with_capacity(rows);
            for record in records {
                column.extend(record.integral(term.signal, structure.integration(k)));
            }
            match fixed {
                None => columns.push(column),
                Some(value) => target.iter_mut().zip(&column).for_each(|(t, c)| *t -= value * c),
            }
        }
        for (r, record) in records.iter().enumerate() {
            for &exponent in &exponents {
                let mut column = vec![0.0; rows];
                column[starts[r]..starts[r + 1]].copy_from_slice(&record.initial_term(exponent));
                columns.push(column);
            }
        }
        Ok(Self { columns, target, starts, exponents, fixed: fixed.to_vec() })
    }

    /// Number of free coefficients of the terms.
    #[must_use]
    pub fn free_count(&self) -> usize {
        self.fixed.iter().filter(|f| f.is_none()).count()
    }

    /// Convert a solution (free coefficients, then coefficients of the initial terms by record) to an [`Estimate`].
    ///
    /// `excluded_columns` contains the indices of excluded columns.
    ///
    /// # Errors
    /// [`Error::Length`] for a solution of another length. [`Error::Structure`] if an excluded column is not an initial
    /// term.
    pub fn estimate(&self, solution: &[f64], excluded_columns: &[usize]) -> Result<Estimate> {
        let first = self.free_count();
        let count = first + (self.starts.len() - 1) * self.exponents.len();
        check_length("solution", count, solution.len())?;
        if let Some(index) = excluded_columns.iter().find(|index| !(first..count).contains(index)) {
            let what = format!("column {index} is not an initial term; these are columns {first} to {count}");
            return Err(Error::Structure { what, remedy: "omit initial terms only".into() });
        }
        let mut free = solution.iter();
        let coefficients = self.fixed.iter().map(|f| f.or_else(|| free.next().copied()).unwrap_or(0.0)).collect();
        let width = self.exponents.len();
        let initial_coefficients: Vec<f64> = free.copied().collect();
        let initial =
            (0..self.starts.len() - 1).map(|r| initial_coefficients[r * width..(r + 1) * width].to_vec()).collect();
        let excluded_terms =
            excluded_columns.iter().map(|&index| ((index - first) / width, (index - first) % width)).collect();
        Ok(Estimate { coefficients, initial, exponents: self.exponents.clone(), excluded_terms })
    }
}

/// Fit the coefficients of an equation to one or several records, each with its own initial terms.
///
/// `fixed` has one entry per term: the value of a fixed coefficient, None for a free one. The cost is O(k² Σm) for k
/// columns and records of m pulses.
///
/// # Errors
/// [`Error::Singular`] with the index of the first linearly dependent free term. [`Error::Length`] if `fixed` does not
/// have one entry per term or there is no record. [`Error::NotFinite`] if a fixed coefficient is not finite.
/// [`Error::OutOfRange`] for an invalid order or exponent. [`Error::Structure`] for a signal that does not exist.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::equation::{Initial, Structure, Term};
/// use ftlm::estimation::least_squares;
/// use ftlm::regressors::Record;
/// let input: Vec<f64> = (0..64).map(|k| f64::from(k % 7)).collect();
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![vec![0.0; 64], input.clone()]), None)?;
/// // y = 3 I^0.5 u.
/// let output = record.integral(1, 0.5).iter().map(|v| 3.0 * v).collect();
/// let run = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
/// let structure = Structure { output: 0, order: 0.5, terms: vec![Term { signal: 1, order: 0.0 }] };
/// let found = least_squares::fit(&[run], &structure, &[None], &Initial::Rest)?;
/// assert!((found.coefficients[0] - 3.0).abs() < 1e-12);
/// # Ok(())
/// # }
/// ```
pub fn fit(records: &[Record], structure: &Structure, fixed: &[Option<f64>], initial: &Initial) -> Result<Estimate> {
    let regression = Regression::new(records, structure, fixed, initial)?;
    let (solution, excluded_columns) = solve(&regression.columns, &regression.target, regression.free_count())?;
    regression.estimate(&solution, &excluded_columns)
}

/// Minimize ‖target − Σ x_k column_k‖ over the coefficients x_k by QR factorization.
///
/// The first `required` columns must be linearly independent. Later dependent columns are excluded, with coefficient 0.
/// Return the coefficients and the indices of the excluded columns.
///
/// # Errors
/// [`Error::Singular`] with the index of the first dependent column among the needed ones. [`Error::Length`] if a
/// column has another length than the target.
pub fn solve(columns: &[Vec<f64>], target: &[f64], required: usize) -> Result<(Vec<f64>, Vec<usize>)> {
    let k = columns.len();
    columns.iter().try_for_each(|column| check_length("column", target.len(), column.len()))?;
    if k == 0 {
        return Ok((Vec::new(), Vec::new()));
    }
    let scales: Vec<f64> = columns.iter().map(|c| norm(c)).collect();
    let mut independent: Vec<usize> = (0..k).collect();
    if let Some(&index) = independent.iter().find(|&&i| i < required && !(scales[i] > 0.0 && scales[i].is_finite())) {
        return Err(Error::Singular { index, count: k });
    }
    independent.retain(|&i| scales[i] > 0.0 && scales[i].is_finite());
    let target_scale = norm(target).max(f64::MIN_POSITIVE);
    loop {
        let stride = independent.len() + 1;
        let r = dense::triangular_factor_by_blocks((stride, target.len()), |position, rows, out| {
            let (column, scale) = match independent.get(position) {
                Some(&i) => (columns[i].as_slice(), scales[i]),
                None => (target, target_scale),
            };
            out.extend(column[rows].iter().map(|v| v / scale));
        });
        let dependent = (0..independent.len()).find(|&i| r[i * stride + i].abs() <= RANK_TOLERANCE);
        if let Some(position) = dependent {
            if independent[position] < required {
                return Err(Error::Singular { index: independent[position], count: k });
            }
            independent.remove(position);
            continue;
        }
        let rhs: Vec<f64> = (0..independent.len()).map(|i| r[i * stride + independent.len()]).collect();
        let solution = back_substitute(&r, stride, &rhs);
        let mut x = vec![0.0; k];
        for (&i, value) in independent.iter().zip(solution) {
            x[i] = value * target_scale / scales[i];
        }
        let excluded_columns = (0..k).filter(|i| !independent.contains(i)).collect();
        return Ok((x, excluded_columns));
    }
}

fn norm(column: &[f64]) -> f64 {
    // Scaling by the largest element avoids overflow and underflow of the squares.
    let largest = column.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
    if largest == 0.0 || !largest.is_finite() {
        return largest;
    }
    largest * column.iter().map(|v| (v / largest) * (v / largest)).sum::<f64>().sqrt()
}

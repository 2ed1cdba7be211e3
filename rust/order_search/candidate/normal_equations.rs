//! Coefficients of candidates from precomputed normal equations, for several candidates in parallel SIMD lanes.
//!
//! The squared equation error follows from the Gram matrix of columns and measured output alone.

use crate::error::Result;
use crate::estimation::multi_innovation::{Innovation, RowBasis};
use crate::fractional::operational_matrices;
use crate::linalg::dense;
use crate::linalg::small::{packed_index, solve_lanes, PIVOT_FLOOR};
use crate::order_search::candidate::columns::Columns;
use crate::parallel::Stop;
use crate::regressors::Bank;
use crate::simd::Lanes;

/// Normal equations of the columns of a bank, weighted by the estimator and scaled to a unit diagonal.
pub(crate) struct Normal {
    width: usize,
    /// Correlation matrix of the columns, row-major width × width. Rows of zero columns are 0.
    correlation: Vec<f64>,
    /// Products of the columns, scaled to unit norm, with the measured output.
    rhs: Vec<f64>,
    /// Norm of each regressor column: square root of the sum of its squared norm and the inverse prior covariance.
    size: Vec<f64>,
    /// Inverse norm of each column, 0 for a zero column.
    inverse: Vec<f64>,
}

impl Normal {
    /// Build the equations from a Gram matrix over columns and measured output, (width + 1)² row-major. `prior` is the
    /// inverse prior covariance of each coefficient, which is added to the diagonal.
    pub(super) fn new(gram: &[f64], width: usize, prior: &[f64]) -> Self {
        let stride = width + 1;
        let diagonal = |p: usize| gram[p * stride + p] + prior[p];
        let size: Vec<f64> = (0..width)
            .map(|p| if diagonal(p) > 0.0 && diagonal(p).is_finite() { diagonal(p).sqrt() } else { 0.0 })
            .collect();
        let inverse: Vec<f64> = size.iter().map(|&s| if s > 0.0 { 1.0 / s } else { 0.0 }).collect();
        let mut correlation = vec![0.0; width * width];
        for p in 0..width {
            for q in (0..width).filter(|&q| inverse[p] > 0.0 && inverse[q] > 0.0) {
                correlation[p * width + q] = if p == q { 1.0 } else { gram[p * stride + q] * inverse[p] * inverse[q] };
            }
        }
        let rhs = (0..width).map(|p| gram[p * stride + width] * inverse[p]).collect();
        Self { width, correlation, rhs, size, inverse }
    }

    /// Return the correlation of two regressor columns.
    #[inline(always)]
    pub(crate) fn product(&self, a: usize, b: usize) -> f64 {
        self.correlation[a * self.width + b]
    }

    /// Return the correlations of one regressor column with all regressor columns.
    #[inline(always)]
    pub(crate) fn products(&self, a: usize) -> &[f64] {
        &self.correlation[a * self.width..(a + 1) * self.width]
    }

    /// Return the products of the columns, scaled to unit norm, with the measured output.
    pub(crate) fn rhs(&self) -> &[f64] {
        &self.rhs
    }

    /// Return the inverse norm of each column, 0 for a zero column.
    pub(crate) fn inverse(&self) -> &[f64] {
        &self.inverse
    }
}

/// Workspace for solving the normal equations of L candidates in parallel SIMD lanes.
pub(crate) struct Solve<const L: usize> {
    /// Lower triangle of the correlation matrix, row-major.
    gram: Vec<Lanes<L>>,
    /// Right-hand side, replaced by the solution for unit-norm columns.
    rhs: Vec<Lanes<L>>,
    /// Coefficients of the terms of the L candidates.
    pub(crate) coefficients: Vec<Lanes<L>>,
    /// Coefficients of the initial terms of the L candidates, record by record.
    pub(crate) initial: Vec<Lanes<L>>,
}

impl<const L: usize> Solve<L> {
    pub(crate) fn new() -> Self {
        Self { gram: Vec::new(), rhs: Vec::new(), coefficients: Vec::new(), initial: Vec::new() }
    }
}

/// Normal equations that all candidates share. The equations for the coefficients of the terms are summed over all
/// records. Each record has separate equations for its initial terms.
pub(crate) struct NormalEquations {
    /// Equations for the coefficients of the terms, summed over all records.
    terms: Normal,
    /// Equations of each record for its initial terms. Empty for zero initial conditions.
    record_equations: Vec<Normal>,
    /// The fixed coefficients by term, `None` for a free coefficient.
    fixed: Vec<Option<f64>>,
    /// Indices of the terms with a free coefficient.
    free: Vec<usize>,
}

impl NormalEquations {
    /// Combine the equations summed over all records with the equations of each record, which are needed for initial
    /// terms.
    pub(super) fn new(terms: Normal, record_equations: Vec<Normal>, fixed: &[Option<f64>]) -> Self {
        let free = (0..fixed.len()).filter(|&k| fixed[k].is_none()).collect();
        Self { terms, record_equations, fixed: fixed.to_vec(), free }
    }

    /// Return the normal equations over all records. `None` if a coefficient is fixed or there are initial terms.
    pub(crate) fn unconstrained_equations(&self) -> Option<&Normal> {
        (self.record_equations.is_empty() && self.free.len() == self.fixed.len()).then_some(&self.terms)
    }

    /// Return the fixed coefficients by term, `None` for a free coefficient.
    pub(super) fn fixed_coefficients(&self) -> &[Option<f64>] {
        &self.fixed
    }

    /// Solve the normal equations for the coefficients of L candidates, and store them in `solve`. Return true for each
    /// singular candidate.
    ///
    /// `positions` has the columns of each term for the L candidates. `initial` has the columns of the initial terms,
    /// which are the same for all candidates.
    #[inline(always)]
    pub(crate) fn solve<const L: usize>(
        &self,
        positions: &[Columns<L>],
        initial: &[usize],
        solve: &mut Solve<L>,
    ) -> [bool; L] {
        let normal = &self.terms;
        let (free, width) = (self.free.len(), normal.width);
        let k = free + initial.len() * self.record_equations.len();
        let zero = [0.0; L];
        let Solve { gram, rhs, coefficients, initial: weights } = solve;
        gram.clear();
        gram.resize(packed_index(k, 0), zero);
        rhs.clear();
        rhs.resize(k, zero);
        for (a, &ta) in self.free.iter().enumerate() {
            let rows = &positions[ta];
            for (b, &tb) in self.free[..=a].iter().enumerate() {
                gram[packed_index(a, b)] = rows.gather_pairs(&positions[tb], &normal.correlation, width);
            }
            rhs[a] = rows.gather(&normal.rhs);
            for (columns, fixed) in positions.iter().zip(&self.fixed) {
                if let Some(value) = *fixed {
                    let (size, correlation) =
                        (columns.gather(&normal.size), rows.gather_pairs(columns, &normal.correlation, width));
                    (0..L).for_each(|n| rhs[a][n] -= value * size[n] * correlation[n]);
                }
            }
        }
        for (r, part) in self.record_equations.iter().enumerate() {
            for (i, &e) in initial.iter().enumerate() {
                let a = free + r * initial.len() + i;
                let row = &part.correlation[e * width..(e + 1) * width];
                for (b, &tb) in self.free.iter().enumerate() {
                    // Product with the column of a term on this record, relative to the norm of the column over all
                    // records.
                    let columns = &positions[tb];
                    let (c, size, all) =
                        (columns.gather(row), columns.gather(&part.size), columns.gather(&normal.inverse));
                    gram[packed_index(a, b)] = std::array::from_fn(|n| c[n] * size[n] * all[n]);
                }
                for (j, &f) in initial[..=i].iter().enumerate() {
                    gram[packed_index(a, free + r * initial.len() + j)] = [row[f]; L];
                }
                rhs[a] = [part.rhs[e]; L];
                for (columns, fixed) in positions.iter().zip(&self.fixed) {
                    if let Some(value) = *fixed {
                        let (size, correlation) = (columns.gather(&part.size), columns.gather(row));
                        (0..L).for_each(|n| rhs[a][n] -= value * size[n] * correlation[n]);
                    }
                }
            }
        }
        let singular = solve_lanes(gram, rhs, free);
        coefficients.clear();
        let mut next = 0;
        for (columns, fixed) in positions.iter().zip(&self.fixed) {
            coefficients.push(match *fixed {
                Some(value) => [value; L],
                None => {
                    let scale = columns.gather(&normal.inverse);
                    let x = rhs[next];
                    next += 1;
                    let mut out = [0.0; L];
                    for n in 0..L {
                        out[n] = x[n] * scale[n];
                    }
                    out
                }
            });
        }
        weights.clear();
        for (r, part) in self.record_equations.iter().enumerate() {
            for (i, &e) in initial.iter().enumerate() {
                let x = rhs[free + r * initial.len() + i];
                weights.push(std::array::from_fn(|n| x[n] * part.inverse[e]));
            }
        }
        singular
    }
}

/// Return the Gram matrix of the columns of a bank and the measured output, (columns + 1)² row-major. The result is
/// invalid after a stop request.
pub(super) fn plain_gram(bank: &Bank, target: &[f64], stop: &Stop) -> Vec<f64> {
    dense::gram(bank.columns(), target, stop)
}

/// Apply multi-innovation weights to the Gram matrix of columns and measured output. Row j of m rows has the weight
/// min(p, m − j), with the innovation length p and j from 0. Rows are samples or Haar coordinates.
#[allow(clippy::cast_precision_loss)]
pub(super) fn apply_innovation_weights(
    gram: &mut [f64],
    bank: &Bank,
    target: &[f64],
    innovation: Innovation,
) -> Result<()> {
    let width = bank.len() + 1;
    // The Haar transform is orthogonal, so the unweighted Gram matrix is the same in Haar coordinates.
    let m = target.len();
    let tail = innovation.length.min(m) - 1;
    gram.iter_mut().for_each(|g| *g *= innovation.length.min(m) as f64);
    let mut rows = vec![vec![0.0; width]; tail];
    for j in 0..width {
        let mut values = if j < bank.len() { bank.column(j) } else { target }.to_vec();
        if innovation.row_basis == RowBasis::Haar {
            operational_matrices::haar_transform(&mut values)?;
        }
        for (t, row) in rows.iter_mut().enumerate() {
            row[j] = values[m - 1 - t];
        }
    }
    for (t, row) in rows.iter().enumerate() {
        // Row m−1−t is used by t+1 steps instead of p.
        let excess = (innovation.length.min(m) - 1 - t) as f64;
        for (i, &x) in row.iter().enumerate() {
            for (j, &y) in row.iter().enumerate() {
                gram[i * width + j] -= excess * x * y;
            }
        }
    }
    Ok(())
}

/// Gram matrix of columns and measured output summed over records, for the residual sum of squares of any candidate.
pub(crate) struct ResidualSumOfSquares {
    /// Number of columns plus one for the measured output.
    stride: usize,
    /// Gram matrix, row-major. The measured output comes last.
    gram: Vec<f64>,
    /// Diagonal of the Gram matrix: squared norms of the columns and the measured output.
    diagonal: Vec<f64>,
    /// Norms of the columns and the measured output: square roots of the diagonal.
    norms: Vec<f64>,
    /// Factor of the rounding-error bound of a residual sum of squares. It multiplies (‖y‖ + Σ|c|‖x‖)² for the measured
    /// output y and terms with coefficient c and column x.
    unit: f64,
    /// Factor of the rounding-error bound of the minimum of the residual sum of squares over all coefficients. It
    /// multiplies (‖y‖ + Σ|c|‖x‖)² for the measured output y and terms with coefficient c and column x.
    slack: f64,
    /// Minimum eigenvalue of a correlation matrix for which lower bounds are valid.
    min_eigenvalue: f64,
}

impl ResidualSumOfSquares {
    /// Build from a Gram matrix over `width` columns and the measured output, row-major. `samples` is the number of
    /// summands of each element, `terms` the number of terms of a candidate. `weights` is the largest weight of a row
    /// in the normal equations.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn new(gram: Vec<f64>, width: usize, samples: usize, terms: usize, weights: usize) -> Self {
        let slack = 4.0 * f64::EPSILON * (samples + 8 * terms + 16) as f64;
        Self {
            stride: width + 1,
            diagonal: (0..=width).map(|p| gram[p * (width + 2)]).collect(),
            norms: (0..=width).map(|p| gram[p * (width + 2)].max(0.0).sqrt()).collect(),
            gram,
            unit: 4.0 * f64::EPSILON * samples as f64,
            slack,
            // The normal equations of a candidate with this smallest eigenvalue are regular, also with row weights.
            min_eigenvalue: (2.0 * terms as f64 * slack).max(16.0 * weights as f64 * PIVOT_FLOOR),
        }
    }

    /// Return the index of the measured output in the Gram matrix.
    #[inline(always)]
    pub(super) fn target(&self) -> usize {
        self.stride - 1
    }

    /// Return the inner products of a column with all columns and the measured output.
    #[inline(always)]
    pub(super) fn row(&self, column: usize) -> &[f64] {
        &self.gram[column * self.stride..(column + 1) * self.stride]
    }

    /// Return the inner product of two regressor columns.
    #[inline(always)]
    pub(super) fn product(&self, a: usize, b: usize) -> f64 {
        self.gram[a * self.stride + b]
    }

    /// Return the squared norms of all columns and the measured output.
    #[inline(always)]
    pub(super) fn diagonal(&self) -> &[f64] {
        &self.diagonal
    }

    /// Return the norms of all columns and the measured output.
    #[inline(always)]
    pub(super) fn norms(&self) -> &[f64] {
        &self.norms
    }

    /// Return the factor of the rounding-error bound of the minimum of a residual sum of squares over all coefficients.
    /// It multiplies (‖y‖ + Σ|c|‖x‖)² for the measured output y and terms with coefficient c and column x.
    #[inline(always)]
    pub(super) fn slack(&self) -> f64 {
        self.slack
    }

    /// Return the minimum eigenvalue of a correlation matrix for which lower bounds are valid.
    #[inline(always)]
    pub(super) fn min_eigenvalue(&self) -> f64 {
        self.min_eigenvalue
    }

    /// Return two values of the sum of squared equation errors for each of L candidates: a lower bound that includes
    /// rounding errors, and the computed value.
    #[inline(always)]
    pub(crate) fn error<const L: usize>(
        &self,
        positions: &[Columns<L>],
        coefficients: &[Lanes<L>],
    ) -> (Lanes<L>, Lanes<L>) {
        let (stride, target) = (self.stride, self.stride - 1);
        let mut sum = [self.gram[target * stride + target]; L];
        let mut size = [self.norms[target]; L];
        for (i, (rows, c)) in positions.iter().zip(coefficients).enumerate() {
            let norms = rows.gather(&self.norms);
            // c·(c·G_ii + 2 Σ_{j<i} c_j G_ij − 2 b_i)
            let mut inner = rows.gather(&self.gram[target * stride..]);
            for (columns, d) in positions[..i].iter().zip(coefficients) {
                let g = rows.gather_pairs(columns, &self.gram, stride);
                (0..L).for_each(|n| inner[n] -= d[n] * g[n]);
            }
            let diagonal = rows.gather(&self.diagonal);
            for n in 0..L {
                sum[n] += c[n] * (c[n] * diagonal[n] - 2.0 * inner[n]);
                size[n] += c[n].abs() * norms[n];
            }
        }
        let mut min_error = [0.0; L];
        for n in 0..L {
            min_error[n] = sum[n] - self.unit * size[n] * size[n];
        }
        (min_error, sum)
    }
}

//! Coefficients of candidates from precomputed normal equations, several candidates in parallel lanes.
//!
//! The squared equation error follows from the Gram matrix alone.

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
    /// Correlation matrix, row-major width × width; rows of zero columns are 0.
    correlation: Vec<f64>,
    rhs: Vec<f64>,
    /// Norm of each column.
    size: Vec<f64>,
    inverse: Vec<f64>,
}

impl Normal {
    /// Build the equations from a Gram matrix over columns and target, (width + 1)² row-major. `prior` has the inverse
    /// prior covariances, which are added to its diagonal.
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

    /// Correlation of two columns.
    #[inline(always)]
    pub(crate) fn product(&self, a: usize, b: usize) -> f64 {
        self.correlation[a * self.width + b]
    }

    /// Correlations of one column with all.
    #[inline(always)]
    pub(crate) fn products(&self, a: usize) -> &[f64] {
        &self.correlation[a * self.width..(a + 1) * self.width]
    }

    /// Products of the unit columns with the target.
    pub(crate) fn rhs(&self) -> &[f64] {
        &self.rhs
    }

    /// Inverse norm of each column, 0 for a zero column.
    pub(crate) fn inverse(&self) -> &[f64] {
        &self.inverse
    }
}

/// Workspace for solving L candidates in parallel lanes.
pub(crate) struct Solve<const L: usize> {
    gram: Vec<Lanes<L>>,
    /// Right-hand side; after the solve, the scaled solution.
    rhs: Vec<Lanes<L>>,
    pub(crate) coefficients: Vec<Lanes<L>>,
    /// Coefficients of the initial terms, record by record.
    pub(crate) initial: Vec<Lanes<L>>,
}

impl<const L: usize> Solve<L> {
    pub(crate) fn new() -> Self {
        Self { gram: Vec::new(), rhs: Vec::new(), coefficients: Vec::new(), initial: Vec::new() }
    }
}

/// Normal equations that all candidates share. The equations for the coefficients of the terms are summed over all
/// records. Each record has its own equations for its initial terms.
pub(crate) struct NormalEquations {
    terms: Normal,
    /// Equations of each record for its initial terms. Empty for zero initial conditions.
    record_equations: Vec<Normal>,
    /// Coefficients by term, `None` for a free coefficient.
    fixed: Vec<Option<f64>>,
    free: Vec<usize>,
}

impl NormalEquations {
    /// Combine the equations summed over all records with the equations of each record, which are needed for initial
    /// terms.
    pub(super) fn new(terms: Normal, record_equations: Vec<Normal>, fixed: &[Option<f64>]) -> Self {
        let free = (0..fixed.len()).filter(|&k| fixed[k].is_none()).collect();
        Self { terms, record_equations, fixed: fixed.to_vec(), free }
    }

    /// Normal equations over all records; None if a coefficient is fixed or there are initial terms.
    pub(crate) fn unconstrained_equations(&self) -> Option<&Normal> {
        (self.record_equations.is_empty() && self.free.len() == self.fixed.len()).then_some(&self.terms)
    }

    /// Values of the fixed coefficients by term, `None` for a free coefficient.
    pub(super) fn fixed_coefficients(&self) -> &[Option<f64>] {
        &self.fixed
    }

    /// Solve for the coefficients of L candidates. Return a flag for each singular one.
    ///
    /// `positions` holds the column of each term per candidate. The initial terms are common to all.
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
                gram[packed_index(a, b)] = rows.with(&positions[tb], &normal.correlation, width);
            }
            rhs[a] = rows.of(&normal.rhs);
            for (columns, fixed) in positions.iter().zip(&self.fixed) {
                if let Some(value) = *fixed {
                    let (size, correlation) =
                        (columns.of(&normal.size), rows.with(columns, &normal.correlation, width));
                    (0..L).for_each(|n| rhs[a][n] -= value * size[n] * correlation[n]);
                }
            }
        }
        for (r, part) in self.record_equations.iter().enumerate() {
            for (i, &e) in initial.iter().enumerate() {
                let a = free + r * initial.len() + i;
                let row = &part.correlation[e * width..(e + 1) * width];
                for (b, &tb) in self.free.iter().enumerate() {
                    // Contribution of this record to a term's column, relative to the column's norm over all records.
                    let columns = &positions[tb];
                    let (c, size, all) = (columns.of(row), columns.of(&part.size), columns.of(&normal.inverse));
                    gram[packed_index(a, b)] = std::array::from_fn(|n| c[n] * size[n] * all[n]);
                }
                for (j, &f) in initial[..=i].iter().enumerate() {
                    gram[packed_index(a, free + r * initial.len() + j)] = [row[f]; L];
                }
                rhs[a] = [part.rhs[e]; L];
                for (columns, fixed) in positions.iter().zip(&self.fixed) {
                    if let Some(value) = *fixed {
                        let (size, correlation) = (columns.of(&part.size), columns.of(row));
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
                    let scale = columns.of(&normal.inverse);
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

/// Gram matrix of a bank's columns and the target, (columns + 1)² row-major. Invalid after a stop request.
pub(super) fn plain_gram(bank: &Bank, target: &[f64], stop: &Stop) -> Vec<f64> {
    dense::gram(bank.columns(), target, stop)
}

/// Apply multi-innovation weights to a Gram matrix: row j of m rows has the weight min(p, m − j).
#[allow(clippy::cast_precision_loss)]
pub(super) fn apply_innovation_weights(
    gram: &mut [f64],
    bank: &Bank,
    target: &[f64],
    innovation: Innovation,
) -> Result<()> {
    let width = bank.len() + 1;
    // Φ is orthogonal: the unweighted Gram matrix is the same in Haar coordinates.
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

/// Gram matrix of columns and target summed over records, with the norms of the columns.
pub(crate) struct ResidualSumOfSquares {
    stride: usize,
    gram: Vec<f64>,
    /// Diagonal of the Gram matrix, and its square roots.
    diagonal: Vec<f64>,
    norms: Vec<f64>,
    /// Factor of the rounding-error bound of a residual sum of squares. The bound is this factor times (sum of the
    /// column norms)².
    unit: f64,
    /// Rounding-error bound of the minimal residual sum of squares over all coefficients.
    slack: f64,
    min_eigenvalue: f64,
}

impl ResidualSumOfSquares {
    /// Build from a Gram matrix over `width` columns and the target, row-major. `samples` is the length of its sums,
    /// `terms` the number of terms of a candidate. `weights` is the largest weight of a row in the normal equations.
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
            // Candidates with this minimum eigenvalue are regular in the weighted equations, too.
            min_eigenvalue: (2.0 * terms as f64 * slack).max(16.0 * weights as f64 * PIVOT_FLOOR),
        }
    }

    /// Position of the target.
    #[inline(always)]
    pub(super) fn target(&self) -> usize {
        self.stride - 1
    }

    /// Products of all columns and the target with one of them.
    #[inline(always)]
    pub(super) fn row(&self, column: usize) -> &[f64] {
        &self.gram[column * self.stride..(column + 1) * self.stride]
    }

    /// Inner product of two columns.
    #[inline(always)]
    pub(super) fn product(&self, a: usize, b: usize) -> f64 {
        self.gram[a * self.stride + b]
    }

    /// Squares of the norms of columns and target.
    #[inline(always)]
    pub(super) fn diagonal(&self) -> &[f64] {
        &self.diagonal
    }

    /// Norms of columns and target.
    #[inline(always)]
    pub(super) fn norms(&self) -> &[f64] {
        &self.norms
    }

    /// Rounding-error bound of a minimal residual sum of squares, divided by (sum of the column norms)².
    #[inline(always)]
    pub(super) fn slack(&self) -> f64 {
        self.slack
    }

    /// Smallest eigenvalue of a correlation matrix for which the bound holds.
    #[inline(always)]
    pub(super) fn min_eigenvalue(&self) -> f64 {
        self.min_eigenvalue
    }

    /// Lower bounds, including rounding errors, and computed values of the squared equation error of L candidates.
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
            let norms = rows.of(&self.norms);
            // c·(c·G_ii + 2 Σ_{j<i} c_j G_ij − 2 b_i)
            let mut inner = rows.of(&self.gram[target * stride..]);
            for (columns, d) in positions[..i].iter().zip(coefficients) {
                let g = rows.with(columns, &self.gram, stride);
                (0..L).for_each(|n| inner[n] -= d[n] * g[n]);
            }
            let diagonal = rows.of(&self.diagonal);
            for n in 0..L {
                sum[n] += c[n] * (c[n] * diagonal[n] - 2.0 * inner[n]);
                size[n] += c[n].abs() * norms[n];
            }
        }
        let mut least = [0.0; L];
        for n in 0..L {
            least[n] = sum[n] - self.unit * size[n] * size[n];
        }
        (least, sum)
    }
}

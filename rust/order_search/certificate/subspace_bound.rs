//! Lower bound of the squared equation error over a cell (a box of orders), for nearly dependent regressor columns.
//!
//! Such columns determine the coefficients poorly, and the bound of `cell_bound` is then too low to exclude a cell.
//! This bound is the distance of the output from a subspace. The subspace is spanned by the columns at the midpoint and
//! their first two derivatives with respect to the order of integration. Columns elsewhere in the cell deviate from the
//! subspace by third-order terms only, so the bound holds for coefficients of limited size.

use crate::order_search::certificate::regressor_expansion::{rounding_unit, EXPANSION_COLUMNS, MAX_TERMS};

/// Number of columns of the subspace per term: the value and its derivatives.
const SPANNED_DERIVATIVES: usize = 3;
/// Maximum number of basis columns of a [`DerivativeSubspace`], which are stored as rows.
const MAX_BASIS_ROWS: usize = SPANNED_DERIVATIVES * MAX_TERMS;
/// Ridge parameter times the largest admissible sum of squared coefficients, relative to the target of the bound. The
/// ridge limits the coefficients of nearly dependent columns.
const RIDGE_TARGET_FRACTION: f64 = 0.05;
/// Minimum ridge parameter of [`DerivativeSubspace::bound`].
const MIN_RIDGE: f64 = 1e-11;
/// Relative margin for the rounding error of the lower bound.
const ROUNDING_MARGIN: f64 = 1e-9;

/// Subspace spanned by the columns x, ωx′, ω²x″/2 of each term. Here ω is the half width of the cell (box of orders),
/// and derivatives are with respect to the order of integration. In this scaling the coefficients of the derivatives
/// are no larger than those of the values.
pub(super) struct DerivativeSubspace {
    /// Term, order of the derivative, and scale factor of each column of the subspace.
    rows: [((usize, usize), f64); MAX_BASIS_ROWS],
    /// Number of columns of the subspace.
    count: usize,
    /// Number of terms of the equation.
    terms: usize,
    /// Inner products of the columns of the subspace.
    matrix: [[f64; MAX_BASIS_ROWS]; MAX_BASIS_ROWS],
    /// Products of the columns of the subspace with the measured output, scaled to unit norm.
    target: [f64; MAX_BASIS_ROWS],
    /// Upper bound of the norm of the omitted Taylor terms of a unit-norm column.
    max_omitted_norm: f64,
    /// Lower bound of the norm, within the cell (box of orders), of a column that has norm 1 at the midpoint.
    min_column_norm: f64,
    /// Upper bound of the rounding error in the inner product of two unit-norm columns.
    rounding: f64,
}

impl DerivativeSubspace {
    /// Return an empty subspace for `samples` samples.
    pub(super) fn new(samples: usize) -> Self {
        Self {
            rows: [((0, 0), 0.0); MAX_BASIS_ROWS],
            count: 0,
            terms: 0,
            matrix: [[0.0; MAX_BASIS_ROWS]; MAX_BASIS_ROWS],
            target: [0.0; MAX_BASIS_ROWS],
            max_omitted_norm: 0.0,
            min_column_norm: 1.0,
            rounding: rounding_unit(samples) / 8.0,
        }
    }

    /// Add a term. `half` is the half width of its interval of orders, `sizes` holds the norms of its column and of the
    /// derivatives, and `remainder` is the remainder of its expansion.
    pub(super) fn add(&mut self, half: f64, sizes: [f64; EXPANSION_COLUMNS], remainder: f64) {
        let units = [1.0, half, half * half / 2.0, half * half * half / 6.0];
        for (derivative, unit) in units.into_iter().enumerate().take(if half > 0.0 { SPANNED_DERIVATIVES } else { 1 }) {
            self.rows[self.count] = ((self.terms, derivative), unit);
            self.count += 1;
        }
        self.terms += 1;
        let tail_norm = |first: usize| (first..EXPANSION_COLUMNS).map(|m| units[m] * sizes[m]).sum::<f64>() + remainder;
        self.max_omitted_norm = self.max_omitted_norm.max(tail_norm(SPANNED_DERIVATIVES));
        self.min_column_norm = self.min_column_norm.min(1.0 - tail_norm(1));
    }

    /// Compute the inner products of the columns. `product` and `target_product` return the products of two
    /// derivatives, and of a derivative with the measured output. A derivative is given as (term, order of the
    /// derivative).
    pub(super) fn fill(
        &mut self,
        product: impl Fn((usize, usize), (usize, usize)) -> f64,
        target_product: impl Fn((usize, usize)) -> f64,
    ) {
        for i in 0..self.count {
            let (a, scale) = self.rows[i];
            self.target[i] = scale * target_product(a);
            for j in 0..=i {
                let (b, other) = self.rows[j];
                self.matrix[i][j] = scale * other * product(a, b);
                self.matrix[j][i] = self.matrix[i][j];
            }
        }
    }

    /// Return a lower bound of the squared residual over the cell (box of orders), relative to the squared norm of the
    /// output y, 0 without a proof. It holds for all coefficients c with Σ‖c x‖ ≤ `max_coefficient`·‖y‖ over the
    /// columns x. The ridge parameter is tuned to reach the bound `target_bound`.
    pub(super) fn bound(&self, max_coefficient: f64, target_bound: f64) -> f64 {
        if self.min_column_norm.is_nan() || self.min_column_norm <= 0.5 || target_bound.is_nan() {
            return 0.0;
        }
        let (n, all) = (self.count, max_coefficient / self.min_column_norm);
        let powers = f64::from(u8::try_from(SPANNED_DERIVATIVES).unwrap_or(u8::MAX));
        let ridge_parameter = (RIDGE_TARGET_FRACTION * target_bound / (powers * all * all)).clamp(MIN_RIDGE, 1.0);
        let coefficients = self.ridge_solution(ridge_parameter);
        // The minimum of the form with the ridge is at least its value anywhere minus |gradient|²/(4·ridge). The bound
        // uses the exact form of the columns, which is positive semidefinite, not the rounded one.
        let (mut value, mut gradient, mut sum) = (1.0, 0.0, 1.0);
        for i in 0..n {
            let row: f64 =
                (0..n).map(|j| self.matrix[i][j] * coefficients[j]).sum::<f64>() + ridge_parameter * coefficients[i];
            value += coefficients[i] * (row - 2.0 * self.target[i]);
            let partial = 2.0 * (row - self.target[i]);
            gradient += partial * partial;
            sum += coefficients[i].abs();
        }
        #[allow(clippy::cast_precision_loss)]
        let (count, rounded) = (n as f64, self.rounding + 16.0 * f64::EPSILON * n as f64);
        let slope = gradient.sqrt() + 2.0 * rounded * sum * count.sqrt();
        let ridge = value - rounded * sum * sum - slope * slope / (4.0 * ridge_parameter);
        // The coefficients of the values, and those of each derivative, sum up to at most `all`.
        let square = ridge - ridge_parameter * powers * all * all;
        let root = square.max(0.0).sqrt() - all * self.max_omitted_norm;
        let lower_bound = root * root * (1.0 - ROUNDING_MARGIN);
        if root > 0.0 && lower_bound.is_finite() {
            lower_bound
        } else {
            0.0
        }
    }

    /// Return an approximate minimizer of the quadratic form with `ridge_parameter` added to its diagonal.
    fn ridge_solution(&self, ridge_parameter: f64) -> [f64; MAX_BASIS_ROWS] {
        let n = self.count;
        let mut factor = self.matrix;
        let mut x = self.target;
        factor.iter_mut().enumerate().for_each(|(i, row)| row[i] += ridge_parameter);
        for i in 0..n {
            let row = factor[i];
            let pivot = row[i].max(ridge_parameter);
            for l in i + 1..n {
                let multiplier = row[l] / pivot;
                for (a, b) in factor[l][l..n].iter_mut().zip(&row[l..n]) {
                    *a -= multiplier * b;
                }
                x[l] -= multiplier * x[i];
            }
        }
        for i in (0..n).rev() {
            let sum: f64 = (i + 1..n).map(|j| factor[i][j] * x[j]).sum();
            x[i] = (x[i] - sum) / factor[i][i].max(ridge_parameter);
        }
        x
    }
}

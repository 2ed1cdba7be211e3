//! Lower bound over a cell from the subspace spanned by its columns and their first two derivatives.
//!
//! Near orders with nearly dependent columns the coefficients are poorly determined, and a bound based on them proves
//! nothing. The distance of the output from this subspace still bounds the equation error for coefficients of limited
//! size, since the subspace omits only terms of third order from the columns.

use crate::order_search::certificate::regressor_expansion::{unit, ALL, MOST};

/// Number of spanning columns of a term: the value and its derivatives.
const SPANNED: usize = 3;
const ROWS: usize = SPANNED * MOST;
/// Ridge on the squared coefficients, relative to the goal for all of them together, and its minimum. The ridge keeps
/// nearly dependent columns harmless.
const SHARE: f64 = 0.05;
const RIDGE: f64 = 1e-11;
/// Relative margin for the rounding of the bound.
const HAIR: f64 = 1e-9;

/// Subspace spanned by the scaled columns x, ωx′, ω²x″/2. In this scaling no derivative has larger coefficients than
/// the value.
pub(super) struct Span {
    /// Term, derivative and scale of each row.
    rows: [((usize, usize), f64); ROWS],
    count: usize,
    terms: usize,
    matrix: [[f64; ROWS]; ROWS],
    target: [f64; ROWS],
    /// Largest norm omitted from a unit column, and smallest norm of a unit column within the cell.
    beyond: f64,
    least: f64,
    /// Rounding-error bound of a product of two unit columns.
    rounding: f64,
}

impl Span {
    pub(super) fn new(samples: usize) -> Self {
        Self {
            rows: [((0, 0), 0.0); ROWS],
            count: 0,
            terms: 0,
            matrix: [[0.0; ROWS]; ROWS],
            target: [0.0; ROWS],
            beyond: 0.0,
            least: 1.0,
            rounding: unit(samples) / 8.0,
        }
    }

    /// Add a term: half its width, the norms of its columns and the remainder of its expansion.
    pub(super) fn add(&mut self, half: f64, sizes: [f64; ALL], rest: f64) {
        let units = [1.0, half, half * half / 2.0, half * half * half / 6.0];
        for (derivative, unit) in units.into_iter().enumerate().take(if half > 0.0 { SPANNED } else { 1 }) {
            self.rows[self.count] = ((self.terms, derivative), unit);
            self.count += 1;
        }
        self.terms += 1;
        let off = |from: usize| (from..ALL).map(|m| units[m] * sizes[m]).sum::<f64>() + rest;
        self.beyond = self.beyond.max(off(SPANNED));
        self.least = self.least.min(1.0 - off(1));
    }

    /// Fill in the products of the columns of terms and derivatives, and those with the target.
    pub(super) fn fill(
        &mut self,
        product: impl Fn((usize, usize), (usize, usize)) -> f64,
        along: impl Fn((usize, usize)) -> f64,
    ) {
        for i in 0..self.count {
            let (a, scale) = self.rows[i];
            self.target[i] = scale * along(a);
            for j in 0..=i {
                let (b, other) = self.rows[j];
                self.matrix[i][j] = scale * other * product(a, b);
                self.matrix[j][i] = self.matrix[i][j];
            }
        }
    }

    /// Lower bound of the relative squared residual over the cell, 0 if nothing is proved. It holds for coefficients
    /// whose terms sum up to at most `largest` times the norm of the output. The ridge is tuned for `goal`.
    pub(super) fn bound(&self, largest: f64, goal: f64) -> f64 {
        if self.least.is_nan() || self.least <= 0.5 || goal.is_nan() {
            return 0.0;
        }
        let (n, all) = (self.count, largest / self.least);
        let powers = f64::from(u8::try_from(SPANNED).unwrap_or(u8::MAX));
        let added = (SHARE * goal / (powers * all * all)).clamp(RIDGE, 1.0);
        let coefficients = self.minimum(added);
        // The minimum of the form with the ridge is at least its value anywhere minus |gradient|²/(4·ridge). The bound
        // uses the exact form of the columns, which is positive semidefinite, not the rounded one.
        let (mut value, mut gradient, mut sum) = (1.0, 0.0, 1.0);
        for i in 0..n {
            let row: f64 = (0..n).map(|j| self.matrix[i][j] * coefficients[j]).sum::<f64>() + added * coefficients[i];
            value += coefficients[i] * (row - 2.0 * self.target[i]);
            let off = 2.0 * (row - self.target[i]);
            gradient += off * off;
            sum += coefficients[i].abs();
        }
        #[allow(clippy::cast_precision_loss)]
        let (count, rounded) = (n as f64, self.rounding + 16.0 * f64::EPSILON * n as f64);
        let slope = gradient.sqrt() + 2.0 * rounded * sum * count.sqrt();
        let ridge = value - rounded * sum * sum - slope * slope / (4.0 * added);
        // The coefficients of the values, and those of each derivative, sum up to at most `all`.
        let square = ridge - added * powers * all * all;
        let root = square.max(0.0).sqrt() - all * self.beyond;
        let least = root * root * (1.0 - HAIR);
        if root > 0.0 && least.is_finite() {
            least
        } else {
            0.0
        }
    }

    /// Approximate minimizer of the form with the ridge.
    fn minimum(&self, added: f64) -> [f64; ROWS] {
        let n = self.count;
        let mut factor = self.matrix;
        let mut x = self.target;
        factor.iter_mut().enumerate().for_each(|(i, row)| row[i] += added);
        for i in 0..n {
            let row = factor[i];
            let pivot = row[i].max(added);
            for l in i + 1..n {
                let share = row[l] / pivot;
                for (a, b) in factor[l][l..n].iter_mut().zip(&row[l..n]) {
                    *a -= share * b;
                }
                x[l] -= share * x[i];
            }
        }
        for i in (0..n).rev() {
            let sum: f64 = (i + 1..n).map(|j| factor[i][j] * x[j]).sum();
            x[i] = (x[i] - sum) / factor[i][i].max(added);
        }
        x
    }
}

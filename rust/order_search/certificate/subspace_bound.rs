//! A lower bound over a cell from the space that its columns and their first two derivatives span.
//!
//! Near orders whose columns depend on one another coefficients are told by next to nothing, and what follows from them
//! proves nothing. There the output's distance from that space still bounds the equation error, for coefficients whose
//! terms are not beyond all measure: what the space leaves out of the columns is of third order.

use crate::order_search::certificate::regressor_expansion::{unit, ALL, MOST};

/// The value and the derivatives that are taken into the space.
const SPANNED: usize = 3;
const ROWS: usize = SPANNED * MOST;
/// What is added to squares of coefficients, which may not be as large as they like: as a share of what is to be proved,
/// all of them taken together, and so much at least that columns that depend on one another do no harm.
const SHARE: f64 = 0.05;
const RIDGE: f64 = 1e-11;
/// A hair more, for the rounding of what is put together here.
const HAIR: f64 = 1e-9;

/// Columns in units in which their coefficients are at most those of the values: x, ωx′, ω²x″/2.
pub(super) struct Span {
    /// Term, derivative and unit of each row.
    rows: [((usize, usize), f64); ROWS],
    count: usize,
    terms: usize,
    matrix: [[f64; ROWS]; ROWS],
    target: [f64; ROWS],
    /// What is left out of a unit column at most, and the least size of one.
    beyond: f64,
    least: f64,
    /// What rounding may add to a product of two unit columns.
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

    /// The next term: half its width, the sizes of its columns and what their series leaves out.
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

    /// Takes products of the columns of terms and derivatives, and with the target.
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

    /// No orders of the cell, with coefficients whose terms have together at most `largest` times the size of the output,
    /// leave a smaller share of its square; 0 where nothing is proved. To prove this goal is what is tried.
    pub(super) fn bound(&self, largest: f64, goal: f64) -> f64 {
        if self.least.is_nan() || self.least <= 0.5 || goal.is_nan() {
            return 0.0;
        }
        let (n, all) = (self.count, largest / self.least);
        let powers = f64::from(u8::try_from(SPANNED).unwrap_or(u8::MAX));
        let added = (SHARE * goal / (powers * all * all)).clamp(RIDGE, 1.0);
        let coefficients = self.minimum(added);
        // The least of the form with the ridge is at least its value anywhere less |gradient|²/(4·ridge); so the form of the
        // columns themselves is asked, which has no negative squares, not the rounded one.
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
        // Coefficients of the values add up to `all` at most, those of each derivative too.
        let square = ridge - added * powers * all * all;
        let root = square.max(0.0).sqrt() - all * self.beyond;
        let least = root * root * (1.0 - HAIR);
        if root > 0.0 && least.is_finite() {
            least
        } else {
            0.0
        }
    }

    /// Coefficients where the form with the ridge is about least.
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

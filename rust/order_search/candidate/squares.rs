//! The squared equation error of candidates from a Gram matrix alone.

use crate::linalg::small::PIVOT_FLOOR;
use crate::order_search::candidate::columns_part::Columns;
use crate::simd::Lanes;

/// Gram matrix of columns and target summed over records, and the norms on its diagonal.
pub(crate) struct Squares {
    stride: usize,
    gram: Vec<f64>,
    /// Its diagonal, and the roots of that.
    diagonal: Vec<f64>,
    norms: Vec<f64>,
    /// What rounding may add to a squared sum, per unit of the squared sum of norms.
    unit: f64,
    /// The same where the least sum over all coefficients is asked for, and the least eigenvalue of the terms' correlation
    /// matrix from which on it holds (docs/mathematics.md, stretches of one term).
    slack: f64,
    flat: f64,
}

impl Squares {
    /// From a Gram matrix over so many columns and the target, row-major, how many samples it sums over, of how many terms
    /// a candidate is and how many times another a row may weigh in the equations that give its coefficients.
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
            // Whose columns lie this far apart is not singular in the weighted equations either.
            flat: (2.0 * terms as f64 * slack).max(16.0 * weights as f64 * PIVOT_FLOOR),
        }
    }

    /// Place of the target.
    #[inline(always)]
    pub(super) fn target(&self) -> usize {
        self.stride - 1
    }

    /// Products of all columns and the target with one of them.
    #[inline(always)]
    pub(super) fn row(&self, column: usize) -> &[f64] {
        &self.gram[column * self.stride..(column + 1) * self.stride]
    }

    /// One product.
    #[inline(always)]
    pub(super) fn product(&self, a: usize, b: usize) -> f64 {
        self.gram[a * self.stride + b]
    }

    /// Squared norms of columns and target.
    #[inline(always)]
    pub(super) fn diagonal(&self) -> &[f64] {
        &self.diagonal
    }

    /// Norms of columns and target.
    #[inline(always)]
    pub(super) fn norms(&self) -> &[f64] {
        &self.norms
    }

    /// What rounding may add to a least squared sum, per unit of the squared sum of norms.
    #[inline(always)]
    pub(super) fn slack(&self) -> f64 {
        self.slack
    }

    /// The least eigenvalue of a correlation matrix of which anything is proved.
    #[inline(always)]
    pub(super) fn flat(&self) -> f64 {
        self.flat
    }

    /// Lower bounds of the squared equation error of L candidates, rounding allowed for, and its values.
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

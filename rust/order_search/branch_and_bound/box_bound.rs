//! Lower bound of the errors of all candidates in a box of two orders.
//!
//! Here x_u and x_v are the regressor columns of the two varying orders. The vectors û and v̂ are these columns, made
//! orthogonal to the fixed-order columns and scaled to unit norm. Their coefficients p and q solve p + B q = û·y, B p +
//! q = v̂·y with B = û·v̂, so (p ± q)/2 = (û·y ± v̂·y)/(2(1 ± B)). The coefficients are computed for all candidates, so
//! their deviation from bilinear functions over a box is known exactly.
//!
//! The coordinates −1 ≤ s, t ≤ 1 describe the position in a box. Along each coordinate, every other quantity is a
//! linear interpolation between the ends plus a bounded remainder. The bound needs the product ⟨t, w⟩ of a test vector
//! t with the equation error w, and the denominator 1 − Σ c g. Here c are coefficients, and g is the projection of Fᵀt
//! on t for the kernel matrix F of an output column. All of them are bilinear in the coordinates up to remainders of
//! second order. The modulus |⟨t, w⟩| is at least its projection on one direction, which is bilinear. Subtracting a
//! multiple of moduli of bilinear functions gives a function that is concave in each coordinate. Its minimum over the
//! box is therefore at a corner.

use std::ops::Range;

use crate::order_search::branch_and_bound::axis_table::{
    vector_groups, AxisTable, RemainingColumns, VectorProducts, Wide, ZERO_LANES,
};
use crate::order_search::dual_bound::test_vectors::NO_INDEX;
use crate::order_search::options::Norm;
use crate::simd::LANE_COUNT;

/// Constant factor in the bound of the rounding error of a coefficient. It is far above the error of Gaussian
/// elimination. The other factors of this bound are the trace of the inverse correlation matrix, the squared number of
/// terms, and the sum of the output norm and the moduli of the coefficients.
const ELIMINATION_ERROR: f64 = 16.0 * f64::EPSILON;

/// Value of 1 − B² at or below which the two varying columns are numerically collinear. B is the inner product of these
/// columns after projection orthogonal to the fixed-order columns and scaling to unit norm.
const COLLINEARITY_TOLERANCE: f64 = 1e-12;

/// Maximum number of regressor columns of a slice of the order grid whose orders do not vary.
pub(super) const MAX_REMAINING_COLUMNS: usize = 16;

/// Constants shared by the boxes of all slices.
pub(super) struct SearchConstants {
    pub(super) norm: Norm,
    /// True if candidates are ranked by their squared equation error.
    pub(super) ranks_equation_error: bool,
    /// For each group of [`LANE_COUNT`] test vectors t, the maxima of |⟨t, x⟩| and |g|‖t‖ over all unit-norm columns x.
    /// Here g is the projection of Fᵀt on t, and F is the kernel matrix of x.
    pub(super) max_moduli: Vec<[Wide; 2]>,
    /// For each record, the largest rounding-error bound of ⟨t, x⟩ over all unit-norm columns x.
    pub(super) rounding: Vec<f64>,
    /// Euclidean norm of the output over all records.
    pub(super) size: f64,
    /// Product of `size` and the square root of the largest row weight of the normal equations.
    pub(super) weighted_size: f64,
    /// One plus the ratio of the largest to the smallest inverse column norm.
    pub(super) ratio: f64,
}

impl SearchConstants {
    /// Compute the constants. `size` is the Euclidean norm of the output over all records, and `weight` the square root
    /// of the largest row weight of the normal equations.
    pub(super) fn new(
        remaining: &RemainingColumns<'_>,
        norm: Norm,
        ranks_equation_error: bool,
        size: f64,
        weight: f64,
    ) -> Self {
        let width = remaining.normal.inverse().len();
        let max_moduli = vector_groups(remaining.test_vectors)
            .map(|(r, g)| {
                let mut peaks = [ZERO_LANES; 2];
                for p in 0..width {
                    let (products, _) = remaining.vector_products(r, g, p);
                    for half in 0..2 {
                        for n in 0..LANE_COUNT {
                            peaks[half][n] = peaks[half][n].max(products[2 * half][n].hypot(products[2 * half + 1][n]));
                        }
                    }
                }
                peaks
            })
            .collect();
        let sizes = || remaining.normal.inverse().iter().copied().filter(|&i| i > 0.0);
        // In a sum of two coefficients, the error of one is scaled by the ratio of column norms. The term 1 is for the
        // other.
        let ratio = 1.0 + sizes().fold(0.0, f64::max) / sizes().fold(f64::INFINITY, f64::min);
        let max_scaled = |rounding: &[f64]| -> f64 {
            rounding.iter().zip(remaining.normal.inverse()).map(|(r, i)| r * i).fold(0.0, f64::max)
        };
        Self {
            norm,
            ranks_equation_error,
            max_moduli,
            rounding: remaining.test_vectors.iter().map(|p| max_scaled(&p.rounding)).collect(),
            size,
            weighted_size: size * weight,
            ratio,
        }
    }
}

/// Interval of consecutive grid values of one order. It has at most 2^`level` values and starts at value number
/// `position`·2^`level`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Interval {
    pub(super) level: usize,
    pub(super) position: usize,
}

impl Interval {
    /// Return the indices of the first and the last value of the interval, for an order with `n` grid values.
    #[inline(always)]
    pub(super) fn ends(self, n: usize) -> (usize, usize) {
        (self.position << self.level, n.min((self.position + 1) << self.level) - 1)
    }
}

/// Linear approximation of a quantity over an interval: value at the midpoint, half the difference of the end values,
/// and a bound of the deviation.
#[derive(Debug, Clone, Copy)]
pub(super) struct LinearApproximation {
    pub(super) middle: f64,
    pub(super) slope: f64,
    pub(super) remainder: f64,
}

impl LinearApproximation {
    /// Return the approximation from the values at both ends and a bound of the deviation.
    #[inline(always)]
    pub(super) fn new(first: f64, last: f64, remainder: f64) -> Self {
        Self { middle: (first + last) / 2.0, slope: (last - first) / 2.0, remainder }
    }
}

/// Return the coefficients of 1, s, t and st of the bilinear function with these values at (s, t) = (−1, −1), (1, −1),
/// (−1, 1), (1, 1).
#[inline(always)]
fn bilinear([a, b, c, d]: [f64; 4]) -> [f64; 4] {
    [(a + b + c + d) / 4.0, ((b + d) - (a + c)) / 4.0, ((c + d) - (a + b)) / 4.0, ((a + d) - (b + c)) / 4.0]
}

/// Quantities shared by all candidates of a box of orders. The coefficients p and q belong to the two varying columns,
/// made orthogonal to the fixed-order columns and scaled to unit norm.
pub(super) struct BoxQuantities {
    /// Row of the slice of the order grid and index within the row, for each of the four corners.
    pub(super) corners: [(usize, usize); 4],
    /// One eighth of the squared length of each side, with the length in grid increments.
    pub(super) interpolation_factors: [f64; 2],
    /// Coefficient p of the first varying column at the four corners.
    pub(super) ps: [f64; 4],
    /// Coefficient q of the second varying column at the four corners.
    pub(super) qs: [f64; 4],
    /// Upper bounds over the box of orders of |p| and |q|, with the coefficients p and q of the two varying columns.
    pub(super) coefficient_bounds: [f64; 2],
    /// Largest deviations of (p + q)/2 and (p − q)/2 over the box of orders from the bilinear functions with the same
    /// corner values. Here p and q are the coefficients of the two varying columns. The deviations are 0 if candidates
    /// are ranked by equation error, whose bound does not need them.
    pub(super) bilinear_deviation: [f64; 2],
    /// Upper bounds of the deviations of p s and q t from bilinear functions over the box of orders. Here −1 ≤ s, t ≤ 1
    /// are the coordinates in the box, and the coefficients p and q of the two varying columns are approximated by
    /// bilinear functions. The first bound is the sum of the moduli of the coefficients of s and st in the function for
    /// p. The second is that of t and st in the function for q.
    pub(super) mixed_slopes: [f64; 2],
    /// Upper bound over the box of the part of the squared output norm that the two varying columns explain. It is 0
    /// unless candidates are ranked by equation error.
    pub(super) explained_square: f64,
    /// Upper bound of the sum of the weighted output norm and the moduli of all coefficients.
    pub(super) modulus_sum: f64,
    /// Rounding-error bound of one coefficient of a candidate.
    pub(super) rounding: f64,
}

impl BoxQuantities {
    /// Return an upper bound of the deviation of p a + q b from a bilinear function over the box of orders. Here p and
    /// q are the coefficients of the two varying columns. The quantities a and b each depend on one of the two orders,
    /// and are given by linear approximations.
    #[inline(always)]
    pub(super) fn remainder(&self, [a, b]: [LinearApproximation; 2]) -> f64 {
        let curvature = self.mixed_slopes[0] * a.slope.abs() + self.mixed_slopes[1] * b.slope.abs();
        let slopes = a.slope.abs() + b.slope.abs();
        let (sum, difference) = (a.middle + b.middle, a.middle - b.middle);
        curvature
            + self.coefficient_bounds[0] * a.remainder
            + self.coefficient_bounds[1] * b.remainder
            + self.bilinear_deviation[0] * (sum.abs() + slopes)
            + self.bilinear_deviation[1] * (difference.abs() + slopes)
    }
}

/// Moduli of the coefficients of the fixed-order columns at the corners of a box of orders, and bounds of the deviation
/// of the coefficients from bilinear functions.
pub(super) struct Moduli {
    /// Modulus of the coefficient of each fixed-order column at the four corners.
    fixed_columns: [[f64; 4]; MAX_REMAINING_COLUMNS],
    /// For each fixed-order column, an upper bound of how far its coefficient deviates from a bilinear function within
    /// the box of orders. The bound includes rounding errors.
    deviation_bounds: [f64; MAX_REMAINING_COLUMNS],
    /// Modulus, at each corner, of the sum of two coefficients that may cancel. They belong to the fixed-order output
    /// column and to the varying output column.
    sums: [f64; 4],
    /// Upper bound of how far the sum of the two coefficients of `sums` deviates from a bilinear function within the
    /// box of orders. The bound includes rounding errors.
    sum_deviation_bound: f64,
}

/// Inner products and denominators of one group of [`LANE_COUNT`] test vectors at the corners of a box of orders, and
/// their deviations from bilinear functions.
pub(super) struct CornerValues {
    /// Products ⟨t, w⟩ of the test vectors t with the equation error w, and denominators ‖t‖(1 − Σ c g), by corner.
    /// Each is given as real and imaginary part. The sum is over the output columns with coefficient c and kernel
    /// matrix F, and g is the projection of Fᵀt on t.
    pub(super) values: [[Wide; 4]; 4],
    /// Slack Σ|c|‖Fᵀt − g t‖ at the corners, by which the norm in the denominator of the bound may exceed ‖t‖|1 − Σ c
    /// g|. The sum is over the output columns with coefficient c and kernel matrix F. Here t is a test vector, and g is
    /// the projection of Fᵀt on t.
    pub(super) slack: [Wide; 4],
    /// Upper bounds of how far two quantities deviate from bilinear functions within the box of orders. The first
    /// quantity is the product of a test vector with the equation error. The second is the denominator of the bound,
    /// including its slack.
    pub(super) remainders: [Wide; 2],
}

/// Tables of one slice of the order grid, from which the bounds of its boxes of orders are computed.
pub(super) struct SliceTables<'a> {
    pub(super) remaining: &'a RemainingColumns<'a>,
    pub(super) common: &'a SearchConstants,
    /// Tables of the values of the two varying orders. In the grid of order pairs, the first order determines the row,
    /// the second the column.
    pub(super) sides: [AxisTable; 2],
    /// Index in `sides` of the order that belongs to terms of the output. `None` if neither order does.
    output_side: Option<usize>,
    /// Coefficients of the projection of the output on the fixed-order columns.
    pub(super) base_coefficients: Vec<f64>,
    /// The squared norm of the residual of the output after projection on the fixed-order columns.
    residual_square: f64,
    /// Product ⟨t, r⟩ and denominator ‖t‖(1 − Σ c g), by group of test vectors t. Here r is the residual of the output
    /// after projection on the fixed-order columns. The sum is over these columns with coefficient c and kernel matrix
    /// F, and g is the projection of Fᵀt on t.
    base: Vec<VectorProducts>,
    /// Norms ‖Fᵀt − g t‖ for the fixed-order columns with kernel matrix F and the test vectors t, scaled by the inverse
    /// column norm. Here g is the projection of Fᵀt on t. The entries are sorted by group of test vectors, then by
    /// column.
    orthogonal_norms: Vec<Wide>,
}

impl<'a> SliceTables<'a> {
    /// Build the tables of a slice of the order grid from the tables along its two varying orders.
    #[inline(always)]
    pub(super) fn new(remaining: &'a RemainingColumns<'a>, common: &'a SearchConstants, sides: [AxisTable; 2]) -> Self {
        let k = remaining.columns.len();
        let mut base_coefficients = vec![0.0; k];
        let rhs: Vec<f64> = remaining.columns.iter().map(|&s| remaining.normal.rhs()[s]).collect();
        remaining.solve(&rhs, &mut base_coefficients);
        let (mut base, mut orthogonal_norms) = (Vec::new(), Vec::new());
        for (r, g) in vector_groups(remaining.test_vectors) {
            let test_vectors = &remaining.test_vectors[r];
            let mut slice_products =
                [test_vectors.target[g][0], test_vectors.target[g][1], test_vectors.size[g], ZERO_LANES];
            for (c, &s) in base_coefficients.iter().zip(remaining.columns) {
                let (products, orthogonal_norm) = remaining.vector_products(r, g, s);
                for (slice_products, products) in slice_products.iter_mut().zip(&products) {
                    for n in 0..LANE_COUNT {
                        slice_products[n] -= c * products[n];
                    }
                }
                orthogonal_norms.push(orthogonal_norm);
            }
            base.push(slice_products);
        }
        let explained_square: f64 = base_coefficients.iter().zip(&rhs).map(|(c, g)| c * g).sum();
        let is_output_side = |side: &AxisTable| {
            remaining.test_vectors.first().is_some_and(|p| side.columns.iter().all(|&c| p.rows[c] != NO_INDEX))
        };
        let output_side = (0..2).find(|&n| is_output_side(&sides[n]));
        Self {
            remaining,
            common,
            sides,
            output_side,
            base_coefficients,
            residual_square: common.size * common.size - explained_square,
            base,
            orthogonal_norms,
        }
    }

    /// Compute the coefficients of the two varying columns for all candidates in these rows of the slice of the order
    /// grid, and store them in `row_coefficients`.
    #[inline(always)]
    pub(super) fn compute_coefficients(&self, row_coefficients: &mut RowCoefficients, rows: Range<usize>) {
        let (k, len) = (self.remaining.columns.len(), self.sides[1].columns.len());
        let [u, v] = &self.sides;
        (row_coefficients.start, row_coefficients.len) = (rows.start, len);
        let RowCoefficients { plus, minus, independence, product, .. } = row_coefficients;
        for table in [&mut *plus, minus, independence] {
            table.resize(rows.len() * len, 0.0);
        }
        product.resize((k + 1) * len, 0.0);
        let (product, fixed_products) = product.split_at_mut(len);
        for (s, fixed_products) in fixed_products.chunks_exact_mut(len).enumerate() {
            for (j, fixed_products) in fixed_products.iter_mut().enumerate() {
                *fixed_products = v.fixed_products[j * k + s];
            }
        }
        for (index, row) in rows.enumerate() {
            let (products, scale, y) = (self.remaining.normal.products(u.columns[row]), u.scale[row], u.target[row]);
            for (product, &column) in product.iter_mut().zip(&v.columns) {
                *product = products[column] * scale;
            }
            for (fixed_products, fixed_coefficients) in
                fixed_products.chunks_exact(len).zip(&u.fixed_coefficients[row * k..(row + 1) * k])
            {
                for (product, fixed_products) in product.iter_mut().zip(fixed_products) {
                    *product -= fixed_coefficients * fixed_products;
                }
            }
            let index = index * len..(index + 1) * len;
            let (plus, minus, independence) =
                (&mut plus[index.clone()], &mut minus[index.clone()], &mut independence[index]);
            let (scales, targets) = (&v.scale[..len], &v.target[..len]);
            for j in 0..len {
                let (b, z) = (product[j] * scales[j], targets[j]);
                let (above, below) = (1.0 + b, 1.0 - b);
                let independence_of_pair = above * below;
                let is_independent = independence_of_pair > COLLINEARITY_TOLERANCE;
                let half = if is_independent { 0.5 / independence_of_pair } else { 0.0 };
                independence[j] = if is_independent { independence_of_pair } else { 0.0 };
                plus[j] = (y + z) * below * half;
                minus[j] = (y - z) * above * half;
            }
        }
    }

    /// Compute the quantities shared by all candidates of a box of orders. `None` if the two varying columns may be
    /// collinear in the box, because no bound exists then.
    #[inline(always)]
    pub(super) fn box_quantities(
        &self,
        row_coefficients: &RowCoefficients,
        [su, sv]: [Interval; 2],
    ) -> Option<BoxQuantities> {
        let [u, v] = &self.sides;
        let ((u0, u1), (v0, v1)) = (su.ends(u.columns.len()), sv.ends(v.columns.len()));
        let (wu, wv) = (eighth_of_square(u1 - u0), eighth_of_square(v1 - v0));
        let (pu, pv) =
            (u.levels[su.level].coefficient_sums[su.position], v.levels[sv.level].coefficient_sums[sv.position]);
        let sums = pu.sum + pv.sum;
        let corners = [(u0, v0), (u1, v0), (u0, v1), (u1, v1)];
        let indices = corners.map(|(i, j)| row_coefficients.at(i, j));
        let halves =
            [indices.map(|index| row_coefficients.plus[index]), indices.map(|index| row_coefficients.minus[index])];
        let (mut ps, mut qs) = ([0.0; 4], [0.0; 4]);
        for c in 0..4 {
            ps[c] = halves[0][c] + halves[1][c];
            qs[c] = halves[0][c] - halves[1][c];
        }
        let (bilinear_deviation, independence, explained_square) = if self.common.ranks_equation_error {
            let (independence, explained_square) =
                row_coefficients.max_explained([(u0, u1), (v0, v1)], [&u.target, &v.target]);
            ([0.0; 2], independence, explained_square)
        } else {
            let (bilinear_deviation, independence) =
                row_coefficients.bilinear_deviation([(u0, u1), (v0, v1)], halves.map(bilinear));
            (bilinear_deviation, independence, 0.0)
        };
        let independence = independence - 2.0 * self.remaining.rounding * self.remaining.trace * sums * sums;
        // NaN proves nothing.
        if independence.is_nan() || independence <= 0.0 {
            return None;
        }
        let largest = |x: &[f64; 4]| x.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        let deviation_sum = bilinear_deviation[0] + bilinear_deviation[1];
        let (p, q, p_most, q_most) =
            (bilinear(ps), bilinear(qs), largest(&ps) + deviation_sum, largest(&qs) + deviation_sum);

        let trace = self.remaining.trace + sums * sums / independence;
        let modulus_sum = self.common.weighted_size
            + self.base_coefficients.iter().map(|c| c.abs()).sum::<f64>()
            + p_most * pu.sum
            + q_most * pv.sum;
        let terms = to_f64(self.remaining.columns.len() + 2);
        let rounding = ELIMINATION_ERROR * terms * terms * trace * modulus_sum;
        let mixed_slopes = [p[1].abs() + p[3].abs(), q[2].abs() + q[3].abs()];
        Some(BoxQuantities {
            corners,
            interpolation_factors: [wu, wv],
            ps,
            qs,
            coefficient_bounds: [p_most, q_most],
            bilinear_deviation,
            mixed_slopes,
            explained_square,
            modulus_sum,
            rounding,
        })
    }

    /// Return a lower bound of the raw score (Σ|e| or Σe²) that holds for every candidate of a box of orders. The sum
    /// over records stops once it exceeds `limit`.
    #[inline(always)]
    pub(super) fn bound(&self, intervals: [Interval; 2], cell: &BoxQuantities, limit: f64) -> f64 {
        if self.common.ranks_equation_error {
            self.equation_error_bound(cell)
        } else {
            self.output_error_bound(intervals, cell, limit)
        }
    }

    /// Return a lower bound of the sum of squared equation errors of every candidate of the box of orders, 0 if nothing
    /// is proved.
    #[inline(always)]
    fn equation_error_bound(&self, cell: &BoxQuantities) -> f64 {
        let rounding =
            self.remaining.rounding * cell.modulus_sum + to_f64(self.remaining.columns.len() + 2) * cell.rounding;
        let bound = self.residual_square - cell.explained_square - 4.0 * rounding * cell.modulus_sum;
        // Neither NaN nor an overflow proves anything.
        if bound > 0.0 && bound < f64::MAX && cell.explained_square > f64::MIN {
            bound
        } else {
            0.0
        }
    }

    /// Return a lower bound of the raw output error (Σ|e| or Σe²) of every candidate of the box of orders. The sum over
    /// records stops once it exceeds `limit`.
    #[inline(always)]
    fn output_error_bound(&self, intervals: [Interval; 2], cell: &BoxQuantities, limit: f64) -> f64 {
        let moduli = self.moduli(intervals, cell);
        let (mut sum, mut first) = (0.0, 0);
        for (r, test_vectors) in self.remaining.test_vectors.iter().enumerate() {
            let mut best = 0.0;
            for group in first..first + test_vectors.groups {
                let joint_column = self.joint_column(intervals, cell, &moduli, group);
                let CornerValues { values, slack, remainders } =
                    self.corner_values(intervals, cell, &moduli, (r, group), joint_column);
                // All corner values are projected on the direction of their sum.
                let mut direction = [ZERO_LANES; 2];
                for n in 0..LANE_COUNT {
                    let re = values[0][0][n] + values[1][0][n] + values[2][0][n] + values[3][0][n];
                    let im = values[0][1][n] + values[1][1][n] + values[2][1][n] + values[3][1][n];
                    let size = (re * re + im * im).sqrt();
                    let inverse = if size > 0.0 { 1.0 / size } else { 0.0 };
                    direction[0][n] = re * inverse;
                    direction[1][n] = im * inverse;
                }
                let mut bounds = [f64::MAX; LANE_COUNT];
                for (value, slack) in values.iter().zip(&slack) {
                    for n in 0..LANE_COUNT {
                        let response = value[0][n] * direction[0][n] + value[1][n] * direction[1][n] - remainders[0][n];
                        let size = (value[2][n] * value[2][n] + value[3][n] * value[3][n]).sqrt();
                        // Margin for the rounding errors of the divisor and of the score.
                        let bound = response / ((size + slack[n] + remainders[1][n]) * (1.0 + test_vectors.unit));
                        // Neither NaN nor an overflow proves anything.
                        let bound = if bound > 0.0 && bound < f64::MAX { bound } else { 0.0 };
                        bounds[n] = if bound < bounds[n] { bound } else { bounds[n] };
                    }
                }
                for bound in bounds {
                    if bound > best {
                        best = bound;
                    }
                }
                if sum + self.raw(best) > limit {
                    break;
                }
            }
            first += test_vectors.groups;
            sum += self.raw(best);
        }
        sum
    }

    /// Compute the moduli of the coefficients of the fixed-order columns at the corners of a box of orders. Also bound
    /// the deviation of these coefficients from bilinear functions.
    #[inline(always)]
    pub(super) fn moduli(&self, [su, sv]: [Interval; 2], cell: &BoxQuantities) -> Moduli {
        let k = self.remaining.columns.len();
        let [u, v] = &self.sides;
        let BoxQuantities { corners, interpolation_factors: [wu, wv], ps, qs, rounding, .. } = *cell;
        let ((u0, v0), (u1, v1)) = (corners[0], corners[3]);
        let (lu, lv) = (&u.levels[su.level], &v.levels[sv.level]);
        let (mut fixed_columns, mut deviation_bounds) =
            ([[0.0; 4]; MAX_REMAINING_COLUMNS], [0.0; MAX_REMAINING_COLUMNS]);
        for s in 0..k {
            for (c, (i, j)) in corners.into_iter().enumerate() {
                fixed_columns[s][c] = (self.base_coefficients[s]
                    - ps[c] * u.fixed_coefficients[i * k + s]
                    - qs[c] * v.fixed_coefficients[j * k + s])
                    .abs();
            }
            let a = LinearApproximation::new(
                u.fixed_coefficients[u0 * k + s],
                u.fixed_coefficients[u1 * k + s],
                wu * lu.fixed_coefficients[su.position * k + s],
            );
            let b = LinearApproximation::new(
                v.fixed_coefficients[v0 * k + s],
                v.fixed_coefficients[v1 * k + s],
                wv * lv.fixed_coefficients[sv.position * k + s],
            );
            deviation_bounds[s] = cell.remainder([a, b]) + rounding;
        }
        let (mut sums, mut sum_deviation_bound) = ([0.0; 4], 0.0);
        if let Some(fixed_output_column) = self.fixed_output_column() {
            for (c, (i, j)) in corners.into_iter().enumerate() {
                sums[c] = (self.base_coefficients[fixed_output_column]
                    - ps[c] * u.joint_coefficients[i]
                    - qs[c] * v.joint_coefficients[j])
                    .abs();
            }
            let curvature = |values: &[f64], first: usize, last: usize| {
                let inner =
                    (first + 1..last).map(|i| ((values[i - 1] - values[i]) + (values[i + 1] - values[i])).abs());
                inner.fold(0.0, f64::max)
            };
            let a = LinearApproximation::new(
                u.joint_coefficients[u0],
                u.joint_coefficients[u1],
                wu * curvature(&u.joint_coefficients, u0, u1),
            );
            let b = LinearApproximation::new(
                v.joint_coefficients[v0],
                v.joint_coefficients[v1],
                wv * curvature(&v.joint_coefficients, v0, v1),
            );
            sum_deviation_bound = cell.remainder([a, b]) + rounding * self.common.ratio;
        }
        Moduli { fixed_columns, deviation_bounds, sums, sum_deviation_bound }
    }

    /// Return the index of a fixed-order column of the output if a varying column also belongs to the output. `None`
    /// otherwise. The coefficients of the two columns may cancel.
    #[inline(always)]
    fn fixed_output_column(&self) -> Option<usize> {
        self.remaining.fixed_output_column.filter(|_| self.output_side.is_some())
    }

    /// Return the index of the fixed-order output column if a joint bound with the varying output column is tighter for
    /// this group of test vectors. `None` otherwise.
    #[inline(always)]
    pub(super) fn joint_column(
        &self,
        [su, sv]: [Interval; 2],
        cell: &BoxQuantities,
        moduli: &Moduli,
        group: usize,
    ) -> Option<usize> {
        let fixed_output_column = self.fixed_output_column()?;
        let (k, groups) = (self.remaining.columns.len(), self.base.len());
        let [u, v] = &self.sides;
        let bu = &u.levels[su.level].nodes[su.position * groups + group].second_differences;
        let bv = &v.levels[sv.level].nodes[sv.position * groups + group].second_differences;
        let output_coefficients = if self.output_side == Some(0) { &cell.ps } else { &cell.qs };
        let orthogonal_norms = &self.orthogonal_norms[group * k + fixed_output_column];
        let (mut separate_slack, mut joint_slack) = (0.0, 0.0);
        for n in 0..LANE_COUNT {
            separate_slack += moduli.fixed_columns[fixed_output_column][0] * orthogonal_norms[n]
                + output_coefficients[0].abs() * (bu[2][n] + bv[2][n]);
            joint_slack += moduli.sums[0] * orthogonal_norms[n] + output_coefficients[0].abs() * (bu[3][n] + bv[3][n]);
        }
        (joint_slack < separate_slack).then_some(fixed_output_column)
    }

    /// Compute inner products and denominators of one group of test vectors on one record, at the corners of a box of
    /// orders. `joint_column` is the fixed-order output column that is bounded jointly with the varying output column.
    #[inline(always)]
    pub(super) fn corner_values(
        &self,
        [su, sv]: [Interval; 2],
        cell: &BoxQuantities,
        moduli: &Moduli,
        (record, group): (usize, usize),
        joint_column: Option<usize>,
    ) -> CornerValues {
        let (k, groups) = (self.remaining.columns.len(), self.base.len());
        let [u, v] = &self.sides;
        let BoxQuantities {
            corners,
            interpolation_factors: [wu, wv],
            ps,
            qs,
            coefficient_bounds: [p_bound, q_bound],
            bilinear_deviation,
            mixed_slopes,
            modulus_sum,
            rounding: rounding_error,
            ..
        } = *cell;
        let deviation_sum = bilinear_deviation[0] + bilinear_deviation[1];
        let ((u0, v0), (u1, v1)) = (corners[0], corners[3]);
        let bu = &u.levels[su.level].nodes[su.position * groups + group].second_differences;
        let bv = &v.levels[sv.level].nodes[sv.position * groups + group].second_differences;
        let (a, b) = (&u.vector_products[u0 * groups + group], &u.vector_products[u1 * groups + group]);
        let (c, d) = (&v.vector_products[v0 * groups + group], &v.vector_products[v1 * groups + group]);
        let (base, max_moduli) = (&self.base[group], &self.common.max_moduli[group]);
        let mut remainders = [[0.0; LANE_COUNT]; 2];
        for half in 0..2 {
            for n in 0..LANE_COUNT {
                let mut sizes = [0.0; 4];
                for part in 2 * half..2 * half + 2 {
                    let (mu, mv) = ((a[part][n] + b[part][n]) * 0.5, (c[part][n] + d[part][n]) * 0.5);
                    sizes[0] += (mu + mv).abs();
                    sizes[1] += (mu - mv).abs();
                    sizes[2] += (b[part][n] - a[part][n]).abs() * 0.5;
                    sizes[3] += (d[part][n] - c[part][n]).abs() * 0.5;
                }
                remainders[half][n] = mixed_slopes[0] * sizes[2]
                    + mixed_slopes[1] * sizes[3]
                    + bilinear_deviation[0] * sizes[0]
                    + bilinear_deviation[1] * sizes[1]
                    + deviation_sum * (sizes[2] + sizes[3])
                    + wu * bu[half][n] * p_bound
                    + wv * bv[half][n] * q_bound
                    + rounding_error * max_moduli[half][n];
            }
        }
        let rounding = self.remaining.test_vectors[record].target_rounding
            + (modulus_sum + rounding_error) * self.common.rounding[record];
        remainders[0].iter_mut().for_each(|remainders| *remainders += rounding);
        // Slack of the varying columns, whose scale is at least 1. The slack of the fixed-order columns follows.
        let mut slack = [ZERO_LANES; 4];
        let part = if joint_column.is_some() { 3 } else { 2 };
        for n in 0..LANE_COUNT {
            remainders[1][n] += (deviation_sum + rounding_error) * (bu[part][n] + bv[part][n]);
            for corner in 0..4 {
                slack[corner][n] = ps[corner].abs() * bu[part][n] + qs[corner].abs() * bv[part][n];
            }
        }
        let orthogonal_norms = &self.orthogonal_norms[group * k..(group + 1) * k];
        for (s, orthogonal_norm) in orthogonal_norms.iter().enumerate() {
            let joint_coefficients = joint_column == Some(s);
            let (sizes, norms) = if joint_coefficients {
                (&moduli.sums, moduli.sum_deviation_bound)
            } else {
                (&moduli.fixed_columns[s], moduli.deviation_bounds[s])
            };
            for n in 0..LANE_COUNT {
                remainders[1][n] += norms * orthogonal_norm[n];
                for corner in 0..4 {
                    slack[corner][n] += sizes[corner] * orthogonal_norm[n];
                }
            }
        }
        let mut values = [[ZERO_LANES; 4]; 4];
        for (corner, value) in values.iter_mut().enumerate() {
            let (of_u, of_v) = ([a, b][corner % 2], [c, d][corner / 2]);
            for part in 0..4 {
                for n in 0..LANE_COUNT {
                    value[part][n] = base[part][n] - ps[corner] * of_u[part][n] - qs[corner] * of_v[part][n];
                }
            }
        }
        CornerValues { values, slack, remainders }
    }

    /// Convert a norm of the error to a raw score: Σ|e| for [`Norm::L1`], Σe² for [`Norm::L2`].
    #[inline(always)]
    pub(super) fn raw(&self, norm: f64) -> f64 {
        match self.common.norm {
            Norm::L1 => norm,
            Norm::L2 => norm * norm,
        }
    }
}

/// Return one eighth of a squared length.
#[inline(always)]
fn eighth_of_square(length: usize) -> f64 {
    let length = to_f64(length);
    length * length / 8.0
}
/// Number of candidates of a row that are processed in parallel SIMD lanes.
const ROW_LANES: usize = 4;
const LANE_OFFSETS: [f64; ROW_LANES] = [0.0, 1.0, 2.0, 3.0];

/// Coefficients p and q of the two varying columns for all candidates of some rows of a slice of the order grid. The
/// columns are orthogonal to the fixed-order columns and of unit norm.
#[derive(Default)]
pub(super) struct RowCoefficients {
    /// Index of the first stored row in the slice of the order grid.
    pub(super) start: usize,
    /// Number of candidates in a row.
    pub(super) len: usize,
    /// Half sum (p + q)/2 of the coefficients p and q of the two varying columns, by candidate. It is 0 if the columns
    /// are collinear.
    pub(super) plus: Vec<f64>,
    /// Half difference (p − q)/2 of the coefficients p and q of the two varying columns, by candidate. It is 0 if the
    /// columns are collinear.
    pub(super) minus: Vec<f64>,
    /// Value of 1 − B² by candidate, where B is the inner product of the two normalized varying columns. It is 0 if the
    /// columns are collinear.
    pub(super) independence: Vec<f64>,
    /// Inner product of the two normalized varying columns for each candidate of the current row, followed by
    /// workspace.
    pub(super) product: Vec<f64>,
}

impl RowCoefficients {
    /// Return the index, in the stored vectors, of candidate number `value` in row `row` of the slice.
    #[inline(always)]
    pub(super) fn at(&self, row: usize, value: usize) -> usize {
        (row - self.start) * self.len + value
    }

    /// Return the largest deviations of (p + q)/2 and (p − q)/2 from the given bilinear functions over a box of orders,
    /// and the smallest 1 − B². Here p and q are the coefficients of the two varying columns, and B is the inner
    /// product of these columns after normalization.
    #[inline(always)]
    pub(super) fn bilinear_deviation(
        &self,
        [(u0, u1), (v0, v1)]: [(usize, usize); 2],
        [plus, minus]: [[f64; 4]; 2],
    ) -> ([f64; 2], f64) {
        let (mut deviations, mut independence) = ([[0.0_f64; ROW_LANES]; 2], [f64::INFINITY; ROW_LANES]);
        let width = v1 - v0 + 1;
        let [row_scale, column_scale] =
            [(u0, u1), (v0, v1)].map(|(a, b)| if b > a { 2.0 / to_f64(b - a) } else { 0.0 });
        for row in 0..=u1 - u0 {
            let s = to_f64(row) * row_scale - 1.0;
            let (x, y) = (plus[2] + plus[3] * s, minus[2] + minus[3] * s);
            let (first, second) = (plus[0] + plus[1] * s - x, minus[0] + minus[1] * s - y);
            let (x, y, start) = (x * column_scale, y * column_scale, self.at(u0 + row, v0));
            let plus = self.plus[start..start + width].chunks_exact(ROW_LANES);
            let minus = self.minus[start..start + width].chunks_exact(ROW_LANES);
            let denominators = self.independence[start..start + width].chunks_exact(ROW_LANES);
            let tail = [plus.remainder(), minus.remainder(), denominators.remainder()];
            let mut offsets = LANE_OFFSETS;
            for ((plus, minus), denominators) in plus.zip(minus).zip(denominators) {
                for n in 0..ROW_LANES {
                    let a = (plus[n] - (first + x * offsets[n])).abs();
                    let b = (minus[n] - (second + y * offsets[n])).abs();
                    deviations[0][n] = if a > deviations[0][n] { a } else { deviations[0][n] };
                    deviations[1][n] = if b > deviations[1][n] { b } else { deviations[1][n] };
                    independence[n] = if denominators[n] < independence[n] { denominators[n] } else { independence[n] };
                    offsets[n] += LANE_OFFSETS[ROW_LANES - 1] + 1.0;
                }
            }
            for n in 0..tail[0].len() {
                let a = (tail[0][n] - (first + x * offsets[n])).abs();
                let b = (tail[1][n] - (second + y * offsets[n])).abs();
                deviations[0][n] = if a > deviations[0][n] { a } else { deviations[0][n] };
                deviations[1][n] = if b > deviations[1][n] { b } else { deviations[1][n] };
                independence[n] = if tail[2][n] < independence[n] { tail[2][n] } else { independence[n] };
            }
        }
        let maximum = |x: [f64; ROW_LANES]| x.into_iter().fold(0.0_f64, f64::max);
        ([maximum(deviations[0]), maximum(deviations[1])], independence.into_iter().fold(f64::INFINITY, f64::min))
    }

    /// Return the smallest 1 − B² over a box of orders, and the largest part of the squared output norm that the two
    /// varying columns explain. B is the inner product of these columns after normalization.
    #[inline(always)]
    pub(super) fn max_explained(&self, [(u0, u1), (v0, v1)]: [(usize, usize); 2], [y, z]: [&[f64]; 2]) -> (f64, f64) {
        let (mut independence, mut max_square) = ([f64::INFINITY; ROW_LANES], [f64::NEG_INFINITY; ROW_LANES]);
        let width = v1 - v0 + 1;
        for row in u0..u1 + 1 {
            let (y, start) = (y[row], self.at(row, v0));
            let sums = [&self.plus, &self.minus, &self.independence].map(|table| &table[start..start + width]);
            let z = &z[v0..v0 + width];
            let mut offset = 0;
            while offset < width {
                let lanes = ROW_LANES.min(width - offset);
                for n in 0..lanes {
                    let explained_square =
                        sums[0][offset + n] * (y + z[offset + n]) + sums[1][offset + n] * (y - z[offset + n]);
                    max_square[n] = if explained_square > max_square[n] { explained_square } else { max_square[n] };
                    independence[n] =
                        if sums[2][offset + n] < independence[n] { sums[2][offset + n] } else { independence[n] };
                }
                offset += lanes;
            }
        }
        (
            independence.into_iter().fold(f64::INFINITY, f64::min),
            max_square.into_iter().fold(f64::NEG_INFINITY, f64::max),
        )
    }
}

/// Convert a count to a floating-point number.
#[inline(always)]
#[allow(clippy::cast_precision_loss)]
pub(super) fn to_f64(n: usize) -> f64 {
    n as f64
}

//! Tables along one order of a slice: projections, coefficients and deviations from linear interpolation.
//!
//! For each grid value of the order, x is the regressor column. The vector û is x made orthogonal to the fixed-order
//! columns of the slice and scaled to unit norm. Let l be the linear interpolation of a quantity f between the ends of
//! an interval. Then f deviates from l by at most one eighth of the squared length times the largest second difference.
//! This follows from f_i − l_i = −Σ_j G_ij Δ²f_j, where lo and hi are the ends of the interval, and G is a nonnegative
//! matrix with Σ_j G_ij = (i − lo)(hi − i)/2.

use crate::order_search::candidate::normal_equations::Normal;
use crate::order_search::dual_bound::test_vectors::{TestVectors, NO_INDEX};
use crate::simd::LANE_COUNT;

/// One value for each of [`LANE_COUNT`] test vectors.
pub(super) type Wide = [f64; LANE_COUNT];
pub(super) const ZERO_LANES: Wide = [0.0; LANE_COUNT];

/// Products of a column x with a group of test vectors t: ⟨t, x⟩ and g‖t‖, each as real and imaginary part. Here g is
/// the projection of Fᵀt on t, and F is the kernel matrix of x. For a column of a signal other than the output, g is 0.
pub(super) type VectorProducts = [Wide; 4];

/// Maxima over one interval of an order, for one group of [`LANE_COUNT`] test vectors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Node {
    /// Four maxima over the interval of grid values. The first two are second differences of ⟨t, û⟩ and g‖t‖ along the
    /// order. The third is ‖Fᵀt − g t‖. The fourth bounds the difference of Fᵀt − g t from its value for the
    /// fixed-order output column. Here t is a test vector, and û is the column of the varying order, orthogonal to the
    /// fixed-order columns and of unit norm. F is the kernel matrix of the varying column, and g is the projection of
    /// Fᵀt on t.
    pub(super) second_differences: [Wide; 4],
}

/// Maximum, over an interval of grid values of one order, of a sum of coefficient moduli.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CoefficientSums {
    /// Maximum over the interval of Σ|c|. Here c are the coefficients of a normalized column in terms of the regressor
    /// column of its order and the fixed-order columns. The normalized column is orthogonal to the fixed-order columns
    /// and has unit norm.
    pub(super) sum: f64,
}

/// Maxima over all intervals of grid values of one length, along one order.
pub(super) struct Level {
    /// Largest sum of coefficient moduli, by interval of grid values.
    pub(super) coefficient_sums: Vec<CoefficientSums>,
    /// Largest second differences of the coefficients of the fixed-order columns in the normalized column, which is
    /// orthogonal to them and has unit norm. The entries are sorted by interval, then by fixed-order column.
    pub(super) fixed_coefficients: Vec<f64>,
    /// Maxima of quantities of the test vectors, by interval of grid values, then by group of test vectors.
    pub(super) nodes: Vec<Node>,
}

/// Regressor columns of a slice of the order grid whose orders do not vary.
pub(super) struct RemainingColumns<'a> {
    pub(super) normal: &'a Normal,
    pub(super) test_vectors: &'a [TestVectors],
    /// Column indices of the fixed-order columns in the bank of regressors.
    pub(super) columns: &'a [usize],
    /// Inverse of the correlation matrix of the fixed-order columns, row-major k × k for k columns.
    pub(super) inverse: &'a [f64],
    /// Trace of `inverse`, at least 1.
    pub(super) trace: f64,
    /// Upper bound of the rounding error in the inner product of two unit-norm columns.
    pub(super) rounding: f64,
    /// Index in `columns` of a column of the output, if there is one. A varying column may also belong to the output.
    /// The coefficients of the two columns may then cancel.
    pub(super) fixed_output_column: Option<usize>,
}

impl RemainingColumns<'_> {
    /// Compute the coefficients of the projection of a column on the fixed-order columns, given the inner products of
    /// the column with them.
    pub(super) fn solve(&self, products: &[f64], out: &mut [f64]) {
        let k = self.columns.len();
        for (i, out) in out.iter_mut().enumerate() {
            *out = (0..k).map(|j| self.inverse[i * k + j] * products[j]).sum();
        }
    }

    /// Return an upper bound of ‖(Fᵀt − g t) − (Fₚᵀt − gₚ t)‖ for each test vector t of a group. F is the kernel matrix
    /// of the output column `column`, and g the projection of Fᵀt on t. Fₚ and gₚ are the same quantities of the
    /// fixed-order output column. The bound is 0 if `column` is not an output column or no fixed-order column is one.
    #[inline(always)]
    fn distance_to_fixed_output_column(&self, record: usize, group: usize, column: usize) -> Wide {
        let test_vectors = &self.test_vectors[record];
        let (mut distance, row) = (ZERO_LANES, test_vectors.rows[column]);
        if let Some(fixed_output_column) = self.fixed_output_column.filter(|_| row != NO_INDEX) {
            let effect = |row: usize| &test_vectors.effects[row * test_vectors.groups + group][3];
            let (a, b) = (effect(row), effect(test_vectors.rows[self.columns[fixed_output_column]]));
            for n in 0..LANE_COUNT {
                distance[n] = (a[n] - b[n]).abs();
            }
        }
        distance
    }

    /// Return the products ⟨t, x⟩ and g‖t‖ of a column x, scaled to unit norm, with a group of test vectors t, and ‖Fᵀt
    /// − g t‖. F is the kernel matrix of x, and g is the projection of Fᵀt on t.
    #[inline(always)]
    pub(super) fn vector_products(&self, record: usize, group: usize, column: usize) -> (VectorProducts, Wide) {
        let test_vectors = &self.test_vectors[record];
        let inverse = self.normal.inverse()[column];
        let [re, im] = &test_vectors.products[column * test_vectors.groups + group];
        let row = test_vectors.rows[column];
        let (mut products, mut orthogonal_norm) = ([ZERO_LANES; 4], ZERO_LANES);
        for n in 0..LANE_COUNT {
            products[0][n] = re[n] * inverse;
            products[1][n] = im[n] * inverse;
        }
        if row != NO_INDEX {
            let [a, b, c, _] = &test_vectors.effects[row * test_vectors.groups + group];
            for n in 0..LANE_COUNT {
                products[2][n] = a[n] * inverse;
                products[3][n] = b[n] * inverse;
                orthogonal_norm[n] = c[n] * inverse;
            }
        }
        (products, orthogonal_norm)
    }
}

/// Tables along one varying order of a slice of the order grid. For each grid value, x is the regressor column, and û
/// is x made orthogonal to the fixed-order columns and scaled to unit norm.
pub(super) struct AxisTable {
    /// Index of the regressor column in the bank of regressors, by grid value.
    pub(super) columns: Vec<usize>,
    /// Inverse norm, by grid value, of the regressor column (of unit norm) after projection orthogonal to the
    /// fixed-order columns.
    pub(super) scale: Vec<f64>,
    /// Product of the output with the normalized column (orthogonal to the fixed-order columns, of unit norm), by grid
    /// value.
    pub(super) target: Vec<f64>,
    /// Products of the regressor column (of unit norm) with the fixed-order columns, by grid value, then by fixed-order
    /// column.
    pub(super) fixed_products: Vec<f64>,
    /// Coefficients, negated, of the fixed-order columns in the normalized column, which is orthogonal to them and has
    /// unit norm. The entries are sorted by grid value, then by fixed-order column.
    pub(super) fixed_coefficients: Vec<f64>,
    /// Sum, with the opposite sign, of two coefficients of the normalized column (orthogonal to the fixed-order
    /// columns, of unit norm), by grid value. They belong to the fixed-order output column and to the regressor column
    /// itself if it is an output column. The second is converted to the scale of the first. Empty if no fixed-order
    /// column belongs to the output.
    pub(super) joint_coefficients: Vec<f64>,
    /// Products of the normalized column (orthogonal to the fixed-order columns, of unit norm) with the test vectors,
    /// by grid value, then by group of [`LANE_COUNT`] test vectors.
    pub(super) vector_products: Vec<VectorProducts>,
    /// Maxima over all intervals of 1, 2, 4, … grid values, by interval length.
    pub(super) levels: Vec<Level>,
}

impl AxisTable {
    /// Build the tables for these columns. `None` if a column is nearly a linear combination of the fixed-order
    /// columns, or if a product is not finite.
    #[inline(always)]
    pub(super) fn new(remaining: &RemainingColumns<'_>, columns: Vec<usize>) -> Option<Self> {
        let (k, n, normal) = (remaining.columns.len(), columns.len(), remaining.normal);
        let (mut scale, mut target, mut fixed_products) = (vec![0.0; n], vec![0.0; n], vec![0.0; n * k]);
        let (mut fixed_coefficients, mut raw) = (vec![0.0; n * k], vec![0.0; n * k]);
        for (i, &column) in columns.iter().enumerate() {
            let (fixed_products, raw) = (&mut fixed_products[i * k..(i + 1) * k], &mut raw[i * k..(i + 1) * k]);
            for (g, &s) in fixed_products.iter_mut().zip(remaining.columns) {
                *g = normal.product(s, column);
            }
            remaining.solve(fixed_products, raw);
            let remainder = 1.0 - fixed_products.iter().zip(raw.iter()).map(|(g, a)| g * a).sum::<f64>();
            let sum = 1.0 + raw.iter().map(|a| a.abs()).sum::<f64>();
            // This also rejects NaN.
            if remainder.is_nan() || remainder <= 1e3 * remaining.rounding * remaining.trace * sum * sum {
                return None;
            }
            scale[i] = 1.0 / remainder.sqrt();
            let fixed_part: f64 = raw.iter().zip(remaining.columns).map(|(a, &s)| a * normal.rhs()[s]).sum();
            target[i] = (normal.rhs()[column] - fixed_part) * scale[i];
            for (m, a) in fixed_coefficients[i * k..(i + 1) * k].iter_mut().zip(raw.iter()) {
                *m = a * scale[i];
            }
        }
        let groups: usize = remaining.test_vectors.iter().map(|p| p.groups).sum();
        let mut responses = Vec::with_capacity(n * groups);
        let mut rests = Vec::with_capacity(n * groups);
        let mut finite_check = ZERO_LANES;
        let mut joint_coefficients = Vec::new();
        if let Some(fixed_output_column) = remaining.fixed_output_column {
            let inverse = normal.inverse();
            let are_output_columns = remaining
                .test_vectors
                .first()
                .is_some_and(|test_vectors| columns.iter().all(|&p| test_vectors.rows[p] != NO_INDEX));
            joint_coefficients.extend(columns.iter().enumerate().map(|(i, &p)| {
                let varying_coefficient = if are_output_columns {
                    scale[i] * inverse[p] / inverse[remaining.columns[fixed_output_column]]
                } else {
                    0.0
                };
                fixed_coefficients[i * k + fixed_output_column] - varying_coefficient
            }));
        }
        let fixed_part: Vec<Vec<VectorProducts>> = remaining
            .columns
            .iter()
            .map(|&s| {
                vector_groups(remaining.test_vectors).map(|(r, g)| remaining.vector_products(r, g, s).0).collect()
            })
            .collect();
        for (i, &column) in columns.iter().enumerate() {
            for (index, (r, g)) in vector_groups(remaining.test_vectors).enumerate() {
                let (mut column_products, mut orthogonal_norm) = remaining.vector_products(r, g, column);
                for (s, fixed_part) in fixed_part.iter().enumerate() {
                    let a = raw[i * k + s];
                    for (column_products, fixed_part) in column_products.iter_mut().zip(&fixed_part[index]) {
                        for n in 0..LANE_COUNT {
                            column_products[n] -= a * fixed_part[n];
                        }
                    }
                }
                for column_products in &mut column_products {
                    column_products.iter_mut().for_each(|v| *v *= scale[i]);
                }
                let mut distance = remaining.distance_to_fixed_output_column(r, g, column);
                orthogonal_norm.iter_mut().for_each(|v| *v *= scale[i]);
                distance.iter_mut().for_each(|v| *v *= scale[i] * normal.inverse()[column]);
                for values in column_products.iter().chain([&orthogonal_norm, &distance]) {
                    for n in 0..LANE_COUNT {
                        finite_check[n] += 0.0 * values[n];
                    }
                }
                responses.push(column_products);
                rests.push([orthogonal_norm, distance]);
            }
        }
        // Reject NaN and infinity: their product with 0 is NaN.
        if finite_check.iter().any(|v| v.is_nan()) {
            return None;
        }
        let mut side = Self {
            columns,
            scale,
            target,
            fixed_products,
            fixed_coefficients,
            joint_coefficients,
            vector_products: responses,
            levels: Vec::new(),
        };
        side.build(k, groups, &rests);
        Some(side)
    }

    /// Compute the maxima over intervals of 1, 2, 4, … grid values, for `k` fixed-order columns. `orthogonal_norms`
    /// contains the norms of [`Node`] that are not second differences, by grid value, then by group of test vectors.
    #[inline(always)]
    fn build(&mut self, k: usize, groups: usize, orthogonal_norms: &[[Wide; 2]]) {
        let n = self.columns.len();
        let second_difference = |values: &[f64], stride: usize, offset: usize, i: usize| -> f64 {
            let v = |i: usize| values[i * stride + offset];
            ((v(i - 1) - v(i)) + (v(i + 1) - v(i))).abs()
        };
        let vector_differences = |i: usize, g: usize| -> [Wide; 2] {
            let (a, b, c) = (
                &self.vector_products[(i - 1) * groups + g],
                &self.vector_products[i * groups + g],
                &self.vector_products[(i + 1) * groups + g],
            );
            let mut out = [ZERO_LANES; 2];
            for half in 0..2 {
                for n in 0..LANE_COUNT {
                    let re = (a[2 * half][n] - b[2 * half][n]) + (c[2 * half][n] - b[2 * half][n]);
                    let im = (a[2 * half + 1][n] - b[2 * half + 1][n]) + (c[2 * half + 1][n] - b[2 * half + 1][n]);
                    out[half][n] = (re * re + im * im).sqrt();
                }
            }
            out
        };
        let mut levels = vec![Level {
            coefficient_sums: (0..n)
                .map(|i| {
                    let fixed_coefficients: f64 =
                        self.fixed_coefficients[i * k..(i + 1) * k].iter().map(|m| m.abs()).sum();
                    CoefficientSums { sum: self.scale[i] + fixed_coefficients }
                })
                .collect(),
            fixed_coefficients: vec![0.0; n * k],
            nodes: orthogonal_norms
                .iter()
                .map(|&[orthogonal_norm, distance]| Node {
                    second_differences: [ZERO_LANES, ZERO_LANES, orthogonal_norm, distance],
                })
                .collect(),
        }];
        let mut length = 1;
        while length < n {
            let below = &levels[levels.len() - 1];
            let halves = n.div_ceil(length);
            let count = n.div_ceil(2 * length);
            let mut level = Level {
                coefficient_sums: Vec::with_capacity(count),
                fixed_coefficients: Vec::with_capacity(count * k),
                nodes: Vec::with_capacity(count * groups),
            };
            for node in 0..count {
                let (left, right) = (2 * node, 2 * node + 1);
                let mut coefficient_sum = below.coefficient_sums[left];
                let start = level.fixed_coefficients.len();
                level.fixed_coefficients.extend_from_slice(&below.fixed_coefficients[left * k..(left + 1) * k]);
                if right < halves {
                    // The last value of the left half and the first value of the right half become interior values,
                    // except at the end.
                    let boundary = right * length;
                    let is_interior = |i: usize| i > left * length && i + 1 < n.min((right + 1) * length);
                    coefficient_sum.sum = coefficient_sum.sum.max(below.coefficient_sums[right].sum);
                    for s in 0..k {
                        let mut value =
                            level.fixed_coefficients[start + s].max(below.fixed_coefficients[right * k + s]);
                        for i in [boundary - 1, boundary] {
                            if is_interior(i) {
                                value = value.max(second_difference(&self.fixed_coefficients, k, s, i));
                            }
                        }
                        level.fixed_coefficients[start + s] = value;
                    }
                    for g in 0..groups {
                        let mut node = below.nodes[left * groups + g];
                        let mut include_maximum = |part: usize, values: &Wide| {
                            for (maximum, value) in node.second_differences[part].iter_mut().zip(values) {
                                *maximum = maximum.max(*value);
                            }
                        };
                        let other = &below.nodes[right * groups + g];
                        (0..4).for_each(|part| include_maximum(part, &other.second_differences[part]));
                        for i in [boundary - 1, boundary] {
                            if is_interior(i) {
                                let [a, b] = vector_differences(i, g);
                                include_maximum(0, &a);
                                include_maximum(1, &b);
                            }
                        }
                        level.nodes.push(node);
                    }
                } else {
                    level.nodes.extend_from_slice(&below.nodes[left * groups..(left + 1) * groups]);
                }
                level.coefficient_sums.push(coefficient_sum);
            }
            levels.push(level);
            length *= 2;
        }
        self.levels = levels;
    }
}

/// Iterate over all groups of test vectors as pairs (record, group).
pub(super) fn vector_groups(test_vectors: &[TestVectors]) -> impl Iterator<Item = (usize, usize)> + '_ {
    test_vectors.iter().enumerate().flat_map(|(r, test_vectors)| (0..test_vectors.groups).map(move |g| (r, g)))
}

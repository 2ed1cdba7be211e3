//! Axis tables of one order of a slice: projections, coefficients and deviations from linearity.
//!
//! For each value of the order, û is its column x, orthogonal to the remaining columns of the slice and scaled to unit
//! norm. Over an interval any quantity deviates from linear interpolation between the ends by at most one eighth of the
//! squared length times the largest second difference: f_i − l_i = −Σ_j G_ij Δ²f_j with 0 ≤ G and Σ_j G_ij = (i −
//! lo)(hi − i)/2.

use crate::order_search::candidate::normal_equations::Normal;
use crate::order_search::dual_bound::test_vectors::{TestVectors, NO_INDEX};
use crate::simd::LANE_COUNT;

/// Vector of one value for each of [`LANE_COUNT`] test vectors.
pub(super) type Wide = [f64; LANE_COUNT];
pub(super) const ZERO_LANES: Wide = [0.0; LANE_COUNT];

/// Products of a column x with test vectors t: ⟨t, x⟩ and g‖t‖, each as real and imaginary part.
pub(super) type VectorProducts = [Wide; 4];

/// Largest values and second differences over an interval of 2^l values of an order.
#[derive(Debug, Clone, Copy)]
pub(super) struct Node {
    /// Largest second differences of ⟨t, û⟩ and of g‖t‖ along the axis. Here t is a test vector, û the normalized
    /// column of this order, and g the projection of Fᵀt on t.
    pub(super) second_differences: [Wide; 4],
}

/// Largest sums of coefficients over an interval of values.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CoefficientSums {
    /// Maximum over the interval of Σ|c|, where c are the coefficients of û.
    pub(super) sum: f64,
}

/// Intervals of one length along an order.
pub(super) struct Level {
    pub(super) coefficient_sums: Vec<CoefficientSums>,
    /// Largest second differences of the coefficients of û on the remaining columns, k per interval.
    pub(super) mixed: Vec<f64>,
    /// Nodes by interval, then by group of test vectors.
    pub(super) nodes: Vec<Node>,
}

/// Columns of a slice whose orders do not vary.
pub(super) struct RemainingColumns<'a> {
    pub(super) normal: &'a Normal,
    pub(super) test_vectors: &'a [TestVectors],
    /// Positions of the remaining columns.
    pub(super) columns: &'a [usize],
    pub(super) inverse: &'a [f64],
    /// Trace of `inverse`.
    pub(super) trace: f64,
    /// Rounding-error bound of a product of unit columns.
    pub(super) rounding: f64,
    /// Index in `columns` of a column of the output itself, if there is one. Its coefficient and the coefficient of a
    /// varying output column may cancel.
    pub(super) partner: Option<usize>,
}

impl RemainingColumns<'_> {
    /// Solve for the coefficients of a column on the remaining columns, given its products with them.
    pub(super) fn solve(&self, products: &[f64], out: &mut [f64]) {
        let k = self.columns.len();
        for (i, out) in out.iter_mut().enumerate() {
            *out = (0..k).map(|j| self.inverse[i * k + j] * products[j]).sum();
        }
    }

    /// Upper bound of ‖(Fᵀt − g t) − (Fₚᵀt − gₚ t)‖ for each test vector t of a group. F is the convolution matrix of
    /// an output column, g the projection of Fᵀt on t, and Fₚ, gₚ belong to the remaining output column `partner`. The
    /// bound is zero if `column` is not an output column or there is no partner.
    #[inline(always)]
    fn distance_to_partner(&self, record: usize, group: usize, column: usize) -> Wide {
        let probes = &self.test_vectors[record];
        let (mut way, row) = (ZERO_LANES, probes.rows[column]);
        if let Some(partner) = self.partner.filter(|_| row != NO_INDEX) {
            let at = |row: usize| &probes.effects[row * probes.groups + group][3];
            let (a, b) = (at(row), at(probes.rows[self.columns[partner]]));
            for n in 0..LANE_COUNT {
                way[n] = (a[n] - b[n]).abs();
            }
        }
        way
    }

    /// Products ⟨t, x⟩ and g‖t‖ of a unit column x with a group of test vectors t, and ‖Fᵀt − g t‖.
    #[inline(always)]
    pub(super) fn vector_products(&self, record: usize, group: usize, column: usize) -> (VectorProducts, Wide) {
        let probes = &self.test_vectors[record];
        let inverse = self.normal.inverse()[column];
        let [re, im] = &probes.products[column * probes.groups + group];
        let row = probes.rows[column];
        let (mut products, mut rest) = ([ZERO_LANES; 4], ZERO_LANES);
        for n in 0..LANE_COUNT {
            products[0][n] = re[n] * inverse;
            products[1][n] = im[n] * inverse;
        }
        if row != NO_INDEX {
            let [a, b, c, _] = &probes.effects[row * probes.groups + group];
            for n in 0..LANE_COUNT {
                products[2][n] = a[n] * inverse;
                products[3][n] = b[n] * inverse;
                rest[n] = c[n] * inverse;
            }
        }
        (products, rest)
    }
}

/// Tables along one order of a slice.
pub(super) struct AxisTable {
    pub(super) columns: Vec<usize>,
    /// Inverse norm of each column x after projection, which scales it to û.
    pub(super) scale: Vec<f64>,
    pub(super) target: Vec<f64>,
    /// Products of each column with the remaining columns, k per value.
    pub(super) shared: Vec<f64>,
    pub(super) mixed: Vec<f64>,
    /// Sum of the coefficient of û on the remaining output column `partner` and its coefficient on x. Empty without a
    /// partner.
    pub(super) paired: Vec<f64>,
    /// Products with test vectors, by value, then by group of test vectors.
    pub(super) vector_products: Vec<VectorProducts>,
    pub(super) levels: Vec<Level>,
}

impl AxisTable {
    /// Build the tables for these columns. `None` if a column is nearly a combination of the remaining columns.
    #[inline(always)]
    pub(super) fn new(others: &RemainingColumns<'_>, columns: Vec<usize>) -> Option<Self> {
        let (k, n, normal) = (others.columns.len(), columns.len(), others.normal);
        let (mut scale, mut target, mut shared) = (vec![0.0; n], vec![0.0; n], vec![0.0; n * k]);
        let (mut mixed, mut raw) = (vec![0.0; n * k], vec![0.0; n * k]);
        for (i, &column) in columns.iter().enumerate() {
            let (shared, raw) = (&mut shared[i * k..(i + 1) * k], &mut raw[i * k..(i + 1) * k]);
            for (g, &s) in shared.iter_mut().zip(others.columns) {
                *g = normal.product(s, column);
            }
            others.solve(shared, raw);
            let remainder = 1.0 - shared.iter().zip(raw.iter()).map(|(g, a)| g * a).sum::<f64>();
            let sum = 1.0 + raw.iter().map(|a| a.abs()).sum::<f64>();
            // This also rejects NaN.
            if remainder.is_nan() || remainder <= 1e3 * others.rounding * others.trace * sum * sum {
                return None;
            }
            scale[i] = 1.0 / remainder.sqrt();
            let along: f64 = raw.iter().zip(others.columns).map(|(a, &s)| a * normal.rhs()[s]).sum();
            target[i] = (normal.rhs()[column] - along) * scale[i];
            for (m, a) in mixed[i * k..(i + 1) * k].iter_mut().zip(raw.iter()) {
                *m = a * scale[i];
            }
        }
        let groups: usize = others.test_vectors.iter().map(|p| p.groups).sum();
        let mut responses = Vec::with_capacity(n * groups);
        let mut rests = Vec::with_capacity(n * groups);
        let mut sound = ZERO_LANES;
        let mut paired = Vec::new();
        if let Some(partner) = others.partner {
            let inverse = normal.inverse();
            let own =
                others.test_vectors.first().is_some_and(|probes| columns.iter().all(|&p| probes.rows[p] != NO_INDEX));
            paired.extend(columns.iter().enumerate().map(|(i, &p)| {
                let alone = if own { scale[i] * inverse[p] / inverse[others.columns[partner]] } else { 0.0 };
                mixed[i * k + partner] - alone
            }));
        }
        let along: Vec<Vec<VectorProducts>> = others
            .columns
            .iter()
            .map(|&s| vector_groups(others.test_vectors).map(|(r, g)| others.vector_products(r, g, s).0).collect())
            .collect();
        for (i, &column) in columns.iter().enumerate() {
            for (at, (r, g)) in vector_groups(others.test_vectors).enumerate() {
                let (mut column_products, mut rest) = others.vector_products(r, g, column);
                for (s, along) in along.iter().enumerate() {
                    let a = raw[i * k + s];
                    for (column_products, along) in column_products.iter_mut().zip(&along[at]) {
                        for n in 0..LANE_COUNT {
                            column_products[n] -= a * along[n];
                        }
                    }
                }
                for column_products in &mut column_products {
                    column_products.iter_mut().for_each(|v| *v *= scale[i]);
                }
                let mut way = others.distance_to_partner(r, g, column);
                rest.iter_mut().for_each(|v| *v *= scale[i]);
                way.iter_mut().for_each(|v| *v *= scale[i] * normal.inverse()[column]);
                for values in column_products.iter().chain([&rest, &way]) {
                    for n in 0..LANE_COUNT {
                        sound[n] += 0.0 * values[n];
                    }
                }
                responses.push(column_products);
                rests.push([rest, way]);
            }
        }
        // Reject NaN and infinity, whose multiple by 0 is NaN.
        if sound.iter().any(|v| v.is_nan()) {
            return None;
        }
        let mut side =
            Self { columns, scale, target, shared, mixed, paired, vector_products: responses, levels: Vec::new() };
        side.build(k, groups, &rests);
        Some(side)
    }

    /// Build the levels of intervals with 1, 2, 4, … values, for `k` remaining columns.
    #[inline(always)]
    fn build(&mut self, k: usize, groups: usize, rests: &[[Wide; 2]]) {
        let n = self.columns.len();
        let apart = |values: &[f64], stride: usize, at: usize, i: usize| -> f64 {
            let v = |i: usize| values[i * stride + at];
            ((v(i - 1) - v(i)) + (v(i + 1) - v(i))).abs()
        };
        let bent = |i: usize, g: usize| -> [Wide; 2] {
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
                    let mixed: f64 = self.mixed[i * k..(i + 1) * k].iter().map(|m| m.abs()).sum();
                    CoefficientSums { sum: self.scale[i] + mixed }
                })
                .collect(),
            mixed: vec![0.0; n * k],
            nodes: rests
                .iter()
                .map(|&[rest, way]| Node { second_differences: [ZERO_LANES, ZERO_LANES, rest, way] })
                .collect(),
        }];
        let mut length = 1;
        while length < n {
            let below = &levels[levels.len() - 1];
            let halves = n.div_ceil(length);
            let count = n.div_ceil(2 * length);
            let mut level = Level {
                coefficient_sums: Vec::with_capacity(count),
                mixed: Vec::with_capacity(count * k),
                nodes: Vec::with_capacity(count * groups),
            };
            for node in 0..count {
                let (left, right) = (2 * node, 2 * node + 1);
                let mut all = below.coefficient_sums[left];
                let start = level.mixed.len();
                level.mixed.extend_from_slice(&below.mixed[left * k..(left + 1) * k]);
                if right < halves {
                    // The last value of the left half and the first of the right half become inner values, except at
                    // the end.
                    let joint = right * length;
                    let inner = |i: usize| i > left * length && i + 1 < n.min((right + 1) * length);
                    all.sum = all.sum.max(below.coefficient_sums[right].sum);
                    for s in 0..k {
                        let mut value = level.mixed[start + s].max(below.mixed[right * k + s]);
                        for i in [joint - 1, joint] {
                            if inner(i) {
                                value = value.max(apart(&self.mixed, k, s, i));
                            }
                        }
                        level.mixed[start + s] = value;
                    }
                    for g in 0..groups {
                        let mut node = below.nodes[left * groups + g];
                        let mut most = |part: usize, with: &Wide| {
                            for (most, with) in node.second_differences[part].iter_mut().zip(with) {
                                *most = most.max(*with);
                            }
                        };
                        let other = &below.nodes[right * groups + g];
                        (0..4).for_each(|part| most(part, &other.second_differences[part]));
                        for i in [joint - 1, joint] {
                            if inner(i) {
                                let [a, b] = bent(i, g);
                                most(0, &a);
                                most(1, &b);
                            }
                        }
                        level.nodes.push(node);
                    }
                } else {
                    level.nodes.extend_from_slice(&below.nodes[left * groups..(left + 1) * groups]);
                }
                level.coefficient_sums.push(all);
            }
            levels.push(level);
            length *= 2;
        }
        self.levels = levels;
    }
}

/// All groups of test vectors as (record, group number).
pub(super) fn vector_groups(probes: &[TestVectors]) -> impl Iterator<Item = (usize, usize)> + '_ {
    probes.iter().enumerate().flat_map(|(r, probes)| (0..probes.groups).map(move |g| (r, g)))
}

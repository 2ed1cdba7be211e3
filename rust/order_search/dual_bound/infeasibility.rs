//! Proofs of infeasibility: no coefficients reduce the output error of a candidate to the limit.
//!
//! They are used before the coefficients of a candidate are refined. Let t be a test vector and w the equation error.
//! Let d = 1 − Σ c g and S = Σ |c_i| ρ_i over the output terms with coefficients c and convolution matrices F. Here g
//! is the projection of Fᵀt on t, and ρ = ‖Fᵀt − g t‖. By the dual bound, an error norm of at most L requires |⟨t, w⟩|²
//! ≤ L²(|d|‖t‖ + S)² for every t. With a = |d|‖t‖,
//!
//!   (a + S)² ≤ (1+κ)a² + (1+1/κ)S², S² ≤ Σ c_i²ρ_i²/p_i for any κ, p_i > 0 with Σ p_i = 1.
//!
//! Each condition therefore implies that a quadratic form in (c, 1) is not positive. If a sum of these forms with
//! positive weights (the multipliers) is positive definite, no coefficients satisfy all conditions.

use crate::linalg::small::packed_index;
use crate::order_search::dual_bound::test_vectors::{TestVectors, Wide, NO_INDEX};
use crate::simd::LANE_COUNT;

/// Maximum number of iterations in the search for multipliers. Three suffice on average.
const MAX_MULTIPLIER_STEPS: usize = 12;
/// Relative rounding margin of a diagonal element of a k × k form. It exceeds the rounding error, about k² ε, by a
/// safety factor.
const DEFINITENESS_MARGIN: f64 = 1e-12;

/// Contribution of one unknown coefficient to the conditions |⟨t, w⟩| ≤ L(|d|‖t‖ + S) of a group of test vectors t.
/// `error` is its part of ⟨t, w⟩/L, and `divisor` its part of d‖t‖, each as real and imaginary part. `slack` is its
/// part of S with rounding errors. Here w is the equation error, and L is the limit of the error norm. The sums d = 1 −
/// Σ c g and S = Σ |c| ‖Fᵀt − g t‖ are over output terms with coefficient c and convolution matrix F. The number g is
/// the projection of Fᵀt on t.
#[derive(Debug, Clone, Copy)]
struct Effect {
    error: [Wide; 2],
    divisor: [Wide; 2],
    slack: Wide,
}

/// Contribution of an unknown that does not enter the conditions.
const NO_EFFECT: Effect =
    Effect { error: [[0.0; LANE_COUNT]; 2], divisor: [[0.0; LANE_COUNT]; 2], slack: [0.0; LANE_COUNT] };

/// Workspace of an infeasibility proof, reused for all candidates.
#[derive(Default)]
pub(crate) struct InfeasibilityProof {
    /// Number of unknown coefficients, plus one for the constant 1, which comes last.
    unknowns: usize,
    /// Contribution of unknown coefficient i to the conditions of group g of test vectors, at index g·unknowns + i.
    effects: Vec<Effect>,
    /// Current values of the unknown coefficients, then the constant 1.
    values: Vec<f64>,
    /// Multiplier of the condition of each test vector, by group.
    weights: Vec<Wide>,
    /// Lower triangle of the weighted sum of the quadratic forms, row-major.
    form: Vec<f64>,
    /// Part of `form` from the squared moduli of the products of test vectors with the equation error, in the same
    /// layout.
    errors: Vec<f64>,
    /// Sum of the moduli of all contributions to each diagonal element of `form`.
    sizes: Vec<f64>,
    /// Factor L D Lᵀ of a quadratic form: lower triangle, row-major.
    factor: Vec<f64>,
}

impl InfeasibilityProof {
    /// Set up the conditions on the unknown coefficients that follow from an error norm of at most `limit`. The
    /// arguments are as in
    /// [`Bound::proves_infeasible`](crate::order_search::dual_bound::lower_bound::Bound::proves_infeasible).
    #[inline(always)]
    pub(super) fn set_conditions(
        &mut self,
        test_vectors: &[TestVectors],
        limit: f64,
        terms: &[usize],
        fixed: &[Option<f64>],
        initial: &[usize],
        start: &[f64],
    ) {
        let free = fixed.iter().filter(|f| f.is_none()).count();
        let last = free + initial.len() * test_vectors.len();
        self.unknowns = last + 1;
        self.effects.clear();
        for (r, test_vectors) in test_vectors.iter().enumerate() {
            // Margin for the rounding of the divisor and of the score.
            let scale = 1.0 / (limit * (1.0 + test_vectors.unit));
            for group in 0..test_vectors.groups {
                let first = self.effects.len();
                self.effects.resize(first + self.unknowns, NO_EFFECT);
                let effects = &mut self.effects[first..];
                let column = |p: usize, c: f64| -> Effect {
                    let [re, im] = &test_vectors.products[p * test_vectors.groups + group];
                    let mut effect = NO_EFFECT;
                    for n in 0..LANE_COUNT {
                        effect.error[0][n] = -c * re[n] * scale;
                        effect.error[1][n] = -c * im[n] * scale;
                        effect.slack[n] = c.abs() * test_vectors.rounding[p] * scale;
                    }
                    let row = test_vectors.rows[p];
                    if row != NO_INDEX {
                        let [re, im, rest, _] = &test_vectors.effects[row * test_vectors.groups + group];
                        for n in 0..LANE_COUNT {
                            effect.divisor[0][n] = -c * re[n];
                            effect.divisor[1][n] = -c * im[n];
                            effect.slack[n] += c.abs() * rest[n];
                        }
                    }
                    effect
                };
                let mut constant = NO_EFFECT;
                for n in 0..LANE_COUNT {
                    constant.error[0][n] = test_vectors.target[group][0][n] * scale;
                    constant.error[1][n] = test_vectors.target[group][1][n] * scale;
                    constant.divisor[0][n] = test_vectors.size[group][n];
                    constant.slack[n] = test_vectors.target_rounding * scale;
                }
                let mut next = 0;
                for (&p, value) in terms.iter().zip(fixed) {
                    match *value {
                        Some(c) => {
                            let effect = column(p, c);
                            for half in 0..2 {
                                for n in 0..LANE_COUNT {
                                    constant.error[half][n] += effect.error[half][n];
                                    constant.divisor[half][n] += effect.divisor[half][n];
                                }
                            }
                            for n in 0..LANE_COUNT {
                                constant.slack[n] += effect.slack[n];
                            }
                        }
                        None => {
                            effects[next] = column(p, 1.0);
                            next += 1;
                        }
                    }
                }
                for (i, &p) in initial.iter().enumerate() {
                    effects[free + r * initial.len() + i] = column(p, 1.0);
                }
                effects[last] = constant;
            }
        }
        self.values.clear();
        self.values.extend(start.iter().zip(fixed).filter(|(_, f)| f.is_none()).map(|(x, _)| *x));
        self.values.extend(&start[fixed.len()..]);
        self.values.push(1.0);
    }

    /// Search for multipliers of the conditions for which the weighted sum of their quadratic forms is positive
    /// definite, and return true if they are found. Each step moves to the minimizer of the form and increases the
    /// multipliers of the conditions that are violated there. Return false if no condition is violated, a value is not
    /// finite, or the maximum number of steps is reached.
    #[inline(always)]
    pub(super) fn find_multipliers(&mut self) -> bool {
        let k = self.unknowns;
        let groups = self.effects.len() / k;
        self.weights.clear();
        for step in 0..MAX_MULTIPLIER_STEPS {
            let smallest = 1e-6 * self.values.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
            if !smallest.is_finite() {
                return false;
            }
            let states: Vec<[Wide; 3]> = (0..groups).map(|g| self.state(g)).collect();
            let mut max_violation = 0.0_f64;
            for [ratios, _, _] in &states {
                for &q in ratios {
                    if q.is_nan() {
                        return false;
                    }
                    max_violation = max_violation.max(q);
                }
            }
            // No condition is violated at this point.
            if max_violation <= 1.0 || max_violation.is_infinite() {
                return false;
            }
            if step == 0 {
                self.weights.extend(states.iter().map(|[_, size, slack]| {
                    let mut weight = [0.0; LANE_COUNT];
                    for n in 0..LANE_COUNT {
                        let all = size[n] + slack[n];
                        weight[n] = 1.0 / (all * all);
                    }
                    weight
                }));
            }
            for (weight, [ratios, _, _]) in self.weights.iter_mut().zip(&states) {
                for n in 0..LANE_COUNT {
                    weight[n] *= (ratios[n] / max_violation + 1e-3).sqrt();
                }
            }
            self.assemble(&states, smallest);
            if !self.form.iter().chain(&self.errors).all(|v| v.is_finite()) {
                return false;
            }
            let convex = factorize(&self.form, k, &mut self.factor);
            if convex == k {
                return true;
            }
            if convex < k - 1 && factorize(&self.errors, k, &mut self.factor) < k - 1 {
                return false;
            }
            self.values[k - 1] = 1.0;
            for i in (0..k - 1).rev() {
                let mut value = -self.factor[packed_index(k - 1, i)];
                for j in i + 1..k - 1 {
                    value -= self.factor[packed_index(j, i)] * self.values[j];
                }
                self.values[i] = value;
            }
        }
        false
    }

    /// Return three values for each condition |⟨t, w⟩|/L ≤ |d|‖t‖ + S of one group of test vectors t, at the current
    /// values of the unknowns. They are the squared ratio of the left side to the right side, |d|‖t‖, and S, as in
    /// [`Effect`].
    #[inline(always)]
    fn state(&self, group: usize) -> [Wide; 3] {
        let zero = [0.0; LANE_COUNT];
        let (mut error, mut divisor, mut slack) = ([zero; 2], [zero; 2], zero);
        for (effect, &x) in self.effects[group * self.unknowns..(group + 1) * self.unknowns].iter().zip(&self.values) {
            for n in 0..LANE_COUNT {
                error[0][n] += x * effect.error[0][n];
                error[1][n] += x * effect.error[1][n];
                divisor[0][n] += x * effect.divisor[0][n];
                divisor[1][n] += x * effect.divisor[1][n];
                slack[n] += x.abs() * effect.slack[n];
            }
        }
        let (mut ratios, mut size) = (zero, zero);
        for n in 0..LANE_COUNT {
            size[n] = (divisor[0][n] * divisor[0][n] + divisor[1][n] * divisor[1][n]).sqrt();
            let limit = size[n] + slack[n];
            ratios[n] = (error[0][n] * error[0][n] + error[1][n] * error[1][n]) / (limit * limit);
        }
        [ratios, size, slack]
    }

    /// Assemble the weighted sum of the quadratic forms. The free parameters of the underlying inequalities are chosen
    /// so that equality holds at the current point. `smallest` is a lower bound for the modulus of an unknown.
    #[inline(always)]
    fn assemble(&mut self, states: &[[Wide; 3]], smallest: f64) {
        let k = self.unknowns;
        self.form.clear();
        self.form.resize(packed_index(k, 0), 0.0);
        self.errors.clear();
        self.errors.resize(packed_index(k, 0), 0.0);
        self.sizes.clear();
        self.sizes.resize(k, 0.0);
        for (g, (weight, [_, size, slack])) in self.weights.iter().zip(states).enumerate() {
            let effects = &self.effects[g * k..(g + 1) * k];
            let (mut fixed_sum, mut free_sum, mut total) = ([0.0; LANE_COUNT], [0.0; LANE_COUNT], [0.0; LANE_COUNT]);
            for (effect, x) in effects.iter().zip(&self.values) {
                for (sum, slack) in total.iter_mut().zip(&effect.slack) {
                    *sum += slack * x.abs().max(smallest);
                }
            }
            for n in 0..LANE_COUNT {
                let kappa = (slack[n] / size[n]).clamp(1e-6, 1e6);
                fixed_sum[n] = weight[n] * (1.0 + kappa);
                free_sum[n] = weight[n] * (1.0 + 1.0 / kappa) * total[n];
            }
            for (i, a) in effects.iter().enumerate() {
                let (mut lhs, mut right) = ([[0.0; LANE_COUNT]; 2], [[0.0; LANE_COUNT]; 2]);
                for half in 0..2 {
                    for n in 0..LANE_COUNT {
                        lhs[half][n] = weight[n] * a.error[half][n];
                        right[half][n] = fixed_sum[n] * a.divisor[half][n];
                    }
                }
                for (j, b) in effects[..=i].iter().enumerate() {
                    let (mut errors, mut divisors) = ([0.0; LANE_COUNT], [0.0; LANE_COUNT]);
                    for n in 0..LANE_COUNT {
                        errors[n] = lhs[0][n] * b.error[0][n] + lhs[1][n] * b.error[1][n];
                        divisors[n] = right[0][n] * b.divisor[0][n] + right[1][n] * b.divisor[1][n];
                    }
                    let (errors, divisors) = (errors.iter().sum::<f64>(), divisors.iter().sum::<f64>());
                    self.errors[packed_index(i, j)] += errors;
                    self.form[packed_index(i, j)] += errors - divisors;
                    if i == j {
                        self.sizes[i] += errors + divisors;
                    }
                }
                let slacks = free_sum.iter().zip(&a.slack).map(|(r, s)| r * s).sum::<f64>();
                let slacks = slacks / self.values[i].abs().max(smallest);
                self.form[packed_index(i, i)] -= slacks;
                self.sizes[i] += slacks;
            }
        }
        for i in 0..k {
            self.form[packed_index(i, i)] -= DEFINITENESS_MARGIN * self.sizes[i];
            self.errors[packed_index(i, i)] += DEFINITENESS_MARGIN * self.sizes[i];
        }
    }
}

/// Factor a symmetric k × k matrix, given by the rows of its lower triangle, into L D Lᵀ. Return the number of leading
/// positive pivots. The rows of L are valid up to and including the first nonpositive pivot.
#[inline(always)]
fn factorize(matrix: &[f64], k: usize, factor: &mut Vec<f64>) -> usize {
    factor.clear();
    factor.extend_from_slice(matrix);
    for i in 0..k {
        let mut pivot = factor[packed_index(i, i)];
        for j in 0..i {
            let mut sum = factor[packed_index(i, j)];
            for l in 0..j {
                sum -= factor[packed_index(i, l)] * factor[packed_index(j, l)] * factor[packed_index(l, l)];
            }
            factor[packed_index(i, j)] = sum / factor[packed_index(j, j)];
            pivot -= sum * factor[packed_index(i, j)];
        }
        // This form of the condition rejects a NaN pivot.
        if !(pivot > 0.0 && pivot.is_finite()) {
            return i;
        }
        factor[packed_index(i, i)] = pivot;
    }
    k
}

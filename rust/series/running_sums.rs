//! Solution of systems of integrals of integer order by running sums instead of transforms. O(n² K) per term for n
//! equations and K sums.
//!
//! In pulse means with the sampling interval h, the integral I^η of integer order η is h^η/(η+1)!·A(z)/(1−z)^η. Here z
//! is the one-step delay, and A is an Eulerian polynomial of degree η. In powers of 1−z it is a combination of running
//! sums Q^l, Q = 1/(1−z), l = 0 … η. A system of such integrals is thus y = G₀ + Q(G₁ + Q(G₂ + …)), where each G_l is
//! linear in the unknowns and the inputs. It needs one state per sum. The sums have the magnitude of the outputs,
//! unlike the terms of a difference equation in y.

use crate::error::{check_length, Error, Result};
use crate::linalg::small;
use crate::simd::{dispatch_simd, SimdKernel};

/// Maximum order of an integral. For higher orders, transforms are as fast.
pub const MAX_SUMS: usize = 6;

/// Number of right-hand sides solved in parallel SIMD lanes, which hides the latency of the recursion.
pub const RIGHT_SIDE_LANES: usize = 4;

/// Number of terms that are processed in one chunk. The inputs of a chunk stay in the cache.
const CHUNK_TERMS: usize = 256;

/// Return the weights of the running sums Q^0 … Q^η in the integral I^η of pulse means, with Q = 1/(1 − z) and the
/// one-step delay z. `step` is the sampling interval h.
///
/// By Frobenius' identity the weights are h^η/(η+1)!·(−1)^{η−l}·(l+1)!·S(η+1, l+1), l = 0 … η, with Stirling numbers S
/// of the second kind.
///
/// ```
/// // I^1 of a pulse: half of it within the pulse, all of it in every later one.
/// assert_eq!(ftlm::series::running_sums(1, 0.1), [-0.05, 0.1]);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn running_sums(eta: usize, step: f64) -> Vec<f64> {
    // S(η+1, l+1), row by row.
    let mut stirling = vec![1.0];
    for row in 1..=eta {
        let mut next = vec![0.0; row + 1];
        for (l, value) in next.iter_mut().enumerate() {
            let same_column_part = stirling.get(l).map_or(0.0, |s| (l + 1) as f64 * s);
            *value = same_column_part + if l > 0 { stirling[l - 1] } else { 0.0 };
        }
        stirling = next;
    }
    let scale = (1..=eta).fold(1.0, |product, k| product * step / (k + 1) as f64);
    let mut factorial = 1.0;
    let mut weights = Vec::with_capacity(eta + 1);
    for (l, stirling_number) in stirling.iter().enumerate() {
        factorial *= (l + 1) as f64;
        let sign = if (eta - l).is_multiple_of(2) { 1.0 } else { -1.0 };
        weights.push(scale * sign * factorial * stirling_number);
    }
    weights
}

/// Input of one equation: `weight` times the integral I^`order` of a series.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// Index of the equation.
    pub equation: usize,
    /// Integer order of the integral.
    pub order: usize,
    /// Coefficient of the integral.
    pub weight: f64,
    /// Samples of the input series.
    pub series: &'a [f64],
}

/// System y_i = Σ c·I^η y_j + inputs with integrals I^η of integer order, for any number of right-hand sides.
#[derive(Debug, Clone)]
pub struct RunningSumSystem {
    /// Number of equations.
    n: usize,
    /// Number of running sums of each equation.
    sums: usize,
    /// Sampling interval \[s\].
    step: f64,
    /// Weight of unknown j in running sum l of equation i, at index (i·(sums + 1) + l)·n + j for n equations.
    unknown_weights: Vec<f64>,
    /// Inverse of the matrix of leading coefficients, row-major.
    inverse: Vec<f64>,
}

impl RunningSumSystem {
    /// Build a system of n equations from terms (i, j, η, c), each for c·I^η y_j in equation i. `sums` is the highest η
    /// of terms and inputs, and `step` the sampling interval.
    ///
    /// # Errors
    /// [`Error::LeadingZero`] if the matrix of leading coefficients is singular. [`Error::Structure`] for an order
    /// above `sums`, or for `sums` above [`MAX_SUMS`].
    pub fn new(n: usize, sums: usize, step: f64, terms: &[(usize, usize, usize, f64)]) -> Result<Self> {
        let highest = terms.iter().map(|&(.., order, _)| order).max().unwrap_or(0);
        if highest > sums || sums > MAX_SUMS {
            let what = format!("integrals of order {highest} by {sums} running sums");
            return Err(Error::Structure { what, remedy: format!("give the highest order, {MAX_SUMS} at most") });
        }
        let mut unknown_weights = vec![0.0; n * (sums + 1) * n];
        let mut leading: Vec<f64> = (0..n * n).map(|index| f64::from(u8::from(index / n == index % n))).collect();
        for &(i, j, order, c) in terms {
            for (l, weight) in running_sums(order, step).iter().enumerate() {
                unknown_weights[(i * (sums + 1) + l) * n + j] += c * weight;
            }
            leading[i * n + j] -= c * crate::fractional::kernels::first_coefficient(order_to_float(order), step);
        }
        Ok(Self { n, sums, step, unknown_weights, inverse: small::inverse(&leading, n)? })
    }

    /// Solve the system for each list of inputs. Return n unknown series of m terms per list.
    ///
    /// # Errors
    /// [`Error::Length`] for an input series shorter than m.
    ///
    /// # Panics
    /// If an input has an equation that does not exist or an order above the number of sums.
    pub fn solve(&self, m: usize, lists: &[Vec<Source>]) -> Result<Vec<Vec<Vec<f64>>>> {
        for source in lists.iter().flatten() {
            if source.series.len() < m {
                check_length("input series", m, source.series.len())?;
            }
        }
        if self.n > 1 {
            return Ok(lists.iter().map(|sources| self.solve_coupled(m, sources)).collect());
        }
        let solve = match self.sums {
            0 => Self::solve_one_unknown::<1>,
            1 => Self::solve_one_unknown::<2>,
            2 => Self::solve_one_unknown::<3>,
            3 => Self::solve_one_unknown::<4>,
            4 => Self::solve_one_unknown::<5>,
            5 => Self::solve_one_unknown::<6>,
            _ => Self::solve_one_unknown::<7>,
        };
        let solutions = lists.chunks(RIGHT_SIDE_LANES).flat_map(|group| solve(self, m, group));
        Ok(solutions.map(|solution| vec![solution]).collect())
    }

    /// Solve a system of one unknown for up to [`RIGHT_SIDE_LANES`] lists of inputs. L is the number of running sums
    /// plus one.
    fn solve_one_unknown<const L: usize>(&self, m: usize, lists: &[Vec<Source>]) -> Vec<Vec<f64>> {
        let mut unknown_weights = [0.0; L];
        unknown_weights.copy_from_slice(&self.unknown_weights[..L]);
        let weighted_inputs: Vec<Vec<(Vec<f64>, &[f64])>> = lists
            .iter()
            .map(|list| list.iter().map(|source| (self.weights(source), source.series)).collect())
            .collect();
        let mut out = vec![vec![0.0; m]; lists.len()];
        let mut states = [[0.0; RIGHT_SIDE_LANES]; L];
        let mut inputs = vec![[[0.0; RIGHT_SIDE_LANES]; L]; CHUNK_TERMS.min(m)];
        let mut solution = vec![[0.0; RIGHT_SIDE_LANES]; CHUNK_TERMS.min(m)];
        for start in (0..m).step_by(CHUNK_TERMS) {
            let length = CHUNK_TERMS.min(m - start);
            inputs[..length].fill([[0.0; RIGHT_SIDE_LANES]; L]);
            for (lane, sources) in weighted_inputs.iter().enumerate() {
                for (weights, series) in sources {
                    for (input, value) in inputs.iter_mut().zip(&series[start..start + length]) {
                        input.iter_mut().zip(weights).for_each(|(sum, w)| sum[lane] += w * value);
                    }
                }
            }
            let (inputs, solution) = (&inputs[..length], &mut solution[..length]);
            dispatch_simd(Block {
                unknown_weights: &unknown_weights,
                inverse: self.inverse[0],
                states: &mut states,
                inputs,
                solution,
            });
            for (lane, series) in out.iter_mut().enumerate() {
                series[start..start + length].iter_mut().zip(&*solution).for_each(|(value, y)| *value = y[lane]);
            }
        }
        out
    }

    /// Return the weights with which an input enters each running sum.
    fn weights(&self, source: &Source) -> Vec<f64> {
        running_sums(source.order, self.step).iter().map(|w| w * source.weight).collect()
    }

    /// Solve a system of several unknowns for one list of inputs. Return n series of m terms.
    fn solve_coupled(&self, m: usize, sources: &[Source]) -> Vec<Vec<f64>> {
        let (n, stride) = (self.n, self.sums + 1);
        // Inputs of each sum, term by term, then equation by equation.
        let mut inputs = vec![0.0; m * n * stride];
        for source in sources {
            let weights = self.weights(source);
            for (row, &value) in inputs.chunks_exact_mut(n * stride).zip(source.series) {
                let part = &mut row[source.equation * stride..][..weights.len()];
                part.iter_mut().zip(&weights).for_each(|(sum, w)| *sum += w * value);
            }
        }
        let mut out: Vec<Vec<f64>> = (0..n).map(|_| Vec::with_capacity(m)).collect();
        let (mut sums, mut known_sums, mut y) = (vec![0.0; n * stride], vec![0.0; n], vec![0.0; n]);
        for input in inputs.chunks_exact(n * stride) {
            for (i, sum) in known_sums.iter_mut().enumerate() {
                let index = i * stride;
                *sum = input[index] + (1..stride).map(|l| input[index + l] + sums[index + l]).sum::<f64>();
            }
            for (i, value) in y.iter_mut().enumerate() {
                *value = (0..n).map(|j| self.inverse[i * n + j] * known_sums[j]).sum();
                out[i].push(*value);
            }
            for i in 0..n {
                let mut higher_sum = 0.0;
                for l in (1..stride).rev() {
                    let index = i * stride + l;
                    let unknown_part: f64 = (0..n).map(|j| self.unknown_weights[index * n + j] * y[j]).sum();
                    sums[index] += input[index] + unknown_part + higher_sum;
                    higher_sum = sums[index];
                }
            }
        }
        out
    }
}

/// Solution for one unknown and [`RIGHT_SIDE_LANES`] right-hand sides over a chunk of terms. This task is compiled for
/// the widest vector instructions available.
struct Block<'a, const L: usize> {
    /// Weight of the unknown in each running sum.
    unknown_weights: &'a [f64; L],
    /// Reciprocal of the leading coefficient of the equation.
    inverse: f64,
    /// Values of the running sums, updated in place.
    states: &'a mut [[f64; RIGHT_SIDE_LANES]; L],
    /// Input of each running sum for each right-hand side, by term.
    inputs: &'a [[[f64; RIGHT_SIDE_LANES]; L]],
    /// Values of the unknown for each right-hand side, by term.
    solution: &'a mut [[f64; RIGHT_SIDE_LANES]],
}

impl<const L: usize> SimdKernel for Block<'_, L> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let mut states = *self.states;
        for (input, y) in self.inputs.iter().zip(self.solution) {
            let mut known_sum = input[0];
            for l in 1..L {
                for w in 0..RIGHT_SIDE_LANES {
                    known_sum[w] += input[l][w] + states[l][w];
                }
            }
            let mut higher_sum = [0.0; RIGHT_SIDE_LANES];
            for w in 0..RIGHT_SIDE_LANES {
                y[w] = self.inverse * known_sum[w];
            }
            for l in (1..L).rev() {
                for w in 0..RIGHT_SIDE_LANES {
                    states[l][w] += input[l][w] + self.unknown_weights[l] * y[w] + higher_sum[w];
                }
                higher_sum = states[l];
            }
        }
        *self.states = states;
    }
}

#[allow(clippy::cast_precision_loss)]
fn order_to_float(order: usize) -> f64 {
    order as f64
}

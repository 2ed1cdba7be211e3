//! Equations of integer orders in state space, and their exact discretization for inputs with a zero-order hold or a
//! first-order hold.
//!
//! An equation y = Σ c_k I^{η_k} s_k + Σ a_e t^e with integers η = α − ν and e is a chain of integrators. State j is
//! the integrand of the j-th integral: w_j′ = w_{j+1} + Σ c_k s_k over the terms with η_k = j. A term with η = 0 acts
//! on the output directly, and a power of t is the initial state w_{e+1} = a_e e!. With the outputs substituted this is
//! w′ = A w + B u, y = C w + D u. Over one sampling interval h,
//!
//! w(h) = w + (e^{hA} − I) w + φ₁(hA) hB u(0) + φ₂(hA) hB (u(h) − u(0)),
//! φ₁(z) = (e^z − 1)/z, φ₂(z) = (e^z − 1 − z)/z²,
//!
//! where the second input term exists for a linear input only. The recursion adds (e^{hA} − I) w to w. Scaling and
//! squaring computes this difference of matrices instead of e^{hA}. Slow modes therefore keep their accuracy next to
//! fast modes and at short steps (Higham, *Functions of Matrices*, 2008, sections 10.3 and 10.7).

use std::borrow::Cow;

use crate::equation::{check_regular, Equation, ORDER_GRAIN};
use crate::error::{check_finite, check_length, check_points, check_step, Error, Result};
use crate::linalg::{dense, small};
use crate::parallel::Stop;
use crate::signal::block_pulse::{delay_samples, delayed_row, Intersample};

/// Input of the equations, with its samples.
#[derive(Debug, Clone, PartialEq)]
pub struct InputSignal {
    /// Index of the signal in the equations.
    pub signal: usize,
    /// Samples, one per row of the record.
    pub samples: Vec<f64>,
    /// Inter-sample behavior. The samples of a linear signal are delayed first, and then interpolated linearly.
    pub intersample: Intersample,
    /// Delay in sampling intervals, which need not be an integer.
    pub delay: f64,
    /// Value of a delayed input before the record.
    pub before: f64,
}

/// Maximum number n of states. A step of the recursion costs O(n²).
const MAX_STATES: usize = 128;
/// Maximum condition number of the matrix of direct feedthrough terms. Above it, the orders of the system would depend
/// on a cancellation.
const MAX_CONDITION: f64 = 1e10;
/// Distance from the nearest integer at which a delay d in sampling intervals counts as an integer, relative to max(1,
/// d).
const DELAY_TOLERANCE: f64 = 1e-9;
/// Number of rows that are computed together. A stop request is checked after each such block.
const BLOCK_ROWS: usize = 1 << 10;
/// Magnitude below which a state is set to 0 at the next block, because arithmetic below 1e−308 is slow.
const MIN_STATE: f64 = 1e-290;
/// Number of Taylor terms for the matrix function φ₂(A), φ₂(z) = (e^z − 1 − z)/z², with ‖A‖ ≤ 1/2.
const TAYLOR_TERMS: i32 = 15;

/// Return exact samples of the outputs of equations with integer orders, concatenated: `rows` samples for each
/// equation.
///
/// The equations are simulated together. A signal that is neither output nor input is zero. A sample is the value just
/// after the inputs of its row have changed. `initial` holds (exponent, coefficient) pairs of powers of t by equation;
/// it is empty for zero initial conditions. An unstable model may overflow, so that values are not finite. The result
/// is None if direct feedthrough makes the equations (nearly) singular, with more than 128 states, or if the transition
/// over one interval overflows. O(n²) per row with n states.
///
/// # Errors
/// Errors for invalid equations, and for orders or exponents that are negative or not integers. Errors for samples that
/// are not finite or not `rows` in number, and for too many rows. [`Error::Interrupted`] after a stop request.
///
/// ```
/// use ftlm::equation::{Equation, Structure, Term};
/// use ftlm::signal::block_pulse::Intersample;
/// use ftlm::state_space::{respond, InputSignal};
/// # fn main() -> ftlm::error::Result<()> {
/// // y′ = −y + u.
/// let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
/// let model = Equation::new(Structure { output: 0, order: 1.0, terms }, vec![-1.0, 1.0])?;
/// let (samples, intersample) = (vec![1.0; 3], Intersample::Hold);
/// let step = InputSignal { signal: 1, samples, intersample, delay: 0.0, before: 0.0 };
/// let y = respond(&[model], &[step], &[], 0.5, 3, &ftlm::parallel::Stop::default())?.unwrap_or_default();
/// assert!((y[2] - (1.0 - (-1.0_f64).exp())).abs() < 1e-15);
/// # Ok(())
/// # }
/// ```
pub fn respond(
    equations: &[Equation],
    inputs: &[InputSignal],
    initial: &[Vec<(f64, f64)>],
    step: f64,
    rows: usize,
    stop: &Stop,
) -> Result<Option<Vec<f64>>> {
    check_step(step)?;
    check_points("samples of all outputs", rows.saturating_mul(equations.len()))?;
    for equation in equations {
        equation.check(usize::MAX)?;
    }
    if !initial.is_empty() {
        check_length("initial terms", equations.len(), initial.len())?;
    }
    for input in inputs {
        check_length("input", rows, input.samples.len())?;
        check_finite("input", &input.samples)?;
        check_finite("input before the record", &[input.before])?;
        check_finite("delay", &[input.delay])?;
    }
    let Some(model) = Realization::new(equations, inputs, initial, step)? else { return Ok(None) };
    let Some(recursion) = model.discretize(inputs)? else { return Ok(None) };
    recursion.run(model.initial_state, rows, stop).map(Some)
}

/// Convert an order or exponent to an integer. Values above [`MAX_STATES`] become [`MAX_STATES`] + 1. Return an error
/// for a negative value, or a value that is not an integer.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn integer(order: f64) -> Result<usize> {
    let nearest = order.round();
    if nearest >= 0.0 && (order - nearest).abs() <= ORDER_GRAIN {
        return Ok(nearest.min(MAX_STATES as f64 + 1.0) as usize);
    }
    Err(Error::Structure {
        what: format!("order or exponent {order} is not an integer, as a chain of integrators requires"),
        remedy: "use integers from 0, or the simulation by series".into(),
    })
}

/// Continuous-time state-space model, with one sampling interval h as the unit of time. Matrices are row-major.
struct Realization {
    states: usize,
    outputs: usize,
    /// System matrix h A, where h is the sampling interval.
    system: Vec<f64>,
    /// Gains (h B, D) of each input on the states and on the outputs.
    input_vectors: Vec<(Vec<f64>, Vec<f64>)>,
    /// Output matrix C, one row per output.
    output_matrix: Vec<f64>,
    initial_state: Vec<f64>,
}

impl Realization {
    /// Return the balanced state-space model of equations. None if direct feedthrough makes them singular, or for too
    /// many states.
    fn new(
        equations: &[Equation],
        inputs: &[InputSignal],
        initial: &[Vec<(f64, f64)>],
        step: f64,
    ) -> Result<Option<Self>> {
        let count = equations.len();
        let outputs: Vec<usize> = equations.iter().map(|e| e.structure.output).collect();
        let mut lengths = vec![0; count];
        // (equation, integration order, index of the output or `count` + index of the input, coefficient).
        let mut terms = Vec::new();
        for (i, Equation { structure, coefficients }) in equations.iter().enumerate() {
            for (k, (term, &c)) in structure.terms.iter().zip(coefficients).enumerate() {
                let input_index = || inputs.iter().position(|u| u.signal == term.signal).map(|q| count + q);
                let eta = integer(structure.integration(k))?;
                // A signal that is neither output nor input is zero.
                let Some(source) = outputs.iter().position(|&o| o == term.signal).or_else(input_index) else {
                    continue;
                };
                if c != 0.0 {
                    terms.push((i, eta, source, c));
                    lengths[i] = eta.max(lengths[i]);
                }
            }
            for &(exponent, _) in initial.get(i).into_iter().flatten() {
                lengths[i] = (integer(exponent)? + 1).max(lengths[i]);
            }
        }
        let n: usize = lengths.iter().sum();
        if n > MAX_STATES || check_regular(equations).is_err() {
            return Ok(None);
        }
        let first: Vec<usize> = (0..count).map(|i| lengths[..i].iter().sum()).collect();
        // Direct feedthrough: (I − E) y = w₁ + F u, with I − E in `feedthrough` and the columns of F in `direct`.
        let mut feedthrough = vec![0.0; count * count];
        let mut direct = vec![vec![0.0; count]; inputs.len()];
        (0..count).for_each(|i| feedthrough[i * count + i] = 1.0);
        for &(i, _, source, c) in terms.iter().filter(|t| t.1 == 0) {
            match source.checked_sub(count) {
                None => feedthrough[i * count + source] -= c,
                Some(q) => direct[q][i] += c,
            }
        }
        let norm = |m: &[f64]| m.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        let Ok(feedthrough_inverse) = small::inverse(&feedthrough, count) else { return Ok(None) };
        let condition = norm(&feedthrough) * norm(&feedthrough_inverse);
        if condition.is_nan() || condition > MAX_CONDITION {
            return Ok(None);
        }
        let mut output_matrix = vec![0.0; count * n];
        for (i, row) in (0..count).flat_map(|i| (0..count).map(move |row| (i, row))).filter(|&(i, _)| lengths[i] > 0) {
            output_matrix[row * n + first[i]] = feedthrough_inverse[row * count + i];
        }
        let mut input_vectors: Vec<(Vec<f64>, Vec<f64>)> =
            direct.iter().map(|f| (vec![0.0; n], dense::multiply(&feedthrough_inverse, f, count, count, 1))).collect();
        let mut system = vec![0.0; n * n];
        let mut initial_state = vec![0.0; n];
        for i in 0..count {
            (first[i]..(first[i] + lengths[i]).saturating_sub(1)).for_each(|row| system[row * n + row + 1] = step);
            for &(exponent, value) in initial.get(i).into_iter().flatten() {
                let power = integer(exponent)?;
                #[allow(clippy::cast_precision_loss)]
                let factorial: f64 = (1..=power).map(|k| k as f64).product();
                initial_state[first[i] + power] += value * factorial;
            }
        }
        for &(i, eta, source, c) in terms.iter().filter(|t| t.1 > 0) {
            let (row, gain) = (first[i] + eta - 1, step * c);
            match source.checked_sub(count) {
                None => {
                    (0..n).for_each(|j| system[row * n + j] += gain * output_matrix[source * n + j]);
                    input_vectors.iter_mut().for_each(|(b, d)| b[row] += gain * d[source]);
                }
                Some(q) => input_vectors[q].0[row] += gain,
            }
        }
        let mut model = Self { states: n, outputs: count, system, input_vectors, output_matrix, initial_state };
        model.balance();
        Ok(Some(model))
    }

    /// Scale the states by powers of two until the off-diagonal parts of each row and column of h A have nearly equal
    /// norms (Parlett and Reinsch, 1969).
    fn balance(&mut self) {
        let n = self.states;
        let mut has_changed = true;
        // Each sweep reduces the norm. For a reducible matrix, the sweeps end when its coupling is negligible.
        for _ in 0..MAX_STATES {
            if !std::mem::take(&mut has_changed) {
                break;
            }
            for i in 0..n {
                let sum = |index: &dyn Fn(usize) -> usize| {
                    (0..n).filter(|&j| j != i).map(|j| self.system[index(j)].abs()).sum::<f64>()
                };
                let (column, row) = (sum(&|j| j * n + i), sum(&|j| i * n + j));
                let ratio = (row / column).log2() * 0.5;
                if !ratio.is_finite() || ratio.abs() < 1.0 {
                    continue;
                }
                let factor = ratio.round().exp2();
                (0..n).filter(|&j| j != i).for_each(|j| {
                    self.system[j * n + i] *= factor;
                    self.system[i * n + j] /= factor;
                });
                self.output_matrix.iter_mut().skip(i).step_by(n).for_each(|v| *v *= factor);
                self.input_vectors.iter_mut().for_each(|(b, _)| b[i] /= factor);
                self.initial_state[i] /= factor;
                has_changed = true;
            }
        }
    }

    /// Return the recursion over one sampling interval; None if it overflows.
    fn discretize<'a>(&self, inputs: &'a [InputSignal]) -> Result<Option<Recursion<'a>>> {
        let n = self.states;
        let Some(interval) = Transition::new(&self.system, n, 1.0) else { return Ok(None) };
        let mut channels = Vec::with_capacity(inputs.len());
        for (input, (input_vector, direct)) in inputs.iter().zip(&self.input_vectors) {
            let nearest = input.delay.round();
            let is_integer = (input.delay - nearest).abs() <= DELAY_TOLERANCE * nearest.abs().max(1.0);
            let delay = if is_integer { nearest } else { input.delay };
            let fraction = delay - delay.floor();
            #[allow(clippy::cast_possible_truncation)]
            let integer_delay = delay.floor().clamp(-1e18, 1e18) as isize;
            let Some(InputGains { current_gains, next_gains }) =
                InputGains::new(&interval, &self.system, input_vector, input.intersample, fraction)
            else {
                return Ok(None);
            };
            let (samples, lag) = match input.intersample {
                Intersample::Linear if delay != 0.0 => {
                    (Cow::Owned(delay_samples(&input.samples, delay, input.before)?), 0)
                }
                Intersample::Linear => (Cow::Borrowed(input.samples.as_slice()), 0),
                Intersample::Hold => {
                    (Cow::Borrowed(input.samples.as_slice()), integer_delay.saturating_add(isize::from(fraction > 0.0)))
                }
            };
            let channel =
                Channel { samples, lag, before: input.before, current_gains, next_gains, direct: direct.clone() };
            channels.push(channel);
        }
        let gains = channels.iter().flat_map(|c| c.current_gains.iter().chain(&c.next_gains).chain(&c.direct));
        if !gains.chain(&self.initial_state).chain(&self.output_matrix).all(|v| v.is_finite()) {
            return Ok(None);
        }
        // Columns are contiguous, so that the states of a step are independent sums.
        let transition_increment = (0..n * n).map(|k| interval.transition_increment[k % n * n + k / n]).collect();
        Ok(Some(Recursion {
            states: n,
            outputs: self.outputs,
            transition_increment,
            output_matrix: self.output_matrix.clone(),
            channels,
        }))
    }
}

/// Matrix functions e^M − I (`transition_increment`), φ₁(M) (`first`) and φ₂(M) (`second`) of an n × n matrix M,
/// row-major. φ₁ and φ₂ are defined in the module documentation.
pub(crate) struct Transition {
    pub(crate) transition_increment: Vec<f64>,
    first: Vec<f64>,
    second: Vec<f64>,
}

impl Transition {
    /// Compute the functions of M = `scale` × `matrix` by scaling and squaring; None if they overflow.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn new(matrix: &[f64], n: usize, scale: f64) -> Option<Self> {
        let norm = (0..n).map(|i| (0..n).map(|j| matrix[i * n + j].abs()).sum::<f64>()).fold(0.0_f64, f64::max) * scale;
        if !norm.is_finite() {
            return None;
        }
        let halvings = if norm > 0.5 { norm.log2().ceil() as i32 + 1 } else { 0 };
        let scaled: Vec<f64> = matrix.iter().map(|v| v * scale * 0.5_f64.powi(halvings)).collect();
        let with_diagonal = |mut matrix: Vec<f64>, value: f64| {
            (0..n).for_each(|i| matrix[i * n + i] += value);
            matrix
        };
        let product = |a: &[f64], b: &[f64]| dense::multiply(a, b, n, n, n);
        // Σ M^k/(k + 2)! by Horner's rule.
        let mut second = vec![0.0; n * n];
        let mut coefficient: f64 = (1..TAYLOR_TERMS + 2).map(f64::from).product::<f64>().recip();
        for k in (0..TAYLOR_TERMS).rev() {
            second = with_diagonal(product(&scaled, &second), coefficient);
            coefficient *= f64::from(k + 2);
        }
        let mut first = with_diagonal(product(&scaled, &second), 1.0);
        let mut transition_increment = product(&scaled, &first);
        for _ in 0..halvings {
            let squared = product(&first, &first);
            second.iter_mut().zip(&squared).for_each(|(v, s)| *v = 0.25 * (s + 2.0 * *v));
            let increment = product(&transition_increment, &first);
            first.iter_mut().zip(&increment).for_each(|(v, r)| *v += 0.5 * r);
            let squared = product(&transition_increment, &transition_increment);
            transition_increment.iter_mut().zip(&squared).for_each(|(v, s)| *v = 2.0 * *v + s);
        }
        let is_finite = transition_increment.iter().chain(&first).chain(&second).all(|v| v.is_finite());
        is_finite.then_some(Self { transition_increment, first, second })
    }
}

/// Return the matrix exponential e^M of a row-major n × n matrix M; None if it overflows.
pub(crate) fn exponential(matrix: &[f64], n: usize) -> Option<Vec<f64>> {
    let mut transition = Transition::new(matrix, n, 1.0)?.transition_increment;
    transition.iter_mut().step_by(n + 1).for_each(|v| *v += 1.0);
    Some(transition)
}

/// Gains of an input on the states after one interval. `current_gains` multiplies the value of the input at the start
/// of the interval, and `next_gains` its next value.
pub(crate) struct InputGains {
    pub(crate) current_gains: Vec<f64>,
    pub(crate) next_gains: Vec<f64>,
}

impl InputGains {
    /// Return the gains of the input with the input vector `input_vector`; None if they overflow.
    ///
    /// `fraction` is the fractional part of the delay of a zero-order-hold input, in sampling intervals. If it is not
    /// 0, the next value of the input takes effect after this fraction of the interval.
    pub(crate) fn new(
        interval: &Transition,
        system: &[f64],
        input_vector: &[f64],
        intersample: Intersample,
        fraction: f64,
    ) -> Option<Self> {
        let n = input_vector.len();
        let total = dense::multiply(&interval.first, input_vector, n, n, 1);
        let next_gains: Vec<f64> = match intersample {
            Intersample::Linear => dense::multiply(&interval.second, input_vector, n, n, 1),
            Intersample::Hold if fraction == 0.0 => {
                return Some(Self { current_gains: total, next_gains: vec![0.0; n] })
            }
            Intersample::Hold => {
                // The next value takes effect within the interval and acts over the rest of it.
                let remaining_fraction = 1.0 - fraction;
                let remaining_interval = Transition::new(system, n, remaining_fraction)?;
                dense::multiply(&remaining_interval.first, input_vector, n, n, 1)
                    .into_iter()
                    .map(|v| v * remaining_fraction)
                    .collect()
            }
        };
        let current_gains = total.iter().zip(&next_gains).map(|(a, b)| a - b).collect();
        Some(Self { current_gains, next_gains })
    }
}

/// Input of the recursion.
struct Channel<'a> {
    samples: Cow<'a, [f64]>,
    /// Number of rows by which the samples are delayed.
    lag: isize,
    before: f64,
    /// Gains of the value in the current row on the states in the next row. `next_gains` holds the gains of the value
    /// in the next row.
    current_gains: Vec<f64>,
    next_gains: Vec<f64>,
    /// Direct feedthrough gain on each output.
    direct: Vec<f64>,
}

/// Linear recursion of the states from row to row.
struct Recursion<'a> {
    states: usize,
    outputs: usize,
    /// Transition matrix e^{hA} minus I, column-major.
    transition_increment: Vec<f64>,
    output_matrix: Vec<f64>,
    channels: Vec<Channel<'a>>,
}

impl Recursion<'_> {
    /// Return the samples of all outputs from an initial state, concatenated: `rows` samples for each output.
    fn run(&self, state: Vec<f64>, rows: usize, stop: &Stop) -> Result<Vec<f64>> {
        // Loops of constant length are compiled for common numbers of states.
        match self.states {
            1 => self.run_states(1, state, rows, stop),
            2 => self.run_states(2, state, rows, stop),
            3 => self.run_states(3, state, rows, stop),
            4 => self.run_states(4, state, rows, stop),
            n => self.run_states(n, state, rows, stop),
        }
    }

    #[inline(always)]
    fn run_states(&self, n: usize, mut state: Vec<f64>, rows: usize, stop: &Stop) -> Result<Vec<f64>> {
        let mut out = vec![0.0; self.outputs * rows];
        let mut history = vec![0.0; BLOCK_ROWS * n];
        let mut values = vec![0.0; BLOCK_ROWS + 1];
        for first_row in (0..rows).step_by(BLOCK_ROWS) {
            stop.check()?;
            let count = BLOCK_ROWS.min(rows - first_row);
            history.fill(0.0);
            for channel in &self.channels {
                channel.write_values(first_row, &mut values);
                for (gains, shift) in [(&channel.current_gains, 0), (&channel.next_gains, 1)] {
                    if gains.iter().any(|&gain| gain != 0.0) {
                        add_forcing(n, gains, &values[shift..], &mut history);
                    }
                }
                for (samples, &gain) in out.chunks_exact_mut(rows).zip(&channel.direct).filter(|&(_, &g)| g != 0.0) {
                    let samples = &mut samples[first_row..first_row + count];
                    samples.iter_mut().zip(&values).for_each(|(y, value)| *y += gain * value);
                }
            }
            advance(n, &self.transition_increment, &mut state, &mut history);
            for (samples, gains) in out.chunks_exact_mut(rows).zip(self.output_matrix.chunks_exact(n.max(1))) {
                add_outputs(n, gains, &history, &mut samples[first_row..first_row + count]);
            }
            state.iter_mut().filter(|x| x.abs() < MIN_STATE).for_each(|x| *x = 0.0);
        }
        Ok(out)
    }
}

impl Channel<'_> {
    /// Write the values of the input in the rows from `first_row` on to `values`. The last sample is repeated beyond
    /// the record.
    fn write_values(&self, first_row: usize, values: &mut [f64]) {
        let last_value = self.samples.last().copied().unwrap_or(0.0);
        let before_record =
            (0..values.len()).take_while(|row| delayed_row(first_row + row, self.lag).is_none()).count();
        let (before_record, in_record) = values.split_at_mut(before_record);
        before_record.fill(self.before);
        let first = delayed_row(first_row + before_record.len(), self.lag).unwrap_or(usize::MAX);
        let samples = self.samples.get(first..).unwrap_or_default();
        let (sampled, after_record) = in_record.split_at_mut(samples.len().min(in_record.len()));
        sampled.copy_from_slice(&samples[..sampled.len()]);
        after_record.fill(last_value);
    }
}

/// Add gain × input value to each of the `n` states in every row of a block.
#[inline(always)]
fn add_forcing(n: usize, gains: &[f64], values: &[f64], forcing: &mut [f64]) {
    let gains = &gains[..n];
    for (sums, &value) in forcing.chunks_exact_mut(n.max(1)).zip(values) {
        for i in 0..n {
            sums[i] += gains[i] * value;
        }
    }
}

/// Add Σ gain × state over the `n` states to the sample of an output in each row.
#[inline(always)]
fn add_outputs(n: usize, gains: &[f64], history: &[f64], samples: &mut [f64]) {
    // An output does not depend on a state with zero gain, which may overflow.
    for (j, &gain) in gains.iter().enumerate().filter(|&(_, &gain)| gain != 0.0) {
        samples.iter_mut().zip(history.chunks_exact(n.max(1))).for_each(|(y, states)| *y += gain * states[j]);
    }
}

/// Advance the state by one block of rows. `history` contains the forcing of each row, which is replaced by the state
/// at that row.
#[inline(always)]
fn advance(n: usize, transition_increment: &[f64], state: &mut [f64], history: &mut [f64]) {
    let (transition_increment, state) = (&transition_increment[..n * n], &mut state[..n]);
    for row in history.chunks_exact_mut(n.max(1)) {
        for i in 0..n {
            let current = state[i];
            state[i] += row[i];
            row[i] = current;
        }
        for j in 0..n {
            for i in 0..n {
                state[i] += transition_increment[j * n + i] * row[j];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{respond, InputSignal, Transition};
    use crate::equation::{Equation, Structure, Term};
    use crate::error::Error;
    use crate::parallel::Stop;
    use crate::signal::block_pulse::Intersample;

    /// Return the exact values of e^M − I, φ₁(M) and φ₂(M) for a chain of two real poles, from partial fractions.
    fn two_poles(fast: f64, slow: f64) -> [f64; 3] {
        // Element (1, 1) of a function of [[−(f + s), f], [−s, 0]] with the eigenvalues −f and −s.
        let of = |z: fn(f64) -> f64| (-slow * z(-fast) + fast * z(-slow)) / (fast - slow);
        [of(|z| z.exp_m1()), of(|z| z.exp_m1() / z), of(|z| (z.exp_m1() / z - 1.0) / z)]
    }

    #[test]
    fn slow_poles_are_accurate_beside_fast_ones() {
        for fast in [1e1, 1e4, 1e8, 1e12] {
            for slow in [1.0, 1e-3, 1e-6] {
                let root = f64::sqrt(fast * slow);
                let matrix = [-(fast + slow), root, -root, 0.0];
                let entries =
                    Transition::new(&matrix, 2, 1.0).map(|t| [t.transition_increment[3], t.first[3], t.second[3]]);
                let exact = two_poles(fast, slow);
                let worst = entries
                    .map_or(f64::NAN, |f| f.iter().zip(exact).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f64::max));
                // The second function loses six digits of the reference by cancellation at 1e-6.
                assert!(worst < 1e-9, "{fast:e}, {slow:e}: {worst:e}");
            }
        }
    }

    #[test]
    fn nilpotent_chain_has_powers_over_factorials() {
        let mut chain = vec![0.0; 16];
        (0..3).for_each(|i| chain[5 * i + 1] = 1.0);
        let entries = Transition::new(&chain, 4, 0.5).map(|t| [t.transition_increment[3], t.first[3], t.second[3]]);
        let exact = [6.0, 24.0, 120.0].map(|factorial| 0.125 / factorial);
        assert!(entries.is_some_and(|f| f.iter().zip(exact).all(|(a, b)| (a / b - 1.0).abs() < 1e-14)), "{entries:?}");
    }

    #[test]
    fn overflowing_transition_is_none() {
        assert!(Transition::new(&[1e3], 1, 1.0).is_none());
        assert!(Transition::new(&[-1e300], 1, 1.0).is_some());
        assert!(Transition::new(&[f64::INFINITY], 1, 1.0).is_none());
    }
    #[test]
    fn stop_request_ends_the_recursion() {
        let structure = Structure { output: 0, order: 1.0, terms: vec![Term { signal: 1, order: 0.0 }] };
        let samples = vec![1.0; 5];
        let ramp = [InputSignal { signal: 1, samples, intersample: Intersample::Hold, delay: 0.0, before: 0.0 }];
        let equations = [Equation { structure, coefficients: vec![1.0] }];
        let stop = Stop::default();
        let of = || respond(&equations, &ramp, &[], 1.0, 5, &stop);
        assert_eq!(of(), Ok(Some(vec![0.0, 1.0, 2.0, 3.0, 4.0])));
        stop.set();
        assert_eq!(of(), Err(Error::Interrupted));
    }
}

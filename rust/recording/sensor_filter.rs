//! States of a sensor filter without zeros: its initial transient in a signal, and its responses to impulses.
//!
//! A signal that was filtered from an unknown initial state contains responses of the filter to an impulse and its
//! derivatives. On a grid of pulses, an impulse would last for one pulse, and its derivative for two. The responses are
//! therefore computed from the states of the filter.

use crate::equation::Filter;
use crate::error::{check_points, Result};
use crate::linalg::dense::{minimum_norm_solution, multiply};
use crate::linalg::orthogonal::norm;
use crate::linalg::small::spectral_radius;
use crate::state_space::exponential;

/// Length of the initial part of the record to which the transient is fitted, in time constants of the fastest pole.
/// Over this time the input of the filter is nearly a straight line.
const TRANSIENT_FIT_TIME_CONSTANTS: f64 = 1.0;
/// Minimum number of samples per parameter in the fit of the transient.
const SAMPLES_PER_PARAMETER: usize = 2;
/// Product of the fastest pole \[rad/s\] and the sampling interval \[s\] above which the transient has decayed before
/// the second sample.
const MAX_POLE_STEP_PRODUCT: f64 = 1e3;

/// State-space form of a filter without zeros: a chain of integrators whose first state is the output.
pub(super) struct FilterStates {
    /// Number of states.
    size: usize,
    /// System matrix, row-major.
    system: Vec<f64>,
    /// Gain from the input of the filter to the last state.
    gain: f64,
    /// Magnitude of the fastest pole \[rad/s\].
    fastest_pole: f64,
}

impl FilterStates {
    /// Return the state-space form of a filter. None if the filter has zeros, fractional orders or order 0, because its
    /// transients are then not impulse responses.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(super) fn from_filter(filter: &Filter) -> Option<Self> {
        let is_integer = |order: f64| order.fract() == 0.0;
        let nonzero_terms = |terms: &[(f64, f64)]| terms.iter().copied().filter(|(c, _)| *c != 0.0).collect::<Vec<_>>();
        let (numerator, denominator) = (nonzero_terms(&filter.numerator), nonzero_terms(&filter.denominator));
        if numerator.iter().any(|(_, order)| *order > 0.0) || !denominator.iter().all(|(_, order)| is_integer(*order)) {
            return None;
        }
        let degree = denominator.iter().map(|(_, order)| *order as usize).max()?;
        let mut powers = vec![0.0; degree + 1];
        denominator.iter().for_each(|&(coefficient, order)| powers[order as usize] += coefficient);
        let size = powers.iter().rposition(|c| *c != 0.0).filter(|&size| size > 0)?;
        let mut system = vec![0.0; size * size];
        (1..size).for_each(|i| system[(i - 1) * size + i] = 1.0);
        (0..size).for_each(|k| system[(size - 1) * size + k] = -powers[k] / powers[size]);
        let gain = filter.numerator.iter().map(|(c, _)| c).sum::<f64>() / powers[size];
        let fastest_pole = spectral_radius(&powers[..=size])?;
        Some(Self { size, system, gain, fastest_pole })
    }

    /// True if a transient lasts beyond the first sample at the sampling interval `step` \[s\].
    pub(super) fn has_lasting_transient(&self, step: f64) -> bool {
        self.fastest_pole * step <= MAX_POLE_STEP_PRODUCT
    }

    /// Return the states just after an impulse and after its first `count` − 1 derivatives, one row for each.
    fn impulse_states(&self, count: usize) -> Vec<Vec<f64>> {
        // An impulse sets the last state. Each derivative multiplies by the system matrix once more.
        let mut state = vec![0.0; self.size];
        state[self.size - 1] = self.gain;
        let mut states = Vec::with_capacity(count);
        for _ in 0..count {
            let next = self.times(&state);
            states.push(std::mem::replace(&mut state, next));
        }
        states
    }

    fn times(&self, state: &[f64]) -> Vec<f64> {
        self.system.chunks_exact(self.size).map(|row| row.iter().zip(state).map(|(a, x)| a * x).sum()).collect()
    }

    /// Return the system matrix with `extra_states` additional states, multiplied by `step`. `elements` holds (row,
    /// column, value) of the additional elements.
    fn extended_system(&self, extra_states: usize, elements: &[(usize, usize, f64)], step: f64) -> Vec<f64> {
        let n = self.size + extra_states;
        let mut extended = vec![0.0; n * n];
        for (i, row) in self.system.chunks_exact(self.size).enumerate() {
            row.iter().enumerate().for_each(|(j, v)| extended[i * n + j] = v * step);
        }
        elements.iter().for_each(|&(i, j, value)| extended[i * n + j] = value * step);
        extended
    }

    /// Return the initial transient of a filtered signal at its samples; None if it cannot be computed.
    ///
    /// The first sample is assumed to consist of the transient only. Over the first samples, the input of the filter is
    /// nearly a straight line. The response to this line, and `states` responses to an impulse and its derivatives, are
    /// fitted together.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(super) fn transient(&self, samples: &[f64], step: f64, states: usize) -> Option<Vec<f64>> {
        let row_count = TRANSIENT_FIT_TIME_CONSTANTS / (self.fastest_pole * step);
        let row_count =
            if self.fastest_pole > 0.0 { row_count.round_ties_even().min(samples.len() as f64) as usize } else { 0 };
        let count = row_count.max(SAMPLES_PER_PARAMETER * (states + 2)).min(samples.len());
        // Level and slope of the input are two additional states. The slope is constant, and the level is its integral.
        let n = self.size;
        let extended = self.extended_system(2, &[(n - 1, n, self.gain), (n, n + 1, 1.0)], step);
        let unit_state = |state: usize| (0..n + 2).map(|i| f64::from(u8::from(i == state))).collect::<Vec<f64>>();
        let impulses = self.impulse_states(states);
        let mut initial_states: Vec<Vec<f64>> =
            impulses.iter().map(|state| [state.as_slice(), &[0.0; 2]].concat()).collect();
        initial_states.extend([unit_state(n), unit_state(n + 1)]);
        let mut columns = free_responses(&extended, n + 2, &initial_states, count, 0)?;
        let first = columns.remove(states.checked_sub(1)?);
        let level = samples.first()? / first.first()?;
        let norms: Vec<f64> = columns.iter().map(|c| norm(c)).map(|s| if s == 0.0 { 1.0 } else { s }).collect();
        let scaled: Vec<Vec<f64>> = columns
            .iter()
            .zip(&norms)
            .map(|(c, norm_of_column)| c.iter().map(|v| v / norm_of_column).collect())
            .collect();
        let remainder: Vec<f64> = samples.iter().zip(&first).map(|(v, unit_value)| v - level * unit_value).collect();
        #[allow(clippy::cast_precision_loss)]
        let rounding = f64::EPSILON * remainder.len().max(scaled.len()) as f64;
        let mut scaled_states = minimum_norm_solution(&scaled, &remainder, rounding)?;
        scaled_states.iter_mut().zip(&norms).for_each(|(x, norm_of_column)| *x /= norm_of_column);
        scaled_states.truncate(states - 1);
        scaled_states.push(level);
        let mut initial_state = vec![0.0; n];
        for (state, x) in impulses.iter().zip(&scaled_states) {
            initial_state.iter_mut().zip(state).for_each(|(sum, v)| *sum += v * x);
        }
        free_responses(&self.extended_system(0, &[], step), n, &[initial_state], samples.len(), 0)
            .map(|mut rows| rows.remove(0))
    }

    /// Return the means over `m` pulses of the responses to an impulse and its derivatives. Empty if the responses are
    /// not finite or have decayed within a pulse.
    ///
    /// # Errors
    /// [`Error::OutOfRange`](crate::error::Error::OutOfRange) for too many pulses.
    pub(super) fn impulse_responses(&self, states: usize, m: usize, step: f64) -> Result<Vec<Vec<f64>>> {
        check_points("m", m)?;
        if states == 0 || !self.has_lasting_transient(step) {
            return Ok(Vec::new());
        }
        // The integral of the response is an additional state.
        let n = self.size;
        let initial_states: Vec<Vec<f64>> =
            self.impulse_states(states).iter().map(|state| [state.as_slice(), &[0.0]].concat()).collect();
        let integrals =
            free_responses(&self.extended_system(1, &[(n, 0, 1.0)], step), n + 1, &initial_states, m + 1, n);
        let means = |row: Vec<f64>| row.windows(2).map(|pair| (pair[1] - pair[0]) / step).collect();
        Ok(integrals.unwrap_or_default().into_iter().map(means).collect())
    }
}

/// Return the free response of the state with index `state` at unit time steps, one row of `count` values for each
/// initial state; None if it overflows.
fn free_responses(
    system: &[f64],
    n: usize,
    initial_states: &[Vec<f64>],
    count: usize,
    state: usize,
) -> Option<Vec<Vec<f64>>> {
    // Multiplication by a power of the transition matrix doubles the number of known steps.
    let mut power = exponential(system, n)?;
    let rows = initial_states.len();
    let mut responses: Vec<f64> = initial_states.concat();
    let mut steps = 1;
    while steps < count {
        // States are rows, so that they are multiplied by the transposed transition.
        let transposed: Vec<f64> = (0..n * n).map(|k| power[(k % n) * n + k / n]).collect();
        responses.extend(multiply(&responses, &transposed, steps * rows, n, n));
        steps *= 2;
        power = multiply(&power, &power, n, n, n);
    }
    Some((0..rows).map(|row| (0..count).map(|k| responses[(k * rows + row) * n + state]).collect()).collect())
}

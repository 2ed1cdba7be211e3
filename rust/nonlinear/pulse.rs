//! Equations of one pulse and their solution by Newton iterations.

use super::channels::PulseFailure;
use super::contact::PulseEquations;
use super::operators::{ExpressionArgument, Operators};
use super::system::NonlinearSystem;
use crate::expression::Values;
use crate::linalg::small;

/// Maximum number of Newton iterations in a pulse. Two or three are usual.
const MAX_NEWTON_ITERATIONS: usize = 50;
/// Maximum number of times that a Newton step is halved if it does not reduce the residual. The slope of a square root
/// at 0 is set to 0, so that the first step may exceed the solution by many orders of magnitude.
const MAX_STEP_HALVINGS: usize = 50;
/// Newton step at which the iteration has converged, relative to the sum of the magnitudes of the channel's terms.
/// Convergence is quadratic, so the next step would be below rounding error. The Jacobian is computed before this step
/// and therefore has a relative error of this size.
const NEWTON_TOLERANCE: f64 = 1e-8;
/// Rounding error of the residual of a channel, relative to the rounding scale of the channel.
const ROUNDING_RATIO: f64 = 16.0 * f64::EPSILON;

/// Equations of one pulse, with the current iterate of the Newton iterations and work arrays.
pub(super) struct Pulse<'a> {
    operators: &'a Operators,
    system: &'a NonlinearSystem,
    /// Forcing of each state channel: the part that does not depend on this pulse.
    pub(super) free: Vec<f64>,
    /// Value at which each state channel is fixed; None if the equations determine it.
    fixed: Vec<Option<f64>>,
    /// For each state channel, whether it was fixed when `inverse` was computed. Without non-linear terms, the inverse
    /// depends on these flags only.
    fixed_in_inverse: Vec<bool>,
    /// Means of the input channels in this pulse.
    pub(super) input_means: Vec<f64>,
    /// Iterate: means of the state channels in this pulse.
    pub(super) z: Vec<f64>,
    /// Values of the non-linear terms at `z`, followed by the friction forces.
    pub(super) values: Vec<f64>,
    /// Derivatives of the non-linear terms with respect to the state channels, then the input channels, row-major.
    pub(super) slopes: Vec<f64>,
    /// Inverse Jacobian of the equations, row-major.
    pub(super) inverse: Vec<f64>,
    pub(super) determinant: f64,
    /// Residual of the equation of each state channel.
    residual: Vec<f64>,
    /// Sum of the magnitudes of the terms in the equation of each state channel.
    magnitudes: Vec<f64>,
    /// Scale of the rounding error of each residual: `magnitudes`, with the rounding scales of the non-linear terms.
    rounding_scales: Vec<f64>,
    /// Rounding scale of each non-linear term, then the magnitudes of the friction forces.
    term_scales: Vec<f64>,
    matrix: Vec<f64>,
    step: Vec<f64>,
    previous: Vec<f64>,
    /// First function without a value at the iterate, and its argument.
    fault: Option<(&'static str, f64)>,
    arguments: Vec<f64>,
    work: Values,
}

impl<'a> Pulse<'a> {
    pub(super) fn new(operators: &'a Operators, system: &'a NonlinearSystem) -> Self {
        let (states, values, input_count) = (operators.states.len(), operators.values(), operators.input_means.len());
        Self {
            operators,
            system,
            free: vec![0.0; states],
            fixed: vec![None; states],
            fixed_in_inverse: Vec::new(),
            input_means: vec![0.0; input_count],
            z: vec![0.0; states],
            values: vec![0.0; values],
            slopes: vec![0.0; values * (states + input_count)],
            inverse: vec![0.0; states * states],
            determinant: 1.0,
            residual: vec![0.0; states],
            magnitudes: vec![0.0; states],
            rounding_scales: vec![0.0; states],
            term_scales: vec![0.0; values],
            matrix: vec![0.0; states * states],
            step: vec![0.0; states],
            previous: vec![0.0; states],
            fault: None,
            arguments: Vec::new(),
            work: Values::default(),
        }
    }

    pub(super) fn source(&self, index: usize) -> f64 {
        self.z.get(index).copied().unwrap_or_else(|| self.values[index - self.z.len()])
    }

    /// Evaluate non-linear terms, their derivatives and the residual at `z`. Return the sum of the magnitudes of the
    /// residual.
    fn evaluate(&mut self) -> f64 {
        let (states, width) = (self.z.len(), self.z.len() + self.input_means.len());
        self.slopes.fill(0.0);
        self.fault = None;
        for (q, term) in self.operators.terms.iter().enumerate() {
            self.arguments.clear();
            let value = |argument: &ExpressionArgument| match *argument {
                ExpressionArgument::State(state) => self.z[state],
                ExpressionArgument::Input(input) => self.input_means[input],
            };
            self.arguments.extend(term.arguments.iter().map(value));
            self.values[q] = self.system.derived[term.signal].expression.evaluate(&self.arguments, &mut self.work);
            self.term_scales[q] = self.work.rounding_scale();
            self.fault = self.fault.or(self.work.fault());
            for (argument, slope) in term.arguments.iter().zip(self.work.slopes()) {
                let column = match *argument {
                    ExpressionArgument::State(state) => state,
                    ExpressionArgument::Input(input) => states + input,
                };
                self.slopes[q * width + column] += slope;
            }
        }
        let terms = self.operators.terms.len();
        self.term_scales[terms..].iter_mut().zip(&self.values[terms..]).for_each(|(scale, v)| *scale = v.abs());
        let count = self.operators.sources();
        let mut norm = 0.0;
        for a in 0..states {
            let gains = &self.operators.gains[a * count..(a + 1) * count];
            let same_pulse_sum: f64 = gains.iter().zip(self.z.iter().chain(&self.values)).map(|(g, x)| g * x).sum();
            let magnitudes = gains.iter().zip(self.z.iter().chain(&self.values)).map(|(g, x)| (g * x).abs());
            self.magnitudes[a] = magnitudes.sum::<f64>() + self.z[a].abs() + self.free[a].abs();
            let scales = gains[states..].iter().zip(self.values.iter().zip(&self.term_scales));
            let excess: f64 = scales.map(|(g, (value, scale))| g.abs() * (scale - value.abs())).sum();
            self.rounding_scales[a] = self.magnitudes[a] + excess;
            self.residual[a] = match self.fixed[a] {
                Some(value) => self.z[a] - value,
                None => self.z[a] - self.free[a] - same_pulse_sum,
            };
            norm += self.residual[a].abs();
        }
        norm
    }

    /// Set the initial guess `z` of the Newton iterations: the quadratic extrapolation of the last three pulses. The
    /// degree is lower in the second and third pulse. The first pulse starts at the forcing.
    pub(super) fn predict(&mut self, sources: &[Vec<f64>]) {
        for ((z, row), free) in self.z.iter_mut().zip(sources).zip(&self.free) {
            *z = match row.as_slice() {
                [.., first, previous, last] => 3.0 * (last - previous) + first,
                [previous, last] => 2.0 * last - previous,
                [last] => *last,
                [] => *free,
            };
        }
    }

    /// Compute the inverse Jacobian of the equations of the pulse. Return false if the Jacobian is singular or the
    /// inverse is not finite.
    fn linearize(&mut self) -> bool {
        let (states, count, width) = (self.z.len(), self.operators.sources(), self.z.len() + self.input_means.len());
        let is_fixed = self.fixed.iter().map(Option::is_some);
        if self.is_linear() && is_fixed.clone().eq(self.fixed_in_inverse.iter().copied()) {
            return true;
        }
        self.fixed_in_inverse = is_fixed.collect();
        for a in 0..states {
            let gains = &self.operators.gains[a * count..(a + 1) * count];
            for b in 0..states {
                if self.fixed[a].is_some() {
                    self.matrix[a * states + b] = f64::from(u8::from(a == b));
                    continue;
                }
                let nonlinear_gain: f64 =
                    gains[states..].iter().enumerate().map(|(q, g)| g * self.slopes[q * width + b]).sum();
                self.matrix[a * states + b] = f64::from(u8::from(a == b)) - gains[b] - nonlinear_gain;
            }
        }
        if let [a] = self.matrix[..] {
            (self.determinant, self.inverse[0]) = (a, 1.0 / a);
            return a != 0.0 && self.inverse[0].is_finite();
        }
        let Some((inverse, determinant)) = small::inverse_with_determinant(&self.matrix, states) else { return false };
        (self.inverse, self.determinant) = (inverse, determinant);
        true
    }

    /// Solve a pulse without non-linear terms for its state channels, at the friction forces in `values`.
    fn solve_linear(&mut self) -> std::result::Result<(), PulseFailure> {
        if !self.linearize() {
            return Err(PulseFailure::Newton("its linearization is singular"));
        }
        let (states, count) = (self.z.len(), self.operators.sources());
        for (a, rhs) in self.residual.iter_mut().enumerate() {
            let gains = &self.operators.gains[a * count + states..(a + 1) * count];
            let forced_value = || self.free[a] + gains.iter().zip(&self.values).map(|(g, x)| g * x).sum::<f64>();
            *rhs = self.fixed[a].unwrap_or_else(forced_value);
        }
        for (z, row) in self.z.iter_mut().zip(self.inverse.chunks(states)) {
            *z = row.iter().zip(&self.residual).map(|(v, rhs)| v * rhs).sum();
        }
        if self.z.iter().all(|z| z.is_finite()) {
            Ok(())
        } else {
            Err(PulseFailure::Overflow)
        }
    }

    /// Solve the pulse by Newton iterations from the current `z`, at the friction forces in `values`.
    pub(super) fn solve(&mut self) -> std::result::Result<(), PulseFailure> {
        if self.is_linear() {
            return self.solve_linear();
        }
        let states = self.z.len();
        let mut norm = self.evaluate();
        if !norm.is_finite() && self.free.iter().all(|v| v.is_finite()) {
            // The extrapolation may lie outside the domain of an expression. The iteration then starts at the forcing.
            self.z.clone_from(&self.free);
            norm = self.evaluate();
        }
        for _ in 0..MAX_NEWTON_ITERATIONS {
            if !norm.is_finite() {
                return Err(self.describe_fault());
            }
            if !self.linearize() {
                return Err(PulseFailure::Newton("its linearization is singular"));
            }
            let mut is_small = true;
            for a in 0..states {
                let row = &self.inverse[a * states..(a + 1) * states];
                self.step[a] = row.iter().zip(&self.residual).map(|(v, r)| v * r).sum();
                // The inverse Jacobian propagates rounding errors of large state channels to small ones.
                let rounding: f64 = row.iter().zip(&self.rounding_scales).map(|(v, scale)| (v * scale).abs()).sum();
                let tolerance = NEWTON_TOLERANCE * self.magnitudes[a] + ROUNDING_RATIO * rounding;
                is_small &= self.step[a].abs() <= tolerance;
            }
            self.previous.clone_from(&self.z);
            let (mut step_fraction, mut halvings_left) = (1.0, MAX_STEP_HALVINGS);
            loop {
                let steps = self.previous.iter().zip(&self.step);
                self.z.iter_mut().zip(steps).for_each(|(z, (start, d))| *z = start - step_fraction * d);
                let next_norm = self.evaluate();
                if next_norm.is_finite() && (next_norm <= norm || is_small) {
                    norm = next_norm;
                    break;
                }
                if halvings_left == 0 {
                    return Err(if next_norm.is_finite() { NO_DESCENT } else { self.describe_fault() });
                }
                (step_fraction, halvings_left) = (0.5 * step_fraction, halvings_left - 1);
            }
            if is_small {
                return Ok(());
            }
        }
        Err(NO_DESCENT)
    }

    fn describe_fault(&self) -> PulseFailure {
        match self.fault {
            Some((name, argument)) if argument.abs() < MIN_OVERFLOW_ARGUMENT => PulseFailure::Domain(name, argument),
            _ => PulseFailure::Overflow,
        }
    }
}

impl PulseEquations for Pulse<'_> {
    fn is_linear(&self) -> bool {
        self.operators.terms.is_empty()
    }

    fn solve_with(&mut self, frictions: &[f64]) -> std::result::Result<(), PulseFailure> {
        let terms = self.operators.terms.len();
        self.values[terms..].copy_from_slice(frictions);
        self.solve()
    }

    fn channel(&mut self, state: usize) -> &mut f64 {
        &mut self.z[state]
    }

    fn fix(&mut self, state: usize, value: Option<f64>) {
        self.fixed[state] = value;
    }
}

/// Magnitude of an argument at or above which a function without a finite value is reported as an overflow. For smaller
/// arguments, the argument is reported as outside the domain of the function.
const MIN_OVERFLOW_ARGUMENT: f64 = 1e60;
/// Failure of a pulse in which no Newton step reduces the residual, or whose iteration does not converge.
const NO_DESCENT: PulseFailure = PulseFailure::Newton("no Newton step reduces its residual");

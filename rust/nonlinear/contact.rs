//! Dry friction in a simulation: friction force of a pulse, and its derivatives.
//!
//! The end velocity of a body is e = p − G φ. p is the end velocity without the friction φ, G the linear response
//! within the pulse. Non-linear terms change p only slightly within a pulse, so the iteration for φ converges in a few
//! steps.

use super::channels::{ForcingTerms, PulseFailure, SystemDerivatives};
use crate::error::Result;
use crate::friction::contact::{FrictionProblem, MAX_FRICTION_ERROR_RATIO, VELOCITY_ROUNDING_RATIO};
use crate::friction::law::{FrictionLaw, Phase, Pulse as FrictionPulse, PulseDerivatives};
use crate::linalg::small;

/// Maximum number of iterations in a pulse, each of which solves for the state channels and then for the friction.
/// Three are usual.
const MAX_PULSE_ITERATIONS: usize = 60;
/// Error of a friction force at which the iteration has converged, relative to the velocities.
const FRICTION_ROUNDING_RATIO: f64 = 64.0 * f64::EPSILON;

/// Equations of one pulse with given friction forces.
pub(super) trait PulseEquations {
    /// True if the state channels are linear in the friction forces.
    fn is_linear(&self) -> bool;

    /// Solve the equations for the state channels with these friction forces.
    fn solve_with(&mut self, frictions: &[f64]) -> std::result::Result<(), PulseFailure>;

    /// Value of a state channel.
    fn channel(&mut self, state: usize) -> &mut f64;

    /// Fix a state channel at a value; None frees it, so that the equations determine it.
    fn fix(&mut self, state: usize, value: Option<f64>);
}

/// Friction problem of a simulation, with the state channels of its bodies.
pub(super) struct ContactOperators {
    /// Friction laws, and decrease of the end velocities per unit of each friction force without the non-linear terms.
    problem: FrictionProblem,
    /// State channel of the output of each body.
    outputs: Vec<usize>,
    /// State channel of the end velocity of each body.
    velocities: Vec<usize>,
    /// Number of state channels.
    states: usize,
    /// Inverse of the equations of the state channels without non-linear terms.
    inverse: Vec<f64>,
}

/// Motion of a body with friction in a simulation.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyMotion {
    /// Mean friction over each pulse, in the unit of D^α y, at most the breakaway force up to rounding.
    pub force: Vec<f64>,
    /// Velocity at the pulse edges, one more than there are pulses. Exactly 0 at rest.
    pub velocity: Vec<f64>,
    /// Phase of the body in each pulse.
    pub phases: Vec<Phase>,
}

/// Motion and friction of one body in one pulse.
#[derive(Debug, Clone, Copy)]
pub(super) struct BodyState {
    /// Velocity at the start.
    start_velocity: f64,
    /// Velocity at the end without the friction of the body.
    free_velocity: f64,
    /// True if the body is at rest in this pulse and in the previous one, so that its mean output is constant.
    is_resting: bool,
    pulse: FrictionPulse,
}

/// Derivatives of the bodies with respect to a parameter.
pub(super) struct BodyDerivatives {
    /// Initial output and velocity of each body.
    pub(super) starts: Vec<(f64, f64)>,
    /// Derivative of each body's friction gain with respect to the parameter. The gain is the change of the body's
    /// velocity at the end of a pulse per unit of its friction force in the pulse.
    gains: Vec<f64>,
    /// Derivatives of fc, fs and vs of each body.
    laws: Vec<[f64; 3]>,
}

/// Solver of the friction forces of all bodies, pulse by pulse.
pub(super) struct ContactSolver<'a> {
    contact: &'a ContactOperators,
    /// Velocities at the start of the run.
    initial_velocities: Vec<f64>,
    /// Velocities at the start of the pulse.
    velocities: Vec<f64>,
    /// Output of each body in the last pulse; true if it was at rest.
    last_outputs: Vec<(f64, bool)>,
    /// True if a body is at rest in this pulse and in the previous one.
    is_resting: Vec<bool>,
    forces: Vec<f64>,
    rounding: Vec<f64>,
    at: Vec<(f64, FrictionPulse)>,
    contacts: Vec<BodyState>,
}

impl ContactOperators {
    /// Friction problem of bodies with these friction laws. `channels` holds, for each body, the state channels of its
    /// output and of its velocity at the end of a pulse. `gains` holds the weight of each source in each state channel
    /// within a pulse, row-major. The friction forces are the last sources.
    pub(super) fn new(
        laws: Vec<FrictionLaw>,
        channels: &[(usize, usize)],
        gains: &[f64],
        states: usize,
    ) -> Result<Self> {
        let (count, n) = (gains.len() / states, laws.len());
        let (outputs, velocities): (Vec<usize>, Vec<usize>) = channels.iter().copied().unzip();
        let mut matrix = vec![0.0; states * states];
        for a in 0..states {
            for b in 0..states {
                matrix[a * states + b] = f64::from(u8::from(a == b)) - gains[a * count + b];
            }
        }
        let inverse = small::inverse(&matrix, states)?;
        let response = |a: usize, b: usize| -> f64 {
            (0..states).map(|s| -inverse[velocities[a] * states + s] * gains[s * count + count - n + b]).sum()
        };
        let problem = FrictionProblem::new(laws, (0..n * n).map(|at| response(at / n, at % n)).collect())?;
        Ok(Self { problem, outputs, velocities, states, inverse })
    }

    /// Number of bodies.
    pub(super) fn count(&self) -> usize {
        self.problem.count()
    }

    /// State channel of each body's output. It equals the index of the body's equation.
    pub(super) fn outputs(&self) -> &[usize] {
        &self.outputs
    }

    /// Motion of each body, from its contact states pulse by pulse.
    pub(super) fn motions(&self, forcing: &ForcingTerms, contacts: &[BodyState]) -> Vec<BodyMotion> {
        let of = |(body, start): (usize, &(f64, f64))| {
            let pulses = || contacts.iter().skip(body).step_by(self.count()).map(|contact| &contact.pulse);
            BodyMotion {
                force: pulses().map(|pulse| pulse.force).collect(),
                velocity: std::iter::once(start.1).chain(pulses().map(|pulse| pulse.end)).collect(),
                phases: pulses().map(|pulse| pulse.phase).collect(),
            }
        };
        forcing.starts.iter().enumerate().map(of).collect()
    }

    /// Return the contact solver at the start of a run.
    pub(super) fn start(&self, forcing: &ForcingTerms) -> ContactSolver<'_> {
        let initial_velocities: Vec<f64> = forcing.starts.iter().map(|start| start.1).collect();
        let last_outputs = forcing.starts.iter().map(|start| (start.0, true)).collect();
        let largest = |(body, start): (&usize, &f64)| {
            VELOCITY_ROUNDING_RATIO * forcing.channels[*body].iter().fold(start.abs(), |most, v| most.max(v.abs()))
        };
        let rounding = self.velocities.iter().zip(&initial_velocities).map(largest).collect();
        let (velocities, forces) = (initial_velocities.clone(), vec![0.0; self.count()]);
        let is_resting = vec![false; self.count()];
        ContactSolver {
            contact: self,
            initial_velocities,
            velocities,
            last_outputs,
            is_resting,
            forces,
            rounding,
            at: Vec::new(),
            contacts: Vec::new(),
        }
    }

    /// Derivatives of the bodies' friction gains, laws and initial states. `gain_derivatives` holds the derivatives of
    /// the source weights `gains`.
    pub(super) fn derivatives(
        &self,
        gains: &[f64],
        gain_derivatives: &[f64],
        derivatives: &SystemDerivatives,
    ) -> Result<BodyDerivatives> {
        let (states, n) = (self.states, self.count());
        let count = gains.len() / states;
        let of = |a: usize| -> f64 {
            let friction = count - n + a;
            let response: Vec<f64> = (0..states)
                .map(|s| (0..states).map(|r| self.inverse[s * states + r] * gains[r * count + friction]).sum())
                .collect();
            let moved = (0..states).map(|s| {
                let row = &gain_derivatives[s * count..(s + 1) * count];
                row[friction] + row[..states].iter().zip(&response).map(|(g, x)| g * x).sum::<f64>()
            });
            moved.enumerate().map(|(s, v)| -self.inverse[self.velocities[a] * states + s] * v).sum()
        };
        let mut starts = derivatives.forcing.starts.clone();
        starts.resize(n, (0.0, 0.0));
        let mut laws = derivatives.laws.clone();
        laws.resize(n, [0.0; 3]);
        Ok(BodyDerivatives { starts, gains: (0..n).map(of).collect(), laws })
    }

    /// Add the derivatives of the friction forces of a pulse to the derivatives of the sources. Update the derivatives
    /// of outputs and velocities.
    pub(super) fn add_friction_derivatives(
        &self,
        at: &[BodyState],
        derivatives: &BodyDerivatives,
        motion: &mut [(f64, f64)],
        (gains, inverse): (&[f64], &[f64]),
        x: &mut [f64],
    ) -> Result<()> {
        let (states, n, count) = (self.states, self.count(), x.len());
        let moves_freely =
            |state: usize| !at.iter().zip(&self.outputs).any(|(at, &output)| at.is_resting && output == state);
        let free: Vec<usize> = (0..states).filter(|&state| moves_freely(state)).collect();
        // Response of the state channels to a friction, with the non-linear terms.
        let response = |b: usize| -> Vec<f64> {
            let of = |a: usize| free.iter().map(|&s| inverse[a * states + s] * gains[s * count + count - n + b]).sum();
            (0..states).map(of).collect()
        };
        let responses: Vec<Vec<f64>> = (0..n).map(response).collect();
        let (mut matrix, mut right) = (vec![0.0; n * n], vec![0.0; n]);
        for (a, &BodyState { start_velocity: start, free_velocity: free, pulse, .. }) in at.iter().enumerate() {
            let own = self.problem.own(a);
            let slope = self.problem.force_slope(a, start, free, &pulse);
            for b in 0..n {
                let direct = if a == b { 1.0 - slope * own } else { 0.0 };
                matrix[a * n + b] = direct - slope * responses[b][self.velocities[a]];
            }
            let end = derivatives.starts[a].1 + x[self.velocities[a]];
            let moved = PulseDerivatives {
                start: motion[a].1,
                free: end + pulse.force * derivatives.gains[a],
                first: derivatives.gains[a],
                law: derivatives.laws[a],
            };
            right[a] = self.problem.law(a).slope(start, free, own, &pulse, &moved).0;
        }
        let solution = small::inverse(&matrix, n)?;
        for b in 0..n {
            let force: f64 = (0..n).map(|c| solution[b * n + c] * right[c]).sum();
            x[..states].iter_mut().zip(&responses[b]).for_each(|(x, r)| *x += r * force);
            x[count - n + b] = force;
        }
        for (a, motion) in motion.iter_mut().enumerate() {
            *motion = (x[self.outputs[a]], derivatives.starts[a].1 + x[self.velocities[a]]);
        }
        Ok(())
    }

    /// For each body at rest, replace the derivative of its output by the derivative in the last pulse.
    pub(super) fn fix_resting_outputs(&self, at: &[BodyState], motion: &[(f64, f64)], free: &mut [f64]) {
        for (a, _) in at.iter().enumerate().filter(|(_, at)| at.is_resting) {
            free[self.outputs[a]] = motion[a].0;
        }
    }
}

impl ContactSolver<'_> {
    /// Solve a pulse for its state channels and friction forces.
    ///
    /// A constant friction cannot balance a force that varies within the pulse, so the mean output of a body at rest
    /// would drift with the square of the step. The solver keeps it constant from one pulse at rest to the next.
    pub(super) fn solve(&mut self, pulse: &mut impl PulseEquations) -> std::result::Result<(), PulseFailure> {
        for (rests, (before, now)) in self.is_resting.iter_mut().zip(self.last_outputs.iter().zip(&self.velocities)) {
            *rests = before.1 && *now == 0.0;
        }
        loop {
            for (a, rests) in self.is_resting.iter().enumerate() {
                pulse.fix(self.contact.outputs[a], rests.then_some(self.last_outputs[a].0));
            }
            self.solve_friction(pulse)?;
            let mut is_done = true;
            for (rests, (_, found)) in self.is_resting.iter_mut().zip(&self.at) {
                if *rests && found.end != 0.0 {
                    (*rests, is_done) = (false, false);
                }
            }
            if is_done {
                return Ok(());
            }
        }
    }

    fn solve_friction(&mut self, pulse: &mut impl PulseEquations) -> std::result::Result<(), PulseFailure> {
        let (contact, n) = (self.contact, self.contact.count());
        let mut miss = f64::INFINITY;
        let mut size: f64 = 0.0;
        for _ in 0..MAX_PULSE_ITERATIONS {
            pulse.solve_with(&self.forces)?;
            let through = |a: usize| (0..n).map(|b| contact.problem.gain(a, b) * self.forces[b]).sum::<f64>();
            let free: Vec<f64> = (0..n)
                .map(|a| self.initial_velocities[a] + *pulse.channel(contact.velocities[a]) + through(a))
                .collect();
            for (rounding, free) in self.rounding.iter_mut().zip(&free) {
                *rounding = f64::max(*rounding, VELOCITY_ROUNDING_RATIO * free.abs());
            }
            contact.problem.solve(&self.velocities, &free, &self.rounding, &self.forces, &mut self.at);
            (miss, size) = (0.0, 0.0);
            for (a, (_, found)) in self.at.iter().enumerate() {
                let own = contact.problem.own(a);
                miss = f64::max(miss, (found.force - self.forces[a]).abs() * own);
                size = size.max(self.velocities[a].abs() + free[a].abs() + contact.problem.breakaway(a) * own);
                self.forces[a] = found.force;
            }
            if self.at.iter().any(|(_, found)| found.end.is_nan()) {
                return Err(PulseFailure::Overflow);
            }
            if miss <= FRICTION_ROUNDING_RATIO * size {
                break;
            }
            if pulse.is_linear() {
                // The frictions do not depend on the state channels, which follow from them.
                pulse.solve_with(&self.forces)?;
                miss = 0.0;
                break;
            }
        }
        if miss > MAX_FRICTION_ERROR_RATIO * size {
            return Err(PulseFailure::Contact);
        }
        for (a, (_, found)) in self.at.iter().enumerate() {
            *pulse.channel(contact.velocities[a]) = found.end - self.initial_velocities[a];
        }
        Ok(())
    }

    /// Advance to the next pulse. Return the contact states of the solved pulse, whose state channels are `z`.
    pub(super) fn advance(&mut self, z: &[f64]) -> &[BodyState] {
        self.contacts.clear();
        for (a, &(free_velocity, pulse)) in self.at.iter().enumerate() {
            let start_velocity = self.velocities[a];
            self.contacts.push(BodyState { start_velocity, free_velocity, is_resting: self.is_resting[a], pulse });
            self.last_outputs[a] = (z[self.contact.outputs[a]], start_velocity == 0.0 && pulse.end == 0.0);
            self.velocities[a] = pulse.end;
        }
        &self.contacts
    }
}

//! Dry friction in a simulation: friction forces of a pulse, and their derivatives.
//!
//! The velocity of a body at the end of a pulse is e = p − G φ. φ is the friction force, p the end velocity without
//! friction, and G the decrease of velocity per unit of friction. Non-linear terms change p only slightly within a
//! pulse, so the iteration for φ converges in a few steps.

use super::channels::{ForcingTerms, PulseFailure, SystemDerivatives};
use super::jumps::{ForceJumps, Interval};
use crate::error::Result;
use crate::friction::contact::{FrictionProblem, MAX_FRICTION_ERROR_RATIO, VELOCITY_ROUNDING_RATIO};
use crate::friction::law::{FrictionLaw, Phase, Pulse as FrictionPulse, PulseDerivatives};
use crate::linalg::small;

/// Maximum number of iterations in a pulse. Each of them solves for the state channels, then for the friction forces.
/// Three are usual.
const MAX_PULSE_ITERATIONS: usize = 60;
/// Maximum error of a friction force after the iteration has converged. The error is expressed as the velocity change
/// that it causes, relative to the velocities of the pulse.
const FRICTION_ROUNDING_RATIO: f64 = 64.0 * f64::EPSILON;

/// Equations of one pulse of a simulation, which can be solved at given friction forces.
pub(super) trait PulseEquations {
    /// True if the state channels are linear in the friction forces.
    fn is_linear(&self) -> bool;

    /// Solve the equations for the state channels at the friction forces `frictions`, one per body.
    fn solve_with(&mut self, frictions: &[f64]) -> std::result::Result<(), PulseFailure>;

    /// Return a mutable reference to the value of a state channel.
    fn channel(&mut self, state: usize) -> &mut f64;

    /// Fix a state channel at a value. With None, the equations determine it.
    fn fix(&mut self, state: usize, value: Option<f64>);
}

/// Friction problem of a simulation, with the state channels of its bodies.
pub(super) struct ContactOperators {
    /// Friction laws and gains. A gain is the decrease of a body's velocity at the end of a pulse per unit of friction
    /// force, without the non-linear terms.
    problem: FrictionProblem,
    /// Index of the state channel of the output of each body.
    outputs: Vec<usize>,
    /// Index of the state channel of the velocity of each body at the ends of pulses.
    velocities: Vec<usize>,
    /// Number of state channels.
    states: usize,
    /// Inverse of the matrix of the linear equations for the state channels in a pulse, without non-linear terms.
    /// Row-major.
    inverse: Vec<f64>,
}

/// Motion of one body with friction in a simulation.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyMotion {
    /// Mean friction force over each pulse, in the unit of the highest derivative D^α y in its equation. Up to
    /// rounding, its magnitude is at most the breakaway force.
    pub force: Vec<f64>,
    /// Velocity at the pulse edges: one value more than there are pulses. Exactly 0 at rest.
    pub velocity: Vec<f64>,
    /// Phase of the body in each pulse: sliding, at rest, or reversing.
    pub phases: Vec<Phase>,
}

/// Motion and friction of one body in one interval of a pulse.
#[derive(Debug, Clone, Copy)]
pub(super) struct BodyState {
    /// Length of the interval as a fraction of the pulse.
    length: f64,
    /// Change of velocity in a whole pulse if the forces of this interval acted throughout and there were no friction.
    frictionless_change: f64,
    /// Velocity at the start of the interval.
    start_velocity: f64,
    /// Velocity at the end of the interval without the body's own friction.
    free_velocity: f64,
    /// True if the body is at rest in the current and the previous pulse, so that its mean output is constant.
    is_resting: bool,
    pulse: FrictionPulse,
}

/// Motion and friction of each body in each interval of each pulse of a run.
pub(super) struct ContactStates {
    states: Vec<BodyState>,
    /// Index in `states` of the first state of each pulse. The last entry is the number of states.
    first_indices: Vec<usize>,
}

impl ContactStates {
    /// States of a run before its first pulse: an empty list.
    pub(super) fn empty() -> Self {
        Self { states: Vec::new(), first_indices: vec![0] }
    }

    /// Append the states of one pulse.
    pub(super) fn push(&mut self, states: &[BodyState]) {
        self.states.extend_from_slice(states);
        self.first_indices.push(self.states.len());
    }

    /// Return the states of one pulse: those of all bodies in its first interval, then in its second, and so on.
    fn pulse_states(&self, pulse: usize) -> &[BodyState] {
        &self.states[self.first_indices[pulse]..self.first_indices[pulse + 1]]
    }
}

/// Derivatives of the initial states, gains and friction laws of the bodies with respect to one parameter.
pub(super) struct BodyDerivatives {
    /// Derivatives of the initial output and velocity of each body.
    pub(super) initial_motion: Vec<(f64, f64)>,
    /// Derivatives of the gains G_ab, row-major. G_ab is the decrease of the velocity of body a at the end of a pulse
    /// per unit of friction force on body b.
    gains: Vec<f64>,
    /// Derivatives of Coulomb friction, Stribeck friction and Stribeck velocity of each body.
    laws: Vec<[f64; 3]>,
}

/// Derivatives with respect to one parameter of the velocities, gains, friction laws and intervals that determine the
/// friction forces of a pulse.
struct PulseInputDerivatives<'a> {
    /// Derivatives of the velocities of the bodies at the start of the pulse.
    start_velocities: &'a [f64],
    /// Derivatives of the velocities of the bodies at the end of the pulse without friction.
    end_velocities: &'a [f64],
    /// Derivatives of the gains G_ab, as in [`BodyDerivatives`].
    gains: &'a [f64],
    /// Derivatives of Coulomb friction, Stribeck friction and Stribeck velocity of each body.
    laws: &'a [[f64; 3]],
    /// Derivatives of the lengths and forces of the intervals of the pulse.
    intervals: &'a [Interval],
}

/// Workspace for the derivatives of the friction forces of one pulse. Every vector has one entry per body.
#[derive(Default)]
struct DerivativeWorkspace {
    velocities: Vec<f64>,
    /// Derivatives of the mean friction forces.
    means: Vec<f64>,
    slopes: Vec<f64>,
    forces: Vec<f64>,
    end_velocities: Vec<f64>,
}

/// Derivatives of the outputs and velocities of the bodies with respect to one parameter. They advance from pulse to
/// pulse.
pub(super) struct MotionDerivatives {
    outputs: Vec<f64>,
    velocities: Vec<f64>,
    /// Derivatives of the velocities at the end of the current pulse without friction.
    end_velocities: Vec<f64>,
    work: DerivativeWorkspace,
}

impl MotionDerivatives {
    /// Derivatives of outputs and velocities at the start of a run.
    pub(super) fn start(derivatives: &BodyDerivatives) -> Self {
        let (outputs, velocities): (Vec<f64>, Vec<f64>) = derivatives.initial_motion.iter().copied().unzip();
        Self { end_velocities: vec![0.0; outputs.len()], outputs, velocities, work: DerivativeWorkspace::default() }
    }
}

/// Linear responses to the friction forces in each pulse of a run. They are the same for all parameters.
pub(super) struct ContactResponses {
    /// Response of each state channel to a unit of each mean friction force. The elements are stored by pulse, then by
    /// body, then by channel.
    channels: Vec<f64>,
    /// Matrix of each pulse, row-major. It maps changes of the mean friction forces at fixed state channels to changes
    /// that include the feedback through the state channels.
    feedback: Vec<f64>,
}

/// Solver for the friction forces of all bodies, pulse by pulse.
pub(super) struct ContactSolver<'a> {
    contact: &'a ContactOperators,
    /// Velocities at the start of the run.
    initial_velocities: Vec<f64>,
    /// Velocities at the start of the current pulse.
    velocities: Vec<f64>,
    /// Mean output of each body in the previous pulse, and whether the body was at rest in that pulse.
    last_outputs: Vec<(f64, bool)>,
    /// For each body, whether it is at rest in the current and the previous pulse.
    is_resting: Vec<bool>,
    /// Mean friction force on each body in the current pulse.
    forces: Vec<f64>,
    rounding: Vec<f64>,
    /// State of each body in each interval of the current pulse.
    contacts: Vec<BodyState>,
    work: IntervalWorkspace,
}

/// Workspace for the friction problems of the intervals of a pulse. Every vector has one entry per body.
#[derive(Default)]
struct IntervalWorkspace {
    velocities: Vec<f64>,
    forces: Vec<f64>,
    frictionless: Vec<f64>,
    frictionless_changes: Vec<f64>,
    solutions: Vec<(f64, FrictionPulse)>,
}

impl ContactOperators {
    /// Return the friction problem of a simulation for bodies with these friction laws.
    ///
    /// `channels` holds, for each body, the state channels of its output and of its velocity at the end of a pulse.
    /// `gains` is row-major with one row per state channel. A row holds the contributions of a unit of each state
    /// channel, non-linear term and friction force to this channel within the same pulse. `states` is the number of
    /// state channels. Return an error if the equations of a pulse are singular, or if coupled bodies have no unique
    /// friction forces.
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
        let problem = FrictionProblem::new(laws, (0..n * n).map(|index| response(index / n, index % n)).collect())?;
        Ok(Self { problem, outputs, velocities, states, inverse })
    }

    /// Number of bodies.
    pub(super) fn count(&self) -> usize {
        self.problem.count()
    }

    /// Return the index of the state channel of each body's output. It equals the index of the body's equation.
    pub(super) fn outputs(&self) -> &[usize] {
        &self.outputs
    }

    /// Return the motion of each body. `forcing` holds the initial velocities, and `contacts` the states of all pulses.
    pub(super) fn motions(&self, forcing: &ForcingTerms, contacts: &ContactStates) -> Vec<BodyMotion> {
        let motion_of_body = |(body, start): (usize, &(f64, f64))| {
            let mut motion = BodyMotion { force: Vec::new(), velocity: vec![start.1], phases: Vec::new() };
            for pulse in 0..contacts.first_indices.len() - 1 {
                let states = || contacts.pulse_states(pulse).iter().skip(body).step_by(self.count());
                motion.force.push(states().map(|state| state.length * state.pulse.force).sum());
                if let Some(last) = states().next_back() {
                    motion.velocity.push(last.pulse.end);
                    motion.phases.push(last.pulse.phase);
                }
            }
            motion
        };
        forcing.initial_motion.iter().enumerate().map(motion_of_body).collect()
    }

    /// Return the solver at the start of a run, with the initial outputs and velocities of `forcing`.
    pub(super) fn start(&self, forcing: &ForcingTerms) -> ContactSolver<'_> {
        let initial_velocities: Vec<f64> = forcing.initial_motion.iter().map(|start| start.1).collect();
        let last_outputs = forcing.initial_motion.iter().map(|start| (start.0, true)).collect();
        let rounding_error = |(body, start): (&usize, &f64)| {
            VELOCITY_ROUNDING_RATIO * forcing.channels[*body].iter().fold(start.abs(), |peak, v| peak.max(v.abs()))
        };
        let rounding = self.velocities.iter().zip(&initial_velocities).map(rounding_error).collect();
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
            contacts: Vec::new(),
            work: IntervalWorkspace::default(),
        }
    }

    /// Return the derivatives of the bodies' gains, friction laws and initial states with respect to a parameter.
    /// `gains` holds the contributions within a pulse ([`ContactOperators::new`]), and `gain_derivatives` their
    /// derivatives.
    pub(super) fn derivatives(
        &self,
        gains: &[f64],
        gain_derivatives: &[f64],
        derivatives: &SystemDerivatives,
    ) -> Result<BodyDerivatives> {
        let (states, n) = (self.states, self.count());
        let count = gains.len() / states;
        let gain_derivative = |index: usize| -> f64 {
            let (a, friction) = (index / n, count - n + index % n);
            let response: Vec<f64> = (0..states)
                .map(|s| (0..states).map(|r| self.inverse[s * states + r] * gains[r * count + friction]).sum())
                .collect();
            let direct_changes = (0..states).map(|s| {
                let row = &gain_derivatives[s * count..(s + 1) * count];
                row[friction] + row[..states].iter().zip(&response).map(|(g, x)| g * x).sum::<f64>()
            });
            direct_changes.enumerate().map(|(s, v)| -self.inverse[self.velocities[a] * states + s] * v).sum()
        };
        let mut initial_motion = derivatives.forcing.initial_motion.clone();
        initial_motion.resize(n, (0.0, 0.0));
        let mut laws = derivatives.laws.clone();
        laws.resize(n, [0.0; 3]);
        Ok(BodyDerivatives { initial_motion, gains: (0..n * n).map(gain_derivative).collect(), laws })
    }

    /// Compute the derivatives of the mean friction force on each body in a pulse and write them to `work.means`.
    /// `pulse_states` holds the solved states of the pulse.
    fn force_derivatives(
        &self,
        pulse_states: &[BodyState],
        intervals: &[Interval],
        inputs: &PulseInputDerivatives<'_>,
        work: &mut DerivativeWorkspace,
    ) {
        let (n, problem) = (self.count(), &self.problem);
        let DerivativeWorkspace { velocities, means, slopes, forces, end_velocities } = work;
        velocities.clear();
        velocities.extend_from_slice(inputs.start_velocities);
        for row in [&mut *means, slopes, forces, end_velocities] {
            row.clear();
            row.resize(n, 0.0);
        }
        for ((states, interval), change) in pulse_states.chunks(n).zip(intervals).zip(inputs.intervals) {
            let length = interval.length;
            let gain = |a: usize, b: usize| change.length * problem.gain(a, b) + length * inputs.gains[a * n + b];
            for (a, state) in states.iter().enumerate() {
                let force_change =
                    |b: usize| inputs.gains[a * n + b] * interval.forces[b] + problem.gain(a, b) * change.forces[b];
                let frictionless_change =
                    inputs.end_velocities[a] - inputs.start_velocities[a] + (0..n).map(force_change).sum::<f64>();
                let coupling_change = |b: usize| if a == b { 0.0 } else { gain(a, b) * states[b].pulse.force };
                let free = velocities[a] + change.length * state.frictionless_change + length * frictionless_change
                    - (0..n).map(coupling_change).sum::<f64>();
                let derivatives =
                    PulseDerivatives { start: velocities[a], free, gain: gain(a, a), law: inputs.laws[a] };
                let (law, own_gain) = (problem.law(a), length * problem.own_gain(a));
                end_velocities[a] = free - gain(a, a) * state.pulse.force;
                forces[a] =
                    law.slope(state.start_velocity, state.free_velocity, own_gain, &state.pulse, &derivatives).0;
                if n > 1 {
                    let free_pulse = (state.free_velocity, state.pulse);
                    slopes[a] = problem.force_slope(a, length, state.start_velocity, &free_pulse);
                }
            }
            if n > 1 {
                *forces = problem.solve_coupled(length, slopes, forces);
            }
            for (a, state) in states.iter().enumerate() {
                let friction_change: f64 = (0..n).map(|b| length * problem.gain(a, b) * forces[b]).sum();
                velocities[a] =
                    if state.pulse.phase == Phase::Stick { 0.0 } else { end_velocities[a] - friction_change };
                means[a] += change.length * state.pulse.force + length * forces[a];
            }
        }
    }

    /// Return the linear responses to the mean friction forces in each pulse. `inverses` holds the inverse Jacobian of
    /// the equations of each pulse.
    ///
    /// # Errors
    /// [`Error::LeadingZero`](crate::error::Error::LeadingZero) for a singular matrix.
    pub(super) fn responses(
        &self,
        contacts: &ContactStates,
        jumps: &ForceJumps,
        gains: &[f64],
        inverses: &[f64],
    ) -> Result<ContactResponses> {
        let (states, n) = (self.states, self.count());
        let count = gains.len() / states;
        let mut out = ContactResponses { channels: Vec::new(), feedback: Vec::new() };
        let (zeros, no_gains, no_laws) = (vec![0.0; n], vec![0.0; n * n], vec![[0.0; 3]; n]);
        let (mut unit, mut matrix, mut work) = (zeros.clone(), no_gains.clone(), DerivativeWorkspace::default());
        for (pulse, inverse) in inverses.chunks(states * states).enumerate() {
            let pulse_states = contacts.pulse_states(pulse);
            let moves_freely = |state: usize| {
                !pulse_states.iter().zip(&self.outputs).any(|(body, &output)| body.is_resting && output == state)
            };
            let first = out.channels.len();
            for b in 0..n {
                for a in 0..states {
                    let path = |s: usize| inverse[a * states + s] * gains[s * count + count - n + b];
                    out.channels.push((0..states).filter(|&s| moves_freely(s)).map(path).sum());
                }
            }
            let intervals = jumps.intervals(pulse);
            let constant = vec![Interval { length: 0.0, forces: zeros.clone() }; intervals.len()];
            (0..n * n).for_each(|index| matrix[index] = f64::from(u8::from(index % (n + 1) == 0)));
            for c in 0..n {
                unit.fill(0.0);
                unit[c] = 1.0;
                let inputs = PulseInputDerivatives {
                    start_velocities: &zeros,
                    end_velocities: &unit,
                    gains: &no_gains,
                    laws: &no_laws,
                    intervals: &constant,
                };
                self.force_derivatives(pulse_states, &intervals, &inputs, &mut work);
                for (a, slope) in work.means.iter().enumerate() {
                    for b in 0..n {
                        let channel_response = out.channels[first + b * states + self.velocities[c]];
                        matrix[a * n + b] -= slope * (channel_response + self.problem.gain(c, b));
                    }
                }
            }
            if n == 1 {
                out.feedback.push(1.0 / matrix[0]);
            } else {
                out.feedback.extend(small::inverse(&matrix, n)?);
            }
        }
        Ok(out)
    }

    /// Compute the derivatives of the friction forces of a pulse, add their effect to the derivatives `x` of all pulse
    /// means, and update `motion`. `changes` holds the derivatives of the intervals of the pulse.
    pub(super) fn add_friction_derivatives(
        &self,
        (contacts, responses, pulse): (&ContactStates, &ContactResponses, usize),
        (intervals, changes): (&[Interval], &[Interval]),
        derivatives: &BodyDerivatives,
        motion: &mut MotionDerivatives,
        x: &mut [f64],
    ) {
        let pulse_states = contacts.pulse_states(pulse);
        let (states, n, count) = (self.states, self.count(), x.len());
        let MotionDerivatives { outputs, velocities, end_velocities, work } = motion;
        for (a, end) in end_velocities.iter_mut().enumerate() {
            let gain_change = |state: (usize, &BodyState)| {
                derivatives.gains[a * n + state.0 % n] * state.1.length * state.1.pulse.force
            };
            *end = derivatives.initial_motion[a].1
                + x[self.velocities[a]]
                + pulse_states.iter().enumerate().map(gain_change).sum::<f64>();
        }
        let inputs = PulseInputDerivatives {
            start_velocities: velocities,
            end_velocities,
            gains: &derivatives.gains,
            laws: &derivatives.laws,
            intervals: changes,
        };
        self.force_derivatives(pulse_states, intervals, &inputs, work);
        let solution = &responses.feedback[pulse * n * n..(pulse + 1) * n * n];
        let channels = &responses.channels[pulse * n * states..(pulse + 1) * n * states];
        for b in 0..n {
            let force: f64 = (0..n).map(|c| solution[b * n + c] * work.means[c]).sum();
            x[..states].iter_mut().zip(&channels[b * states..]).for_each(|(x, r)| *x += r * force);
            x[count - n + b] = force;
        }
        for a in 0..n {
            (outputs[a], velocities[a]) = (x[self.outputs[a]], derivatives.initial_motion[a].1 + x[self.velocities[a]]);
        }
    }

    /// Set the derivative of the output of each body at rest to its value in the previous pulse.
    pub(super) fn fix_resting_outputs(
        &self,
        contacts: &ContactStates,
        pulse: usize,
        motion: &MotionDerivatives,
        free: &mut [f64],
    ) {
        for (a, _) in
            contacts.pulse_states(pulse).iter().take(self.count()).enumerate().filter(|(_, state)| state.is_resting)
        {
            free[self.outputs[a]] = motion.outputs[a];
        }
    }
}

impl ContactSolver<'_> {
    /// Solve a pulse for its state channels and friction forces.
    ///
    /// The mean output of a body at rest is fixed at its value in the previous pulse. It would otherwise drift with the
    /// square of the step, because a constant friction force cannot balance a force that varies within the pulse.
    pub(super) fn solve(
        &mut self,
        pulse: &mut impl PulseEquations,
        intervals: &[Interval],
    ) -> std::result::Result<(), PulseFailure> {
        for (is_resting, (last_output, velocity)) in
            self.is_resting.iter_mut().zip(self.last_outputs.iter().zip(&self.velocities))
        {
            *is_resting = last_output.1 && *velocity == 0.0;
        }
        loop {
            for (a, is_resting) in self.is_resting.iter().enumerate() {
                pulse.fix(self.contact.outputs[a], is_resting.then_some(self.last_outputs[a].0));
            }
            self.solve_friction(pulse, intervals)?;
            let mut is_done = true;
            for a in 0..self.contact.count() {
                if self.is_resting[a] && !self.is_at_rest(a) {
                    (self.is_resting[a], is_done) = (false, false);
                }
            }
            if is_done {
                return Ok(());
            }
        }
    }

    /// True if a body is at rest during the whole pulse.
    fn is_at_rest(&self, body: usize) -> bool {
        let mut states = self.contacts.iter().skip(body).step_by(self.contact.count());
        self.velocities[body] == 0.0 && states.all(|state| state.pulse.end == 0.0)
    }

    /// Velocity of a body at the end of the pulse.
    fn end_velocity(&self, body: usize) -> f64 {
        self.contacts[self.contacts.len() - self.contact.count() + body].pulse.end
    }

    fn solve_friction(
        &mut self,
        pulse: &mut impl PulseEquations,
        intervals: &[Interval],
    ) -> std::result::Result<(), PulseFailure> {
        let (contact, n) = (self.contact, self.contact.count());
        let mut error = f64::INFINITY;
        let mut velocity_scale: f64 = 0.0;
        for _ in 0..MAX_PULSE_ITERATIONS {
            pulse.solve_with(&self.forces)?;
            let friction_change = |a: usize| (0..n).map(|b| contact.problem.gain(a, b) * self.forces[b]).sum::<f64>();
            let free: Vec<f64> = (0..n)
                .map(|a| self.initial_velocities[a] + *pulse.channel(contact.velocities[a]) + friction_change(a))
                .collect();
            for (rounding, free) in self.rounding.iter_mut().zip(&free) {
                *rounding = f64::max(*rounding, VELOCITY_ROUNDING_RATIO * free.abs());
            }
            self.solve_intervals(&free, intervals);
            (error, velocity_scale) = (0.0, 0.0);
            for (a, free) in free.iter().enumerate() {
                let states = self.contacts.iter().skip(a).step_by(n);
                let force: f64 = states.map(|state| state.length * state.pulse.force).sum();
                let own_gain = contact.problem.own_gain(a);
                error = f64::max(error, (force - self.forces[a]).abs() * own_gain);
                velocity_scale =
                    velocity_scale.max(self.velocities[a].abs() + free.abs() + contact.problem.breakaway(a) * own_gain);
                self.forces[a] = force;
            }
            if self.contacts.iter().any(|state| state.pulse.end.is_nan()) {
                return Err(PulseFailure::Overflow);
            }
            if error <= FRICTION_ROUNDING_RATIO * velocity_scale {
                break;
            }
            if pulse.is_linear() && !self.is_resting.contains(&true) {
                // With linear equations, this iteration found the exact friction forces. The state channels follow from
                // them. If a body rests, its fixed output changes the gains, so that the iteration continues.
                pulse.solve_with(&self.forces)?;
                error = 0.0;
                break;
            }
        }
        if error > MAX_FRICTION_ERROR_RATIO * velocity_scale {
            return Err(PulseFailure::Contact);
        }
        for a in 0..n {
            *pulse.channel(contact.velocities[a]) = self.end_velocity(a) - self.initial_velocities[a];
        }
        Ok(())
    }

    /// Solve the friction problem of each interval of the pulse. `free` holds the velocity of each body at the end of
    /// the pulse without friction.
    fn solve_intervals(&mut self, free: &[f64], intervals: &[Interval]) {
        let (problem, n) = (&self.contact.problem, self.contact.count());
        let IntervalWorkspace { velocities, forces, frictionless, frictionless_changes, solutions } = &mut self.work;
        velocities.clone_from(&self.velocities);
        forces.clone_from(&self.forces);
        self.contacts.clear();
        for Interval { length, forces: force_offsets } in intervals {
            frictionless_changes.clear();
            frictionless.clear();
            for (a, (&free, &start)) in free.iter().zip(&self.velocities).enumerate() {
                let end = free + (0..n).map(|b| problem.gain(a, b) * force_offsets[b]).sum::<f64>();
                frictionless_changes.push(end - start);
                // This value is exactly `free` if the interval is the whole pulse.
                frictionless.push(length * end + (velocities[a] - length * start));
            }
            problem.solve(*length, (velocities, frictionless), &self.rounding, forces, solutions);
            for (a, &(free_velocity, pulse)) in solutions.iter().enumerate() {
                self.contacts.push(BodyState {
                    length: *length,
                    frictionless_change: frictionless_changes[a],
                    start_velocity: velocities[a],
                    free_velocity,
                    is_resting: self.is_resting[a],
                    pulse,
                });
                (velocities[a], forces[a]) = (pulse.end, pulse.force);
            }
        }
    }

    /// Advance to the next pulse. `z` holds the state channels of the solved pulse, whose contact states are returned.
    pub(super) fn advance(&mut self, z: &[f64]) -> &[BodyState] {
        for a in 0..self.contact.count() {
            self.last_outputs[a] = (z[self.contact.outputs[a]], self.is_at_rest(a));
        }
        for a in 0..self.contact.count() {
            self.velocities[a] = self.end_velocity(a);
        }
        &self.contacts
    }
}

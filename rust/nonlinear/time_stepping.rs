//! Simulation of equations with non-linear terms, pulse by pulse, and its sensitivities to parameters.
//!
//! A state channel is an output, or a derivative D^ρ of an output that enters an expression. Its pulse means are L + Σ
//! κ_η ∗ (w x), summed over the terms of its equation. L is the part due to inputs and initial terms. κ_η is the kernel
//! of the fractional integral I^η. w is the coefficient of the term, and x a state channel or the value of an
//! expression. The autoregressive terms are not inverted, so no kernel grows exponentially, and an unstable linear part
//! loses no digits. The scheme is implicit. Newton iterations solve each pulse, starting from an extrapolation of the
//! last three pulses. Sensitivities satisfy the same equations, linearized at the simulation, and need no iteration.

use super::channels::{ForcingTerms, PulseFailure};
use super::contact::{BodyMotion, ContactStates};
use super::convolution::OnlineConvolution;
use super::input_continuation::{ContinuedPulse, InputContinuation};
use super::operators::{Contribution, Operators};
use super::pulse::Pulse;
use super::system::NonlinearSystem;
use crate::equation::ORDER_GRAIN;
use crate::error::Error;

/// Simulation of a run with the linearization of its equations in every pulse.
pub(super) struct LinearizedRun {
    /// Pulse means of each source: state channels, then non-linear terms, then friction forces.
    pub(super) sources: Vec<Vec<f64>>,
    /// Derivatives of the non-linear terms with respect to the state channels, then the input channels. One row-major
    /// matrix per pulse, with additional zero rows for friction forces.
    pub(super) slopes: Vec<f64>,
    /// Inverse Jacobian of the equations in each pulse, row-major.
    pub(super) inverses: Vec<f64>,
    pub(super) contacts: ContactStates,
    /// Continuation of the inputs after samples at which they jump; None if no input jumps, or with friction.
    pub(super) continuation: Option<InputContinuation>,
    /// Pulses after these samples, solved with continued inputs.
    pub(super) continued_pulses: Vec<ContinuedPulse>,
}

/// Early end of a simulation: index of the pulse that has no solution, and the reason.
pub(super) struct EarlyEnd {
    pub(super) index: usize,
    pub(super) reason: String,
    pub(super) is_overflow: bool,
}

impl EarlyEnd {
    pub(super) fn error(self, step: f64) -> Error {
        #[allow(clippy::cast_precision_loss)]
        let time = (self.index as f64 + 0.5) * step;
        if self.is_overflow {
            Error::Diverged { what: format!("simulation (at {time:.4} s)"), index: self.index }
        } else {
            Error::NoSolution { time, index: self.index, reason: self.reason }
        }
    }
}

impl Operators {
    /// Return the motion of each body with friction in a simulated run.
    pub(super) fn body_motions(&self, forcing: &ForcingTerms, run: &LinearizedRun) -> Vec<BodyMotion> {
        self.contact.as_ref().map_or_else(Vec::new, |contact| contact.motions(forcing, &run.contacts))
    }

    /// Simulate with the given forcing of the state channels. With a `continuation` of the inputs, the pulses after
    /// samples are also solved with continued inputs. It is None for systems with friction.
    ///
    /// The second result is None for a complete run. If the simulation ends early, it holds the pulse and the reason,
    /// and the run consists of the pulses before it.
    pub(super) fn run(
        &self,
        system: &NonlinearSystem,
        forcing: &ForcingTerms,
        continuation: Option<InputContinuation>,
    ) -> (LinearizedRun, Option<EarlyEnd>) {
        let (states, count) = (self.states.len(), self.sources());
        let width = states + self.input_means.len();
        let mut run = LinearizedRun {
            sources: vec![Vec::with_capacity(self.m); count],
            slopes: Vec::with_capacity(self.m * self.values() * width),
            inverses: Vec::with_capacity(self.m * states * states),
            contacts: ContactStates::empty(),
            continuation: None,
            continued_pulses: Vec::new(),
        };
        let mut convolutions: Vec<OnlineConvolution<'_>> =
            self.kernel_contributions.iter().map(|group| OnlineConvolution::new(&self.kernels[group.kernel])).collect();
        let mut pulse = Pulse::new(self, system);
        let mut sign = None;
        let mut motion = self.contact.as_ref().map(|contact| contact.start(forcing));
        for k in 0..self.m {
            pulse.free.iter_mut().zip(&forcing.channels).for_each(|(free, row)| *free = row[k]);
            for (group, convolution) in self.kernel_contributions.iter().zip(&convolutions) {
                pulse.free[group.state] += convolution.past_contribution();
            }
            pulse.predict(&run.sources);
            pulse.input_means.iter_mut().zip(&self.input_means).for_each(|(value, (_, means))| *value = means[k]);
            let start = continuation.as_ref().and_then(|inputs| Some((inputs, inputs.sample_at_start(k)?)));
            let continued = start.map(|(inputs, sample)| self.solve_continued(system, &mut pulse, inputs, (k, sample)));
            match continued.transpose() {
                Ok(continued) => run.continued_pulses.extend(continued),
                Err(failure) => return (run, Some(self.early_end(k, failure))),
            }
            let solved = match &mut motion {
                Some(motion) => motion.solve(&mut pulse, &self.jumps.intervals(k)),
                None => pulse.solve(),
            };
            if let Err(failure) = solved {
                return (run, Some(self.early_end(k, failure)));
            }
            let is_positive = pulse.determinant > 0.0;
            if *sign.get_or_insert(is_positive) != is_positive {
                let reason =
                    "the Jacobian of the equations is singular, and they have no solution beyond this point".into();
                return (run, Some(EarlyEnd { index: k, reason, is_overflow: !self.is_algebraic }));
            }
            let values = pulse.z.iter().chain(&pulse.values);
            run.sources.iter_mut().zip(values).for_each(|(row, v)| row.push(*v));
            run.slopes.extend_from_slice(&pulse.slopes);
            run.inverses.extend_from_slice(&pulse.inverse);
            if let Some(motion) = &mut motion {
                run.contacts.push(motion.advance(&pulse.z));
            }
            for (group, convolution) in self.kernel_contributions.iter().zip(&mut convolutions) {
                let weighted_value =
                    |contribution: &Contribution| contribution.weight * pulse.source(contribution.source);
                convolution.push(group.contributions.iter().map(weighted_value).sum());
            }
        }
        run.continuation = continuation;
        (run, None)
    }

    /// Solve a pulse with inputs that continue from before the sample at its start. `pulse` is unchanged except for its
    /// work arrays. `pulse_and_sample` holds the indices of the pulse and of the compared sample.
    fn solve_continued(
        &self,
        system: &NonlinearSystem,
        pulse: &mut Pulse<'_>,
        continuation: &InputContinuation,
        (index, sample): (usize, usize),
    ) -> std::result::Result<ContinuedPulse, PulseFailure> {
        let (free, input_means, start) = (pulse.free.clone(), pulse.input_means.clone(), pulse.z.clone());
        for input in &self.inputs {
            let weight = system.equations[input.term.0].coefficients[input.term.1];
            let first = self.kernels[input.kernel].values().first().copied().unwrap_or(0.0);
            pulse.free[input.state] += weight * first * continuation.continued_minus_actual(input.signal, sample);
        }
        // A derivative of an input is infinite at a jump, so only the inputs themselves are continued.
        let channels = pulse.input_means.iter_mut().zip(&self.input_means);
        channels
            .filter(|(_, ((_, order), _))| *order < ORDER_GRAIN)
            .for_each(|(value, ((signal, _), _))| *value += continuation.continued_minus_actual(*signal, sample));
        pulse.solve()?;
        let continued = ContinuedPulse {
            pulse: index,
            sample,
            sources: pulse.z.iter().chain(&pulse.values).copied().collect(),
            slopes: pulse.slopes.clone(),
            inverse: pulse.inverse.clone(),
        };
        (pulse.free, pulse.input_means, pulse.z) = (free, input_means, start);
        Ok(continued)
    }

    /// Return the end of a simulation at a pulse that has no solution.
    fn early_end(&self, index: usize, failure: PulseFailure) -> EarlyEnd {
        let (reason, is_overflow) = match failure {
            PulseFailure::Overflow => (String::new(), true),
            PulseFailure::Domain(name, argument) => (format!("{name} of {argument:.6} has no value"), false),
            PulseFailure::Contact => ("no friction force is consistent with the motion".into(), false),
            // Without algebraic terms, short pulses have a solution unless a value grows without bound in one.
            PulseFailure::Newton(reason) => (reason.into(), !self.is_algebraic),
        };
        EarlyEnd { index, reason, is_overflow }
    }
}

impl LinearizedRun {
    /// Return the corrections of the compared samples of each output: half of the change of the pulse mean after the
    /// sample if the inputs continue.
    pub(super) fn sample_corrections(&self, outputs: usize, samples: usize) -> Vec<Vec<f64>> {
        let mut out = vec![vec![0.0; samples]; outputs];
        for continued in &self.continued_pulses {
            for ((row, means), value) in out.iter_mut().zip(&self.sources).zip(&continued.sources) {
                row[continued.sample] = 0.5 * (value - means[continued.pulse]);
            }
        }
        out
    }
}

//! Jumps of the forces on bodies with friction within a pulse.
//!
//! An input with zero-order hold and a delay that is not a multiple of the pulse length jumps within pulses. A body may
//! rest until the jump and slide after it, which the mean force of the pulse does not represent. The friction of such a
//! pulse is therefore computed interval by interval between the jumps. Only terms c u of inputs u are treated this way.
//! Inputs that are differentiated or enter non-linear terms are replaced by their pulse means.

use std::borrow::Cow;

use super::channels::SystemDerivatives;
use super::system::NonlinearSystem;
use crate::equation::ORDER_GRAIN;
use crate::regressors::Record;

/// Interval of a pulse between two jumps, or the derivative of such an interval with respect to a parameter.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Interval {
    /// Length as a fraction of the pulse.
    pub(super) length: f64,
    /// External force on each body minus its mean over the pulse, in the unit of the highest derivative D^α y in the
    /// equation of the body.
    pub(super) forces: Vec<f64>,
}

/// Jump of an input by `size` in the pulse with index `pulse`. `fraction` is the fraction of the pulse before the jump.
#[derive(Debug, Clone, Copy)]
struct InputJump {
    pulse: usize,
    fraction: f64,
    size: f64,
    signal: usize,
    /// Index of the jump among the jumps of its signal.
    index: usize,
}

/// Term c u of the equation of a body: the input u acts on the body with the force c u.
#[derive(Debug, Clone, Copy)]
struct InputForce {
    signal: usize,
    body: usize,
    /// Indices of the equation and of the term in it.
    term: (usize, usize),
    coefficient: f64,
}

/// Jumps of the forces on the bodies of a system.
pub(super) struct ForceJumps {
    /// Jumps in chronological order.
    jumps: Vec<InputJump>,
    forces: Vec<InputForce>,
    /// Intervals of a pulse without jumps: one interval of length 1.
    whole_pulse: [Interval; 1],
    /// Derivatives of `whole_pulse`: zero.
    whole_pulse_derivative: [Interval; 1],
}

impl ForceJumps {
    /// Collect the jumps of the inputs of a record that act as forces on bodies with friction.
    pub(super) fn new(system: &NonlinearSystem, record: &Record) -> Self {
        let mut forces = Vec::new();
        for (body, &(i, _)) in system.frictions.iter().enumerate() {
            let equation = &system.equations[i];
            for (k, (term, &coefficient)) in equation.structure.terms.iter().zip(&equation.coefficients).enumerate() {
                let is_input = term.signal < system.recorded && system.output_index(i, term.signal).is_none();
                if is_input && term.order < ORDER_GRAIN {
                    forces.push(InputForce { signal: term.signal, body, term: (i, k), coefficient });
                }
            }
        }
        let mut signals: Vec<usize> = forces.iter().map(|force| force.signal).collect();
        signals.sort_unstable();
        signals.dedup();
        let jumps_of_signal = |&signal: &usize| {
            record.jumps(signal).iter().enumerate().map(move |(index, jump)| InputJump {
                pulse: jump.pulse,
                fraction: jump.fraction,
                size: jump.after - jump.before,
                signal,
                index,
            })
        };
        let mut jumps: Vec<InputJump> = signals.iter().flat_map(jumps_of_signal).collect();
        jumps.sort_by(|a, b| a.pulse.cmp(&b.pulse).then(a.fraction.total_cmp(&b.fraction)));
        let bodies = system.frictions.len();
        let interval = |length: f64| [Interval { length, forces: vec![0.0; bodies] }];
        Self { jumps, forces, whole_pulse: interval(1.0), whole_pulse_derivative: interval(0.0) }
    }

    fn pulse_jumps(&self, pulse: usize) -> &[InputJump] {
        let first = self.jumps.partition_point(|jump| jump.pulse < pulse);
        let count = self.jumps[first..].partition_point(|jump| jump.pulse == pulse);
        &self.jumps[first..first + count]
    }

    /// Return the intervals of a pulse between its jumps.
    pub(super) fn intervals(&self, pulse: usize) -> Cow<'_, [Interval]> {
        let jumps = self.pulse_jumps(pulse);
        if jumps.is_empty() {
            return Cow::Borrowed(&self.whole_pulse);
        }
        let size = |jump: &InputJump, force: &InputForce| force.coefficient * jump.size;
        let mean = |jump: &InputJump, force: &InputForce| size(jump, force) * (1.0 - jump.fraction);
        Cow::Owned(self.split(jumps, |jump| jump.fraction, 1.0, size, mean))
    }

    /// Return the derivatives of the intervals of a pulse with respect to a parameter.
    pub(super) fn interval_derivatives(&self, pulse: usize, derivatives: &SystemDerivatives) -> Cow<'_, [Interval]> {
        let jumps = self.pulse_jumps(pulse);
        if jumps.is_empty() {
            return Cow::Borrowed(&self.whole_pulse_derivative);
        }
        let slope = |jump: &InputJump| {
            let input = derivatives.inputs.iter().find(|input| input.signal == jump.signal);
            input.and_then(|input| input.jumps.get(jump.index)).map_or((0.0, 0.0), |s| (s.fraction, s.after - s.before))
        };
        let size = |jump: &InputJump, force: &InputForce| {
            derivatives.terms[force.term.0][force.term.1].0 * jump.size + force.coefficient * slope(jump).1
        };
        let mean = |jump: &InputJump, force: &InputForce| {
            size(jump, force) * (1.0 - jump.fraction) - force.coefficient * jump.size * slope(jump).0
        };
        Cow::Owned(self.split(jumps, |jump| slope(jump).0, 0.0, size, mean))
    }

    /// Split a pulse at its jumps and return the intervals. If the functions return derivatives, the result holds the
    /// derivatives of the intervals.
    ///
    /// `position` returns the position of a jump as a fraction of the pulse, and `end` is the position of the end of
    /// the pulse. `size` returns the change of a force at a jump. `mean` returns the contribution of this change to the
    /// mean force.
    fn split(
        &self,
        jumps: &[InputJump],
        position: impl Fn(&InputJump) -> f64,
        end: f64,
        size: impl Fn(&InputJump, &InputForce) -> f64,
        mean: impl Fn(&InputJump, &InputForce) -> f64,
    ) -> Vec<Interval> {
        let (mut means, mut intervals) =
            (vec![0.0; self.whole_pulse[0].forces.len()], Vec::with_capacity(jumps.len() + 1));
        let (mut level, mut last) = (means.clone(), 0.0);
        for jump in jumps {
            intervals.push(Interval { length: position(jump) - last, forces: level.clone() });
            last = position(jump);
            for force in self.forces.iter().filter(|force| force.signal == jump.signal) {
                level[force.body] += size(jump, force);
                means[force.body] += mean(jump, force);
            }
        }
        intervals.push(Interval { length: end - last, forces: level });
        for interval in &mut intervals {
            interval.forces.iter_mut().zip(&means).for_each(|(force, mean)| *force -= mean);
        }
        intervals
    }
}

//! Outputs at samples at which a zero-order-hold input jumps.
//!
//! A sample lies between two pulses, and its value is the average of their means. This is of second order in the step
//! where the output is smooth. After a jump of an input the slope of the output of a first-order equation changes, and
//! the average has an error proportional to the step. The mean of the later pulse is therefore replaced by that of a
//! continuation: the same pulse, solved with inputs that go on as they were before the sample. The slope of an input
//! that is linear between samples is not continued: its error is of second order for equations of order 1 or more.

use super::channels::InputDerivative;
use crate::estimation::output_error::Experiment;
use crate::regressors::Record;

/// Zero-order-hold inputs that go on after each compared sample as they were before it.
pub(super) struct InputContinuation {
    pulses_per_sample: usize,
    /// Changes of each signal by compared sample: mean of the pulse before the sample minus that of the pulse after it.
    /// None for a signal without jumps at samples.
    changes: Vec<Option<Vec<f64>>>,
}

/// Solution of the pulse after a compared sample with continued inputs, with its linearization.
pub(super) struct ContinuedPulse {
    /// Index of the pulse.
    pub(super) pulse: usize,
    /// Index of the compared sample.
    pub(super) sample: usize,
    /// Pulse means of the state channels, then of the non-linear terms.
    pub(super) sources: Vec<f64>,
    /// Derivatives of the non-linear terms with respect to state channels and input channels, row-major.
    pub(super) slopes: Vec<f64>,
    /// Inverse Jacobian of the equations of the pulse, row-major.
    pub(super) inverse: Vec<f64>,
}

impl InputContinuation {
    /// Continuation of the inputs in `record`, the record of an experiment after its free input laws. None if no input
    /// jumps at a sample.
    pub(super) fn new(experiment: &Experiment, record: &Record) -> Option<Self> {
        let pulses_per_sample = experiment.pulses_per_sample;
        let change = |signal: usize| {
            experiment.point_values.get(signal).filter(|values| values.is_zero_order_hold)?;
            let means = record.signal(signal);
            let samples = 0..experiment.compared_count();
            let values: Vec<f64> = samples.map(|k| change_of_mean(means, (k + 1) * pulses_per_sample)).collect();
            values.iter().any(|v| *v != 0.0).then_some(values)
        };
        let changes: Vec<Option<Vec<f64>>> = (0..record.len()).map(change).collect();
        changes.iter().any(Option::is_some).then_some(Self { pulses_per_sample, changes })
    }

    /// Return the index of the compared sample at the start of a pulse; None if there is none or if no input changes
    /// there.
    pub(super) fn sample_before(&self, pulse: usize) -> Option<usize> {
        if pulse == 0 || !pulse.is_multiple_of(self.pulses_per_sample) {
            return None;
        }
        let sample = pulse / self.pulses_per_sample - 1;
        (0..self.changes.len()).any(|signal| self.change(signal, sample) != 0.0).then_some(sample)
    }

    /// Return the change of a signal in the pulse after a compared sample: continued minus actual pulse mean.
    pub(super) fn change(&self, signal: usize, sample: usize) -> f64 {
        let changes = self.changes.get(signal).and_then(Option::as_ref);
        changes.and_then(|changes| changes.get(sample)).copied().unwrap_or(0.0)
    }

    /// Return the derivative of [`InputContinuation::change`] with respect to a parameter of the input.
    pub(super) fn change_derivative(&self, input: &InputDerivative, sample: usize) -> f64 {
        match self.changes.get(input.signal) {
            Some(Some(_)) => change_of_mean(&input.means, (sample + 1) * self.pulses_per_sample),
            _ => 0.0,
        }
    }
}

/// Return the mean of the pulse before the given one minus its own mean.
fn change_of_mean(means: &[f64], pulse: usize) -> f64 {
    means[pulse - 1] - means[pulse]
}

//! Outputs at samples at which a zero-order-hold input jumps.
//!
//! A compared sample lies at the boundary of two block pulses, and its value is the average of their means. The error of
//! the average is of second order in the step where the output is smooth. After a jump of an input, the output of an
//! equation of order α changes like t^α, and the error at the jump is of order α. The mean of the later pulse is
//! therefore replaced by that of a continuation: the same pulse, solved with inputs that go on as they were before the
//! sample. This restores second order. Where an input is linear between samples, its change of slope is ignored, which
//! causes an error of order 1 + α.

use super::channels::InputDerivative;
use crate::estimation::output_error::Experiment;
use crate::regressors::Record;

/// Zero-order-hold inputs that go on after each compared sample as they were before it.
pub(super) struct InputContinuation {
    pulses_per_sample: usize,
    /// Differences of each signal by compared sample: mean of the pulse before the sample minus that of the pulse after
    /// it. None for a signal without jumps at samples.
    differences: Vec<Option<Vec<f64>>>,
}

/// Solution, with continued inputs, of the pulse after a compared sample, and its linearization there.
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
    /// Continuation of the inputs in `record`, the record of the experiment with its free input laws applied. None if no
    /// input jumps at a sample.
    pub(super) fn new(experiment: &Experiment, record: &Record) -> Option<Self> {
        let pulses_per_sample = experiment.pulses_per_sample;
        let difference = |signal: usize| {
            experiment.point_values.get(signal).filter(|values| values.is_zero_order_hold)?;
            let means = record.signal(signal);
            let samples = 0..experiment.compared_count();
            let values: Vec<f64> = samples.map(|k| decrease_of_mean(means, (k + 1) * pulses_per_sample)).collect();
            values.iter().any(|v| *v != 0.0).then_some(values)
        };
        let differences: Vec<Option<Vec<f64>>> = (0..record.len()).map(difference).collect();
        differences.iter().any(Option::is_some).then_some(Self { pulses_per_sample, differences })
    }

    /// Return the index of the compared sample at the start of a pulse; None if there is none or if no input jumps
    /// there.
    pub(super) fn sample_at_start(&self, pulse: usize) -> Option<usize> {
        if pulse == 0 || !pulse.is_multiple_of(self.pulses_per_sample) {
            return None;
        }
        let sample = pulse / self.pulses_per_sample - 1;
        (0..self.differences.len()).any(|signal| self.continued_minus_actual(signal, sample) != 0.0).then_some(sample)
    }

    /// Return the continued minus the actual mean of a signal in the pulse after a compared sample.
    pub(super) fn continued_minus_actual(&self, signal: usize, sample: usize) -> f64 {
        let differences = self.differences.get(signal).and_then(Option::as_ref);
        differences.and_then(|values| values.get(sample)).copied().unwrap_or(0.0)
    }

    /// Return the derivative of [`InputContinuation::continued_minus_actual`] with respect to a parameter of the input.
    pub(super) fn continued_minus_actual_derivative(&self, input: &InputDerivative, sample: usize) -> f64 {
        match self.differences.get(input.signal) {
            Some(Some(_)) => decrease_of_mean(&input.means, (sample + 1) * self.pulses_per_sample),
            _ => 0.0,
        }
    }
}

/// Return the mean of the pulse before the given one minus its own mean.
fn decrease_of_mean(means: &[f64], pulse: usize) -> f64 {
    means[pulse - 1] - means[pulse]
}

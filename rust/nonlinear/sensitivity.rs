//! Sensitivities of a simulated run to parameters: the equations of its pulses, linearized at the simulation.

use super::channels::SystemDerivatives;
use super::contact::{BodyDerivatives, ContactOperators, ContactResponses, MotionDerivatives};
use super::convolution::{OnlineConvolution, SignalSpectrum};
use super::input_continuation::{ContinuedPulse, InputContinuation};
use super::operators::{derivative, InputContribution, Operators};
use super::system::NonlinearSystem;
use super::time_stepping::LinearizedRun;
use crate::equation::ORDER_GRAIN;
use crate::error::Result;
use crate::regressors::Record;

/// Cache for the sensitivities of one simulated run. It contains convolutions of simulated pulse means with kernels and
/// with derivatives of kernels, and responses to friction forces. Each is computed when it is first needed.
pub(super) struct SensitivityCache<'a> {
    operators: &'a Operators,
    run: &'a LinearizedRun,
    spectra: Vec<Option<SignalSpectrum>>,
    slopes: Vec<Option<Vec<f64>>>,
    convolutions: std::collections::BTreeMap<(usize, usize, bool), Vec<f64>>,
    contacts: Option<ContactResponses>,
}

impl<'a> SensitivityCache<'a> {
    pub(super) fn new(operators: &'a Operators, run: &'a LinearizedRun) -> Self {
        let spectra = (0..operators.sources()).map(|_| None).collect();
        let slopes = vec![None; operators.integrals.len()];
        Self { operators, run, spectra, slopes, convolutions: std::collections::BTreeMap::new(), contacts: None }
    }

    /// Compute the responses to friction forces unless they are cached.
    fn linearize_contacts(&mut self) -> Result<()> {
        if let (Some(contact), None) = (&self.operators.contact, &self.contacts) {
            let Operators { jumps, gains, .. } = self.operators;
            self.contacts = Some(contact.responses(&self.run.contacts, jumps, gains, &self.run.inverses)?);
        }
        Ok(())
    }

    /// Return the derivative of the values of a kernel with respect to its order.
    fn kernel_slope(&mut self, kernel: usize) -> &[f64] {
        let Operators { m, step, ref integrals, .. } = *self.operators;
        self.slopes[kernel].get_or_insert_with(|| integrals[kernel].values_and_slopes(m, step).1)
    }

    /// Return the convolution of a source (a state channel, a non-linear term or a friction force) with a kernel. If
    /// `is_slope`, use the derivative of the kernel with respect to its order.
    fn convolution(&mut self, kernel: usize, source: usize, is_slope: bool) -> &[f64] {
        let key = (kernel, source, is_slope);
        if !self.convolutions.contains_key(&key) {
            if is_slope {
                self.kernel_slope(kernel);
            }
            let series = match &self.slopes[kernel] {
                Some(slope) if is_slope => slope.as_slice(),
                _ => self.operators.kernels[kernel].values(),
            };
            let signal = &self.run.sources[source];
            let spectrum = self.spectra[source].get_or_insert_with(|| SignalSpectrum::new(signal));
            self.convolutions.insert(key, spectrum.convolve(series));
        }
        &self.convolutions[&key]
    }
}

impl Operators {
    /// Return the derivatives of the outputs with respect to one parameter. `derivatives` holds the derivatives of the
    /// system with respect to it.
    pub(super) fn sensitivity(
        &self,
        system: &NonlinearSystem,
        record: &Record,
        run: &LinearizedRun,
        cache: &mut SensitivityCache<'_>,
        derivatives: &SystemDerivatives,
    ) -> Result<OutputDerivatives> {
        let states = self.states.len();
        let mut forcing = derivatives.forcing.channels.clone();
        forcing.resize(states, vec![0.0; self.m]);
        let add = |row: &mut Vec<f64>, weight: f64, part: &[f64]| {
            row.iter_mut().zip(part).for_each(|(sum, v)| *sum += weight * v);
        };
        for group in &self.kernel_contributions {
            for contribution in &group.contributions {
                let (coefficient, order) = derivatives.terms[contribution.term.0][contribution.term.1];
                if coefficient != 0.0 {
                    add(
                        &mut forcing[group.state],
                        coefficient,
                        cache.convolution(group.kernel, contribution.source, false),
                    );
                }
                if order != 0.0 && contribution.weight != 0.0 {
                    add(
                        &mut forcing[group.state],
                        order * contribution.weight,
                        cache.convolution(group.kernel, contribution.source, true),
                    );
                }
            }
        }
        for (signal, inputs) in self.inputs_by_signal() {
            let input_change = derivatives
                .inputs
                .iter()
                .find(|input| input.signal == signal)
                .map(|input| SignalSpectrum::new(&input.means));
            let mut spectrum = None;
            for input in inputs {
                let (coefficient, order) = derivatives.terms[input.term.0][input.term.1];
                let weight = system.equations[input.term.0].coefficients[input.term.1];
                if coefficient != 0.0 || order != 0.0 {
                    let spectrum = spectrum.get_or_insert_with(|| SignalSpectrum::new(record.signal(signal)));
                    if coefficient != 0.0 {
                        let part = self.integrate(spectrum, input.kernel, self.kernels[input.kernel].values());
                        add(&mut forcing[input.state], coefficient, &part);
                    }
                    if order != 0.0 {
                        let part = self.integrate(spectrum, input.kernel, cache.kernel_slope(input.kernel));
                        add(&mut forcing[input.state], order * weight, &part);
                    }
                }
                if let Some(input_change) = &input_change {
                    let part = self.integrate(input_change, input.kernel, self.kernels[input.kernel].values());
                    add(&mut forcing[input.state], weight, &part);
                }
            }
        }
        let mut input_derivatives = Vec::new();
        for (index, ((signal, order), _)) in self.input_means.iter().enumerate() {
            if let Some(input) = derivatives.inputs.iter().find(|input| input.signal == *signal) {
                input_derivatives.push((index, derivative(&input.means, *order, self.step)?));
            }
        }
        let bodies = match &self.contact {
            Some(contact) => {
                let gain_derivatives = self.gain_derivatives(derivatives, cache);
                Some((contact, contact.derivatives(&self.gains, &gain_derivatives, derivatives)?))
            }
            None => None,
        };
        let continued = run.continuation.as_ref().map(|continuation| ContinuationDerivatives {
            continuation,
            derivatives,
            gains: self.gain_derivatives(derivatives, cache),
            inputs: self.input_gain_derivatives(system, derivatives, cache),
        });
        cache.linearize_contacts()?;
        let forcing =
            ForcingDerivatives { system: derivatives, channels: forcing, inputs: input_derivatives, continued };
        self.linear_run(run, &forcing, bodies, cache.contacts.as_ref())
    }

    /// Return the derivatives of the gains of the inputs within a pulse.
    fn input_gain_derivatives(
        &self,
        system: &NonlinearSystem,
        derivatives: &SystemDerivatives,
        cache: &mut SensitivityCache<'_>,
    ) -> Vec<InputGain> {
        let gain = |input: &InputContribution| {
            let (coefficient, order) = derivatives.terms[input.term.0][input.term.1];
            let weight = system.equations[input.term.0].coefficients[input.term.1];
            let first = self.kernels[input.kernel].values().first().copied().unwrap_or(0.0);
            let slope = if order == 0.0 { 0.0 } else { cache.kernel_slope(input.kernel)[0] };
            let (signal, state) = (input.signal, input.state);
            InputGain { signal, state, gain: weight * first, derivative: coefficient * first + weight * order * slope }
        };
        self.inputs.iter().map(gain).collect()
    }

    /// Return the derivatives of `gains` with respect to a parameter, in the same layout.
    fn gain_derivatives(&self, derivatives: &SystemDerivatives, cache: &mut SensitivityCache<'_>) -> Vec<f64> {
        let count = self.sources();
        let mut out = vec![0.0; self.gains.len()];
        for group in &self.kernel_contributions {
            let first = self.kernels[group.kernel].values().first().copied().unwrap_or(0.0);
            for contribution in &group.contributions {
                let (coefficient, order) = derivatives.terms[contribution.term.0][contribution.term.1];
                let slope = if order == 0.0 { 0.0 } else { cache.kernel_slope(group.kernel)[0] };
                out[group.state * count + contribution.source] +=
                    coefficient * first + contribution.weight * order * slope;
            }
        }
        out
    }

    /// Simulate the linearized equations. Return the derivatives of the outputs with respect to a parameter.
    ///
    /// `bodies` holds the derivatives of the initial states, gains and friction laws of the bodies, and `responses` the
    /// responses to friction forces. Both are None without friction.
    fn linear_run(
        &self,
        run: &LinearizedRun,
        forcing: &ForcingDerivatives<'_>,
        bodies: Option<(&ContactOperators, BodyDerivatives)>,
        responses: Option<&ContactResponses>,
    ) -> Result<OutputDerivatives> {
        let ForcingDerivatives { system, channels, inputs: input_derivatives, continued } = forcing;
        let (states, values, count) = (self.states.len(), self.values(), self.sources());
        let width = states + self.input_means.len();
        let mut means = vec![Vec::with_capacity(self.m); self.outputs];
        let mut continued_outputs = Vec::with_capacity(run.continued_pulses.len());
        let mut continued_pulses = run.continued_pulses.iter().peekable();
        let mut convolutions: Vec<OnlineConvolution<'_>> =
            self.kernel_contributions.iter().map(|group| OnlineConvolution::new(&self.kernels[group.kernel])).collect();
        let (mut free, mut x) = (vec![0.0; states], vec![0.0; count]);
        let mut inputs = vec![0.0; input_derivatives.len()];
        let mut bodies = bodies.map(|(contact, bodies)| (contact, MotionDerivatives::start(&bodies), bodies));
        for k in 0..self.m {
            free.iter_mut().zip(channels).for_each(|(free, row)| *free = row[k]);
            for (group, convolution) in self.kernel_contributions.iter().zip(&convolutions) {
                free[group.state] += convolution.past_contribution();
            }
            inputs.iter_mut().zip(input_derivatives).for_each(|(value, (_, means))| *value = means[k]);
            let input_values = || input_derivatives.iter().zip(&inputs).map(|((index, _), value)| (*index, *value));
            if let (Some(pulse), Some(continued)) = (continued_pulses.next_if(|pulse| pulse.pulse == k), continued) {
                let (mut free, mut x) = (free.clone(), vec![0.0; count]);
                continued.add_forcing(run, pulse, &mut free);
                let inputs: Vec<(usize, f64)> = input_values()
                    .map(|(index, value)| (index, value + continued.input_change(self.input_means[index].0, pulse)))
                    .collect();
                self.add_inputs_of_terms(&pulse.slopes, inputs.into_iter(), &mut free, &mut x);
                self.solve_states(&pulse.inverse, &free, &mut x);
                x.truncate(self.outputs);
                continued_outputs.push((pulse, x));
            }
            let slopes = &run.slopes[k * values * width..(k + 1) * values * width];
            let inverse = &run.inverses[k * states * states..(k + 1) * states * states];
            self.add_inputs_of_terms(slopes, input_values(), &mut free, &mut x);
            if let Some((contact, motion, _)) = &bodies {
                contact.fix_resting_outputs(&run.contacts, k, motion, &mut free);
            }
            self.solve_states(inverse, &free, &mut x);
            if let (Some((contact, motion, bodies)), Some(responses)) = (&mut bodies, responses) {
                let intervals = (&*self.jumps.intervals(k), &*self.jumps.interval_derivatives(k, system));
                let pulse_context = (&run.contacts, responses, k);
                contact.add_friction_derivatives(pulse_context, intervals, bodies, motion, &mut x);
            }
            for q in 0..self.terms.len() {
                x[states + q] += (0..states).map(|b| slopes[q * width + b] * x[b]).sum::<f64>();
            }
            means.iter_mut().zip(&x).for_each(|(row, v)| row.push(*v));
            for (group, convolution) in self.kernel_contributions.iter().zip(&mut convolutions) {
                convolution.push(
                    group.contributions.iter().map(|contribution| contribution.weight * x[contribution.source]).sum(),
                );
            }
        }
        let half_changes = continued_outputs.into_iter().map(|(pulse, x)| {
            let changes = x.iter().zip(&means).map(|(value, row)| 0.5 * (value - row[pulse.pulse]));
            (pulse.sample, changes.collect())
        });
        Ok(OutputDerivatives { corrections: half_changes.collect(), means })
    }

    /// Write the derivatives of the non-linear terms due to the inputs alone to `x`, and add their contributions to the
    /// forcing `free`. `inputs` holds indices of input channels and the derivatives of their means in the pulse.
    fn add_inputs_of_terms(
        &self,
        slopes: &[f64],
        inputs: impl Iterator<Item = (usize, f64)> + Clone,
        free: &mut [f64],
        x: &mut [f64],
    ) {
        let (states, width, count) = (self.states.len(), self.states.len() + self.input_means.len(), self.sources());
        x[states..].fill(0.0);
        for q in 0..self.terms.len() {
            x[states + q] = inputs.clone().map(|(index, value)| slopes[q * width + states + index] * value).sum();
        }
        if inputs.count() > 0 {
            for (free, gains) in free.iter_mut().zip(self.gains.chunks(count)) {
                *free += gains[states..].iter().zip(&x[states..]).map(|(g, v)| g * v).sum::<f64>();
            }
        }
    }

    /// Set the derivatives of the state channels in `x` from the inverse Jacobian of a pulse.
    fn solve_states(&self, inverse: &[f64], free: &[f64], x: &mut [f64]) {
        let states = self.states.len();
        for a in 0..states {
            x[a] = (0..states).map(|b| inverse[a * states + b] * free[b]).sum();
        }
    }
}

/// Derivatives of the outputs of a run with respect to a parameter.
pub(super) struct OutputDerivatives {
    /// Derivatives of the pulse means of each output.
    pub(super) means: Vec<Vec<f64>>,
    /// Derivatives of the corrections of compared samples: (index of the sample, one value per output).
    corrections: Vec<(usize, Vec<f64>)>,
}

impl OutputDerivatives {
    /// Derivatives of the pulse means, without corrections of samples.
    pub(super) fn of_means(means: Vec<Vec<f64>>) -> Self {
        Self { means, corrections: Vec::new() }
    }

    /// Return the derivatives of the corrections of the compared samples of each output.
    pub(super) fn sample_corrections(&self, samples: usize) -> Vec<Vec<f64>> {
        let mut out = vec![vec![0.0; samples]; self.means.len()];
        for (sample, values) in &self.corrections {
            out.iter_mut().zip(values).for_each(|(row, value)| row[*sample] = *value);
        }
        out
    }
}

/// Derivatives of the forcing of the state channels with respect to a parameter.
struct ForcingDerivatives<'a> {
    system: &'a SystemDerivatives,
    /// Derivatives of the forcing of each state channel, one value per pulse.
    channels: Vec<Vec<f64>>,
    /// Indices of input channels, and the derivatives of their pulse means.
    inputs: Vec<(usize, Vec<f64>)>,
    /// Derivatives for the pulses with continued inputs; None if no input is continued.
    continued: Option<ContinuationDerivatives<'a>>,
}

/// Gain of an input in a state channel within the same pulse, and its derivative with respect to a parameter.
struct InputGain {
    signal: usize,
    state: usize,
    gain: f64,
    derivative: f64,
}

/// Derivatives with respect to a parameter that the pulses with continued inputs need.
struct ContinuationDerivatives<'a> {
    continuation: &'a InputContinuation,
    derivatives: &'a SystemDerivatives,
    /// Derivatives of the contributions within a pulse, in the layout of [`Operators::gains`].
    gains: Vec<f64>,
    inputs: Vec<InputGain>,
}

impl ContinuationDerivatives<'_> {
    /// Add the derivative of the change of the forcing by continued inputs to `free`.
    fn add_forcing(&self, run: &LinearizedRun, pulse: &ContinuedPulse, free: &mut [f64]) {
        let count = self.gains.len() / free.len();
        for (free, gains) in free.iter_mut().zip(self.gains.chunks(count)) {
            let changes = pulse.sources.iter().zip(&run.sources).map(|(value, means)| value - means[pulse.pulse]);
            *free += gains.iter().zip(changes).map(|(gain, change)| gain * change).sum::<f64>();
        }
        for input in &self.inputs {
            let change = self.continuation.continued_minus_actual(input.signal, pulse.sample);
            free[input.state] += input.derivative * change + input.gain * self.signal_change(input.signal, pulse);
        }
    }

    /// Return the derivative of the change of a signal in a pulse with continued inputs.
    fn signal_change(&self, signal: usize, pulse: &ContinuedPulse) -> f64 {
        let input = self.derivatives.inputs.iter().find(|input| input.signal == signal);
        input.map_or(0.0, |input| self.continuation.continued_minus_actual_derivative(input, pulse.sample))
    }

    /// Return the derivative of the change of an input channel, given by signal and order of the derivative.
    fn input_change(&self, (signal, order): (usize, f64), pulse: &ContinuedPulse) -> f64 {
        if order < ORDER_GRAIN {
            self.signal_change(signal, pulse)
        } else {
            0.0
        }
    }
}

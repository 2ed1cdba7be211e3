//! Discretization of equations with non-linear terms: channels, kernels and weights on the pulses of a record.

use super::channels::{uses_output_means, MIN_INTEGRATION_ORDER};
use super::channels::{ForcingTerms, IntegralKernel, StateChannel};
use super::contact::ContactOperators;
use super::convolution::{average_neighbors, ConvolutionKernel, SignalSpectrum, MAX_FEEDTHROUGH_ORDER};
use super::initial_state::{derivative_powers, power_term_means, EndVelocityForcing, Link};
use super::jumps::ForceJumps;
use super::system::NonlinearSystem;
use crate::equation::{Equation, ORDER_GRAIN};
use crate::error::{Error, Result};
use crate::fractional::kernels::{kernel, MAX_ORDER_EXCESS};
use crate::friction::FrictionLaw;
use crate::regressors::Record;

/// Argument of an expression, by its index: a state channel, or an input channel (an input or a derivative of one).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ExpressionArgument {
    State(usize),
    Input(usize),
}

/// Non-linear term of an equation: indices of equation, term and derived signal, and the arguments of its expression.
pub(super) struct NonlinearTerm {
    equation: usize,
    term: usize,
    pub(super) signal: usize,
    pub(super) arguments: Vec<ExpressionArgument>,
}

/// Contribution of a source to a state channel. A source is a state channel, a non-linear term or a friction force.
/// `term` holds the indices of the equation and of the term in it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Contribution {
    pub(super) source: usize,
    pub(super) term: (usize, usize),
    pub(super) weight: f64,
}

/// Contributions to one state channel that share a kernel. One online convolution of their weighted sum computes them.
pub(super) struct KernelContributions {
    pub(super) state: usize,
    pub(super) kernel: usize,
    pub(super) contributions: Vec<Contribution>,
}

/// Contribution of an input to a state channel. `term` holds the indices of the equation and of the term in it.
pub(super) struct InputContribution {
    pub(super) state: usize,
    pub(super) kernel: usize,
    pub(super) term: (usize, usize),
    pub(super) signal: usize,
}

/// System discretized on the pulses of a record: channels, kernels and weights.
pub(super) struct Operators {
    pub(super) m: usize,
    pub(super) step: f64,
    pub(super) outputs: usize,
    pub(super) states: Vec<StateChannel>,
    /// Inputs, or derivatives of inputs, that enter expressions: (signal, order of the derivative), and pulse means.
    pub(super) input_means: Vec<((usize, f64), Vec<f64>)>,
    pub(super) terms: Vec<NonlinearTerm>,
    pub(super) integrals: Vec<IntegralKernel>,
    /// Convolution kernel of each entry of `integrals`.
    pub(super) kernels: Vec<ConvolutionKernel>,
    pub(super) kernel_contributions: Vec<KernelContributions>,
    pub(super) inputs: Vec<InputContribution>,
    /// Contributions within a pulse, row-major with one row per state channel. A row holds the contributions of a unit
    /// of each state channel, non-linear term and friction force to this channel within the same pulse.
    pub(super) gains: Vec<f64>,
    /// True if the value of a non-linear term depends on itself in the same pulse, because it enters a state channel
    /// without integration.
    pub(super) is_algebraic: bool,
    /// Dry friction of the bodies; None without friction.
    pub(super) contact: Option<ContactOperators>,
    /// Jumps of the forces on bodies with friction that occur within pulses.
    pub(super) jumps: ForceJumps,
}

/// Return the index of a kernel in a list. A kernel that is not in the list is appended.
fn kernel_index(kernels: &mut Vec<IntegralKernel>, order: f64, at_ends: bool) -> usize {
    let is_equal = |entry: &IntegralKernel| entry.at_ends == at_ends && (entry.order - order).abs() < ORDER_GRAIN;
    kernels.iter().position(is_equal).unwrap_or_else(|| {
        kernels.push(IntegralKernel { order, at_ends });
        kernels.len() - 1
    })
}

impl Operators {
    pub(super) fn new(system: &NonlinearSystem, record: &Record) -> Result<Self> {
        let (m, step, states) = (record.m(), record.step(), system.state_channels());
        let state_index = |channel: StateChannel| states.iter().position(|state| state.is_same(channel));
        let mut input_means: Vec<((usize, f64), Vec<f64>)> = Vec::new();
        let mut terms: Vec<NonlinearTerm> = Vec::new();
        for (i, equation) in system.equations.iter().enumerate() {
            for (k, term) in equation.structure.terms.iter().enumerate().filter(|(_, t)| t.signal >= system.recorded) {
                let signal = term.signal - system.recorded;
                let mut arguments = Vec::new();
                for &(signal, order) in &system.derived[signal].channels {
                    let output = system.output_index(i, signal);
                    let state = output.and_then(|equation| state_index(StateChannel::Mean { equation, order }));
                    arguments.push(match state {
                        Some(state) => ExpressionArgument::State(state),
                        None => {
                            ExpressionArgument::Input(input_channel_index(&mut input_means, (signal, order), record)?)
                        }
                    });
                }
                terms.push(NonlinearTerm { equation: i, term: k, signal, arguments });
            }
        }
        // The optimizer shortens its step after this error.
        let order_too_high = Error::term_above_equation;
        let (mut integrals, mut groups, mut inputs) = (Vec::new(), Vec::<KernelContributions>::new(), Vec::new());
        let mut is_algebraic = false;
        for (state, &channel) in states.iter().enumerate() {
            let (j, rho, at_ends) = (channel.equation(), channel.order(), channel.is_at_ends());
            let add = |groups: &mut Vec<KernelContributions>, kernel: usize, contribution: Contribution| match groups
                .iter_mut()
                .find(|group| group.state == state && group.kernel == kernel)
            {
                Some(group) => group.contributions.push(contribution),
                None => groups.push(KernelContributions { state, kernel, contributions: vec![contribution] }),
            };
            let Equation { structure, coefficients } = &system.equations[j];
            for (k, (term, &weight)) in structure.terms.iter().zip(coefficients).enumerate() {
                let eta = structure.order - term.order;
                let (source, kernel) = if let Some(l) = system.output_index(j, term.signal) {
                    if eta < if l == j { MIN_INTEGRATION_ORDER } else { MIN_INTEGRATION_ORDER - MAX_ORDER_EXCESS } {
                        return Err(order_too_high());
                    }
                    if at_ends && system.couples_by_means(j, l, eta) {
                        let mean = StateChannel::Mean { equation: l, order: 0.0 };
                        (state_index(mean), kernel_index(&mut integrals, eta - 1.0, true))
                    } else if !at_ends && uses_output_means(eta, rho) {
                        let mean = StateChannel::Mean { equation: l, order: 0.0 };
                        (state_index(mean), kernel_index(&mut integrals, eta - rho, false))
                    } else {
                        (state_index(channel.with_equation(l)), kernel_index(&mut integrals, eta, false))
                    }
                } else if let Some(q) = terms.iter().position(|t| (t.equation, t.term) == (j, k)) {
                    let has_input =
                        terms[q].arguments.iter().any(|argument| matches!(argument, ExpressionArgument::Input(_)));
                    let remaining_order = eta - rho;
                    let min_remaining_order = if at_ends { MAX_FEEDTHROUGH_ORDER } else { -ORDER_GRAIN };
                    if remaining_order < min_remaining_order || (has_input && eta < MIN_INTEGRATION_ORDER) {
                        return Err(order_too_high());
                    }
                    is_algebraic |= remaining_order < MIN_INTEGRATION_ORDER
                        && !terms[q].arguments.iter().all(|p| matches!(p, ExpressionArgument::Input(_)));
                    (Some(states.len() + q), kernel_index(&mut integrals, remaining_order.max(0.0), at_ends))
                } else {
                    let remaining_order = eta - rho;
                    if (remaining_order < -ORDER_GRAIN && !at_ends) || eta < MIN_INTEGRATION_ORDER {
                        return Err(order_too_high());
                    }
                    let remaining_order = if at_ends { remaining_order } else { remaining_order.max(0.0) };
                    let kernel = kernel_index(&mut integrals, remaining_order, at_ends);
                    inputs.push(InputContribution { state, kernel, term: (j, k), signal: term.signal });
                    continue;
                };
                if let Some(source) = source {
                    add(&mut groups, kernel, Contribution { source, term: (j, k), weight });
                }
            }
            if let Some(friction) = system.frictions.iter().position(|friction| friction.0 == j) {
                if structure.order - rho < if at_ends { MAX_FEEDTHROUGH_ORDER } else { MIN_INTEGRATION_ORDER } {
                    return Err(order_too_high());
                }
                let kernel = kernel_index(&mut integrals, structure.order - rho, at_ends);
                let source = states.len() + terms.len() + friction;
                add(&mut groups, kernel, Contribution { source, term: (j, structure.terms.len()), weight: -1.0 });
            }
        }
        let kernels: Vec<ConvolutionKernel> = integrals.iter().map(|integral| integral.kernel(m, step)).collect();
        let count = states.len() + terms.len() + system.frictions.len();
        let mut gains = vec![0.0; states.len() * count];
        for group in &groups {
            let first = kernels[group.kernel].values().first().copied().unwrap_or(0.0);
            for contribution in &group.contributions {
                gains[group.state * count + contribution.source] += first * contribution.weight;
            }
        }
        let bodies = system.frictions.iter().filter_map(|&(equation, law)| {
            state_index(StateChannel::EndVelocity { equation }).map(|velocity| (law, (equation, velocity)))
        });
        let (laws, channels): (Vec<FrictionLaw>, Vec<(usize, usize)>) = bodies.unzip();
        let contact =
            if laws.is_empty() { None } else { Some(ContactOperators::new(laws, &channels, &gains, states.len())?) };
        let outputs = system.equations.len();
        Ok(Self {
            m,
            step,
            outputs,
            states,
            input_means,
            terms,
            integrals,
            kernels,
            kernel_contributions: groups,
            inputs,
            gains,
            is_algebraic,
            contact,
            jumps: ForceJumps::new(system, record),
        })
    }

    pub(super) fn sources(&self) -> usize {
        self.states.len() + self.values()
    }

    /// Number of non-linear terms plus number of friction forces.
    pub(super) fn values(&self) -> usize {
        self.terms.len() + self.contact.as_ref().map_or(0, ContactOperators::count)
    }

    /// Return the forcing of the state channels by initial terms. `powers` holds (exponent, coefficient) of the powers
    /// of t in the output of each equation. Return an error if a power has no finite mean over the first pulse.
    pub(super) fn initial_forcing(&self, system: &NonlinearSystem, powers: &[Vec<(f64, f64)>]) -> Result<ForcingTerms> {
        let links = &system.links();
        let mut out = ForcingTerms { channels: vec![vec![0.0; self.m]; self.states.len()], initial_motion: Vec::new() };
        let at_ends = match &self.contact {
            Some(_) => {
                let end_velocity_links = |(i, row): (usize, &Vec<Link>)| {
                    let is_end_velocity_link =
                        |link: &&Link| !system.couples_by_means(i, link.output, link.integration);
                    row.iter().filter(is_end_velocity_link).copied().collect()
                };
                let links: Vec<Vec<Link>> = links.iter().enumerate().map(end_velocity_links).collect();
                Some(EndVelocityForcing::new(powers, &links, self.m, self.step)?)
            }
            None => None,
        };
        for (row, channel) in out.channels.iter_mut().zip(&self.states) {
            match (*channel, &at_ends) {
                (StateChannel::EndVelocity { equation }, Some(at_ends)) => {
                    row.clone_from(&at_ends.velocities[equation])
                }
                _ => {
                    for (exponent, value) in derivative_powers(channel.equation(), channel.order(), links, powers)? {
                        let means = power_term_means(exponent, self.m, self.step);
                        row.iter_mut().zip(means).for_each(|(sum, v)| *sum += value * v);
                    }
                }
            }
        }
        if let (Some(at_ends), Some(contact)) = (&at_ends, &self.contact) {
            let initial_motion =
                |&equation: &usize| (at_ends.initial_outputs[equation], at_ends.initial_velocities[equation]);
            out.initial_motion = contact.outputs().iter().map(initial_motion).collect();
        }
        Ok(out)
    }

    /// Add the contributions of the inputs to the forcing of the state channels.
    pub(super) fn add_inputs(&self, system: &NonlinearSystem, record: &Record, forcing: &mut ForcingTerms) {
        for (signal, inputs) in self.inputs_by_signal() {
            let spectrum = SignalSpectrum::new(record.signal(signal));
            for input in inputs {
                let weight = system.equations[input.term.0].coefficients[input.term.1];
                let part = self.integrate(&spectrum, input.kernel, self.kernels[input.kernel].values());
                forcing.channels[input.state].iter_mut().zip(part).for_each(|(sum, v)| *sum += weight * v);
            }
        }
    }

    /// Return the fractional integral of a signal that is given by its spectrum. `series` holds the values of the
    /// kernel with index `kernel`, or their derivatives with respect to its order.
    pub(super) fn integrate(&self, signal: &SignalSpectrum, kernel: usize, series: &[f64]) -> Vec<f64> {
        let out = signal.convolve(series);
        if self.integrals[kernel].is_averaged() {
            average_neighbors(&out)
        } else {
            out
        }
    }

    pub(super) fn inputs_by_signal(&self) -> Vec<(usize, Vec<&InputContribution>)> {
        let mut out: Vec<(usize, Vec<&InputContribution>)> = Vec::new();
        for input in &self.inputs {
            match out.iter_mut().find(|(signal, _)| *signal == input.signal) {
                Some((_, inputs)) => inputs.push(input),
                None => out.push((input.signal, vec![input])),
            }
        }
        out
    }
}

/// Return the index of an input, or of a derivative of an input, in `input_means`. A new entry is computed from the
/// record and appended.
fn input_channel_index(
    input_means: &mut Vec<((usize, f64), Vec<f64>)>,
    channel: (usize, f64),
    record: &Record,
) -> Result<usize> {
    if let Some(index) = input_means.iter().position(|(entry, _)| *entry == channel) {
        return Ok(index);
    }
    input_means.push((channel, derivative(record.signal(channel.0), channel.1, record.step())?));
    Ok(input_means.len() - 1)
}

/// Return the pulse means of the derivative of a signal from its pulse means. Return [`Error::OutOfRange`] for an order
/// above [`MAX_ORDER_EXCESS`].
pub(super) fn derivative(means: &[f64], order: f64, step: f64) -> Result<Vec<f64>> {
    if order < ORDER_GRAIN {
        return Ok(means.to_vec());
    }
    if order > MAX_ORDER_EXCESS {
        return Err(Error::OutOfRange {
            name: "order of a derivative of an input in a non-linear term".into(),
            value: order,
            range: format!("[0, {MAX_ORDER_EXCESS}]"),
            remedy: "measure the derivative as a signal".into(),
        });
    }
    Ok(SignalSpectrum::new(means).convolve(&kernel(-order, means.len(), step)))
}

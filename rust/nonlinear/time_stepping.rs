//! Simulation of equations with non-linear terms, pulse by pulse, and its sensitivities to parameters.
//!
//! A state channel is an output, or a derivative D^ρ of an output that enters an expression. Its pulse means are L + Σ
//! κ_η ∗ (w x), summed over the terms of its equation. L is the part due to inputs and initial terms. κ_η is the kernel
//! of the fractional integral I^η. w is the coefficient of the term, and x a state channel or the value of an
//! expression. The autoregressive terms are not inverted, so no kernel grows exponentially, and an unstable linear part
//! loses no digits. The scheme is implicit. Newton iterations solve each pulse, starting from an extrapolation of the
//! last two pulses. Sensitivities satisfy the same equations, linearized at the simulation, and need no iteration.

use super::channels::{ForcingTerms, IntegralKernel, PulseFailure, StateChannel, SystemDerivatives};
use super::contact::{
    BodyDerivatives, BodyMotion, ContactOperators, ContactResponses, ContactStates, MotionDerivatives, PulseEquations,
};
use super::convolution::{average_neighbors, product, ConvolutionKernel, OnlineConvolution, MAX_FEEDTHROUGH_ORDER};
use super::initial_state::{derivative_powers, power_term_means, EndVelocityForcing, Link};
use super::jumps::ForceJumps;
use super::system::{NonlinearSystem, MIN_INTEGRATION_ORDER};
use crate::equation::{Equation, ORDER_GRAIN};
use crate::error::{Error, Result};
use crate::expression::Values;
use crate::fractional::kernels::{kernel, MAX_ORDER_EXCESS};
use crate::friction::FrictionLaw;
use crate::linalg::small;
use crate::regressors::Record;
use crate::series::{Buffers, Kernel};

/// Maximum number of Newton iterations in a pulse. Three are usual.
const MAX_NEWTON_ITERATIONS: usize = 50;
/// Maximum number of times that a Newton step is halved if it does not reduce the residual.
const MAX_STEP_HALVINGS: usize = 12;
/// Newton step at which the iteration has converged, relative to the sum of the magnitudes of the channel's terms.
/// Convergence is quadratic, so the next step would be below rounding error. The Jacobian is computed before this step
/// and therefore has a relative error of this size.
const NEWTON_TOLERANCE: f64 = 1e-8;
/// Rounding error of the residual of a channel, relative to the sum of the magnitudes of the channel's terms.
const ROUNDING_RATIO: f64 = 16.0 * f64::EPSILON;

/// Argument of an expression, by its index: a state channel, or an input channel (an input or a derivative of one).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ExpressionArgument {
    State(usize),
    Input(usize),
}

/// Non-linear term of an equation: indices of equation, term and derived signal, and the arguments of its expression.
struct NonlinearTerm {
    equation: usize,
    term: usize,
    signal: usize,
    arguments: Vec<ExpressionArgument>,
}

/// Contribution of a source to a state channel. A source is a state channel, a non-linear term or a friction force.
/// `term` holds the indices of the equation and of the term in it.
#[derive(Debug, Clone, Copy)]
struct Contribution {
    source: usize,
    term: (usize, usize),
    weight: f64,
}

/// Contributions to one state channel that share a kernel. One online convolution of their weighted sum computes them.
struct KernelContributions {
    state: usize,
    kernel: usize,
    contributions: Vec<Contribution>,
}

/// Contribution of an input to a state channel. `term` holds the indices of the equation and of the term in it.
struct InputContribution {
    state: usize,
    kernel: usize,
    term: (usize, usize),
    signal: usize,
}

/// System discretized on the pulses of a record: channels, kernels and weights.
pub(super) struct Operators {
    m: usize,
    step: f64,
    outputs: usize,
    states: Vec<StateChannel>,
    /// Inputs, or derivatives of inputs, that enter expressions: (signal, order of the derivative), and pulse means.
    input_means: Vec<((usize, f64), Vec<f64>)>,
    terms: Vec<NonlinearTerm>,
    integrals: Vec<IntegralKernel>,
    /// Convolution kernel of each entry of `integrals`.
    kernels: Vec<ConvolutionKernel>,
    kernel_contributions: Vec<KernelContributions>,
    inputs: Vec<InputContribution>,
    /// Contributions within a pulse, row-major with one row per state channel. A row holds the contributions of a unit
    /// of each state channel, non-linear term and friction force to this channel within the same pulse.
    gains: Vec<f64>,
    /// True if the value of a non-linear term depends on itself in the same pulse, because it enters a state channel
    /// without integration.
    is_algebraic: bool,
    /// Dry friction of the bodies; None without friction.
    contact: Option<ContactOperators>,
    /// Jumps of the forces on bodies with friction that occur within pulses.
    jumps: ForceJumps,
}

/// Simulation of a run with the linearization of its equations in every pulse.
pub(super) struct LinearizedRun {
    /// Pulse means of each source: state channels, then non-linear terms, then friction forces.
    pub(super) sources: Vec<Vec<f64>>,
    /// Derivatives of the non-linear terms with respect to the state channels, then the input channels. One row-major
    /// matrix per pulse, with additional zero rows for friction forces.
    slopes: Vec<f64>,
    /// Inverse Jacobian of the equations in each pulse, row-major.
    inverses: Vec<f64>,
    contacts: ContactStates,
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
        let order_too_high = || Error::Diverged { what: "order of a term above alpha; simulation".into(), index: 0 };
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

    fn sources(&self) -> usize {
        self.states.len() + self.values()
    }

    /// Number of non-linear terms plus number of friction forces.
    fn values(&self) -> usize {
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
            let spectrum = Kernel::new(record.signal(signal));
            for input in inputs {
                let weight = system.equations[input.term.0].coefficients[input.term.1];
                let part = self.integrate(&spectrum, input.kernel, self.kernels[input.kernel].values());
                forcing.channels[input.state].iter_mut().zip(part).for_each(|(sum, v)| *sum += weight * v);
            }
        }
    }

    /// Return the fractional integral of a signal that is given by its spectrum. `series` holds the values of the
    /// kernel with index `kernel`, or their derivatives with respect to its order.
    fn integrate(&self, signal: &Kernel, kernel: usize, series: &[f64]) -> Vec<f64> {
        let out = product(signal, series);
        if self.integrals[kernel].is_averaged() {
            average_neighbors(&out)
        } else {
            out
        }
    }

    fn inputs_by_signal(&self) -> Vec<(usize, Vec<&InputContribution>)> {
        let mut out: Vec<(usize, Vec<&InputContribution>)> = Vec::new();
        for input in &self.inputs {
            match out.iter_mut().find(|(signal, _)| *signal == input.signal) {
                Some((_, inputs)) => inputs.push(input),
                None => out.push((input.signal, vec![input])),
            }
        }
        out
    }

    /// Return the motion of each body with friction in a simulated run.
    pub(super) fn body_motions(&self, forcing: &ForcingTerms, run: &LinearizedRun) -> Vec<BodyMotion> {
        self.contact.as_ref().map_or_else(Vec::new, |contact| contact.motions(forcing, &run.contacts))
    }

    /// Simulate with the given forcing of the state channels.
    ///
    /// The second result is None for a complete run. If the simulation ends early, it holds the pulse and the reason,
    /// and the run consists of the pulses before it.
    pub(super) fn run(&self, system: &NonlinearSystem, forcing: &ForcingTerms) -> (LinearizedRun, Option<EarlyEnd>) {
        let (states, count) = (self.states.len(), self.sources());
        let width = states + self.input_means.len();
        let mut run = LinearizedRun {
            sources: vec![Vec::with_capacity(self.m); count],
            slopes: Vec::with_capacity(self.m * self.values() * width),
            inverses: Vec::with_capacity(self.m * states * states),
            contacts: ContactStates::empty(),
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
            let solved = match &mut motion {
                Some(motion) => motion.solve(&mut pulse, &self.jumps.intervals(k)),
                None => pulse.solve(),
            };
            if let Err(failure) = solved {
                let (reason, is_overflow) = match failure {
                    PulseFailure::Overflow => (String::new(), true),
                    PulseFailure::Domain(name, argument) => (format!("{name} of {argument:.6} has no value"), false),
                    PulseFailure::Contact => ("no friction force is consistent with the motion".into(), false),
                    // Without algebraic terms, short pulses have a solution unless a value grows without bound in one.
                    PulseFailure::Newton(reason) => (reason.into(), !self.is_algebraic),
                };
                return (run, Some(EarlyEnd { index: k, reason, is_overflow }));
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
        (run, None)
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
fn derivative(means: &[f64], order: f64, step: f64) -> Result<Vec<f64>> {
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
    Ok(product(&Kernel::new(means), &kernel(-order, means.len(), step)))
}

/// Equations of one pulse, with the current iterate of the Newton iterations and work arrays.
struct Pulse<'a> {
    operators: &'a Operators,
    system: &'a NonlinearSystem,
    free: Vec<f64>,
    /// Value at which each state channel is fixed; None if the equations determine it.
    fixed: Vec<Option<f64>>,
    /// For each state channel, whether it was fixed when `inverse` was computed. Without non-linear terms, the inverse
    /// depends on these flags only.
    fixed_in_inverse: Vec<bool>,
    input_means: Vec<f64>,
    z: Vec<f64>,
    /// Values of the non-linear terms at `z`, followed by the friction forces.
    values: Vec<f64>,
    slopes: Vec<f64>,
    inverse: Vec<f64>,
    determinant: f64,
    residual: Vec<f64>,
    /// Sum of the magnitudes of the terms in the equation of each state channel.
    magnitudes: Vec<f64>,
    matrix: Vec<f64>,
    step: Vec<f64>,
    previous: Vec<f64>,
    fault: Option<(&'static str, f64)>,
    arguments: Vec<f64>,
    work: Values,
}

impl<'a> Pulse<'a> {
    fn new(operators: &'a Operators, system: &'a NonlinearSystem) -> Self {
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
            matrix: vec![0.0; states * states],
            step: vec![0.0; states],
            previous: vec![0.0; states],
            fault: None,
            arguments: Vec::new(),
            work: Values::default(),
        }
    }

    fn source(&self, index: usize) -> f64 {
        self.z.get(index).copied().unwrap_or_else(|| self.values[index - self.z.len()])
    }

    /// Evaluate non-linear terms, their derivatives and the residual at `z`. Return the Euclidean norm of the residual.
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
            self.fault = self.fault.or(self.work.fault());
            for (argument, slope) in term.arguments.iter().zip(self.work.slopes()) {
                let column = match *argument {
                    ExpressionArgument::State(state) => state,
                    ExpressionArgument::Input(input) => states + input,
                };
                self.slopes[q * width + column] += slope;
            }
        }
        let count = self.operators.sources();
        let mut norm: f64 = 0.0;
        for a in 0..states {
            let gains = &self.operators.gains[a * count..(a + 1) * count];
            let same_pulse_sum: f64 = gains.iter().zip(self.z.iter().chain(&self.values)).map(|(g, x)| g * x).sum();
            let magnitudes = gains.iter().zip(self.z.iter().chain(&self.values)).map(|(g, x)| (g * x).abs());
            self.magnitudes[a] = magnitudes.sum::<f64>() + self.z[a].abs() + self.free[a].abs();
            self.residual[a] = match self.fixed[a] {
                Some(value) => self.z[a] - value,
                None => self.z[a] - self.free[a] - same_pulse_sum,
            };
            norm = norm.hypot(self.residual[a]);
        }
        norm
    }

    /// Set `z` to the linear extrapolation of the last two pulses. The second pulse starts at the value of the first
    /// pulse, and the first pulse at the forcing.
    fn predict(&mut self, sources: &[Vec<f64>]) {
        for ((z, row), free) in self.z.iter_mut().zip(sources).zip(&self.free) {
            *z = match row.as_slice() {
                [.., previous, last] => 2.0 * last - previous,
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
    fn solve(&mut self) -> std::result::Result<(), PulseFailure> {
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
                // A channel with small terms receives the rounding errors of channels with large terms.
                let rounding: f64 = row.iter().zip(&self.magnitudes).map(|(v, magnitude)| (v * magnitude).abs()).sum();
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

/// Cache for the sensitivities of one simulated run. It contains convolutions of simulated pulse means with kernels and
/// with derivatives of kernels, and responses to friction forces. Each is computed when it is first needed.
pub(super) struct SensitivityCache<'a> {
    operators: &'a Operators,
    run: &'a LinearizedRun,
    spectra: Vec<Option<Kernel>>,
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
            if self.spectra[source].is_none() {
                self.spectra[source] = Some(Kernel::new(&self.run.sources[source]));
            }
            if is_slope {
                self.kernel_slope(kernel);
            }
            let series = match &self.slopes[kernel] {
                Some(slope) if is_slope => slope.as_slice(),
                _ => self.operators.kernels[kernel].values(),
            };
            let mut out = vec![0.0; self.operators.m];
            if let Some(spectrum) = &self.spectra[source] {
                spectrum.apply(series, &mut out, &mut Buffers::default());
            }
            self.convolutions.insert(key, out);
        }
        &self.convolutions[&key]
    }
}

impl Operators {
    /// Return the derivatives of the pulse means of each output with respect to one parameter. `derivatives` holds the
    /// derivatives of the system with respect to it.
    pub(super) fn sensitivity(
        &self,
        system: &NonlinearSystem,
        record: &Record,
        run: &LinearizedRun,
        cache: &mut SensitivityCache<'_>,
        derivatives: &SystemDerivatives,
    ) -> Result<Vec<Vec<f64>>> {
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
            let input_change =
                derivatives.inputs.iter().find(|input| input.signal == signal).map(|input| Kernel::new(&input.means));
            let mut spectrum = None;
            for input in inputs {
                let (coefficient, order) = derivatives.terms[input.term.0][input.term.1];
                let weight = system.equations[input.term.0].coefficients[input.term.1];
                if coefficient != 0.0 || order != 0.0 {
                    let spectrum = spectrum.get_or_insert_with(|| Kernel::new(record.signal(signal)));
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
        cache.linearize_contacts()?;
        self.linear_run(run, &forcing, &input_derivatives, bodies, (derivatives, cache.contacts.as_ref()))
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

    /// Simulate the linearized equations. Return the derivatives of the pulse means of each output with respect to a
    /// parameter.
    ///
    /// `forcing` holds the derivatives of the forcing of each state channel. `input_derivatives` holds indices of input
    /// channels and the derivatives of their pulse means. `bodies` holds the derivatives of the initial states, gains
    /// and friction laws of the bodies.
    fn linear_run(
        &self,
        run: &LinearizedRun,
        forcing: &[Vec<f64>],
        input_derivatives: &[(usize, Vec<f64>)],
        bodies: Option<(&ContactOperators, BodyDerivatives)>,
        (derivatives, responses): (&SystemDerivatives, Option<&ContactResponses>),
    ) -> Result<Vec<Vec<f64>>> {
        let (states, terms, values, count) = (self.states.len(), self.terms.len(), self.values(), self.sources());
        let width = states + self.input_means.len();
        let mut out = vec![Vec::with_capacity(self.m); self.outputs];
        let mut convolutions: Vec<OnlineConvolution<'_>> =
            self.kernel_contributions.iter().map(|group| OnlineConvolution::new(&self.kernels[group.kernel])).collect();
        let (mut free, mut x) = (vec![0.0; states], vec![0.0; count]);
        let mut bodies = bodies.map(|(contact, bodies)| (contact, MotionDerivatives::start(&bodies), bodies));
        for k in 0..self.m {
            free.iter_mut().zip(forcing).for_each(|(free, row)| *free = row[k]);
            for (group, convolution) in self.kernel_contributions.iter().zip(&convolutions) {
                free[group.state] += convolution.past_contribution();
            }
            let slopes = &run.slopes[k * values * width..(k + 1) * values * width];
            let inverse = &run.inverses[k * states * states..(k + 1) * states * states];
            x[states..].fill(0.0);
            for q in 0..terms {
                x[states + q] =
                    input_derivatives.iter().map(|(index, means)| slopes[q * width + states + index] * means[k]).sum();
            }
            if !input_derivatives.is_empty() {
                for (free, gains) in free.iter_mut().zip(self.gains.chunks(count)) {
                    *free += gains[states..].iter().zip(&x[states..]).map(|(g, v)| g * v).sum::<f64>();
                }
            }
            if let Some((contact, motion, _)) = &bodies {
                contact.fix_resting_outputs(&run.contacts, k, motion, &mut free);
            }
            for a in 0..states {
                x[a] = (0..states).map(|b| inverse[a * states + b] * free[b]).sum();
            }
            if let (Some((contact, motion, bodies)), Some(responses)) = (&mut bodies, responses) {
                let intervals = (&*self.jumps.intervals(k), &*self.jumps.interval_derivatives(k, derivatives));
                let pulse_context = (&run.contacts, responses, k);
                contact.add_friction_derivatives(pulse_context, intervals, bodies, motion, &mut x);
            }
            for q in 0..terms {
                x[states + q] += (0..states).map(|b| slopes[q * width + b] * x[b]).sum::<f64>();
            }
            out.iter_mut().zip(&x).for_each(|(row, v)| row.push(*v));
            for (group, convolution) in self.kernel_contributions.iter().zip(&mut convolutions) {
                convolution.push(
                    group.contributions.iter().map(|contribution| contribution.weight * x[contribution.source]).sum(),
                );
            }
        }
        Ok(out)
    }
}

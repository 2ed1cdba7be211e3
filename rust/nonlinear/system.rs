//! Systems of equations with non-linear terms and dry friction, with given orders and coefficients.

use super::channels::{uses_output_means, StateChannel, MIN_INTEGRATION_ORDER};
use super::convolution::MAX_FEEDTHROUGH_ORDER;
use super::initial_state::Link;
use crate::equation::{check_regular, Equation, Term, ORDER_GRAIN};
use crate::error::{check_finite, Error, Result};
use crate::expression::DerivedSignal;
use crate::friction::contact::is_p_matrix;
use crate::friction::FrictionLaw;
use crate::linalg::small;

/// Equations with non-linear terms and dry friction, with given orders and coefficients.
///
/// Signals with an index of `recorded` or more are derived signals.
#[derive(Debug, Clone, PartialEq)]
pub struct NonlinearSystem {
    /// Equations D^α y = Σ c D^ν s over recorded and derived signals s.
    pub equations: Vec<Equation>,
    /// Expressions of the derived signals, in the sequence of their signal indices.
    pub derived: Vec<DerivedSignal>,
    /// Number of recorded signals.
    pub recorded: usize,
    /// True if outputs enter other equations as simulated, false if as measured.
    pub coupled: bool,
    /// Index of each equation with dry friction, and the law F of the friction force −F(Dy) sgn(Dy) on its output y.
    pub frictions: Vec<(usize, FrictionLaw)>,
}

impl NonlinearSystem {
    /// System of linear equations with dry friction. Outputs enter other equations as simulated.
    #[must_use]
    pub fn with_friction(equations: Vec<Equation>, frictions: Vec<(usize, FrictionLaw)>, recorded: usize) -> Self {
        Self { equations, derived: Vec::new(), recorded, coupled: true, frictions }
    }

    /// Return the index of the equation whose simulated output is `signal`, as it enters equation `i`. None if `signal`
    /// is an input of equation `i`.
    pub(crate) fn output_index(&self, i: usize, signal: usize) -> Option<usize> {
        if self.coupled {
            self.equations.iter().position(|e| e.structure.output == signal)
        } else {
            (signal == self.equations[i].structure.output).then_some(i)
        }
    }

    /// Return an error for an inconsistent system.
    ///
    /// # Errors
    /// [`Error::Structure`] for a signal or equation index out of range, two equations with the same output, or two
    /// friction laws in one equation. With friction, the same error occurs for coupled equations that do not determine
    /// their outputs, or whose coupling accelerates a body against a force. [`Error::OutOfRange`] or
    /// [`Error::NotFinite`] for orders and friction parameters that are not supported. The errors of
    /// [`Equation::check`] for an invalid equation.
    pub fn check(&self) -> Result<()> {
        let signals = self.recorded + self.derived.len();
        let invalid = |what: String, remedy: &str| Err(Error::Structure { what, remedy: remedy.into() });
        for (i, equation) in self.equations.iter().enumerate() {
            equation.check(signals)?;
            let output = equation.structure.output;
            if output >= self.recorded {
                return invalid("a derived signal as output of an equation".into(), "simulate recorded signals only");
            }
            if self.equations[..i].iter().any(|other| other.structure.output == output) {
                let what = format!("two equations have signal {output} as their output");
                return invalid(what, "give each output one equation");
            }
        }
        match self.derived.iter().flat_map(|d| &d.channels).find(|(signal, _)| *signal >= self.recorded) {
            None => self.check_frictions(),
            Some((signal, _)) => invalid(format!("signal {signal} of {} in an expression", self.recorded), "record it"),
        }
    }

    /// Return an error for an invalid friction law, and for an equation whose orders do not support friction.
    fn check_frictions(&self) -> Result<()> {
        let invalid = |name: &str, value: f64, range: &str, remedy: &str| {
            Err(Error::OutOfRange { name: name.into(), value, range: range.into(), remedy: remedy.into() })
        };
        for (k, &(equation, _)) in self.frictions.iter().enumerate() {
            if equation >= self.equations.len() || self.frictions[..k].iter().any(|f| f.0 == equation) {
                return Err(Error::Structure {
                    what: format!("friction in equation {equation}"),
                    remedy: format!(
                        "give each of the {} equations at most one friction law, and number equations from 0",
                        self.equations.len()
                    ),
                });
            }
        }
        for &(equation, FrictionLaw { coulomb, stribeck, speed }) in &self.frictions {
            check_finite("friction", &[coulomb, stribeck, speed])?;
            let alpha = self.equations[equation].structure.order;
            if !(alpha > 1.0 && alpha <= 2.0) {
                return invalid(
                    "order of a body with friction",
                    alpha,
                    "(1, 2]",
                    "friction requires an equation with inertia, so that the velocity is continuous",
                );
            }
            if let Some(force) = [coulomb, stribeck].into_iter().find(|f| *f < 0.0) {
                return invalid(
                    "friction",
                    force,
                    "[0, ∞)",
                    "give a coefficient of at least 0, because friction dissipates energy",
                );
            }
            if speed <= 0.0 {
                let remedy = "give the positive speed below which friction increases";
                return invalid("speed of Stribeck friction", speed, "(0, ∞)", remedy);
            }
        }
        if self.frictions.is_empty() {
            return Ok(());
        }
        for (i, Equation { structure, .. }) in self.equations.iter().enumerate() {
            // An input must not cause a jump of a velocity. Bodies with friction may depend on each other's
            // accelerations.
            let above = |order: f64| order >= structure.order - ORDER_GRAIN;
            if let Some(term) =
                structure.terms.iter().find(|t| above(t.order) && self.output_index(i, t.signal).is_none())
            {
                let has_friction = self.frictions.iter().any(|f| f.0 == i);
                let name = if has_friction {
                    "order of a term of a body with friction"
                } else {
                    "order of an input term of a body"
                };
                return invalid(name, term.order, "below that of the body", "reduce it");
            }
        }
        check_regular(&self.equations)?;
        self.check_response_to_forces()?;
        for channel in self.state_channels().into_iter().filter(|channel| channel.is_at_ends()) {
            let structure = &self.equations[channel.equation()].structure;
            let limit = structure.order - 1.0;
            let above = |term: &&Term| term.signal >= self.recorded && term.order > limit - MIN_INTEGRATION_ORDER;
            if let Some(term) = structure.terms.iter().find(above) {
                return Err(Error::OutOfRange {
                    name: "order of a non-linear term in an equation with friction".into(),
                    value: term.order,
                    range: format!("below {limit}, the order of the equation minus 1"),
                    remedy: "reduce the order, or remove the friction".into(),
                });
            }
        }
        Ok(())
    }

    /// Return an error if the coupling makes a force accelerate a body against the force.
    ///
    /// Friction would then have no unique solution. A system with improper terms is checked after its discretization
    /// instead.
    fn check_response_to_forces(&self) -> Result<()> {
        let (n, links) = (self.equations.len(), self.links());
        let bodies: Vec<usize> = self.frictions.iter().map(|friction| friction.0).collect();
        if links.iter().flatten().any(|link| link.integration < -ORDER_GRAIN) {
            return Ok(());
        }
        let mut matrix = vec![0.0; n * n];
        for (i, row) in links.iter().enumerate() {
            matrix[i * n + i] = 1.0;
            for link in row.iter().filter(|link| link.integration.abs() < ORDER_GRAIN) {
                matrix[i * n + link.output] -= link.coefficient;
            }
        }
        let inverse = small::inverse(&matrix, n)?;
        let pairs = bodies.iter().flat_map(|&a| bodies.iter().map(move |&b| (a, b)));
        let accelerations: Vec<f64> = pairs.map(|(a, b)| inverse[a * n + b]).collect();
        if is_p_matrix(&accelerations, bodies.len()) {
            return Ok(());
        }
        Err(Error::Structure {
            what: "the coupled accelerations of bodies with friction are so large that a force on one moves it \
                   against the force"
                .into(),
            remedy:
                "reduce the coupling coefficients of the accelerations, so that the inertia matrix is positive definite"
                    .into(),
        })
    }

    /// Return the terms of each equation whose signal is a simulated output.
    pub(super) fn links(&self) -> Vec<Vec<Link>> {
        let links_of_equation = |(i, Equation { structure, coefficients }): (usize, &Equation)| {
            (structure.terms.iter().zip(coefficients))
                .filter_map(|(term, &coefficient)| {
                    let (order, integration) = (term.order, structure.order - term.order);
                    self.output_index(i, term.signal).map(|output| Link { output, order, integration, coefficient })
                })
                .collect()
        };
        self.equations.iter().enumerate().map(links_of_equation).collect()
    }

    /// Return true if a term of `equation` uses the pulse means of the output `output`, like those of an input, for the
    /// velocity at the end of a pulse.
    ///
    /// This applies to integration orders of 2 or more: the velocity then has feedback from the output, as in
    /// [`uses_output_means`]. For lower orders, velocities at the ends of pulses are more accurate. It also applies to
    /// outputs of equations of order 1 or less, such as actuators, because they have no velocity at the end of a pulse.
    pub(super) fn couples_by_means(&self, equation: usize, output: usize, integration: f64) -> bool {
        let order = self.equations[output].structure.order;
        let has_no_velocity = output != equation && order <= 1.0 + MAX_FEEDTHROUGH_ORDER;
        integration >= 2.0 - ORDER_GRAIN || (has_no_velocity && integration > 1.0 + MAX_FEEDTHROUGH_ORDER)
    }

    /// Return the state channels: all outputs, then the derivatives that expressions, friction and coupling terms need.
    pub(super) fn state_channels(&self) -> Vec<StateChannel> {
        let mut states: Vec<StateChannel> =
            (0..self.equations.len()).map(|equation| StateChannel::Mean { equation, order: 0.0 }).collect();
        let add = |states: &mut Vec<StateChannel>, channel: StateChannel| {
            if !states.iter().any(|state| state.is_same(channel)) {
                states.push(channel);
            }
        };
        for (i, equation) in self.equations.iter().enumerate() {
            for term in equation.structure.terms.iter().filter(|term| term.signal >= self.recorded) {
                for &(signal, order) in &self.derived[term.signal - self.recorded].channels {
                    if let Some(equation) = self.output_index(i, signal) {
                        add(&mut states, StateChannel::Mean { equation, order });
                    }
                }
            }
        }
        self.frictions.iter().for_each(|&(equation, _)| add(&mut states, StateChannel::EndVelocity { equation }));
        // A derivative of an output depends on the same derivative of each output coupled to it. Outputs that enter it
        // by their pulse means are the exception.
        let mut processed = 0;
        while processed < states.len() {
            let channel = states[processed];
            for term in &self.equations[channel.equation()].structure.terms {
                let eta = self.equations[channel.equation()].structure.order - term.order;
                let Some(output) = self.output_index(channel.equation(), term.signal) else { continue };
                let enters_by_means = if channel.is_at_ends() {
                    self.couples_by_means(channel.equation(), output, eta)
                } else {
                    uses_output_means(eta, channel.order())
                };
                if !enters_by_means {
                    add(&mut states, channel.with_equation(output));
                }
            }
            processed += 1;
        }
        states
    }
}

/// Return the error for non-linear terms in combination with an option that does not support them.
pub(crate) fn unsupported_with(what: &str, remedy: &str) -> Error {
    Error::Structure { what: format!("non-linear terms in combination with {what}"), remedy: remedy.into() }
}

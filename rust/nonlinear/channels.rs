//! State channels of equations with non-linear terms, their integral kernels and their forcing.

use super::convolution::{edge_kernel, ConvolutionKernel, MAX_FEEDTHROUGH_ORDER};
use crate::equation::ORDER_GRAIN;
use crate::fractional::kernels::kernel_and_slope;
use crate::signal::block_pulse::PulseJump;

/// Minimum integration order of a linear term: order of the equation minus order of the term.
pub(super) const MIN_INTEGRATION_ORDER: f64 = 1e-3;

/// Maximum order ρ − η of a derivative that is computed from the pulse means of an output. Derivatives amplify
/// high-frequency errors, the more so the higher their order.
const MAX_DIFFERENTIATION_ORDER: f64 = 0.5;

/// Return true if a linear term with integration order η enters the derivative D^ρ of an output as I^{η−ρ} y, computed
/// from the pulse means of y. Return false if it enters as I^η D^ρ y. Both are equal up to initial terms.
///
/// The second form has no feedback from y to D^ρ y. If the linear part of the equation is unstable, errors of y then
/// grow, because non-linear terms that depend on D^ρ y do not act on them.
pub(super) fn uses_output_means(eta: f64, rho: f64) -> bool {
    rho > ORDER_GRAIN && eta >= MIN_INTEGRATION_ORDER && eta - rho >= -MAX_DIFFERENTIATION_ORDER
}

/// State channel: a quantity of a simulated output that is solved for in each pulse.
#[derive(Debug, Clone, Copy)]
pub(super) enum StateChannel {
    /// Pulse means of a derivative of the output.
    Mean {
        /// Index of the equation of the output.
        equation: usize,
        /// Order of the derivative.
        order: f64,
    },
    /// Velocity of the output at the ends of pulses, minus its initial velocity. Dry friction acts on this channel.
    EndVelocity {
        /// Index of the equation of the output.
        equation: usize,
    },
}

impl StateChannel {
    pub(super) fn equation(self) -> usize {
        match self {
            Self::Mean { equation, .. } | Self::EndVelocity { equation } => equation,
        }
    }

    pub(super) fn order(self) -> f64 {
        match self {
            Self::Mean { order, .. } => order,
            Self::EndVelocity { .. } => 1.0,
        }
    }

    pub(super) fn is_at_ends(self) -> bool {
        matches!(self, Self::EndVelocity { .. })
    }

    /// Return the same channel for the output of another equation.
    pub(super) fn with_equation(self, equation: usize) -> Self {
        match self {
            Self::Mean { order, .. } => Self::Mean { equation, order },
            Self::EndVelocity { .. } => Self::EndVelocity { equation },
        }
    }

    pub(super) fn is_same(self, other: Self) -> bool {
        self.equation() == other.equation()
            && self.is_at_ends() == other.is_at_ends()
            && (self.order() - other.order()).abs() < ORDER_GRAIN
    }
}

/// Kernel of a fractional integral. Its convolution with pulse means gives pulse means of the integral, or values at
/// the ends of pulses if `at_ends`.
#[derive(Debug, Clone, Copy)]
pub(super) struct IntegralKernel {
    pub(super) order: f64,
    pub(super) at_ends: bool,
}

impl IntegralKernel {
    /// Return true if values at pulse ends are computed as averages of neighboring pulse means instead of by a
    /// convolution.
    pub(super) fn is_averaged(self) -> bool {
        self.at_ends && self.order <= MAX_FEEDTHROUGH_ORDER
    }

    /// Return the kernel for online convolutions over `m` pulses of length `step` \[s\].
    pub(super) fn kernel(self, m: usize, step: f64) -> ConvolutionKernel {
        ConvolutionKernel::of_integral(self.order, self.values_and_slopes(m, step).0)
    }

    /// Return `m` values of the kernel, and their derivatives with respect to the order.
    pub(super) fn values_and_slopes(self, m: usize, step: f64) -> (Vec<f64>, Vec<f64>) {
        if self.at_ends && !self.is_averaged() {
            edge_kernel(self.order, m, step)
        } else {
            kernel_and_slope(self.order, m, step)
        }
    }
}

/// Forcing of the state channels by initial terms and inputs.
#[derive(Debug, Clone, Default)]
pub(super) struct ForcingTerms {
    /// Forcing of each state channel, one value per pulse; empty if zero.
    pub(super) channels: Vec<Vec<f64>>,
    /// Initial output and velocity of each body with friction; empty if zero.
    pub(super) initial_motion: Vec<(f64, f64)>,
}

/// Derivatives of a system with respect to one parameter.
pub(super) struct SystemDerivatives {
    /// For each equation and term, the derivative of the coefficient and of the integration order. The last pair of an
    /// equation belongs to the friction force.
    pub(super) terms: Vec<Vec<(f64, f64)>>,
    /// Derivatives of the forcing by initial terms.
    pub(super) forcing: ForcingTerms,
    /// Derivatives of Coulomb friction, Stribeck friction and Stribeck velocity of each body with friction.
    pub(super) laws: Vec<[f64; 3]>,
    /// Derivatives of the inputs that depend on the parameter.
    pub(super) inputs: Vec<InputDerivative>,
}

/// Derivative of an input with respect to a parameter.
#[derive(Debug, Clone)]
pub(super) struct InputDerivative {
    pub(super) signal: usize,
    /// Derivatives of the pulse means.
    pub(super) means: Vec<f64>,
    /// Derivatives of the position and of the values of each jump within a pulse.
    pub(super) jumps: Vec<PulseJump>,
}

/// Reason why a pulse has no solution.
pub(super) enum PulseFailure {
    /// A value overflows.
    Overflow,
    /// A function has no value: name of the function, and its argument.
    Domain(&'static str, f64),
    /// No friction forces are consistent with the motion.
    Contact,
    /// The Newton iterations do not converge. The text is the reason.
    Newton(&'static str),
}

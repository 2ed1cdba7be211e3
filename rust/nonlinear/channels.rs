//! Channels of equations with non-linear terms, their integral kernels and their forcing.

use super::convolution::{edge_kernel, ConvolutionKernel, MAX_FEEDTHROUGH_ORDER};
use crate::equation::ORDER_GRAIN;
use crate::fractional::kernels::kernel_and_slope;
use crate::signal::block_pulse::PulseJump;

/// Channel of an output that the equations determine.
#[derive(Debug, Clone, Copy)]
pub(super) enum StateChannel {
    /// Pulse means of a derivative.
    Mean {
        /// Equation of the output.
        equation: usize,
        /// Order of the derivative.
        order: f64,
    },
    /// Velocity at the ends of pulses minus the initial velocity, on which dry friction acts.
    EndVelocity {
        /// Equation of the output.
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

    /// Same channel of the output of another equation.
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

/// Kernel of a fractional integral, in pulse means or at the ends of pulses.
#[derive(Debug, Clone, Copy)]
pub(super) struct IntegralKernel {
    pub(super) order: f64,
    pub(super) at_ends: bool,
}

impl IntegralKernel {
    /// Whether values at pulse ends are averages of neighboring means.
    pub(super) fn is_averaged(self) -> bool {
        self.at_ends && self.order <= MAX_FEEDTHROUGH_ORDER
    }

    /// Kernel of its online convolution.
    pub(super) fn kernel(self, m: usize, step: f64) -> ConvolutionKernel {
        ConvolutionKernel::of_integral(self.order, self.values_and_slopes(m, step).0)
    }

    /// Kernel values, and their derivatives with respect to the order.
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
    /// Forcing of each state channel; empty if zero.
    pub(super) channels: Vec<Vec<f64>>,
    /// Initial output and velocity of each body with friction; empty if zero.
    pub(super) starts: Vec<(f64, f64)>,
}

/// Derivatives of a system with respect to one parameter.
pub(super) struct SystemDerivatives {
    /// Derivatives (of the coefficient, of the integration order) of each term, by equation. The last pair belongs to
    /// the friction force.
    pub(super) terms: Vec<Vec<(f64, f64)>>,
    /// Derivatives of the forcing by initial terms.
    pub(super) forcing: ForcingTerms,
    /// Derivatives of fc, fs and vs of each friction.
    pub(super) laws: Vec<[f64; 3]>,
    /// Derivatives of recorded signals that are inputs.
    pub(super) inputs: Vec<InputDerivative>,
}

/// Derivative of an input with respect to a parameter.
#[derive(Debug, Clone)]
pub(super) struct InputDerivative {
    pub(super) signal: usize,
    /// Derivatives of the pulse means.
    pub(super) means: Vec<f64>,
    /// Derivatives of the share and of the values of each jump within a pulse.
    pub(super) jumps: Vec<PulseJump>,
}

/// Reason for which a pulse has no solution.
pub(super) enum PulseFailure {
    /// A value overflows.
    Overflow,
    /// A function has no value for this argument.
    Domain(&'static str, f64),
    /// No friction forces are consistent with the motion.
    Contact,
    /// No Newton iteration converges.
    Newton(&'static str),
}

//! Coulomb–Stribeck friction in one pulse, a time step of a simulation: F(v) sgn v with F(v) = fc + fs exp(−(v/vs)²),
//! set-valued at rest.
//!
//! Within a pulse the velocity is linear in time unless the body is at rest. The friction force of the pulse is the
//! mean of F(v) sgn v in closed form. The mean of the Gaussian is a difference of error functions. A velocity that
//! reaches zero stays zero if the force is at most the static friction. Otherwise the body reverses its direction. The
//! mean friction force is continuous across this transition. F decreases with speed, so the equation of the end
//! velocity may have several roots in long pulses. The root that is closest to the initial velocity is used.

use core::f64::consts::PI;

/// Motion of a body in a pulse.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// Sliding without a change of direction.
    Slip,
    /// At rest at the end of the pulse.
    Stick,
    /// Sliding with a reversal of direction.
    Turn,
}

/// Friction law of Coulomb friction with Stribeck effect.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrictionLaw {
    /// Coulomb friction fc, not negative, in the unit of the highest derivative D^α y in the equation.
    pub coulomb: f64,
    /// Stribeck friction fs, not negative: excess of the static friction over fc.
    pub stribeck: f64,
    /// Stribeck velocity vs, positive: speed at which the excess has fallen to fs/e.
    pub speed: f64,
}

/// Friction force and motion of a body in one pulse, which is a time step of a simulation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pulse {
    /// Mean friction force over the pulse, in the unit of the highest derivative D^α y in the equation. It is positive
    /// if it opposes a positive velocity.
    pub force: f64,
    /// Velocity at the end of the pulse, exactly 0 at rest.
    pub end: f64,
    /// Motion of the body: sliding, at rest, or reversing.
    pub phase: Phase,
}

/// Derivatives of the quantities that determine the motion of a body in one block pulse, with respect to one parameter:
/// velocities, friction gain and parameters of the friction law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PulseDerivatives {
    /// Derivative of the velocity at the start of the pulse.
    pub start: f64,
    /// Derivative of the velocity at the end of the pulse without friction.
    pub free: f64,
    /// Derivative of the friction gain, which is the decrease of the velocity at the end of the pulse per unit of
    /// friction force.
    pub gain: f64,
    /// Derivatives of Coulomb friction, Stribeck friction and Stribeck velocity.
    pub law: [f64; 3],
}

/// Mean of the friction force F over a speed that changes linearly between two speeds, and its derivatives.
struct Mean {
    value: f64,
    /// Derivative of the mean with respect to the first speed.
    slope_from: f64,
    /// Derivative of the mean with respect to the second speed.
    slope_to: f64,
    /// Derivatives of the mean with respect to Coulomb friction, Stribeck friction and Stribeck velocity.
    law: [f64; 3],
}

/// Difference of two speeds, relative to the Stribeck velocity, below which quadrature replaces the difference of error
/// functions. Quadrature with five points is then exact to rounding, while the difference would lose digits.
const QUADRATURE_SPEED_RATIO: f64 = 0.2;
/// Nodes and weights of the Gauss–Legendre quadrature with five points on [0, 1].
const GAUSS_LEGENDRE_NODES: [(f64, f64); 5] = [
    (0.046_910_077_030_668, 0.118_463_442_528_094_54),
    (0.230_765_344_947_158_45, 0.239_314_335_249_683_24),
    (0.5, 0.284_444_444_444_444_44),
    (0.769_234_655_052_841_6, 0.239_314_335_249_683_24),
    (0.953_089_922_969_332, 0.118_463_442_528_094_54),
];
/// Maximum number of fixed-point iterations for the end velocity. Each iteration adds at least one correct digit,
/// unless two roots nearly coincide.
const MAX_SLIDE_ITERATIONS: usize = 500;

/// Solve a pulse with Coulomb friction. Return (mean friction force divided by fc, end velocity, phase).
///
/// `v` is the initial velocity, `p` the end velocity without friction, and `b` the largest velocity change that
/// friction causes. A body stays at rest if the force exceeds its friction by at most `rounding`, expressed as a
/// velocity change.
#[must_use]
pub fn pulse(v: f64, p: f64, b: f64, rounding: f64) -> (f64, f64, Phase) {
    if v == 0.0 {
        if p.abs() <= b + rounding {
            return (if b > 0.0 { p / b } else { 0.0 }, 0.0, Phase::Stick);
        }
        return (p.signum(), p - b * p.signum(), Phase::Slip);
    }
    let direction = v.signum();
    let end = p - b * direction;
    if end * direction >= 0.0 {
        return (direction, end, Phase::Slip);
    }
    if (p - v).abs() <= b + rounding {
        return (if b > 0.0 { p / b } else { 0.0 }, 0.0, Phase::Stick);
    }
    let sign = direction * (2.0 * v / (v - end) - 1.0);
    (sign, p - b * sign, Phase::Turn)
}

impl FrictionLaw {
    /// Return the law of Coulomb friction alone, whose friction force does not depend on speed.
    #[must_use]
    pub const fn coulomb(coulomb: f64) -> Self {
        Self { coulomb, stribeck: 0.0, speed: 1.0 }
    }

    /// Return the breakaway force fc + fs: the largest friction force at rest.
    #[must_use]
    pub fn breakaway(&self) -> f64 {
        self.coulomb + self.stribeck
    }

    /// Return the mean of exp(−(v/vs)²), with the Stribeck velocity vs, over a speed v that changes linearly from
    /// `from` to `to`. Both are nonnegative.
    fn mean_stribeck_factor(&self, from: f64, to: f64) -> f64 {
        let (x, d) = (from / self.speed, (to - from) / self.speed);
        if d.abs() < QUADRATURE_SPEED_RATIO {
            return GAUSS_LEGENDRE_NODES.iter().map(|(u, w)| w * libm::exp(-(x + u * d).powi(2))).sum();
        }
        0.5 * libm::sqrt(PI) * (libm::erf(x + d) - libm::erf(x)) / d
    }

    fn mean(&self, from: f64, to: f64) -> f64 {
        self.coulomb + self.stribeck * self.mean_stribeck_factor(from, to)
    }

    fn mean_with_slopes(&self, from: f64, to: f64) -> Mean {
        let (x, d) = (from / self.speed, (to - from) / self.speed);
        let mean_stribeck_factor = self.mean_stribeck_factor(from, to);
        let gauss = |z: f64| libm::exp(-z * z);
        let (slope_from, slope_to) = if d.abs() < QUADRATURE_SPEED_RATIO {
            let quadrature = |weight: fn(f64) -> f64| -> f64 {
                GAUSS_LEGENDRE_NODES.iter().map(|(u, w)| -2.0 * w * weight(*u) * (x + u * d) * gauss(x + u * d)).sum()
            };
            (quadrature(|u| 1.0 - u), quadrature(|u| u))
        } else {
            ((mean_stribeck_factor - gauss(x)) / d, (gauss(x + d) - mean_stribeck_factor) / d)
        };
        // The mean depends on vs only by x and x + d.
        let slope_speed = -(x * slope_from + (x + d) * slope_to) / self.speed;
        let s = self.stribeck;
        Mean {
            value: self.coulomb + s * mean_stribeck_factor,
            slope_from: s * slope_from / self.speed,
            slope_to: s * slope_to / self.speed,
            law: [1.0, mean_stribeck_factor, s * slope_speed],
        }
    }

    /// Return the end velocity of a body that slides without reversal, or None if it comes to rest.
    ///
    /// `v` ≥ 0 is the initial velocity, and `p` the end velocity without friction. A unit of friction force decreases
    /// the end velocity by `g`. The mean friction decreases with the end velocity, so iterates from `v` are monotone
    /// and converge to the nearest root.
    fn slide(&self, v: f64, p: f64, g: f64) -> Option<f64> {
        let rounding = 4.0 * f64::EPSILON * (v + p.abs());
        let mut end = v;
        for _ in 0..MAX_SLIDE_ITERATIONS {
            let next = p - g * self.mean(v, end);
            if next < 0.0 {
                return None;
            }
            let change = (next - end).abs();
            end = next;
            if change <= rounding {
                break;
            }
        }
        Some(end)
    }

    /// Return friction force and motion of a body in a pulse.
    ///
    /// `v` is the initial velocity, and `p` the end velocity without friction. A unit of friction force decreases the
    /// end velocity by `g`. A body stays at rest if the force exceeds its friction by at most `rounding`, expressed as
    /// a velocity change.
    #[must_use]
    pub fn pulse(&self, v: f64, p: f64, g: f64, rounding: f64) -> Pulse {
        if self.stribeck == 0.0 {
            let (sign, end, phase) = pulse(v, p, self.coulomb * g, rounding);
            return Pulse { force: self.coulomb * sign, end, phase };
        }
        let max_stick_change = g * self.breakaway() + rounding;
        let at_rest = Pulse { force: if g > 0.0 { p / g } else { 0.0 }, end: 0.0, phase: Phase::Stick };
        if v == 0.0 && p.abs() <= max_stick_change {
            return at_rest;
        }
        let direction = if v == 0.0 { p.signum() } else { v.signum() };
        if let Some(end) = self.slide(direction * v, direction * p, g) {
            let force = direction * self.mean(direction * v, end);
            return Pulse { force, end: p - g * force, phase: Phase::Slip };
        }
        if (p - v).abs() <= max_stick_change {
            return at_rest;
        }
        let (speed, velocity_loss) = (direction * v, direction * (v - p));
        let first_mean = self.mean(0.0, speed);
        let reversal_fraction = speed / (g * first_mean + velocity_loss);
        let remaining_fraction = 1.0 - reversal_fraction;
        // After the reversal, the body starts from rest under the remaining force, against the friction of the
        // remaining time.
        let reverse_speed = self.slide(0.0, remaining_fraction * velocity_loss, remaining_fraction * g).unwrap_or(0.0);
        let force = direction * (reversal_fraction * first_mean - remaining_fraction * self.mean(0.0, reverse_speed));
        Pulse { force, end: -direction * reverse_speed, phase: Phase::Turn }
    }

    /// Return the derivatives of the friction force in a pulse and of the velocity at its end with respect to a
    /// parameter. `v`, `p` and `g` are the arguments of [`FrictionLaw::pulse`], and `pulse` is its result.
    /// `derivatives` holds the derivatives of these arguments and of the law with respect to the parameter.
    #[must_use]
    pub fn slope(&self, v: f64, p: f64, g: f64, pulse: &Pulse, derivatives: &PulseDerivatives) -> (f64, f64) {
        let law_derivative = |mean: &Mean| mean.law.iter().zip(&derivatives.law).map(|(a, b)| a * b).sum::<f64>();
        match pulse.phase {
            Phase::Stick if g > 0.0 && self.breakaway() > 0.0 => {
                ((derivatives.free - pulse.force * derivatives.gain) / g, 0.0)
            }
            Phase::Stick => (0.0, 0.0),
            Phase::Slip => {
                let direction = if v == 0.0 { pulse.end.signum() } else { v.signum() };
                let mean = self.mean_with_slopes(direction * v, (direction * pulse.end).max(0.0));
                let mean_derivative = law_derivative(&mean) + mean.slope_from * direction * derivatives.start;
                let end = (direction * (derivatives.free - pulse.force * derivatives.gain) - g * mean_derivative)
                    / (1.0 + g * mean.slope_to);
                (direction * (mean_derivative + mean.slope_to * end), direction * end)
            }
            Phase::Turn => {
                let direction = v.signum();
                let (speed, velocity_loss) = (direction * v, direction * (v - p));
                let (speed_derivative, loss_derivative) =
                    (direction * derivatives.start, direction * (derivatives.start - derivatives.free));
                let first_mean = self.mean_with_slopes(0.0, speed);
                let first_derivative = law_derivative(&first_mean) + first_mean.slope_to * speed_derivative;
                let total_loss = g * first_mean.value + velocity_loss;
                let reversal_fraction = speed / total_loss;
                let total_derivative = derivatives.gain * first_mean.value + g * first_derivative + loss_derivative;
                let fraction_derivative = (speed_derivative - reversal_fraction * total_derivative) / total_loss;
                let remaining_fraction = 1.0 - reversal_fraction;
                let second_mean = self.mean_with_slopes(0.0, pulse.end.abs());
                let second_derivative = law_derivative(&second_mean);
                let reverse_speed = (remaining_fraction
                    * (loss_derivative - derivatives.gain * second_mean.value - g * second_derivative)
                    - fraction_derivative * (velocity_loss - g * second_mean.value))
                    / (1.0 + remaining_fraction * g * second_mean.slope_to);
                let second_derivative_total = second_derivative + second_mean.slope_to * reverse_speed;
                let force = fraction_derivative * (first_mean.value + second_mean.value)
                    + reversal_fraction * first_derivative
                    - remaining_fraction * second_derivative_total;
                (direction * force, -direction * reverse_speed)
            }
        }
    }
}

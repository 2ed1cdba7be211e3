//! Time stepping of a two-link arm: four coupled fractional-order equations in its angles, with dry friction at its
//! joints.
//!
//! The caller supplies equations with orders and coefficients, as in identification and simulation.
//!
//! Each equation is integrated once. Derivatives above order 1, D^ν θ with ν > 1, then appear on the left as momenta
//! D^{ν−1} θ. All other terms are forces. Fractional derivatives of the angles are integrals of their rates, D^ν θ =
//! I^{1−ν} θ′ and D^ν θ = I^{2−ν} θ″, exact for rates that are linear over a substep. The history is stored in a fixed
//! number of exponentials ([`crate::fractional::exponential_sum`]). One substep is a trapezoidal step, implicit in all
//! four rates.
//!
//! Coulomb friction of a joint is a set-valued torque. It is expressed as a current that is subtracted from the motor
//! current. At standstill it may have any value up to its limit. [`crate::friction::law`] computes it for one joint,
//! and an iteration couples the two joints.

use crate::equation::{check_regular, round_order, Equation, ORDER_GRAIN};
use crate::error::{check_length, check_step, Error, Result};
use crate::fractional::exponential_sum::{decay, Rates};
use crate::friction::law::{pulse, Phase};
use crate::linalg::small;

/// Relative accuracy of the sums of exponentials that represent fractional kernels. It is far below the error of the
/// trapezoidal steps.
const MEMORY_TOLERANCE: f64 = 1e-10;
/// Maximum number of iterations for the friction of both joints. Decoupled joints need one, coupled joints a few.
const MAX_FRICTION_SWEEPS: usize = 60;
/// Rounding error of a rate, relative to the largest change of the rate due to friction.
const RATE_ROUNDING_RATIO: f64 = 1e-12;

/// Maximum number of substeps per sample. A sample with more would take seconds.
const MAX_SUBSTEPS: f64 = 1e6;

/// Number of signals of the arm's equations: angles θ₁₁, θ₁₂, θ₂₁, θ₂₂ and motor currents I₁, I₂.
pub const SIGNAL_COUNT: usize = 6;

/// Equations and friction of the arm.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// Equations D^α θ = Σ c D^ν s of the angles θ₁₁, θ₁₂, θ₂₁, θ₂₂, in this sequence. s is one of the [`SIGNAL_COUNT`]
    /// signals. Friction is not subtracted from the motor currents.
    pub equations: Vec<Equation>,
    /// Coulomb friction of each joint, expressed as a motor current \[A\].
    pub coulomb: [f64; 2],
}

/// Fractional derivative of one angle, and its contributions to the four equations.
#[derive(Debug, Clone, Default)]
struct Operator {
    signal: usize,
    order: f64,
    force: [f64; 4],
    /// Contributions to the momenta on the left-hand side of the integrated equations.
    momentum: [f64; 4],
    /// Weights of the history states; empty for orders 0 and 1.
    weights: Vec<f64>,
    /// Weight of the rate at the start of the substep. `end_weight` is the weight of the rate at its end.
    start_weight: f64,
    end_weight: f64,
    /// Value of the derivative at the start of the substep.
    value: f64,
}

/// State and discretization of the arm.
#[derive(Debug, Clone)]
pub struct Arm {
    substep: f64,
    substeps: usize,
    operators: Vec<Operator>,
    /// Acceleration of each angle per ampere of each motor \[rad/(s² A)\].
    input: [[f64; 2]; 4],
    coulomb: [f64; 2],
    /// Matrix (P − h/2·C)⁻¹ for a substep h. P and C hold the momenta and the forces per unit of rate at the end of the
    /// substep.
    step_inverse: [[f64; 4]; 4],
    rate_forces: [[f64; 4]; 4],
    decay_factors: Vec<f64>,
    first_weights: Vec<f64>,
    last_weights: Vec<f64>,
    history: [Vec<f64>; 4],
    rate: [f64; 4],
    angle: [f64; 4],
    force: [f64; 4],
    friction: [f64; 2],
}

impl Arm {
    /// Build the model of an arm at rest. A sample lasts `step` \[s\] and is divided into substeps of at most
    /// `longest_substep` \[s\]. The history is accurate up to the time `horizon` \[s\].
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for an order outside [0, 3), a highest order outside (1, 2], a negative friction, a step
    /// that is not positive, a horizon that is NaN, or more than a million substeps. [`Error::NotFinite`] for a
    /// coefficient that is not finite. [`Error::Structure`] for a singular leading matrix, a differentiated current, or
    /// friction of a joint on which its motor does not act.
    pub fn new(parameters: &Parameters, step: f64, longest_substep: f64, horizon: f64) -> Result<Self> {
        check_step(step)?;
        check_step(longest_substep)?;
        let out_of_range = |name: &str, value: f64, range: &str| Error::OutOfRange {
            name: name.into(),
            value,
            range: range.into(),
            remedy: "correct the times of the virtual arm".into(),
        };
        if horizon.is_nan() {
            return Err(out_of_range("horizon", horizon, "[0, ∞) s"));
        }
        let substep_count = (step / longest_substep - 1e-9).ceil().max(1.0);
        if substep_count > MAX_SUBSTEPS {
            return Err(out_of_range("substeps per sample", substep_count, &format!("[1, {MAX_SUBSTEPS}]")));
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let substeps = substep_count as usize;
        #[allow(clippy::cast_precision_loss)]
        let h = step / substeps as f64;
        let (mut operators, input) = accelerations(parameters)?;
        let rates = Rates::new(h, horizon.max(2.0 * step), MEMORY_TOLERANCE)?;
        for operator in &mut operators {
            operator.prepare(h, &rates);
        }
        let (mut rate_forces, mut momenta) = ([[0.0; 4]; 4], [[0.0; 4]; 4]);
        for operator in &operators {
            for (row, c) in rate_forces.iter_mut().zip(operator.force) {
                row[operator.signal] += c * operator.end_weight;
            }
            for (row, c) in momenta.iter_mut().zip(operator.momentum) {
                row[operator.signal] += c * operator.end_weight;
            }
        }
        let matrix: Vec<f64> = (0..16).map(|i| momenta[i / 4][i % 4] - h / 2.0 * rate_forces[i / 4][i % 4]).collect();
        let inverse = small::inverse(&matrix, 4).map_err(|_| singular_matrix_error())?;
        let mut step_inverse = [[0.0; 4]; 4];
        for (i, value) in inverse.iter().enumerate() {
            step_inverse[i / 4][i % 4] = *value;
        }
        let steps: Vec<(f64, f64, f64)> = rates.rates().iter().map(|s| decay(s * h)).collect();
        let count = steps.len();
        // Angles that are differentiated by integer orders only have no history.
        let has_history: [bool; 4] =
            std::array::from_fn(|s| operators.iter().any(|o| o.signal == s && !o.weights.is_empty()));
        let arm = Self {
            substep: h,
            substeps,
            operators,
            input,
            coulomb: parameters.coulomb,
            step_inverse,
            rate_forces,
            decay_factors: steps.iter().map(|s| s.0).collect(),
            first_weights: steps.iter().map(|s| h * s.1).collect(),
            last_weights: steps.iter().map(|s| h * s.2).collect(),
            history: has_history.map(|has_history| vec![0.0; if has_history { count } else { 0 }]),
            rate: [0.0; 4],
            angle: [0.0; 4],
            force: [0.0; 4],
            friction: [0.0; 2],
        };
        let columns = arm.rate_changes();
        for (k, column) in columns.iter().enumerate() {
            if arm.coulomb[k] > 0.0 && !(column[2 * k] > 0.0 && column[2 * k].is_finite()) {
                return Err(Error::Structure {
                    what: format!(
                        "motor {} does not move its hub, so friction given as a current of the motor does not act on the hub",
                        k + 1
                    ),
                    remedy: "give the hub a positive torque per ampere, or no friction".into(),
                });
            }
        }
        Ok(arm)
    }

    /// Hub angle and deflection of joint 1, then of joint 2: θ₁₁, θ₁₂, θ₂₁, θ₂₂ \[rad\].
    #[must_use]
    pub fn angles(&self) -> [f64; 4] {
        self.angle
    }

    /// Rates of the angles \[rad/s\].
    #[must_use]
    pub fn rates(&self) -> [f64; 4] {
        self.rate
    }

    /// Total number of history states of all angles.
    #[must_use]
    pub fn memory(&self) -> usize {
        self.history.iter().map(Vec::len).sum()
    }

    /// Advance by one sample with constant motor currents \[A\]. The computing time does not grow with the elapsed
    /// time.
    pub fn advance(&mut self, current: [f64; 2]) {
        for _ in 0..self.substeps {
            self.substep(current);
        }
    }

    fn substep(&mut self, current: [f64; 2]) {
        let h = self.substep;
        let (mut history_forces, mut momentum) = ([0.0; 4], [0.0; 4]);
        for operator in &mut self.operators {
            let s = operator.signal;
            let mut value = operator.start_weight * self.rate[s];
            if operator.order == 0.0 {
                value += self.angle[s];
            }
            value += operator.weights.iter().zip(&self.history[s]).map(|(w, z)| w * z).sum::<f64>();
            for (sum, c) in history_forces.iter_mut().zip(operator.force) {
                *sum += c * value;
            }
            for (sum, c) in momentum.iter_mut().zip(operator.momentum) {
                *sum += c * (operator.value - value);
            }
            // The contribution of the rate at the end of the substep is added below.
            operator.value = value;
        }
        let mut right = [0.0; 4];
        for (i, value) in right.iter_mut().enumerate() {
            let input_force: f64 = self.input[i].iter().zip(current).map(|(b, u)| b * u).sum();
            *value = momentum[i] + h / 2.0 * (self.force[i] + history_forces[i]) + h * input_force;
        }
        let mut rate = times(&self.step_inverse, &right);
        if self.coulomb != [0.0; 2] {
            self.apply_friction(&mut rate);
        }
        for operator in &mut self.operators {
            operator.value += operator.end_weight * rate[operator.signal];
        }
        let rate_force = times(&self.rate_forces, &rate);
        for i in 0..4 {
            self.force[i] = history_forces[i] + rate_force[i];
            self.angle[i] += h / 2.0 * (self.rate[i] + rate[i]);
            let (before, after) = (self.rate[i], rate[i]);
            for (((z, decay_factor), first_weight), last_weight) in
                self.history[i].iter_mut().zip(&self.decay_factors).zip(&self.first_weights).zip(&self.last_weights)
            {
                *z = *z * decay_factor + first_weight * before + last_weight * after;
            }
        }
        self.rate = rate;
    }

    /// Return the change of the rates at the end of a substep per ampere of each motor: four rates for each motor.
    fn rate_changes(&self) -> [[f64; 4]; 2] {
        let h = self.substep;
        std::array::from_fn(|k| times(&self.step_inverse, &std::array::from_fn(|i| h * self.input[i][k])))
    }

    /// Subtract Coulomb friction from the rates at the end of a substep. Iterate over the friction laws of both joints
    /// until they converge.
    fn apply_friction(&mut self, rate: &mut [f64; 4]) {
        let columns = self.rate_changes();
        let frictionless = *rate;
        let mut friction = self.friction;
        let mut is_resting = [false; 2];
        for _ in 0..MAX_FRICTION_SWEEPS {
            let mut change = 0.0_f64;
            for k in (0..2).filter(|&k| self.coulomb[k] > 0.0) {
                let (hub, other) = (2 * k, 1 - k);
                let coupled_rate = frictionless[hub] - columns[other][hub] * friction[other];
                let max_change = columns[k][hub] * self.coulomb[k];
                let (sign, _, phase) =
                    pulse(self.rate[hub], coupled_rate, max_change, RATE_ROUNDING_RATIO * max_change);
                let next = self.coulomb[k] * sign;
                change = change.max((next - friction[k]).abs());
                friction[k] = next;
                is_resting[k] = phase == Phase::Stick;
            }
            if change < 1e-15 {
                break;
            }
        }
        self.friction = friction;
        for i in 0..4 {
            rate[i] = frictionless[i] - columns[0][i] * friction[0] - columns[1][i] * friction[1];
        }
        for k in 0..2 {
            // A joint at rest has a rate of exactly 0, so its encoder does not count.
            if is_resting[k] {
                rate[2 * k] = 0.0;
            }
        }
    }
}

fn times(matrix: &[[f64; 4]; 4], vector: &[f64; 4]) -> [f64; 4] {
    std::array::from_fn(|i| matrix[i].iter().zip(vector).map(|(a, b)| a * b).sum())
}

impl Operator {
    fn prepare(&mut self, h: f64, rates: &Rates) {
        if self.order == 0.0 {
            (self.start_weight, self.end_weight) = (h / 2.0, h / 2.0);
        } else if self.order == 1.0 {
            (self.start_weight, self.end_weight) = (0.0, 1.0);
        } else if self.order < 1.0 {
            // Exact integral I^q of a rate that is linear over the last substep. The exponentials represent the history
            // before it.
            let q = 1.0 - self.order;
            let scale = libm::pow(h, q) / libm::tgamma(q + 2.0);
            (self.start_weight, self.end_weight) = (q * scale, scale);
            self.weights = history_weights(rates, q, h);
        } else {
            let q = 2.0 - self.order;
            let scale = libm::pow(h, q - 1.0) / libm::tgamma(q + 1.0);
            // ∫ e^{−s(t−τ)} θ″ dτ = θ′(t) − s z(t).
            let weights = history_weights(rates, q, h);
            self.start_weight = weights.iter().sum::<f64>() - scale;
            self.end_weight = scale;
            self.weights = weights.iter().zip(rates.rates()).map(|(w, s)| -w * s).collect();
        }
    }
}

/// Return the weights of the exponentials in the kernel of order `q` for lags longer than one substep `h`.
fn history_weights(rates: &Rates, q: f64, h: f64) -> Vec<f64> {
    rates.weights(q).iter().zip(rates.rates()).map(|(w, s)| w * libm::exp(-s * h)).collect()
}

fn singular_matrix_error() -> Error {
    Error::Structure {
        what: "the equations of the arm cannot be solved for its angles: their leading matrix is singular".into(),
        remedy: "change an order, or a coupling inertia of the links".into(),
    }
}

/// Return the forces and momenta of the four equations as derivatives of the angles, and the coefficients of both motor
/// currents in each equation.
fn accelerations(parameters: &Parameters) -> Result<(Vec<Operator>, [[f64; 2]; 4])> {
    check_length("equations of the arm", 4, parameters.equations.len())?;
    let out_of_range = |name: &str, value: f64, range: &str| Error::OutOfRange {
        name: name.into(),
        value,
        range: range.into(),
        remedy: "correct the arm's parameters".into(),
    };
    if let Some(&value) = parameters.coulomb.iter().find(|c| !(**c >= 0.0 && c.is_finite())) {
        return Err(out_of_range("Coulomb friction", value, "[0, ∞) A"));
    }
    let mut operators: Vec<Operator> = Vec::new();
    let mut input = [[0.0; 2]; 4];
    for (row, equation) in parameters.equations.iter().enumerate() {
        let structure = &equation.structure;
        crate::error::check_finite("coefficients of the arm", &equation.coefficients)?;
        check_length("coefficients", structure.terms.len(), equation.coefficients.len())?;
        if structure.output != row {
            let what = format!("equation {row} of the arm does not have angle {row} as output");
            return Err(Error::Structure { what, remedy: "give θ11, θ12, θ21, θ22 in this order".into() });
        }
        let alpha = structure.order;
        if !(alpha > 1.0 && alpha <= 2.0) {
            return Err(out_of_range("highest order of the arm", alpha, "(1, 2]"));
        }
        // Terms of the left-hand side have a negative sign on the right-hand side.
        let terms = structure.terms.iter().zip(&equation.coefficients).map(|(t, &c)| (t.signal, t.order, c));
        for (signal, order, c) in std::iter::once((row, alpha, -1.0)).chain(terms) {
            if signal >= SIGNAL_COUNT {
                let what =
                    format!("an equation of the arm contains signal {signal}, but the arm has {SIGNAL_COUNT} signals");
                return Err(Error::Structure { what, remedy: "number four angles and two currents from 0".into() });
            }
            if signal >= 4 {
                if order.abs() > ORDER_GRAIN {
                    let what = format!("an equation of the arm contains a current with derivative order {order}");
                    return Err(Error::Structure {
                        what,
                        remedy: "use order 0 for currents, which have a zero-order hold".into(),
                    });
                }
                input[row][signal - 4] += c;
                continue;
            }
            // From order 3 on, the momentum would have a derivative of order 2 or more, which trapezoidal steps do not
            // support.
            if !(0.0..3.0).contains(&order) {
                return Err(out_of_range("order of the arm", order, "[0, 3)"));
            }
            if c == 0.0 {
                continue;
            }
            let is_momentum = order > 1.0;
            let order = round_order(if is_momentum { order - 1.0 } else { order });
            #[allow(clippy::float_cmp)]
            let position = operators.iter().position(|o| o.signal == signal && o.order == order);
            let index = position.unwrap_or_else(|| {
                operators.push(Operator { signal, order, ..Operator::default() });
                operators.len() - 1
            });
            if is_momentum {
                operators[index].momentum[row] -= c;
            } else {
                operators[index].force[row] += c;
            }
        }
    }
    check_regular(&parameters.equations).map_err(|_| singular_matrix_error())?;
    Ok((operators, input))
}

//! The physical two-link arm stepped sample by sample, with its converters, paced in real time or not.
//!
//! Each hub obeys (17) with Newton's order 2 on the left, each link (15): it hangs on its hub's motion, which enters by
//! D^{2−μ+γ} of the hub angle, a change of momentum. Or both obey (22)–(23) as published, where that motion is eliminated
//! and a derivative of the current dropped: such a link bends the wrong way. The hub's Coulomb friction is a set-valued
//! torque, so it counts as a current that is subtracted from the motor's and may take any value up to its limit at
//! standstill. Stage 2 rides on link 1: with φ = θ₁₁ + θ₁₂ its base accelerates by φ″, and its motor's torque pulls on
//! link 1,
//!
//!   J₁₁θ₁₁″ = τ₁ + …,   J₁₂φ″ = … − κτ₂,   J₂₁(κφ″ + θ₂₁″) = τ₂ + …,   κ = 0 (apart) … 1 (the real mounting),
//!
//! which follow from one Lagrangian for every κ; link 2 hangs on the motion of its hub against the ground, κφ + θ₂₁.
//! Fractional derivatives of the angles are integrals of their rates,
//! D^ν θ = I^{1−ν} θ′ and D^ν θ = I^{2−ν} θ″, exact for rates that are linear over a substep; the past lives in a fixed
//! number of exponentials ([`crate::memory`]). One substep is a trapezoidal step, implicit in all four rates at once.

use crate::error::{check_step, Error, Result};
use crate::memory::{decay, Rates};
use crate::small;

/// Accuracy of the memory's kernels: far below what the trapezoidal steps leave.
const MEMORY_TOLERANCE: f64 = 1e-10;
/// Sweeps of the friction solve; two hubs need one where the stages are apart and a few where they are not.
const FRICTION_SWEEPS: usize = 60;

/// Most substeps of a sample: more take seconds each, and a slip of the hand would never end.
const MOST_SUBSTEPS: f64 = 1e6;

/// Which equation of the deflection is integrated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// (15): the link hangs on its hub.
    Lagrange,
    /// (23) as published.
    Published,
}

/// Orders, coefficients and friction of one stage, by the paper's names.
#[derive(Debug, Clone, PartialEq)]
pub struct Stage {
    /// Orders in the hub's equation: β on the deflection, γ on the hub, μ on the deflection; in [0, 2).
    pub hub_orders: [f64; 3],
    /// a, b, d, g of the hub's equation.
    pub hub: [f64; 4],
    /// Orders in the deflection's equation: β, γ, μ; in [0, 2), but γ in [1, 3) of [`Form::Lagrange`].
    pub deflection_orders: [f64; 3],
    /// a, b, d, g of the deflection's equation; g is 0 of [`Form::Lagrange`].
    pub deflection: [f64; 4],
    /// Coulomb friction of the hub as a current \[A\].
    pub coulomb: f64,
}

/// Both stages and how they are joined.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    /// Stage 1 and stage 2.
    pub stages: [Stage; 2],
    /// κ: 0 stages apart, 1 stage 2 on link 1.
    pub coupling: f64,
    /// J₂₁/J₁₂.
    pub inertia_ratio: f64,
    /// Which equation of the deflections.
    pub form: Form,
}

/// A derivative of one angle and what it contributes to the four equations.
#[derive(Debug, Clone, Default)]
struct Operator {
    signal: usize,
    order: f64,
    into: [f64; 4],
    /// Momenta that it is part of, beside the rates: what stands on the left of the equations, integrated once.
    momentum: [f64; 4],
    /// On the states of the past; empty for orders 0 and 1.
    weights: Vec<f64>,
    /// On the rate at the start and at the end of the substep.
    before: f64,
    now: f64,
    /// Its value at the start of the substep.
    value: f64,
}

/// The arm's state and its substep.
#[derive(Debug, Clone)]
pub struct Arm {
    substep: f64,
    substeps: usize,
    operators: Vec<Operator>,
    /// Accelerations per ampere of both motors.
    input: [[f64; 2]; 4],
    coulomb: [f64; 2],
    /// (P − h/2·C)⁻¹ with P the momenta and C the forces per rate at the end of the substep.
    solve: [[f64; 4]; 4],
    implicit: [[f64; 4]; 4],
    keep: Vec<f64>,
    first: Vec<f64>,
    last: Vec<f64>,
    past: [Vec<f64>; 4],
    rate: [f64; 4],
    angle: [f64; 4],
    linear: [f64; 4],
    friction: [f64; 2],
}

impl Arm {
    /// An arm at rest, stepped `step` s at a time in substeps of at most `longest_substep`, for `horizon` s.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for an order outside [0, 2), a negative friction or coupling, a step that is not positive, a
    /// horizon that is no number, more than a million substeps;
    /// [`Error::NotFinite`] for a coefficient.
    pub fn new(parameters: &Parameters, step: f64, longest_substep: f64, horizon: f64) -> Result<Self> {
        check_step(step)?;
        check_step(longest_substep)?;
        let outside = |name: &str, value: f64, range: &str| Error::OutOfRange {
            name: name.into(),
            value,
            range: range.into(),
            remedy: "correct the times of the virtual arm".into(),
        };
        if horizon.is_nan() {
            return Err(outside("horizon", horizon, "[0, ∞) s"));
        }
        let parts = (step / longest_substep - 1e-9).ceil().max(1.0);
        if parts > MOST_SUBSTEPS {
            return Err(outside("substeps a sample", parts, &format!("[1, {MOST_SUBSTEPS}]")));
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let substeps = parts as usize;
        #[allow(clippy::cast_precision_loss)]
        let h = step / substeps as f64;
        let (mut operators, input) = accelerations(parameters)?;
        let rates = Rates::new(h, horizon.max(2.0 * step), MEMORY_TOLERANCE)?;
        for operator in &mut operators {
            operator.prepare(h, &rates);
        }
        let (mut implicit, mut momenta) = ([[0.0; 4]; 4], [[0.0; 4]; 4]);
        (0..4).for_each(|i| momenta[i][i] = 1.0);
        for operator in &operators {
            for (row, c) in implicit.iter_mut().zip(operator.into) {
                row[operator.signal] += c * operator.now;
            }
            for (row, c) in momenta.iter_mut().zip(operator.momentum) {
                row[operator.signal] += c * operator.now;
            }
        }
        let matrix: Vec<f64> = (0..16).map(|i| momenta[i / 4][i % 4] - h / 2.0 * implicit[i / 4][i % 4]).collect();
        let inverse = small::inverse(&matrix, 4)?;
        let mut solve = [[0.0; 4]; 4];
        for (i, value) in inverse.iter().enumerate() {
            solve[i / 4][i % 4] = *value;
        }
        let steps: Vec<(f64, f64, f64)> = rates.rates().iter().map(|s| decay(s * h)).collect();
        let count = steps.len();
        Ok(Self {
            substep: h,
            substeps,
            operators,
            input,
            coulomb: [parameters.stages[0].coulomb, parameters.stages[1].coulomb],
            solve,
            implicit,
            keep: steps.iter().map(|s| s.0).collect(),
            first: steps.iter().map(|s| h * s.1).collect(),
            last: steps.iter().map(|s| h * s.2).collect(),
            past: std::array::from_fn(|_| vec![0.0; count]),
            rate: [0.0; 4],
            angle: [0.0; 4],
            linear: [0.0; 4],
            friction: [0.0; 2],
        })
    }

    /// θ₁₁, θ₁₂, θ₂₁, θ₂₂ \[rad\].
    #[must_use]
    pub fn angles(&self) -> [f64; 4] {
        self.angle
    }

    /// Their rates \[rad/s\].
    #[must_use]
    pub fn rates(&self) -> [f64; 4] {
        self.rate
    }

    /// How many numbers hold the past.
    #[must_use]
    pub fn memory(&self) -> usize {
        self.past.iter().map(Vec::len).sum()
    }

    /// One sample under held motor currents \[A\]. Constant time.
    pub fn advance(&mut self, current: [f64; 2]) {
        for _ in 0..self.substeps {
            self.substep(current);
        }
    }

    fn substep(&mut self, current: [f64; 2]) {
        let h = self.substep;
        let (mut history, mut gained) = ([0.0; 4], [0.0; 4]);
        for operator in &mut self.operators {
            let s = operator.signal;
            let mut value = operator.before * self.rate[s];
            if operator.order == 0.0 {
                value += self.angle[s];
            }
            value += operator.weights.iter().zip(&self.past[s]).map(|(w, z)| w * z).sum::<f64>();
            for (sum, c) in history.iter_mut().zip(operator.into) {
                *sum += c * value;
            }
            for (sum, c) in gained.iter_mut().zip(operator.momentum) {
                *sum += c * (operator.value - value);
            }
            // But for what the rate at the end adds.
            operator.value = value;
        }
        let mut right = [0.0; 4];
        for (i, value) in right.iter_mut().enumerate() {
            let driven: f64 = self.input[i].iter().zip(current).map(|(b, u)| b * u).sum();
            *value = self.rate[i] + gained[i] + h / 2.0 * (self.linear[i] + history[i]) + h * driven;
        }
        let mut rate = times(&self.solve, &right);
        if self.coulomb != [0.0; 2] {
            self.rub(&mut rate);
        }
        for operator in &mut self.operators {
            operator.value += operator.now * rate[operator.signal];
        }
        let implicit = times(&self.implicit, &rate);
        for i in 0..4 {
            self.linear[i] = history[i] + implicit[i];
            self.angle[i] += h / 2.0 * (self.rate[i] + rate[i]);
            let (before, after) = (self.rate[i], rate[i]);
            for (((z, keep), first), last) in self.past[i].iter_mut().zip(&self.keep).zip(&self.first).zip(&self.last) {
                *z = *z * keep + first * before + last * after;
            }
        }
        self.rate = rate;
    }

    /// Coulomb friction: the currents within ±coulomb that stop the hubs, or as much of them as there is.
    fn rub(&mut self, rate: &mut [f64; 4]) {
        let h = self.substep;
        // Rates per ampere of friction; column k is the response to motor k.
        let columns: [[f64; 4]; 2] =
            std::array::from_fn(|k| times(&self.solve, &std::array::from_fn(|i| h * self.input[i][k])));
        let free = *rate;
        let mut friction = self.friction;
        for _ in 0..FRICTION_SWEEPS {
            let mut change = 0.0_f64;
            for k in 0..2 {
                let hub = 2 * k;
                let speed = free[hub] - columns[0][hub] * friction[0] - columns[1][hub] * friction[1];
                let next = (friction[k] + speed / columns[k][hub]).clamp(-self.coulomb[k], self.coulomb[k]);
                change = change.max((next - friction[k]).abs());
                friction[k] = next;
            }
            if change < 1e-15 {
                break;
            }
        }
        self.friction = friction;
        for i in 0..4 {
            rate[i] = free[i] - columns[0][i] * friction[0] - columns[1][i] * friction[1];
        }
        for k in 0..2 {
            // A hub held by friction stands still exactly, and its encoder with it.
            if friction[k].abs() < self.coulomb[k] {
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
            (self.before, self.now) = (h / 2.0, h / 2.0);
        } else if self.order == 1.0 {
            (self.before, self.now) = (0.0, 1.0);
        } else if self.order < 1.0 {
            // I^q of a rate that is linear over the last substep, exactly; older parts through the exponentials.
            let q = 1.0 - self.order;
            let scale = libm::pow(h, q) / libm::tgamma(q + 2.0);
            (self.before, self.now) = (q * scale, scale);
            self.weights = decayed(rates, q, h);
        } else {
            let q = 2.0 - self.order;
            let scale = libm::pow(h, q - 1.0) / libm::tgamma(q + 1.0);
            // ∫ e^{−s(t−τ)} θ″ dτ = θ′(t) − s z(t).
            let weights = decayed(rates, q, h);
            self.before = weights.iter().sum::<f64>() - scale;
            self.now = scale;
            self.weights = weights.iter().zip(rates.rates()).map(|(w, s)| -w * s).collect();
        }
    }
}

/// Weights of the kernel at lags beyond a substep.
fn decayed(rates: &Rates, q: f64, h: f64) -> Vec<f64> {
    rates.weights(q).iter().zip(rates.rates()).map(|(w, s)| w * libm::exp(-s * h)).collect()
}

/// The forces and momenta of the four equations as derivatives of the angles, and their motor currents.
fn accelerations(parameters: &Parameters) -> Result<(Vec<Operator>, [[f64; 2]; 4])> {
    let (k, ratio) = (parameters.coupling, parameters.inertia_ratio);
    let outside = |name: &str, value: f64, range: &str| Error::OutOfRange {
        name: name.into(),
        value,
        range: range.into(),
        remedy: "correct the arm's parameters".into(),
    };
    if !(0.0..=1.0).contains(&k) {
        return Err(outside("coupling", k, "[0, 1]"));
    }
    if !(ratio >= 0.0 && ratio.is_finite()) {
        return Err(outside("inertia ratio", ratio, "[0, ∞)"));
    }
    let mut terms: Vec<(usize, f64, usize, f64)> = Vec::new();
    let mut momenta: Vec<(usize, f64, usize, f64)> = Vec::new();
    let mut input = [[0.0; 2]; 4];
    for (j, stage) in parameters.stages.iter().enumerate() {
        if !(stage.coulomb >= 0.0 && stage.coulomb.is_finite()) {
            return Err(outside("Coulomb friction", stage.coulomb, "[0, ∞) A"));
        }
        let (hub, link) = (2 * j, 2 * j + 1);
        for (row, orders, c) in [(hub, stage.hub_orders, stage.hub), (link, stage.deflection_orders, stage.deflection)]
        {
            crate::error::check_finite("coefficients of the arm", &c)?;
            for (t, signal) in [link, hub, link].into_iter().enumerate() {
                // Integrated once with its equation, the hub's motion is a momentum.
                let moved = row == link && t == 1 && parameters.form == Form::Lagrange;
                let order = if moved { orders[t] - 1.0 } else { orders[t] };
                if !(0.0..2.0).contains(&order) {
                    return Err(outside("order of the arm", orders[t], if moved { "[1, 3)" } else { "[0, 2)" }));
                }
                if moved {
                    momenta.push((signal, order, row, -c[t]));
                    if j == 1 {
                        // Hub 2 turns with the tip of link 1.
                        momenta.extend([(0, order, row, -k * c[t]), (1, order, row, -k * c[t])]);
                    }
                } else {
                    terms.push((signal, orders[t], row, c[t]));
                }
            }
            input[row][j] += c[3];
        }
    }
    // What accelerates φ accelerates the base of hub 2 the other way.
    momenta.extend([(0, 1.0, 2, k), (1, 1.0, 2, k)]);
    // Motor 2 and its friction pull on link 1.
    let second = &parameters.stages[1];
    terms.push((2, second.hub_orders[1], 1, -k * ratio * second.hub[1]));
    input[1][1] -= k * ratio * second.hub[3];

    let mut operators: Vec<Operator> = Vec::new();
    for (list, momentum) in [(terms, false), (momenta, true)] {
        for (signal, order, row, c) in list.into_iter().filter(|term| term.3 != 0.0) {
            #[allow(clippy::float_cmp)]
            let known = operators.iter().position(|o| o.signal == signal && o.order == order);
            let at = known.unwrap_or_else(|| {
                operators.push(Operator { signal, order, ..Operator::default() });
                operators.len() - 1
            });
            let into = if momentum { &mut operators[at].momentum } else { &mut operators[at].into };
            into[row] += c;
        }
    }
    Ok((operators, input))
}

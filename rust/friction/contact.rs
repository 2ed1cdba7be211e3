//! Friction forces of coupled bodies in one pulse, a time step of a simulation, with a set-valued friction law.
//!
//! p_a is the velocity of body a at the end of the pulse without friction, e_a the velocity with friction, and φ_a the
//! mean friction force. These satisfy e = p − G φ, where G_ab is the decrease of the velocity of body a per unit of
//! friction force on body b. The friction force of a body is a function T_a of its end velocity without its own
//! friction ([`FrictionLaw::pulse`]): φ_a = T_a(p_a − Σ_{b≠a} G_ab φ_b).
//!
//! With Coulomb friction, T_a rises with its argument by at most 1/G_aa. Friction and end velocity of a body therefore
//! never change in opposite directions: two solutions have Δe_a Δφ_a ≥ 0 for every a, while Δe = −G Δφ. If G is a
//! P-matrix (all principal minors are positive, as for an inverse inertia matrix), some a has Δφ_a (G Δφ)_a > 0 unless
//! Δφ = 0. The solution is therefore unique: exactly one combination of sliding and sticking is consistent. Newton
//! steps find it in a few iterations. A Newton step that does not halve the error is replaced by a Gauss–Seidel sweep
//! over the bodies. The sweep decreases the error for inertia matrices, because these are symmetric up to scaling.
//!
//! Stribeck friction falls with speed. In long pulses, several combinations of sliding and sticking may then be
//! consistent. The iteration starts at the friction forces of the previous pulse, and the solution that it finds is
//! used.

use super::law::{FrictionLaw, Pulse, PulseDerivatives};
use crate::error::{Error, Result};
use crate::linalg::small;

/// Friction problem of coupled bodies: friction laws and gains G_ab. G_ab is the decrease of the velocity of body a at
/// the end of a pulse per unit of friction force on body b.
#[derive(Debug, Clone, PartialEq)]
pub struct FrictionProblem {
    laws: Vec<FrictionLaw>,
    /// Gains G_ab, row-major.
    gains: Vec<f64>,
}

/// Maximum number of iterations for the friction forces of a pulse. Two weakly coupled bodies need two iterations.
const MAX_CONTACT_ITERATIONS: usize = 200;
/// Rounding error of a velocity, relative to the largest velocity without friction. A body at rest does not move under
/// a force that equals its friction within this error.
pub(crate) const VELOCITY_ROUNDING_RATIO: f64 = 1e-12;
/// Maximum error of a friction force, expressed as the velocity change it causes relative to the velocities of the
/// pulse.
pub(crate) const MAX_FRICTION_ERROR_RATIO: f64 = 1e-9;

impl FrictionProblem {
    /// Friction problem of bodies with these friction laws. `gains` holds G_ab, row-major.
    ///
    /// # Errors
    /// [`Error::NotSimulable`] if G is not a P-matrix, so that the friction forces of a pulse are not unique. The step is
    /// then too long.
    pub fn new(laws: Vec<FrictionLaw>, gains: Vec<f64>) -> Result<Self> {
        if !is_p_matrix(&gains, laws.len()) {
            // The optimizer shortens its step after this error.
            let reason = "the friction forces of the coupled bodies are not unique at this step";
            return Err(Error::NotSimulable { reason: reason.into() });
        }
        Ok(Self { laws, gains })
    }

    /// Number of bodies.
    #[must_use]
    pub fn count(&self) -> usize {
        self.laws.len()
    }

    /// Friction law of a body.
    #[must_use]
    pub fn law(&self, body: usize) -> &FrictionLaw {
        &self.laws[body]
    }

    /// Return the gain G_ab, where a is `body` and b is `other`. Both may be the same body.
    #[must_use]
    pub fn gain(&self, body: usize, other: usize) -> f64 {
        self.gains[body * self.count() + other]
    }

    /// Return the gain G_aa, where a is `body`.
    #[must_use]
    pub fn own_gain(&self, body: usize) -> f64 {
        self.gain(body, body)
    }

    /// Breakaway force of a body.
    #[must_use]
    pub fn breakaway(&self, body: usize) -> f64 {
        self.laws[body].breakaway()
    }

    /// Return the decrease of the end velocity of a body due to the friction forces on the other bodies during a pulse.
    fn coupling_velocity(&self, body: usize, forces: impl Fn(usize) -> f64) -> f64 {
        (0..self.count()).filter(|&b| b != body).map(|b| self.gain(body, b) * forces(b)).sum()
    }

    /// Solve for the friction forces in a pulse or in an interval of it. `v` holds the velocities of the bodies at its
    /// start, and `p` the velocities at its end without friction.
    ///
    /// `length` is the length of the interval as a fraction of the pulse; the gains are proportional to it. A body
    /// stays at rest if the external force exceeds its friction by at most `rounding`, expressed as a velocity change.
    /// The iteration starts at the friction forces `initial_forces`. `pulses` receives, for each body, the end velocity
    /// without its own friction, and the solved pulse. Without convergence, the end velocities in the pulses are NaN,
    /// except with Stribeck friction.
    pub fn solve(
        &self,
        length: f64,
        (v, p): (&[f64], &[f64]),
        rounding: &[f64],
        initial_forces: &[f64],
        pulses: &mut Vec<(f64, Pulse)>,
    ) {
        let n = self.count();
        let own_gain = |a: usize| length * self.own_gain(a);
        let body_pulse = |a: usize, forces: &[f64]| {
            let free = p[a] - length * self.coupling_velocity(a, |b| forces[b]);
            (free, self.laws[a].pulse(v[a], free, own_gain(a), rounding[a]))
        };
        pulses.clear();
        pulses.extend((0..n).map(|a| body_pulse(a, initial_forces)));
        if n == 1 {
            return;
        }
        let mut forces = initial_forces.to_vec();
        let max_error = |pulses: &[(f64, Pulse)], forces: &[f64]| {
            pulses
                .iter()
                .zip(forces)
                .enumerate()
                .fold(0.0_f64, |w, (a, (x, f))| w.max((x.1.force - f).abs() * own_gain(a)))
        };
        let mut error = max_error(pulses, &forces);
        let size = (0..n).map(|a| v[a].abs() + p[a].abs() + own_gain(a) * self.breakaway(a)).fold(0.0, f64::max);
        for _ in 0..MAX_CONTACT_ITERATIONS {
            if error <= 4.0 * f64::EPSILON * size {
                break;
            }
            let errors: Vec<f64> = pulses.iter().zip(&forces).map(|(x, f)| x.1.force - f).collect();
            let slopes: Vec<f64> = (0..n).map(|a| self.force_slope(a, length, v[a], &pulses[a])).collect();
            let newton_step = self.solve_coupled(length, &slopes, &errors);
            let newton_forces: Vec<f64> = forces.iter().zip(&newton_step).map(|(f, s)| f + s).collect();
            let newton_pulses: Vec<(f64, Pulse)> = (0..n).map(|a| body_pulse(a, &newton_forces)).collect();
            let newton_error = max_error(&newton_pulses, &newton_forces);
            if newton_error < 0.5 * error {
                (forces, *pulses, error) = (newton_forces, newton_pulses, newton_error);
                continue;
            }
            // Gauss–Seidel sweep over the bodies. It converges if each body affects itself more than it affects the
            // others.
            for a in 0..n {
                forces[a] = body_pulse(a, &forces).1.force;
            }
            *pulses = (0..n).map(|a| body_pulse(a, &forces)).collect();
            error = max_error(pulses, &forces);
        }
        let has_stribeck = self.laws.iter().any(|law| law.stribeck > 0.0);
        if !has_stribeck && error > MAX_FRICTION_ERROR_RATIO * size {
            // NaN counts as overflow, which is better than a wrong solution.
            pulses.iter_mut().for_each(|(_, pulse)| pulse.end = f64::NAN);
        }
    }

    /// Return the derivative of a body's friction force in an interval of a pulse with respect to its end velocity
    /// without friction. `velocity` is its velocity at the start. `solved_pulse` holds the end velocity and the pulse
    /// from [`FrictionProblem::solve`].
    #[must_use]
    pub fn force_slope(&self, body: usize, length: f64, velocity: f64, solved_pulse: &(f64, Pulse)) -> f64 {
        let unit = PulseDerivatives { start: 0.0, free: 1.0, gain: 0.0, law: [0.0; 3] };
        self.laws[body].slope(velocity, solved_pulse.0, length * self.own_gain(body), &solved_pulse.1, &unit).0
    }

    /// Return the solution x of (1 + `length` diag(slopes) (G − diag G)) x = `vector`. x holds the changes of the
    /// friction forces of coupled bodies. `vector` holds the changes that each force would have alone, and `slopes` the
    /// values of [`FrictionProblem::force_slope`].
    #[must_use]
    pub fn solve_coupled(&self, length: f64, slopes: &[f64], vector: &[f64]) -> Vec<f64> {
        let n = self.count();
        let mut matrix = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..n {
                matrix[a * n + b] = if a == b { 1.0 } else { length * slopes[a] * self.gains[a * n + b] };
            }
        }
        match small::inverse(&matrix, n) {
            Ok(inverse) => (0..n).map(|a| (0..n).map(|b| inverse[a * n + b] * vector[b]).sum()).collect(),
            // With a P-matrix, the inversion fails only if a value is NaN. The result is then NaN as well.
            Err(_) => vec![f64::NAN; n],
        }
    }
}

/// True if all principal minors of a row-major n × n matrix are positive. The test is recursive over the first pivot
/// and its Schur complement.
#[must_use]
pub fn is_p_matrix(matrix: &[f64], n: usize) -> bool {
    if n == 0 {
        return true;
    }
    let first = matrix[0];
    if first.is_nan() || first <= 0.0 {
        return false;
    }
    let submatrix: Vec<f64> = (1..n).flat_map(|i| (1..n).map(move |j| matrix[i * n + j])).collect();
    let schur_complement: Vec<f64> =
        (1..n).flat_map(|i| (1..n).map(move |j| matrix[i * n + j] - matrix[i * n] * matrix[j] / first)).collect();
    is_p_matrix(&submatrix, n - 1) && is_p_matrix(&schur_complement, n - 1)
}

//! The set-valued law φ ∈ F(V) sgn(V), V = L − g ∗ φ, of all bodies that may stick, pulse by pulse, and what moves with it.

use super::contact::Rubbing;
use super::convolution::{Heads, Online};
use super::law::{Moves, Phase, Pulse};

/// What a body that may stick did.
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    /// Mean of the friction over each pulse, in the unit of its D^α y, not beyond the most that it holds but for rounding.
    pub force: Vec<f64>,
    /// Velocity at the edges of the pulses, one more than there are pulses; exactly 0 at rest.
    pub edges: Vec<f64>,
    /// What happened in each pulse.
    pub phases: Vec<Phase>,
    /// Velocity at the end of each pulse if there were no friction of its own in it.
    free: Vec<f64>,
}

impl Trace {
    /// Whether it never left its rest.
    #[must_use]
    pub fn is_still(&self) -> bool {
        self.edges.iter().all(|v| *v == 0.0)
    }
}

/// A march over all pulses.
#[derive(Debug, Clone, PartialEq)]
pub struct March {
    /// Of each body that may stick.
    pub bodies: Vec<Trace>,
    rubbing: Rubbing,
}

/// Share of the largest velocity without friction that may be rounding: a force that equals friction moves nothing.
const ROUNDING: f64 = 1e-12;

impl March {
    /// Marches from velocities: `linear` is L of each body at the ends of the pulses, `responses` g, those of a body's
    /// velocity to forces on each.
    #[must_use]
    pub fn new(linear: &[Vec<f64>], responses: &[Vec<Heads>], rubbing: Rubbing, start: &[f64]) -> Self {
        let n = rubbing.count();
        let m = linear.first().map_or(0, Vec::len);
        let mut bodies: Vec<Trace> = (start.iter())
            .map(|&v| {
                let (force, phases, free) = (Vec::new(), Vec::with_capacity(m), Vec::with_capacity(m));
                let mut edges = Vec::with_capacity(m + 1);
                edges.push(v);
                Trace { force, edges, phases, free }
            })
            .collect();
        let rounding: Vec<f64> =
            linear.iter().map(|row| ROUNDING * row.iter().fold(0.0_f64, |a, v| a.max(v.abs()))).collect();
        let mut pasts: Vec<Vec<Online>> = responses.iter().map(|row| row.iter().map(Online::new).collect()).collect();
        let (mut v, mut forces) = (start.to_vec(), vec![0.0; n]);
        let (mut p, mut at) = (vec![0.0; n], Vec::with_capacity(n));
        for k in 0..m {
            for ((p, row), linear) in p.iter_mut().zip(&pasts).zip(linear) {
                *p = linear[k] - row.iter().map(Online::past).sum::<f64>();
            }
            rubbing.pulse(&v, &p, &rounding, &forces, &mut at);
            for (a, &(free, Pulse { force, end, phase })) in at.iter().enumerate() {
                pasts.iter_mut().for_each(|row| row[a].push(force));
                let body = &mut bodies[a];
                body.free.push(free);
                body.phases.push(phase);
                body.edges.push(end);
                (v[a], forces[a]) = (end, force);
            }
        }
        if let Some(row) = pasts.into_iter().next() {
            bodies.iter_mut().zip(row).for_each(|(body, past)| body.force = past.into_signal());
        }
        Self { bodies, rubbing }
    }

    /// The laws of the bodies and what moves what within a pulse.
    #[must_use]
    pub fn rubbing(&self) -> &Rubbing {
        &self.rubbing
    }

    /// How the frictions move with a parameter: `moved` is the derivative of L − g ∗ φ of each body at the ends of the
    /// pulses while φ stands, `first` that of its own g₀, `laws` those of its fc, fs and vs, `start` that of its velocity
    /// at the start. None where no friction moves.
    #[must_use]
    pub fn slope(
        &self,
        moved: &[Vec<f64>],
        responses: &[Vec<Heads>],
        first: &[f64],
        laws: &[[f64; 3]],
        start: &[f64],
    ) -> Option<Vec<Vec<f64>>> {
        let n = self.bodies.len();
        let m = moved.first().map_or(0, Vec::len);
        let mut pasts: Vec<Vec<Online>> = responses.iter().map(|row| row.iter().map(Online::new).collect()).collect();
        let mut dv = start.to_vec();
        let (mut v, mut at, mut moves) = (Vec::with_capacity(n), Vec::with_capacity(n), Vec::with_capacity(n));
        let mut slopes = Vec::with_capacity(n);
        let mut any = false;
        for k in 0..m {
            v.clear();
            at.clear();
            moves.clear();
            for (a, (body, moved)) in self.bodies.iter().zip(moved).enumerate() {
                v.push(body.edges[k]);
                let (force, end, phase) = (body.force[k], body.edges[k + 1], body.phases[k]);
                at.push((body.free[k], Pulse { force, end, phase }));
                let past: f64 = pasts[a].iter().map(Online::past).sum();
                let free = moved[k] + first[a] * force - past;
                moves.push(Moves { start: dv[a], free, first: first[a], law: laws[a] });
            }
            self.rubbing.slope(&v, &at, &moves, &mut slopes);
            for (a, &(force, end)) in slopes.iter().enumerate() {
                dv[a] = end;
                any |= force != 0.0;
                pasts.iter_mut().for_each(|row| row[a].push(force));
            }
        }
        let row = pasts.into_iter().next()?;
        any.then(|| row.into_iter().map(Online::into_signal).collect())
    }
}

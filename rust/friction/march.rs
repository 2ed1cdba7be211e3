//! The set-valued law φ ∈ F(V) sgn(V), V = L − g ∗ φ, pulse by pulse, and what moves with it.

use super::law::{Law, Moves, Phase, Pulse};
use super::online::{Heads, Online};

/// A march over all pulses.
#[derive(Debug, Clone, PartialEq)]
pub struct March {
    /// Mean of the friction over each pulse, not beyond the most that it holds but for rounding.
    pub force: Vec<f64>,
    /// Velocity at the edges of the pulses, one more than there are pulses; exactly 0 at rest.
    pub edges: Vec<f64>,
    /// What happened in each pulse.
    pub phases: Vec<Phase>,
    /// Velocity at the end of each pulse if there were no friction in it.
    free: Vec<f64>,
    law: Law,
    /// What a unit of force in a pulse takes from the velocity at its end.
    first: f64,
}

/// Share of the largest velocity without friction that may be rounding: a force that equals friction moves nothing.
const ROUNDING: f64 = 1e-12;

impl March {
    /// Marches from a velocity: `linear` is L at the ends of the pulses, `response` g, `first` its first number.
    #[must_use]
    pub fn new(linear: &[f64], response: &Heads, first: f64, law: Law, start: f64) -> Self {
        let m = linear.len();
        let mut march = Self {
            force: Vec::new(),
            edges: Vec::with_capacity(m + 1),
            phases: Vec::with_capacity(m),
            free: Vec::with_capacity(m),
            law,
            first,
        };
        march.edges.push(start);
        let rounding = ROUNDING * linear.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        let mut past = Online::new(response);
        let mut v = start;
        for &l in linear {
            let p = l - past.past();
            let Pulse { force, end, phase } = law.pulse(v, p, first, rounding);
            past.push(force);
            march.free.push(p);
            march.phases.push(phase);
            march.edges.push(end);
            v = end;
        }
        march.force = past.into_signal();
        march
    }

    /// How the friction moves with a parameter: `moved` is the derivative of L − g ∗ φ at the ends of the pulses while φ
    /// stands, `first` that of g₀, `law` those of fc, fs and vs, `start` that of the velocity at the start. None where no
    /// friction moves.
    #[must_use]
    pub fn slope(&self, moved: &[f64], response: &Heads, first: f64, law: [f64; 3], start: f64) -> Option<Vec<f64>> {
        let mut past = Online::new(response);
        let mut dv = start;
        let mut any = false;
        for (k, &w) in moved.iter().enumerate() {
            let (v, p, force) = (self.edges[k], self.free[k], self.force[k]);
            let at = Pulse { force, end: self.edges[k + 1], phase: self.phases[k] };
            let dp = w + first * force - past.past();
            let (df, dend) = self.law.slope(v, p, self.first, &at, &Moves { start: dv, free: dp, first, law });
            dv = dend;
            any |= df != 0.0;
            past.push(df);
        }
        any.then(|| past.into_signal())
    }
}

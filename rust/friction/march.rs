//! The set-valued law s ∈ sgn(V), V = L − f g ∗ s, pulse by pulse, and what moves with it.
//!
//! Within a pulse the velocity is taken as linear. One that reaches zero there stays if friction can hold the body, and
//! else turns at that instant, so that the mean of the sign over the pulse follows continuously from both ends.

use super::online::{Heads, Online};

/// What the body did in a pulse.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// It slid, the sign of its velocity standing.
    Slip,
    /// It was at rest at the end: it stayed so, or came to rest.
    Stick,
    /// It passed through rest to the other side.
    Turn,
}

/// A march over all pulses.
#[derive(Debug, Clone, PartialEq)]
pub struct March {
    /// Mean of the friction's sign over each pulse, within [−1, 1] but for rounding.
    pub sign: Vec<f64>,
    /// Velocity at the edges of the pulses, one more than there are pulses; exactly 0 at rest.
    pub edges: Vec<f64>,
    /// What happened in each pulse.
    pub phases: Vec<Phase>,
    /// Velocity at the end of each pulse if there were no friction in it.
    free: Vec<f64>,
    /// Most that friction in a pulse takes from the velocity at its end.
    brake: f64,
}

/// Share of the largest velocity without friction that may be rounding: a force that equals friction moves nothing.
const ROUNDING: f64 = 1e-12;

/// Mean sign and end velocity of a pulse that starts at v, would end at p without friction, which takes b at most and
/// holds what exceeds it by rounding.
#[must_use]
pub fn pulse(v: f64, p: f64, b: f64, rounding: f64) -> (f64, f64, Phase) {
    if v == 0.0 {
        if p.abs() <= b + rounding {
            return (if b > 0.0 { p / b } else { 0.0 }, 0.0, Phase::Stick);
        }
        return (p.signum(), p - b * p.signum(), Phase::Slip);
    }
    let side = v.signum();
    let end = p - b * side;
    if end * side >= 0.0 {
        return (side, end, Phase::Slip);
    }
    if (p - v).abs() <= b + rounding {
        return (if b > 0.0 { p / b } else { 0.0 }, 0.0, Phase::Stick);
    }
    let sign = side * (2.0 * v / (v - end) - 1.0);
    (sign, p - b * sign, Phase::Turn)
}

impl March {
    /// Marches from a velocity: `linear` is L at the ends of the pulses, `response` g, `strength` f, not negative.
    #[must_use]
    pub fn new(linear: &[f64], response: &Heads, first: f64, strength: f64, start: f64) -> Self {
        let m = linear.len();
        let mut march = Self {
            sign: Vec::new(),
            edges: Vec::with_capacity(m + 1),
            phases: Vec::with_capacity(m),
            free: Vec::with_capacity(m),
            brake: strength * first,
        };
        march.edges.push(start);
        let rounding = ROUNDING * linear.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        let mut past = Online::new(response);
        let mut v = start;
        for &l in linear {
            let p = l - strength * past.past();
            let (sign, end, phase) = pulse(v, p, march.brake, rounding);
            past.push(sign);
            march.free.push(p);
            march.phases.push(phase);
            march.edges.push(end);
            v = end;
        }
        march.sign = past.into_signal();
        march
    }

    /// How the signs move with a parameter: `moved` is the derivative of L − f g ∗ s at the ends of the pulses while s
    /// stands, `brake` that of f g₀, `start` that of the velocity at the start. None where no sign moves.
    #[must_use]
    pub fn slope(&self, moved: &[f64], response: &Heads, strength: f64, brake: f64, start: f64) -> Option<Vec<f64>> {
        let mut past = Online::new(response);
        let mut dv = start;
        let mut any = false;
        for (k, &w) in moved.iter().enumerate() {
            let (v, p, s, b) = (self.edges[k], self.free[k], self.sign[k], self.brake);
            let dp = w + brake * s - strength * past.past();
            let ds = match self.phases[k] {
                Phase::Slip => 0.0,
                Phase::Stick if b > 0.0 => (dp - s * brake) / b,
                Phase::Stick => 0.0,
                Phase::Turn => {
                    let side = v.signum();
                    let (end, dend) = (p - b * side, dp - brake * side);
                    2.0 * side * (v * dend - end * dv) / ((v - end) * (v - end))
                }
            };
            dv = if self.phases[k] == Phase::Stick { 0.0 } else { dp - brake * s - b * ds };
            any |= ds != 0.0;
            past.push(ds);
        }
        any.then(|| past.into_signal())
    }
}

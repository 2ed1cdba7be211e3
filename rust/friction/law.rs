//! What friction does to a body in one pulse: F(v) sgn v, F(v) = fc + fs exp(−(v/vs)²), set-valued at rest.
//!
//! Within a pulse the velocity is taken as linear between rests, and the friction of the pulse is its mean over it, in
//! closed form: the mean of the Gaussian is a difference of error functions. A velocity that reaches zero stays there if
//! friction can hold the body, and else turns at that instant, so that the mean follows continuously from both ends.
//!
//! F falls with speed, so the equation of the
//! end velocity may have several roots where the pulse is long beside what F takes to fall; taken is the one that the body
//! meets first on its way from where it starts.

use core::f64::consts::PI;

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

/// Coulomb friction and what is more of it near rest (Stribeck).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Law {
    /// fc, not negative, in the unit of D^α y: what is left at speed.
    pub coulomb: f64,
    /// fs, not negative: what comes on top near rest.
    pub stribeck: f64,
    /// vs, positive: the speed at which it has fallen to fs/e.
    pub speed: f64,
}

/// A pulse with friction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pulse {
    /// Mean of the friction over it, positive against a positive velocity.
    pub force: f64,
    /// Velocity at its end; exactly 0 at rest.
    pub end: f64,
    /// What the body did.
    pub phase: Phase,
}

/// How what a pulse is made of moves with a parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moves {
    /// Velocity at its start.
    pub start: f64,
    /// Velocity at its end if there were no friction in it.
    pub free: f64,
    /// What a unit of force in it does to the velocity at its end.
    pub first: f64,
    /// fc, fs and vs.
    pub law: [f64; 3],
}

/// The mean of F over the speeds between two, and its derivatives.
struct Mean {
    value: f64,
    /// With respect to the two speeds.
    from: f64,
    to: f64,
    /// With respect to fc, fs and vs.
    law: [f64; 3],
}

/// Speeds closer than this share of vs: a difference of error functions would lose digits, five points are exact.
const NEAR: f64 = 0.2;
/// Points and weights of Gauss and Legendre on [0, 1].
const POINTS: [(f64, f64); 5] = [
    (0.046_910_077_030_668, 0.118_463_442_528_094_54),
    (0.230_765_344_947_158_45, 0.239_314_335_249_683_24),
    (0.5, 0.284_444_444_444_444_44),
    (0.769_234_655_052_841_6, 0.239_314_335_249_683_24),
    (0.953_089_922_969_332, 0.118_463_442_528_094_54),
];
/// Most sweeps to the end velocity; each gains a digit or more unless two roots are about to meet.
const SWEEPS: usize = 500;

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

impl Law {
    /// Friction that is the same at every speed.
    #[must_use]
    pub const fn coulomb(coulomb: f64) -> Self {
        Self { coulomb, stribeck: 0.0, speed: 1.0 }
    }

    /// The most that friction holds.
    #[must_use]
    pub fn breakaway(&self) -> f64 {
        self.coulomb + self.stribeck
    }

    /// What is left of the Stribeck term between two speeds that are not negative, on the average of a linear velocity.
    fn share(&self, from: f64, to: f64) -> f64 {
        let (x, d) = (from / self.speed, (to - from) / self.speed);
        if d.abs() < NEAR {
            return POINTS.iter().map(|(u, w)| w * libm::exp(-(x + u * d).powi(2))).sum();
        }
        0.5 * libm::sqrt(PI) * (libm::erf(x + d) - libm::erf(x)) / d
    }

    fn mean(&self, from: f64, to: f64) -> f64 {
        self.coulomb + self.stribeck * self.share(from, to)
    }

    fn mean_with_slopes(&self, from: f64, to: f64) -> Mean {
        let (x, d) = (from / self.speed, (to - from) / self.speed);
        let share = self.share(from, to);
        let gauss = |z: f64| libm::exp(-z * z);
        let (by_from, by_to) = if d.abs() < NEAR {
            let sloped = |weight: fn(f64) -> f64| -> f64 {
                POINTS.iter().map(|(u, w)| -2.0 * w * weight(*u) * (x + u * d) * gauss(x + u * d)).sum()
            };
            (sloped(|u| 1.0 - u), sloped(|u| u))
        } else {
            ((share - gauss(x)) / d, (gauss(x + d) - share) / d)
        };
        // Of a function of x and x + d alone.
        let by_speed = -(x * by_from + (x + d) * by_to) / self.speed;
        let s = self.stribeck;
        Mean {
            value: self.coulomb + s * share,
            from: s * by_from / self.speed,
            to: s * by_to / self.speed,
            law: [1.0, share, s * by_speed],
        }
    }

    /// Where a body that slides at a speed v ends a pulse in which the others would bring it to p, a unit of force taking
    /// g; none if it comes to rest before.
    ///
    /// The mean falls as the end rises, so each sweep from v goes on in the direction of the first and never passes the
    /// first root.
    fn slide(&self, v: f64, p: f64, g: f64) -> Option<f64> {
        let rounding = 4.0 * f64::EPSILON * (v + p.abs());
        let mut end = v;
        for _ in 0..SWEEPS {
            let next = p - g * self.mean(v, end);
            if next < 0.0 {
                return None;
            }
            let gone = (next - end).abs();
            end = next;
            if gone <= rounding {
                break;
            }
        }
        Some(end)
    }

    /// A pulse that starts at v and would end at p without friction, a unit of force in it taking g from its end; what
    /// exceeds the friction by rounding is held.
    #[must_use]
    pub fn pulse(&self, v: f64, p: f64, g: f64, rounding: f64) -> Pulse {
        if self.stribeck == 0.0 {
            let (sign, end, phase) = pulse(v, p, self.coulomb * g, rounding);
            return Pulse { force: self.coulomb * sign, end, phase };
        }
        let held = g * self.breakaway() + rounding;
        let stuck = Pulse { force: if g > 0.0 { p / g } else { 0.0 }, end: 0.0, phase: Phase::Stick };
        if v == 0.0 && p.abs() <= held {
            return stuck;
        }
        let side = if v == 0.0 { p.signum() } else { v.signum() };
        if let Some(end) = self.slide(side * v, side * p, g) {
            let force = side * self.mean(side * v, end);
            return Pulse { force, end: p - g * force, phase: Phase::Slip };
        }
        if (p - v).abs() <= held {
            return stuck;
        }
        let (speed, push) = (side * v, side * (v - p));
        let before = self.mean(0.0, speed);
        let until = speed / (g * before + push);
        let left = 1.0 - until;
        // From rest, what is left of the push against what is left of the friction.
        let back = self.slide(0.0, left * push, left * g).unwrap_or(0.0);
        let force = side * (until * before - left * self.mean(0.0, back));
        Pulse { force, end: -side * back, phase: Phase::Turn }
    }

    /// How the friction and the end velocity of a pulse move.
    #[must_use]
    pub fn slope(&self, v: f64, p: f64, g: f64, at: &Pulse, moves: &Moves) -> (f64, f64) {
        let of = |mean: &Mean| mean.law.iter().zip(&moves.law).map(|(a, b)| a * b).sum::<f64>();
        match at.phase {
            Phase::Stick if g > 0.0 && self.breakaway() > 0.0 => ((moves.free - at.force * moves.first) / g, 0.0),
            Phase::Stick => (0.0, 0.0),
            Phase::Slip => {
                let side = if v == 0.0 { at.end.signum() } else { v.signum() };
                let mean = self.mean_with_slopes(side * v, (side * at.end).max(0.0));
                let by_law = of(&mean) + mean.from * side * moves.start;
                let end = (side * (moves.free - at.force * moves.first) - g * by_law) / (1.0 + g * mean.to);
                (side * (by_law + mean.to * end), side * end)
            }
            Phase::Turn => {
                let side = v.signum();
                let (speed, push) = (side * v, side * (v - p));
                let (speed_moves, push_moves) = (side * moves.start, side * (moves.start - moves.free));
                let before = self.mean_with_slopes(0.0, speed);
                let before_moves = of(&before) + before.to * speed_moves;
                let whole = g * before.value + push;
                let until = speed / whole;
                let whole_moves = moves.first * before.value + g * before_moves + push_moves;
                let until_moves = (speed_moves - until * whole_moves) / whole;
                let left = 1.0 - until;
                let after = self.mean_with_slopes(0.0, at.end.abs());
                let by_law = of(&after);
                let back = (left * (push_moves - moves.first * after.value - g * by_law)
                    - until_moves * (push - g * after.value))
                    / (1.0 + left * g * after.to);
                let after_moves = by_law + after.to * back;
                let force = until_moves * (before.value + after.value) + until * before_moves - left * after_moves;
                (side * force, -side * back)
            }
        }
    }
}

//! Stability of the homogeneous part of an equation.

use std::f64::consts::PI;

/// Ratio of the dominant term to the sum of all others, in magnitude, at the ends of the frequency range.
const DOMINANCE_RATIO: f64 = 1e3;
/// Maximum step in ln ω.
const MAX_LOG_FREQUENCY_STEP: f64 = 0.25;
/// Minimum step in ln ω. A pole counts as on the imaginary axis if its relative distance from the axis is smaller.
const MIN_LOG_FREQUENCY_STEP: f64 = 1e-12;
/// Maximum change of the angle of s^α − Σ c s^ν at s = jω between two frequencies ω \[rad\].
const MAX_ANGLE_STEP_RAD: f64 = 0.5;
/// Difference below which two exponents of s are merged. Powers of s whose exponents differ by less are distinguishable
/// only above ω = e^1000.
const EXPONENT_TOLERANCE: f64 = 1e-3;
/// Number of computed zeros in the right half-plane above which the equation counts as unstable.
///
/// A zero on the imaginary axis counts 1/2.
const MIN_UNSTABLE_ZERO_COUNT: f64 = 0.25;

/// Return true if an equation of order α with given autoregressive terms is unstable.
///
/// `autoregressive_terms` contains the coefficient c and the order ν of each term. The equation is unstable if
/// s^α − Σ c s^ν has a zero in the right half-plane, or on the imaginary axis except the origin. Zeros are counted by
/// the argument principle on the principal sheet. The angle of the function at s = jω, for ω from 0 to ∞, changes by
/// (p_high − p_low − 2Z)·π/2. p_high and p_low are the largest and the smallest exponent, and Z is the number of zeros
/// in the right half-plane.
///
/// ```
/// use ftlm::estimation::output_error::stability::is_unstable;
/// // D²y = −4 y − 0.1 Dy is stable; with negative damping it is unstable.
/// assert!(!is_unstable(2.0, &[(-4.0, 0.0), (-0.1, 1.0)]));
/// assert!(is_unstable(2.0, &[(-4.0, 0.0), (0.1, 1.0)]));
/// ```
#[must_use]
pub fn is_unstable(alpha: f64, autoregressive_terms: &[(f64, f64)]) -> bool {
    let powers = merge_close_powers(
        std::iter::once((1.0, alpha)).chain(autoregressive_terms.iter().map(|&(c, nu)| (-c, nu))).collect(),
    );
    let by_power = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
    let (Some(&low), Some(&high)) = (powers.iter().min_by(by_power), powers.iter().max_by(by_power)) else {
        return false;
    };
    if high.1 <= low.1 {
        return false;
    }
    let log_ratio = (DOMINANCE_RATIO * powers.len() as f64).ln();
    // ln ω at which another power is smaller than the dominant one by the dominance ratio.
    let crossing = |end: (f64, f64), &(c, p): &(f64, f64)| (end.0.abs().ln() - c.abs().ln() - log_ratio) / (p - end.1);
    let crossings =
        |end: (f64, f64)| powers.iter().filter(move |(_, p)| *p != end.1).map(move |power| crossing(end, power));
    let (first, last) =
        (crossings(low).fold(f64::INFINITY, f64::min), crossings(high).fold(f64::NEG_INFINITY, f64::max));
    let steps = ((last - first) / MAX_LOG_FREQUENCY_STEP).ceil().clamp(1.0, 1e6);
    let mut angle = 0.0;
    let mut start = (first, curve_point(&powers, first));
    for k in 1..=steps as usize {
        let next = first + (last - first) * k as f64 / steps;
        let next_point = (next, curve_point(&powers, next));
        angle += angle_change(&powers, start, next_point);
        start = next_point;
    }
    0.5 * (high.1 - low.1) - angle / PI > MIN_UNSTABLE_ZERO_COUNT
}

/// Merge powers (coefficient, exponent) whose exponents are closer than [`EXPONENT_TOLERANCE`].
///
/// Such powers cannot be distinguished at any measurable frequency.
fn merge_close_powers(mut powers: Vec<(f64, f64)>) -> Vec<(f64, f64)> {
    powers.sort_by(|a, b| a.1.total_cmp(&b.1));
    let mut out: Vec<(f64, f64)> = Vec::with_capacity(powers.len());
    for (c, p) in powers {
        match out.last_mut() {
            Some(last) if p - last.1 < EXPONENT_TOLERANCE => last.0 += c,
            _ => out.push((c, p)),
        }
    }
    out.retain(|(c, _)| *c != 0.0 && c.is_finite());
    out
}

/// Point of the curve Σ c (jω)^p at ω, relative to its largest term, as real and imaginary part.
fn curve_point(powers: &[(f64, f64)], log_omega: f64) -> (f64, f64) {
    let logs = || powers.iter().map(|(c, p)| c.abs().ln() + p * log_omega);
    let largest = logs().fold(f64::NEG_INFINITY, f64::max);
    powers.iter().zip(logs()).fold((0.0, 0.0), |(re, im), ((c, p), log)| {
        let magnitude = (log - largest).exp() * c.signum();
        (re + magnitude * (0.5 * PI * p).cos(), im + magnitude * (0.5 * PI * p).sin())
    })
}

/// Change of the angle of the curve between two frequencies \[rad\], by bisection; −∞ if the curve passes through 0.
fn angle_change(powers: &[(f64, f64)], from: (f64, (f64, f64)), to: (f64, (f64, f64))) -> f64 {
    let ((a, (x, y)), (b, (u, v))) = (from, to);
    let angle = (x * v - y * u).atan2(x * u + y * v);
    let mid_frequency = 0.5 * (a + b);
    if angle.abs() <= MAX_ANGLE_STEP_RAD {
        return angle;
    }
    // At extreme frequencies the spacing of floating-point numbers exceeds the smallest step, or the curve is NaN.
    if b - a < MIN_LOG_FREQUENCY_STEP || !(mid_frequency > a && mid_frequency < b) || angle.is_nan() {
        // The curve passes through 0, so a zero lies on the axis: return a value that counts as unstable.
        return f64::NEG_INFINITY;
    }
    let midpoint = (mid_frequency, curve_point(powers, mid_frequency));
    angle_change(powers, from, midpoint) + angle_change(powers, midpoint, to)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn single_power_has_known_poles() {
        assert!(!is_unstable(2.0, &[]) && !is_unstable(2.0, &[(0.0, 1.0)]));
        // s^α = c has a root in the right half-plane for c > 0, and for c < 0 only if α is above 2.
        assert!(is_unstable(0.5, &[(2.0, 0.0)]) && is_unstable(1.7, &[(1e-9, 0.3)]));
        assert!(
            !is_unstable(0.5, &[(-2.0, 0.0)])
                && !is_unstable(1.999, &[(-2.0, 0.0)])
                && is_unstable(2.1, &[(-2.0, 0.0)])
        );
    }

    #[test]
    fn commensurate_orders_match_matignon() {
        // s^1.2 − c s^0.6 + 1 is unstable if a root in s^0.6 has an argument below 0.3π in magnitude.
        for k in 0..200 {
            let c = -2.5 + 0.025 * f64::from(k);
            let discriminant = 0.25 * c * c - 1.0;
            let angle = if discriminant < 0.0 {
                (-discriminant).sqrt().atan2(0.5 * c)
            } else if c > 0.0 {
                0.0
            } else {
                PI
            };
            if (angle - 0.3 * PI).abs() > 1e-3 {
                assert_eq!(is_unstable(1.2, &[(c, 0.6), (-1.0, 0.0)]), angle < 0.3 * PI, "c = {c}");
            }
        }
    }

    #[test]
    fn extreme_values_terminate() {
        // Regression test of infinite recursion; only termination is checked.
        for (alpha, terms) in [
            (1e-9, [(-0.954, 0.0), (5e-324, 0.5)]),
            (0.0, [(1e308, 0.0), (-0.468, 0.5)]),
            (1e308, [(1.0, 0.0), (-1.0, -1e308)]),
            (1.6, [(-5e-324, 0.0), (1e308, 0.5)]),
        ] {
            std::hint::black_box(is_unstable(alpha, &terms));
        }
    }

    #[test]
    fn nearly_equal_powers_terminate() {
        // Example from a fit of a real link: two autoregressive terms with nearly the highest order.
        for c in [1.0, 0.999_999, -1.0, 1e-9, 1e9] {
            for gap in [1e-15, 1e-12, 1e-9, 1e-6] {
                // (1 − c) s² + c can have zeros on the axis; only termination is checked.
                std::hint::black_box(is_unstable(2.0, &[(c, 2.0 - gap), (-c, gap)]));
                // s² − 1.
                assert!(is_unstable(2.0, &[(c, 2.0 - gap), (-c, 2.0 - 2.0 * gap), (1.0, 0.0)]), "{c} {gap}");
            }
            for gap in [1e-3, 1.1e-3, 2e-3, 1e-2] {
                assert!(!is_unstable(2.0, &[(-c.abs(), 2.0 - gap), (-c.abs(), 1.0), (-1.0, 0.0)]), "{c} {gap}");
            }
        }
        assert!(!is_unstable(2.0, &[(-2.0, 1.0), (-2.0, 1.0 + 1e-12), (-4.0, 0.0)]));
        assert!(is_unstable(2.0, &[(2.0, 1.0), (2.0, 1.0 + 1e-12), (-4.0, 0.0)]));
    }

    #[test]
    fn mode_on_imaginary_axis_is_unstable() {
        assert!(is_unstable(2.0, &[(-9.0, 0.0)]));
        assert!(!is_unstable(2.0, &[(-9.0, 0.0), (-1e-6, 1.0)]) && is_unstable(2.0, &[(-9.0, 0.0), (1e-6, 1.0)]));
    }
}

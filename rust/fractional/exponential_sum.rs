//! Approximation of the kernel of the fractional integral I^q by a sum of decaying exponentials. The history of a
//! signal then needs bounded memory.
//!
//! The kernel is t^{q−1}/Γ(q) = sin(πq)/π ∫ e^{x(1−q)} e^{−t e^x} dx over all real x. For such integrands the
//! trapezoidal rule in x with spacing Δx has an error of about e^{−π²/Δx}. A few dozen decay rates e^x therefore
//! represent the whole history at any requested accuracy, and each rate needs one state per signal. Nodes below the
//! lowest rate form a geometric series. Four rates near zero replace these nodes and match the first four moments of
//! the series. The rates do not depend on q, so the integrals of all orders of one signal use the same states.

use crate::error::{check_finite, check_overflow, Error, Result};

/// Product of the lowest decay rate of the quadrature rule and the longest lag. Slower exponentials are replaced by
/// four moments of the signal, with an error of (1e−3)⁴/4! < 1e−13.
const LOWEST_RATE_TIMES_LAG: f64 = 1e-3;
/// Decay rates that replace the quadrature nodes below the lowest rate of the quadrature rule, relative to this rate.
const TAIL_RATE_RATIOS: [f64; 4] = [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0];

/// Decay rates of exponential sums that approximate t^{q−1}/Γ(q) for all 0 < q ≤ 1, at time lags t between two limits.
#[derive(Debug, Clone)]
pub struct Rates {
    /// Decay rates \[1/s\], ascending.
    rates: Vec<f64>,
    /// Spacing of the logarithms of the rates of the quadrature rule.
    spacing: f64,
    /// Lowest rate of the quadrature rule \[1/s\].
    lowest: f64,
}

impl Rates {
    /// Return the rates for time lags in `[shortest, longest]` \[s\] at a relative accuracy of about `tolerance`, which
    /// is 1e−14 at best.
    ///
    /// The number of rates grows with ln(longest/shortest)·ln(1/tolerance). It is 70 for a ratio of 10⁶ at 1e−9.
    /// # Errors
    /// [`Error::OutOfRange`] if the lags do not increase or the tolerance is outside (1e−15, 0.1).
    pub fn new(shortest: f64, longest: f64, tolerance: f64) -> Result<Self> {
        let out_of_range = |name: &str, value: f64, range: &str| Error::OutOfRange {
            name: name.into(),
            value,
            range: range.into(),
            remedy: "give lags in seconds and a relative accuracy".into(),
        };
        if !(shortest > 0.0 && shortest.is_finite()) {
            return Err(out_of_range("shortest lag", shortest, "(0, ∞)"));
        }
        if !(longest > shortest && longest.is_finite()) {
            return Err(out_of_range("longest lag", longest, "(shortest lag, ∞)"));
        }
        if !(tolerance > 1e-15 && tolerance < 0.1) {
            return Err(out_of_range("tolerance", tolerance, "(1e-15, 0.1)"));
        }
        let log_accuracy = -libm::log(tolerance);
        // The growth of Γ off the real axis costs slightly more than e^{−π²/Δx}.
        let spacing = std::f64::consts::PI * std::f64::consts::PI / (log_accuracy + 4.0);
        let lowest = LOWEST_RATE_TIMES_LAG / longest;
        // Above this rate the remainder at lag `shortest` is below the tolerance, even relative to t^{q−1} at q near 1.
        let highest = (log_accuracy + 8.0) / shortest;
        if !(highest / lowest).is_finite() {
            return Err(out_of_range("longest lag", longest, "a range that floating point holds"));
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let count = (libm::log(highest / lowest) / spacing).ceil() as usize + 1;
        let mut rates: Vec<f64> = TAIL_RATE_RATIOS.iter().map(|f| f * lowest).collect();
        #[allow(clippy::cast_precision_loss)]
        rates.extend((1..=count).map(|j| lowest * libm::exp(spacing * j as f64)));
        Ok(Self { rates, spacing, lowest })
    }

    /// Return the decay rates \[1/s\] in ascending order. The first is zero.
    #[must_use]
    pub fn rates(&self) -> &[f64] {
        &self.rates
    }

    /// Return the weights w of t^{q−1}/Γ(q) ≈ Σ w_j e^{−rate_j t} for 0 < q ≤ 1, one per rate. For q = 1 only the zero
    /// rate has a nonzero weight, and the sum is exact.
    #[must_use]
    pub fn weights(&self, q: f64) -> Vec<f64> {
        let mut weights = vec![0.0; self.rates.len()];
        if q == 1.0 {
            weights[0] = 1.0;
            return weights;
        }
        let scale = libm::sin(std::f64::consts::PI * q) / std::f64::consts::PI * self.spacing;
        for (w, rate) in weights.iter_mut().zip(&self.rates).skip(TAIL_RATE_RATIOS.len()) {
            *w = scale * libm::pow(*rate, 1.0 - q);
        }
        // Moments Σ_{j≥0} w_j (rate_j/lowest)^k of the nodes of the rule at and below the lowest rate.
        let lowest_weight = scale * libm::pow(self.lowest, 1.0 - q);
        let mut moments = [0.0; 4];
        let mut power = 1.0 - q;
        for moment in &mut moments {
            *moment = -lowest_weight / libm::expm1(-power * self.spacing);
            power += 1.0;
        }
        for (i, weight) in weights.iter_mut().take(TAIL_RATE_RATIOS.len()).enumerate() {
            // Coefficients of the Lagrange polynomial of this node.
            let mut polynomial = [1.0, 0.0, 0.0, 0.0];
            let mut degree = 0;
            for (k, node) in TAIL_RATE_RATIOS.iter().enumerate() {
                if k != i {
                    let gap = TAIL_RATE_RATIOS[i] - node;
                    for d in (0..=degree).rev() {
                        polynomial[d + 1] += polynomial[d] / gap;
                        polynomial[d] *= -node / gap;
                    }
                    degree += 1;
                }
            }
            *weight = polynomial.iter().zip(&moments).map(|(p, m)| p * m).sum();
        }
        weights
    }
}

/// Return three weights for an exponential decay over one sampling interval, with x = rate·step. The first is e^{−x}.
/// The others are the weights of the first and the last value of the interval in ∫₀¹ e^{−x(1−u)} (first·(1−u) + last·u)
/// du.
#[must_use]
pub fn decay(x: f64) -> (f64, f64, f64) {
    let factor = libm::exp(-x);
    if x < 0.1 {
        // Series of the divided differences. The closed forms would cancel to x².
        let (mut first, mut last, mut term) = (0.0, 0.0, 1.0);
        for k in 0..12 {
            let n = f64::from(k);
            // ∫ (1−u)^k u du = 1/((k+1)(k+2)), ∫ (1−u)^{k+1} du = 1/(k+2).
            last += term / ((n + 1.0) * (n + 2.0));
            first += term / (n + 2.0);
            term *= -x / (n + 1.0);
        }
        return (factor, first, last);
    }
    let square = x * x;
    (factor, (1.0 - factor * (1.0 + x)) / square, (x - 1.0 + factor) / square)
}

/// Return the fractional integral I^q of a signal that is linear between samples, computed recursively with a sum of
/// exponentials. The arguments are the samples `x`, the order q, the sampling interval `step` \[s\] and the relative
/// accuracy `tolerance`. The result is one value per sample, and the number of states.
///
/// The cost is O(samples · rates).
///
/// # Errors
/// [`Error::OutOfRange`] for an order outside (0, 1], and for a step or a tolerance out of range ([`Rates::new`]).
/// [`Error::NotFinite`] for a sample that is not finite. Also an error for an integral that overflows.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// // I^1 of t is t²/2.
/// let ramp: Vec<f64> = (0..=100).map(|k| 0.01 * f64::from(k)).collect();
/// let (integral, _) = ftlm::fractional::exponential_sum::integral_by_memory(&ramp, 1.0, 0.01, 1e-9)?;
/// assert!((integral[100] - 0.5).abs() < 1e-9);
/// # Ok(())
/// # }
/// ```
pub fn integral_by_memory(x: &[f64], order: f64, step: f64, tolerance: f64) -> Result<(Vec<f64>, usize)> {
    check_finite("samples", x)?;
    if !(order > 0.0 && order <= 1.0) {
        let (range, remedy) = ("(0, 1]".into(), "integrate integer orders separately".into());
        return Err(Error::OutOfRange { name: "order".into(), value: order, range, remedy });
    }
    #[allow(clippy::cast_precision_loss)]
    let rates = Rates::new(step, step * (x.len() + 1) as f64, tolerance)?;
    let weights = rates.weights(order);
    let scale = libm::pow(step, order) / libm::tgamma(order + 2.0);
    let decays: Vec<_> = rates.rates().iter().map(|s| decay(s * step)).collect();
    let mut history = vec![0.0; weights.len()];
    let mut out = vec![0.0; x.len()];
    for n in 1..x.len() {
        let mut value = scale * (x[n] + order * x[n - 1]);
        for ((z, w), (factor, first, last)) in history.iter_mut().zip(&weights).zip(&decays) {
            value += w * factor * *z;
            *z = *z * factor + step * (first * x[n - 1] + last * x[n]);
        }
        out[n] = value;
    }
    check_overflow(&out, step)?;
    Ok((out, history.len()))
}

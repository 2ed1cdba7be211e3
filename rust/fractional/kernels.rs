//! Kernels of the fractional integral I^η: block-pulse kernel, its derivative with respect to η, Grünwald–Letnikov
//! weights, and kernels of improper terms.
//!
//! A term is improper if its order exceeds the order of its equation. The equation D^α y = c D^ν s + … with ν > α is
//! integrated by its highest order ν: I^{ν−α} y = c s + …. Division by the kernel of I^{ν−α} gives y = c D^{ν−α} s + …,
//! where the kernel of D^{ν−α} is the reciprocal of the kernel of I^{ν−α}. All terms then have the same form, with an
//! error of second order in the step. D^q I^q is the identity up to rounding.

use crate::error::{Error, Result};
use crate::fractional::integer_powers::{integer_logarithms, integer_powers, odd_powers};
use crate::series::{multiply, reciprocal};

/// Maximum order of an integral and of an equation. It suffices for five oscillatory modes.
///
/// Kernels are exact to a few ε up to this order. Rounding errors of a division grow like (ωT)^α/Γ(α+1) with the
/// frequency ω of a mode, the record length T and the order α. Long records of many modes therefore need lower orders.
pub const MAX_ORDER: f64 = 10.0;

/// Minimum order of an input in an equation. A negative order −3 is a threefold integration.
pub const MIN_INPUT_ORDER: f64 = -3.0;

/// Distance \[pulses\] below which the even binomial sum of the kernel converges slowly and needs [`NEAR_SUM_TERMS`]
/// terms.
const FAR_DISTANCE_PULSES: usize = 8;
/// Number of terms of the binomial sum of the kernel for distances of 2 to 7 pulses. At distance 2, the omitted terms,
/// 4^−25, are below the rounding error.
const NEAR_SUM_TERMS: usize = 25;
/// Number of terms of the binomial sum of the kernel from a distance of 8 pulses on. The omitted terms, 64^−8, are
/// below the rounding error.
const FAR_SUM_TERMS: usize = 8;

/// Return the block-pulse kernel of I^η, which is the first row of the matrix F^η: `h^η/Γ(η+2)·v_n`, n = 1 … m, eq.
/// (32) of the paper. `step` is the pulse length h \[s\].
///
/// In the paper, `v_n` is a second difference of n^{η+1}. It suffers from cancellation, with a relative error of 2e−3
/// at n = 2^20 for η = 0.15. Here it is an even binomial sum, exact to a few ε for every n. η = 0 gives the identity.
///
/// O(m).
///
/// ```
/// // I^1 of a pulse: half of it within itself, all of it in every later one.
/// let kernel = ftlm::fractional::kernels::block_pulse_kernel(1.0, 3, 0.1);
/// assert!(kernel.iter().zip([0.05, 0.1, 0.1]).all(|(v, truth)| (v - truth).abs() < 1e-15));
/// ```
#[must_use]
pub fn block_pulse_kernel(eta: f64, m: usize, step: f64) -> Vec<f64> {
    let scale = libm::pow(step, eta) / libm::tgamma(eta + 2.0);
    let differences = SecondDifferences::new(eta);
    if m < MIN_SIEVE_TERMS {
        return (1..=m).map(|n| scale * differences.value(n)).collect();
    }
    let powers = integer_powers(eta + 1.0, m);
    let head = (1..=LONG_SUM_TERMS).map(|n| differences.near_value(n, powers[n - 1]));
    let tail = powers.iter().enumerate().skip(LONG_SUM_TERMS).map(|(c, &power)| differences.far_value(c, power));
    head.chain(tail).map(|v| scale * v).collect()
}

/// Return the derivative of [`block_pulse_kernel`] with respect to η.
///
/// It follows from the logarithmic derivative of `h^η/Γ(η+2)`, which is ln h − ψ(η+2), and from the term-by-term
/// derivative of the binomial sum.
#[must_use]
pub fn block_pulse_kernel_derivative(eta: f64, m: usize, step: f64) -> Vec<f64> {
    kernel_with_derivative(eta, m, step).1
}

/// Return [`block_pulse_kernel`] and its derivative with respect to η, at little more than the cost of one.
#[must_use]
pub fn kernel_with_derivative(eta: f64, m: usize, step: f64) -> (Vec<f64>, Vec<f64>) {
    let scale = libm::pow(step, eta) / libm::tgamma(eta + 2.0);
    let slope = libm::log(step) - digamma(eta + 2.0);
    let differences = SecondDifferences::new(eta);
    if m >= MIN_SIEVE_TERMS {
        let powers = integer_powers(eta + 1.0, m);
        let logarithms = integer_logarithms(m);
        let (mut kernel, mut slopes) = (Vec::with_capacity(m), Vec::with_capacity(m));
        for (c, (&power, &logarithm)) in powers.iter().zip(logarithms.iter()).enumerate() {
            let (v, dv) = if c < LONG_SUM_TERMS {
                differences.near_value_and_slope(c + 1, power, logarithm)
            } else {
                differences.far_value_and_slope(c, power, logarithm)
            };
            kernel.push(scale * v);
            slopes.push(scale * (v * slope + dv));
        }
        return (kernel, slopes);
    }
    (1..=m)
        .map(|n| {
            let (v, dv) = differences.value_and_slope(n);
            (scale * v, scale * (v * slope + dv))
        })
        .unzip()
}

/// Return `v_n = n^{η+1} − 2(n−1)^{η+1} + (n−2)^{η+1}` (v₁ = 1) and its derivative with respect to η, both exact to a
/// few ε.
#[must_use]
pub fn second_difference(eta: f64, n: usize) -> (f64, f64) {
    SecondDifferences::new(eta).value_and_slope(n)
}

/// Even binomial coefficients C(η+1, 2k), k = 1 … K, and their derivatives with respect to η. They give the second
/// differences `v_n` of n^{η+1} for all n ([`second_difference`]).
pub(crate) struct SecondDifferences {
    eta: f64,
    /// Binomial coefficients C(η+1, 2k), k = 1 … K, for the order of integration η.
    coefficients: [f64; NEAR_SUM_TERMS],
    /// Derivatives of the binomial coefficients with respect to the order of integration.
    slopes: [f64; NEAR_SUM_TERMS],
}

impl SecondDifferences {
    /// Compute the coefficients for the order of integration `eta`.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn new(eta: f64) -> Self {
        let (mut coefficients, mut slopes) = ([0.0; NEAR_SUM_TERMS], [0.0; NEAR_SUM_TERMS]);
        let (mut c, mut dc) = (1.0, 0.0);
        for (k, (coefficient, slope)) in coefficients.iter_mut().zip(&mut slopes).enumerate() {
            for j in [2 * k, 2 * k + 1] {
                // The factor is η + 1 − j, but exactly η at j = 1. For small η, the rounding error of η + 1 would
                // dominate the error of the factor.
                let factor = if j == 0 { eta + 1.0 } else { eta - (j as f64 - 1.0) };
                let divisor = (j + 1) as f64;
                dc = (dc * factor + c) / divisor;
                c = c * factor / divisor;
            }
            (*coefficient, *slope) = (c, dc);
        }
        Self { eta, coefficients, slopes }
    }

    /// Return the sum Σ_k a_k x^k, k ≥ 1, with a = `coefficients` and x = `inverse_square` = center^{−2}. Only terms
    /// above the rounding error are added, the smallest first.
    fn sum(coefficients: &[f64; NEAR_SUM_TERMS], center: usize, inverse_square: f64) -> f64 {
        let terms = if center < FAR_DISTANCE_PULSES { NEAR_SUM_TERMS } else { FAR_SUM_TERMS };
        coefficients[..terms].iter().rev().fold(0.0, |sum, &c| (sum + c) * inverse_square)
    }

    /// Return the second difference `v_n` of n^{η+1} ([`second_difference`]).
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn value(&self, n: usize) -> f64 {
        self.near_value(n, if n > 2 { libm::pow((n - 1) as f64, self.eta + 1.0) } else { 1.0 })
    }

    /// Return the second difference `v_n` of n^{η+1} ([`second_difference`]) and its derivative with respect to η.
    #[allow(clippy::cast_precision_loss)]
    fn value_and_slope(&self, n: usize) -> (f64, f64) {
        let center = n.saturating_sub(1) as f64;
        let (power, logarithm) =
            if n > 2 { (libm::pow(center, self.eta + 1.0), libm::log(center)) } else { (1.0, 0.0) };
        self.near_value_and_slope(n, power, logarithm)
    }

    /// Return the second difference `v_n` of n^{η+1} ([`second_difference`]). `power` is (n−1)^{η+1}.
    #[allow(clippy::cast_precision_loss)]
    fn near_value(&self, n: usize, power: f64) -> f64 {
        match n {
            0 => 0.0,
            1 => 1.0,
            2 => 2.0 * libm::expm1(self.eta * std::f64::consts::LN_2),
            _ => {
                let center = (n - 1) as f64;
                2.0 * power * Self::sum(&self.coefficients, n - 1, 1.0 / (center * center))
            }
        }
    }

    /// Return the second difference `v_n` of n^{η+1} ([`second_difference`]) and its derivative with respect to η.
    /// `power` is (n−1)^{η+1}, and `logarithm` is ln(n−1).
    #[allow(clippy::cast_precision_loss)]
    fn near_value_and_slope(&self, n: usize, power: f64, logarithm: f64) -> (f64, f64) {
        let value = self.near_value(n, power);
        match n {
            0 | 1 => (value, 0.0),
            2 => (value, 2.0 * libm::exp2(self.eta) * std::f64::consts::LN_2),
            _ => {
                let center = (n - 1) as f64;
                let slope = Self::sum(&self.slopes, n - 1, 1.0 / (center * center));
                (value, value * logarithm + 2.0 * power * slope)
            }
        }
    }
}

/// Minimum length of a kernel whose powers are computed by a sieve over primes instead of one by one.
const MIN_SIEVE_TERMS: usize = 256;
/// Number of values at the start of a kernel that are computed with many terms of the binomial sum. Later values need
/// at most five terms.
const LONG_SUM_TERMS: usize = 64;

/// Return the number K of terms of the even binomial sum that exceed the rounding error for c = `center` ≥
/// [`LONG_SUM_TERMS`]. The omitted terms are below c^{−2K}.
const fn terms_at(center: usize) -> usize {
    match center {
        0..1024 => 5,
        1024..32768 => 3,
        _ => 2,
    }
}

impl SecondDifferences {
    /// Return the second difference `v_n` of n^{η+1} ([`second_difference`]) for n = `center` + 1 > [`LONG_SUM_TERMS`].
    /// `power` is center^{η+1}.
    #[allow(clippy::cast_precision_loss)]
    fn far_value(&self, center: usize, power: f64) -> f64 {
        let inverse_square = 1.0 / (center as f64 * center as f64);
        let sum = self.coefficients[..terms_at(center)].iter().rev().fold(0.0, |sum, &c| (sum + c) * inverse_square);
        2.0 * power * sum
    }

    /// Return the second difference `v_n` of n^{η+1} ([`second_difference`]) and its derivative with respect to η, for
    /// n = `center` + 1 > [`LONG_SUM_TERMS`]. `power` is center^{η+1}, and `logarithm` is ln center.
    #[allow(clippy::cast_precision_loss)]
    fn far_value_and_slope(&self, center: usize, power: f64, logarithm: f64) -> (f64, f64) {
        let inverse_square = 1.0 / (center as f64 * center as f64);
        let terms = terms_at(center);
        let (mut sum, mut slope) = (0.0, 0.0);
        for (&c, &dc) in self.coefficients[..terms].iter().zip(&self.slopes[..terms]).rev() {
            sum = (sum + c) * inverse_square;
            slope = (slope + dc) * inverse_square;
        }
        let value = 2.0 * power * sum;
        (value, value * logarithm + 2.0 * power * slope)
    }
}

/// Return the digamma function ψ(x) for x > 0, NaN elsewhere, by recurrence up to x ≥ 10 and the asymptotic series
/// (DLMF 5.11.2).
#[must_use]
pub fn digamma(x: f64) -> f64 {
    // B_{2k}/(2k) for k = 1 … 7 with Bernoulli numbers B. The eighth term is below 1e−17 at x = 10.
    const BERNOULLI_SERIES: [f64; 7] =
        [1.0 / 12.0, -1.0 / 120.0, 1.0 / 252.0, -1.0 / 240.0, 1.0 / 132.0, -691.0 / 32760.0, 1.0 / 12.0];
    if x.is_nan() || x <= 0.0 {
        return f64::NAN;
    }
    let (mut x, mut shift) = (x, 0.0);
    while x < 10.0 {
        shift += 1.0 / x;
        x += 1.0;
    }
    let square = 1.0 / (x * x);
    let tail = BERNOULLI_SERIES.iter().rev().fold(0.0, |sum, &b| (sum + b) * square);
    libm::log(x) - 0.5 / x - tail - shift
}

/// Return the Grünwald–Letnikov weights `(−1)^j C(α, j)`, j = 0 … m−1, eq. (2) of the paper. A negative α integrates.
///
/// ```
/// assert_eq!(ftlm::fractional::kernels::grunwald_letnikov_weights(1.0, 4), [1.0, -1.0, 0.0, 0.0]);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn grunwald_letnikov_weights(alpha: f64, m: usize) -> Vec<f64> {
    let mut weights = Vec::with_capacity(m);
    let mut weight = 1.0;
    for j in 0..m {
        if j > 0 {
            weight *= 1.0 - (alpha + 1.0) / j as f64;
        }
        weights.push(weight);
    }
    weights
}

/// Return the means of `t^exponent` over the pulses k = 1 … m of length `step` from t = 0 on. They are exact to a few ε
/// for exponents above −1.
///
/// For the exponents −1, −2, … the result contains weights of differences on the first pulses, which represent an
/// impulse and its derivatives.
///
/// ```
/// let means = ftlm::fractional::kernels::power_means(1.0, 3, 2.0);
/// assert!(means.iter().zip([1.0, 3.0, 5.0]).all(|(v, truth)| (v - truth).abs() < 1e-14));
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn power_means(exponent: f64, m: usize, step: f64) -> Vec<f64> {
    if exponent <= -1.0 && exponent.fract() == 0.0 {
        // A difference of the first pulses is centered between them. One more difference shifts its center back to t =
        // 0.
        let order = -exponent - 1.0;
        let (first, next) = (grunwald_letnikov_weights(order, m), grunwald_letnikov_weights(order + 1.0, m));
        let scale = libm::pow(step, exponent);
        return first.iter().zip(&next).map(|(a, b)| scale * (a + 0.5 * (order + 1.0) * b)).collect();
    }
    let means = PowerMeans::new(exponent, step);
    let mut out: Vec<f64> = (1..=near_pulses(m)).map(|k| means.endpoint_mean(k as f64)).collect();
    if out.len() < m {
        let odd = odd_powers(exponent, m);
        out.extend(odd.iter().enumerate().skip(ENDPOINT_PULSES).map(|(k, &power)| means.midpoint_mean(k, power)));
    }
    out
}

/// Return the derivative of [`power_means`] with respect to an exponent above −1.
///
/// ```
/// // Means of t^0 are always 1. Those of t^e change with e like ln t: ∫ ln t over [0, 1] is −1.
/// let slope = ftlm::fractional::kernels::power_means_slope(0.0, 1, 1.0);
/// assert!((slope[0] + 1.0).abs() < 1e-15);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn power_means_slope(exponent: f64, m: usize, step: f64) -> Vec<f64> {
    let means = PowerMeans::new(exponent, step);
    let mut out: Vec<f64> = (1..=near_pulses(m)).map(|k| means.endpoint_slope(k as f64)).collect();
    if out.len() < m {
        let (odd, logarithms) = (odd_powers(exponent, m), integer_logarithms(2 * m));
        let later_pulses = odd.iter().enumerate().skip(ENDPOINT_PULSES);
        out.extend(later_pulses.map(|(k, &power)| means.midpoint_slope(k, power, logarithms[2 * k + 1])));
    }
    out
}

/// Number of pulses at the start of a long record whose means of t^e are computed as differences of powers at the pulse
/// ends. The means over later pulses are computed by a series about the pulse midpoint.
const ENDPOINT_PULSES: usize = 16;
/// Number of terms of the series about the midpoint of a pulse, for pulse indices below [`LONG_SUM_TERMS`]. The omitted
/// terms, 33^−16, are below the rounding error.
const MIDPOINT_SERIES_TERMS: usize = 8;

/// Return the number of pulses at the start of a record of m pulses whose means of t^e are computed from powers at the
/// pulse ends. The means over other pulses are computed from powers at their midpoints.
fn near_pulses(m: usize) -> usize {
    m.min(if m < MIN_SIEVE_TERMS { m } else { ENDPOINT_PULSES })
}

/// Means of t^e over pulses of length h from t = 0 on, with the exponent e.
#[derive(Debug, Clone)]
pub(crate) struct PowerMeans {
    /// Exponent plus one.
    a: f64,
    /// Factor h^e with the pulse length h and the exponent e.
    scale: f64,
    /// Factor (h/2)^e with the pulse length h and the exponent e.
    half: f64,
    /// Logarithm of the pulse length.
    ln_step: f64,
    /// Coefficients C(a, 2j+1)/a, j = 0, 1, …, of the series about the pulse midpoint, with the exponent a − 1.
    sums: [f64; MIDPOINT_SERIES_TERMS],
    /// Derivatives of the coefficients `sums` with respect to the exponent.
    slopes: [f64; MIDPOINT_SERIES_TERMS],
}

impl PowerMeans {
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn new(exponent: f64, step: f64) -> Self {
        let (a, scale) = (exponent + 1.0, libm::pow(step, exponent));
        let (mut sums, mut slopes) = ([0.0; MIDPOINT_SERIES_TERMS], [0.0; MIDPOINT_SERIES_TERMS]);
        let (mut c, mut dc) = (1.0, 0.0);
        for (j, (sum, slope)) in sums.iter_mut().zip(&mut slopes).enumerate() {
            (*sum, *slope) = (c, dc);
            let next = (2 * j + 1) as f64;
            let (factor, divisor) = ((a - next) * (a - next - 1.0), (next + 1.0) * (next + 2.0));
            dc = (dc * factor + c * (2.0 * (a - next) - 1.0)) / divisor;
            c *= factor / divisor;
        }
        Self { a, scale, half: scale * libm::exp2(-exponent), ln_step: libm::log(step), sums, slopes }
    }

    /// Return the mean of the power over pulse k + 1, which is element k of [`power_means`].
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn mean(&self, k: usize) -> f64 {
        if k < ENDPOINT_PULSES {
            return self.endpoint_mean((k + 1) as f64);
        }
        self.midpoint_mean(k, libm::pow((2 * k + 1) as f64, self.a - 1.0))
    }

    /// Return the mean of t^e over pulse k, which is h^e/a·(k^a − (k−1)^a), without cancellation. Here h is the pulse
    /// length, e the exponent and a = e + 1.
    fn endpoint_mean(&self, k: f64) -> f64 {
        let a = self.a;
        self.scale / a * if k == 1.0 { 1.0 } else { -libm::pow(k, a) * libm::expm1(a * libm::log1p(-1.0 / k)) }
    }

    /// Return the derivative of the mean of t^e over pulse k with respect to the exponent e.
    fn endpoint_slope(&self, k: f64) -> f64 {
        let a = self.a;
        let derivative = |k: f64| if k > 1.0 { libm::pow(k, a) * libm::log(k) } else { 0.0 };
        self.endpoint_mean(k) * (self.ln_step - 1.0 / a) + self.scale / a * (derivative(k) - derivative(k - 1.0))
    }

    /// Return the sum Σ_j `sums[j]`·d^{−2j} with d = 2k + 1, where d/2 is the midpoint of pulse k + 1 in pulse lengths.
    /// Only terms above the rounding error are added.
    #[allow(clippy::cast_precision_loss)]
    fn sum(sums: &[f64; MIDPOINT_SERIES_TERMS], k: usize) -> f64 {
        let d = (2 * k + 1) as f64;
        let inverse_square = 1.0 / (d * d);
        let terms = if k < LONG_SUM_TERMS { MIDPOINT_SERIES_TERMS } else { terms_at(2 * k) };
        sums[..terms].iter().rev().fold(0.0, |sum, &c| sum * inverse_square + c)
    }

    /// Return the mean of t^e over pulse k + 1, which is (h d/2)^e·Σ_j C(a, 2j+1)/a·d^{−2j}. Here h is the pulse
    /// length, d = 2k + 1 and a = e + 1. `power` is d^e.
    fn midpoint_mean(&self, k: usize, power: f64) -> f64 {
        self.half * power * Self::sum(&self.sums, k)
    }

    /// Return the derivative of the mean of t^e over pulse k + 1 with respect to the exponent e. `power` is d^e and
    /// `logarithm` is ln d with d = 2k + 1.
    fn midpoint_slope(&self, k: usize, power: f64, logarithm: f64) -> f64 {
        let logarithm_sum = self.ln_step - std::f64::consts::LN_2 + logarithm;
        self.half * power * (Self::sum(&self.sums, k) * logarithm_sum + Self::sum(&self.slopes, k))
    }
}

/// Return the pulse means of t^`exponent` as an input of a simulation, corrected in the first two pulses for exponents
/// between −1 and 0. `step` is the pulse length \[s\].
///
/// Without the correction, a smooth response has an error of order e + 2 in the pulse length h, with the exponent e.
/// Its cause is the first moments of t^e about the pulse midpoints t_j. Their sum Σ_j ∫_j (t − t_j) t^e dt over the
/// pulses is h^{e+2} ζ(−1−e)/(1+e). The correction moves this amount from the first pulse to the second (as in
/// doi:10.1137/0517050).
#[must_use]
pub fn power_pulses(exponent: f64, m: usize, step: f64) -> Vec<f64> {
    let mut pulses = power_means(exponent, m, step);
    if is_singular(exponent) {
        shift(&mut pulses, moment(exponent) * libm::pow(step, exponent));
    }
    pulses
}

/// Return the derivative of [`power_pulses`] with respect to an exponent above −1.
#[must_use]
pub fn power_pulses_slope(exponent: f64, m: usize, step: f64) -> Vec<f64> {
    let mut slopes = power_means_slope(exponent, m, step);
    if is_singular(exponent) {
        let h = 1e-4_f64.min(0.5 * (exponent + 1.0));
        let moment_slope = (moment(exponent + h) - moment(exponent - h)) / (2.0 * h);
        shift(&mut slopes, (moment_slope + moment(exponent) * libm::log(step)) * libm::pow(step, exponent));
    }
    slopes
}

/// Return true if the power t^exponent is infinite at t = 0 and not an impulse.
fn is_singular(exponent: f64) -> bool {
    exponent > -1.0 && exponent < 0.0
}

/// Subtract `value` from the first pulse and add it to the second.
fn shift(pulses: &mut [f64], value: f64) {
    if let [first, second, ..] = pulses {
        *first -= value;
        *second += value;
    }
}

/// Return the sum of the first moments of t^e about the midpoints of pulses of unit length. It is ζ(−1−e)/(1+e) for −1
/// < e < 0.
fn moment(exponent: f64) -> f64 {
    // Euler–Maclaurin summation from n = 10 on.
    const SUMMATION_START: f64 = 10.0;
    const BERNOULLI_FACTORS: [f64; 4] = [1.0 / 12.0, -1.0 / 720.0, 1.0 / 30240.0, -1.0 / 1_209_600.0];
    let a = exponent + 1.0;
    let first: f64 = (1..10).map(|n| libm::pow(f64::from(n), a)).sum();
    let power = libm::pow(SUMMATION_START, a);
    let mut zeta = first - power * SUMMATION_START / (a + 1.0) + 0.5 * power;
    // Terms s (s+1) (s+2) … N^{−s−2j+1} for s = −a and N = 10.
    let mut term = -a * power / SUMMATION_START;
    for (j, b) in (1..).zip(BERNOULLI_FACTORS) {
        zeta += b * term;
        let next = f64::from(2 * j - 1) - a;
        term *= next * (next + 1.0) / (SUMMATION_START * SUMMATION_START);
    }
    zeta / a
}

/// Return an error for an order outside [0, [`MAX_ORDER`]].
///
/// # Errors
/// [`Error::OutOfRange`] for an order outside this interval, or NaN.
pub fn check_order(name: &str, order: f64) -> Result<()> {
    if (0.0..=MAX_ORDER).contains(&order) {
        Ok(())
    } else {
        Err(Error::OutOfRange {
            name: name.to_owned(),
            value: order,
            range: format!("[0, {MAX_ORDER}]"),
            remedy: "split a higher order into an integer and a fractional part".into(),
        })
    }
}

/// The difference between the order of a term and the order α of its equation must be below this value. At difference 1
/// the reciprocal kernel is that of Tustin's rule for a derivative, which oscillates from pulse to pulse without decay.
pub const MAX_ORDER_EXCESS: f64 = 1.0;

/// Return the kernel of I^η in pulse means for η > −[`MAX_ORDER_EXCESS`], m values for the pulse length `step` \[s\].
/// For η < 0 it is the reciprocal of [`block_pulse_kernel`] at −η.
///
/// ```
/// use ftlm::fractional::kernels::kernel;
/// let both = ftlm::series::multiply(&kernel(-0.4, 64, 0.1), &kernel(0.4, 64, 0.1), 64);
/// assert!((both[0] - 1.0).abs() < 1e-12 && both[1..].iter().all(|v| v.abs() < 1e-12));
/// ```
#[must_use]
pub fn kernel(eta: f64, m: usize, step: f64) -> Vec<f64> {
    if eta >= 0.0 {
        block_pulse_kernel(eta, m, step)
    } else {
        reciprocal(&block_pulse_kernel(-eta, m, step))
    }
}

/// Return [`kernel`] and its derivative with respect to η.
#[must_use]
pub fn kernel_and_slope(eta: f64, m: usize, step: f64) -> (Vec<f64>, Vec<f64>) {
    if eta >= 0.0 {
        return kernel_with_derivative(eta, m, step);
    }
    let (integral, slope) = kernel_with_derivative(-eta, m, step);
    let kernel = reciprocal(&integral);
    // d/dη of 1/F(−η) is F′(−η)/F(−η)², with the kernel F as a series.
    let square = multiply(&kernel, &kernel, m);
    (kernel, multiply(&square, &slope, m))
}

/// Return the first value of [`kernel`], which gives the contribution of a pulse to the integral over the same pulse.
#[must_use]
pub fn first_coefficient(eta: f64, step: f64) -> f64 {
    let modulus = eta.abs();
    let value = libm::pow(step, modulus) / libm::tgamma(modulus + 2.0);
    if eta >= 0.0 {
        value
    } else {
        1.0 / value
    }
}

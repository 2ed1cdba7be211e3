//! Fractional integrals and derivatives of uniformly sampled signals.

use crate::error::{check_finite, check_length, check_overflow, check_step, Error, Result};
use crate::fractional::kernels::{block_pulse_kernel, check_order, grunwald_letnikov_weights, SecondDifferences};
use crate::series;

/// Discretization rule of a fractional integral of order η. h is the sampling interval.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IntegralRule {
    /// Block-pulse operational matrix F^η, eqs. (31) and (32) of the paper. Input and result are means over sampling
    /// intervals. The error is of second order in h.
    BlockPulse,
    /// Product trapezoidal rule for point samples, exact for the linear interpolant. The error is of second order in h.
    Trapezoidal,
    /// Grünwald–Letnikov sum of order −η for point samples, eq. (2) of the paper. The error is of first order in h.
    GrunwaldLetnikov,
}

/// Maximum order of a derivative of samples. Each integer order multiplies the noise of the samples by 1/h, where h is
/// the sampling interval.
pub const MAX_DERIVATIVE_ORDER: f64 = 3.0;

/// Definition of a fractional derivative of order α, and its discretization with the sampling interval h.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Derivative {
    /// Grünwald–Letnikov sum, eq. (2) of the paper. The error is of first order in h for signals that start at zero.
    GrunwaldLetnikov,
    /// Riemann–Liouville derivative, eq. (3) of the paper: Caputo derivative plus power functions of the initial
    /// values. It is infinite at t = 0 if an initial value is not zero.
    RiemannLiouville,
    /// Caputo derivative, eq. (5) of the paper, by the L1 formula applied to the highest integer derivative below α.
    /// The error is of order min(2, 2 − frac α) in h.
    Caputo,
}

/// Return the fractional integral I^η of uniformly sampled `x` from its first sample, one value per sample. `step` is
/// the sampling interval \[s\].
///
/// # Errors
/// [`Error::OutOfRange`] for an order outside [0, 10] or a step that is not positive. [`Error::NotFinite`] for a value
/// that is not finite. Also an error for an integral that overflows.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::fractional::integral::{fractional_integral, IntegralRule};
/// // I^1 of t is t²/2, exactly for the linear interpolant.
/// let integral = fractional_integral(&[0.0, 1.0, 2.0], 1.0, 1.0, IntegralRule::Trapezoidal)?;
/// assert!((integral[2] - 2.0).abs() < 1e-12);
/// # Ok(())
/// # }
/// ```
pub fn fractional_integral(x: &[f64], eta: f64, step: f64, rule: IntegralRule) -> Result<Vec<f64>> {
    let mut out = x.to_vec();
    integrate_signals(&mut out, x.len(), eta, step, rule)?;
    Ok(out)
}

/// Replace several signals of m samples by their fractional integrals I^η. `signals` contains one signal after another.
/// The kernel is computed once.
///
/// # Errors
/// The errors of [`fractional_integral`], and [`Error::Length`] for a length that is not a multiple of m.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::fractional::integral::{integrate_signals, IntegralRule};
/// let mut signals = [1.0, 1.0, 2.0, 2.0];
/// integrate_signals(&mut signals, 2, 1.0, 1.0, IntegralRule::BlockPulse)?;
/// assert_eq!(signals, [0.5, 1.5, 1.0, 3.0]);
/// # Ok(())
/// # }
/// ```
pub fn integrate_signals(signals: &mut [f64], m: usize, eta: f64, step: f64, rule: IntegralRule) -> Result<()> {
    check_step(step)?;
    check_order("order", eta)?;
    check_finite("x", signals)?;
    if m == 0 || !signals.len().is_multiple_of(m) {
        return if signals.is_empty() { Ok(()) } else { check_length("the last signal", m, signals.len() % m.max(1)) };
    }
    if eta == 0.0 {
        return Ok(());
    }
    match rule {
        IntegralRule::BlockPulse => series::multiply_signals(&block_pulse_kernel(eta, m, step), signals),
        IntegralRule::GrunwaldLetnikov => {
            let scale = libm::pow(step, eta);
            series::multiply_signals(&grunwald_letnikov_weights(-eta, m), signals);
            signals.iter_mut().for_each(|v| *v *= scale);
        }
        IntegralRule::Trapezoidal => {
            let differences = SecondDifferences::new(eta);
            let scale = libm::pow(step, eta) / libm::tgamma(eta + 2.0);
            let weights: Vec<f64> =
                (0..m).map(|n| scale * (first_sample_weight(eta, n) - differences.value(n + 1))).collect();
            let first: Vec<f64> = signals.iter().step_by(m).copied().collect();
            // The block-pulse kernel is also the trapezoidal weight of every sample but the first.
            series::multiply_signals(&block_pulse_kernel(eta, m, step), signals);
            for (out, first) in signals.chunks_exact_mut(m).zip(first) {
                out.iter_mut().zip(&weights).for_each(|(value, weight)| *value += first * weight);
                out[0] = 0.0;
            }
        }
    }
    check_overflow(signals, step)
}

/// Return the weight of the first sample in the product trapezoidal rule at sample n, without the factor h^η/Γ(η+2):
/// `(n−1)^{η+1} − (n−1−η) n^η`.
#[allow(clippy::cast_precision_loss)]
fn first_sample_weight(eta: f64, n: usize) -> f64 {
    if n == 0 {
        return 0.0;
    }
    if n == 1 {
        return eta;
    }
    let n = n as f64;
    // n^η·[(n−1)((1−1/n)^η − 1) + η] with the inner difference by expm1.
    libm::pow(n, eta) * ((n - 1.0) * libm::expm1(eta * libm::log1p(-1.0 / n)) + eta)
}

/// Return the fractional derivative D^α of uniformly sampled `x` from its first sample, one value per sample. `step` is
/// the sampling interval \[s\].
///
/// `initial` contains the known initial values x(0), x′(0), …. Missing values follow from second-order one-sided
/// differences of the samples.
///
/// # Errors
/// [`Error::OutOfRange`] for an order outside [0, 3] or a step that is not positive. [`Error::NotFinite`] for a value
/// that is not finite. [`Error::Length`] for fewer than ⌈α⌉ + 2 samples, which the differences need. Also an error for
/// a Grünwald–Letnikov sum that overflows.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::fractional::integral::{fractional_derivative, Derivative};
/// // D^0.5 of t is 2 √(t/π).
/// let slope = fractional_derivative(&[0.0, 1.0, 2.0, 3.0], 0.5, 1.0, Derivative::Caputo, &[])?;
/// assert!((slope[3] - 2.0 * (3.0 / std::f64::consts::PI).sqrt()).abs() < 1e-12);
/// # Ok(())
/// # }
/// ```
pub fn fractional_derivative(
    x: &[f64],
    alpha: f64,
    step: f64,
    definition: Derivative,
    initial: &[f64],
) -> Result<Vec<f64>> {
    check_step(step)?;
    if !(0.0..=MAX_DERIVATIVE_ORDER).contains(&alpha) {
        return Err(Error::OutOfRange {
            name: "order".into(),
            value: alpha,
            range: format!("[0, {MAX_DERIVATIVE_ORDER}]"),
            remedy: "reduce the order of the derivative, or move the derivative to an equation".into(),
        });
    }
    check_finite("x", x)?;
    check_finite("initial", initial)?;
    let m = x.len();
    if alpha == 0.0 {
        return Ok(x.to_vec());
    }
    if definition == Derivative::GrunwaldLetnikov {
        let scale = libm::pow(step, -alpha);
        let mut out = series::multiply(&grunwald_letnikov_weights(alpha, m), x, m);
        out.iter_mut().for_each(|v| *v *= scale);
        check_overflow(&out, step)?;
        return Ok(out);
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let integer_order = alpha.ceil() as usize;
    if m < integer_order + 2 {
        return Err(Error::Length { name: "x".into(), expected: integer_order + 2, found: m });
    }
    // Initial values, and the highest integer derivative, to which the L1 formula is applied.
    let mut x = x.to_vec();
    x[0] = initial.first().copied().unwrap_or(x[0]);
    let mut initial_values = Vec::with_capacity(integer_order);
    let mut highest = Vec::new();
    for k in 0..integer_order {
        highest = difference(&x, k, step);
        initial_values.push(initial.get(k).copied().unwrap_or(highest[0]));
        highest[0] = initial_values[k];
    }
    #[allow(clippy::cast_precision_loss)]
    let fraction = alpha - (integer_order - 1) as f64;
    let mut out = if fraction == 1.0 { difference(&x, integer_order, step) } else { l1(&highest, fraction, step) };
    if definition == Derivative::RiemannLiouville && fraction < 1.0 {
        #[allow(clippy::cast_precision_loss)]
        for (k, &initial_value) in initial_values.iter().enumerate() {
            if initial_value == 0.0 {
                continue;
            }
            let power = k as f64 - alpha;
            let scale = initial_value / libm::tgamma(power + 1.0);
            for (n, value) in out.iter_mut().enumerate() {
                *value += scale * libm::pow(n as f64 * step, power);
            }
        }
    }
    Ok(out)
}

/// Return the Caputo derivative of an order in (0, 1) by the L1 formula, which is exact for the linear interpolant.
#[allow(clippy::cast_precision_loss)]
fn l1(x: &[f64], order: f64, step: f64) -> Vec<f64> {
    let (m, a) = (x.len(), 1.0 - order);
    let scale = libm::pow(step, -order) / libm::tgamma(2.0 - order);
    let weights: Vec<f64> = (0..m)
        .map(|k| {
            let k = k as f64;
            // (k+1)^a − k^a without the cancellation.
            scale * if k == 0.0 { 1.0 } else { libm::pow(k, a) * libm::expm1(a * libm::log1p(1.0 / k)) }
        })
        .collect();
    let mut differences = vec![0.0; m];
    for n in 1..m {
        differences[n] = x[n] - x[n - 1];
    }
    // rises[0] = 0, so the product at n is Σ_{k<n} w_k·(x_{n−k} − x_{n−k−1}).
    series::multiply(&weights, &differences, m)
}

/// Return the derivative of integer order k ≤ 3 by central differences, which are one-sided at the ends. The error is
/// of second order in the step at every sample. The signal must have at least k + 2 samples.
///
/// Each k has a separate formula, because every repetition of first differences would lose an order of accuracy at the
/// ends.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
fn difference(x: &[f64], k: usize, step: f64) -> Vec<f64> {
    // Weights for the first samples, and central weights for every interior sample.
    let (end_weights, central_weights): (&[&[f64]], &[f64]) = match k {
        0 => return x.to_vec(),
        1 => (&[&[-1.5, 2.0, -0.5]], &[-0.5, 0.0, 0.5]),
        2 => (&[&[2.0, -5.0, 4.0, -1.0]], &[1.0, -2.0, 1.0]),
        _ => (&[&[-2.5, 9.0, -12.0, 7.0, -1.5], &[-1.5, 5.0, -6.0, 3.0, -0.5]], &[-0.5, 1.0, 0.0, -1.0, 0.5]),
    };
    let (m, end_count) = (x.len(), end_weights.len());
    let scale = step.powi(-(k as i32));
    // In reversed time, a derivative of odd order changes its sign.
    let end_scale = if k % 2 == 1 { -scale } else { scale };
    let mut out: Vec<f64> = Vec::with_capacity(m);
    let weighted_sum = |weights: &[f64], values: &mut dyn Iterator<Item = &f64>| -> f64 {
        weights.iter().zip(values).map(|(w, v)| w * v).sum()
    };
    out.extend(end_weights.iter().map(|weights| scale * weighted_sum(weights, &mut x.iter())));
    out.extend(x.windows(2 * end_count + 1).map(|window| scale * weighted_sum(central_weights, &mut window.iter())));
    out.extend(end_weights.iter().rev().map(|weights| end_scale * weighted_sum(weights, &mut x.iter().rev())));
    out
}

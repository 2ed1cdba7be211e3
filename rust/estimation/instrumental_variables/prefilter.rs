//! Prefilters and low-pass filters for instrumental variables, and noise-free projections of measured outputs.

use super::solution::dot;
use crate::equation::Filter;
use crate::error::{Error, Result};
use crate::fft;
use crate::fractional::kernels::block_pulse_kernel;
use crate::linalg::orthogonal::orthonormal_basis;
use crate::parallel::Stop;
use crate::regressors::Record;
use crate::series::{self, reciprocal, Buffers, Kernel};
use crate::signal::block_pulse::PulseMeans;

/// Ratio of the peak magnitude in the second half of a response to that in the first half, above which the response
/// counts as unstable.
const INSTABILITY_PEAK_RATIO: f64 = 2.0;

/// Return the first m coefficients of 1/D(z), damped if 1/D is unstable, and true if they are damped.
///
/// D is the series with the m coefficients `divisor`. If 1/D is unstable, the result is 1/D(ρz). The factor ρ =
/// e^{−γ/m} is the largest one with γ = 4, 8, 16, … that makes the result stable.
///
/// # Errors
/// [`LeadingZero`](crate::error::Error::LeadingZero) if the leading coefficient of D is zero.
#[allow(clippy::cast_precision_loss)]
pub fn damped_inverse(divisor: &[f64]) -> Result<(Vec<f64>, bool)> {
    let m = divisor.len();
    let unit_series = unit(m);
    let quotient = series::divide(&unit_series, divisor)?;
    if !is_unstable(&quotient) {
        return Ok((quotient, false));
    }
    let is_finite = quotient.iter().all(|q| q.is_finite());
    let mut gamma = 4.0;
    loop {
        let rho = libm::exp(-gamma / m as f64);
        // 1/D(ρz) is the series of 1/D at ρz, unless that series overflows.
        let damped = if is_finite {
            scale_argument(rho, &quotient)
        } else {
            series::divide(&unit_series, &scale_argument(rho, divisor))?
        };
        // At γ = 64 m only the first term of D remains.
        if !is_unstable(&damped) || gamma > 64.0 * m as f64 {
            return Ok((damped, true));
        }
        gamma *= 2.0;
    }
}

/// Return the coefficients of the series a(ρz), given those of a(z) in `series`.
fn scale_argument(rho: f64, series: &[f64]) -> Vec<f64> {
    let mut power = 1.0;
    series
        .iter()
        .map(|v| {
            let value = v * power;
            power *= rho;
            value
        })
        .collect()
}

pub(super) fn is_unstable(response: &[f64]) -> bool {
    let (first, second) = response.split_at(response.len() / 2);
    let peak =
        |part: &[f64]| part.iter().fold(0.0_f64, |a, v| if v.is_finite() { a.max(v.abs()) } else { f64::INFINITY });
    let later = peak(second);
    later.is_infinite() || later > INSTABILITY_PEAK_RATIO * peak(first)
}

/// Frequency \[rad/s\] below which 90 % of the power of a signal about its mean lies.
///
/// `step` is the sampling interval \[s\].
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn power_frequency(signal: &[f64], step: f64) -> f64 {
    let m = signal.len();
    let mean = signal.iter().sum::<f64>() / m.max(1) as f64;
    let power = fft::power_spectrum(signal.iter().enumerate().map(|(k, v)| {
        // A Hann window, because leakage from the ends would count as high frequency.
        let window = 0.5 - 0.5 * libm::cos(2.0 * std::f64::consts::PI * k as f64 / m as f64);
        window * (v - mean)
    }));
    let total: f64 = power.iter().sum();
    let mut sum = 0.0;
    let bin = power.iter().position(|p| {
        sum += p;
        sum >= 0.9 * total
    });
    // The bins are equally spaced from zero to the Nyquist frequency, which is the last bin.
    let bins = power.len().saturating_sub(1).max(1) as f64;
    std::f64::consts::PI / step * bin.unwrap_or(0).max(1) as f64 / bins
}

/// Return the series of a second-order low-pass filter on the pulses of a record.
///
/// `omega` is the cutoff frequency \[rad/s\].
///
/// An equation remains valid if all its signals pass this filter.
///
/// # Errors
/// An order out of range, a value that is not finite, or an invalid step ([`Filter::series`]).
pub fn low_pass(omega: f64, record: &Record) -> Result<Vec<f64>> {
    let numerator = vec![(omega * omega, 0.0)];
    let denominator = vec![(1.0, 2.0), (1.4 * omega, 1.0), (omega * omega, 0.0)];
    Filter { numerator, denominator }.series(record.m(), record.step())
}

/// Return the series of the state-variable filter s^α/(s + λ)^⌈α⌉ on the pulses of a record.
///
/// α is `order`, and λ is `pole` \[rad/s\].
///
/// # Errors
/// An order out of range, a value that is not finite, or an invalid step ([`Filter::series`]).
pub(super) fn state_variable_filter(pole: f64, order: f64, record: &Record) -> Result<Vec<f64>> {
    let n = order.ceil().max(1.0) as i32;
    let mut binomial = 1.0;
    let mut denominator = Vec::new();
    for k in 0..=n {
        denominator.push((binomial * pole.powi(n - k), f64::from(k)));
        binomial *= f64::from(n - k) / f64::from(k + 1);
    }
    Filter { numerator: vec![(1.0, order)], denominator }.series(record.m(), record.step())
}

/// First `m` coefficients of the constant series 1.
pub(super) fn unit(m: usize) -> Vec<f64> {
    let mut series = vec![0.0; m];
    if let Some(first) = series.first_mut() {
        *first = 1.0;
    }
    series
}

/// Number of resonators of [`project`] per decade and input. At [`RESONATOR_DAMPING`], adjacent passbands overlap.
const RESONATORS_PER_DECADE: usize = 8;
/// Damping ratio of the resonators of [`project`].
const RESONATOR_DAMPING: f64 = 0.2;

/// Relative norm below which a basis column of [`project`] counts as linearly dependent on the previous columns.
///
/// Such a column is excluded. Its component outside the span of the previous columns contains almost nothing of the
/// responses, but as much noise as any other direction. Rounding errors (10⁻¹¹ for columns of a thousand pulses) would
/// also determine the direction of this component.
const BASIS_RANK_TOLERANCE: f64 = 1e-6;

/// Return a record to which noise-free substitutes ([`project`]) of all signals except the inputs are added.
///
/// `inputs` flags the signals that are inputs.
///
/// # Errors
/// [`Error::Structure`] if a signal needs a substitute and there is no input or there are fewer than 8 pulses.
/// [`Error::Interrupted`] after a stop request.
pub fn with_projections(record: Record, inputs: &[bool], at_rest: bool, stop: &Stop) -> Result<Record> {
    let input_signals: Vec<usize> = (0..record.len()).filter(|&s| inputs.get(s).copied().unwrap_or(false)).collect();
    // All signals share one basis. It is empty if all signals are inputs.
    let basis = if input_signals.len() < record.len() {
        input_response_basis(&record, &input_signals, at_rest, stop)?
    } else {
        Vec::new()
    };
    let clean = (0..record.len()).map(|s| {
        let signal = record.signal(s);
        PulseMeans::new(if input_signals.contains(&s) { signal.to_vec() } else { project_on_basis(&basis, signal) })
    });
    let clean = clean.collect();
    record.with_clean(clean)
}

/// Project a measured signal on the space of responses to the inputs, which removes most of its noise.
///
/// The basis contains the first two integrals of each input and the responses of resonators to them, eight per decade.
/// A basis of k directions passes the fraction k/m of the noise power in m samples, for any dynamics. Unless
/// `at_rest` is true, the basis also contains an offset and a ramp in time.
///
/// # Errors
/// [`Error::Structure`] without an input or for a record of fewer than 8 pulses.
pub fn project(record: &Record, signal: usize, inputs: &[usize], at_rest: bool) -> Result<Vec<f64>> {
    Ok(project_on_basis(&input_response_basis(record, inputs, at_rest, &Stop::default())?, record.signal(signal)))
}

/// Return the orthogonal projection of a signal on the span of an orthonormal basis.
fn project_on_basis(basis: &[Vec<f64>], signal: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; signal.len()];
    for direction in basis {
        let component = dot(direction, signal);
        out.iter_mut().zip(direction).for_each(|(o, v)| *o += component * v);
    }
    out
}

/// Orthonormal basis of the integrals of the inputs and of the responses of resonators to the inputs.
///
/// Unless `at_rest` is true, the basis also contains an offset and a ramp.
#[allow(clippy::cast_precision_loss)]
fn input_response_basis(record: &Record, inputs: &[usize], at_rest: bool, stop: &Stop) -> Result<Vec<Vec<f64>>> {
    let (m, h) = (record.m(), record.step());
    if m < 8 || inputs.is_empty() {
        return Err(Error::Structure {
            what: "instruments need an input and at least 8 pulses".into(),
            remedy: "use a longer record, or least squares".into(),
        });
    }
    let duration = m as f64 * h;
    let (low, high) = (std::f64::consts::PI / duration, std::f64::consts::PI / (4.0 * h));
    let decades = libm::log10(high / low);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let count = ((decades * RESONATORS_PER_DECADE as f64) as usize).clamp(2, (m / (8 * inputs.len())).max(2));
    let mut columns = Vec::new();
    if !at_rest {
        columns.extend([0.0, 1.0].map(|e| record.initial_term(e)));
    }
    let [first_kernel, second_kernel] = [1.0, 2.0].map(|eta| block_pulse_kernel(eta, m, h));
    let mut buffers = Buffers::default();
    for &input in inputs {
        let input_spectrum = Kernel::new(record.signal(input));
        let integrals = [&first_kernel, &second_kernel].map(|kernel| {
            let mut integral = vec![0.0; m];
            input_spectrum.apply(kernel, &mut integral, &mut buffers);
            integral
        });
        let spectra = [&integrals[0], &integrals[1]].map(|integral| Kernel::new(integral));
        columns.extend(integrals);
        for i in 0..count {
            stop.check()?;
            // Resonators with denominator s² + 2ζωs + ω² and numerators s and 1. With I = 1/s, their responses to u are
            // I u and I² u, both divided by 1 + 2ζωI + ω²I².
            let omega = low * libm::pow(10.0, decades * i as f64 / (count - 1) as f64);
            let resonator = first_kernel
                .iter()
                .zip(&second_kernel)
                .map(|(a, b)| 2.0 * RESONATOR_DAMPING * omega * a + omega * omega * b);
            let mut resonator: Vec<f64> = resonator.collect();
            resonator[0] += 1.0;
            let response = Kernel::with_buffers(&reciprocal(&resonator), &mut buffers);
            columns.extend(spectra.each_ref().map(|integral| {
                let mut column = vec![0.0; m];
                response.times(integral, &mut column, &mut buffers);
                column
            }));
        }
    }
    orthonormal_basis(columns, BASIS_RANK_TOLERANCE, stop)
}

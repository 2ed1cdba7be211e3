//! The filters that stand before regressors and instruments: 1/D̂, damped where it grows, and low-passes.

use crate::equation::Filter;
use crate::error::Result;
use crate::fft;
use crate::regressors::Record;
use crate::series;

/// A free run whose second half exceeds the first by this factor is unstable: its instruments would drown the rest.
const GROWTH: f64 = 2.0;

/// 1/D mod z^m, or of D(ρz) with the largest ρ = e^{−γ/m}, γ = 0, 4, 8, …, that keeps it from growing.
///
/// # Errors
/// [`LeadingZero`](crate::error::Error::LeadingZero) where D starts with zero.
#[allow(clippy::cast_precision_loss)]
pub fn damped_inverse(divisor: &[f64]) -> Result<(Vec<f64>, bool)> {
    let m = divisor.len();
    let one = unit(m);
    let quotient = series::divide(&one, divisor)?;
    if !grows(&quotient) {
        return Ok((quotient, false));
    }
    let finite = quotient.iter().all(|q| q.is_finite());
    let mut gamma = 4.0;
    loop {
        let rho = libm::exp(-gamma / m as f64);
        // The quotient of a divisor read at ρz is the quotient read at ρz, as long as numbers hold it.
        let damped = if finite { read_at(rho, &quotient) } else { series::divide(&one, &read_at(rho, divisor))? };
        // At γ = 64 m nothing is left of D but its first term.
        if !grows(&damped) || gamma > 64.0 * m as f64 {
            return Ok((damped, true));
        }
        gamma *= 2.0;
    }
}

/// A series read at ρz.
fn read_at(rho: f64, series: &[f64]) -> Vec<f64> {
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

pub(super) fn grows(response: &[f64]) -> bool {
    let (first, second) = response.split_at(response.len() / 2);
    let peak =
        |part: &[f64]| part.iter().fold(0.0_f64, |a, v| if v.is_finite() { a.max(v.abs()) } else { f64::INFINITY });
    let later = peak(second);
    later.is_infinite() || later > GROWTH * peak(first)
}

/// Frequency [rad/s] below which 90 % of a signal's power lies.
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn power_frequency(signal: &[f64], step: f64) -> f64 {
    let m = signal.len();
    let mean = signal.iter().sum::<f64>() / m.max(1) as f64;
    let power = fft::power_spectrum(signal.iter().enumerate().map(|(k, v)| {
        // Hann's window: what an open end leaks would count as high frequency.
        let window = 0.5 - 0.5 * libm::cos(2.0 * std::f64::consts::PI * k as f64 / m as f64);
        window * (v - mean)
    }));
    let total: f64 = power.iter().sum();
    let mut sum = 0.0;
    let at = power.iter().position(|p| {
        sum += p;
        sum >= 0.9 * total
    });
    // Bins of the padded transform are 1/(its length) apart; the last bin is Nyquist's frequency.
    let bins = power.len().saturating_sub(1).max(1) as f64;
    std::f64::consts::PI / step * at.unwrap_or(0).max(1) as f64 / bins
}

/// A second-order low-pass as a series: behind it the equation between all signals stays the same.
///
/// # Errors
/// As [`Filter::series`].
pub fn low_pass(omega: f64, record: &Record) -> Result<Vec<f64>> {
    let numerator = vec![(omega * omega, 0.0)];
    let denominator = vec![(1.0, 2.0), (1.4 * omega, 1.0), (omega * omega, 0.0)];
    Filter { numerator, denominator }.series(record.m(), record.step())
}

/// The series 1.
pub(super) fn unit(m: usize) -> Vec<f64> {
    let mut one = vec![0.0; m];
    if let Some(first) = one.first_mut() {
        *first = 1.0;
    }
    one
}

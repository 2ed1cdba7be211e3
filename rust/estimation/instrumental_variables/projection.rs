//! Clean substitutes for measured outputs: their projections on what the inputs excite.

use super::solution::dot;
use crate::error::{Error, Result};
use crate::fractional::kernels::block_pulse_kernel;
use crate::linalg::orthogonal::orthonormal_basis;
use crate::regressors::Record;
use crate::series::{reciprocal, Buffers, Kernel};
use crate::stop::Stop;

/// Resonators of [`project`] a decade and input, and their damping ratio: broad enough to leave no gap between them.
const RESONATORS: usize = 8;
const RESONATOR_DAMPING: f64 = 0.2;

/// Where less than this share of every column of [`project`] is new the others are left out: what inputs excite has next to
/// nothing along them, noise as much as along any, and rounding (10⁻¹¹ of columns of a thousand pulses) would choose them.
const SPANNED: f64 = 1e-6;

/// A record with clean substitutes ([`project`]) for all signals that are no inputs; inputs stand for themselves.
///
/// # Errors
/// As [`project`], [`Error::Interrupted`].
pub fn with_projections(record: Record, inputs: &[bool], at_rest: bool, stop: &Stop) -> Result<Record> {
    let known: Vec<usize> = (0..record.len()).filter(|&s| inputs.get(s).copied().unwrap_or(false)).collect();
    // One basis for all signals; none where all are inputs.
    let basis = if known.len() < record.len() { excited(&record, &known, at_rest, stop)? } else { Vec::new() };
    let clean = (0..record.len()).map(|s| {
        let signal = record.signal(s);
        if known.contains(&s) {
            signal.to_vec()
        } else {
            along(&basis, signal)
        }
    });
    let clean = clean.collect();
    record.with_clean(clean)
}

/// A measured signal without most of its noise: its least-squares projection on what the inputs excite.
///
/// The basis holds each input's first two integrals and, eight a decade, its response through resonators: k directions
/// leave k/m of the noise power, whatever the signal's dynamics. Deterministic powers of t (offset, ramp) are added
/// where the record does not start at rest.
///
/// # Errors
/// No input, a record of fewer than 8 pulses.
pub fn project(record: &Record, signal: usize, inputs: &[usize], at_rest: bool) -> Result<Vec<f64>> {
    Ok(along(&excited(record, inputs, at_rest, &Stop::default())?, record.signal(signal)))
}

/// The sum of a signal's parts along orthonormal directions.
fn along(basis: &[Vec<f64>], signal: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; signal.len()];
    for direction in basis {
        let along = dot(direction, signal);
        out.iter_mut().zip(direction).for_each(|(o, v)| *o += along * v);
    }
    out
}

/// An orthonormal basis of what the inputs excite.
#[allow(clippy::cast_precision_loss)]
fn excited(record: &Record, inputs: &[usize], at_rest: bool, stop: &Stop) -> Result<Vec<Vec<f64>>> {
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
    let count = ((decades * RESONATORS as f64) as usize).clamp(2, (m / (8 * inputs.len())).max(2));
    let mut columns = Vec::new();
    if !at_rest {
        columns.extend([0.0, 1.0].map(|e| record.initial_term(e)));
    }
    let [once, twice] = [1.0, 2.0].map(|eta| block_pulse_kernel(eta, m, h));
    let mut buffers = Buffers::default();
    for &input in inputs {
        let driver = Kernel::new(record.signal(input));
        let integrals = [&once, &twice].map(|kernel| {
            let mut integral = vec![0.0; m];
            driver.apply(kernel, &mut integral, &mut buffers);
            integral
        });
        let spectra = [&integrals[0], &integrals[1]].map(|integral| Kernel::new(integral));
        columns.extend(integrals);
        for i in 0..count {
            stop.check()?;
            // s u and u over s² + 2ζωs + ω² are I u and I² u over 1 + 2ζω I + ω² I², whatever their sizes.
            let omega = low * libm::pow(10.0, decades * i as f64 / (count - 1) as f64);
            let resonator =
                once.iter().zip(&twice).map(|(a, b)| 2.0 * RESONATOR_DAMPING * omega * a + omega * omega * b);
            let mut resonator: Vec<f64> = resonator.collect();
            resonator[0] += 1.0;
            let answer = Kernel::made_with(&reciprocal(&resonator), &mut buffers);
            columns.extend(spectra.each_ref().map(|integral| {
                let mut column = vec![0.0; m];
                answer.times(integral, &mut column, &mut buffers);
                column
            }));
        }
    }
    orthonormal_basis(columns, SPANNED, stop)
}

//! Clean substitutes for measured outputs: their projections on what the inputs excite.

use super::common::dot;
use crate::equation::Filter;
use crate::error::{Error, Result};
use crate::kernels::block_pulse_kernel;
use crate::orthogonal::extend_orthonormal;
use crate::regressors::Record;
use crate::series::{Buffers, Kernel};
use crate::stop::Stop;

/// Resonators of [`project`] a decade and input, and their damping ratio: broad enough to leave no gap between them.
const RESONATORS: usize = 8;
const RESONATOR_DAMPING: f64 = 0.2;

/// A column of [`project`] of which less than this share is new is left out: it would add rounding, not span.
const SPANNED: f64 = 1e-9;

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
/// The basis holds each input's first two integrals and, eight a decade, its response through resonators: k columns
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
    for &input in inputs {
        let u = record.signal(input);
        let driver = Kernel::new(u);
        let mut buffers = Buffers::default();
        let mut through = |series: &[f64]| {
            let mut out = vec![0.0; m];
            driver.apply(series, &mut out, &mut buffers);
            out
        };
        columns.extend([1.0, 2.0].map(|eta| through(&block_pulse_kernel(eta, m, h))));
        for i in 0..count {
            let omega = low * libm::pow(10.0, decades * i as f64 / (count - 1) as f64);
            let denominator = vec![(1.0, 2.0), (2.0 * RESONATOR_DAMPING * omega, 1.0), (omega * omega, 0.0)];
            for numerator in [(omega * omega, 0.0), (omega, 1.0)] {
                let filter = Filter { numerator: vec![numerator], denominator: denominator.clone() };
                stop.check()?;
                columns.push(through(&filter.series(m, h)?));
            }
        }
    }
    let mut basis = Vec::with_capacity(columns.len());
    for column in columns {
        stop.check()?;
        extend_orthonormal(&mut basis, column, SPANNED);
    }
    Ok(basis)
}

//! What the sensor filter of an output still held when a run began: its answers to an impulse and to derivatives of one.
//!
//! They are written as powers of t below zero, −1, −2, …, among the initial terms of an equation. They move nothing, and are
//! added to the output that came through the sensor. Only where the whole equation is put through the filter afterwards, with
//! an output that was not measured through it, do they drive the equation like others: what drives then held them.

use crate::fractional::kernels::power_means;

/// Whether an exponent stands for an impulse or a derivative of one.
pub(crate) fn is_impulse(exponent: f64) -> bool {
    exponent <= -1.0 && exponent.fract() == 0.0
}

/// Initial terms that move something, and impulses, by equation.
#[allow(clippy::type_complexity)]
pub(crate) fn parted(powers: &[Vec<(f64, f64)>]) -> (Vec<Vec<(f64, f64)>>, Vec<Vec<(f64, f64)>>) {
    powers.iter().map(|own| own.iter().partition(|(e, _)| !is_impulse(*e))).unzip()
}

/// Adds impulses and their derivatives to pulse means of outputs.
pub(crate) fn add_impulses(outputs: &mut [Vec<f64>], impulses: &[Vec<(f64, f64)>], step: f64) {
    for (output, own) in outputs.iter_mut().zip(impulses) {
        for &(exponent, value) in own.iter().filter(|(_, value)| *value != 0.0) {
            let means = power_means(exponent, output.len(), step);
            output.iter_mut().zip(means).for_each(|(s, v)| *s += value * v);
        }
    }
}

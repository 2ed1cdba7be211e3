//! Signals integrated by any order: pulse means on the levels of an output and of its velocity, and values at edges.

use crate::excess::kernel_and_slope;
use crate::kernels::digamma;
use crate::series::{Buffers, Kernel};

/// What pulses of a signal give at the ends of pulses, integrated by η > 0, and its derivative with respect to η.
#[allow(clippy::cast_precision_loss)]
pub(super) fn edge_kernel(eta: f64, m: usize, step: f64) -> (Vec<f64>, Vec<f64>) {
    let scale = libm::pow(step, eta) / libm::tgamma(eta + 1.0);
    let turn = libm::log(step) - digamma(eta + 1.0);
    (0..m)
        .map(|n| {
            // (n + 1)^η − n^η without the cancellation.
            let (value, slope) = if n == 0 {
                (1.0, 0.0)
            } else {
                let (n, near) = (n as f64, libm::log1p(1.0 / n as f64));
                let (power, grown) = (libm::pow(n, eta), libm::expm1(eta * near));
                (power * grown, power * (libm::log(n) * grown + near * (grown + 1.0)))
            };
            (scale * value, scale * (value * turn + slope))
        })
        .unzip()
}

/// Below this integration a signal shows at an edge as the pulses on either side have it.
const SEEN_AT_ONCE: f64 = 1e-6;

/// A signal integrated as its term asks on all three levels, or the slope of that with respect to the order.
#[derive(Debug, Clone)]
pub(super) struct Integrated {
    pub(super) output: Vec<f64>,
    pub(super) velocity: Vec<f64>,
    pub(super) edges: Vec<f64>,
}

/// Kernels of a signal that drives the body, integrated by η on the level of the output: values and slopes.
pub(super) struct Driver {
    pub(super) output: [Vec<f64>; 2],
    pub(super) velocity: [Vec<f64>; 2],
    pub(super) edges: Option<[Vec<f64>; 2]>,
}

impl Driver {
    pub(super) fn new(eta: f64, m: usize, step: f64, seen: bool) -> Self {
        let (output, velocity) = (kernel_and_slope(eta, m, step), kernel_and_slope(eta - 1.0, m, step));
        let edges = (seen && eta - 1.0 > SEEN_AT_ONCE).then(|| edge_kernel(eta - 1.0, m, step));
        Self {
            output: [output.0, output.1],
            velocity: [velocity.0, velocity.1],
            edges: edges.map(|(value, slope)| [value, slope]),
        }
    }

    /// The signal through the kernels (0) or their slopes (1).
    pub(super) fn of(&self, signal: &Kernel, which: usize) -> Integrated {
        let velocity = product(signal, &self.velocity[which]);
        let edges = match &self.edges {
            Some(kernels) => product(signal, &kernels[which]),
            None => at_edges(&velocity),
        };
        Integrated { output: product(signal, &self.output[which]), velocity, edges }
    }
}

/// A product with what was cached.
pub(super) fn product(cached: &Kernel, series: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; series.len()];
    cached.apply(series, &mut out, &mut Buffers::default());
    out
}

/// Values at the ends of the pulses from means: those on either side, the last extended.
fn at_edges(means: &[f64]) -> Vec<f64> {
    let m = means.len();
    let mut out: Vec<f64> = means.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])).collect();
    let last = means.last().copied().unwrap_or(0.0);
    out.push(if m > 1 { 1.5 * last - 0.5 * means[m - 2] } else { last });
    out
}

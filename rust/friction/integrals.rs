//! Signals integrated by any order: pulse means on the level of an output, and its velocity at edges.

use crate::fractional::excess::kernel_and_slope;
use crate::fractional::kernels::digamma;
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

/// A signal integrated as its term asks, or the slope of that with respect to the order.
#[derive(Debug, Clone)]
pub(super) struct Integrated {
    /// Pulse means on the level of the output.
    pub(super) output: Vec<f64>,
    /// The velocity at the ends of pulses.
    pub(super) edges: Vec<f64>,
}

/// Kernels of a signal that drives the body, integrated by η on the level of the output: values and slopes.
pub(super) struct Driver {
    pub(super) output: [Vec<f64>; 2],
    /// What a pulse does at the ends of pulses; of a signal that shows at once, to means.
    pub(super) edges: [Vec<f64>; 2],
    at_once: bool,
}

impl Driver {
    pub(super) fn new(eta: f64, m: usize, step: f64) -> Self {
        let output = kernel_and_slope(eta, m, step);
        let at_once = eta - 1.0 <= SEEN_AT_ONCE;
        let edges = if at_once { kernel_and_slope(eta - 1.0, m, step) } else { edge_kernel(eta - 1.0, m, step) };
        Self { output: [output.0, output.1], edges: [edges.0, edges.1], at_once }
    }

    /// The signal through the kernels (0) or their slopes (1).
    pub(super) fn of(&self, signal: &Kernel, which: usize) -> Integrated {
        let edges = product(signal, &self.edges[which]);
        let edges = if self.at_once { between(&edges) } else { edges };
        Integrated { output: product(signal, &self.output[which]), edges }
    }
}

/// A product with what was cached.
pub(super) fn product(cached: &Kernel, series: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; series.len()];
    cached.apply(series, &mut out, &mut Buffers::default());
    out
}

/// Values at the ends of the pulses from means: those on either side, the last extended.
fn between(means: &[f64]) -> Vec<f64> {
    let m = means.len();
    let mut out: Vec<f64> = means.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])).collect();
    let last = means.last().copied().unwrap_or(0.0);
    out.push(if m > 1 { 1.5 * last - 0.5 * means[m - 2] } else { last });
    out
}

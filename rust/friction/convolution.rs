//! A convolution whose signal becomes known one value at a time, each once the sum over its past is: O(N log² N).
//!
//! A block of the past meets the block of equal length that follows it as soon as it is complete, by one transform
//! (van der Hoeven, doi:10.1016/S0747-7171(02)90101-6); what is left within a short block is summed directly.
//!
//! Signals integrated by any order: pulse means on the level of an output, and its velocity at edges.

use crate::fractional::kernels::{digamma, kernel_and_slope};
use crate::series::{Buffers, Kernel};

/// Values that are summed directly: below it a transform costs more.
const DIRECT: usize = 64;

/// Spectra of the heads of a kernel, each twice as long as the last, shared by all signals that it meets.
pub struct Heads {
    kernel: Vec<f64>,
    spectra: Vec<Kernel>,
}

impl Heads {
    /// The kernel of a convolution of as many values.
    #[must_use]
    pub fn new(kernel: &[f64]) -> Self {
        let mut spectra = Vec::new();
        let mut length = DIRECT;
        while length < kernel.len() {
            // Of two blocks only the later one is read, so that what wraps around does not matter.
            spectra.push(Kernel::with_length(&kernel[..(2 * length).min(kernel.len())], 2 * length));
            length *= 2;
        }
        Self { kernel: kernel.to_vec(), spectra }
    }
}

/// Sums over the past of one signal.
pub struct Online<'a> {
    heads: &'a Heads,
    sums: Vec<f64>,
    signal: Vec<f64>,
    buffers: Buffers,
    block: Vec<f64>,
}

impl<'a> Online<'a> {
    /// Nothing is known yet.
    #[must_use]
    pub fn new(heads: &'a Heads) -> Self {
        let m = heads.kernel.len();
        let (signal, block) = (Vec::with_capacity(m), Vec::new());
        Self { heads, sums: vec![0.0; m], signal, buffers: Buffers::default(), block }
    }

    /// Σ_{j<k} κ_{k−j} x_j for the value k that comes next.
    #[must_use]
    pub fn past(&self) -> f64 {
        let k = self.signal.len();
        let first = k - k % DIRECT;
        let recent = self.signal[first..].iter().rev().zip(&self.heads.kernel[1..]).map(|(x, c)| x * c).sum::<f64>();
        self.sums.get(k).copied().unwrap_or(0.0) + recent
    }

    /// The next value of the signal.
    pub fn push(&mut self, value: f64) {
        self.signal.push(value);
        let known = self.signal.len();
        if known % DIRECT != 0 || known >= self.sums.len() {
            return;
        }
        let level = (known / DIRECT).trailing_zeros() as usize;
        let length = DIRECT << level;
        let past = &self.signal[known - length..];
        let Some(spectrum) = self.heads.spectra.get(level).filter(|_| past.iter().any(|x| *x != 0.0)) else { return };
        self.block.resize(2 * length, 0.0);
        spectrum.apply(past, &mut self.block[..2 * length], &mut self.buffers);
        self.sums[known..].iter_mut().zip(&self.block[length..2 * length]).for_each(|(sum, v)| *sum += v);
    }

    /// The signal.
    #[must_use]
    pub fn into_signal(self) -> Vec<f64> {
        self.signal
    }
}

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

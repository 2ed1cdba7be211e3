//! Convolution for friction: online convolution in O(N log² N), and signals integrated by any order.
//!
//! A block of the past is multiplied with the equally long block that follows as soon as it is complete, by one
//! transform (van der Hoeven, doi:10.1016/S0747-7171(02)90101-6). Within a short block terms are summed directly.

use crate::fractional::kernels::{digamma, kernel_and_slope};
use crate::series::{Buffers, Kernel};

/// Length of a block that is summed directly. Transforms of shorter blocks cost more.
const DIRECT_SUM_LENGTH: usize = 64;

/// Spectra of the heads of a kernel, each twice as long as the previous one, shared by all signals.
pub struct Heads {
    kernel: Vec<f64>,
    spectra: Vec<Kernel>,
}

impl Heads {
    /// Heads of a kernel for a convolution of as many values.
    #[must_use]
    pub fn new(kernel: &[f64]) -> Self {
        let mut spectra = Vec::new();
        let mut length = DIRECT_SUM_LENGTH;
        while length < kernel.len() {
            // Only the later of two blocks is read, so wrapped-around terms do not matter.
            spectra.push(Kernel::with_length(&kernel[..(2 * length).min(kernel.len())], 2 * length));
            length *= 2;
        }
        Self { kernel: kernel.to_vec(), spectra }
    }

    /// The kernel.
    #[must_use]
    pub fn kernel(&self) -> &[f64] {
        &self.kernel
    }
}

/// Online convolution of one signal with a kernel.
pub struct OnlineConvolution<'a> {
    heads: &'a Heads,
    sums: Vec<f64>,
    signal: Vec<f64>,
    buffers: Buffers,
    block: Vec<f64>,
}

impl<'a> OnlineConvolution<'a> {
    /// Convolution of a signal without values yet; [`OnlineConvolution::push`] appends them.
    #[must_use]
    pub fn new(heads: &'a Heads) -> Self {
        let m = heads.kernel.len();
        let (signal, block) = (Vec::with_capacity(m), Vec::new());
        Self { heads, sums: vec![0.0; m], signal, buffers: Buffers::default(), block }
    }

    /// Sum Σ_{j<k} κ_{k−j} x_j for the next value k.
    #[must_use]
    pub fn past(&self) -> f64 {
        let k = self.signal.len();
        let first = k - k % DIRECT_SUM_LENGTH;
        let recent = self.signal[first..].iter().rev().zip(&self.heads.kernel[1..]).map(|(x, c)| x * c).sum::<f64>();
        self.sums.get(k).copied().unwrap_or(0.0) + recent
    }

    /// Append the next value of the signal.
    pub fn push(&mut self, value: f64) {
        self.signal.push(value);
        let known = self.signal.len();
        if !known.is_multiple_of(DIRECT_SUM_LENGTH) || known >= self.sums.len() {
            return;
        }
        let level = (known / DIRECT_SUM_LENGTH).trailing_zeros() as usize;
        let length = DIRECT_SUM_LENGTH << level;
        let past = &self.signal[known - length..];
        let Some(spectrum) = self.heads.spectra.get(level).filter(|_| past.iter().any(|x| *x != 0.0)) else { return };
        self.block.resize(2 * length, 0.0);
        spectrum.apply(past, &mut self.block[..2 * length], &mut self.buffers);
        self.sums[known..].iter_mut().zip(&self.block[length..2 * length]).for_each(|(sum, v)| *sum += v);
    }

    /// Signal so far.
    #[must_use]
    pub fn into_signal(self) -> Vec<f64> {
        self.signal
    }
}

/// Response at the ends of pulses to the pulses of a signal integrated by η > 0, and its derivative in η.
#[allow(clippy::cast_precision_loss)]
pub(crate) fn edge_kernel(eta: f64, m: usize, step: f64) -> (Vec<f64>, Vec<f64>) {
    let scale = libm::pow(step, eta) / libm::tgamma(eta + 1.0);
    let turn = libm::log(step) - digamma(eta + 1.0);
    (0..m)
        .map(|n| {
            // (n + 1)^η − n^η without cancellation.
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

/// Integration order below which a signal has direct feedthrough to the velocity at an edge, as the mean of the
/// neighboring pulses.
pub(crate) const MAX_FEEDTHROUGH_ORDER: f64 = 1e-6;

/// Signal integrated by the order of its term, or the derivative of that in the order.
#[derive(Debug, Clone)]
pub(super) struct IntegratedSignal {
    /// Pulse means at the level of the output.
    pub(super) output: Vec<f64>,
    /// Velocity at the ends of pulses.
    pub(super) edges: Vec<f64>,
}

/// Kernels of an input integrated by η, at the level of the output: values and derivatives in η.
pub(super) struct InputKernels {
    pub(super) output: [Vec<f64>; 2],
    /// Response to a pulse at the ends of pulses. With direct feedthrough: response in pulse means.
    pub(super) edges: [Vec<f64>; 2],
    at_once: bool,
}

impl InputKernels {
    pub(super) fn new(eta: f64, m: usize, step: f64) -> Self {
        let output = kernel_and_slope(eta, m, step);
        let at_once = eta - 1.0 <= MAX_FEEDTHROUGH_ORDER;
        let edges = if at_once { kernel_and_slope(eta - 1.0, m, step) } else { edge_kernel(eta - 1.0, m, step) };
        Self { output: [output.0, output.1], edges: [edges.0, edges.1], at_once }
    }

    /// Signal through the kernels (0) or their derivatives (1).
    pub(super) fn of(&self, signal: &Kernel, which: usize) -> IntegratedSignal {
        let edges = product(signal, &self.edges[which]);
        let edges = if self.at_once { average_neighbors(&edges) } else { edges };
        IntegratedSignal { output: product(signal, &self.output[which]), edges }
    }
}

/// Product with a cached series.
pub(crate) fn product(cached: &Kernel, series: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; series.len()];
    cached.apply(series, &mut out, &mut Buffers::default());
    out
}

/// Values at pulse ends from means: averages of neighboring pulses, the last value extrapolated.
pub(crate) fn average_neighbors(means: &[f64]) -> Vec<f64> {
    let m = means.len();
    let mut out: Vec<f64> = means.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])).collect();
    let last = means.last().copied().unwrap_or(0.0);
    out.push(if m > 1 { 1.5 * last - 0.5 * means[m - 2] } else { last });
    out
}

//! A convolution whose signal becomes known one value at a time, each once the sum over its past is: O(N log² N).
//!
//! A block of the past meets the block of equal length that follows it as soon as it is complete, by one transform
//! (van der Hoeven, doi:10.1016/S0747-7171(02)90101-6); what is left within a short block is summed directly.

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

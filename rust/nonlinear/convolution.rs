//! Online convolution, and kernels that give values at the ends of pulses.
//!
//! The signal of an online convolution arrives value by value. When a block of past values is complete, one transform
//! adds its contribution to the next block of equal length (van der Hoeven, doi:10.1016/S0747-7171(02)90101-6). The
//! cost is O(N log² N) for N values. Short blocks are summed directly. Kernels of integer orders are polynomials in the
//! lag, for which running sums of the signal suffice: O(N).

use crate::fractional::kernels::digamma;
use crate::series::{Buffers, Kernel};

/// Length of a block that is summed directly. Transforms of shorter blocks are slower than the sum.
const DIRECT_SUM_LENGTH: usize = 64;
/// Maximum integer order whose kernel is summed as a polynomial. Running sums of higher orders lose digits over long
/// runs.
const MAX_POLYNOMIAL_ORDER: usize = 3;

/// Kernel of online convolutions. One kernel serves any number of signals.
pub struct ConvolutionKernel {
    values: Vec<f64>,
    form: KernelForm,
}

/// Form of a kernel for sums over past values.
enum KernelForm {
    /// Spectra of the first values of the kernel. Each spectrum covers twice as many values as the previous one.
    Blocks(Vec<Kernel>),
    /// Coefficients of the kernel in the polynomials 1, n, n(n + 1)/2, … of the lag n ≥ 1.
    Polynomial(Vec<f64>),
}

impl ConvolutionKernel {
    /// Kernel with these values from lag 0 on. A signal must not be longer than the kernel.
    #[must_use]
    pub fn new(values: Vec<f64>) -> Self {
        let mut spectra = Vec::new();
        let mut length = DIRECT_SUM_LENGTH;
        while length < values.len() {
            // Only the later of two blocks is read, so wrapped-around terms do not matter.
            spectra.push(Kernel::with_length(&values[..(2 * length).min(values.len())], 2 * length));
            length *= 2;
        }
        Self { values, form: KernelForm::Blocks(spectra) }
    }

    /// Kernel of the fractional integral of the given order. `values` holds the kernel from lag 0 on. For an integer
    /// order up to 3, the kernel is a polynomial from lag 1 on, and running sums replace the transforms.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    pub fn of_integral(order: f64, values: Vec<f64>) -> Self {
        let degrees = order.max(0.0) as usize;
        if order != degrees as f64 || degrees > MAX_POLYNOMIAL_ORDER || values.len() <= degrees {
            return Self::new(values);
        }
        // The j-th backward difference of C(n + i − 1, i) at n = 0 is 1 for j = i and 0 otherwise. The polynomial is
        // extended to n ≤ 0 by its differences at 1, 2, ….
        let mut differences: Vec<f64> = values[1..=degrees].to_vec();
        for level in 1..degrees {
            for index in (level..degrees).rev() {
                differences[index] -= differences[index - 1];
            }
        }
        // Forward differences at 1 become backward differences at 0: ∇^j p(0) = Σ_k (−1)^k C(j + k, k) Δ^{j+k} p(1).
        let coefficients = (0..degrees)
            .map(|j| {
                let mut factor = 1.0;
                let mut sum = 0.0;
                for k in 0..degrees - j {
                    sum += factor * differences[j + k];
                    factor *= -((j + k + 1) as f64) / (k + 1) as f64;
                }
                sum
            })
            .collect();
        Self { values, form: KernelForm::Polynomial(coefficients) }
    }

    /// Values of the kernel from lag 0 on.
    #[must_use]
    pub fn values(&self) -> &[f64] {
        &self.values
    }
}

/// Online convolution of one signal with a kernel.
pub struct OnlineConvolution<'a> {
    kernel: &'a ConvolutionKernel,
    /// Contribution of the past values to each future value of the convolution. For a polynomial kernel, the running
    /// sums Σ_j C(k − j + i − 1, i) x_j for i = 0, 1, …, where k is the next index.
    sums: Vec<f64>,
    signal: Vec<f64>,
    buffers: Buffers,
    block: Vec<f64>,
}

impl<'a> OnlineConvolution<'a> {
    /// Convolution of an empty signal, to which [`OnlineConvolution::push`] appends values.
    #[must_use]
    pub fn new(kernel: &'a ConvolutionKernel) -> Self {
        let (sums, signal) = match &kernel.form {
            KernelForm::Blocks(_) => (vec![0.0; kernel.values.len()], Vec::with_capacity(kernel.values.len())),
            KernelForm::Polynomial(coefficients) => (vec![0.0; coefficients.len()], Vec::new()),
        };
        Self { kernel, sums, signal, buffers: Buffers::default(), block: Vec::new() }
    }

    /// Contribution Σ_{j<k} κ_{k−j} x_j of the k past values to the next value of the convolution.
    #[must_use]
    pub fn past_contribution(&self) -> f64 {
        if let KernelForm::Polynomial(coefficients) = &self.kernel.form {
            return coefficients.iter().zip(&self.sums).map(|(c, sum)| c * sum).sum();
        }
        self.sums.get(self.signal.len()).copied().unwrap_or(0.0)
    }

    /// Append the next value of the signal.
    pub fn push(&mut self, value: f64) {
        let spectra = match &self.kernel.form {
            KernelForm::Polynomial(_) => {
                let mut increment = value;
                for sum in &mut self.sums {
                    *sum += increment;
                    increment = *sum;
                }
                return;
            }
            KernelForm::Blocks(spectra) => spectra,
        };
        self.signal.push(value);
        let count = self.signal.len();
        let end = count.next_multiple_of(DIRECT_SUM_LENGTH).min(self.sums.len());
        if let Some(block_sums) = self.sums.get_mut(count..end) {
            block_sums.iter_mut().zip(&self.kernel.values[1..]).for_each(|(sum, c)| *sum += c * value);
        }
        if !count.is_multiple_of(DIRECT_SUM_LENGTH) || count >= self.sums.len() {
            return;
        }
        let level = (count / DIRECT_SUM_LENGTH).trailing_zeros() as usize;
        let length = DIRECT_SUM_LENGTH << level;
        let past = &self.signal[count - length..];
        let Some(spectrum) = spectra.get(level).filter(|_| past.iter().any(|x| *x != 0.0)) else { return };
        self.block.resize(2 * length, 0.0);
        spectrum.apply(past, &mut self.block[..2 * length], &mut self.buffers);
        self.sums[count..].iter_mut().zip(&self.block[length..2 * length]).for_each(|(sum, v)| *sum += v);
    }
}

/// Return the kernel of the integral I^η, η > 0, and its derivative with respect to η, `m` values each. The kernel maps
/// pulse means to values at the ends of pulses of length `step` \[s\].
#[allow(clippy::cast_precision_loss)]
pub(crate) fn edge_kernel(eta: f64, m: usize, step: f64) -> (Vec<f64>, Vec<f64>) {
    let scale = libm::pow(step, eta) / libm::tgamma(eta + 1.0);
    let log_slope = libm::log(step) - digamma(eta + 1.0);
    (0..m)
        .map(|n| {
            // (n + 1)^η − n^η without cancellation.
            let (value, slope) = if n == 0 {
                (1.0, 0.0)
            } else {
                let (n, log_ratio) = (n as f64, libm::log1p(1.0 / n as f64));
                let (power, relative_growth) = (libm::pow(n, eta), libm::expm1(eta * log_ratio));
                (
                    power * relative_growth,
                    power * (libm::log(n) * relative_growth + log_ratio * (relative_growth + 1.0)),
                )
            };
            (scale * value, scale * (value * log_slope + slope))
        })
        .unzip()
}

/// Integration order up to which a signal has direct feedthrough to the velocity at a pulse edge. The value of the
/// signal at the edge is then the average of its means over the two neighboring pulses.
pub(crate) const MAX_FEEDTHROUGH_ORDER: f64 = 1e-6;

/// Spectrum of a signal, for its convolutions with several kernels.
///
/// The values before the first nonzero value of the signal are left out. A convolution is therefore exactly 0 there, so
/// that a system stays at rest until its inputs start. Rounding errors of transforms would be outside the domain of
/// functions such as the square root.
pub(crate) struct SignalSpectrum {
    /// Index of the first nonzero value.
    start: usize,
    /// Spectrum of the signal from `start` on.
    spectrum: Kernel,
}

impl SignalSpectrum {
    /// Return the spectrum of a signal.
    pub(crate) fn new(signal: &[f64]) -> Self {
        let start = signal.iter().position(|v| *v != 0.0).unwrap_or(signal.len());
        Self { start, spectrum: Kernel::new(&signal[start..]) }
    }

    /// Return the convolution of the signal with a kernel of equal length, truncated to this length.
    pub(crate) fn convolve(&self, kernel: &[f64]) -> Vec<f64> {
        let mut out = vec![0.0; kernel.len()];
        let start = self.start.min(kernel.len());
        self.spectrum.apply(&kernel[..kernel.len() - start], &mut out[start..], &mut Buffers::default());
        out
    }
}

/// Return values at the ends of pulses from pulse means: the averages of neighboring means. The last value is
/// extrapolated linearly.
pub(crate) fn average_neighbors(means: &[f64]) -> Vec<f64> {
    let m = means.len();
    let mut out: Vec<f64> = means.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])).collect();
    let last = means.last().copied().unwrap_or(0.0);
    out.push(if m > 1 { 1.5 * last - 0.5 * means[m - 2] } else { last });
    out
}

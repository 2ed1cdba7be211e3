//! Products of truncated power series mod z^m by real FFTs, O(m log m). The spectra of factors of many products are
//! computed once.

use std::cell::RefCell;

use crate::fft::{self, Bin, Plan, Workspace};

/// Maximum length of the shorter factor of a product that is computed directly. Up to this length, direct products are
/// faster and have no rounding error of transforms.
const MAX_DIRECT_TERMS: usize = 64;

/// Return the first m terms of the product of two power series by definition. O(m²).
pub(super) fn direct(a: &[f64], b: &[f64], m: usize) -> Vec<f64> {
    let mut out = vec![0.0; m];
    for (i, &x) in a.iter().enumerate().take(m) {
        for (value, &y) in out[i..].iter_mut().zip(b) {
            *value += x * y;
        }
    }
    out
}

/// Return the first m terms of the product of two power series, which is the causal convolution of a kernel with a
/// signal. O(m log m).
///
/// # Panics
/// If there is not enough memory for m values.
#[must_use]
pub fn multiply(a: &[f64], b: &[f64], m: usize) -> Vec<f64> {
    let (a, b) = (&a[..a.len().min(m)], &b[..b.len().min(m)]);
    if a.len().min(b.len()) <= MAX_DIRECT_TERMS {
        return direct(a, b, m);
    }
    let kernel = Kernel::with_length(a, a.len() + b.len());
    let mut out = vec![0.0; m];
    with_thread_buffers(kernel.plan.len(), |buffers| kernel.apply(b, &mut out, buffers));
    out
}

/// Multiply many signals of m samples by one power series of m terms, in place. Products are truncated to m terms. O(m
/// log m) per signal.
///
/// The spectrum of the series is computed once. `signals` contains one signal after another. A remainder of fewer than
/// m terms is unchanged. The product is exact for a series that is zero from its second term on.
///
/// ```
/// let mut signals = [1.0, 2.0, 3.0, 0.0, 1.0, 0.0];
/// ftlm::series::multiply_signals(&[1.0, -1.0, 0.0], &mut signals);
/// assert_eq!(signals, [1.0, 1.0, 1.0, 0.0, 1.0, -1.0]);
/// ```
pub fn multiply_signals(series: &[f64], signals: &mut [f64]) {
    let m = series.len();
    let Some((&first, rest)) = series.split_first() else { return };
    if rest.iter().all(|&v| v == 0.0) {
        let length = signals.len() / m * m;
        signals[..length].iter_mut().for_each(|v| *v *= first);
    } else if m <= MAX_DIRECT_TERMS {
        signals.chunks_exact_mut(m).for_each(|signal| signal.copy_from_slice(&direct(series, signal, m)));
    } else {
        let kernel = Kernel::new(series);
        let mut product = vec![0.0; m];
        with_thread_buffers(kernel.plan.len(), |buffers| {
            for signal in signals.chunks_exact_mut(m) {
                kernel.apply(signal, &mut product, buffers);
                signal.copy_from_slice(&product);
            }
        });
    }
}

/// Maximum length of a Fourier transform for which a thread reuses its buffers.
const MAX_REUSED_BUFFER_POINTS: usize = 1 << 17;

thread_local!(static BUFFERS: RefCell<Buffers> = RefCell::default());

/// Call `work` with reused buffers of this thread, or with new ones for transforms of more than
/// [`MAX_REUSED_BUFFER_POINTS`] points. `work` must not call this function.
fn with_thread_buffers<R>(points: usize, work: impl FnOnce(&mut Buffers) -> R) -> R {
    if points <= MAX_REUSED_BUFFER_POINTS {
        BUFFERS.with_borrow_mut(work)
    } else {
        work(&mut Buffers::default())
    }
}

/// Reusable buffers for the Fourier transforms of one thread.
#[derive(Default)]
pub struct Buffers {
    time: Vec<f64>,
    spectrum: Vec<Bin>,
    workspace: Workspace,
}

/// Series with its spectrum, for products with many signals. Each product takes two transforms.
pub struct Kernel {
    plan: Plan,
    spectrum: Vec<Bin>,
}

impl Kernel {
    /// Return the spectrum of a series of length m, for products with signals of up to m terms.
    #[must_use]
    pub fn new(series: &[f64]) -> Self {
        Self::with_length(series, 2 * series.len())
    }

    /// Return the spectrum of a series, for products whose factors have up to `total` terms together.
    #[must_use]
    pub fn with_length(series: &[f64], total: usize) -> Self {
        let plan = fft::plan(fft::fast_length(total));
        with_thread_buffers(plan.len(), |buffers| Self::from_plan(plan.clone(), series, buffers))
    }

    /// Return the spectrum as [`Kernel::new`] does, with buffers of the caller.
    #[must_use]
    pub(crate) fn with_buffers(series: &[f64], buffers: &mut Buffers) -> Self {
        Self::from_plan(fft::plan(fft::fast_length(2 * series.len())), series, buffers)
    }

    /// Return the spectrum of a series, computed by the transform `plan`.
    fn from_plan(plan: Plan, series: &[f64], buffers: &mut Buffers) -> Self {
        let spectrum = vec![Bin::new(0.0, 0.0); plan.bins()];
        let mut kernel = Self { plan, spectrum };
        kernel.read(series.iter().copied(), buffers);
        kernel
    }

    /// Return the spectrum of a zero series of `m` terms.
    pub(crate) fn zeros(m: usize) -> Self {
        let plan = fft::plan(fft::fast_length(2 * m));
        let spectrum = vec![Bin::new(0.0, 0.0); plan.bins()];
        Self { plan, spectrum }
    }

    /// Replace the series by another one of the same length, in place.
    pub(crate) fn read(&mut self, series: impl Iterator<Item = f64>, Buffers { time, workspace, .. }: &mut Buffers) {
        time.clear();
        time.extend(series);
        time.resize(self.plan.len(), 0.0);
        self.plan.transform(time, &mut self.spectrum, workspace);
    }

    /// Write the first `out.len()` terms of the product with `signal` to `out`. The series and `signal` together must
    /// have at most the number of terms for which the spectrum was computed ([`Kernel::with_length`]).
    pub fn apply(&self, signal: &[f64], out: &mut [f64], buffers: &mut Buffers) {
        buffers.time.clear();
        buffers.time.extend_from_slice(signal);
        buffers.time.resize(self.plan.len(), 0.0);
        buffers.spectrum.resize(self.plan.bins(), Bin::new(0.0, 0.0));
        let spectrum = &mut buffers.spectrum[..self.plan.bins()];
        self.plan.transform(&mut buffers.time, spectrum, &mut buffers.workspace);
        for (x, k) in spectrum.iter_mut().zip(&self.spectrum) {
            *x *= k;
        }
        self.plan.inverse(spectrum, &mut buffers.time, &mut buffers.workspace);
        let length = out.len().min(buffers.time.len());
        out[..length].copy_from_slice(&buffers.time[..length]);
    }

    /// Multiply by another series in the frequency domain. Both spectra must be for the same total number of terms, and
    /// the product must not exceed it.
    pub fn multiply(&mut self, other: &Self) {
        self.spectrum.iter_mut().zip(&other.spectrum).for_each(|(x, y)| *x *= y);
    }

    /// Write the first `out.len()` terms of the product with another series of the same length to `out`. Takes one
    /// transform.
    pub fn times(&self, other: &Self, out: &mut [f64], buffers: &mut Buffers) {
        buffers.spectrum.clear();
        buffers.spectrum.extend(self.spectrum.iter().zip(&other.spectrum).map(|(x, y)| x * y));
        buffers.time.resize(self.plan.len(), 0.0);
        let time = &mut buffers.time[..self.plan.len()];
        self.plan.inverse(&mut buffers.spectrum, time, &mut buffers.workspace);
        out.copy_from_slice(&time[..out.len()]);
    }
}

/// Sum of products of series in the frequency domain. All products together need one inverse transform.
pub struct SumOfProducts {
    plan: Plan,
    spectrum: Vec<Bin>,
}

impl SumOfProducts {
    /// Return an empty sum, to which products of two series of m terms can be added.
    #[must_use]
    pub fn new(m: usize) -> Self {
        Self::with_length(2 * m)
    }

    /// Return an empty sum of products whose factors have up to `total` terms together. Three factors of m terms need
    /// 3m.
    #[must_use]
    pub fn with_length(total: usize) -> Self {
        let plan = fft::plan(fft::fast_length(total));
        let spectrum = vec![Bin::new(0.0, 0.0); plan.bins()];
        Self { plan, spectrum }
    }

    /// Reset the sum to zero.
    pub fn clear(&mut self) {
        self.spectrum.fill(Bin::new(0.0, 0.0));
    }

    /// Add a series. Its spectrum must be for the same total number of terms as the sum.
    pub fn add_series(&mut self, series: &Kernel) {
        self.spectrum.iter_mut().zip(&series.spectrum).for_each(|(sum, x)| *sum += x);
    }

    /// Add the product of another sum and a series. All spectra must be for the same total number of terms.
    pub fn add_product(&mut self, other: &Self, series: &Kernel) {
        for ((sum, x), y) in self.spectrum.iter_mut().zip(&other.spectrum).zip(&series.spectrum) {
            *sum += x * y;
        }
    }

    /// Add `weight`·a·b. All spectra must be for the same total number of terms.
    pub fn add(&mut self, weight: f64, a: &Kernel, b: &Kernel) {
        for ((sum, x), y) in self.spectrum.iter_mut().zip(&a.spectrum).zip(&b.spectrum) {
            *sum += x * y * weight;
        }
    }

    /// Write the first `out.len()` terms of the sum to `out`, and reset the sum to zero.
    pub fn take(&mut self, out: &mut [f64], buffers: &mut Buffers) {
        buffers.time.resize(self.plan.len(), 0.0);
        let time = &mut buffers.time[..self.plan.len()];
        self.plan.inverse(&mut self.spectrum, time, &mut buffers.workspace);
        out.copy_from_slice(&time[..out.len()]);
        self.spectrum.fill(Bin::new(0.0, 0.0));
    }
}

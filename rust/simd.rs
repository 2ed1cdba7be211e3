//! SIMD kernels, whose instruction set is chosen at run time. Only this module uses the crate `pulp`.
//!
//! Kernels are loops over arrays of [`LANE_COUNT`] values. They are inlined into [`dispatch_simd`], so that the
//! compiler uses the widest vector instructions of the processor. Multiplications and additions are not fused, and sums
//! are not reordered. A kernel therefore gives the same bits inside and outside [`dispatch_simd`].

use std::sync::atomic::{AtomicBool, Ordering};

use pulp::{Arch, Simd, WithSimd};

/// Number of values that a kernel processes in parallel.
pub const LANE_COUNT: usize = 8;

/// Vector with one value for each of L parallel computations.
pub type Lanes<const L: usize> = [f64; L];

/// Kernel that [`dispatch_simd`] runs with vector instructions.
///
/// `run` and the functions in its inner loops must be `#[inline(always)]`. Code that is not inlined is compiled for the
/// minimum instruction set.
pub trait SimdKernel {
    /// Type of the result.
    type Output;

    /// Run the kernel and return its result.
    fn run(self) -> Self::Output;
}

struct PulpKernel<K>(K);

impl<K: SimdKernel> WithSimd for PulpKernel<K> {
    type Output = K::Output;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> K::Output {
        self.0.run()
    }
}

static USE_PORTABLE: AtomicBool = AtomicBool::new(false);

/// If `is_forced`, make [`dispatch_simd`] run kernels with the minimum instruction set, so that tests can compare both
/// results.
pub fn force_portable(is_forced: bool) {
    USE_PORTABLE.store(is_forced, Ordering::Relaxed);
}

/// Run a kernel with the widest vector instructions of the processor and return its result.
///
/// ```
/// use ftlm::simd::{dispatch_simd, dot, SimdKernel};
///
/// struct Squares<'a>(&'a [f64]);
///
/// impl SimdKernel for Squares<'_> {
///     type Output = f64;
///
///     #[inline(always)]
///     fn run(self) -> f64 {
///         dot(self.0, self.0)
///     }
/// }
///
/// assert_eq!(dispatch_simd(Squares(&[3.0, 4.0])), 25.0);
/// ```
pub fn dispatch_simd<K: SimdKernel>(kernel: K) -> K::Output {
    if USE_PORTABLE.load(Ordering::Relaxed) {
        kernel.run()
    } else {
        Arch::new().dispatch(PulpKernel(kernel))
    }
}

/// Return the dot product Σ a·b of slices of equal length, accumulated in [`LANE_COUNT`] lanes.
/// ```
/// assert_eq!(ftlm::simd::dot(&[1.0, 2.0], &[3.0, 4.0]), 11.0);
/// ```
#[inline(always)]
#[must_use]
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; LANE_COUNT];
    let (a, b) = (a.chunks_exact(LANE_COUNT), b.chunks_exact(LANE_COUNT));
    let rest: f64 = a.remainder().iter().zip(b.remainder()).map(|(x, y)| x * y).sum();
    for (a, b) in a.zip(b) {
        for i in 0..LANE_COUNT {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().sum::<f64>() + rest
}

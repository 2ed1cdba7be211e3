//! Vector instructions chosen at run time; the only user of `pulp`.
//!
//! Kernels are plain loops over arrays of [`WIDTH`] values that are inlined into [`widest`], where the compiler may use
//! the widest instructions of the machine at hand. Nothing is contracted to fused multiply-adds and no sum is
//! reordered, so a kernel gives the same bits whether it runs inside [`widest`] or not.

use std::sync::atomic::{AtomicBool, Ordering};

use pulp::{Arch, Simd, WithSimd};

/// Values that a kernel works on side by side.
pub const WIDTH: usize = 8;

/// One value of each of several computations that run side by side.
pub type Lanes<const L: usize> = [f64; L];

/// A kernel for [`widest`]. `run`, and all of its inner loops' functions, must be `#[inline(always)]`: what the compiler
/// leaves outside is compiled for the oldest machine.
pub trait Kernel {
    /// What it returns.
    type Output;

    /// Does the work.
    fn run(self) -> Self::Output;
}

struct Inlined<K>(K);

impl<K: Kernel> WithSimd for Inlined<K> {
    type Output = K::Output;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> K::Output {
        self.0.run()
    }
}

static PORTABLE: AtomicBool = AtomicBool::new(false);

/// Whether [`widest`] runs kernels as they are compiled for the oldest machine, so that tests can compare the two.
pub fn portable(on: bool) {
    PORTABLE.store(on, Ordering::Relaxed);
}

/// Runs a kernel with the widest vector instructions of this machine.
///
/// ```
/// use ftlm::simd::{dot, widest, Kernel};
///
/// struct Squares<'a>(&'a [f64]);
///
/// impl Kernel for Squares<'_> {
///     type Output = f64;
///
///     #[inline(always)]
///     fn run(self) -> f64 {
///         dot(self.0, self.0)
///     }
/// }
///
/// assert_eq!(widest(Squares(&[3.0, 4.0])), 25.0);
/// ```
pub fn widest<K: Kernel>(kernel: K) -> K::Output {
    if PORTABLE.load(Ordering::Relaxed) {
        kernel.run()
    } else {
        Arch::new().dispatch(Inlined(kernel))
    }
}

/// Σ a·b, summed in [`WIDTH`] lanes that are joined at the end; slices are of one length.
///
/// ```
/// assert_eq!(ftlm::simd::dot(&[1.0, 2.0], &[3.0, 4.0]), 11.0);
/// ```
#[inline(always)]
#[must_use]
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; WIDTH];
    let (a, b) = (a.chunks_exact(WIDTH), b.chunks_exact(WIDTH));
    let rest: f64 = a.remainder().iter().zip(b.remainder()).map(|(x, y)| x * y).sum();
    for (a, b) in a.zip(b) {
        for i in 0..WIDTH {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().sum::<f64>() + rest
}

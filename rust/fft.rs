//! Plans, lengths and scratch for real Fourier transforms; the only user of `realfft`.
//!
//! Transforms are unnormalised forward and divided by their length on the way back, so a product of
//! spectra is a cyclic convolution. Scratch belongs to the caller ([`Workspace`]): plans are shared,
//! workspaces are one per thread.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock};

pub use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};

/// One complex number of a spectrum.
pub type Bin = Complex<f64>;

/// A forward and an inverse real transform of one even length.
#[derive(Clone)]
pub struct Plan {
    len: usize,
    forward: Arc<dyn RealToComplex<f64>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
}

/// Scratch of the transforms of one thread; grows to the largest plan it has met.
#[derive(Default)]
pub struct Workspace {
    scratch: Vec<Bin>,
}

/// Smallest even 5-smooth length that is at least `n`: the lengths at which the transform is fast.
#[must_use]
pub fn fast_length(n: usize) -> usize {
    let mut len = n.max(2);
    loop {
        let mut rest = len;
        for prime in [2, 3, 5] {
            while rest % prime == 0 {
                rest /= prime;
            }
        }
        if rest == 1 && len % 2 == 0 {
            return len;
        }
        len += 1;
    }
}

/// Longest transform whose plan is kept for good; a plan holds some 20 bytes a point.
const KEPT: usize = 1 << 17;
/// Points of all longer ones together beyond which those asked for longest ago are forgotten: a run on ever finer grids
/// would leave the plans of all of them behind. What is forgotten too early costs two transforms once more.
const POINTS: usize = 1 << 22;
/// Those among so many asked for last are in use: one evaluation of a large problem holds more points than these.
const IN_USE: u64 = 32;

/// Plans by length, each with when it was last asked for.
#[derive(Default)]
struct Plans {
    asked: u64,
    made: HashMap<usize, (Plan, u64)>,
}

impl Plans {
    fn of(&mut self, len: usize) -> Plan {
        self.asked += 1;
        let now = self.asked;
        if let Some((plan, last)) = self.made.get_mut(&len) {
            *last = now;
            return plan.clone();
        }
        if len > KEPT {
            self.make_room(POINTS.saturating_sub(len));
        }
        let mut planner = RealFftPlanner::<f64>::new();
        let plan = Plan { len, forward: planner.plan_fft_forward(len), inverse: planner.plan_fft_inverse(len) };
        self.made.insert(len, (plan.clone(), now));
        plan
    }

    /// Forgets long plans, the one asked for longest ago first, until no more points than these are left.
    fn make_room(&mut self, points: usize) {
        let mut long: Vec<(u64, usize)> =
            self.made.iter().map(|(&len, &(_, last))| (last, len)).filter(|&(_, len)| len > KEPT).collect();
        long.sort_unstable();
        let mut held: usize = long.iter().map(|&(_, len)| len).sum();
        for (last, len) in long {
            if held <= points || self.asked - last <= IN_USE {
                break;
            }
            held -= len;
            self.made.remove(&len);
        }
    }
}

/// The plan of a length, shared by all that ask for it; [`fast_length`] gives good ones. Of long ones only the last are
/// kept.
///
/// ```
/// use ftlm::fft::{plan, Complex, Workspace};
/// let plan = plan(4);
/// let (mut time, mut spectrum) = (vec![1.0, 2.0, 3.0, 4.0], vec![Complex::default(); plan.bins()]);
/// plan.forward(&mut time, &mut spectrum, &mut Workspace::new());
/// assert_eq!(spectrum[0], Complex::new(10.0, 0.0));
/// ```
#[must_use]
pub fn plan(len: usize) -> Plan {
    static PLANS: OnceLock<Mutex<Plans>> = OnceLock::new();
    let table = PLANS.get_or_init(Mutex::default);
    // A poisoned table only means that another thread died between two inserts; its content is whole.
    table.lock().unwrap_or_else(std::sync::PoisonError::into_inner).of(len)
}

/// Squared magnitudes of a signal's transform, from frequency 0 to Nyquist's, zero-padded to a fast length.
#[must_use]
pub fn power_spectrum(signal: impl ExactSizeIterator<Item = f64>) -> Vec<f64> {
    let plan = plan(fast_length(signal.len()));
    let mut time: Vec<f64> = signal.collect();
    time.resize(plan.len(), 0.0);
    let mut spectrum = vec![Bin::new(0.0, 0.0); plan.bins()];
    plan.forward(&mut time, &mut spectrum, &mut Workspace::new());
    spectrum.iter().map(Bin::norm_sqr).collect()
}

impl Plan {
    /// Number of real points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Never true: a plan has at least two points.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Number of bins of a spectrum: `len / 2 + 1`.
    #[must_use]
    pub fn bins(&self) -> usize {
        self.len / 2 + 1
    }

    /// Spectrum of `time`, whose content is destroyed. `time` has `len`, `spectrum` has `bins` elements.
    ///
    /// # Panics
    /// For other lengths: a fault of the caller's program, whatever the data.
    pub fn forward(&self, time: &mut [f64], spectrum: &mut [Bin], workspace: &mut Workspace) {
        self.check(time.len(), spectrum.len());
        let scratch = workspace.at_least(self.forward.get_scratch_len());
        // The transform refuses nothing but lengths, which are right.
        let done = self.forward.process_with_scratch(time, spectrum, scratch);
        assert!(done.is_ok(), "the forward transform refused its own lengths");
    }

    fn check(&self, points: usize, bins: usize) {
        assert!(
            points == self.len && bins == self.bins(),
            "a transform of {} points and {} bins was given {points} and {bins}",
            self.len,
            self.bins()
        );
    }

    /// Signal of `spectrum`, divided by the length; the spectrum's content is destroyed.
    ///
    /// # Panics
    /// As [`Plan::forward`].
    pub fn inverse(&self, spectrum: &mut [Bin], time: &mut [f64], workspace: &mut Workspace) {
        self.check(time.len(), spectrum.len());
        // The transform refuses an imaginary part in the two bins that a real signal keeps real.
        if let Some(first) = spectrum.first_mut() {
            first.im = 0.0;
        }
        if self.len % 2 == 0 {
            if let Some(last) = spectrum.last_mut() {
                last.im = 0.0;
            }
        }
        let scratch = workspace.at_least(self.inverse.get_scratch_len());
        let done = self.inverse.process_with_scratch(spectrum, time, scratch);
        assert!(done.is_ok(), "the inverse transform refused its own lengths");
        #[allow(clippy::cast_precision_loss)]
        let scale = 1.0 / self.len as f64;
        for value in time {
            *value *= scale;
        }
    }
}

impl Workspace {
    /// An empty workspace.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    fn at_least(&mut self, len: usize) -> &mut [Bin] {
        if self.scratch.len() < len {
            self.scratch.resize(len, Bin::new(0.0, 0.0));
        }
        &mut self.scratch[..len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_plans_are_forgotten_that_nobody_asks_for() {
        let mut plans = Plans::default();
        let (short, long, next) = (64, POINTS / 2, POINTS / 2 + 2);
        plans.of(short);
        plans.of(long);
        plans.of(next);
        assert!(plans.made.contains_key(&long), "in use");
        for _ in 0..=IN_USE {
            plans.of(short);
        }
        plans.of(next + 2);
        assert!(!plans.made.contains_key(&long) && !plans.made.contains_key(&next));
        assert!(plans.made.contains_key(&short) && plans.made.contains_key(&(next + 2)));
        // Made anew, it is the same.
        let mut spectrum = vec![Bin::new(0.0, 0.0); long / 2 + 1];
        plans.of(long).forward(&mut vec![1.0; long], &mut spectrum, &mut Workspace::new());
        #[allow(clippy::cast_precision_loss)]
        let sum = long as f64;
        assert!((spectrum[0].re - sum).abs() < 1e-6 && spectrum[1].norm() < 1e-6);
    }
}

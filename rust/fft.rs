//! Real fast Fourier transforms: shared plans, fast lengths and scratch memory. Only this module uses the crate
//! `realfft`.
//!
//! Forward transforms are not normalized. Inverse transforms are divided by the length, so the inverse transform of a
//! product of spectra is a cyclic convolution. Plans are shared by all threads. The caller supplies scratch memory: one
//! [`Workspace`] per thread.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::sync::Arc;

use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};

pub use realfft::num_complex::Complex;

use crate::parallel::ForkSafeLock;

/// Complex value of a spectrum at one frequency.
pub type Bin = Complex<f64>;

/// Plan of the forward and the inverse real transform of one length.
#[derive(Clone)]
pub struct Plan {
    len: usize,
    forward: Arc<dyn RealToComplex<f64>>,
    inverse: Arc<dyn ComplexToReal<f64>>,
}

/// Scratch memory for the transforms of one thread. It grows as the largest plan requires.
#[derive(Default)]
pub struct Workspace {
    scratch: Vec<Bin>,
}

/// Return the smallest even length of at least `n` without prime factors above 5. Transforms of these lengths are fast.
#[must_use]
pub fn fast_length(n: usize) -> usize {
    let mut len = n.max(2);
    loop {
        let mut rest = len;
        for prime in [2, 3, 5] {
            while rest.is_multiple_of(prime) {
                rest /= prime;
            }
        }
        if rest == 1 && len.is_multiple_of(2) {
            return len;
        }
        len += 1;
    }
}

/// Maximum length of a transform whose plan is never evicted from the cache. A plan takes about 20 bytes per point.
const MAX_PERMANENT_PLAN_POINTS: usize = 1 << 14;
/// Total number of points of longer plans above which the least recently used plans are evicted.
///
/// Without eviction, the plans of all pulse grids of a repeatedly refined simulation would stay in memory. If a plan is
/// evicted too early, its new computation costs about two transforms.
const MAX_CACHED_PLAN_POINTS: usize = 1 << 20;
/// Number of most recent requests for long plans. The plans of these requests are not evicted, even if the total
/// exceeds the limit. One evaluation of a large problem may need more points than the limit.
const RECENT_REQUEST_COUNT: u64 = 16;

/// Plans by length, each with the number of its last request.
struct Plans {
    request_count: u64,
    plans: BTreeMap<usize, (Plan, u64)>,
}

/// Plans that all threads share. Each thread copies short plans once, so that it does not wait for the lock again.
static SHARED_PLANS: ForkSafeLock<Plans> = ForkSafeLock::new(Plans::new());

thread_local! {
    /// Short plans that this thread requested, and plans that it computed while the lock was unavailable.
    static THREAD_PLANS: RefCell<Plans> = const { RefCell::new(Plans::new()) };
}

impl Plans {
    const fn new() -> Self {
        Self { request_count: 0, plans: BTreeMap::new() }
    }

    fn find(&mut self, len: usize) -> Option<Plan> {
        let (plan, last) = self.plans.get_mut(&len)?;
        if len > MAX_PERMANENT_PLAN_POINTS {
            self.request_count += 1;
            *last = self.request_count;
        }
        Some(plan.clone())
    }

    /// Store a plan, unless there is a plan of the same length. Return the stored plan and the evicted plans.
    ///
    /// The caller drops the evicted plans outside the lock.
    fn insert(&mut self, plan: Plan) -> (Plan, Vec<Plan>) {
        let len = plan.len;
        if let Some(stored) = self.find(len) {
            return (stored, vec![plan]);
        }
        let mut evicted = Vec::new();
        if len > MAX_PERMANENT_PLAN_POINTS {
            self.request_count += 1;
            evicted = self.evict(MAX_CACHED_PLAN_POINTS.saturating_sub(len));
        }
        self.plans.insert(len, (plan.clone(), self.request_count));
        (plan, evicted)
    }

    /// Evict plans longer than [`MAX_PERMANENT_PLAN_POINTS`], the least recently used first, until the remaining long
    /// plans have at most `points` points in total. Recently requested plans are not evicted. Return the evicted plans.
    fn evict(&mut self, points: usize) -> Vec<Plan> {
        let mut long: Vec<(u64, usize)> = self
            .plans
            .iter()
            .map(|(&len, &(_, last))| (last, len))
            .filter(|&(_, len)| len > MAX_PERMANENT_PLAN_POINTS)
            .collect();
        long.sort_unstable();
        let mut stored_points: usize = long.iter().map(|&(_, len)| len).sum();
        let mut evicted = Vec::new();
        for (last, len) in long {
            if stored_points <= points || self.request_count - last <= RECENT_REQUEST_COUNT {
                break;
            }
            stored_points -= len;
            evicted.extend(self.plans.remove(&len).map(|(plan, _)| plan));
        }
        evicted
    }
}

/// Return the plan of the real transforms of `len` points, which all threads share. See [`fast_length`] for fast
/// lengths.
///
/// Long plans that were not used recently are evicted from the cache.
///
/// ```
/// use ftlm::fft::{plan, Complex, Workspace};
/// let plan = plan(4);
/// let (mut time, mut spectrum) = (vec![1.0, 2.0, 3.0, 4.0], vec![Complex::default(); plan.bins()]);
/// plan.transform(&mut time, &mut spectrum, &mut Workspace::new());
/// assert_eq!(spectrum[0], Complex::new(10.0, 0.0));
/// ```
#[must_use]
pub fn plan(len: usize) -> Plan {
    if let Some(plan) = THREAD_PLANS.with_borrow_mut(|plans| plans.find(len)) {
        return plan;
    }
    let (plan, shared) = match SHARED_PLANS.with(|plans| plans.find(len)).flatten() {
        Some(plan) => (plan, true),
        None => {
            // Plans are computed outside the lock. If two threads compute the same one, the later one is dropped.
            let new_plan = Plan::new(len);
            match SHARED_PLANS.with(|plans| plans.insert(new_plan.clone())) {
                Some((plan, _evicted)) => (plan, true),
                None => (new_plan, false),
            }
        }
    };
    if len <= MAX_PERMANENT_PLAN_POINTS || !shared {
        THREAD_PLANS.with_borrow_mut(|plans| plans.insert(plan.clone()));
    }
    plan
}

/// Return the power spectrum of a signal: squared magnitudes from frequency zero to the Nyquist frequency. The signal
/// is zero-padded to a fast length.
#[must_use]
pub fn power_spectrum(signal: impl ExactSizeIterator<Item = f64>) -> Vec<f64> {
    let plan = plan(fast_length(signal.len()));
    let mut time: Vec<f64> = signal.collect();
    time.resize(plan.len(), 0.0);
    let mut spectrum = vec![Bin::new(0.0, 0.0); plan.bins()];
    plan.transform(&mut time, &mut spectrum, &mut Workspace::new());
    spectrum.iter().map(Bin::norm_sqr).collect()
}

impl Plan {
    fn new(len: usize) -> Self {
        let mut planner = RealFftPlanner::<f64>::new();
        Self { len, forward: planner.plan_fft_forward(len), inverse: planner.plan_fft_inverse(len) }
    }

    /// Number of real points of the transform.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Always false: a plan has at least two points.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Number of frequencies of a spectrum: `len / 2 + 1`.
    #[must_use]
    pub fn bins(&self) -> usize {
        self.len / 2 + 1
    }

    /// Transform `time` (`len` values, overwritten) into `spectrum` (`bins` values).
    ///
    /// # Panics
    /// If a length differs from that of the plan, which is a programming error.
    pub fn transform(&self, time: &mut [f64], spectrum: &mut [Bin], workspace: &mut Workspace) {
        self.check(time.len(), spectrum.len());
        let scratch = workspace.scratch(self.forward.get_scratch_len());
        // The transform can only fail on lengths, which were checked.
        let outcome = self.forward.process_with_scratch(time, spectrum, scratch);
        assert!(outcome.is_ok(), "the forward transform refused its own lengths");
    }

    fn check(&self, points: usize, bins: usize) {
        assert!(
            points == self.len && bins == self.bins(),
            "a transform of {} points and {} bins was given {points} and {bins}",
            self.len,
            self.bins()
        );
    }

    /// Compute the inverse transform of `spectrum` (`bins` values, overwritten), divided by the length. Write it to
    /// `time` (`len` values).
    ///
    /// # Panics
    /// If a length differs from that of the plan, which is a programming error.
    pub fn inverse(&self, spectrum: &mut [Bin], time: &mut [f64], workspace: &mut Workspace) {
        self.check(time.len(), spectrum.len());
        // The transform rejects an imaginary part in the two bins that are real for a real signal.
        if let Some(first) = spectrum.first_mut() {
            first.im = 0.0;
        }
        if self.len.is_multiple_of(2)
            && let Some(last) = spectrum.last_mut()
        {
            last.im = 0.0;
        }
        let scratch = workspace.scratch(self.inverse.get_scratch_len());
        let outcome = self.inverse.process_with_scratch(spectrum, time, scratch);
        assert!(outcome.is_ok(), "the inverse transform refused its own lengths");
        #[allow(clippy::cast_precision_loss)]
        let scale = 1.0 / self.len as f64;
        for value in time {
            *value *= scale;
        }
    }
}

impl Workspace {
    /// Workspace without scratch memory, which is allocated on first use.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    fn scratch(&mut self, len: usize) -> &mut [Bin] {
        if self.scratch.len() < len {
            self.scratch.resize(len, Bin::new(0.0, 0.0));
        }
        &mut self.scratch[..len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[allow(clippy::cast_precision_loss)]
    fn is_sound(plan: &Plan) -> bool {
        let mut spectrum = vec![Bin::new(0.0, 0.0); plan.bins()];
        plan.transform(&mut vec![1.0; plan.len()], &mut spectrum, &mut Workspace::new());
        (spectrum[0].re - plan.len() as f64).abs() < 1e-6 && spectrum[1].norm() < 1e-6
    }

    #[test]
    fn unused_long_plans_are_evicted() {
        let mut plans = Plans::new();
        let (short, long, next) = (64, MAX_CACHED_PLAN_POINTS / 2, MAX_CACHED_PLAN_POINTS / 2 + 2);
        let insert = |plans: &mut Plans, len| plans.insert(Plan::new(len)).1.len();
        for len in [short, long, next] {
            assert_eq!(insert(&mut plans, len), 0, "in use");
        }
        for _ in 0..=RECENT_REQUEST_COUNT {
            assert!(plans.find(short).is_some() && plans.find(next).is_some());
        }
        assert_eq!(insert(&mut plans, next + 2), 1);
        assert!(plans.find(long).is_none() && plans.find(next).is_some() && plans.find(short).is_some());
        // A plan that is computed again works.
        assert!(is_sound(&plan(long)));
    }

    #[test]
    fn first_of_two_plans_of_a_length_is_kept() {
        let mut plans = Plans::new();
        let (first, _) = plans.insert(Plan::new(64));
        let (first_plan, dropped) = plans.insert(Plan::new(64));
        assert!(Arc::ptr_eq(&first.forward, &first_plan.forward) && dropped.len() == 1);
    }

    #[test]
    fn locked_cache_does_not_block_plans() {
        for len in [90, MAX_PERMANENT_PLAN_POINTS + 2] {
            let (first, second) = SHARED_PLANS.hold_during(|| (plan(len), plan(len)));
            assert!(is_sound(&first));
            assert!(Arc::ptr_eq(&first.forward, &second.forward), "plans once");
        }
    }
}

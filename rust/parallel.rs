//! Parallel execution: parallel map, thread pool of one search, fork-safe locks and cancellation.
//!
//! A global thread pool hangs after a fork. Work therefore runs on the thread pool of the current search, or serially
//! if there is none.
//!
//! After a fork, the child process has one thread. A lock that another thread had taken stays locked forever. A thread
//! therefore tries to take a fork-safe lock only for some microseconds, which is far longer than any thread holds it.
//! After that, the caller continues without the value.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError, TryLockError};

use rayon::prelude::*;

use crate::error::{Error, Result};

/// Apply `work` to each item, in parallel if the caller runs in a thread pool.
///
/// The results are in the sequence of the items. `scratch` creates scratch memory, which a thread reuses for its items.
/// `work` must give the same result for any scratch memory, so that results do not depend on the number of threads.
pub(crate) fn map<T, S, R>(
    items: Vec<T>,
    scratch: impl Fn() -> S + Sync + Send,
    work: impl Fn(&mut S, T) -> R + Sync + Send,
) -> Vec<R>
where
    T: Send,
    R: Send,
{
    if rayon::current_thread_index().is_some() {
        items.into_par_iter().map_init(scratch, work).collect()
    } else {
        let mut scratch = scratch();
        items.into_iter().map(|item| work(&mut scratch, item)).collect()
    }
}

/// Maximum number of threads of a search.
pub const MAX_THREADS: usize = 1024;

/// Build a thread pool for one search. A global thread pool would hang after a fork.
///
/// # Errors
/// [`Error::OutOfRange`] for a number outside 1 to [`MAX_THREADS`], [`Error::Threads`] if the system cannot start the
/// threads.
///
/// ```
/// # use ftlm::parallel::pool;
/// assert_eq!(pool(2)?.current_num_threads(), 2);
/// assert!(pool(0).is_err());
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn pool(threads: usize) -> Result<rayon::ThreadPool> {
    if threads == 0 || threads > MAX_THREADS {
        #[allow(clippy::cast_precision_loss)]
        return Err(Error::OutOfRange {
            name: "threads".into(),
            value: threads as f64,
            range: format!("[1, {MAX_THREADS}]"),
            remedy: "use about the number of cores".into(),
        });
    }
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|i| format!("ftlm-search-{i}"))
        .build()
        .map_err(|e| Error::Threads { threads, reason: e.to_string() })
}

/// Workspaces for the threads of a pool, one per thread.
pub(crate) struct PerThread<T>(Vec<Mutex<T>>);

impl<T: Default> PerThread<T> {
    pub(crate) fn new(pool: &rayon::ThreadPool) -> Self {
        Self((0..pool.current_num_threads().max(1)).map(|_| Mutex::default()).collect())
    }

    /// Number of workspaces, which is the number of threads.
    pub(crate) fn len(&self) -> usize {
        self.0.len()
    }

    /// Apply a function to the workspace of the current thread and return its result.
    pub(crate) fn with<R>(&self, work: impl FnOnce(&mut T) -> R) -> R {
        let thread = rayon::current_thread_index().unwrap_or(0) % self.0.len();
        let mut memory = self.0[thread].lock().unwrap_or_else(PoisonError::into_inner);
        work(&mut memory)
    }
}

/// Maximum number of attempts to take a lock. The caller then continues without the value.
const MAX_LOCK_ATTEMPTS: usize = 128;
const SPIN_LOCK_ATTEMPTS: usize = 64;

/// Value behind a lock that is tried a limited number of times, so that a caller never waits forever after a fork.
pub(crate) struct ForkSafeLock<T>(Mutex<T>);

impl<T> ForkSafeLock<T> {
    pub(crate) const fn new(value: T) -> Self {
        Self(Mutex::new(value))
    }

    /// Apply `work`, which must be short, to the value and return its result. None if the lock cannot be taken.
    pub(crate) fn with<R>(&self, work: impl FnOnce(&mut T) -> R) -> Option<R> {
        for attempt in 0..MAX_LOCK_ATTEMPTS {
            match self.0.try_lock() {
                Ok(mut value) => return Some(work(&mut value)),
                // Poison means that another thread panicked, which leaves the values intact.
                Err(TryLockError::Poisoned(value)) => return Some(work(&mut value.into_inner())),
                Err(TryLockError::WouldBlock) if attempt < SPIN_LOCK_ATTEMPTS => std::hint::spin_loop(),
                Err(TryLockError::WouldBlock) => std::thread::yield_now(),
            }
        }
        None
    }

    /// Hold the lock during `work`, like a thread that does not survive a fork.
    #[cfg(test)]
    pub(crate) fn hold_during<R>(&self, work: impl FnOnce() -> R) -> R {
        let _value = self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        work()
    }
}

/// Cancellation flag. Any thread may set it, and the computing thread polls it. Clones share the flag.
///
/// ```
/// let stop = ftlm::parallel::Stop::default();
/// assert!(stop.clone().check().is_ok());
/// stop.set();
/// assert!(stop.is_set() && stop.check().is_err());
/// ```
#[derive(Debug, Clone, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Request cancellation.
    pub fn set(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// True if cancellation was requested.
    #[must_use]
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// Return an error if cancellation was requested.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a stop request.
    pub fn check(&self) -> Result<()> {
        if self.is_set() {
            Err(Error::Interrupted)
        } else {
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::ForkSafeLock;

    #[test]
    #[allow(clippy::panic)]
    fn unavailable_lock_is_bypassed() {
        let shared = ForkSafeLock::new(3);
        assert_eq!(shared.with(|value| *value), Some(3));
        assert_eq!(shared.hold_during(|| shared.with(|value| *value)), None);
        assert_eq!(shared.with(|value| *value), Some(3));
        let fault = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            shared.with(|_| std::panic::panic_any("on purpose"));
        }));
        assert!(fault.is_err());
        assert_eq!(shared.with(|value| *value), Some(3), "a thread that died leaves it to the others");
    }
}

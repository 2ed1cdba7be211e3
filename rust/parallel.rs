//! Work on the threads of the pool at hand; one after the other where there is none, since a global pool hangs after a fork.
//!
//! The thread pool of one search, and memory that each of its threads reuses.
//!
//! What all threads share and none waits for.
//!
//! After a fork the child has one thread and every lock as it was: one that another thread held stays locked for good.
//! So a lock here is tried for some microseconds, far longer than it is ever held, and then done without.
//!
//! A computation that is told to stop.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError, TryLockError};

use rayon::prelude::*;

use crate::error::{Error, Result};

/// What each item comes to, in the order of the items; each thread reuses its scratch. What an item comes to must not
/// depend on the scratch: results are the same for any number of threads.
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

/// Most threads a search starts.
pub const MAX_THREADS: usize = 1024;

/// A thread pool of its own for one search: a global one hangs after a fork.
///
/// # Errors
/// [`Error::OutOfRange`] for a number outside 1 to [`MAX_THREADS`], [`Error::Threads`] where the system starts no more.
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
        .map_err(|e| Error::Threads { threads, why: e.to_string() })
}

/// One memory a thread.
pub(crate) struct PerThread<T>(Vec<Mutex<T>>);

impl<T: Default> PerThread<T> {
    pub(crate) fn new(pool: &rayon::ThreadPool) -> Self {
        Self((0..pool.current_num_threads().max(1)).map(|_| Mutex::default()).collect())
    }

    /// Number of threads.
    pub(crate) fn len(&self) -> usize {
        self.0.len()
    }

    /// Works with the memory of the thread at hand.
    pub(crate) fn with<R>(&self, work: impl FnOnce(&mut T) -> R) -> R {
        let thread = rayon::current_thread_index().unwrap_or(0) % self.0.len();
        let mut memory = self.0[thread].lock().unwrap_or_else(PoisonError::into_inner);
        work(&mut memory)
    }
}

/// How often a lock is tried before it is done without, and how many of these tries keep the processor.
const TRIES: usize = 128;
const SPINS: usize = 64;

/// A value behind a lock that nobody waits for.
pub(crate) struct Shared<T>(Mutex<T>);

impl<T> Shared<T> {
    pub(crate) const fn new(value: T) -> Self {
        Self(Mutex::new(value))
    }

    /// What a short piece of work on the value comes to; none where its lock is not to be had.
    pub(crate) fn with<R>(&self, work: impl FnOnce(&mut T) -> R) -> Option<R> {
        for turn in 0..TRIES {
            match self.0.try_lock() {
                Ok(mut value) => return Some(work(&mut value)),
                // Only means that another thread died at its work, which leaves values whole.
                Err(TryLockError::Poisoned(value)) => return Some(work(&mut value.into_inner())),
                Err(TryLockError::WouldBlock) if turn < SPINS => std::hint::spin_loop(),
                Err(TryLockError::WouldBlock) => std::thread::yield_now(),
            }
        }
        None
    }

    /// Holds the lock while something is done, as a thread does that a fork does not take along.
    #[cfg(test)]
    pub(crate) fn held<R>(&self, meanwhile: impl FnOnce() -> R) -> R {
        let _value = self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        meanwhile()
    }
}

/// Set from any thread, looked at by the one that computes; its clones are the same stop.
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
    /// Tells whoever looks to stop.
    pub fn set(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether it was told.
    #[must_use]
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// Refuses to go on once it was told.
    ///
    /// # Errors
    /// [`Error::Interrupted`].
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
    use super::Shared;

    #[test]
    #[allow(clippy::panic)]
    fn a_lock_that_is_held_is_done_without() {
        let shared = Shared::new(3);
        assert_eq!(shared.with(|value| *value), Some(3));
        assert_eq!(shared.held(|| shared.with(|value| *value)), None);
        assert_eq!(shared.with(|value| *value), Some(3));
        let fault = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            shared.with(|_| std::panic::panic_any("on purpose"));
        }));
        assert!(fault.is_err());
        assert_eq!(shared.with(|value| *value), Some(3), "a thread that died leaves it to the others");
    }
}

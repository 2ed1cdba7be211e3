//! The thread pool of one search, and memory that each of its threads reuses.

use std::sync::{Mutex, PoisonError};

use crate::error::{Error, Result};

/// Most threads a search starts.
pub const MAX_THREADS: usize = 1024;

/// A thread pool of its own for one search: a global one hangs after a fork.
///
/// # Errors
/// [`Error::OutOfRange`] for a number outside 1 to [`MAX_THREADS`], [`Error::Threads`] where the system starts no more.
///
/// ```
/// # use ftlm::threads::pool;
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

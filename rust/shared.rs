//! What all threads share and none waits for.
//!
//! After a fork the child has one thread and every lock as it was: one that another thread held stays locked for good.
//! So a lock here is tried for some microseconds, far longer than it is ever held, and then done without.

use std::sync::{Mutex, TryLockError};

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

//! Work on the threads of the pool at hand; one after the other where there is none, since a global pool hangs after a fork.

use rayon::prelude::*;

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

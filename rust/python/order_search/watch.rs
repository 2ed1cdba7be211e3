//! Interruptible computation: work on a separate thread, polling of Python signals, progress and checkpoints.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{channel, RecvTimeoutError};
use std::time::Duration;

use pyo3::prelude::*;

use super::arguments::checkpoint_to_tuple;
use crate::error::Error;
use crate::order_search::control::Control;
use crate::parallel;
use crate::python::errors::{catch_panic, run_attached, run_detached};

/// Interval between two polls of Python signals. It is well below the half second within which Ctrl-C must end a
/// search.
const SIGNAL_POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Run `work` on a separate thread and return its result. Meanwhile the calling thread polls Python signals and calls
/// `progress` with (candidates done, total, pruned).
pub fn run_watched<T: Send>(
    py: Python<'_>,
    progress: Option<&Py<PyAny>>,
    work: impl FnOnce(&Control) -> Result<T, Error> + Send,
) -> PyResult<T> {
    run_checkpointed(py, progress, None, work)
}

/// Run `work` like [`run_watched`]. At every poll of the signals, call `save` with the latest checkpoint, or with None
/// if there is no new one.
pub fn run_checkpointed<T: Send>(
    py: Python<'_>,
    progress: Option<&Py<PyAny>>,
    save: Option<&Py<PyAny>>,
    work: impl FnOnce(&Control) -> Result<T, Error> + Send,
) -> PyResult<T> {
    let control = Control::default();
    control.makes_checkpoints.store(save.is_some(), Ordering::Relaxed);
    let result = py.detach(|| {
        std::thread::scope(|scope| {
            let (finished, wait) = channel::<()>();
            let worker = scope.spawn(|| {
                let result = catch_panic(|| work(&control));
                drop(finished);
                result
            });
            let mut raised: Option<PyErr> = None;
            while let Err(RecvTimeoutError::Timeout) = wait.recv_timeout(SIGNAL_POLL_INTERVAL) {
                let callbacks = Python::attach(|py| {
                    py.check_signals()?;
                    // Before the search has counted its candidates, there is no total to report.
                    if let Some(progress) = progress.filter(|_| progress_counts(&control).1 > 0) {
                        progress.call1(py, progress_counts(&control))?;
                    }
                    if let Some(save) = save {
                        save.call1(py, (control.take_checkpoint().map(checkpoint_to_tuple),))?;
                    }
                    Ok::<_, PyErr>(())
                });
                if let Err(error) = callbacks {
                    control.stop.set();
                    raised.get_or_insert(error);
                }
            }
            let result = worker
                .join()
                .unwrap_or_else(|_| Err(Error::Internal { what: "the search thread ended without a result".into() }));
            match raised {
                Some(error) => Err(error),
                None => result.map_err(PyErr::from),
            }
        })
    })?;
    if let Some(progress) = progress {
        progress.call1(py, progress_counts(&control))?;
    }
    Ok(result)
}

/// Maximum number of points that are processed without a separate thread. This takes less time than one polling
/// interval.
const MAX_INLINE_POINTS: usize = 1 << 17;

/// Cancellation flag for computations on threads that Ctrl-C does not interrupt.
#[pyclass(module = "ftlm._core", frozen)]
#[derive(Clone, Default)]
pub struct Stop(parallel::Stop);

#[pymethods]
impl Stop {
    #[new]
    fn new() -> PyResult<Self> {
        run_attached(|| Ok(Self::default()))
    }

    /// Cancel all current and later computations that use this flag.
    fn set(&self) -> PyResult<()> {
        run_attached(|| {
            self.0.set();
            Ok(())
        })
    }

    /// True if the flag is set.
    #[getter]
    fn is_set(&self) -> PyResult<bool> {
        run_attached(|| Ok(self.0.is_set()))
    }
}

/// Run `work` on `points` values and return its result. Ctrl-C or a set flag makes the call return without delay.
///
/// Transforms of millions of points cannot be stopped, so their thread is not joined. The thread ends at the next check
/// for cancellation and does not access Python.
pub fn run_interruptible<T: Send + 'static>(
    py: Python<'_>,
    points: usize,
    flag: Option<&Stop>,
    work: impl FnOnce(&parallel::Stop) -> Result<T, Error> + Send + 'static,
) -> PyResult<T> {
    let stop = flag.cloned().unwrap_or_default().0;
    if points < MAX_INLINE_POINTS {
        return run_detached(py, || work(&stop));
    }
    py.detach(|| {
        let (send, receive) = channel();
        let stop_copy = stop.clone();
        // If the call has returned early, there is no receiver.
        std::thread::spawn(move || drop(send.send(catch_panic(|| work(&stop_copy)))));
        loop {
            match receive.recv_timeout(SIGNAL_POLL_INTERVAL) {
                Ok(result) => return result.map_err(PyErr::from),
                Err(RecvTimeoutError::Timeout) => {
                    if let Err(error) = Python::attach(|py| py.check_signals()) {
                        stop.set();
                        return Err(error);
                    }
                    stop.check()?;
                }
                Err(RecvTimeoutError::Disconnected) => {
                    let what = "a computing thread ended without a result".into();
                    return Err(Error::Internal { what }.into());
                }
            }
        }
    })
}

/// Message of a computing thread: its progress (steps done, all steps), or its result.
enum WorkerMessage<T> {
    Progress(usize, usize),
    Result(Result<T, Error>),
}

/// Progress callback with the arguments (steps done, all steps).
pub type Report<'a> = &'a dyn Fn(usize, usize) -> Result<(), Error>;

/// Run `work` like [`run_interruptible`], but always on a separate thread, which reports its progress.
///
/// `progress` is called on the calling thread, so the computing thread does not access Python. An exception of
/// `progress` stops the computation.
pub fn run_with_progress<T: Send + 'static>(
    py: Python<'_>,
    flag: Option<&Stop>,
    progress: Option<&Py<PyAny>>,
    work: impl FnOnce(&parallel::Stop, Report<'_>) -> Result<T, Error> + Send + 'static,
) -> PyResult<T> {
    let stop = flag.cloned().unwrap_or_default().0;
    py.detach(|| {
        let (send, receive) = channel();
        let stop_copy = stop.clone();
        // If the call has returned early, there is no receiver.
        std::thread::spawn(move || {
            let report = |count, of| send.send(WorkerMessage::Progress(count, of)).map_err(|_| Error::Interrupted);
            let result = catch_panic(|| work(&stop_copy, &report));
            drop(send.send(WorkerMessage::Result(result)));
        });
        loop {
            let outcome = match receive.recv_timeout(SIGNAL_POLL_INTERVAL) {
                Ok(WorkerMessage::Result(result)) => return result.map_err(PyErr::from),
                Ok(WorkerMessage::Progress(count, of)) => {
                    Python::attach(|py| progress.map_or(Ok(()), |progress| progress.call1(py, (count, of)).map(drop)))
                }
                Err(RecvTimeoutError::Timeout) => Python::attach(|py| py.check_signals()),
                Err(RecvTimeoutError::Disconnected) => {
                    let what = "a computing thread ended without a result".into();
                    return Err(Error::Internal { what }.into());
                }
            };
            if let Err(error) = outcome {
                stop.set();
                return Err(error);
            }
            stop.check()?;
        }
    })
}

/// Return the progress of a search: (candidates done, total, pruned).
fn progress_counts(control: &Control) -> (u64, u64, u64) {
    let read = |x: &AtomicU64| x.load(Ordering::Relaxed);
    (read(&control.finished_count), read(&control.total), read(&control.pruned))
}

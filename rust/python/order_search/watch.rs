//! Runs a computation on a thread of its own, so that Python can stop it and see how far it is.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{channel, Receiver, RecvTimeoutError, Sender};
use std::time::Duration;

use pyo3::prelude::*;

use super::arguments::checkpoint_of;
use crate::error::Error;
use crate::order_search::control::Control;
use crate::parallel;
use crate::python::errors::{attached, caught, detached};

/// How often Python is asked for signals: well under the half second after which Ctrl-C must have ended a search.
const LOOK: Duration = Duration::from_millis(50);

/// Runs `work` on a thread of its own, so that this one can watch for signals and report progress.
pub fn watched<T: Send>(
    py: Python<'_>,
    progress: Option<&Py<PyAny>>,
    work: impl FnOnce(&Control) -> Result<T, Error> + Send,
) -> PyResult<T> {
    saved(py, progress, None, work)
}

/// As [`watched`]; whenever Python is asked for signals, `save` is called with the latest checkpoint, or with None.
pub fn saved<T: Send>(
    py: Python<'_>,
    progress: Option<&Py<PyAny>>,
    save: Option<&Py<PyAny>>,
    work: impl FnOnce(&Control) -> Result<T, Error> + Send,
) -> PyResult<T> {
    let control = Control::default();
    control.saving.store(save.is_some(), Ordering::Relaxed);
    let result = py.detach(|| {
        std::thread::scope(|scope| {
            let (finished, wait) = channel::<()>();
            let worker = scope.spawn(|| {
                let result = caught(|| work(&control));
                drop(finished);
                result
            });
            let mut raised: Option<PyErr> = None;
            while let Err(RecvTimeoutError::Timeout) = wait.recv_timeout(LOOK) {
                let look = Python::attach(|py| {
                    py.check_signals()?;
                    if let Some(progress) = progress {
                        progress.call1(py, state(&control))?;
                    }
                    if let Some(save) = save {
                        save.call1(py, (control.take().map(checkpoint_of),))?;
                    }
                    Ok::<_, PyErr>(())
                });
                if let Err(error) = look {
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
        progress.call1(py, state(&control))?;
    }
    Ok(result)
}

/// Work on fewer points, each as often as it is gone through, takes less time than Python's signals are asked for, and no
/// thread.
const SHORT: usize = 1 << 17;

/// A flag that ends what was given it: [`leavable`] work on other threads than the one that Ctrl-C interrupts.
#[pyclass(module = "ftlm._core", frozen)]
#[derive(Clone, Default)]
pub struct Stop(parallel::Stop);

#[pymethods]
impl Stop {
    #[new]
    fn new() -> PyResult<Self> {
        attached(|| Ok(Self::default()))
    }

    /// Ends what was given this flag, now and later.
    fn set(&self) -> PyResult<()> {
        attached(|| {
            self.0.set();
            Ok(())
        })
    }

    /// Whether it was set.
    #[getter]
    fn is_set(&self) -> PyResult<bool> {
        attached(|| Ok(self.0.is_set()))
    }
}

/// Runs `work` on `points` values so that Ctrl-C, or a flag that is set, returns at once: transforms of millions of points
/// cannot be stopped, so their thread is left behind. It ends where `work` next looks at whether it was told to stop, and
/// touches no Python.
pub fn leavable<T: Send + 'static>(
    py: Python<'_>,
    points: usize,
    flag: Option<&Stop>,
    work: impl FnOnce(&parallel::Stop) -> Result<T, Error> + Send + 'static,
) -> PyResult<T> {
    let stop = flag.cloned().unwrap_or_default().0;
    if points < SHORT {
        return detached(py, || work(&stop));
    }
    py.detach(|| {
        let (send, receive) = channel();
        let told = stop.clone();
        // One that is left behind has nobody to send to.
        std::thread::spawn(move || drop(send.send(caught(|| work(&told)))));
        loop {
            match receive.recv_timeout(LOOK) {
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

/// What a computing thread asks of Python while it computes: questions go out, answers come in.
pub struct Desk<Q, A, T> {
    tell: Sender<Told<Q, T>>,
    answers: Receiver<Result<A, Error>>,
}

enum Told<Q, T> {
    Asks(Q),
    Ends(Result<T, Error>),
}

impl<Q, A, T> Desk<Q, A, T> {
    /// Asks, and waits for the answer.
    ///
    /// # Errors
    /// [`Error::Source`] where Python raised an error of ftlm's own, [`Error::Interrupted`] where it raised another one, or
    /// nobody is left to answer.
    pub fn ask(&self, question: Q) -> Result<A, Error> {
        self.tell.send(Told::Asks(question)).map_err(|_| Error::Interrupted)?;
        self.answers.recv().unwrap_or(Err(Error::Interrupted))
    }
}

/// As [`leavable`], but on a thread of its own whatever it takes, which may ask Python: answers are given on the thread
/// that called, so that one that is left behind touches no Python. What Python raised comes out where `work` ends by it.
pub fn served<T: Send + 'static, Q: Send + 'static, A: Send + 'static>(
    py: Python<'_>,
    flag: Option<&Stop>,
    answer: impl Fn(Python<'_>, Q) -> PyResult<A> + Send + Sync,
    work: impl FnOnce(&parallel::Stop, &Desk<Q, A, T>) -> Result<T, Error> + Send + 'static,
) -> PyResult<T> {
    let stop = flag.cloned().unwrap_or_default().0;
    py.detach(|| {
        let (tell, hear) = channel();
        let (reply, answers) = channel();
        let (told, desk) = (stop.clone(), Desk { tell: tell.clone(), answers });
        // One that is left behind has nobody to send to.
        std::thread::spawn(move || drop(tell.send(Told::Ends(caught(|| work(&told, &desk))))));
        let mut raised: Option<PyErr> = None;
        loop {
            match hear.recv_timeout(LOOK) {
                Ok(Told::Ends(Err(Error::Source { why }))) => {
                    return Err(raised.unwrap_or_else(|| Error::Source { why }.into()));
                }
                Ok(Told::Ends(result)) => return result.map_err(PyErr::from),
                Ok(Told::Asks(question)) => {
                    let answered = Python::attach(|py| match answer(py, question) {
                        Err(error) if own(py, &error)? => {
                            let why = error.value(py).to_string();
                            raised = Some(error);
                            Ok(Err(Error::Source { why }))
                        }
                        answered => answered.map(Ok),
                    });
                    match answered {
                        Ok(answered) => drop(reply.send(answered)),
                        Err(error) => {
                            stop.set();
                            return Err(error);
                        }
                    }
                }
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

/// Whether an exception is one of ftlm's own, which a computation may go round.
fn own(py: Python<'_>, error: &PyErr) -> PyResult<bool> {
    Ok(error.is_instance(py, &py.import("ftlm.errors")?.getattr("FtlmError")?))
}

/// Candidates done, in all, and left before the end of the record.
fn state(control: &Control) -> (u64, u64, u64) {
    let read = |x: &AtomicU64| x.load(Ordering::Relaxed);
    (read(&control.done), read(&control.total), read(&control.pruned))
}

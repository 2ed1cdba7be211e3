//! Python exceptions: one class for each category of errors. A panic becomes InternalError.

use std::panic::{catch_unwind, AssertUnwindSafe};

use pyo3::exceptions::{PyKeyboardInterrupt, PyRuntimeError};
use pyo3::prelude::*;
use pyo3::types::PyType;

use crate::error::{Error, Kind};

impl From<Error> for PyErr {
    fn from(error: Error) -> Self {
        let class = match error.kind() {
            Kind::Data => "DataError",
            Kind::Model => "ModelError",
            Kind::Convergence => "ConvergenceError",
            Kind::Internal => "InternalError",
            Kind::Interrupted => return PyKeyboardInterrupt::new_err(()),
        };
        let message = match error {
            // The limit of a search is an argument in Rust, and an environment variable here.
            Error::Memory { .. } => format!("{error} by FTLM_MEMORY"),
            _ => error.to_string(),
        };
        raise(class, message)
    }
}

fn raise(class: &str, message: String) -> PyErr {
    Python::attach(|py| {
        let class_object = py.import("ftlm.errors").and_then(|m| m.getattr(class));
        match class_object.and_then(|c| c.cast_into::<PyType>().map_err(PyErr::from)) {
            Ok(class) => PyErr::from_type(class, message),
            Err(_) => PyRuntimeError::new_err(message),
        }
    })
}

/// Run a computation of the core without the Python interpreter lock. A panic becomes InternalError.
///
/// Every `#[pyfunction]` and every method converts its arguments, and then calls this function or [`run_attached`] one
/// time. `tests/rust/bindings.rs` checks this rule.
pub fn run_detached<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T, Error> + Send) -> PyResult<T> {
    Ok(py.detach(|| catch_panic(work))?)
}

/// Run `work` that takes microseconds without releasing the Python interpreter lock, because the release would take
/// longer. A panic becomes InternalError.
pub fn run_attached<T>(work: impl FnOnce() -> Result<T, Error>) -> PyResult<T> {
    Ok(catch_panic(work)?)
}

/// Run `work` and convert a panic to [`Error::Internal`].
pub fn catch_panic<T>(work: impl FnOnce() -> Result<T, Error>) -> Result<T, Error> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let what = panic
            .downcast_ref::<&str>()
            .map(ToString::to_string)
            .or_else(|| panic.downcast_ref::<String>().cloned())
            .unwrap_or_else(|| "a panic without a message".into());
        Err(Error::Internal { what })
    })
}

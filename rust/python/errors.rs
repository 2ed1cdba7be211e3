//! One Python exception class for each family of errors, and panics turned into InternalError.

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
        raise(class, error.to_string())
    }
}

fn raise(class: &str, message: String) -> PyErr {
    Python::attach(|py| {
        let found = py.import("ftlm.errors").and_then(|m| m.getattr(class));
        match found.and_then(|c| c.cast_into::<PyType>().map_err(PyErr::from)) {
            Ok(class) => PyErr::from_type(class, message),
            Err(_) => PyRuntimeError::new_err(message),
        }
    })
}

/// The one way into the core for what computes: runs detached from Python; a panic becomes InternalError.
///
/// Every `#[pyfunction]` and every method converts its arguments and then makes a single call of this or of [`attached`];
/// `tests/rust/bindings.rs` sees to it.
pub fn detached<T: Send>(py: Python<'_>, work: impl FnOnce() -> Result<T, Error> + Send) -> PyResult<T> {
    Ok(py.detach(|| caught(work))?)
}

/// The one way in for what takes microseconds, between two samples of a rig say, where letting go of Python would cost
/// more than the work: runs attached; a panic becomes InternalError.
pub fn attached<T>(work: impl FnOnce() -> Result<T, Error>) -> PyResult<T> {
    Ok(caught(work)?)
}

/// Runs; a panic becomes [`Error::Internal`].
pub fn caught<T>(work: impl FnOnce() -> Result<T, Error>) -> Result<T, Error> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let what = panic
            .downcast_ref::<&str>()
            .map(ToString::to_string)
            .or_else(|| panic.downcast_ref::<String>().cloned())
            .unwrap_or_else(|| "a panic without a message".into());
        Err(Error::Internal { what })
    })
}

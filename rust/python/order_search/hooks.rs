//! What tests turn and provoke: the instructions that kernels run with, and panics.

use pyo3::prelude::*;

use super::watch::watched;
use crate::python::errors::detached;
use crate::threads::pool;

/// Panics where it is told to, so that a test can see what becomes of a panic: in a call, in the thread that a search
/// runs on, or in one of its workers.
#[pyfunction]
#[allow(clippy::panic)]
pub fn panic_on_purpose(py: Python<'_>, place: &str) -> PyResult<()> {
    let fault = || std::panic::panic_any("on purpose");
    match place {
        "call" => detached(py, fault),
        "search" => watched(py, None, |_| fault()),
        _ => watched(py, None, |_| pool(2)?.install(|| rayon::join(fault, || ()).0)),
    }
}

/// Whether kernels run as they are compiled for the oldest machine.
#[pyfunction]
pub fn portable(on: bool) {
    crate::simd::portable(on);
}

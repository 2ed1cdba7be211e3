//! Certificates of equation errors over whole intervals of orders.

use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::watch::watched;
use crate::order_search::certificate::{self, Asked, Range, Region};
use crate::python::convert::{records, RecordArg};
use crate::python::lists::List;

/// (output, interval of alpha, [(signal, lowest, highest), …], apart).
type RegionTuple = (usize, (f64, f64), List<(usize, f64, f64)>, f64);

/// (within, largest, cells, threads, bytes of memory).
type AskedTuple = (f64, f64, u64, usize, u64);

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn certify<'py>(
    py: Python<'py>,
    runs: List<RecordArg<'py>>,
    region: RegionTuple,
    asked: AskedTuple,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let records = records(&runs)?;
    let (output, alpha, terms, apart) = region;
    let terms = terms.iter().map(|&(signal, lowest, highest)| Range { signal, lowest, highest }).collect();
    let region = Region { output, alpha, terms, apart };
    let (within, largest, cells, threads, memory) = asked;
    let asked = Asked { within, largest, cells, threads, memory };
    let found = watched(py, progress.as_ref(), |control| certificate::certify(&records, &region, &asked, control))?;
    let dict = PyDict::new(py);
    dict.set_item("at_least", found.at_least)?;
    dict.set_item("best", found.best)?;
    dict.set_item("alpha", found.order)?;
    dict.set_item("orders", found.orders)?;
    dict.set_item("cells", found.cells)?;
    dict.set_item("open", found.open)?;
    Ok(dict)
}

//! Bindings of the order search: grid search, batches, certificates, given points, test hooks.

use std::borrow::Cow;

use numpy::{PyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::arguments::{
    checkpoint_from_tuple, counts_to_dict, failure_name, part_from_tuple, part_to_tuple, CheckpointArg, OrdersArg,
    PartArg, SearchInputs, SettingsArg,
};
use super::watch::{run_checkpointed, run_watched};
use crate::error::check_length;
use crate::order_search::batches;
use crate::order_search::certificate::{self, CertificateOptions, Range, Region};
use crate::order_search::control::mismatch_error;
use crate::order_search::given_points::{Point, Points as GivenPoints};
use crate::order_search::grid::independent::OrderGrid;
use crate::order_search::options::Norm;
use crate::order_search::result::{Counts, Outcome, Part, Row};
use crate::parallel::pool;
use crate::python::convert::{check_size, column_count, records, InitialArg, List, RecordArg};
use crate::python::errors::run_detached;

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn order_grid_size(py: Python<'_>, orders: OrdersArg, inputs: List<bool>) -> PyResult<u64> {
    run_detached(py, || Ok(orders.grid(&inputs)?.count()))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn search<'py>(
    py: Python<'py>,
    runs: List<RecordArg<'py>>,
    orders: OrdersArg,
    inputs: List<bool>,
    fixed: List<Option<f64>>,
    terms: InitialArg,
    settings: SettingsArg,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let mut arguments = SearchInputs::new(&runs, inputs, fixed, terms, settings)?;
    let result = run_watched(py, progress.as_ref(), |control| {
        let grid = orders.grid(&arguments.inputs)?;
        let records = arguments.records(control)?;
        Ok(OrderTable::new(&grid, batches::search(&records, &grid, &arguments.fixed, &arguments.options, control)?))
    })?;
    result.dict(py)
}

/// Row of a result table. `initial` holds the coefficients of the initial terms by record.
#[derive(IntoPyObject)]
struct FoundRow {
    index: u64,
    score: f64,
    alpha: f64,
    orders: Vec<f64>,
    coefficients: Vec<f64>,
    initial: Vec<Vec<f64>>,
}

/// Result table of a search, with counts, and (index, alpha, orders, reason) of each failure.
struct OrderTable {
    rows: Vec<FoundRow>,
    counts: Counts,
    failures: Vec<(u64, f64, Vec<f64>, &'static str)>,
}

impl OrderTable {
    fn new(grid: &OrderGrid, outcome: Outcome) -> Self {
        let orders = |index: u64| {
            let structure = grid.structure(index);
            (structure.order, structure.terms.iter().map(|t| t.order).collect::<Vec<f64>>())
        };
        let row = |row: Row| {
            let (alpha, orders) = orders(row.index);
            let Row { index, score, coefficients, initial } = row;
            FoundRow { index, score, alpha, orders, coefficients, initial }
        };
        let failure = |&(index, failure): &_| {
            let (alpha, orders) = orders(index);
            (index, alpha, orders, failure_name(failure))
        };
        Self {
            rows: outcome.rows.into_iter().map(row).collect(),
            counts: outcome.counts,
            failures: outcome.failures.iter().map(failure).collect(),
        }
    }

    fn dict(self, py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
        let dict = PyDict::new(py);
        dict.set_item("rows", self.rows)?;
        dict.set_item("counts", counts_to_dict(py, &self.counts)?)?;
        dict.set_item("boxed", self.counts.excluded_by_box)?;
        dict.set_item("failures", self.failures)?;
        Ok(dict)
    }
}

/// Return the plan of a search: (number of candidates, index after the last batch of each generation). A generation is
/// a group of batches that start from the same results.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn search_plan(
    py: Python<'_>,
    orders: OrdersArg,
    inputs: List<bool>,
    terms: InitialArg,
    settings: SettingsArg,
) -> PyResult<(u64, Vec<u64>)> {
    let options = settings.options(terms)?;
    run_detached(py, || {
        let count = orders.grid(&inputs)?.count();
        Ok((count, batches::generation_ends(batches::batch_count(count, &options))))
    })
}

/// Join the partial results of all batches, and return the result of the search as a dictionary. Return an error if the
/// partial results do not account for all candidates. `samples` is the total number of samples of the records.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn search_join<'py>(
    py: Python<'py>,
    orders: OrdersArg,
    inputs: List<bool>,
    terms: InitialArg,
    settings: SettingsArg,
    samples: usize,
    parts: List<PartArg>,
) -> PyResult<Bound<'py, PyDict>> {
    let options = settings.options(terms)?;
    let result = run_detached(py, || {
        let grid = orders.grid(&inputs)?;
        let mut all = Part::default();
        for argument in parts {
            let part = part_from_tuple(argument);
            let index = part.rows.iter().map(|r| r.index).chain(part.failures.iter().map(|f| f.0)).max();
            if let Some(index) = index.filter(|&i| i >= grid.count()) {
                return Err(mismatch_error(format!("a row has index {index} among {} candidates", grid.count())));
            }
            all.merge(part, options.top);
        }
        if all.counts.candidates != grid.count() || all.counts.processed_count() != grid.count() {
            return Err(mismatch_error(format!(
                "parts account for {} of {} candidates",
                all.counts.processed_count(),
                grid.count()
            )));
        }
        if all.counts.excluded_by_box > all.counts.excluded_by_bound {
            let Counts { excluded_by_box, excluded_by_bound, .. } = all.counts;
            return Err(mismatch_error(format!(
                "parts have {excluded_by_box} candidates in boxes among {excluded_by_bound} excluded ones"
            )));
        }
        Ok(OrderTable::new(&grid, all.outcome(options.norm, samples)))
    })?;
    result.dict(py)
}

/// Order search that is prepared for the evaluation of its batches, on one or several machines.
#[pyclass(frozen, module = "ftlm._core")]
pub struct OrderSearch {
    evaluator: batches::BatchEvaluator<'static>,
}

#[pymethods]
impl OrderSearch {
    #[new]
    #[allow(clippy::needless_pass_by_value)]
    fn new(
        py: Python<'_>,
        runs: List<RecordArg<'_>>,
        orders: OrdersArg,
        inputs: List<bool>,
        fixed: List<Option<f64>>,
        terms: InitialArg,
        settings: SettingsArg,
    ) -> PyResult<Self> {
        let mut arguments = SearchInputs::new(&runs, inputs, fixed, terms, settings)?;
        let evaluator = run_watched(py, None, |control| {
            let grid = orders.grid(&arguments.inputs)?;
            let records = arguments.records(control)?;
            let pool = pool(arguments.options.threads)?;
            batches::BatchEvaluator::new(
                &records,
                Cow::Owned(grid),
                &arguments.fixed,
                &arguments.options,
                &pool,
                control,
            )
        })?;
        Ok(Self { evaluator })
    }

    /// Evaluate the batches `first` to `last` − 1 and return their partial result. All batches must belong to one
    /// generation, a group of batches that start from the same results. `seed` holds (index, raw sum Σ|e| or Σe²) of
    /// the rows found before the generation. `start` is a checkpoint to resume from.
    #[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
    fn evaluate_batches(
        &self,
        py: Python<'_>,
        first: u64,
        last: u64,
        seed: List<(u64, f64)>,
        start: Option<CheckpointArg>,
        threads: usize,
        progress: Option<Py<PyAny>>,
        save: Option<Py<PyAny>>,
    ) -> PyResult<PartArg> {
        let result = run_checkpointed(py, progress.as_ref(), save.as_ref(), |control| {
            let pool = pool(threads)?;
            self.evaluator.evaluate_batches(first, last, &seed, start.map(checkpoint_from_tuple), &pool, control)
        })?;
        Ok(part_to_tuple(result))
    }
}

/// Certify a lower bound of the equation error over a region of orders. Return the certificate as a dictionary. `alpha`
/// is the interval of the order α of the equation, `terms` holds (signal, lowest order, highest order), and `memory` is
/// in bytes.
#[pyfunction]
#[pyo3(signature = (
    runs, *, output, alpha, terms, min_separation, tolerance, max_term_ratio, max_cells, threads, memory, progress,
))]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)]
pub fn certify<'py>(
    py: Python<'py>,
    runs: List<RecordArg<'py>>,
    output: usize,
    alpha: (f64, f64),
    terms: List<(usize, f64, f64)>,
    min_separation: f64,
    tolerance: f64,
    max_term_ratio: f64,
    max_cells: u64,
    threads: usize,
    memory: u64,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let records = records(&runs)?;
    let terms = terms.iter().map(|&(signal, lowest, highest)| Range { signal, lowest, highest }).collect();
    let region = Region { output, alpha, terms, min_separation };
    let options = CertificateOptions { tolerance, max_coefficient: max_term_ratio, max_cells, threads, memory };
    let certificate =
        run_watched(py, progress.as_ref(), |control| certificate::certify(&records, &region, &options, control))?;
    let dict = PyDict::new(py);
    dict.set_item("lower_bound", certificate.lower_bound)?;
    dict.set_item("best", certificate.best)?;
    dict.set_item("alpha", certificate.order)?;
    dict.set_item("orders", certificate.orders)?;
    dict.set_item("cells", certificate.cells)?;
    dict.set_item("open", certificate.open_cells)?;
    Ok(dict)
}

/// Evaluation of candidates with given orders and coefficients.
#[pyclass(module = "ftlm._core")]
pub struct Points {
    inner: GivenPoints,
    width: usize,
}

#[pymethods]
impl Points {
    #[new]
    #[allow(clippy::needless_pass_by_value)]
    fn new(
        py: Python<'_>,
        runs: List<RecordArg<'_>>,
        output: usize,
        signals: List<usize>,
        inputs: List<bool>,
        squares: bool,
    ) -> PyResult<Self> {
        let width = signals.len();
        let norm = if squares { Norm::L2 } else { Norm::L1 };
        let (records, signals, inputs) = (records(&runs)?, signals.into(), inputs.into());
        Ok(Self { inner: run_detached(py, || GivenPoints::new(records, output, signals, inputs, norm))?, width })
    }

    /// Return the error of each candidate. A row of `candidates` holds alpha, the orders and the coefficients. An error
    /// above `limit` is returned as infinity.
    #[allow(clippy::needless_pass_by_value)]
    fn scores<'py>(
        &mut self,
        py: Python<'py>,
        candidates: PyReadonlyArray2<'py, f64>,
        limit: f64,
        threads: usize,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let Self { inner, width } = self;
        let size = 1 + 2 * *width;
        check_size(&candidates)?;
        check_length("a candidate", size, column_count(&candidates))?;
        let values: Vec<f64> = candidates.as_array().iter().copied().collect();
        let errors = run_watched(py, None, |control| {
            let point = |row: &[f64]| {
                let (orders, coefficients) = row[1..].split_at(*width);
                Point { order: row[0], orders: orders.to_vec(), coefficients: coefficients.to_vec() }
            };
            let points: Vec<Point> = values.chunks_exact(size).map(point).collect();
            inner.scores(&points, limit, threads, control)
        })?;
        Ok(PyArray1::from_vec(py, errors))
    }
}

/// Test hook: panic in the calling thread, in the search thread, or in a worker thread of the search.
#[pyfunction]
#[allow(clippy::panic)]
pub fn panic_on_purpose(py: Python<'_>, place: &str) -> PyResult<()> {
    let fault = || std::panic::panic_any("on purpose");
    match place {
        "call" => run_detached(py, fault),
        "search" => run_watched(py, None, |_| fault()),
        _ => run_watched(py, None, |_| pool(2)?.install(|| rayon::join(fault, || ()).0)),
    }
}

/// Test hook: run all kernels with the instruction set of the oldest supported processor if `is_forced` is true.
#[pyfunction]
pub fn force_portable(is_forced: bool) {
    crate::simd::force_portable(is_forced);
}

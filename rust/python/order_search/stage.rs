//! Bindings of the coupled order search, in one call or block by block.

use std::borrow::Cow;
use std::sync::{Mutex, PoisonError};

use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use super::arguments::{
    counts_to_dict, failure_name, law_grid, span_from_tuple, verdicts_from_bytes, verdicts_to_bytes, LawArg,
    SearchInputs, SettingsArg, SpanArg,
};
use super::watch::run_watched;
use crate::error::Error;
use crate::order_search::grid::order_law::OrderLawGrid;
use crate::order_search::result::Counts;
use crate::order_search::stage_join::{self, CoupledSearch, SearchState, StageOutcome, StageRow};
use crate::parallel::pool;
use crate::python::convert::{to_vectors, InitialArg, List, RecordArg};
use crate::python::errors::run_detached;

#[pyfunction]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn search_stage<'py>(
    py: Python<'py>,
    runs: List<RecordArg<'py>>,
    axes: List<List<f64>>,
    laws: List<LawArg>,
    inputs: List<bool>,
    fixed: List<List<Option<f64>>>,
    scales: List<f64>,
    terms: InitialArg,
    settings: SettingsArg,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let (axes, fixed) = (to_vectors(axes), to_vectors(fixed));
    let mut arguments = SearchInputs::new(&runs, inputs, fixed, terms, settings)?;
    let result = run_watched(py, progress.as_ref(), |control| {
        let grid = law_grid(&axes, laws, &arguments.inputs, &arguments.fixed)?;
        let records = arguments.records(control)?;
        let outcome = stage_join::search(&records, &grid, &arguments.fixed, &scales, &arguments.options, control)?;
        Ok(StageTable::new(&grid, outcome))
    })?;
    result.dict(py)
}

/// Result of one equation: (score, α, orders, coefficients, coefficients of the initial terms by record).
type FoundEquation = (f64, f64, Vec<f64>, Vec<f64>, Vec<Vec<f64>>);

/// Result table of a coupled search, with counts, and (index, free orders, reason) of each failure.
struct StageTable {
    rows: Vec<(u64, f64, Vec<f64>, Vec<FoundEquation>)>,
    counts: Counts,
    failures: Vec<(u64, Vec<f64>, &'static str)>,
    distinct: Vec<u64>,
}

impl StageTable {
    fn new(grid: &OrderLawGrid, outcome: StageOutcome) -> Self {
        let row = |row: StageRow| {
            let equations = row.structures.iter().zip(row.rows).map(|(structure, part)| {
                let orders = structure.terms.iter().map(|t| t.order).collect();
                (part.score, structure.order, orders, part.coefficients, part.initial)
            });
            (row.index, row.score, row.free, equations.collect())
        };
        let failure = |&(index, failure): &_| (index, grid.free(index), failure_name(failure));
        Self {
            rows: outcome.rows.into_iter().map(row).collect(),
            counts: outcome.counts,
            failures: outcome.failures.iter().map(failure).collect(),
            distinct: outcome.distinct,
        }
    }

    fn dict(self, py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
        let dict = PyDict::new(py);
        dict.set_item("rows", self.rows)?;
        dict.set_item("counts", counts_to_dict(py, &self.counts)?)?;
        dict.set_item("failures", self.failures)?;
        dict.set_item("distinct", self.distinct)?;
        Ok(dict)
    }
}

/// Order search over coupled equations that is prepared for evaluation on one or several machines. One instance stores
/// the search state and collects the results.
#[pyclass(frozen, module = "ftlm._core")]
pub struct StageSearch {
    search: CoupledSearch<'static>,
    state: Mutex<Option<SearchState>>,
}

impl StageSearch {
    /// Apply `work` to the search state. Return an error if this instance stores no state.
    fn with_state<T>(&self, work: impl FnOnce(&mut SearchState) -> Result<T, Error>) -> Result<T, Error> {
        let mut guard = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let state = guard.as_mut().ok_or_else(|| Error::Structure {
            what: "this search stores no state".into(),
            remedy: "create a search with a state".into(),
        })?;
        work(state)
    }
}

#[pymethods]
impl StageSearch {
    #[new]
    #[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        runs: List<RecordArg<'_>>,
        axes: List<List<f64>>,
        laws: List<LawArg>,
        inputs: List<bool>,
        fixed: List<List<Option<f64>>>,
        scales: List<f64>,
        terms: InitialArg,
        settings: SettingsArg,
        keeps_state: bool,
    ) -> PyResult<Self> {
        let (axes, fixed) = (to_vectors(axes), to_vectors(fixed));
        let mut arguments = SearchInputs::new(&runs, inputs, fixed, terms, settings)?;
        let (search, state) = run_watched(py, None, |control| {
            let grid = law_grid(&axes, laws, &arguments.inputs, &arguments.fixed)?;
            let records = arguments.records(control)?;
            let pool = pool(arguments.options.threads)?;
            CoupledSearch::new(
                &records,
                Cow::Owned(grid),
                &arguments.fixed,
                &scales,
                &arguments.options,
                &pool,
                control,
            )
        })?;
        Ok(Self { search, state: Mutex::new(keeps_state.then_some(state)) })
    }

    /// Return the blocks of candidates to evaluate next as (equation, first, end, limit). Empty if the search is
    /// complete.
    fn pending_spans(&self, py: Python<'_>) -> PyResult<Vec<SpanArg>> {
        run_detached(py, || {
            self.with_state(|state| {
                Ok(state.pending_spans().iter().map(|s| (s.equation, s.first, s.last, s.limit)).collect())
            })
        })
    }

    /// Return (number of candidates to evaluate as known so far, best score so far).
    fn state(&self, py: Python<'_>) -> PyResult<(u64, Option<f64>)> {
        run_detached(py, || self.with_state(|state| Ok((state.total(), state.best()))))
    }

    /// Evaluate blocks of candidates. Return (raw sums Σ|e| or Σe², kinds of outcome) of the candidates as bytes.
    #[allow(clippy::needless_pass_by_value)]
    fn evaluate_spans<'py>(
        &self,
        py: Python<'py>,
        spans: List<SpanArg>,
        threads: usize,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<(Bound<'py, PyBytes>, Bound<'py, PyBytes>)> {
        let requests: Vec<_> = spans.into_iter().map(span_from_tuple).collect();
        let (values, kinds) = run_watched(py, progress.as_ref(), |control| {
            Ok(verdicts_to_bytes(&self.search.evaluate(&requests, &pool(threads)?, control)?))
        })?;
        Ok((PyBytes::new(py, &values), PyBytes::new(py, &kinds)))
    }

    /// Add the outcomes of the pending candidates to the search state, in the sequence of `pending_spans`.
    fn record_outcomes(&self, py: Python<'_>, values: &[u8], kinds: &[u8], threads: usize) -> PyResult<()> {
        run_watched(py, None, |control| {
            let verdicts = verdicts_from_bytes(values, kinds)?;
            self.with_state(|state| state.record_verdicts(&self.search, &verdicts, &pool(threads)?, control))
        })
    }

    /// Return the result of the search as a dictionary, once no candidates are pending.
    fn outcome<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let result = run_watched(py, None, |control| {
            let outcome = self.with_state(|state| self.search.outcome(state, control))?;
            Ok(StageTable::new(self.search.grid(), outcome))
        })?;
        result.dict(py)
    }
}

//! Conversion of settings, order grids, partial results and outcomes of a search from and to Python tuples.

use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::equation::{AffineOrder, Initial};
use crate::error::Error;
use crate::estimation::instrumental_variables::{with_projections, InstrumentalSettings};
use crate::estimation::multi_innovation::{Innovation, RowBasis};
use crate::order_search::control::{mismatch_error, BatchPosition, Checkpoint, Control};
use crate::order_search::grid::independent::{OrderGrid, TermAxis};
use crate::order_search::grid::order_law::{LawEquation, OrderLawGrid};
use crate::order_search::options::{Criterion, Estimator, Norm, Options};
use crate::order_search::result::{Counts, Failure, Part, Row, Verdict};
use crate::order_search::stage_join::Span;
use crate::python::convert::{initial, prior, records, to_lists, to_vectors, InitialArg, List, RecordArg};
use crate::regressors::Record;

/// Convergence tolerance of the instrumental variables of a candidate. It is too small to affect the ranking.
const IV_CONVERGENCE_TOLERANCE: f64 = 1e-4;

/// Settings from a dictionary with these fields as keys. `innovation_length` is 0 for least squares. `iterations` is 0
/// without instrumental variables. `prior_covariance` is None for a weak prior. `memory` is in bytes.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct SettingsDict {
    criterion: String,
    norm: String,
    innovation_length: usize,
    prior_covariance: Option<f64>,
    haar_rows: bool,
    top: usize,
    threads: usize,
    pruning: bool,
    iterations: usize,
    memory: u64,
}

/// Settings of a search without its initial terms.
pub struct SettingsArg {
    criterion: Criterion,
    norm: Norm,
    estimator: Estimator,
    top: usize,
    threads: usize,
    pruning: bool,
    memory: u64,
}

impl<'py> FromPyObject<'_, 'py> for SettingsArg {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let given: SettingsDict = object.extract()?;
        let unknown = |what: String, remedy: &str| Error::Structure { what, remedy: remedy.into() };
        Ok(Self {
            criterion: match given.criterion.as_str() {
                "output-error" => Criterion::OutputError,
                "equation-error" => Criterion::EquationError,
                other => {
                    let what = format!("criterion '{other}' is not known");
                    return Err(unknown(what, "use output-error or equation-error").into());
                }
            },
            norm: match given.norm.as_str() {
                "l1" => Norm::L1,
                "l2" => Norm::L2,
                other => return Err(unknown(format!("norm '{other}' is not known"), "use l1 or l2").into()),
            },
            estimator: if given.iterations > 0 {
                Estimator::InstrumentalVariables(InstrumentalSettings {
                    iterations: given.iterations,
                    tolerance: IV_CONVERGENCE_TOLERANCE,
                })
            } else if given.innovation_length == 0 {
                Estimator::LeastSquares
            } else {
                let row_basis = if given.haar_rows { RowBasis::Haar } else { RowBasis::Time };
                let (length, prior) = (given.innovation_length, prior(given.prior_covariance));
                Estimator::MultiInnovation(Innovation { length, prior, row_basis })
            },
            top: given.top,
            threads: given.threads,
            pruning: given.pruning,
            memory: given.memory,
        })
    }
}

impl SettingsArg {
    /// Return the options of a search with these initial terms.
    pub fn options(self, terms: InitialArg) -> PyResult<Options> {
        let Self { criterion, norm, estimator, top, threads, pruning, memory } = self;
        Ok(Options { criterion, norm, estimator, initial: initial(terms)?, top, threads, pruning, memory })
    }
}

/// Data and options of a search without its order grid. `F` is the type of the fixed coefficients, of one or several
/// equations.
pub struct SearchInputs<F> {
    records: Vec<Record>,
    pub inputs: Vec<bool>,
    pub fixed: F,
    pub options: Options,
}

impl<F> SearchInputs<F> {
    pub fn new(
        runs: &[RecordArg<'_>],
        inputs: List<bool>,
        fixed: F,
        terms: InitialArg,
        settings: SettingsArg,
    ) -> PyResult<Self> {
        Ok(Self { records: records(runs)?, inputs: inputs.into(), fixed, options: settings.options(terms)? })
    }

    /// Return the records. For instrumental variables, they also contain noise-free projections of all signals except
    /// the inputs.
    pub fn records(&mut self, control: &Control) -> Result<Vec<Record>, Error> {
        let records = std::mem::take(&mut self.records);
        if !matches!(self.options.estimator, Estimator::InstrumentalVariables(_)) {
            return Ok(records);
        }
        let at_rest = self.options.initial == Initial::Rest;
        records.into_iter().map(|r| with_projections(r, &self.inputs, at_rest, &control.stop)).collect()
    }
}

/// Order grid: (output, values of alpha, [(signal, values, true if interchangeable), …]).
type OrdersTuple = (usize, List<f64>, List<(usize, List<f64>, bool)>);

/// Values of the orders on the axes of an order grid.
pub struct OrdersArg {
    output: usize,
    alphas: Vec<f64>,
    axes: Vec<TermAxis>,
}

impl<'py> FromPyObject<'_, 'py> for OrdersArg {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let (output, alphas, axes): OrdersTuple = object.extract()?;
        let axis = |(signal, values, interchangeable)| TermAxis { signal, values: Vec::from(values), interchangeable };
        Ok(Self { output, alphas: alphas.into(), axes: axes.into_iter().map(axis).collect() })
    }
}

impl OrdersArg {
    pub fn grid(&self, inputs: &[bool]) -> Result<OrderGrid, Error> {
        OrderGrid::new(self.output, &self.alphas, &self.axes, |s| inputs.get(s).copied().unwrap_or(false))
    }
}

/// Affine order law: (constant, weight of each free order).
type AffineTuple = (f64, List<f64>);
/// Order laws of an equation: (output, alpha, [(signal, order), …]).
type LawTuple = (usize, AffineTuple, List<(usize, AffineTuple)>);

/// Order laws of one equation.
pub struct LawArg(LawEquation);

impl<'py> FromPyObject<'_, 'py> for LawArg {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let (output, order, terms): LawTuple = object.extract()?;
        let affine = |(constant, weights)| AffineOrder { constant, weights: Vec::from(weights) };
        let terms = terms.into_iter().map(|(signal, order)| (signal, affine(order))).collect();
        Ok(Self(LawEquation { output, order: affine(order), terms }))
    }
}

/// Build the order grid of a coupled search. `axes` holds the values of each free order.
pub fn law_grid(
    axes: &[Vec<f64>],
    laws: List<LawArg>,
    inputs: &[bool],
    fixed: &[Vec<Option<f64>>],
) -> Result<OrderLawGrid, Error> {
    let equations: Vec<LawEquation> = laws.into_iter().map(|law| law.0).collect();
    Ok(OrderLawGrid::new(axes, &equations, inputs)?.with_fixed_coefficients(fixed))
}

/// Return the counts as a dictionary, with their names in the Python interface as keys.
pub fn counts_to_dict<'py>(py: Python<'py>, counts: &Counts) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("candidates", counts.candidates)?;
    dict.set_item("kept", counts.table_rows)?;
    dict.set_item("beaten", counts.beaten)?;
    dict.set_item("bound", counts.excluded_by_bound)?;
    dict.set_item("stopped early", counts.stopped)?;
    dict.set_item("singular", counts.singular)?;
    dict.set_item("diverged", counts.diverged)?;
    Ok(dict)
}

/// Return the name of a failure in the Python interface.
pub fn failure_name(failure: Failure) -> &'static str {
    match failure {
        Failure::Singular => "singular",
        Failure::Diverged => "diverged",
    }
}

/// Row of a result: (index, raw sum Σ|e| or Σe² of the errors, coefficients, coefficients of the initial terms by
/// record).
type RowArg = (u64, f64, List<f64>, List<List<f64>>);
/// Numbers of candidates: (all, in the table, evaluated but not in the table, excluded by a bound, stopped early,
/// singular, diverged). An optional last value counts candidates excluded together with their box.
#[derive(FromPyObject, IntoPyObject)]
pub enum CountsArg {
    Plain((u64, u64, u64, u64, u64, u64, u64)),
    Boxed((u64, u64, u64, u64, u64, u64, u64, u64)),
}
/// Partial result: (rows, counts, [(index, true if diverged, false if singular), …] of the failures).
pub type PartArg = (List<RowArg>, CountsArg, List<(u64, bool)>);
/// Checkpoint: (position, true if it replaces earlier results, partial result). The position is (index of the batch,
/// number of its evaluated candidates, end, length and limit of the current chunk, digest of the sequence of
/// evaluation).
pub type CheckpointArg = ((u64, u64, u64, u64, f64, u64), bool, PartArg);

/// Convert a partial result to Python tuples.
pub fn part_to_tuple(part: Part) -> PartArg {
    let c = part.counts;
    (
        part.rows.into_iter().map(|r| (r.index, r.score, r.coefficients.into(), to_lists(r.initial))).collect(),
        match c.excluded_by_box {
            0 => CountsArg::Plain((
                c.candidates,
                c.table_rows,
                c.beaten,
                c.excluded_by_bound,
                c.stopped,
                c.singular,
                c.diverged,
            )),
            n => CountsArg::Boxed((
                c.candidates,
                c.table_rows,
                c.beaten,
                c.excluded_by_bound,
                c.stopped,
                c.singular,
                c.diverged,
                n,
            )),
        },
        part.failures.into_iter().map(|(index, f)| (index, f == Failure::Diverged)).collect(),
    )
}

/// Convert a partial result from Python tuples.
pub fn part_from_tuple((rows, counts, failures): PartArg) -> Part {
    let (candidates, table_rows, beaten, excluded_by_bound, stopped, singular, diverged, excluded_by_box) = match counts
    {
        CountsArg::Plain((a, b, c, d, e, f, g)) => (a, b, c, d, e, f, g, 0),
        CountsArg::Boxed(all) => all,
    };
    Part {
        rows: rows
            .into_iter()
            .map(|(index, score, coefficients, initial)| Row {
                index,
                score,
                coefficients: coefficients.into(),
                initial: to_vectors(initial),
            })
            .collect(),
        counts: Counts {
            candidates,
            table_rows,
            beaten,
            excluded_by_bound,
            excluded_by_box,
            stopped,
            singular,
            diverged,
        },
        failures: failures
            .into_iter()
            .map(|(index, diverged)| (index, if diverged { Failure::Diverged } else { Failure::Singular }))
            .collect(),
    }
}

/// Convert a checkpoint from Python tuples.
pub fn checkpoint_from_tuple(
    ((batch, evaluated_count, end, size, limit, order), replaces_previous, part): CheckpointArg,
) -> Checkpoint {
    Checkpoint {
        position: BatchPosition { batch, evaluated_count, end, size, limit, order },
        replaces_previous,
        part: part_from_tuple(part),
    }
}

/// Convert a checkpoint to Python tuples.
pub fn checkpoint_to_tuple(checkpoint: Checkpoint) -> CheckpointArg {
    let p = checkpoint.position;
    (
        (p.batch, p.evaluated_count, p.end, p.size, p.limit, p.order),
        checkpoint.replaces_previous,
        part_to_tuple(checkpoint.part),
    )
}

/// Contiguous block of candidates: (equation, index of the first candidate, index after the last one, limit of the raw
/// sum Σ|e| or Σe²).
pub type SpanArg = (usize, usize, usize, f64);

/// Convert a block of candidates from a Python tuple.
pub fn span_from_tuple((equation, first, last, limit): SpanArg) -> Span {
    Span { equation, first, last, limit }
}

/// Serialize outcomes of candidates. Return the raw sums Σ|e| or Σe² as little-endian doubles, and the kinds of outcome
/// as one byte each.
pub fn verdicts_to_bytes(verdicts: &[Verdict]) -> (Vec<u8>, Vec<u8>) {
    let pairs = verdicts.iter().map(|verdict| match *verdict {
        Verdict::Score(raw) => (raw, 0),
        Verdict::Bounded(raw) => (raw, 1),
        Verdict::Stopped(raw) => (raw, 2),
        Verdict::Failed(Failure::Singular) => (0.0, 3),
        Verdict::Failed(Failure::Diverged) => (0.0, 4),
    });
    let (values, kinds): (Vec<[u8; 8]>, Vec<u8>) = pairs.map(|(raw, kind)| (raw.to_le_bytes(), kind)).unzip();
    (values.concat(), kinds)
}

/// Deserialize outcomes from [`verdicts_to_bytes`]. Return an error for an unknown kind or for different numbers of
/// values and kinds.
pub fn verdicts_from_bytes(values: &[u8], kinds: &[u8]) -> Result<Vec<Verdict>, Error> {
    let decoded = kinds.iter().zip(values.chunks_exact(8)).map(|(kind, value)| {
        let raw = f64::from_le_bytes(std::array::from_fn(|i| value[i]));
        match kind {
            0 => Some(Verdict::Score(raw)),
            1 => Some(Verdict::Bounded(raw)),
            2 => Some(Verdict::Stopped(raw)),
            3 => Some(Verdict::Failed(Failure::Singular)),
            4 => Some(Verdict::Failed(Failure::Diverged)),
            _ => None,
        }
    });
    decoded.collect::<Option<Vec<_>>>().filter(|_| values.len() == 8 * kinds.len()).ok_or_else(|| {
        mismatch_error(format!("{} bytes of values and {} of kinds do not match", values.len(), kinds.len()))
    })
}

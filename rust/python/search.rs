//! Order searches, watched for Ctrl-C while they run.

use std::borrow::Cow;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{channel, RecvTimeoutError};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use numpy::{PyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use super::arrays::{initial, records, rows, InitialArg, RecordArg};
use super::errors::caught;
use crate::equation::{AffineOrder, Initial};
use crate::error::Error;
use crate::estimate::iv::{with_projections, Settings};
use crate::estimate::multi_innovation::{Innovation, Rows};
use crate::regressors::Record;
use crate::search::lattice::{Lattice, LawEquation, LawLattice, TermAxis};
use crate::search::points::{Point, Points as PointsOf};
use crate::search::run::{
    self, Checkpoint, Control, Counts, Criterion, Estimator, Failure, Norm, Options, Outcome, Part, Place, Row, Verdict,
};
use crate::search::stage::{self, Course, Span, Stage, StageOutcome};

/// How often Python is asked for signals: well under the half second after which Ctrl-C must have ended a search.
const LOOK: Duration = Duration::from_millis(50);

/// Runs `work` on a thread of its own, so that this one can watch for signals and report progress.
fn watched<T: Send>(
    py: Python<'_>,
    progress: Option<&Py<PyAny>>,
    work: impl FnOnce(&Control) -> Result<T, Error> + Send,
) -> PyResult<T> {
    saved(py, progress, None, work)
}

/// As [`watched`]; whenever Python is asked for signals, `save` is called with the latest checkpoint, or with None.
fn saved<T: Send>(
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
                    control.stop.store(true, Ordering::Relaxed);
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

/// Candidates done, in all, and left before the end of the record.
fn state(control: &Control) -> (u64, u64, u64) {
    let read = |x: &std::sync::atomic::AtomicU64| x.load(Ordering::Relaxed);
    (read(&control.done), read(&control.total), read(&control.pruned))
}

/// (criterion, norm, p or 0 for least squares, K₀, Haar rows, keep, threads, early stopping, steps of instrumental
/// variables or 0).
type OptionsArg = (String, String, usize, f64, bool, usize, usize, bool, usize);

/// Change below which a candidate's instrumental variables stand still: far below what moves a rank.
const REFINED: f64 = 1e-4;

fn options(argument: OptionsArg, terms: InitialArg) -> PyResult<Options> {
    let (criterion, norm, length, prior_covariance, haar, keep, threads, early_stopping, iterations) = argument;
    let unknown = |what: String, remedy: &str| Error::Structure { what, remedy: remedy.into() };
    Ok(Options {
        criterion: match criterion.as_str() {
            "output-error" => Criterion::OutputError,
            "equation-error" => Criterion::EquationError,
            other => {
                let what = format!("criterion '{other}' is not known");
                return Err(unknown(what, "use output-error or equation-error").into());
            }
        },
        norm: match norm.as_str() {
            "l1" => Norm::L1,
            "l2" => Norm::L2,
            other => return Err(unknown(format!("norm '{other}' is not known"), "use l1 or l2").into()),
        },
        estimator: if iterations > 0 {
            Estimator::InstrumentalVariables(Settings { iterations, tolerance: REFINED })
        } else if length == 0 {
            Estimator::LeastSquares
        } else {
            let rows = if haar { Rows::Haar } else { Rows::Time };
            Estimator::MultiInnovation(Innovation { length, prior_covariance, rows })
        },
        initial: initial(terms)?,
        keep,
        threads,
        early_stopping,
    })
}

/// Records with the clean signals that the estimator asks for.
fn prepared(records: Vec<Record>, inputs: &[bool], options: &Options) -> Result<Vec<Record>, Error> {
    if !matches!(options.estimator, Estimator::InstrumentalVariables(_)) {
        return Ok(records);
    }
    let at_rest = options.initial == Initial::Rest;
    records.into_iter().map(|r| with_projections(r, inputs, at_rest)).collect()
}

fn counted<'py>(py: Python<'py>, counts: &Counts) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("candidates", counts.candidates)?;
    dict.set_item("kept", counts.kept)?;
    dict.set_item("beaten", counts.beaten)?;
    dict.set_item("bound", counts.bounded)?;
    dict.set_item("stopped early", counts.stopped)?;
    dict.set_item("singular", counts.singular)?;
    dict.set_item("diverged", counts.diverged)?;
    Ok(dict)
}

fn named(failure: Failure) -> &'static str {
    match failure {
        Failure::Singular => "singular",
        Failure::Diverged => "diverged",
    }
}

/// (output, values of alpha, [(signal, values, interchangeable), …]).
type LatticeArg = (usize, Vec<f64>, Vec<(usize, Vec<f64>, bool)>);

fn lattice(argument: LatticeArg, inputs: &[bool]) -> Result<Lattice, Error> {
    let (output, alphas, axes) = argument;
    let axes: Vec<TermAxis> = axes
        .into_iter()
        .map(|(signal, values, interchangeable)| TermAxis { signal, values, interchangeable })
        .collect();
    Lattice::new(output, &alphas, &axes, |s| inputs.get(s).copied().unwrap_or(false))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn lattice_size(py: Python<'_>, orders: LatticeArg, inputs: Vec<bool>) -> PyResult<u64> {
    super::errors::detached(py, || Ok(lattice(orders, &inputs)?.count()))
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn search<'py>(
    py: Python<'py>,
    runs: Vec<RecordArg<'py>>,
    orders: LatticeArg,
    inputs: Vec<bool>,
    fixed: Vec<Option<f64>>,
    terms: InitialArg,
    settings: OptionsArg,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let records = records(&runs)?;
    let options = options(settings, terms)?;
    let (lattice, outcome) = watched(py, progress.as_ref(), |control| {
        let lattice = lattice(orders, &inputs)?;
        let records = prepared(records, &inputs, &options)?;
        let outcome = run::search(&records, &lattice, &fixed, &options, control)?;
        Ok((lattice, outcome))
    })?;
    found(py, &lattice, outcome)
}

/// A table, counts and failures with the orders of each index.
fn found<'py>(py: Python<'py>, lattice: &Lattice, outcome: Outcome) -> PyResult<Bound<'py, PyDict>> {
    let rows: Vec<_> = outcome
        .rows
        .into_iter()
        .map(|row| {
            let structure = lattice.structure(row.index);
            let orders: Vec<f64> = structure.terms.iter().map(|t| t.order).collect();
            (row.index, row.score, structure.order, orders, row.coefficients, row.initial)
        })
        .collect();
    let failures: Vec<(u64, f64, Vec<f64>, &str)> = outcome
        .failures
        .iter()
        .map(|&(index, failure)| {
            let structure = lattice.structure(index);
            let orders = structure.terms.iter().map(|t| t.order).collect();
            (index, structure.order, orders, named(failure))
        })
        .collect();
    let dict = PyDict::new(py);
    dict.set_item("rows", rows)?;
    dict.set_item("counts", counted(py, &outcome.counts)?)?;
    dict.set_item("failures", failures)?;
    Ok(dict)
}

/// (index, raw score, coefficients, initial terms by record).
type RowArg = (u64, f64, Vec<f64>, Vec<Vec<f64>>);
/// Candidates, kept, beaten, bounded, stopped, singular, diverged.
type CountsArg = (u64, u64, u64, u64, u64, u64, u64);
/// Rows, counts, (index, whether diverged rather than singular) of failures.
type PartArg = (Vec<RowArg>, CountsArg, Vec<(u64, bool)>);
/// (round, followed, end, size, limit) and what the stretch came to.
type CheckpointArg = ((u64, u64, u64, u64, f64), PartArg);

fn part_of(part: Part) -> PartArg {
    let c = part.counts;
    (
        part.rows.into_iter().map(|r| (r.index, r.score, r.coefficients, r.initial)).collect(),
        (c.candidates, c.kept, c.beaten, c.bounded, c.stopped, c.singular, c.diverged),
        part.failures.into_iter().map(|(index, f)| (index, f == Failure::Diverged)).collect(),
    )
}

fn part((rows, counts, failures): PartArg) -> Part {
    let (candidates, kept, beaten, bounded, stopped, singular, diverged) = counts;
    Part {
        rows: rows
            .into_iter()
            .map(|(index, score, coefficients, initial)| Row { index, score, coefficients, initial })
            .collect(),
        counts: Counts { candidates, kept, beaten, bounded, stopped, singular, diverged },
        failures: failures
            .into_iter()
            .map(|(index, diverged)| (index, if diverged { Failure::Diverged } else { Failure::Singular }))
            .collect(),
    }
}

fn checkpoint_of(checkpoint: Checkpoint) -> CheckpointArg {
    let p = checkpoint.place;
    ((p.round, p.followed, p.end, p.size, p.limit), part_of(checkpoint.part))
}

/// Candidates of a search, and where each wave of its rounds ends.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn search_plan(
    py: Python<'_>,
    orders: LatticeArg,
    inputs: Vec<bool>,
    terms: InitialArg,
    settings: OptionsArg,
) -> PyResult<(u64, Vec<u64>)> {
    let options = options(settings, terms)?;
    super::errors::detached(py, || {
        let count = lattice(orders, &inputs)?.count();
        Ok((count, run::waves(run::rounds(count, &options))))
    })
}

/// The result of a search from the parts that its rounds came to, over records of so many samples.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn search_join<'py>(
    py: Python<'py>,
    orders: LatticeArg,
    inputs: Vec<bool>,
    terms: InitialArg,
    settings: OptionsArg,
    samples: usize,
    parts: Vec<PartArg>,
) -> PyResult<Bound<'py, PyDict>> {
    let options = options(settings, terms)?;
    let (lattice, outcome) = super::errors::detached(py, || {
        let lattice = lattice(orders, &inputs)?;
        let mut all = Part::default();
        for argument in parts {
            let part = part(argument);
            let index = part.rows.iter().map(|r| r.index).chain(part.failures.iter().map(|f| f.0)).max();
            if let Some(index) = index.filter(|&i| i >= lattice.count()) {
                let what = format!("a row has index {index} among {} candidates", lattice.count());
                return Err(Error::Structure { what, remedy: "start the search again".into() });
            }
            all.join(part, options.keep);
        }
        if all.counts.candidates != lattice.count() || all.counts.done() != lattice.count() {
            let what = format!("parts account for {} of {} candidates", all.counts.done(), lattice.count());
            return Err(Error::Structure { what, remedy: "start the search again".into() });
        }
        Ok((lattice, all.outcome(options.norm, samples)))
    })?;
    found(py, &lattice, outcome)
}

/// A search made ready for its rounds: on this machine, or on one of many.
#[pyclass(frozen, module = "ftlm._core")]
pub struct OrderSearch {
    ready: run::Search<'static>,
}

#[pymethods]
impl OrderSearch {
    #[new]
    #[allow(clippy::needless_pass_by_value)]
    fn new(
        py: Python<'_>,
        runs: Vec<RecordArg<'_>>,
        orders: LatticeArg,
        inputs: Vec<bool>,
        fixed: Vec<Option<f64>>,
        terms: InitialArg,
        settings: OptionsArg,
    ) -> PyResult<Self> {
        let records = records(&runs)?;
        let options = options(settings, terms)?;
        let ready = watched(py, None, |control| {
            let lattice = lattice(orders, &inputs)?;
            let records = prepared(records, &inputs, &options)?;
            let pool = run::pool(options.threads)?;
            run::Search::new(&records, Cow::Owned(lattice), &fixed, &options, &pool, control)
        })?;
        Ok(Self { ready })
    }

    /// Rounds `first … last − 1` of one wave: the part they come to.
    #[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
    fn rounds(
        &self,
        py: Python<'_>,
        first: u64,
        last: u64,
        seed: Vec<(u64, f64)>,
        start: Option<CheckpointArg>,
        threads: usize,
        progress: Option<Py<PyAny>>,
        save: Option<Py<PyAny>>,
    ) -> PyResult<PartArg> {
        let start = start.map(|((round, followed, end, size, limit), argument)| Checkpoint {
            place: Place { round, followed, end, size, limit },
            part: part(argument),
        });
        let found = saved(py, progress.as_ref(), save.as_ref(), |control| {
            let pool = run::pool(threads)?;
            self.ready.rounds(first, last, &seed, start, &pool, control)
        })?;
        Ok(part_of(found))
    }
}

/// Panics where it is told to, so that a test can see what becomes of a panic: in a call, in the thread that a search
/// runs on, or in one of its workers.
#[pyfunction]
#[allow(clippy::panic)]
pub fn panic_on_purpose(py: Python<'_>, place: &str) -> PyResult<()> {
    let fault = || std::panic::panic_any("on purpose");
    match place {
        "call" => super::errors::detached(py, fault),
        "search" => watched(py, None, |_| fault()),
        _ => watched(py, None, |_| run::pool(2)?.install(|| rayon::join(fault, || ()).0)),
    }
}

/// Whether kernels run as they are compiled for the oldest machine.
#[pyfunction]
pub fn portable(on: bool) {
    crate::lanes::portable(on);
}

/// (constant, weight of each free order).
type AffineArg = (f64, Vec<f64>);
/// (output, alpha, [(signal, order), …]).
type LawEquationArg = (usize, AffineArg, Vec<(usize, AffineArg)>);

fn affine((constant, weights): AffineArg) -> AffineOrder {
    AffineOrder { constant, weights }
}

fn law_lattice(axes: &[Vec<f64>], laws: Vec<LawEquationArg>, inputs: &[bool]) -> Result<LawLattice, Error> {
    let equations: Vec<LawEquation> = laws
        .into_iter()
        .map(|(output, order, terms)| LawEquation {
            output,
            order: affine(order),
            terms: terms.into_iter().map(|(signal, order)| (signal, affine(order))).collect(),
        })
        .collect();
    LawLattice::new(axes, &equations, inputs)
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
pub fn search_stage<'py>(
    py: Python<'py>,
    runs: Vec<RecordArg<'py>>,
    axes: Vec<Vec<f64>>,
    laws: Vec<LawEquationArg>,
    inputs: Vec<bool>,
    fixed: Vec<Vec<Option<f64>>>,
    scales: Vec<f64>,
    terms: InitialArg,
    settings: OptionsArg,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let records = records(&runs)?;
    let options = options(settings, terms)?;
    let (lattice, outcome) = watched(py, progress.as_ref(), |control| {
        let lattice = law_lattice(&axes, laws, &inputs)?;
        let records = prepared(records, &inputs, &options)?;
        let outcome = stage::search(&records, &lattice, &fixed, &scales, &options, control)?;
        Ok((lattice, outcome))
    })?;
    found_stage(py, &lattice, outcome)
}

/// A table, counts and failures with the free orders of each index.
fn found_stage<'py>(py: Python<'py>, lattice: &LawLattice, outcome: StageOutcome) -> PyResult<Bound<'py, PyDict>> {
    let rows: Vec<_> = outcome
        .rows
        .into_iter()
        .map(|row| {
            let parts: Vec<_> = row
                .structures
                .iter()
                .zip(row.rows)
                .map(|(structure, part)| {
                    let orders: Vec<f64> = structure.terms.iter().map(|t| t.order).collect();
                    (part.score, structure.order, orders, part.coefficients, part.initial)
                })
                .collect();
            (row.index, row.score, row.free, parts)
        })
        .collect();
    let dict = PyDict::new(py);
    dict.set_item("rows", rows)?;
    dict.set_item("counts", counted(py, &outcome.counts)?)?;
    let failures: Vec<(u64, Vec<f64>, &str)> =
        outcome.failures.iter().map(|&(index, failure)| (index, lattice.free(index), named(failure))).collect();
    dict.set_item("failures", failures)?;
    dict.set_item("distinct", outcome.distinct)?;
    Ok(dict)
}

/// (equation, first candidate, the one behind the last, limit).
type SpanArg = (usize, usize, usize, f64);

/// What candidates came to: raw sums as little-endian doubles, and a byte each that says of what.
fn verdicts_of(verdicts: &[Verdict]) -> (Vec<u8>, Vec<u8>) {
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

fn verdicts(values: &[u8], kinds: &[u8]) -> Result<Vec<Verdict>, Error> {
    let known = kinds.iter().zip(values.chunks_exact(8)).map(|(kind, value)| {
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
    known.collect::<Option<Vec<_>>>().filter(|_| values.len() == 8 * kinds.len()).ok_or_else(|| {
        let what = format!("{} bytes of values and {} of kinds are no verdicts", values.len(), kinds.len());
        Error::Structure { what, remedy: "start the search again".into() }
    })
}

/// The search of a stage made ready: its candidates are followed here or elsewhere, and taken in where its course is
/// kept.
#[pyclass(frozen, module = "ftlm._core")]
pub struct StageSearch {
    stage: Stage<'static>,
    course: Mutex<Option<Course>>,
}

impl StageSearch {
    /// Works on the course.
    fn course<T>(&self, work: impl FnOnce(&mut Course) -> Result<T, Error>) -> Result<T, Error> {
        let mut course = self.course.lock().unwrap_or_else(PoisonError::into_inner);
        let found = course.as_mut().ok_or_else(|| Error::Structure {
            what: "this search only follows candidates".into(),
            remedy: "make one that keeps its course".into(),
        })?;
        work(found)
    }
}

#[pymethods]
impl StageSearch {
    #[new]
    #[allow(clippy::needless_pass_by_value, clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        runs: Vec<RecordArg<'_>>,
        axes: Vec<Vec<f64>>,
        laws: Vec<LawEquationArg>,
        inputs: Vec<bool>,
        fixed: Vec<Vec<Option<f64>>>,
        scales: Vec<f64>,
        terms: InitialArg,
        settings: OptionsArg,
        keeps_course: bool,
    ) -> PyResult<Self> {
        let records = records(&runs)?;
        let options = options(settings, terms)?;
        let (stage, course) = watched(py, None, |control| {
            let lattice = law_lattice(&axes, laws, &inputs)?;
            let records = prepared(records, &inputs, &options)?;
            let pool = run::pool(options.threads)?;
            Stage::new(&records, Cow::Owned(lattice), &fixed, &scales, &options, &pool, control)
        })?;
        Ok(Self { stage, course: Mutex::new(keeps_course.then_some(course)) })
    }

    /// Candidates to follow next; none at the end.
    fn wanted(&self, py: Python<'_>) -> PyResult<Vec<SpanArg>> {
        super::errors::detached(py, || {
            self.course(|c| Ok(c.wanted().iter().map(|s| (s.equation, s.first, s.last, s.limit)).collect()))
        })
    }

    /// Candidates to follow in all, as far as is known, and the best score so far.
    fn state(&self, py: Python<'_>) -> PyResult<(u64, Option<f64>)> {
        super::errors::detached(py, || self.course(|c| Ok((c.total(), c.best()))))
    }

    /// What these candidates come to.
    #[allow(clippy::needless_pass_by_value)]
    fn follow<'py>(
        &self,
        py: Python<'py>,
        spans: Vec<SpanArg>,
        threads: usize,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<(Bound<'py, PyBytes>, Bound<'py, PyBytes>)> {
        let spans: Vec<Span> =
            spans.into_iter().map(|(equation, first, last, limit)| Span { equation, first, last, limit }).collect();
        let (values, kinds) = watched(py, progress.as_ref(), |control| {
            Ok(verdicts_of(&self.stage.evaluate(&spans, &run::pool(threads)?, control)?))
        })?;
        Ok((PyBytes::new(py, &values), PyBytes::new(py, &kinds)))
    }

    /// Takes in what the wanted candidates came to, in their order.
    fn take(&self, py: Python<'_>, values: &[u8], kinds: &[u8], threads: usize) -> PyResult<()> {
        watched(py, None, |control| {
            let found = verdicts(values, kinds)?;
            self.course(|course| course.take(&self.stage, &found, &run::pool(threads)?, control))
        })
    }

    /// The result, once nothing is wanted.
    fn outcome<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let outcome = watched(py, None, |control| self.course(|course| self.stage.outcome(course, control)))?;
        found_stage(py, self.stage.lattice(), outcome)
    }
}

/// Errors of candidates at orders and coefficients of their own.
#[pyclass(module = "ftlm._core")]
pub struct Points {
    inner: PointsOf,
    width: usize,
}

#[pymethods]
impl Points {
    #[new]
    #[allow(clippy::needless_pass_by_value)]
    fn new(
        runs: Vec<RecordArg<'_>>,
        output: usize,
        signals: Vec<usize>,
        inputs: Vec<bool>,
        squares: bool,
    ) -> PyResult<Self> {
        let width = signals.len();
        let norm = if squares { Norm::L2 } else { Norm::L1 };
        Ok(Self { inner: PointsOf::new(records(&runs)?, output, signals, inputs, norm)?, width })
    }

    /// Errors of candidates given as rows (alpha, orders, coefficients); infinite beyond the limit.
    #[allow(clippy::needless_pass_by_value)]
    fn scores<'py>(
        &mut self,
        py: Python<'py>,
        candidates: PyReadonlyArray2<'py, f64>,
        limit: f64,
        threads: usize,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let wanted = 1 + 2 * self.width;
        let points = rows(&candidates)
            .into_iter()
            .map(|row| {
                crate::error::check_length("a candidate", wanted, row.len())?;
                let (orders, coefficients) = row[1..].split_at(self.width);
                Ok(Point { order: row[0], orders: orders.to_vec(), coefficients: coefficients.to_vec() })
            })
            .collect::<Result<Vec<_>, Error>>()?;
        let inner = &mut self.inner;
        let found = watched(py, None, |control| inner.scores(&points, limit, threads, control))?;
        Ok(PyArray1::from_vec(py, found))
    }
}

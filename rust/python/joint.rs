//! The end of a joint fit: settled weights, refinement, covariance; numbers in the runs' own unit of time.

use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::PyKeyError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::arrays::{copied, initial, matrix, rows, stacked, vector, InitialArg};
use super::errors::{attached, detached};
use super::estimate::{experiment, free_equation, free_inputs, status, status_of, ExperimentArg, FreeEquationArg};
use super::friction::{free_laws, FrictionArg};
use super::lists::{nested, List};
use super::search::watch::{leavable, served, Desk, Stop};
use crate::colour;
use crate::error::{check_length, Error};
use crate::estimate::joint::covariance as spread;
use crate::estimate::joint::{self as ends, Attempt, Finished, Grid, Loss, Optimum, Place, Sampling, Source, Weights};
use crate::estimate::output_error::{Coordinate, Experiment, FreeModel};
use crate::statistics;

type Array<'py> = Bound<'py, PyArray1<f64>>;
type Table<'py> = Bound<'py, PyArray2<f64>>;
/// (weight of each output, pulses a sample interval, of how many samples one counts, shares by run or None, whether steady).
type GridArg<'py> = (List<f64>, usize, usize, Option<List<PyReadonlyArray2<'py, f64>>>, bool);
/// (values of everything free, states of each run).
type PlaceArg = (List<f64>, List<List<f64>>);
/// Sample interval and duration of each run \[s\].
type Spans = List<(f64, f64)>;

/// Runs that Python samples.
struct Asked<'a, T> {
    desk: &'a Desk<Sampling, Vec<Experiment>, T>,
    spans: Vec<(f64, f64)>,
}

impl<T> Source for Asked<'_, T> {
    fn spans(&self) -> Vec<(f64, f64)> {
        self.spans.clone()
    }

    fn experiments(&self, sampling: Sampling) -> Result<Vec<Experiment>, Error> {
        self.desk.ask(sampling)
    }
}

/// The answer to a request for runs on a grid.
fn sampling(runs: &Py<PyAny>) -> impl Fn(Python<'_>, Sampling) -> PyResult<Vec<Experiment>> + Send + Sync + '_ {
    |py, sampling| {
        let given: List<ExperimentArg<'_>> = runs.call1(py, (sampling.every, sampling.decimation))?.extract(py)?;
        given.iter().map(experiment).collect()
    }
}

fn weights(outputs: List<f64>, shares: Option<List<PyReadonlyArray2<'_, f64>>>) -> PyResult<Weights> {
    let shares = shares.map(|runs| runs.iter().map(rows).collect::<PyResult<_>>()).transpose()?;
    Ok(Weights { outputs: outputs.into(), shares })
}

fn loss(huber: bool) -> Loss {
    if huber {
        Loss::Huber
    } else {
        Loss::Squares
    }
}

/// An attempt as descents hand it over.
fn attempt(problem: &ends::Problem, found: &Bound<'_, PyDict>) -> PyResult<Attempt> {
    let get = |name: &str| found.get_item(name)?.ok_or_else(|| PyKeyError::new_err(name.to_owned()));
    let parts: [Vec<f64>; 3] = [
        get("orders")?.extract::<List<f64>>()?.into(),
        get("coefficients")?.extract::<List<f64>>()?.into(),
        get("inputs")?.extract::<List<f64>>()?.into(),
    ];
    let states = match found.get_item("states")? {
        Some(states) => nested(states.extract()?),
        None => Vec::new(),
    };
    let jacobian: Option<PyReadonlyArray2<'_, f64>> = get("jacobian")?.extract()?;
    let initial: List<List<List<f64>>> = get("initial")?.extract()?;
    Ok(Attempt {
        place: Place { point: problem.point(&parts.concat())?, states },
        cost: get("cost")?.extract()?,
        residuals: copied("residuals", &get("residuals")?.extract()?)?,
        jacobian: jacobian.as_ref().map_or_else(|| Ok(Vec::new()), rows)?,
        initial: initial.into_iter().map(nested).collect(),
        evaluations: get("evaluations")?.extract()?,
        status: status_of(&get("status")?.extract::<String>()?)?,
    })
}

/// An attempt as Python has it.
fn outcome<'py>(py: Python<'py>, found: Attempt) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    let Place { point, states } = found.place;
    dict.set_item("orders", point.orders)?;
    dict.set_item("coefficients", point.coefficients)?;
    dict.set_item("inputs", point.inputs)?;
    dict.set_item("states", states)?;
    dict.set_item("cost", found.cost)?;
    dict.set_item("residuals", PyArray1::from_vec(py, found.residuals))?;
    let none = found.jacobian.first().is_none_or(Vec::is_empty);
    dict.set_item("jacobian", if none { None } else { Some(stacked(py, &found.jacobian)?) })?;
    dict.set_item("initial", found.initial)?;
    dict.set_item("evaluations", found.evaluations)?;
    dict.set_item("status", status(found.status))?;
    Ok(dict)
}

/// Tables of every run.
fn tables<'py>(py: Python<'py>, runs: &[Vec<Vec<f64>>]) -> PyResult<Vec<Table<'py>>> {
    runs.iter().map(|run| stacked(py, run)).collect()
}

/// What is free in a joint fit.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointProblem {
    inner: Arc<ends::Problem>,
}

#[pymethods]
impl JointProblem {
    #[new]
    #[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)]
    fn new(
        outputs: List<String>,
        laws: List<FreeEquationArg>,
        order_bounds: List<(f64, f64)>,
        coefficients: usize,
        inputs: List<(usize, String, (f64, f64))>,
        coupled: bool,
        terms: InitialArg,
        frictions: List<FrictionArg>,
    ) -> PyResult<Self> {
        let initial = initial(terms)?;
        let inputs: Vec<_> = inputs.into_iter().map(|(signal, law, bounds)| (signal, law, bounds, 0.0)).collect();
        let inputs = free_inputs(&inputs)?;
        let equations = laws.into_iter().map(free_equation).collect();
        attached(|| {
            crate::error::check_points("coefficients", coefficients)?;
            let coordinates = vec![Coordinate::Plain; coefficients];
            let order_bounds = order_bounds.into();
            let model = FreeModel { equations, order_bounds, coordinates, inputs, coupled, initial };
            let inner = Arc::new(ends::Problem::new(outputs.into(), model, free_laws(frictions))?);
            Ok(Self { inner })
        })
    }

    /// Bounds of everything that is free.
    #[getter]
    fn bounds(&self) -> PyResult<Vec<(f64, f64)>> {
        attached(|| Ok(self.inner.bounds()))
    }

    /// The last point on the way from a feasible one to another that keeps bounds and constraints of orders.
    fn feasible<'py>(
        &self,
        py: Python<'py>,
        at: PyReadonlyArray1<'py, f64>,
        towards: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Array<'py>> {
        let (at, towards) = (vector("values to go from", &at)?, vector("values to go to", &towards)?);
        let found = detached(py, || self.inner.feasible(&at, &towards))?;
        Ok(PyArray1::from_vec(py, found))
    }

    /// Descents on a grid until the weights are those of the residuals: what the last one found, weights, shares.
    #[pyo3(signature = (runs, spans, grid, start, huber, stop=None))]
    #[allow(clippy::too_many_arguments, clippy::needless_pass_by_value, clippy::type_complexity)]
    fn settled<'py>(
        &self,
        py: Python<'py>,
        runs: Py<PyAny>,
        spans: Spans,
        grid: GridArg<'py>,
        start: PlaceArg,
        huber: bool,
        stop: Option<&Stop>,
    ) -> PyResult<(Bound<'py, PyDict>, Vec<f64>, Option<Vec<Table<'py>>>)> {
        let (outputs, every, decimation, shares, steady) = grid;
        let weights = weights(outputs, shares)?;
        let start = Place { point: self.inner.point(&start.0)?, states: nested(start.1) };
        let problem = Arc::clone(&self.inner);
        let (found, weights) = served(py, stop, sampling(&runs), move |stop, desk| {
            let source = Asked { desk, spans: spans.into() };
            let sampling = Sampling { every, decimation, first: None };
            let grid = Grid::new((&problem, &source, stop), weights, sampling, steady)?;
            let (found, grid) = ends::settled(&start, grid, loss(huber))?;
            Ok((found, grid.weights))
        })?;
        let shares = weights.shares.map(|shares| tables(py, &shares)).transpose()?;
        Ok((outcome(py, found)?, weights.outputs, shares))
    }

    /// An optimum on grids fine enough, with all that describes it.
    #[pyo3(signature = (runs, spans, grid, found, others, huber, refine, stop=None))]
    #[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)]
    fn finished<'py>(
        &self,
        py: Python<'py>,
        runs: Py<PyAny>,
        spans: Spans,
        grid: GridArg<'py>,
        found: Bound<'py, PyDict>,
        others: List<PlaceArg>,
        huber: bool,
        refine: bool,
        stop: Option<&Stop>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (outputs, every, decimation, shares, steady) = grid;
        let weights = weights(outputs, shares)?;
        let best = attempt(&self.inner, &found)?;
        let others = (others.into_iter())
            .map(|(values, states)| Ok(Place { point: self.inner.point(&values)?, states: nested(states) }))
            .collect::<PyResult<Vec<_>>>()?;
        let problem = Arc::clone(&self.inner);
        let finished = served(py, stop, sampling(&runs), move |stop, desk| {
            let source = Asked { desk, spans: spans.into() };
            let sampling = Sampling { every, decimation, first: None };
            let grid = Grid::new((&problem, &source, stop), weights, sampling, steady)?;
            grid.check(&best)?;
            let optimum =
                if refine { ends::refined(best, grid, loss(huber), &others)? } else { Optimum::unrefined(best, grid)? };
            Ok(optimum.finished())
        })?;
        described(py, finished, self.inner.size())
    }

    /// The unit of time of runs, each told by its sample interval and its duration.
    #[allow(clippy::needless_pass_by_value)]
    fn clock(&self, spans: Spans) -> PyResult<JointClock> {
        attached(|| {
            spans.iter().try_for_each(|&(step, duration)| {
                crate::error::check_step(step)?;
                crate::error::check_step(duration)
            })?;
            Ok(JointClock { inner: ends::Clock::of(&self.inner, &spans), size: self.inner.size() })
        })
    }
}

fn described(py: Python<'_>, finished: Finished, size: usize) -> PyResult<Bound<'_, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("weights", finished.weights.outputs)?;
    dict.set_item("shares", finished.weights.shares.map(|shares| tables(py, &shares)).transpose()?)?;
    dict.set_item("every", finished.every)?;
    dict.set_item("estimate", finished.estimate)?;
    dict.set_item("settled", finished.settled)?;
    dict.set_item("covariance", matrix(py, finished.covariance, size)?)?;
    dict.set_item("noise", finished.noise)?;
    dict.set_item("left", tables(py, &finished.residuals)?)?;
    dict.set_item("robust", finished.robust.map(|robust| (robust.lowered, robust.outliers, robust.samples)))?;
    dict.set_item("attempt", outcome(py, finished.attempt)?)?;
    Ok(dict)
}

/// Numbers of a fit in a unit of time of the runs' own.
#[pyclass(module = "ftlm._core", frozen)]
pub struct JointClock {
    inner: ends::Clock,
    size: usize,
}

impl JointClock {
    fn values(&self, name: &str, array: &PyReadonlyArray1<'_, f64>) -> PyResult<Vec<f64>> {
        let values = copied(name, array)?;
        check_length(name, self.size, values.len())?;
        Ok(values)
    }
}

#[pymethods]
impl JointClock {
    /// ln of the unit of time.
    #[getter]
    fn unit(&self) -> PyResult<f64> {
        attached(|| Ok(self.inner.unit()))
    }

    /// Parameters in the unit.
    fn told<'py>(&self, py: Python<'py>, values: PyReadonlyArray1<'py, f64>) -> PyResult<Array<'py>> {
        let values = self.values("values", &values)?;
        Ok(PyArray1::from_vec(py, attached(|| Ok(self.inner.told(&values)))?))
    }

    /// Parameters from those in the unit.
    fn untold<'py>(&self, py: Python<'py>, values: PyReadonlyArray1<'py, f64>) -> PyResult<Array<'py>> {
        let values = self.values("values", &values)?;
        Ok(PyArray1::from_vec(py, attached(|| Ok(self.inner.untold(&values)))?))
    }

    /// A small step of the parameters at some values, from the one in the unit.
    fn step<'py>(
        &self,
        py: Python<'py>,
        values: PyReadonlyArray1<'py, f64>,
        moved: PyReadonlyArray1<'py, f64>,
    ) -> PyResult<Array<'py>> {
        let (values, moved) = (self.values("values", &values)?, self.values("step", &moved)?);
        Ok(PyArray1::from_vec(py, attached(|| Ok(self.inner.step(&values, &moved)))?))
    }

    /// Standard errors in the unit; infinite where the runs do not see all that takes part.
    fn errors<'py>(
        &self,
        py: Python<'py>,
        values: PyReadonlyArray1<'py, f64>,
        covariance: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Array<'py>> {
        let (values, spread) = (self.values("values", &values)?, rows(&covariance)?);
        check_length("rows of a covariance", self.size, spread.len())?;
        spread.iter().try_for_each(|row| check_length("a row of a covariance", self.size, row.len()))?;
        Ok(PyArray1::from_vec(py, attached(|| Ok(self.inner.errors(&values, &spread.concat())))?))
    }
}

fn all_copied(name: &str, arrays: &[PyReadonlyArray1<'_, f64>]) -> PyResult<Vec<Vec<f64>>> {
    arrays.iter().map(|array| copied(name, array)).collect()
}

/// Covariance from a Jacobian, a row a parameter, residuals by run and output, and the sum of their squares.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn covariance_of<'py>(
    py: Python<'py>,
    jacobian: PyReadonlyArray2<'py, f64>,
    series: List<PyReadonlyArray1<'py, f64>>,
    squares: f64,
) -> PyResult<Table<'py>> {
    let (jacobian, series) = (rows(&jacobian)?, all_copied("residuals", &series)?);
    let (size, points) = (jacobian.len(), jacobian.iter().map(Vec::len).sum());
    let found = leavable(py, points, None, move |_| spread::of_residuals(&jacobian, &series, squares))?;
    matrix(py, found, size)
}

/// The same of a fit, whose residuals may have counted by shares.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn fit_covariance<'py>(
    py: Python<'py>,
    jacobian: PyReadonlyArray2<'py, f64>,
    series: List<PyReadonlyArray1<'py, f64>>,
    shares: Option<PyReadonlyArray1<'py, f64>>,
) -> PyResult<Table<'py>> {
    let (jacobian, series) = (rows(&jacobian)?, all_copied("residuals", &series)?);
    let shares = shares.map(|shares| vector("shares", &shares)).transpose()?;
    let (size, points) = (jacobian.len(), jacobian.iter().map(Vec::len).sum());
    let found = leavable(py, points, None, move |_| spread::of_fit(&jacobian, series, shares.as_deref()))?;
    matrix(py, found, size)
}

/// Covariance of sums of scores with Bartlett weights.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn long_run<'py>(
    py: Python<'py>,
    jacobian: PyReadonlyArray2<'py, f64>,
    series: List<PyReadonlyArray1<'py, f64>>,
) -> PyResult<Table<'py>> {
    let (jacobian, series) = (rows(&jacobian)?, all_copied("residuals", &series)?);
    let (size, points) = (jacobian.len(), jacobian.iter().map(Vec::len).sum());
    let found = leavable(py, points, None, move |_| spread::long_run(&jacobian, &series))?;
    matrix(py, found, size)
}

/// The whitening filter of series that share one colour, and the power that it leaves.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn coloured<'py>(
    py: Python<'py>,
    series: List<PyReadonlyArray1<'py, f64>>,
    most: usize,
) -> PyResult<(Array<'py>, f64)> {
    let series = all_copied("series", &series)?;
    let points = series.iter().map(Vec::len).sum::<usize>().saturating_mul(most.max(1));
    let (filter, power) = leavable(py, points, None, move |_| {
        Ok(colour::coloured(&series.iter().map(Vec::as_slice).collect::<Vec<_>>(), most))
    })?;
    Ok((PyArray1::from_vec(py, filter), power))
}

/// Autocovariances of noise that a filter makes white.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn colour_covariances<'py>(
    py: Python<'py>,
    through: PyReadonlyArray1<'py, f64>,
    power: f64,
    count: usize,
) -> PyResult<Array<'py>> {
    let through = vector("filter", &through)?;
    let found = leavable(py, count, None, move |_| {
        // A circle of many times as many points holds them.
        crate::error::check_points("points for autocovariances", count.saturating_mul(16))?;
        Ok(colour::covariances(&through, power, count))
    })?;
    Ok(PyArray1::from_vec(py, found))
}

/// Autocovariances of series at lags from 0, and how many pairs each is the mean of.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn autocovariances<'py>(
    py: Python<'py>,
    series: List<PyReadonlyArray1<'py, f64>>,
    most: usize,
) -> PyResult<(Array<'py>, Array<'py>)> {
    let series = all_copied("series", &series)?;
    let points = series.iter().map(Vec::len).sum::<usize>().saturating_mul(most.max(1));
    let (sums, pairs) = leavable(py, points, None, move |_| {
        crate::error::check_points("lags by 256", most.saturating_mul(256))?;
        Ok(statistics::autocovariances(&series.iter().map(Vec::as_slice).collect::<Vec<_>>(), most))
    })?;
    Ok((PyArray1::from_vec(py, sums), PyArray1::from_vec(py, pairs)))
}

/// Whether autocorrelations of a series could be those of white noise.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn is_white(py: Python<'_>, series: PyReadonlyArray1<'_, f64>, lags: usize) -> PyResult<bool> {
    let series = copied("series", &series)?;
    leavable(py, series.len(), None, move |_| Ok(statistics::is_white(&series, lags)))
}

/// Value that chi-squared exceeds as often as a normal variable exceeds a quantile.
#[pyfunction]
pub fn chi_squared(degrees: f64, quantile: f64) -> PyResult<f64> {
    attached(|| Ok(statistics::chi_squared(degrees, quantile)))
}

//! Conversion from and to Python: arrays, lists, records, structures and equations.

use std::ops::Deref;

use numpy::{PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::conversion::FromPyObjectOwned;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PyString, PyTuple};

use crate::equation::{Equation, Initial, Structure, Term};
use crate::error::{check_finite, check_points, Error};
use crate::estimation::multi_innovation::Prior;
use crate::expression::{DerivedSignal, Expression, Instruction};
use crate::regressors::Record;

/// Maximum number of values of a two-dimensional array, which take eight gigabytes.
const MAX_VALUES: usize = 1 << 30;

/// Record: (step, signals as rows, power series of the sensor filter or None).
#[derive(FromPyObject)]
pub enum RecordArg<'py> {
    /// Record with nonzero initial conditions. The last element is (flag of a filter transient in each signal, initial
    /// levels, filter responses or None). Rows of the filter responses belong to an impulse and its derivatives.
    WithInitialState(
        f64,
        PyReadonlyArray2<'py, f64>,
        Option<PyReadonlyArray1<'py, f64>>,
        (List<bool>, List<f64>, Option<PyReadonlyArray2<'py, f64>>),
    ),
    Plain(f64, PyReadonlyArray2<'py, f64>, Option<PyReadonlyArray1<'py, f64>>),
}
/// Structure: (output, alpha, [(signal, order), …]).
pub type StructureArg = (usize, f64, List<(usize, f64)>);
/// Equation: (structure, coefficients).
pub type EquationArg = (StructureArg, List<f64>);
/// Initial terms: (true for the powers of t of Caputo derivatives, exponents that are used if the flag is false).
#[derive(FromPyObject)]
pub enum InitialArg {
    /// Initial terms with an offset as in `Offset`, and with the number of impulses of a filter transient.
    Filtered(bool, List<f64>, u8, u8),
    /// Initial terms with an offset: 0 for none, 1 for a constant, 2 for a constant and a ramp, 3 for an output level.
    Offset(bool, List<f64>, u8),
    Plain(bool, List<f64>),
}

/// Description of a derived signal: ([(name, number), …] of the instructions of its expression, [(signal, order of the
/// derivative), …] of its channels).
pub type DerivedArg = (List<(String, f64)>, List<(usize, f64)>);

pub fn derived_signals(arguments: List<DerivedArg>) -> PyResult<Vec<DerivedSignal>> {
    let signal = |(program, channels): DerivedArg| {
        let program = program.iter().map(|(name, value)| Instruction::parse(name, *value)).collect::<Result<_, _>>()?;
        DerivedSignal::new(Expression::new(program, channels.len())?, channels.into())
    };
    Ok(arguments.into_iter().map(signal).collect::<Result<_, Error>>()?)
}

/// Copy a one-dimensional array to a vector. Return an error for a value that is not finite.
pub fn vector(name: &str, array: &PyReadonlyArray1<'_, f64>) -> PyResult<Vec<f64>> {
    let values = copy_vector(name, array)?;
    check_finite(name, &values)?;
    Ok(values)
}

/// Copy a one-dimensional array to a vector, without a check of its values.
pub fn copy_vector(name: &str, array: &PyReadonlyArray1<'_, f64>) -> PyResult<Vec<f64>> {
    check_points(&format!("length of {name}"), array.len())?;
    Ok(array.as_array().iter().copied().collect())
}

/// Return an error for a two-dimensional array that is too large. An array with zero strides may seem larger than
/// memory.
pub fn check_size(array: &PyReadonlyArray2<'_, f64>) -> PyResult<()> {
    let [rows, columns] = [array.shape()[0], array.shape()[1]];
    check_points("rows of an array", rows)?;
    check_points("columns of an array", columns)?;
    if rows.saturating_mul(columns) > MAX_VALUES {
        let what = format!("an array of {rows} rows and {columns} columns");
        return Err(Error::Structure { what, remedy: format!("give at most {MAX_VALUES} values at once") }.into());
    }
    Ok(())
}

/// Copy the rows of a two-dimensional array to vectors.
pub fn rows(array: &PyReadonlyArray2<'_, f64>) -> PyResult<Vec<Vec<f64>>> {
    check_size(array)?;
    Ok(array.as_array().outer_iter().map(|row| row.iter().copied().collect()).collect())
}

pub fn record(argument: &RecordArg<'_>) -> PyResult<Record> {
    let (step, signals, filter, initial_state) = match argument {
        RecordArg::WithInitialState(step, signals, filter, initial_state) => {
            (step, signals, filter, Some(initial_state))
        }
        RecordArg::Plain(step, signals, filter) => (step, signals, filter, None),
    };
    let filter = filter.as_ref().map(|f| vector("filter", f)).transpose()?;
    let record = Record::from_rows(*step, rows(signals)?, filter)?;
    Ok(match initial_state {
        Some((has_transient, levels, impulse_responses)) => {
            let impulse_responses = impulse_responses.as_ref().map(rows).transpose()?.unwrap_or_default();
            record.with_initial_state(has_transient.to_vec(), levels, impulse_responses)?
        }
        None => record,
    })
}

pub fn records(arguments: &[RecordArg<'_>]) -> PyResult<Vec<Record>> {
    arguments.iter().map(record).collect()
}

/// Build and check a structure for a record with this number of signals. `inputs` is true for the inputs among them.
pub fn structure(argument: StructureArg, signals: usize, inputs: &[bool]) -> PyResult<Structure> {
    let structure = Structure {
        output: argument.0,
        order: argument.1,
        terms: argument.2.into_iter().map(|(signal, order)| Term { signal, order }).collect(),
    };
    structure.check(signals, |s| inputs.get(s).copied().unwrap_or(false))?;
    Ok(structure)
}

pub fn equations(arguments: List<EquationArg>, signals: usize, inputs: &[bool]) -> PyResult<Vec<Equation>> {
    arguments
        .into_iter()
        .map(|(s, coefficients)| {
            // A model estimated with an order law may have an order slightly below 0. It is simulated without
            // correction.
            let structure = structure(s, signals, &vec![true; inputs.len()])?;
            Ok(Equation::new(structure, coefficients.into())?)
        })
        .collect()
}

/// Return the prior covariance of multi-innovation least squares; None stands for a weak prior.
pub fn prior(covariance: Option<f64>) -> Prior {
    covariance.map_or(Prior::WEAK, Prior::Absolute)
}

pub fn initial(argument: InitialArg) -> PyResult<Initial> {
    let (caputo, powers, offset, states) = match argument {
        InitialArg::Filtered(caputo, powers, offset, states) => (caputo, powers, offset, states),
        InitialArg::Offset(caputo, powers, offset) => (caputo, powers, offset, 0),
        InitialArg::Plain(caputo, powers) => (caputo, powers, 0, 0),
    };
    let powers = Initial::Powers(powers.into());
    powers.check()?;
    let base = match powers {
        _ if caputo => Initial::Caputo,
        Initial::Powers(powers) if powers.is_empty() => Initial::Rest,
        powers => powers,
    };
    Ok(base.with_offset(offset)?.with_states(states))
}

/// Convert a row-major matrix with `rows` rows to an array.
pub fn matrix<'py>(py: Python<'py>, values: Vec<f64>, rows: usize) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let columns = values.len().checked_div(rows).unwrap_or(0);
    PyArray1::from_vec(py, values).reshape([rows, columns])
}

/// Stack vectors of equal length as the rows of an array.
pub fn stack_rows<'py>(py: Python<'py>, vectors: &[Vec<f64>]) -> PyResult<Bound<'py, PyArray2<f64>>> {
    matrix(py, vectors.concat(), vectors.len())
}

/// Return the length of the last axis of an array.
pub fn column_count(array: &PyReadonlyArray2<'_, f64>) -> usize {
    array.shape()[1]
}

/// Maximum number of items of a sequence that is neither a list nor a tuple. Lists and tuples are already in memory and
/// need no limit.
const MAX_ITEMS: usize = 1 << 24;

/// Vector that can be extracted from any Python sequence.
#[derive(IntoPyObject)]
#[pyo3(transparent)]
pub struct List<T>(Vec<T>);

impl<T> Default for List<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<'py, T: FromPyObjectOwned<'py>> FromPyObject<'_, 'py> for List<T> {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let item = |item: Bound<'py, PyAny>| item.extract::<T>().map_err(Into::into);
        if let Ok(list) = object.cast::<PyList>() {
            return list.iter().map(item).collect::<PyResult<_>>().map(Self);
        }
        if let Ok(tuple) = object.cast::<PyTuple>() {
            return tuple.iter().map(item).collect::<PyResult<_>>().map(Self);
        }
        let is_text_or_mapping = object.is_instance_of::<PyString>() || object.is_instance_of::<PyDict>();
        if is_text_or_mapping || !object.hasattr("__getitem__")? {
            return Err(PyTypeError::new_err(format!("{} is not a sequence", object.get_type().name()?)));
        }
        let length = object.len()?;
        if length > MAX_ITEMS {
            let what = format!("a sequence of {length} items");
            return Err(Error::Structure { what, remedy: format!("give a list, or at most {MAX_ITEMS}") }.into());
        }
        let mut items = Vec::new();
        for next in object.try_iter()? {
            if items.len() == length {
                let what = format!("a sequence with a stated length of {length} that has more items");
                return Err(Error::Structure { what, remedy: "give a list".into() }.into());
            }
            items.push(item(next?)?);
        }
        Ok(Self(items))
    }
}

impl<T> Deref for List<T> {
    type Target = Vec<T>;

    fn deref(&self) -> &Vec<T> {
        &self.0
    }
}

impl<T> From<List<T>> for Vec<T> {
    fn from(list: List<T>) -> Self {
        list.0
    }
}

impl<T> From<Vec<T>> for List<T> {
    fn from(items: Vec<T>) -> Self {
        Self(items)
    }
}

impl<T> FromIterator<T> for List<T> {
    fn from_iter<I: IntoIterator<Item = T>>(items: I) -> Self {
        Self(items.into_iter().collect())
    }
}

impl<T> IntoIterator for List<T> {
    type Item = T;
    type IntoIter = std::vec::IntoIter<T>;

    fn into_iter(self) -> Self::IntoIter {
        self.0.into_iter()
    }
}

/// Convert lists of lists to vectors of vectors.
pub fn to_vectors<T>(lists: List<List<T>>) -> Vec<Vec<T>> {
    lists.into_iter().map(Vec::from).collect()
}

/// Convert vectors of vectors to lists of lists.
pub fn to_lists<T>(vectors: Vec<Vec<T>>) -> List<List<T>> {
    vectors.into_iter().map(List::from).collect()
}

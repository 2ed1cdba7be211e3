//! Arrays and tuples from Python become records, structures and equations; results become arrays.

use numpy::{PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use crate::equation::{Equation, Initial, Structure, Term};
use crate::error::check_finite;
use crate::regressors::Record;

/// (step, signals as rows, series of the sensor filter or None).
pub type RecordArg<'py> = (f64, PyReadonlyArray2<'py, f64>, Option<PyReadonlyArray1<'py, f64>>);
/// (output, alpha, [(signal, order), …]).
pub type StructureArg = (usize, f64, Vec<(usize, f64)>);
/// A structure and its coefficients.
pub type EquationArg = (StructureArg, Vec<f64>);
/// (whether Caputo's powers, else these exponents).
#[derive(FromPyObject)]
pub enum InitialArg {
    /// With offset and the number of impulses that a filter holds.
    Filtered(bool, Vec<f64>, u8, u8),
    /// With offset: 0 none, 1 a constant, 2 a constant and a ramp.
    Offset(bool, Vec<f64>, u8),
    Plain(bool, Vec<f64>),
}

/// A one-dimensional array as a vector, refused if it holds a value that is not finite.
pub fn vector(name: &str, array: &PyReadonlyArray1<'_, f64>) -> PyResult<Vec<f64>> {
    let values: Vec<f64> = array.as_array().iter().copied().collect();
    check_finite(name, &values)?;
    Ok(values)
}

/// Rows of a two-dimensional array.
pub fn rows(array: &PyReadonlyArray2<'_, f64>) -> Vec<Vec<f64>> {
    array.as_array().outer_iter().map(|row| row.iter().copied().collect()).collect()
}

pub fn record(argument: &RecordArg<'_>) -> PyResult<Record> {
    let filter = argument.2.as_ref().map(|f| vector("filter", f)).transpose()?;
    Ok(Record::new(argument.0, rows(&argument.1), filter)?)
}

pub fn records(arguments: &[RecordArg<'_>]) -> PyResult<Vec<Record>> {
    arguments.iter().map(record).collect()
}

/// A structure that the records can carry; inputs are all signals that `is_input` says.
pub fn structure(argument: StructureArg, signals: usize, inputs: &[bool]) -> PyResult<Structure> {
    let structure = Structure {
        output: argument.0,
        order: argument.1,
        terms: argument.2.into_iter().map(|(signal, order)| Term { signal, order }).collect(),
    };
    structure.check(signals, |s| inputs.get(s).copied().unwrap_or(false))?;
    Ok(structure)
}

pub fn equations(arguments: Vec<EquationArg>, signals: usize, inputs: &[bool]) -> PyResult<Vec<Equation>> {
    arguments
        .into_iter()
        .map(|(s, coefficients)| {
            // A model that was estimated under an order law may have an order a little below 0; it is simulated as it is.
            let structure = structure(s, signals, &vec![true; inputs.len()])?;
            Ok(Equation::new(structure, coefficients)?)
        })
        .collect()
}

pub fn initial(argument: InitialArg) -> PyResult<Initial> {
    let (caputo, powers, offset, states) = match argument {
        InitialArg::Filtered(caputo, powers, offset, states) => (caputo, powers, offset, states),
        InitialArg::Offset(caputo, powers, offset) => (caputo, powers, offset, 0),
        InitialArg::Plain(caputo, powers) => (caputo, powers, 0, 0),
    };
    let powers = Initial::Powers(powers);
    powers.check()?;
    let under = match powers {
        _ if caputo => Initial::Caputo,
        Initial::Powers(powers) if powers.is_empty() => Initial::Rest,
        powers => powers,
    };
    Ok(under.with_offset(offset)?.with_states(states))
}

/// A row-major matrix as an array.
pub fn matrix<'py>(py: Python<'py>, values: Vec<f64>, rows: usize) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let columns = values.len().checked_div(rows).unwrap_or(0);
    PyArray1::from_vec(py, values).reshape([rows, columns])
}

/// Vectors of equal length as the rows of an array.
pub fn stacked<'py>(py: Python<'py>, vectors: &[Vec<f64>]) -> PyResult<Bound<'py, PyArray2<f64>>> {
    matrix(py, vectors.concat(), vectors.len())
}

/// Length of the last axis.
pub fn columns(array: &PyReadonlyArray2<'_, f64>) -> usize {
    array.shape()[1]
}

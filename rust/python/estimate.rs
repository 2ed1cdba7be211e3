//! Least squares and multi-innovation least squares at given orders.

use numpy::PyArray2;
use pyo3::prelude::*;

use super::arrays::{initial, records, stacked, structure, InitialArg, RecordArg, StructureArg};
use super::errors::detached;
use crate::estimate::least_squares::Estimate;
use crate::estimate::multi_innovation::{Innovation, Rows};
use crate::estimate::{least_squares as batch, multi_innovation as stepwise};

/// (coefficients, initial terms per record, exponents, dropped (record, position) pairs).
pub type EstimateTuple = (Vec<f64>, Vec<Vec<f64>>, Vec<f64>, Vec<(usize, usize)>);

fn tuple(estimate: Estimate) -> EstimateTuple {
    (estimate.coefficients, estimate.initial, estimate.exponents, estimate.dropped)
}

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn least_squares(
    py: Python<'_>,
    runs: Vec<RecordArg<'_>>,
    equation: StructureArg,
    inputs: Vec<bool>,
    fixed: Vec<Option<f64>>,
    terms: InitialArg,
) -> PyResult<EstimateTuple> {
    let records = records(&runs)?;
    let structure = structure(equation, inputs.len(), &inputs)?;
    let initial = initial(terms)?;
    Ok(tuple(detached(py, || batch::fit(&records, &structure, &fixed, &initial))?))
}

#[pyfunction]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value, clippy::type_complexity)]
pub fn multi_innovation<'py>(
    py: Python<'py>,
    runs: Vec<RecordArg<'py>>,
    equation: StructureArg,
    inputs: Vec<bool>,
    fixed: Vec<Option<f64>>,
    terms: InitialArg,
    length: usize,
    prior_covariance: f64,
    haar: bool,
    recursion: bool,
) -> PyResult<(EstimateTuple, Option<Bound<'py, PyArray2<f64>>>)> {
    let records = records(&runs)?;
    let structure = structure(equation, inputs.len(), &inputs)?;
    let initial = initial(terms)?;
    let innovation = Innovation { length, prior_covariance, rows: if haar { Rows::Haar } else { Rows::Time } };
    if recursion {
        let (estimate, trace) =
            detached(py, || stepwise::recursion(&records, &structure, &fixed, &initial, &innovation))?;
        return Ok((tuple(estimate), Some(stacked(py, &trace)?)));
    }
    let estimate = detached(py, || stepwise::closed_form(&records, &structure, &fixed, &initial, &innovation))?;
    Ok((tuple(estimate), None))
}

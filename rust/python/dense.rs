//! Factors of tall matrices, given by their columns as rows of an array.

use numpy::{PyArray1, PyArray2, PyReadonlyArray2};
use pyo3::prelude::*;

use super::convert::{columns, matrix, rows, stacked};
use crate::error::{check_finite, Error};
use crate::linalg::dense;
use crate::python::order_search::watch::leavable;

type Matrix<'py> = Bound<'py, PyArray2<f64>>;

fn finite(array: &PyReadonlyArray2<'_, f64>) -> PyResult<Vec<Vec<f64>>> {
    let given = rows(array)?;
    for column in &given {
        check_finite("a column", column)?;
    }
    Ok(given)
}

#[pyfunction]
pub fn triangle<'py>(py: Python<'py>, given: PyReadonlyArray2<'py, f64>) -> PyResult<Matrix<'py>> {
    let tall = finite(&given)?;
    let count = tall.len();
    let factor = leavable(py, columns(&given), None, move |_| Ok(dense::triangular_factor(&tall)))?;
    matrix(py, factor, count)
}

#[pyfunction]
#[allow(clippy::type_complexity)]
pub fn singular<'py>(
    py: Python<'py>,
    given: PyReadonlyArray2<'py, f64>,
) -> PyResult<(Matrix<'py>, Bound<'py, PyArray1<f64>>, Matrix<'py>)> {
    let tall = finite(&given)?;
    let found = leavable(py, columns(&given), None, move |_| {
        dense::singular(&tall).ok_or_else(|| Error::Structure {
            what: "singular values are not found".into(),
            remedy: "scale the columns".into(),
        })
    })?;
    Ok((stacked(py, &found.left)?, PyArray1::from_vec(py, found.sizes), stacked(py, &found.right)?))
}

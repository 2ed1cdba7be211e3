//! Lists from Python whose told length is not believed: a range, or an object of one's own, may claim more than memory.

use std::ops::Deref;

use pyo3::conversion::FromPyObjectOwned;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PyString, PyTuple};

use crate::error::Error;

/// Items of a sequence that is neither list nor tuple, at most: those two hold what they tell of already.
const MOST_ITEMS: usize = 1 << 24;

/// A vector from any sequence of Python.
#[derive(IntoPyObject)]
#[pyo3(transparent)]
pub struct List<T>(Vec<T>);

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
        let words = object.is_instance_of::<PyString>() || object.is_instance_of::<PyDict>();
        if words || !object.hasattr("__getitem__")? {
            return Err(PyTypeError::new_err(format!("{} is no sequence", object.get_type().name()?)));
        }
        let told = object.len()?;
        if told > MOST_ITEMS {
            let what = format!("a sequence of {told} items");
            return Err(Error::Structure { what, remedy: format!("give a list, or at most {MOST_ITEMS}") }.into());
        }
        let mut items = Vec::new();
        for next in object.try_iter()? {
            if items.len() == told {
                let what = format!("a sequence that tells of {told} items and hands over more");
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

/// Lists of lists as vectors of vectors.
pub fn nested<T>(lists: List<List<T>>) -> Vec<Vec<T>> {
    lists.into_iter().map(Vec::from).collect()
}

/// Vectors of vectors as lists of lists.
pub fn lists<T>(vectors: Vec<Vec<T>>) -> List<List<T>> {
    vectors.into_iter().map(List::from).collect()
}

//! From Python objects to what the core takes. Wrong kinds are told here, with the name
//! of the argument; wrong values by the core.

use adaptgns_core::threads::Threads;
use numpy::prelude::*;
use numpy::{Element, PyArrayDyn, PyReadonlyArrayDyn, PyUntypedArray};
use pyo3::exceptions::{PyOverflowError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyComplex, PyFloat};
use std::num::NonZeroUsize;

/// An array of real numbers, borrowed where it lies if its memory is in order.
pub enum Reals<'py> {
    Single(PyReadonlyArrayDyn<'py, f32>),
    Double(PyReadonlyArrayDyn<'py, f64>),
}

/// Evaluates an expression for the slice in a [`Reals`], whichever kind it holds.
macro_rules! with_slice {
    ($reals:expr, $slice:ident => $body:expr) => {
        match $reals {
            $crate::arguments::Reals::Single(array) => {
                let $slice = array.as_slice()?;
                $body
            }
            $crate::arguments::Reals::Double(array) => {
                let $slice = array.as_slice()?;
                $body
            }
        }
    };
}
pub(crate) use with_slice;

/// A float32 or float64 array of `axes` axes.
pub fn reals<'py>(argument: &str, value: &Bound<'py, PyAny>, axes: usize) -> PyResult<Reals<'py>> {
    if let Some(array) = array(argument, value, axes)? {
        return Ok(Reals::Single(array));
    }
    if let Some(array) = array(argument, value, axes)? {
        return Ok(Reals::Double(array));
    }
    Err(wrong_kind(
        argument,
        value,
        "a numpy array of float32 or float64",
    ))
}

/// An int64 vector.
pub fn offsets<'py>(
    argument: &str,
    value: &Bound<'py, PyAny>,
) -> PyResult<PyReadonlyArrayDyn<'py, i64>> {
    array(argument, value, 1)?.ok_or_else(|| wrong_kind(argument, value, "a numpy array of int64"))
}

/// A bool vector. What numpy takes for true may be any byte but 0, as in a view of an image mask.
pub fn flags(argument: &str, value: &Bound<'_, PyAny>) -> PyResult<Vec<bool>> {
    if value.cast::<PyArrayDyn<bool>>().is_err() {
        return Err(wrong_kind(argument, value, "a numpy array of bool"));
    }
    let bytes = value.call_method1("view", ("uint8",))?;
    let bytes = array::<u8>(argument, &bytes, 1)?
        .ok_or_else(|| wrong_kind(argument, value, "a numpy array of bool"))?;
    Ok(bytes.as_slice()?.iter().map(|&byte| byte != 0).collect())
}

/// A finite sequence of numbers: a list, a tuple, a vector.
pub fn numbers(argument: &str, value: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    let items = value
        .try_iter()
        .map_err(|_| wrong_kind(argument, value, "a sequence of numbers"))?;
    items.map(|item| number(argument, &item?)).collect()
}

/// A real number, but no bool and no array; infinite where it is too large for a float64.
pub fn number(argument: &str, value: &Bound<'_, PyAny>) -> PyResult<f64> {
    if let Ok(number) = value.cast_exact::<PyFloat>() {
        return Ok(number.value());
    }
    let kind = value
        .getattr("dtype")
        .and_then(|dtype| dtype.getattr("kind"));
    let refused = value.is_instance_of::<PyBool>()
        || value.is_instance_of::<PyComplex>()
        || kind.is_ok_and(|kind| !"iuf".contains(&kind.to_string()))
        || value
            .cast::<PyUntypedArray>()
            .is_ok_and(|array| array.ndim() > 0);
    match value.extract() {
        _ if refused => {}
        Ok(number) => return Ok(number),
        Err(error) if error.is_instance_of::<PyOverflowError>(value.py()) => {
            return Ok(if value.lt(0)? {
                -f64::INFINITY
            } else {
                f64::INFINITY
            });
        }
        Err(_) => {}
    }
    Err(wrong_kind(argument, value, "a number"))
}

/// An integer of at least 1.
pub fn count(argument: &str, value: &Bound<'_, PyAny>) -> PyResult<NonZeroUsize> {
    if value.is_instance_of::<PyBool>() {
        return Err(wrong_kind(argument, value, "an integer"));
    }
    let py = value.py();
    match value.extract::<i64>() {
        Ok(number) => usize::try_from(number).ok().and_then(NonZeroUsize::new),
        Err(error) if error.is_instance_of::<PyOverflowError>(py) => None,
        Err(_) => return Err(wrong_kind(argument, value, "an integer")),
    }
    .ok_or_else(|| {
        PyValueError::new_err(format!(
            "{argument}: got {value}, must be an integer of at least 1"
        ))
    })
}

/// How many threads `threads` asks for.
pub fn threads(value: Option<&Bound<'_, PyAny>>) -> PyResult<Threads> {
    value.map_or(Ok(Threads::All), |value| {
        count("threads", value).map(Threads::AtMost)
    })
}

/// `None` if `value` is no array of this element type; an error if it has another number
/// of axes. An array that is not contiguous or aligned is copied, no other.
fn array<'py, T: Element>(
    argument: &str,
    value: &Bound<'py, PyAny>,
    axes: usize,
) -> PyResult<Option<PyReadonlyArrayDyn<'py, T>>> {
    let Ok(array) = value.cast::<PyArrayDyn<T>>() else {
        return Ok(None);
    };
    if array.ndim() != axes {
        return Err(PyValueError::new_err(format!(
            "{argument}: got an array of {} axes, must have {axes}",
            array.ndim()
        )));
    }
    if array.is_c_contiguous() && array.is_aligned() {
        return Ok(Some(array.try_readonly()?));
    }
    let copy = array.call_method1("copy", ("C",))?;
    Ok(Some(copy.cast_into::<PyArrayDyn<T>>()?.try_readonly()?))
}

fn wrong_kind(argument: &str, value: &Bound<'_, PyAny>, accepted: &str) -> PyErr {
    let kind = match value.cast::<PyUntypedArray>() {
        Ok(array) => format!("a numpy array of {}", array.dtype()),
        Err(_) => value
            .get_type()
            .name()
            .map_or_else(|_| "something else".into(), |name| name.to_string()),
    };
    PyTypeError::new_err(format!("{argument}: got {kind}, must be {accepted}"))
}

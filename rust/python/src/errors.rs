//! The one place where core errors become Python exceptions.

use adaptgns_core::Error;
use pyo3::PyErr;
use pyo3::exceptions::{PyMemoryError, PyValueError};

/// `ValueError` for what a caller got wrong, `MemoryError` for what does not fit.
pub fn to_python(error: Error) -> PyErr {
    match error {
        Error::InvalidArgument { .. } => PyValueError::new_err(error.to_string()),
        Error::OutOfMemory(_) => PyMemoryError::new_err(error.to_string()),
    }
}

//! The one error type of the crate.

/// Why a graph could not be built, a scene not be simulated or a network not be run. Every
/// message names the argument and what is accepted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// An argument lies outside what is accepted.
    #[error("{argument}: {problem}")]
    InvalidArgument {
        /// Name of the argument as the caller knows it.
        argument: &'static str,
        /// What came and what is accepted.
        problem: String,
    },
    /// The result would not fit in the memory there is.
    #[error("{0}")]
    OutOfMemory(String),
}

impl Error {
    pub(crate) fn invalid(argument: &'static str, problem: impl Into<String>) -> Self {
        Self::InvalidArgument {
            argument,
            problem: problem.into(),
        }
    }
}

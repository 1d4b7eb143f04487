//! Errors of devices and calls.

use crate::self_test::SelfTestError;

/// Why a device cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// The server does not start, or does not answer.
    #[error("{0}")]
    Server(String),
    /// The model's derivatives are wrong.
    #[error("{names}: {source}")]
    SelfTest {
        /// Adapter and environment.
        names: String,
        /// What is wrong.
        source: SelfTestError,
    },
    /// The adapter computes forces whether they are wanted or not.
    #[error(
        "{0} cannot evaluate without forces, so walk.bias_norm_interval above 1 saves nothing: set it to 1, or give the adapter \
         evaluate_without_forces (docs/python-adapters.md)"
    )]
    AlwaysForces(String),
    /// A file or directory cannot be written.
    #[error("cannot write {path}: {source}")]
    File {
        /// Where.
        path: String,
        /// Why.
        source: std::io::Error,
    },
    /// The program was asked to stop.
    #[error("interrupted while the server of the model was started")]
    Stopped,
}

/// Why a call has no result.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CallError {
    /// The device is not there any more.
    #[error("{0}")]
    Unavailable(String),
    /// The model cannot evaluate this structure.
    #[error("{0}")]
    Failed(String),
}

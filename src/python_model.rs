//! Starts the programs of models in Python.

use std::sync::Arc;

use bridge::{Device, DeviceError, PythonSettings};
use tokio_util::sync::CancellationToken;

use crate::output::log_and_print;

/// Starts the program of a model, which ends with the last who uses it.
///
/// # Errors
/// A program that does not start, or a model whose derivatives are wrong.
pub fn start(settings: PythonSettings) -> Result<Arc<Device>, DeviceError> {
    let progress = |text: &str| log_and_print(format_args!("python: {text}"));
    Device::start(settings, &CancellationToken::new(), progress).map(Arc::new)
}

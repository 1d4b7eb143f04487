//! Starts the programs of models in Python and prepares their devices.

use std::sync::Arc;

use atoms::Structure;
use bridge::{Device, DeviceError, PythonSettings, SelfTestReport};
use tokio_util::sync::CancellationToken;

use crate::exit_status::CommandError;
use crate::output::log_and_print;

/// Starts the program of a model, which ends with the last who uses it. Cancelling `stop` ends the start, and later restarts.
///
/// # Errors
/// A program that does not start, or a model whose derivatives are wrong.
pub fn start(settings: PythonSettings, stop: &CancellationToken) -> Result<Arc<Device>, DeviceError> {
    let progress = |text: &str| log_and_print(format_args!("python: {text}"));
    Device::start(settings, stop, progress).map(Arc::new)
}

/// Why results do not depend on the structure alone, in batches of at most `max_batch` structures; `None` if they do.
pub fn irreproducible(test: &SelfTestReport, max_batch: u32) -> Option<&'static str> {
    if !test.is_deterministic {
        Some("the model gives other bits when a call is repeated")
    } else if !test.is_batch_independent && max_batch > 1 {
        Some("the bits of a structure depend on those beside it in a batch")
    } else {
        None
    }
}

/// Prepares a device for the calls of this many walkers with structures up to this size, if that is of use.
///
/// # Errors
/// A crashed thread, or a structure that the model does not support.
pub async fn warm_up(
    device: &Arc<Device>,
    largest: Structure,
    skin: f64,
    walkers: u32,
) -> Result<(), CommandError> {
    let description = device.info().description();
    if description.device == "cpu" && !description.padding {
        return Ok(());
    }
    let device = Arc::clone(device);
    let work = tokio::task::spawn_blocking(move || device.warm_up(&largest, skin, walkers as usize));
    work.await.map_err(CommandError::failed)?.map_err(CommandError::Failed)
}

//! Starts the programs of models in Python and prepares their devices.

use std::sync::Arc;
use std::thread;

use atoms::Structure;
use bridge::{Device, DeviceError, PythonSettings, SelfTestReport};
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use crate::exit_status::CommandError;
use crate::output::log_and_print;

/// A reason of [`irreproducible`].
const DEPENDS_ON_BATCH: &str = "the bits of a structure depend on those beside it in a batch";

/// A reason of [`irreproducible`].
pub const NOT_DETERMINISTIC: &str = "the model gives other bits when a call is repeated";

/// Starts the program of a model on each device, which ends with the last who uses it. Cancelling `stop` ends the start, and later
/// restarts. With `same_bits`, all devices must give the same bits, also after a restart.
///
/// # Errors
/// A program that does not start, a model whose derivatives are wrong, or one that is another on another device.
pub fn start(
    settings: Vec<PythonSettings>,
    same_bits: bool,
    stop: &CancellationToken,
) -> Result<Vec<Arc<Device>>, DeviceError> {
    let is_alone = settings.len() == 1;
    let start_one = |settings: PythonSettings| {
        let label = if is_alone { "python".to_owned() } else { format!("python, {}", settings.device) };
        let progress = move |text: &str| log_and_print(format_args!("{label}: {text}"));
        Device::start(settings, same_bits, stop, progress).map(Arc::new)
    };
    let devices: Vec<Arc<Device>> = thread::scope(|scope| {
        let starting: Vec<_> =
            settings.into_iter().map(|settings| scope.spawn(|| start_one(settings))).collect();
        let crashed = |_| Err(DeviceError::Server("a thread that starts a device has crashed".to_owned()));
        starting.into_iter().map(|one| one.join().unwrap_or_else(crashed)).collect::<Result<_, _>>()
    })?;
    if let Some((first, others)) = devices.split_first() {
        let expected = &first.info().reference;
        for other in others {
            expected.check(&other.info().reference, same_bits).map_err(|why| {
                let names = [other, first].map(|one| one.info().description().device.clone());
                DeviceError::Server(format!("the model on {} is not that on {}: {why}", names[0], names[1]))
            })?;
        }
    }
    Ok(devices)
}

/// Names of the devices, for messages.
pub fn names(devices: &[Arc<Device>]) -> String {
    let names: Vec<_> = devices.iter().map(|one| one.info().description().device.as_str()).collect();
    names.join(", ")
}

/// Why results do not depend on the structure alone, in batches of at most `max_batch` structures; `None` if they do.
pub fn irreproducible(devices: &[Arc<Device>], max_batch: u32) -> Option<&'static str> {
    let all = |has: fn(&SelfTestReport) -> bool| devices.iter().all(|device| has(&device.info().self_test));
    if !all(|test| test.is_deterministic) {
        Some(NOT_DETERMINISTIC)
    } else if !all(|test| test.is_batch_independent) && max_batch > 1 {
        Some(DEPENDS_ON_BATCH)
    } else {
        None
    }
}

/// Prepares devices for the calls of this many walkers with structures up to this size, if that is of use. With `same_bits`, the bits of a
/// structure must not depend on the size of the batch: kernels may be chosen by the size of matrices, which the self-test's small ones do
/// not show.
///
/// # Errors
/// A crashed thread, a structure that the model does not support, or bits that depend on the size of the batch.
pub async fn warm_up(
    devices: &[Arc<Device>],
    largest: &Structure,
    skin: f64,
    walkers: u32,
    same_bits: bool,
) -> Result<(), CommandError> {
    let is_of_use = |device: &&Arc<Device>| {
        let description = device.info().description();
        same_bits || description.device != "cpu" || description.padding
    };
    let most = (walkers as usize).div_ceil(devices.len().max(1));
    let prepare = |device: &Arc<Device>| {
        let (device, largest) = (Arc::clone(device), largest.clone());
        spawn_blocking(move || device.warm_up(&largest, skin, most))
    };
    let works: Vec<_> = devices.iter().filter(is_of_use).map(prepare).collect();
    for work in works {
        let is_independent = work.await.map_err(CommandError::failed)?.map_err(CommandError::Failed)?;
        if same_bits && !is_independent {
            return Err(CommandError::Input(format!(
                "the campaign is reproducible, but {DEPENDS_ON_BATCH} of the largest seed structure: set potential.python.max_batch = 1, or \
                 campaign.mode = \"live\""
            )));
        }
    }
    Ok(())
}

//! Watches the devices of a model in Python: what they do, and what happens when a program fails for good: walks end, labels continue.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use bridge::Device;
use monitor::DEVICES;
use store::Store;
use tokio::task::JoinHandle;
use tokio::time::interval;
use tokio_util::sync::CancellationToken;
use wire::DeviceStatistics;

use crate::output::log_and_print;

/// Interval between writes of what the device has done.
const WRITE_INTERVAL: Duration = Duration::from_secs(3);

/// What follows for a campaign when a device has failed for good.
pub const LABELS_GO_ON: &str = "no walk continues; labels are still computed";

/// Ends the walks with a device, and writes what the devices do to a store. Dropping it ends the watch.
pub struct DeviceWatch(Vec<JoinHandle<()>>);

impl DeviceWatch {
    /// Cancels `walks` when one of the devices has failed for good, and says what follows from that.
    pub fn start(
        devices: &[Arc<Device>],
        store: Option<&Store>,
        walks: &CancellationToken,
        consequence: &'static str,
    ) -> Self {
        let watch = |device: &Arc<Device>| {
            let (broken, walks) = (device.broken().clone(), walks.clone());
            let name = device.info().description().device.clone();
            tokio::spawn(async move {
                broken.cancelled().await;
                log_and_print(format_args!(
                    "the model's program on {name} has failed for good: {consequence}"
                ));
                walks.cancel();
            })
        };
        let mut tasks: Vec<_> = devices.iter().map(watch).collect();
        if let Some(store) = store.filter(|_| !devices.is_empty()) {
            let (devices, store) = (devices.to_vec(), store.clone());
            tasks.push(tokio::spawn(async move { match record(&devices, &store).await {} }));
        }
        Self(tasks)
    }
}

/// What each device has done.
pub fn statistics(devices: &[Arc<Device>]) -> Vec<DeviceStatistics> {
    devices.iter().map(|device| device.statistics()).collect()
}

/// Writes what the devices have done, for ever. Ignores errors: other writers report a broken database.
async fn record(devices: &[Arc<Device>], store: &Store) -> Infallible {
    let mut write = interval(WRITE_INTERVAL);
    loop {
        write.tick().await;
        if let Ok(text) = serde_json::to_string(&statistics(devices)) {
            let _ = store.set_metadata(DEVICES, &text).await;
        }
    }
}

impl Drop for DeviceWatch {
    fn drop(&mut self) {
        self.0.iter().for_each(JoinHandle::abort);
    }
}

/// Why a device has failed for good; `None` if none has.
pub fn last_failure(devices: &[Arc<Device>]) -> Option<String> {
    let device = devices.iter().find(|device| device.broken().is_cancelled())?;
    let reason = device.statistics().last_failure.unwrap_or_default();
    Some(format!("the model's program failed three times in a row; the last time: {reason}"))
}

//! Watches the device of a model in Python: what it does, and what happens when its program fails for good: walks end, labels go on.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use bridge::Device;
use monitor::DEVICE;
use store::Store;
use tokio::task::JoinHandle;
use tokio::time::interval;
use tokio_util::sync::CancellationToken;

use crate::output::log_and_print;

/// Interval between writes of what the device has done.
const WRITE_INTERVAL: Duration = Duration::from_secs(3);

/// What follows for a campaign when its device has failed for good.
pub const LABELS_GO_ON: &str = "no walk goes on, labels are still made";

/// Ends the walks with the device, and writes what the device does to a store. Dropping it ends the watch.
pub struct DeviceWatch(Option<JoinHandle<()>>);

impl DeviceWatch {
    /// Cancels `walks` when the device, if there is one, has failed for good, and says what follows from that.
    pub fn start(
        device: Option<&Arc<Device>>,
        store: Option<&Store>,
        walks: &CancellationToken,
        consequence: &'static str,
    ) -> Self {
        let Some(device) = device else { return Self(None) };
        let (device, store, walks) = (Arc::clone(device), store.cloned(), walks.clone());
        Self(Some(tokio::spawn(async move {
            let broken = device.broken().clone();
            tokio::select! {
                () = broken.cancelled() => {}
                never = record(&device, store.as_ref()) => match never {},
            }
            log_and_print(format_args!("the model's program has failed for good: {consequence}"));
            walks.cancel();
            match record(&device, store.as_ref()).await {}
        })))
    }
}

/// Writes what the device has done, for ever. Ignores errors: other writers report a broken database.
async fn record(device: &Device, store: Option<&Store>) -> Infallible {
    let Some(store) = store else { return std::future::pending().await };
    let mut write = interval(WRITE_INTERVAL);
    loop {
        write.tick().await;
        if let Ok(text) = serde_json::to_string(&device.statistics()) {
            let _ = store.set_metadata(DEVICE, &text).await;
        }
    }
}

impl Drop for DeviceWatch {
    fn drop(&mut self) {
        if let Some(task) = &self.0 {
            task.abort();
        }
    }
}

/// Why the device, if there is one, has failed for good; `None` if it has not.
pub fn last_failure(device: Option<&Arc<Device>>) -> Option<String> {
    let device = device.filter(|device| device.broken().is_cancelled())?;
    let reason = device.statistics().last_failure.unwrap_or_default();
    Some(format!("the model's program failed three times in a row; the last time: {reason}"))
}

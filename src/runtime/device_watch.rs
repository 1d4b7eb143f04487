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

use crate::campaign::LoadedCampaign;
use crate::exit_status::CommandError;
use crate::output::log_and_print;

/// Interval between writes of what the device has done.
const WRITE_INTERVAL: Duration = Duration::from_secs(3);

/// Ends the walks with the device, and writes what the device does to the store. Dropping it ends the watch.
pub struct DeviceWatch(Option<JoinHandle<()>>);

impl DeviceWatch {
    /// Cancels `walks` when the device of the campaign's model, if it has one, has failed for good.
    pub fn start(campaign: &LoadedCampaign, store: &Store, walks: &CancellationToken) -> Self {
        let Some(device) = campaign.model.device() else { return Self(None) };
        let (device, store, walks) = (Arc::clone(device), store.clone(), walks.clone());
        Self(Some(tokio::spawn(async move {
            let broken = device.broken().clone();
            tokio::select! {
                () = broken.cancelled() => {}
                never = record(&device, &store) => match never {},
            }
            log_and_print("the model's program has failed for good: no walk goes on, labels are still made");
            walks.cancel();
            match record(&device, &store).await {}
        })))
    }
}

/// Writes what the device has done, for ever. Ignores errors: other writers report a broken database.
async fn record(device: &Device, store: &Store) -> Infallible {
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

/// Prepares the device of the campaign's model for the calls of this many walkers, if that is of use.
///
/// # Errors
/// A crashed thread.
pub async fn warm_up(campaign: &LoadedCampaign, walkers: u32) -> Result<(), CommandError> {
    let Some(device) = campaign.model.device() else { return Ok(()) };
    let description = &device.info().description;
    if description.device == "cpu" && !description.padding {
        return Ok(());
    }
    let seeds = campaign.seed_structures.iter().map(|seed| &seed.plan.structure);
    let Some(largest) = seeds.max_by_key(|structure| structure.len()).cloned() else { return Ok(()) };
    let (device, skin) = (Arc::clone(device), campaign.config.walk.skin.get());
    let work = tokio::task::spawn_blocking(move || device.warm_up(&largest, skin, walkers as usize));
    work.await.map_err(CommandError::failed)?.map_err(CommandError::Failed)
}

/// Whether the device of the campaign's model has failed for good.
pub fn has_failed(campaign: &LoadedCampaign) -> bool {
    campaign.model.device().is_some_and(|device| device.broken().is_cancelled())
}

/// Why, as the error of the run.
pub fn failure(campaign: &LoadedCampaign) -> Option<CommandError> {
    let device = campaign.model.device().filter(|device| device.broken().is_cancelled())?;
    let reason = device.statistics().last_failure.unwrap_or_default();
    Some(CommandError::Failed(format!(
        "walks ended because the model's program failed three times in a row; the last time: {reason}\nwalks keep their checkpoints: \
         run the same command to continue the campaign"
    )))
}

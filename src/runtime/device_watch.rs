//! What happens when the program of the model fails for good: walks end, labels go on.

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::campaign::LoadedCampaign;
use crate::exit_status::CommandError;
use crate::output::log_and_print;

/// Ends the walks with the device. Dropping it ends the watch.
pub struct DeviceWatch(Option<JoinHandle<()>>);

impl DeviceWatch {
    /// Cancels `walks` when the device of the campaign's model, if it has one, has failed for good.
    pub fn start(campaign: &LoadedCampaign, walks: &CancellationToken) -> Self {
        let Some(device) = campaign.model.device() else { return Self(None) };
        let (broken, walks) = (device.broken().clone(), walks.clone());
        Self(Some(tokio::spawn(async move {
            broken.cancelled().await;
            log_and_print("the model's program has failed for good: no walk goes on, labels are still made");
            walks.cancel();
        })))
    }
}

impl Drop for DeviceWatch {
    fn drop(&mut self) {
        if let Some(task) = &self.0 {
            task.abort();
        }
    }
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

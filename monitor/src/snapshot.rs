//! The state of a campaign, which `status`, the dashboard, metrics and notifications show.

use serde_json::{Value, json};
use store::{CampaignRecord, CampaignStatus, Store, StoreError};

use crate::disk::{self, DiskUse};
use crate::end_reason::CampaignEnd;
use crate::expected_end::ExpectedEnd;
use crate::label_queue::LabelQueue;
use crate::mixture_values::MixtureValues;
use crate::provenance::Provenance;
use crate::reference_check::ReferenceCheck;
use crate::versions::CampaignVersions;
use crate::walk_ends::WalkEnds;
use wire::DeviceStatistics;

/// Version of the JSON format; incremented when a key is removed or changes its meaning.
pub const FORMAT: u32 = 1;

/// Metadata of the store: [`DeviceStatistics`] of each device.
pub const DEVICES: &str = "devices";

/// The state of a campaign, read within a short time.
#[derive(Debug)]
pub struct Snapshot {
    /// Identity and configuration.
    pub campaign: CampaignRecord,
    /// Its name and configuration files. `None` for campaigns of early versions.
    pub origin: Option<Provenance>,
    /// Counts, walks and processes.
    pub status: CampaignStatus,
    /// Forgetting and staleness.
    pub mixture: MixtureValues,
    /// Size of the store and its forecast.
    pub disk: DiskUse,
    /// Costs and failures of labels.
    pub labels: LabelQueue,
    /// The expected end.
    pub end: ExpectedEnd,
    /// Why it ended. `None` while it is not finished.
    pub end_reason: Option<CampaignEnd>,
    /// The check of the reference. `None` if there was none.
    pub check: Option<ReferenceCheck>,
    /// Versions of the potential.
    pub versions: CampaignVersions,
    /// What each device of the present or last run has done. Empty for models that this program evaluates.
    pub devices: Vec<DeviceStatistics>,
}

impl Snapshot {
    /// Reads the state of a campaign.
    pub async fn read(store: &Store) -> Result<Self, StoreError> {
        let forecast = store.metadata(disk::METADATA_KEY).await?;
        let forecast = forecast.and_then(|text| serde_json::from_str(&text).ok());
        let (campaign, mut status) = (store.campaign().await?, store.status().await?);
        let end_reason = CampaignEnd::read(store, &status).await?;
        // A refit may be left although every walk has ended.
        status.finished = end_reason.is_some();
        let labels = LabelQueue::read(store, &status).await?;
        let values = store.values().await?;
        let configuration: Value = serde_json::from_str(&campaign.configuration_in_force).unwrap_or_default();
        Ok(Self {
            end_reason,
            end: ExpectedEnd::extrapolate(&status, &configuration, &labels.cost),
            origin: Provenance::read(store).await?,
            check: ReferenceCheck::read(store).await?,
            versions: CampaignVersions::read(store, &status, &values).await?,
            devices: read_devices(store).await?,
            mixture: MixtureValues(values),
            disk: DiskUse { bytes: store.size().await?, forecast },
            campaign,
            status,
            labels,
        })
    }

    /// The JSON of `calmwalk status` (docs/status.md), without the jobs of a batch system and without sentences.
    pub fn to_json(&self) -> serde_json::Result<Value> {
        let Self {
            campaign,
            origin,
            status,
            mixture,
            disk,
            labels,
            end,
            end_reason,
            check,
            versions,
            devices,
        } = self;
        let mut json = serde_json::to_value(status)?;
        json["version"] = FORMAT.into();
        json["campaign"] = campaign.id.to_string().into();
        json["name"] = json!(origin.as_ref().map(|origin| &origin.name));
        json["configuration"] = json!(origin.as_ref().map(|origin| {
            json!({ "path": origin.file.path, "blake3": origin.file.blake3, "began_with": origin.began_with })
        }));
        json["mode"] = campaign.mode.clone().into();
        json["training_frames"] = mixture.training_frames();
        json["candidates"]["left_out"] = mixture.left_out().into();
        json["staleness"] = mixture.staleness_json();
        json["disk"] = serde_json::to_value(disk)?;
        json["disk"]["at_the_end"] = json!(disk.at_the_end(status));
        json["ends"] = json!(WalkEnds::from_walks(&status.walks));
        json["expected_end"] = json!(end);
        json["end_reason"] = json!(end_reason);
        json["reference_check"] = check.as_ref().map_or(Value::Null, ReferenceCheck::to_json);
        json["versions"] = json!(versions.all);
        json["refit"] = json!(versions.refit);
        let total = DeviceStatistics::total(devices);
        json["device"] = total.as_ref().map_or(Value::Null, device_json);
        json["devices"] = devices.iter().map(device_json).collect();
        labels.add_to(&mut json, status);
        Ok(json)
    }
}

async fn read_devices(store: &Store) -> Result<Vec<DeviceStatistics>, StoreError> {
    let text = store.metadata(DEVICES).await?;
    Ok(text.and_then(|text| serde_json::from_str(&text).ok()).unwrap_or_default())
}

/// The statistics with what follows from them.
fn device_json(device: &DeviceStatistics) -> Value {
    let mut json = json!(device);
    json["busy_share"] = json!(device.busy_share());
    json["mean_batch"] = json!(device.mean_batch());
    json["mean_wait"] = json!(device.mean_wait());
    json["bonds_per_second"] = json!(device.bonds_per_second());
    json
}

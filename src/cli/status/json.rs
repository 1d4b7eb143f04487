//! The JSON output of `calmwalk status` (docs/status.md).

use serde_json::{Value, json};

use super::Snapshot;
use super::batch_jobs::BatchJobs;
use crate::walk_ends::WalkEnds;

/// Incremented when a key is removed or changes its meaning.
pub const VERSION: u32 = 1;

/// The JSON object.
pub fn to_json(snapshot: &Snapshot, jobs: &BatchJobs) -> serde_json::Result<Value> {
    let Snapshot { campaign, origin, status, mixture, disk, labels, end } = snapshot;
    let mut json = serde_json::to_value(status)?;
    json["version"] = VERSION.into();
    json["campaign"] = campaign.id.to_string().into();
    json["name"] = json!(origin.as_ref().map(|origin| &origin.name));
    json["configuration"] = json!(origin.as_ref().map(|origin| {
        json!({ "path": origin.file.path, "blake3": origin.file.blake3, "began_with": origin.began_with })
    }));
    json["mode"] = campaign.mode.clone().into();
    json["training_frames"] = mixture.training_frames();
    json["staleness"] = mixture.staleness();
    json["disk"] = serde_json::to_value(disk)?;
    json["disk"]["at_the_end"] = json!(disk.at_the_end(status));
    json["ends"] = json!(WalkEnds::from_walks(&status.walks));
    json["expected_end"] = json!(end);
    labels.add_to(&mut json, status);
    jobs.add_to(&mut json);
    Ok(json)
}

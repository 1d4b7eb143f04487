//! The state of a campaign as JSON: see docs/status.md.

use serde_json::{Value, json};

use super::Snapshot;
use super::jobs::Jobs;
use crate::walk_ends::WalkEnds;

/// Goes up when a key is taken away or comes to mean something else.
pub const VERSION: u32 = 1;

/// One object.
pub fn of(snapshot: &Snapshot, jobs: &Jobs) -> serde_json::Result<Value> {
    let Snapshot { campaign, origin, standing, values, disk, labels, end } = snapshot;
    let mut json = serde_json::to_value(standing)?;
    json["version"] = VERSION.into();
    json["campaign"] = campaign.id.to_string().into();
    json["name"] = json!(origin.as_ref().map(|origin| &origin.name));
    json["configuration"] = json!(origin.as_ref().map(|origin| {
        json!({ "path": origin.file.path, "blake3": origin.file.blake3, "began_with": origin.began_with })
    }));
    json["mode"] = campaign.mode.clone().into();
    json["training_frames"] = values.training_frames();
    json["staleness"] = values.staleness();
    json["disk"] = serde_json::to_value(disk)?;
    json["disk"]["at_the_end"] = json!(disk.at_the_end(standing));
    json["ends"] = json!(WalkEnds::from_walks(&standing.walks));
    json["expected_end"] = json!(end);
    labels.add_to(&mut json, standing);
    jobs.add_to(&mut json);
    Ok(json)
}

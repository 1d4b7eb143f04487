//! Versions of the potential for tests. Not in `common`, which tests of other packages use too.

use serde_json::json;
use store::{VersionFiles, VersionRecord, VersionState};

/// A version of the potential; one that is registered has the files of [`version_files`].
pub fn version_record(number: u32, parent: u32, state: VersionState) -> VersionRecord {
    let is_registered = state == VersionState::Registered;
    let files = version_files(number);
    let hash = |data: &[u8]| {
        if is_registered { blake3::hash(data).to_hex().to_string() } else { String::new() }
    };
    VersionRecord {
        number,
        parent,
        state,
        reason: if is_registered { String::new() } else { "its force errors are larger".into() },
        method: "native".into(),
        structures: 50 * u64::from(number),
        last_decision: 70 * i64::from(number),
        labels: 40 * u64::from(number),
        model_hash: hash(&files.model),
        mixture_hash: hash(&files.mixture),
        figures: json!({ "sets": [{ "name": "replay", "version": { "force_mae": 0.1 } }] }),
        seconds: 12.25,
        core_hours: 0.1 * f64::from(number),
        time: 1000 + i64::from(number),
    }
}

/// The files of a version.
pub fn version_files(number: u32) -> VersionFiles {
    let bytes = |name: &str| format!("{name} of version {number}").into_bytes();
    VersionFiles { model: bytes("model"), mixture: bytes("mixture") }
}

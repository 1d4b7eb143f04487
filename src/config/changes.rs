//! Changes of the configuration of a started campaign: which keys may change and which may not.

use std::fmt;

use serde_json::{Value, json};

/// Keys that may change when a campaign is resumed; all others keep their first values.
pub(super) const CHANGEABLE: [&str; 94] = [
    "campaign.control_share",
    "potential.python.environment",
    "potential.python.launcher",
    "potential.python.device",
    "potential.python.threads",
    "potential.python.max_batch",
    "potential.python.timeout",
    "potential.python.compile_timeout",
    "potential.python.cache",
    "seed_structures",
    "walk.trace_interval",
    "walk.trajectory_interval",
    "collect.max_per_walk",
    "collect.max_per_seed_structure",
    "collect.max_structures",
    "collect.declined_features_mb",
    "collect.min_completion_probability",
    "calm.forgetting_alarm",
    "calm.max_mean_square_growth",
    "label.concurrency",
    "label.lease_timeout",
    "label.max_attempts",
    "label.max_force",
    "label.max_stress",
    "label.max_energy_per_atom",
    "label.max_energy_difference_per_atom",
    "label.min_state_difference",
    "label.on_lower_state",
    "label.cores",
    "label.gpus",
    "label.time_limit",
    "label.memory",
    "label.scratch",
    "label.keep_directories",
    "label.pass_environment",
    "label.batch_system",
    "label.batch_options",
    "label.order",
    "label.queue_limit",
    "label.on_queue_full",
    "label.guard.min_bond_lengths",
    "label.guard.min_height",
    "label.guard.max_edge_ratio",
    "label.guard.min_angle",
    "label.guard.min_volume_per_atom",
    "label.guard.max_volume_per_atom",
    "label.guard.max_atoms",
    "label.guard.duplicate_tolerance",
    "label.guard.max_cost",
    "label.reference_check.structures",
    "label.reference_check.max_energy_difference",
    "label.reference_check.max_force_difference",
    "label.reference_check.max_stress_difference",
    "budget.labels",
    "budget.core_hours",
    "budget.wall_time",
    "stop.max_steps_without_structure",
    "stop.walks",
    "stop.min_improvement",
    "run.walkers",
    "run.threads_per_walker",
    "run.heartbeat_timeout",
    "run.agent_heartbeat_timeout",
    "run.max_restarts",
    "run.store",
    "notify.command",
    "notify.on",
    "notify.stall_timeout",
    "notify.failed_labels",
    "notify.time_limit",
    "guard.max_temperature",
    "refit.after_time",
    "refit.max_versions",
    "refit.max_attempts",
    "refit.threads",
    "refit.test_sets",
    "refit.method.command.time_limit",
    "launch.custom.name",
    "launch.custom.submit",
    "launch.custom.id_after",
    "launch.custom.start_after",
    "launch.custom.queue_full",
    "launch.custom.poll",
    "launch.custom.state_after",
    "launch.custom.states.pending",
    "launch.custom.states.running",
    "launch.custom.states.completed",
    "launch.custom.states.failed",
    "launch.custom.states.cancelled",
    "launch.custom.vanished",
    "launch.custom.cancel",
    "launch.custom.script",
    "launch.custom.log.time_limit",
    "launch.custom.log.out_of_memory",
];

const BONDS: &str = "label.guard.min_bond_lengths";

/// A change that takes effect when the campaign is resumed.
#[derive(Clone, Debug, PartialEq)]
pub enum ConfigChange {
    /// A key with a new value.
    Key {
        /// Dotted key.
        key: String,
        /// The value in the campaign.
        before: Value,
        /// The value in the file now.
        after: Value,
    },
    /// New seed structures after the existing ones.
    SeedStructures {
        /// Number of existing ones.
        before: usize,
        /// Names and contents of the new ones.
        added: Vec<String>,
    },
}

/// A change that is not possible.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refused {
    /// A key that cannot change.
    #[error(
        "{key} is {}, but this campaign {}: {}. Restore the old value{}",
        shown(after),
        campaign_has(key, before),
        reason(key),
        alternative(key)
    )]
    Key {
        /// Dotted key.
        key: String,
        /// The value in the campaign.
        before: Value,
        /// The value in the file now.
        after: Value,
    },
    /// A file whose contents changed.
    #[error(
        "{key}: the contents of the file changed (BLAKE3 {after}; this campaign started with {before}): {}. Restore the old file{}",
        reason(key),
        alternative(key)
    )]
    File {
        /// Dotted key of the configuration that names the file.
        key: String,
        /// The hash in the campaign.
        before: String,
        /// The hash now.
        after: String,
    },
    /// A seed structure that was removed or changed.
    #[error(
        "seed_structures.files: seed structure {number} is {after}, but this campaign has {before}: append new seed structures \
         after the existing ones; do not change, move or remove any. Restore it, and the old seed_structures.min_atoms and \
         min_height"
    )]
    SeedStructure {
        /// Its number, from 0.
        number: usize,
        /// Name and contents in the campaign.
        before: String,
        /// Name and contents now.
        after: String,
    },
}

const OTHER_PHYSICS: &str =
    "a started campaign cannot change it, because earlier and later results would not be comparable";

fn reason(key: &str) -> &'static str {
    match key {
        "instructions" => {
            "the processor of this host gives slightly different floating-point results than that of the start, which \
             mode = \"reproducible\" excludes"
        }
        key if is_label(key) => "one data set must not mix labels of two protocols",
        key if key.starts_with("refit") => {
            "a campaign keeps the refit with which it started, so that its versions can be compared"
        }
        _ => OTHER_PHYSICS,
    }
}

/// Whether the key is a part of the label method.
fn is_label(key: &str) -> bool {
    key.starts_with("label.method")
}

/// What the user can do instead of restoring the old value.
fn alternative(key: &str) -> &'static str {
    if !is_label(key) {
        return "";
    }
    ", or switch to the new protocol (calmwalk relabel --config with this file; --dry-run estimates the cost)"
}

impl Refused {
    /// The key of the configuration that must be restored.
    pub fn key(&self) -> &str {
        match self {
            // Files of a list have numbers: `refit.replay[0]`.
            Self::Key { key, .. } | Self::File { key, .. } => key.split('[').next().unwrap_or(key),
            Self::SeedStructure { .. } => "seed_structures.files",
        }
    }
}

impl ConfigChange {
    /// Key, value before and value after, for the operations log.
    pub fn detail(&self) -> Value {
        match self {
            Self::Key { key, before, after } => json!({ "key": key, "before": before, "after": after }),
            Self::SeedStructures { before, added } => {
                json!({ "key": "seed_structures", "before": before, "after": before + added.len(), "added": added })
            }
        }
    }
}

impl fmt::Display for ConfigChange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Key { key, before, after } => {
                write!(f, "{key} is now {} (was {})", shown(after), shown(before))
            }
            Self::SeedStructures { before, added } => {
                let added: Vec<_> = added.iter().map(|seed| short(seed)).collect();
                write!(f, "seed structures added to the existing {before}: {}", added.join(", "))
            }
        }
    }
}

/// Compares the configuration of a campaign with the one with which it is resumed.
///
/// # Errors
/// The first change that is not possible.
pub fn compare(before: &Value, after: &Value) -> Result<Vec<ConfigChange>, Refused> {
    let changes = changed_keys(before, after).into_iter();
    changes.map(|(key, before, after)| classify(key, before, after)).collect()
}

fn classify(key: String, before: Value, after: Value) -> Result<ConfigChange, Refused> {
    if key == "seed_structures" {
        return seed_structures(&before, &after);
    }
    if let Some(key) = key.strip_prefix("files.").map(str::to_owned) {
        return Err(match (before.as_str(), after.as_str()) {
            (Some(before), Some(after)) => {
                Refused::File { key, before: excerpt(before).to_owned(), after: excerpt(after).to_owned() }
            }
            _ => Refused::Key { key, before, after },
        });
    }
    // The pairs of elements are keys as well.
    let whole = if key.starts_with(BONDS) { BONDS } else { &key };
    if CHANGEABLE.contains(&whole) {
        Ok(ConfigChange::Key { key, before, after })
    } else {
        Err(Refused::Key { key, before, after })
    }
}

fn seed_structures(before: &Value, after: &Value) -> Result<ConfigChange, Refused> {
    let list = |value: &Value| -> Vec<String> {
        let values = value.as_array().into_iter().flatten();
        values.map(|seed| seed.as_str().unwrap_or_default().to_owned()).collect()
    };
    let (before, mut after) = (list(before), list(after));
    if let Some(number) = (0..before.len()).find(|number| before.get(*number) != after.get(*number)) {
        let after = after.get(number).map_or("missing".to_owned(), |seed| short(seed));
        return Err(Refused::SeedStructure { number, before: short(&before[number]), after });
    }
    let added = after.split_off(before.len());
    Ok(ConfigChange::SeedStructures { before: before.len(), added })
}

/// The configuration with all changeable keys set to null.
pub fn without_changeable(configuration: &Value) -> Value {
    let mut fixed = configuration.clone();
    // All of its keys are changeable, and it may be left out.
    fixed.as_object_mut().map(|sections| sections.remove("launch"));
    for key in CHANGEABLE {
        let pointer = format!("/{}", key.replace('.', "/"));
        if let Some(value) = fixed.pointer_mut(&pointer) {
            *value = Value::Null;
        }
    }
    fixed
}

/// A value in the form of a configuration.
fn shown(value: &Value) -> String {
    if value.is_null() { "left out".to_owned() } else { value.to_string() }
}

/// The value of a key in the campaign, in words.
fn campaign_has(key: &str, value: &Value) -> String {
    let verb = if is_label(key) { "labels" } else { "started" };
    if value.is_null() { format!("{verb} without it") } else { format!("{verb} with {value}") }
}

/// Name and short hash of a seed structure.
fn short(seed: &str) -> String {
    let (name, hash) = seed.rsplit_once(' ').unwrap_or((seed, ""));
    format!("'{name}' (content {})", excerpt(hash))
}

/// The first digits of a hash, enough to distinguish it.
fn excerpt(hash: &str) -> &str {
    hash.get(..12).unwrap_or(hash)
}

/// Whether `key` is a section with changeable keys.
fn is_section(key: &str) -> bool {
    CHANGEABLE.iter().any(|changeable| changeable.strip_prefix(key).is_some_and(|rest| rest.starts_with('.')))
}

/// (key, before, after) of every leaf that differs in two JSON values.
pub fn changed_keys(before: &Value, after: &Value) -> Vec<(String, Value, Value)> {
    let mut changes = Vec::new();
    differences("", before, after, &mut changes);
    changes
}

/// (key, before, after) of every leaf that differs.
pub(super) fn differences(
    key: &str,
    before: &Value,
    after: &Value,
    changes: &mut Vec<(String, Value, Value)>,
) {
    if let (Value::Object(old), Value::Object(new)) = (before, after) {
        let names: std::collections::BTreeSet<_> = old.keys().chain(new.keys()).collect();
        for name in names {
            let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
            let of = |map: &serde_json::Map<String, Value>| map.get(name).cloned().unwrap_or(Value::Null);
            differences(&key, &of(old), &of(new), changes);
        }
    } else if before.is_null() && is_section(key) {
        // A section that an earlier version of calmwalk did not have.
        differences(key, &json!({}), after, changes);
    } else if after.is_null() && is_section(key) {
        differences(key, before, &json!({}), changes);
    } else if before != after {
        changes.push((key.to_owned(), before.clone(), after.clone()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn budgets_and_new_seed_structures_are_applied() {
        let before = json!({ "run": { "walkers": 1 }, "seed_structures": ["a 1"] });
        let after = json!({ "run": { "walkers": 2 }, "seed_structures": ["a 1", "b 2"] });
        let changes = compare(&before, &after).unwrap();
        let shown: Vec<_> = changes.iter().map(ConfigChange::to_string).collect();
        assert_eq!(
            shown,
            ["run.walkers is now 2 (was 1)", "seed structures added to the existing 1: 'b' (content 2)"]
        );
        assert_eq!(changes[0].detail(), json!({ "key": "run.walkers", "before": 1, "after": 2 }));
        assert_eq!(
            changes[1].detail(),
            json!({ "key": "seed_structures", "before": 1, "after": 2, "added": ["b 2"] })
        );
        assert_eq!(compare(&after, &after), Ok(Vec::new()));
    }

    #[test]
    fn a_campaign_keeps_its_refit_but_for_its_limits() {
        let before = json!({
            "files": { "refit.replay[0]": "ab" },
            "refit": {
                "replay": null, "held_out": 0.1, "max_versions": 3, "after_time": null, "max_attempts": 3, "threads": 0,
                "method": { "command": { "program": ["train"], "time_limit": null } },
                "test_sets": [],
            },
        });
        let changed = |pointer: &str, value: Value| {
            let mut after = before.clone();
            *after.pointer_mut(pointer).unwrap() = value;
            assert_eq!(
                without_changeable(&before) == without_changeable(&after),
                compare(&before, &after).is_ok(),
                "{pointer}"
            );
            compare(&before, &after)
        };
        for (pointer, value) in [
            ("/refit/max_versions", json!(5)),
            ("/refit/after_time", json!("2h")),
            ("/refit/max_attempts", json!(5)),
            ("/refit/threads", json!(2)),
            ("/refit/test_sets", json!([{ "name": "liquid", "file": "" }])),
            ("/refit/method/command/time_limit", json!("1day")),
        ] {
            assert_eq!(changed(pointer, value).unwrap().len(), 1, "{pointer}");
        }
        for (pointer, value, expected) in [
            (
                "/refit/held_out",
                json!(0.2),
                "refit.held_out is 0.2, but this campaign started with 0.1: a campaign keeps",
            ),
            ("/refit/method", json!({ "native": {} }), "refit.method.command.program is left out, but"),
            ("/files/refit.replay[0]", json!("cd"), "refit.replay[0]: the contents of the file changed"),
        ] {
            let message = changed(pointer, value).unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
        let refused = changed("/files/refit.replay[0]", json!("cd")).unwrap_err();
        assert_eq!(refused.key(), "refit.replay");
        let without = json!({ "files": {} });
        let message = compare(&without, &before).unwrap_err().to_string();
        let expected = "refit.replay[0] is \"ab\", but this campaign started without it: a campaign keeps";
        assert!(message.starts_with(expected), "{message}");
        assert!(compare(&before, &without).is_err());
    }

    #[test]
    fn a_batch_system_may_come_change_and_go() {
        let with =
            |poll: &str| json!({ "launch": { "custom": { "poll": poll, "states": { "running": ["R"] } } } });
        for (before, after, number) in
            [(json!({}), with("a"), 2), (with("a"), with("b"), 1), (with("a"), json!({}), 2)]
        {
            assert_eq!(compare(&before, &after).unwrap().len(), number);
            assert_eq!(without_changeable(&before), without_changeable(&after));
        }
    }

    #[test]
    fn physics_files_and_lost_seed_structures_are_refused() {
        let before = json!({ "walk": { "tau": 0.15 }, "files": { "potential.model": "ab" }, "seed_structures": ["a 1", "b 2"] });
        let refused = |pointer: &str, value: Value| {
            let mut after = before.clone();
            *after.pointer_mut(pointer).unwrap() = value;
            let refused = compare(&before, &after).unwrap_err();
            (refused.key().to_owned(), refused.to_string())
        };
        let (key, message) = refused("/walk/tau", json!(0.2));
        assert!(message.starts_with("walk.tau is 0.2, but this campaign started with 0.15"), "{message}");
        assert_eq!(key, "walk.tau");
        let added = json!({ "walk": { "tau": 0.15, "volume_ramp": { "to": 1.1 } }, "seed_structures": [] });
        let message = compare(&json!({ "walk": { "tau": 0.15 }, "seed_structures": [] }), &added)
            .unwrap_err()
            .to_string();
        assert!(message.contains("{\"to\":1.1}, but this campaign started without it: "), "{message}");
        let (key, message) = refused("/files/potential.model", json!("cd"));
        assert!(message.contains("(BLAKE3 cd; this campaign started with ab)"), "{message}");
        assert_eq!(key, "potential.model");
        for (seeds, found) in
            [(json!(["a 1"]), "1 is missing"), (json!(["a 3", "b 2"]), "0 is 'a' (content 3)")]
        {
            let (key, message) = refused("/seed_structures", seeds);
            assert!(message.contains(&format!("seed structure {found}, but this campaign has")), "{message}");
            assert_eq!(key, "seed_structures.files");
        }
    }
}

//! What may change while a campaign lasts, and what may not.

use serde_json::Value;

/// Keys that may have another value when a campaign is continued; everything else is what it began with.
const CHANGEABLE: [&str; 11] = [
    "seeds",
    "collect.per_seed",
    "collect.total",
    "collect.declined_features_mb",
    "calm.forgetting_alarm",
    "label.slots",
    "label.attempts",
    "label.largest_force",
    "label.queue_limit",
    "run.walkers",
    "guard.highest_temperature",
];

/// One key with another value than before.
#[derive(Clone, Debug, PartialEq)]
pub struct Change {
    /// Dotted key.
    pub key: String,
    /// The value that the campaign has.
    pub before: Value,
    /// The value in the file now.
    pub after: Value,
}

/// A change that is not possible.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "{key} is {after}, but this campaign began with {before}: {reason}. Put the old value back, or start another \
     campaign with --directory"
)]
pub struct Refused {
    key: String,
    before: Value,
    after: Value,
    reason: &'static str,
}

/// The keys that differ between the configuration a campaign has and the one it is continued with.
pub fn compare(before: &Value, after: &Value) -> Result<Vec<Change>, Refused> {
    let mut changes = Vec::new();
    differences("", before, after, &mut changes);
    for change in &changes {
        let Change { key, before, after } = change.clone();
        let changeable = CHANGEABLE.contains(&key.as_str());
        let shrunk = key == "seeds" && !is_extension(&before, &after);
        if !changeable || shrunk {
            let reason = if shrunk {
                "seed structures can be added, behind those that it has, but not taken away"
            } else {
                "its walks, decisions and labels so far would not belong together with what follows"
            };
            return Err(Refused { key, before, after, reason });
        }
    }
    Ok(changes)
}

/// A configuration without the keys that may change.
pub fn without_changeable(configuration: &Value) -> Value {
    let mut fixed = configuration.clone();
    for key in CHANGEABLE {
        let pointer = format!("/{}", key.replace('.', "/"));
        if let Some(value) = fixed.pointer_mut(&pointer) {
            *value = Value::Null;
        }
    }
    fixed
}

fn differences(key: &str, before: &Value, after: &Value, changes: &mut Vec<Change>) {
    if let (Value::Object(old), Value::Object(new)) = (before, after) {
        let names: std::collections::BTreeSet<_> = old.keys().chain(new.keys()).collect();
        for name in names {
            let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
            let of = |map: &serde_json::Map<String, Value>| map.get(name).cloned().unwrap_or(Value::Null);
            differences(&key, &of(old), &of(new), changes);
        }
    } else if before != after {
        changes.push(Change { key: key.to_owned(), before: before.clone(), after: after.clone() });
    }
}

fn is_extension(before: &Value, after: &Value) -> bool {
    match (before.as_array(), after.as_array()) {
        (Some(before), Some(after)) => after.starts_with(before),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn budgets_and_new_seed_structures_are_applied() {
        let before = json!({ "run": { "walkers": 1 }, "seeds": ["a"] });
        let after = json!({ "run": { "walkers": 2 }, "seeds": ["a", "b"] });
        let keys: Vec<_> = compare(&before, &after).unwrap().into_iter().map(|change| change.key).collect();
        assert_eq!(keys, ["run.walkers", "seeds"]);
    }

    #[test]
    fn physics_and_lost_seed_structures_are_refused() {
        let before = json!({ "walk": { "tau": 0.15 }, "seeds": ["a", "b"] });
        let hotter = json!({ "walk": { "tau": 0.2 }, "seeds": ["a", "b"] });
        assert!(compare(&before, &hotter).unwrap_err().to_string().starts_with("walk.tau is 0.2"));
        let fewer = json!({ "walk": { "tau": 0.15 }, "seeds": ["b"] });
        assert!(compare(&before, &fewer).is_err());
    }
}

//! Combines commits into one transaction, with the same result as writing them one after the other.

use std::collections::HashSet;
use std::hash::Hash;

use store::records::Commit;

/// Appends `later` to `commit`.
pub fn append(commit: &mut Commit, later: Commit) {
    let Commit {
        decisions,
        candidates,
        components,
        restart_mixture,
        walks,
        values,
        traces,
        assignments,
        trajectories,
    } = later;
    commit.decisions.extend(decisions);
    commit.candidates.extend(candidates);
    if restart_mixture {
        commit.components.clear();
        commit.restart_mixture = true;
    }
    commit.traces.extend(traces);
    commit.assignments.extend(assignments);
    commit.trajectories.extend(trajectories);
    // Of records that are overwritten, only the newest is kept.
    replace(&mut commit.components, components, |component| (component.element, component.slot));
    replace(&mut commit.walks, walks, |walk| walk.walk);
    replace(&mut commit.values, values, |(name, _)| name.clone());
}

/// Appends `newer`, and removes older records with the same key. There are few older ones: a walker reports once until the
/// commit with its report is written.
fn replace<T, K: Eq + Hash>(records: &mut Vec<T>, newer: Vec<T>, key: impl Fn(&T) -> K) {
    let replaced: HashSet<K> = newer.iter().map(&key).collect();
    records.retain(|old| !replaced.contains(&key(old)));
    records.extend(newer);
}

//! Combines commits into one transaction, with the same result as writing them one after the other.

use store::records::Commit;

/// Appends `later` to `commit`.
pub fn append(commit: &mut Commit, later: Commit) {
    let Commit { decisions, candidates, components, restart_mixture, walks, values } = later;
    commit.decisions.extend(decisions);
    commit.candidates.extend(candidates);
    if restart_mixture {
        commit.components.clear();
        commit.restart_mixture = true;
    }
    // Of records that are overwritten, only the newest is kept.
    replace(&mut commit.components, components, |component| (component.element, component.slot));
    replace(&mut commit.walks, walks, |walk| walk.walk);
    replace(&mut commit.values, values, |(name, _)| name.clone());
}

/// Appends `newer`, and removes older records with the same key.
fn replace<T, K: PartialEq>(records: &mut Vec<T>, newer: Vec<T>, key: impl Fn(&T) -> K) {
    records.retain(|old| newer.iter().all(|new| key(new) != key(old)));
    records.extend(newer);
}

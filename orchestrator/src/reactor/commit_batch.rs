//! Commits that are written as one transaction: what they leave behind is what they would leave one after the other.

use store::records::Commit;

/// Puts `later` behind what is in `commit`.
pub fn append(commit: &mut Commit, later: Commit) {
    let Commit { decisions, candidates, components, restart_mixture, walks, values } = later;
    commit.decisions.extend(decisions);
    commit.candidates.extend(candidates);
    if restart_mixture {
        commit.components.clear();
        commit.restart_mixture = true;
    }
    // Of everything that is written over, only the newest is worth its bytes.
    replace(&mut commit.components, components, |component| (component.element, component.slot));
    replace(&mut commit.walks, walks, |walk| walk.walk);
    replace(&mut commit.values, values, |(name, _)| name.clone());
}

/// Adds `newer` at the end, in place of those with the same key.
fn replace<T, K: PartialEq>(records: &mut Vec<T>, newer: Vec<T>, key: impl Fn(&T) -> K) {
    records.retain(|old| newer.iter().all(|new| key(new) != key(old)));
    records.extend(newer);
}

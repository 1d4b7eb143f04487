//! Campaigns of versions 15 to 20, and the words of version 15.

use serde_json::json;
use store::{Decision, Fate, Store, WalkRecord};
use wire::messages::DeclineReason;
use wire::{Origin, WalkId};

use super::{candidate, commit_of, name_of, protocol, walk};

/// Turns the tables into those of version 20, without the number of the version.
pub const TO_VERSION_20: &str =
    "DROP TABLE sample; DROP TABLE trajectory; DELETE FROM _sqlx_migrations WHERE version > 20";

/// Turns the tables into those of version 19, without the number of the version.
pub const TO_VERSION_19: &str =
    "DROP TABLE sample; DROP TABLE trajectory; DROP TABLE assignment; DROP TABLE reference_volume;
    ALTER TABLE walk_progress DROP COLUMN reference_step; DELETE FROM _sqlx_migrations WHERE version > 19";

/// Turns the tables into those of version 17, without the number of the version.
pub const TO_VERSION_17: &str = "DROP INDEX job_order;
    DROP TABLE sample; DROP TABLE trajectory; DROP TABLE assignment; DROP TABLE reference_volume; ALTER TABLE walk_progress DROP COLUMN reference_step;
    DROP TABLE walk_trace; ALTER TABLE job DROP COLUMN value; ALTER TABLE job DROP COLUMN value_factors;
    CREATE INDEX job_order ON job (state, priority DESC, decision, protocol);
    DELETE FROM _sqlx_migrations WHERE version > 17";

/// Turns the tables into those of version 16, without the number of the version.
pub const TO_VERSION_16: &str = "DROP INDEX job_order;
    DROP TABLE sample; DROP TABLE trajectory; DROP TABLE assignment; DROP TABLE reference_volume; ALTER TABLE walk_progress DROP COLUMN reference_step;
    DROP TABLE walk_trace; ALTER TABLE job DROP COLUMN value; ALTER TABLE job DROP COLUMN value_factors;
    CREATE INDEX job_order ON job (state, priority DESC, decision, protocol);
    DROP TABLE version_file; DROP TABLE version;
    DELETE FROM _sqlx_migrations WHERE version > 16";

/// Turns the tables with [`write_former_words`] into those of version 15, without the number of the version. The checksum
/// of the candidate is unknown, since no program of this version writes its word.
pub const TO_VERSION_15: &str = "
    DROP INDEX job_order;
    DROP TABLE sample; DROP TABLE trajectory; DROP TABLE assignment; DROP TABLE reference_volume; ALTER TABLE walk_progress DROP COLUMN reference_step;
    DROP TABLE walk_trace; ALTER TABLE job DROP COLUMN value; ALTER TABLE job DROP COLUMN value_factors;
    CREATE INDEX job_order ON job (state, priority DESC, decision, protocol);
    DROP TABLE version_file; DROP TABLE version;
    UPDATE candidate SET reason = 'guard', checksum = -1 WHERE reason = 'too_close';
    UPDATE candidate_count SET fate = 'guard' WHERE fate = 'too_close';
    ALTER TABLE walk RENAME COLUMN rejected TO refused; ALTER TABLE walk RENAME COLUMN rollbacks TO returns;
    ALTER TABLE label RENAME COLUMN status TO standing; ALTER TABLE walk_progress RENAME TO pace;
    DELETE FROM _sqlx_migrations WHERE version > 15";

/// Ends of walks before and now.
const ENDS: [(&str, &str); 4] = [
    ("blew_up", "diverged"),
    ("steps", "completed"),
    ("collected", "quota_reached"),
    ("bad_start", "invalid_start"),
];

/// An accepted and a declined candidate, four walks that ended, and a failed label job.
pub async fn write_former_words(store: &Store) {
    let declined = Fate::Declined(DeclineReason::TooClose);
    let records =
        vec![candidate(0, 1, Origin::Biased, Fate::Accepted), candidate(0, 2, Origin::Biased, declined)];
    let mut commit = commit_of(records);
    commit.decisions[1].detail = json!({ "reason": "guard" });
    let logged = |kind, walk, detail| Decision {
        round: 1,
        kind,
        walk: Some(WalkId(walk)),
        candidate: None,
        mixture_version: 2,
        detail,
    };
    commit.decisions.push(logged("segment", 0, json!({ "from": 7, "returns": 2, "to": 3 })));
    for ((end, _), number) in ENDS.into_iter().zip(0..) {
        commit.decisions.push(logged("ended", number, json!({ "end": end, "reason": "\"end\":\"steps\"" })));
        commit.walks.push(WalkRecord {
            state: end.into(),
            accepted: u32::from(number == 0),
            selector_state: r#"{"verdict":{"declined":"guard"}}"#.into(),
            ..walk(number, 3)
        });
    }
    store.commit(&commit).await.unwrap();
    let lease = store.lease(protocol("dft").hash, "l", 0, 600).await.unwrap().unwrap();
    store.fail(&lease, "lost_node", "gone", 1, 1).await.unwrap();
}

/// Checks that all of it is read with the words of this version, and nothing is damaged.
pub async fn check_present_words(store: &Store) {
    let status = store.status().await.unwrap();
    let states: Vec<_> = status.walks.iter().map(|walk| walk.state.as_str()).collect();
    assert_eq!(states, ENDS.map(|(_, now)| now));
    assert_eq!((status.walks[0].rejected, status.candidates.declined.too_close), (2, 1));
    for walk in store.load_walks().await.unwrap() {
        assert_eq!(walk.selector_state, r#"{"verdict":{"declined":"too_close"}}"#);
    }
    let decisions = store.decisions(1..=99).await.unwrap();
    assert_eq!(decisions[1].detail, json!({ "reason": "too_close" }));
    assert_eq!(decisions[2].detail, json!({ "from": 7, "rollbacks": 2, "to": 3 }));
    for (decision, (_, now)) in decisions[3..].iter().zip(ENDS) {
        assert_eq!(decision.detail, json!({ "end": now, "reason": "\"end\":\"steps\"" }));
    }
    let declined = candidate(0, 2, Origin::Biased, Fate::Declined(DeclineReason::TooClose));
    let stored = store.candidate(&name_of(&declined)).await.unwrap().unwrap();
    assert_eq!(stored.fate, declined.fate);
    let failures = store.failures(protocol("dft").hash).await.unwrap();
    assert_eq!((failures[0].class.as_str(), failures[0].failed), ("node_failure", 1));
    assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
}

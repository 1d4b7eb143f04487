//! Trajectories of walks: in one transaction with the records of their assignments, verified, copied, and absent in earlier versions.

use store::{Commit, Location, Store, TrajectoryPart};
use wire::{WalkFrame, WalkId};

use crate::assignments::assignment;
use crate::common::*;

/// Frames of a part of a walk with three atoms.
pub fn trajectory_part(walk: u32, part: u64, frames: u64) -> TrajectoryPart {
    let frame = |number: u64| WalkFrame {
        segment: part as u32,
        step: 100 * part + number,
        time: 2.0 * number as f64,
        temperature: 600.5,
        cell: [[4.05, 0.0, 0.0], [0.1, 4.05, 0.0], [0.0, 0.0, 4.05 + number as f64]],
        positions: (0..3).map(|atom| [atom, -1_000_001 * atom, 2_025_000 + number as i64]).collect(),
    };
    TrajectoryPart { walk: WalkId(walk), part, frames: (0..frames).map(frame).collect() }
}

fn commit(parts: &[(u32, u64, u64)]) -> Commit {
    Commit {
        assignments: parts.iter().map(|(walk, part, _)| assignment(*walk, *part)).collect(),
        trajectories: parts
            .iter()
            .map(|(walk, part, frames)| trajectory_part(*walk, *part, *frames))
            .collect(),
        ..Commit::default()
    }
}

async fn found(store: &Store, walk: u32, part: u64) -> Vec<WalkFrame> {
    store.trajectory_part(WalkId(walk), part).await.unwrap()
}

#[tokio::test]
async fn trajectories_are_written_verified_and_copied() {
    let database = TestDatabase::new();
    let store = database.create().await;
    store.commit(&commit(&[(0, 0, 2), (1, 0, 40), (0, 1, 0)])).await.unwrap();
    store.commit(&commit(&[(0, 2, 1)])).await.unwrap();
    // A commit that fails writes none.
    assert!(store.commit(&commit(&[(1, 1, 1), (0, 2, 1)])).await.is_err());
    let check = async |store: &Store| {
        for (walk, part, frames) in [(0, 0, 2), (0, 1, 0), (0, 2, 1), (1, 0, 40), (1, 1, 0), (2, 0, 0)] {
            assert_eq!(
                found(store, walk, part).await,
                trajectory_part(walk, part, frames).frames,
                "{walk} {part}"
            );
        }
        assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
    };
    check(&store).await;
    let copies = tempfile::tempdir().unwrap();
    let copy = copies.path().join("copy");
    store.backup(&copy, 3, |_, _| {}).await.unwrap();
    let copied = Store::open(copy.as_path()).await.unwrap();
    check(&copied).await;
    copied.close().await;

    for (damage, faults) in [
        ("UPDATE trajectory SET frames = 3 WHERE walk = 1", 1),
        ("UPDATE trajectory SET data = substr(data, 1, 30) WHERE walk = 0 AND part = 0", 2),
        // The checksum fits, but not what has it.
        ("DELETE FROM assignment WHERE walk = 0 AND part = 2", 3),
    ] {
        database.execute(damage).await;
        let found = store.check(|_, _| {}).await.unwrap();
        assert_eq!(found.len(), faults, "{found:?}");
        assert!(found.iter().any(|finding| finding.what.contains("trajectory")), "{found:?}");
    }
    assert!(store.trajectory_part(WalkId(1), 0).await.is_err());
    store.close().await;
}

#[tokio::test]
async fn tables_of_version_20_have_no_trajectories() {
    let database = TestDatabase::new();
    database.create().await.close().await;
    database.execute(TO_VERSION_20).await;
    if let Location::Directory(_) = database.location() {
        database.execute("PRAGMA user_version = 20").await;
    }
    let store = database.open_read_only().await;
    assert_eq!(found(&store, 0, 0).await, []);
    assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
    store.close().await;
    let store = database.open().await;
    store.commit(&commit(&[(0, 0, 2)])).await.unwrap();
    assert_eq!(found(&store, 0, 0).await, trajectory_part(0, 0, 2).frames);
    store.close().await;
}

//! `calmwalk rerun`: walks come out bit by bit, whatever happened to them, and their trajectories have the recorded structures.

use std::fs;
use std::path::Path;
use std::process::Stdio;

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection};
use store::{AssignmentRecord, Store, StoredCandidate, WalkRecord};
use tempfile::TempDir;
use wire::{ContentHash, Origin};

use crate::common::campaign::{Small, written};
use crate::common::processes::{signal, wait_until};
use crate::common::{Running, calmwalk, program, refuse, stderr, succeed};

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "here"];

/// What the store has of a campaign's walks.
struct Recorded {
    walks: Vec<WalkRecord>,
    candidates: Vec<StoredCandidate>,
    assignments: Vec<Vec<AssignmentRecord>>,
}

fn recorded(directory: &Path) -> Recorded {
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = Store::open_read_only(&directory.join("here")).await.unwrap();
        let walks = store.load_walks().await.unwrap();
        let mut assignments = Vec::new();
        for walk in &walks {
            assignments.push(store.assignments(walk.walk).await.unwrap());
        }
        Recorded { walks, candidates: store.candidates(0, true, u32::MAX).await.unwrap(), assignments }
    })
}

/// A finished campaign with these changes to its configuration.
fn finished(small: &Small, changes: &[(&str, &str)]) -> TempDir {
    let directory = written(small, changes);
    succeed(directory.path(), RUN);
    directory
}

/// Runs every walk again. Each candidate must be a frame of its trajectory. Returns the number of candidates.
fn check_all(directory: &Path) -> usize {
    let Recorded { walks, candidates, .. } = recorded(directory);
    let before = fs::read(directory.join("here/campaign.sqlite")).unwrap();
    // A walk that was created just before the end has no record.
    for walk in walks.iter().filter(|walk| walk.assignments > 0) {
        let number = walk.walk.to_string();
        let arguments = ["rerun", "here", &number, "--trajectory", "walk.extxyz.zst", "--every", "1"];
        let said = succeed(directory, arguments);
        let of_walk = candidates.iter().filter(|candidate| candidate.block.view().id().walk == walk.walk);
        let of_walk: Vec<_> = of_walk.map(|candidate| candidate.block.view().id()).collect();
        assert!(said.contains(&format!("{} candidate", of_walk.len())), "{said}");
        assert!(said.contains(&format!("up to step {}", walk.progress.step)), "{said}");
        let packed = fs::File::open(directory.join("walk.extxyz.zst")).unwrap();
        fs::write(directory.join("walk.extxyz"), zstd::decode_all(packed).unwrap()).unwrap();
        let frames = atoms::read_extxyz(&directory.join("walk.extxyz")).unwrap();
        assert!(frames.len() as u64 > walk.progress.step, "{} frames", frames.len());
        let hashes: Vec<_> =
            frames.iter().map(|frame| ContentHash::from_structure(&frame.structure)).collect();
        for id in of_walk {
            let found = hashes.iter().position(|hash| *hash == id.content);
            let frame = &frames[found.unwrap_or_else(|| panic!("no frame of candidate {id}"))];
            assert_eq!(frame.info["step"], (id.step as i64).into(), "{id}");
            assert_eq!(frame.info["segment"], i64::from(id.segment).into(), "{id}");
        }
    }
    assert_eq!(fs::read(directory.join("here/campaign.sqlite")).unwrap(), before, "nothing is written");
    candidates.len()
}

#[test]
fn biased_and_control_walks_come_out_bit_by_bit() {
    let small = Small {
        walks_per_round: 4,
        seed_structures: &["fcc-100", "fcc-097", "fcc-103", "vacancy"],
        ..Small::default()
    };
    let directory = finished(&small, &[]);
    let Recorded { walks, candidates, assignments } = recorded(directory.path());
    assert!(walks.iter().any(|walk| walk.origin == Origin::Control && walk.accepted > 0));
    assert!(candidates.iter().any(|candidate| candidate.block.view().mixture_version() > 1));
    let declined = |part: &AssignmentRecord| {
        part.start.verdict.as_ref().is_some_and(|verdict| verdict.name() != "accepted")
    };
    assert!(assignments.iter().flatten().any(declined), "no verdict but accepted");
    check_all(directory.path());
}

#[test]
fn a_live_campaign_that_was_interrupted_comes_out_bit_by_bit() {
    let small = Small {
        mode: "live",
        walkers: 3,
        steps: 1_200,
        max_per_walk: 1_000,
        seed_structures: &["fcc-100", "fcc-103", "vacancy"],
        ..Small::default()
    };
    let directory = written(&small, &[("steps_per_assignment = 40", "steps_per_assignment = 400")]);
    let here = directory.path();
    let interrupted = || {
        let is_part = |pair: &&[AssignmentRecord]| pair[0].number == pair[1].number;
        recorded(here).assignments.iter().any(|walk| walk.windows(2).any(|pair| is_part(&pair)))
    };
    let mut steps = 0;
    // An interruption between two assignments divides none.
    for (time, least) in [0, 0, 3, 3, 3, 3].into_iter().enumerate() {
        if time >= 3 && interrupted() {
            break;
        }
        let mut run =
            Running(program(here).args(RUN).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
        wait_until("steps and candidates", || {
            let status = calmwalk(here, ["status", "here", "--json"]);
            let status = serde_json::from_slice::<serde_json::Value>(&status.stdout).unwrap_or_default();
            let walks = status["walks"].as_array().into_iter().flatten();
            let made: u64 = walks.filter_map(|walk| walk["step"].as_u64()).sum();
            let is_further = made > steps && status["candidates"]["seen"].as_u64() >= Some(least);
            steps = if is_further { made } else { steps };
            is_further || status["finished"] == true
        });
        signal(run.0.id(), "INT");
        run.0.wait().unwrap();
    }
    assert!(interrupted(), "no assignment was interrupted");
    assert!(check_all(here) > 2);
}

#[test]
fn a_walk_that_rolled_back_comes_out_bit_by_bit() {
    // Near the distance of neighbours in the crystal.
    let keys = "[guard]\nmax_consecutive_rejections = 2\nmax_rollbacks = 1\n\
        min_distances = { rule = \"per_pair\", pairs = { \"Al-Al\" = 2.8 } }\n";
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let config = Small { seed_structures: &["fcc-100"], ..Small::default() }.write(here);
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("[guard]\n", keys)).unwrap();
    // A campaign whose only walk is trapped fails.
    calmwalk(here, RUN);
    let Recorded { walks, assignments, .. } = recorded(here);
    assert!(walks[0].progress.rollbacks > 0, "{:?}", walks[0].progress);
    assert!(assignments[0].iter().any(|part| part.end.segment > 0));
    check_all(here);
}

#[test]
fn walks_of_trained_versions_come_out_bit_by_bit() {
    let directory = finished(&Small::with_two_versions(), &[]);
    let walks = recorded(directory.path()).walks;
    let of_version = |walk: &&WalkRecord| walk.conditions.version == 1 && walk.accepted > 0;
    assert!(walks.iter().any(|walk| of_version(&walk)), "no walk of a trained version");
    check_all(directory.path());
}

#[test]
fn walks_at_constant_pressure_come_out_bit_by_bit() {
    let small = Small { steps: 120, max_per_walk: 2, ..Small::default() };
    let directory =
        written(&small, &[("volume_ramp = { from = 1.0, to = 1.25 }\n", "reference_steps = 60\n")]);
    let here = directory.path();
    let path = here.join("campaign.toml");
    let groups =
        "\n[[walks]]\nname = \"driven\"\npressures = [1.0]\nstart_volumes = [0.97, 1.05]\ncell_bias = true\n";
    fs::write(&path, fs::read_to_string(&path).unwrap() + groups).unwrap();
    succeed(here, RUN);
    let in_reference = |part: &AssignmentRecord| part.end.reference_step.is_some();
    assert!(recorded(here).assignments.iter().flatten().any(in_reference));
    check_all(here);
}

#[test]
fn trajectories_have_the_formats_of_their_names() {
    let directory = finished(&Small { steps: 60, ..Small::default() }, &[]);
    let here = directory.path();
    let zstd = [0x28, 0xb5, 0x2f, 0xfd];
    for (name, every, frames, begin) in [
        ("a.extxyz", 20, 5, &b"32\nLattice="[..]),
        ("a.xyz.gz", 40, 3, &[0x1f, 0x8b]),
        ("a.lammpstrj", 20, 5, b"ITEM: UNITS\nmetal\n"),
        ("a.dump.zst", 40, 3, &zstd),
    ] {
        let said = succeed(here, ["rerun", "here", "0", "--every", &every.to_string(), "--trajectory", name]);
        assert!(said.contains(&format!("{frames} frames in {name}")), "{said}");
        assert!(fs::read(here.join(name)).unwrap().starts_with(begin), "{name}");
    }
    let refused = refuse(here, ["rerun", "here", "0", "--trajectory", "walk.pdb"]);
    assert!(refused.contains("expected a name that ends in .extxyz"), "{refused}");
}

#[test]
fn walks_without_a_record_are_refused() {
    let directory = finished(&Small { steps: 60, ..Small::default() }, &[]);
    let here = directory.path();
    let unknown = refuse(here, ["rerun", "here", "99"]);
    assert!(unknown.contains("the campaign has no walk 99; they are 0 to"), "{unknown}");
    // Another assignment than the record says.
    execute(here, "UPDATE assignment SET threshold_factor = 5.0, checksum = -1 WHERE walk = 0");
    let output = calmwalk(here, ["rerun", "here", "0"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("walk 0 is not reproduced: "), "{said}");
    // Another end than the record says.
    for (change, said) in [
        ("gamma_max = gamma_max + 1.0", "γ_max of the last step differs"),
        ("rejected = rejected + 1", "the number of rejections differs"),
        (
            "checkpoint = (SELECT checkpoint FROM walk AS other WHERE other.walk = 2), checkpoint_checksum = -1",
            "the last checkpoint differs",
        ),
    ] {
        execute(here, "DROP TABLE IF EXISTS kept; CREATE TABLE kept AS SELECT * FROM walk");
        execute(here, &format!("UPDATE walk SET {change}, checksum = -1 WHERE walk = 1"));
        let output = calmwalk(here, ["rerun", "here", "1"]);
        assert_eq!(output.status.code(), Some(1));
        assert!(
            stderr(&output).contains(&format!("walk 1 is not reproduced: {said}")),
            "{}",
            stderr(&output)
        );
        execute(here, "DELETE FROM walk; INSERT INTO walk SELECT * FROM kept; DROP TABLE kept");
    }
    succeed(here, ["rerun", "here", "1"]);
    // The tables of version 19.
    let sql = "DROP TABLE sample; DROP TABLE trajectory; DROP TABLE assignment; DROP TABLE reference_volume; ALTER TABLE walk_progress DROP COLUMN reference_step;
        UPDATE walk SET selector_state = replace(selector_state, '\"records\"', '\"before\"'), checksum = -1;
        DELETE FROM _sqlx_migrations WHERE version > 19; PRAGMA user_version = 19;";
    execute(here, sql);
    for _ in 0..2 {
        let refused = refuse(here, ["rerun", "here", "0", "--trajectory", "walk.extxyz"]);
        assert!(
            refused.contains("walk 0 began under a version of calmwalk that did not record its assignments"),
            "{refused}"
        );
        assert!(!here.join("walk.extxyz").exists());
        // Migrates the tables.
        succeed(here, RUN);
    }
}

fn execute(here: &Path, sql: &str) {
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let options = SqliteConnectOptions::new().filename(here.join("here/campaign.sqlite"));
        let mut connection = options.connect().await.unwrap();
        sqlx::raw_sql(sqlx::AssertSqlSafe(sql.to_owned())).execute(&mut connection).await.unwrap();
        connection.close().await.unwrap();
    });
}

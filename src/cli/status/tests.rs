//! Checks that the output fits a screen, and that docs/status.md describes the JSON output.

use std::collections::BTreeSet;
use std::path::Path;

use monitor::disk::DiskForecast;
use monitor::end_reason::CampaignEnd;
use monitor::label_cost::{CoreHours, QueueCost};
use monitor::label_progress::LabelUnderWay;
use monitor::label_queue::LabelQueue;
use monitor::mixture_values::MixtureValues;
use monitor::provenance::Provenance;
use monitor::snapshot::FORMAT;
use monitor::versions::CampaignVersions;
use orchestrator::batch::{CampaignJob, Role};
use serde_json::{Value, json};
use store::records::{STALENESS, TRAINING_FRAMES};
use store::{
    Budget, BudgetStatus, BudgetUse, Declined, FailureCount, LabelJobCounts, OldestLease, ProcessRecord,
    RunningLabel, Unlabelled, ValueRange, WalkStatus, unix_milliseconds,
};
use wire::{CampaignId, DeviceStatistics, WalkConditions};

use super::*;

/// A large campaign with a value for every field.
pub fn large() -> Snapshot {
    let staleness = json!({ "counts": { "0": 900_000, "3": 100_000 }, "largest": 3 });
    let training = json!({
        "atoms": 20_000, "median": 0.51, "percentile_95": 1.2, "maximum": 7.0, "share_above_one": 0.25, "alarm": true,
        "level": 1.25, "level_of_share": 1.25, "level_of_growth": 0.5, "elements": [{ "element": "Mo", "mean_square_growth": 2.5, "share_above_one": 0.25,
            "components": [{ "component": 3, "mean_square_growth": 6.1 }] }],
    });
    let values = [(STALENESS, staleness), (TRAINING_FRAMES, training)];
    let hours = CoreHours { expected: 123_456.0, low: 98_765.0, high: 234_567.0 };
    let cost = QueueCost {
        unfinished: 12_345,
        measured: 5000,
        overhead: 1.25,
        remaining: Some(hours),
        cores: 4096,
        hours_left: Some(30.1),
    };
    let failure =
        |class: &str| FailureCount { class: class.into(), labelled: 1000, failed: 2000, unfinished: 300 };
    let range = |low, high| ValueRange { low: Some(low), high: Some(high) };
    let unlabelled = Unlabelled {
        seed_structure: "bcc-100".into(),
        formula: "Mo54".into(),
        failed: 12,
        labelled: 1234,
        gamma: range(1.0, 9.5),
        gamma_labelled: range(1.0, 12.5),
        relative_volume: range(0.8, 1.2),
        relative_volume_labelled: range(0.8, 1.2),
    };
    Snapshot {
        campaign: store::CampaignRecord {
            id: CampaignId([7; 16]),
            program_version: String::new(),
            mode: "reproducible".into(),
            configuration: String::new(),
            resolved_configuration: String::new(),
            configuration_in_force: String::new(),
        },
        origin: Some(Provenance::new(
            Path::new("/scratch/a-long-name-of-a-project/a-long-name-of-a-campaign/campaign.toml"),
            "",
            Path::new("/scratch"),
        )),
        status: status(),
        devices: vec![DeviceStatistics {
            adapter: "gracemaker".into(),
            device: "cuda:1".into(),
            last_failure: Some(
                "adapter gracemaker in /opt/a-long-name-of-an-environment: no answer for 60 s".into(),
            ),
            restarts: 3,
            ..DeviceStatistics::default()
        }],
        mixture: MixtureValues(values.map(|(name, value)| (name.to_owned(), value.to_string())).into()),
        disk: DiskUse {
            bytes: 123_456_789_012,
            forecast: Some(DiskForecast {
                structures: 9 << 33,
                rest: 1 << 32,
                declined: 1 << 30,
                max_structures: 200_000,
            }),
        },
        labels: LabelQueue {
            cost,
            failures: ["not_converged", "out_of_memory", "implausible"].map(failure).into(),
            unlabelled: vec![unlabelled],
            by_protocol: Vec::new(),
            running: vec![LabelUnderWay {
                label: RunningLabel {
                    job: 17,
                    candidate: "07070707-1.0.5-0123456789abcdef".into(),
                    protocol: "dft".into(),
                    seed_structure: 0,
                    formula: "Mo54".into(),
                    atoms: 54,
                    attempt: 2,
                    holder: "node7-17-0/3".into(),
                    started: 0,
                    cores: Some(64),
                },
                expected_seconds: Some(3600.0),
            }],
            shared: Some(12),
        },
        end_reason: Some(CampaignEnd::Budget { key: "budget.labels".into() }),
        check: Some(crate::wording::reference_check::tests::example()),
        versions: crate::wording::versions::tests::example(),
        end: ExpectedEnd {
            walks_hours: Some(12.0),
            labels_hours: Some(30.1),
            budget_hours: Some(100.0),
            time: Some(unix_milliseconds() + 108_360_000),
        },
    }
}

/// A campaign in which nothing has begun.
pub fn empty() -> Snapshot {
    Snapshot {
        origin: None,
        status: CampaignStatus::default(),
        devices: Vec::new(),
        mixture: MixtureValues(Default::default()),
        disk: DiskUse { bytes: 1_000_000, forecast: None },
        labels: LabelQueue::default(),
        end_reason: None,
        check: None,
        versions: CampaignVersions { all: Vec::new(), refit: None },
        end: ExpectedEnd::default(),
        ..large()
    }
}

/// A campaign whose run was stopped.
pub fn stopped() -> Snapshot {
    let walk = |number, state: &str| WalkStatus {
        walk: number,
        seed_structure: "bcc-100".into(),
        origin: "biased".into(),
        state: state.into(),
        step: 2000,
        gamma_max: Some(1.25),
        accepted: 3,
        ..WalkStatus::default()
    };
    let walks = vec![walk(0, "running"), walk(1, "waiting"), walk(2, "quota_reached")];
    let candidates = Candidates { seen: 9, accepted: 9, ..Candidates::default() };
    let labels = LabelJobCounts { queued: 2, labelled: 7, ..LabelJobCounts::default() };
    let status =
        CampaignStatus { walks, candidates, labels, mixture_version: 9, ..CampaignStatus::default() };
    Snapshot { status, ..empty() }
}

/// A campaign without a label, whose walk ended early.
fn failed() -> Snapshot {
    let walks = vec![WalkStatus {
        walk: 0,
        seed_structure: "bcc-100".into(),
        origin: "biased".into(),
        state: "diverged".into(),
        reason: "at step 5: 9000 K is above the allowed 800 K".into(),
        ..WalkStatus::default()
    }];
    let labels = LabelJobCounts { failed: 1, ..LabelJobCounts::default() };
    let unlabelled = Unlabelled { failed: 1, labelled: 0, ..large().labels.unlabelled.remove(0) };
    let failures = vec![FailureCount { class: "crashed".into(), labelled: 0, failed: 1, unfinished: 0 }];
    Snapshot {
        status: CampaignStatus { walks, labels, finished: true, ..CampaignStatus::default() },
        labels: LabelQueue { failures, unlabelled: vec![unlabelled], ..LabelQueue::default() },
        ..empty()
    }
}

fn status() -> CampaignStatus {
    let walk = |number: u32| WalkStatus {
        walk: number,
        seed_structure: format!("a-long-name-of-a-seed-structure-{number}"),
        origin: if number.is_multiple_of(2) { "biased" } else { "control" }.into(),
        state: if number < 4 {
            "running"
        } else if number == 4 {
            "diverged"
        } else {
            "quota_reached"
        }
        .into(),
        reason: if number == 4 { "at step 1000000: 23456 K is above the allowed 20000 K" } else { "" }.into(),
        step: 10_000_000,
        tau: Some(0.3),
        temperature: Some(12_345.0),
        relative_volume: Some(1.234),
        gamma_max: Some(123.45),
        steps_per_second: Some(1234.5),
        conditions: Some(WalkConditions {
            cell: if number.is_multiple_of(2) {
                wire::CellConditions::ConstantPressure(wire::ConstantPressure {
                    pressure: 1.0,
                    start_volume: 1.0,
                    cell_bias: true,
                })
            } else {
                wire::CellConditions::VolumeRamp { from: 1.0, to: 1.4 }
            },
            ..WalkConditions::default()
        }),
        accepted: 300,
        ..WalkStatus::default()
    };
    let process = |number: u32| ProcessRecord {
        remark: "exit code 2: something that takes a whole sentence and some more to say".into(),
        ..ProcessRecord::new(ProcessRecord::WALKER, Some(number), 4_000_000, 0)
    };
    let declined = Declined {
        covered: 900_000,
        duplicate: 10_000,
        too_close: 1_000,
        budget: 100,
        backlog: 10_000,
        unlikely_to_complete: 0,
        grade_too_large: 0,
    };
    CampaignStatus {
        walkers_busy: Some(0.625),
        candidates: Candidates {
            seen: 1_000_000,
            accepted: 80_000,
            declined,
            control: 80_000,
            rejected_by_guards: 123_456,
        },
        labels: LabelJobCounts {
            queued: 12_345,
            leased: 1024,
            labelled: 140_000,
            failed: 2000,
            dropped: 12,
            ..LabelJobCounts::default()
        },
        oldest_lease: Some(OldestLease { job: 17, holder: "node7-17-0/3".into(), started: 0 }),
        labels_last_hour: 512,
        imported: 10_000,
        mixture_version: 80_000,
        round: 1_000_000,
        run_active: true,
        steps_per_second: Some(123_456.7),
        walks: (0..1000).map(walk).collect(),
        processes: (0..1000).map(process).collect(),
        budget: BudgetStatus {
            limits: Budget {
                labels: Some(200_000),
                core_hours: Some(1e6),
                wall_hours: Some(1000.0),
                structures_by: Some("budget.labels".into()),
            },
            used: BudgetUse {
                labels: 140_000,
                attempts_in_progress: 1024,
                core_hours: 654_321.0,
                wall_hours: 900.0,
            },
            used_up: Some("budget.labels".into()),
        },
        finished: false,
    }
}

fn job() -> (CampaignJob, Option<String>) {
    let job = CampaignJob {
        id: 1_234_567.into(),
        role: Role::Agent(3),
        state: "PENDING".into(),
        nodes: "node7".into(),
        start: "2026-11-21T20:15:00".into(),
        time_left: "1:00:00".into(),
        walkers: Some(4),
        reason: Some("Resources".into()),
    };
    (job, Some("1:0".into()))
}

#[test]
fn the_status_of_a_large_campaign_fits_a_screen() {
    for (jobs, lines) in [(BatchJobs::None, 40), (BatchJobs::Known(vec![job(); 100]), 45)] {
        let page = StatusLayout { width: 80, ..StatusLayout::unlimited().screen() };
        let mut text = Vec::new();
        write(&mut text, &large(), &jobs, page, None).unwrap();
        let text = String::from_utf8(text).unwrap();
        let widest = text.lines().map(|line| line.chars().count()).max();
        assert!(text.lines().count() <= lines && widest <= Some(80), "{text}");
        for words in ["oldest for", "512 made in the last hour", "123456.7 steps/s", "expected within 30 h"] {
            assert!(text.contains(words), "{words}: {text}");
        }
    }
}

/// The output on a screen of 80 columns.
fn on_a_screen(snapshot: &Snapshot) -> String {
    let page = StatusLayout { width: 80, ..StatusLayout::unlimited().screen() };
    let mut text = Vec::new();
    write(&mut text, snapshot, &BatchJobs::None, page, None).unwrap();
    String::from_utf8(text).unwrap()
}

#[test]
fn a_campaign_in_which_nothing_has_begun_shows_what_there_is() {
    let expected = "\
campaign    07070707070707070707070707070707, reproducible mode
state       not running (resume with calmwalk run)
walks       none yet
mixture     version 0
candidates  0 seen, 0 accepted
labels      none yet
disk        1.0 MB now
";
    assert_eq!(on_a_screen(&empty()), expected);
}

#[test]
fn a_stopped_campaign_has_unfinished_walks_and_no_expected_end() {
    let text = on_a_screen(&stopped());
    for line in [
        "state       not running (resume with calmwalk run)\n",
        "walks       2 unfinished, 1 ended (1 quota reached)\n",
        "labels      2 queued, 7 labelled\n",
        "0  bcc-100    stopped",
        "1  bcc-100    waiting",
    ] {
        assert!(text.contains(line), "{line}: {text}");
    }
    assert!(!text.contains("steps/s") && !text.contains("\nend "), "{text}");
}

#[test]
fn a_campaign_without_labels_says_why_and_what_to_change() {
    let text = on_a_screen(&failed());
    for words in [
        "state       finished\n",
        "walks       1 ended (1 diverged)\n            too hot: try ",
        "labels      1 failed\n",
        "failures    crashed in 1: 0 labelled, 1 failed, 0 unfinished\n",
        "unlabelled  the labels of 1 structure failed, which leaves these ranges",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }
}

#[test]
fn all_walks_are_shown_on_request() {
    let mut text = Vec::new();
    write(&mut text, &large(), &BatchJobs::None, StatusLayout::unlimited().screen(), Some(usize::MAX))
        .unwrap();
    let text = String::from_utf8(text).unwrap();
    assert!(text.contains("a-long-name-of-a-seed-structure-999") && !text.contains("more walks"));
    assert!(text.contains("more processes"));
}

#[test]
fn a_finished_campaign_says_why_it_ended() {
    let ended = Snapshot { end: ExpectedEnd::default(), ..large() };
    assert!(text(&ended, 120).contains("\nend         budget.labels is used up\n"));
}

/// Paths of all scalar values, as docs/status.md writes them.
fn keys(value: &Value, name: &str, keys: &mut BTreeSet<String>) {
    match value {
        Value::Object(object) => {
            for (key, value) in object {
                let key = if key.parse::<u64>().is_ok() { "*" } else { key };
                let name = if name.is_empty() { key.to_owned() } else { format!("{name}.{key}") };
                self::keys(value, &name, keys);
            }
        }
        Value::Array(list) => list.iter().for_each(|value| self::keys(value, &format!("{name}[]"), keys)),
        _ => drop(keys.insert(name.to_owned())),
    }
}

#[test]
fn every_key_is_documented_and_every_documented_key_is_there() {
    let mut found = BTreeSet::new();
    for end in [
        CampaignEnd::NothingNew { steps: Some(500) },
        CampaignEnd::SmallImprovement { version: 2, improvement: 0.01 },
        CampaignEnd::AllVersions { versions: 3 },
    ] {
        let ended = Snapshot { end_reason: Some(end), ..large() };
        keys(&crate::wording::json::snapshot(&ended).unwrap(), "", &mut found);
    }
    for jobs in [BatchJobs::Known(vec![job()]), BatchJobs::Unknown("no answer".into())] {
        let mut json = crate::wording::json::snapshot(&large()).unwrap();
        jobs.add_to(&mut json);
        assert_eq!(json["version"], FORMAT);
        keys(&json, "", &mut found);
    }
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/status.md")).unwrap();
    let rows = text.lines().filter_map(|line| line.strip_prefix("| `")?.split_once("` | "));
    let documented: BTreeSet<_> = rows.map(|(key, _)| key.to_owned()).collect();
    assert_eq!(found, documented);
    assert!(text.contains(&format!("of this description: {}", FORMAT)));
}

//! A campaign of a few seconds: two seed structures of aluminium, short hot walks, and thresholds low enough to
//! collect.

use std::fs;
use std::path::{Path, PathBuf};

use store::{ComponentRecord, ExportFilter, Location, Store, VersionRecord};
use tempfile::TempDir;
use wire::{TracePoint, WalkFrame, WalkId};

use super::config;

/// Keys that tests vary.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Small {
    pub mode: &'static str,
    pub walkers: usize,
    pub walks_per_round: usize,
    pub steps: u64,
    pub max_per_walk: u32,
    pub seed_structures: &'static [&'static str],
    /// The section `[refit]`, or nothing.
    pub refit: &'static str,
}

/// Two versions of the potential, trained in a second each, with a small rate: there are few updates. Of the two default seed structures, one is held out.
pub const TWO_VERSIONS: &str = r#"
[refit]
replay = ["replay.extxyz"]
after_structures = 5
max_versions = 2
held_out = 0.5
max_held_out_error_ratio = 10.0
max_attempts = 100
control_frames = "compare"
start = "first"
method = { native = { epochs = 2, learning_rate = 1e-3, validation_share = 0.0 } }
test_sets = [{ name = "known", file = "replay.extxyz" }]
comparisons = [{ name = "known", file = "replay.extxyz" }]
"#;

/// Steps between two frames of the trajectories.
pub const TRAJECTORY_INTERVAL: u64 = 25;

/// Number of structures of the replay data.
const REPLAY: usize = 6;

impl Default for Small {
    fn default() -> Self {
        let seed_structures = &["fcc-100", "vacancy"];
        Self {
            mode: "reproducible",
            walkers: 2,
            walks_per_round: 2,
            steps: 240,
            max_per_walk: 4,
            seed_structures,
            refit: "",
        }
    }
}

impl Small {
    /// A campaign that trains two versions of its potential.
    pub fn with_two_versions() -> Self {
        Self { max_per_walk: 3, refit: TWO_VERSIONS, ..Self::default() }
    }

    /// Text of the configuration.
    pub fn text(&self) -> String {
        let Self { mode, walkers, walks_per_round, steps, max_per_walk, refit, .. } = self;
        let file = |path: &str| config(path).display().to_string();
        format!(
            r#"
[campaign]
mode = "{mode}"
rng_seed = 7
[potential]
model = "{model}"
[calm]
artifact = "{artifact}"
training_frames = "{frames}"
[seed_structures]
files = ["seeds.extxyz"]
[walk]
temperature = 700.0
biased_steps = {steps}
equilibration_steps = 20
tau = 0.3
trajectory_interval = {TRAJECTORY_INTERVAL}
volume_ramp = {{ from = 1.0, to = 1.25 }}
[collect]
criterion = {{ rule = "atom_count", threshold = 1.0, fraction = 0.1 }}
update_target = {{ rule = "atom_count", threshold = 1.0, fraction = 0.1, target = 1.25 }}
min_interval = 30
min_interval_after_decline = 5
max_per_walk = {max_per_walk}
[guard]
zbl = {{ rule = "uniform", inner = 1.6, outer = 2.4 }}
[label]
method = {{ potential = {{ kind = "eam_fs", file = "{label}" }} }}
[run]
walkers = {walkers}
walks_per_round = {walks_per_round}
steps_per_assignment = 40
{refit}"#,
            model = file("data/al_eam_1l/kokkos.npz"),
            artifact = file("data/al_eam_1l/gmm_artifacts.npz"),
            frames = file("data/al_eam_1l/seed_frames.extxyz"),
            label = file("data/Al_mm.eam.fs"),
        )
    }

    /// Writes configuration, seed structures and, for a refit, replay data into `directory`. Returns the path of the configuration.
    pub fn write(&self, directory: &Path) -> PathBuf {
        let frames =
            atoms::read_extxyz(&config("data/aluminium_seeds.extxyz")).expect("the demo's seed structures");
        let mut seeds = Vec::new();
        for name in self.seed_structures {
            let named = |frame: &&atoms::extxyz::Frame| frame.info["name"].text() == Some(name);
            let frame = frames.iter().find(named).expect("a seed structure of that name");
            atoms::extxyz::write_frame(&mut seeds, frame).expect("memory");
        }
        fs::write(directory.join("seeds.extxyz"), seeds).expect("a directory to write in");
        if !self.refit.is_empty() {
            let known =
                atoms::read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).expect("the demo's data");
            super::write_frames(&directory.join("replay.extxyz"), &known[..REPLAY]);
        }
        let path = directory.join("campaign.toml");
        fs::write(&path, self.text()).expect("a directory to write in");
        path
    }
}

/// The results of a campaign that must not depend on interruptions, byte for byte.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    pub decisions: String,
    pub components: Vec<ComponentRecord>,
    pub walks: Vec<(u32, String, u64, Option<Vec<u8>>)>,
    pub traces: Vec<Vec<TracePoint>>,
    pub trajectories: Vec<Vec<WalkFrame>>,
    pub dataset: Vec<u8>,
    /// Versions of the potential: everything but time and cost.
    pub versions: Vec<VersionRecord>,
}

/// Progress of a campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd)]
pub struct Counters {
    /// Candidates and control frames that reached the selector.
    pub sent: u64,
    /// Number of those in the data set.
    pub accepted: u64,
    /// Number of labels.
    pub labels: u64,
}

impl Counters {
    /// Reads `status`. Zero before the campaign exists.
    pub fn read(location: &str, directory: &Path) -> Self {
        let output = super::calmwalk(directory, ["status", location, "--json"]);
        let status = serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap_or_default();
        let count = |path| status.pointer(path).and_then(serde_json::Value::as_u64).unwrap_or(0);
        let control = count("/candidates/control");
        Self {
            sent: count("/candidates/seen") + control,
            accepted: count("/candidates/accepted") + control,
            labels: count("/labels/labelled"),
        }
    }

    /// Whether no counter has decreased.
    pub fn has_not_decreased_since(&self, before: &Self) -> bool {
        self.sent >= before.sent && self.accepted >= before.accepted && self.labels >= before.labels
    }
}

/// Reads the outcome of the campaign in `directory` and checks that nothing is lost or duplicated.
pub fn outcome(directory: &Path) -> Outcome {
    outcome_at(&directory.display().to_string(), directory)
}

/// The same for a campaign at any location. Temporary files go to `directory`.
pub fn outcome_at(location: &str, directory: &Path) -> Outcome {
    let output = directory.join("dataset.extxyz");
    let arguments = ["export", location, "--control", "--output"];
    super::succeed(
        directory,
        arguments.iter().map(|a| (*a).to_owned()).chain([output.display().to_string()]),
    );
    let location: Location = if location == "." { directory.into() } else { location.parse().expect("one") };
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(async {
        let store = Store::open_read_only(location).await.expect("the campaign's database");
        check_consistency(&store).await;
        let walks = store.load_walks().await.expect("walks");
        let (mut traces, mut trajectories) = (Vec::new(), Vec::new());
        for walk in &walks {
            trajectories.push(frames(&store, walk.walk).await);
            traces.push(store.walk_trace(walk.walk).await.expect("a trace"));
        }
        let versions = store.versions().await.expect("versions").into_iter();
        let without_time = |version| VersionRecord { seconds: 0.0, core_hours: 0.0, time: 0, ..version };
        Outcome {
            versions: versions.map(without_time).collect(),
            decisions: store.decision_log_text().await.expect("decisions"),
            components: store.load_components().await.expect("components"),
            traces,
            trajectories,
            walks: walks
                .into_iter()
                .map(|walk| (walk.walk.0, walk.state, walk.assignments, walk.checkpoint))
                .collect(),
            dataset: fs::read(&output).expect("the exported data set"),
        }
    })
}

/// The frames of a walk. Those that a walker made that seemed lost are left out.
async fn frames(store: &Store, walk: WalkId) -> Vec<WalkFrame> {
    let mut frames = Vec::<WalkFrame>::new();
    for record in store.assignments(walk).await.expect("records") {
        for frame in store.trajectory_part(walk, record.part).await.expect("frames") {
            while frames.last().is_some_and(|last| (last.segment, last.step) >= (frame.segment, frame.step)) {
                frames.pop();
            }
            frames.push(frame);
        }
    }
    frames
}

/// Every accepted candidate has one label, decisions are numbered without gaps, and the queue is empty.
async fn check_consistency(store: &Store) {
    let status = store.status().await.expect("status");
    assert!(status.finished, "{status:?}");
    let decisions = store.decisions(1..=i64::MAX).await.expect("decisions");
    assert!(decisions.iter().zip(1..).all(|(decision, number)| decision.sequence == number));
    let kinds = |kind: &str| decisions.iter().filter(|decision| decision.kind == kind).count();
    assert_eq!(status.candidates.accepted as usize, kinds("accepted"));
    assert_eq!(status.candidates.control as usize, kinds("control"));
    assert_eq!((status.labels.queued, status.labels.leased, status.labels.failed), (0, 0, 0));
    let protocol = store.protocols().await.expect("protocols")[0].hash;
    let filter = ExportFilter { protocol, biased: true, control: true, imported: false };
    let rows = store.labelled(&filter, None, u32::MAX).await.expect("labels");
    assert_eq!(rows.len(), kinds("accepted") + kinds("control"));
}

/// A campaign in a directory of its own with other keys, by what they replace.
pub fn written(small: &Small, changes: &[(&str, &str)]) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let path = small.write(directory.path());
    let mut text = fs::read_to_string(&path).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "no {from}");
        text = text.replacen(from, to, 1);
    }
    fs::write(path, text).unwrap();
    directory
}

//! A campaign for tests of labellers: in a directory, or in a schema of the server that `CALMWALK_POSTGRES` names.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};

use atoms::{Cell, Structure};
use serde_json::Value;
use store::{
    AtomGrades, CandidateRecord, Commit, Decision, ExportFilter, Fate, JobDetails, JobState, Location, Store,
    unix_milliseconds,
};
use tempfile::TempDir;
use wire::{Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkId};

use super::campaign::Small;
use super::processes::{PausedProcesses, wait_for_process, wait_until};
use super::{Running, calmwalk, program, succeed};

/// A directory with `campaign.toml`, and the URL of the store if it is on a server.
pub struct LabelCampaign {
    directory: TempDir,
    url: Option<String>,
}

impl LabelCampaign {
    /// Writes this configuration, with `changes` replaced in its text.
    pub fn new(small: &Small, changes: &[(&str, &str)]) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let path = small.write(directory.path());
        let mut text = fs::read_to_string(&path).unwrap();
        for (from, to) in changes {
            assert!(text.contains(from), "no {from}");
            text = text.replacen(from, to, 1);
        }
        let url = std::env::var("CALMWALK_POSTGRES").ok().map(|server| new_schema(&server));
        if let Some(url) = &url {
            text = text.replacen("[run]\n", &format!("[run]\nstore = \"{url}\"\n"), 1);
        }
        fs::write(path, text).unwrap();
        Self { directory, url }
    }

    /// The same, on a server.
    pub fn on_server(small: &Small, changes: &[(&str, &str)]) -> Self {
        let place = Self::new(small, changes);
        assert!(place.url.is_some(), "CALMWALK_POSTGRES must name a server; '.ci/postgres start' makes one");
        place
    }

    pub fn path(&self) -> &Path {
        self.directory.path()
    }

    /// Argument for commands that run in the directory.
    pub fn argument(&self) -> &str {
        self.url.as_deref().unwrap_or(".")
    }

    /// Location for `Store::open`.
    pub fn location(&self) -> Location {
        self.url.as_ref().map_or_else(|| self.path().into(), |url| url.parse().unwrap())
    }

    /// Starts a command whose standard error goes to the file `said`.
    pub fn start(&self, arguments: &[&str]) -> Running {
        self.spawn(program(self.path()), arguments)
    }

    /// The same with a given command.
    pub fn spawn(&self, mut command: Command, arguments: &[&str]) -> Running {
        let said = fs::File::options().create(true).append(true).open(self.path().join("said")).unwrap();
        Running(command.args(arguments).stdout(Stdio::null()).stderr(said).spawn().expect("it starts"))
    }

    /// `calmwalk run`
    pub fn run(&self) -> Running {
        self.start(&["run", "campaign.toml", "--directory", "."])
    }

    /// `calmwalk label` with these further arguments.
    pub fn label(&self, arguments: &[&str]) -> Running {
        self.start(&[&["label", "--store", self.argument()], arguments].concat())
    }

    /// Standard error of the commands so far.
    pub fn said(&self) -> String {
        fs::read_to_string(self.path().join("said")).unwrap_or_default()
    }

    /// `calmwalk status`; null before the campaign exists.
    pub fn status(&self) -> Value {
        let output = calmwalk(self.path(), ["status", self.argument(), "--json"]);
        serde_json::from_slice(&output.stdout).unwrap_or_default()
    }

    /// Number of jobs in a state.
    pub fn jobs(&self, state: &str) -> u64 {
        self.status()["labels"][state].as_u64().unwrap_or_default()
    }

    /// The bytes of an export.
    pub fn export(&self) -> Vec<u8> {
        succeed(self.path(), ["export", self.argument(), "--control", "--output", "exported.extxyz"]);
        fs::read(self.path().join("exported.extxyz")).unwrap()
    }

    /// A job with its attempts.
    pub fn job(&self, candidate: &str) -> JobDetails {
        on_store(self.location(), async |store| store.queue_show(candidate).await.unwrap())
    }

    /// Waits until a job is leased. Reads the store directly, since starting the program may take longer than the
    /// label.
    pub fn wait_for_lease(&self) {
        let leased =
            async |store: &Store| store.queue_list(Some(JobState::Leased), 1, 0).await.unwrap().len();
        wait_until("a structure is leased", || on_store(self.location(), leased) == 1);
    }

    /// Stops processes while they hold no database lock.
    pub fn pause(&self, pids: &[u32]) -> PausedProcesses {
        let store = self.url.as_deref().unwrap_or_else(|| self.path().to_str().unwrap());
        PausedProcesses::outside_transactions(pids, store)
    }

    /// Stops the only labeller while it makes a label.
    pub fn pause_labeller(&self) -> PausedProcesses {
        let labeller = wait_for_process(self.path(), "labeller");
        self.wait_for_lease();
        self.pause(&[labeller])
    }

    /// Queues a structure whose label takes some seconds. Returns the name of its candidate.
    pub fn queue_large(&self) -> String {
        queue(self.location(), 1, large(), Vec::new())
    }
}

/// Queues a structure as if a walk had collected it at this step, with features [n × D] or none. Returns the name of its
/// candidate.
pub fn queue(location: Location, step: u64, structure: Structure, features: Vec<f64>) -> String {
    let candidate = collected(step, structure, features);
    let name = candidate.id.to_string();
    let grades = AtomGrades { gamma: candidate.gamma.clone(), gamma_nbr: candidate.gamma_nbr.clone() };
    let record = CandidateRecord {
        block: CandidateBlock::encode(&candidate),
        fate: Fate::Accepted,
        seed_structure: 0,
        selector: grades.clone(),
        original: grades,
        keep_features: !candidate.features.is_empty(),
        priority: 10,
    };
    let decision = Decision {
        round: 0,
        kind: "accepted",
        walk: Some(candidate.id.walk),
        candidate: Some(candidate.id),
        mixture_version: 0,
        detail: Value::Null,
    };
    let commit = Commit { decisions: vec![decision], candidates: vec![record], ..Commit::default() };
    on_store(location, async |store| store.commit(&commit).await.unwrap());
    name
}

/// Runs `act` with the store.
pub fn on_store<T>(location: Location, act: impl AsyncFnOnce(&Store) -> T) -> T {
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = Store::open(location).await.unwrap();
        let done = act(&store).await;
        store.close().await;
        done
    })
}

/// End of a label script that writes fixed numbers.
pub const WRITE_FIXED_LABEL: &str = r#"
awk '
    NR == 1 { print; next }
    NR == 2 { sub(/Properties=[^ ]*/, "Properties=species:S:1:pos:R:3:forces:R:3"); print $0 " energy=-1.5"; next }
    { print $0, 0.25, 0, 0 }
' structure.extxyz > unfinished
mv unfinished label.extxyz
"#;

/// Checks that each structure has exactly one result, the label of [`WRITE_FIXED_LABEL`]. Returns the number of structures.
pub async fn check_single_labels(store: &Store) -> usize {
    let protocol = store.protocols().await.unwrap()[0].hash;
    let filter = ExportFilter { protocol, biased: true, control: true, imported: false };
    let mut structures = BTreeSet::new();
    for row in store.labelled(&filter, None, u32::MAX).await.unwrap() {
        let structure = ContentHash::from_structure(&row.structure);
        assert_eq!(store.labels_of(structure).await.unwrap().len(), 1);
        assert_eq!((row.label.energy, row.label.forces[0]), (-1.5, [0.25, 0.0, 0.0]));
        // Two walks may have found the same structure.
        structures.insert(structure.0);
    }
    assert_eq!(store.check(|_, _| ()).await.unwrap(), []);
    structures.len()
}

/// An fcc aluminium structure whose label takes a while.
fn large() -> Structure {
    const CELLS: usize = 38;
    let (a, basis) = (4.05, [[0.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]]);
    let corners = (0..CELLS.pow(3)).map(|k| [k / CELLS / CELLS, k / CELLS % CELLS, k % CELLS]);
    let atoms = corners.flat_map(|corner| {
        basis.map(|shift| std::array::from_fn(|axis| a * (corner[axis] as f64 + shift[axis])))
    });
    let positions: Vec<[f64; 3]> = atoms.collect();
    let (n, edge) = (positions.len(), a * CELLS as f64);
    Structure {
        species: vec!["Al".parse().unwrap(); n],
        positions,
        cell: Cell::orthorhombic(edge, edge, edge),
        periodic: [true; 3],
    }
}

fn collected(step: u64, structure: Structure, features: Vec<f64>) -> Candidate {
    let n = structure.len();
    let id = CandidateId {
        campaign: wire::CampaignId([1; 16]),
        walk: WalkId(0),
        segment: 0,
        step,
        content: ContentHash::from_structure(&structure),
    };
    Candidate {
        id,
        origin: Origin::Biased,
        mixture_version: 0,
        temperature: 300.0,
        relative_volume: 1.0,
        energy: 0.0,
        virial: [[0.0; 3]; 3],
        forces: vec![[0.0; 3]; n],
        gamma: vec![2.0; n],
        gamma_nbr: vec![2.0; n],
        features,
        structure,
    }
}

/// URL of a new schema. It is discarded with the test server.
fn new_schema(server: &str) -> String {
    static NUMBER: AtomicU64 = AtomicU64::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    format!("{server}?schema=whole_{}_{}_{number}", std::process::id(), unix_milliseconds())
}

//! Versions of the potential: what each was trained on, its errors, and whether it is in force.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use store::{
    CampaignStatus, ProcessRecord, Store, StoreError, VersionRecord, VersionState, WalkStatus, WalkVersions,
};
use wire::ContentHash;

/// Name of the value of the selector with the version that the decision log last switched to.
const TAKEN_UP: &str = "version";

/// Number of the version that the decision log last switched to, from the values of the selector.
pub fn taken_up(values: &[(String, String)]) -> u32 {
    let found = values.iter().find(|(name, _)| name == TAKEN_UP);
    found.and_then(|(_, number)| number.parse().ok()).unwrap_or(0)
}

/// Where a version stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum VersionStanding {
    /// It drives the walks.
    InForce,
    /// A later version is in force.
    Earlier,
    /// It is registered, and the walks do not have it yet.
    NotTakenUp,
    /// It was refused.
    Refused,
}

/// A version of the potential, or a refused attempt at one.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct VersionSummary {
    /// Its number; 0 is that of the configuration.
    pub number: u32,
    /// Where it stands.
    pub state: VersionStanding,
    /// The version from which it was trained; `None` for version 0.
    pub parent: Option<u32>,
    /// How it was made: `configuration`, `native`, `command`, `rollback`.
    pub method: String,
    /// Why it was refused; empty if it was not.
    pub reason: String,
    /// Number of labels in its training set.
    pub labels: u64,
    /// Number of structures that the campaign had accepted when its training set was fixed.
    pub structures: u64,
    /// Structures accepted from its biased walks.
    pub accepted: u64,
    /// Structures with a label that its walks found first, under the protocol in force.
    pub labelled: u64,
    /// Errors by data set.
    pub errors: Vec<VersionSetErrors>,
    /// Wall time of the refit, s.
    pub seconds: f64,
    /// Processor time of the refit, core hours.
    pub core_hours: f64,
    /// When it was registered or refused, ms since 1970; `None` for version 0.
    pub time: Option<i64>,
}

/// Errors of a version, its parent and version 0 on the structures of one data set.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(default)]
pub struct VersionSetErrors {
    /// Name of the data set.
    pub name: String,
    /// `test`, `held_out`, `replay` (the replay sample) or `since` (labels that came after the training set was fixed).
    pub kind: String,
    /// Number of structures.
    pub structures: u64,
    /// Errors of version 0; `None` for version 0 itself.
    pub first: Option<ErrorFigures>,
    /// Errors of the parent; `None` for version 0.
    pub parent: Option<ErrorFigures>,
    /// Errors of the version; `None` if they are unknown.
    pub version: Option<ErrorFigures>,
    /// Errors of the models that were trained for comparison with the version.
    pub compared: Vec<ComparedErrors>,
}

/// Errors of a model that was trained with other structures in place of those of the campaign.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
pub struct ComparedErrors {
    /// Where these structures come from: `control`, or a name of `refit.comparisons`.
    pub name: String,
    /// Their number.
    pub structures: u64,
    /// Mean absolute error of energies, eV/atom.
    pub energy_mae: Option<f64>,
    /// Mean absolute error of force components, eV/Å.
    pub force_mae: Option<f64>,
}

/// Mean absolute and root mean square errors; `None` if unknown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(default)]
pub struct ErrorFigures {
    /// Of energies, eV/atom.
    pub energy_mae: Option<f64>,
    /// The same.
    pub energy_rmse: Option<f64>,
    /// Of force components, eV/Å.
    pub force_mae: Option<f64>,
    /// The same.
    pub force_rmse: Option<f64>,
    /// Of stress components, eV/Å³.
    pub stress_mae: Option<f64>,
    /// The same.
    pub stress_rmse: Option<f64>,
}

/// A refit under way.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RefitUnderWay {
    /// Number that its version will have.
    pub number: u32,
    /// Host of its process.
    pub host: String,
    /// When the process started, ms since 1970.
    pub started: i64,
    /// State of the process.
    pub state: String,
    /// What it says of its progress.
    pub remark: String,
}

/// All versions of a campaign.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CampaignVersions {
    /// All by number, version 0 first; empty if the campaign has never trained one.
    pub all: Vec<VersionSummary>,
    /// The refit under way.
    pub refit: Option<RefitUnderWay>,
}

impl CampaignVersions {
    /// Reads the versions of a campaign with this status and these values of its selector.
    pub async fn read(
        store: &Store,
        status: &CampaignStatus,
        values: &[(String, String)],
    ) -> Result<Self, StoreError> {
        let records = store.versions().await?;
        let refit = RefitUnderWay::find(status, &records);
        if records.is_empty() {
            return Ok(Self { all: Vec::new(), refit });
        }
        let labels = match store.protocol_in_force().await? {
            Some(protocol) => store.labels_by_walk(protocol.hash).await?,
            None => Vec::new(),
        };
        Ok(Self { all: summaries(&records, taken_up(values), &status.walks, &labels), refit })
    }

    /// The version that drives the walks; `None` if the campaign has never trained one.
    pub fn in_force(&self) -> Option<&VersionSummary> {
        self.all.iter().find(|version| version.state == VersionStanding::InForce)
    }

    /// The version with this number.
    pub fn numbered(&self, number: u32) -> Option<&VersionSummary> {
        self.all.iter().find(|version| version.number == number)
    }

    /// Names of all data sets, in the order of their first appearance.
    pub fn sets(&self) -> Vec<&str> {
        let mut names = Vec::new();
        for set in self.all.iter().flat_map(|version| &version.errors) {
            if !names.contains(&set.name.as_str()) {
                names.push(set.name.as_str());
            }
        }
        names
    }

    /// Core hours of this refit and all before it, refused attempts included.
    pub fn core_hours_until(&self, number: u32) -> f64 {
        self.all.iter().filter(|version| version.number <= number).map(|version| version.core_hours).sum()
    }
}

impl VersionSetErrors {
    /// Force MAE of the version, eV/Å.
    pub fn force_mae(&self) -> Option<f64> {
        self.version?.force_mae
    }

    /// Change of the force MAE relative to version 0 on the same structures, as a share (−0.5: half of it).
    pub fn change_since_first(&self) -> Option<f64> {
        relative_change(self.first?.force_mae?, self.force_mae()?)
    }

    /// The same relative to the parent.
    pub fn change_from_parent(&self) -> Option<f64> {
        relative_change(self.parent?.force_mae?, self.force_mae()?)
    }
}

impl VersionSummary {
    /// Its errors on a data set.
    pub fn errors_on(&self, set: &str) -> Option<&VersionSetErrors> {
        self.errors.iter().find(|found| found.name == set)
    }

    /// Whether it can drive walks.
    pub fn is_registered(&self) -> bool {
        self.state != VersionStanding::Refused
    }
}

impl VersionStanding {
    /// All, as they are counted.
    pub const ALL: [Self; 4] = [Self::InForce, Self::Earlier, Self::NotTakenUp, Self::Refused];

    /// Name in JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::InForce => "in_force",
            Self::Earlier => "earlier",
            Self::NotTakenUp => "not_taken_up",
            Self::Refused => "refused",
        }
    }
}

impl RefitUnderWay {
    fn find(status: &CampaignStatus, records: &[VersionRecord]) -> Option<Self> {
        let is_alive = |process: &&ProcessRecord| {
            process.kind == ProcessRecord::REFITTER
                && !matches!(process.state.as_str(), "dead" | "failed" | "exited")
        };
        let process = status.processes.iter().find(is_alive)?;
        let last = records.last().map_or(0, |record| record.number);
        Some(Self {
            number: last.saturating_add(1),
            host: process.host.clone(),
            started: process.started,
            state: process.state.clone(),
            remark: process.remark.clone(),
        })
    }
}

/// The newest version whose walks found structures with labels under this protocol; 0 without any.
pub async fn newest_with_labels(
    store: &Store,
    protocol: ContentHash,
    versions: &WalkVersions,
) -> Result<u32, StoreError> {
    if versions.is_single() {
        return Ok(0);
    }
    let labels = store.labels_by_walk(protocol).await?;
    Ok(labels.iter().map(|(walk, _)| versions.version_of(*walk)).max().unwrap_or_else(|| versions.newest()))
}

fn summaries(
    records: &[VersionRecord],
    taken_up: u32,
    walks: &[WalkStatus],
    labels: &[(u32, u64)],
) -> Vec<VersionSummary> {
    let version_of = |walk: &WalkStatus| walk.conditions.as_ref().map_or(0, |conditions| conditions.version);
    let (mut accepted, mut labelled) = (BTreeMap::<u32, u64>::new(), BTreeMap::<u32, u64>::new());
    for walk in walks.iter().filter(|walk| walk.origin == "biased") {
        *accepted.entry(version_of(walk)).or_default() += u64::from(walk.accepted);
    }
    let versions = WalkVersions::from_walks(walks.iter().map(|walk| (walk.walk, version_of(walk))));
    for (walk, number) in labels {
        *labelled.entry(versions.version_of(*walk)).or_default() += number;
    }
    let mut all = vec![first(records)];
    all.extend(records.iter().map(VersionSummary::from_record));
    for version in &mut all {
        let number = version.number;
        version.accepted = accepted.get(&number).copied().unwrap_or(0);
        version.labelled = labelled.get(&number).copied().unwrap_or(0);
        version.state = match number {
            _ if !version.is_registered() => VersionStanding::Refused,
            number if number == taken_up => VersionStanding::InForce,
            number if number > taken_up => VersionStanding::NotTakenUp,
            _ => VersionStanding::Earlier,
        };
    }
    all
}

/// Version 0. Its errors are those of the parent of the first attempt from it.
fn first(records: &[VersionRecord]) -> VersionSummary {
    let from_it =
        records.iter().find(|record| record.parent == 0 && record.method != VersionRecord::ROLLBACK);
    let errors = from_it.map(|record| errors_of(&record.figures)).unwrap_or_default();
    let errors = errors.into_iter().filter(|set| set.parent.is_some());
    VersionSummary {
        number: 0,
        state: VersionStanding::Earlier,
        parent: None,
        method: "configuration".into(),
        reason: String::new(),
        labels: 0,
        structures: 0,
        accepted: 0,
        labelled: 0,
        errors: errors
            .map(|set| VersionSetErrors {
                version: set.parent,
                parent: None,
                first: None,
                compared: Vec::new(),
                ..set
            })
            .collect(),
        seconds: 0.0,
        core_hours: 0.0,
        time: None,
    }
}

impl VersionSummary {
    fn from_record(record: &VersionRecord) -> Self {
        Self {
            number: record.number,
            state: match record.state {
                VersionState::Registered => VersionStanding::Earlier,
                VersionState::Refused => VersionStanding::Refused,
            },
            parent: Some(record.parent),
            method: record.method.clone(),
            reason: record.reason.clone(),
            labels: record.labels,
            structures: record.structures,
            accepted: 0,
            labelled: 0,
            errors: errors_of(&record.figures),
            seconds: record.seconds,
            core_hours: record.core_hours,
            time: Some(record.time),
        }
    }
}

/// The errors by data set in the figures of a version; none if another program wrote something else.
fn errors_of(figures: &Value) -> Vec<VersionSetErrors> {
    let sets = figures["sets"].as_array().into_iter().flatten();
    let mut sets: Vec<_> = sets.filter_map(|set| VersionSetErrors::deserialize(set).ok()).collect();
    for comparison in figures["comparisons"].as_array().into_iter().flatten() {
        let found = |set: &str| {
            let all = comparison["sets"].as_array().into_iter().flatten();
            all.into_iter().find(|found| found["name"] == set).map(|found| &found["errors"])
        };
        for set in &mut sets {
            let Some(errors) = found(&set.name) else { continue };
            set.compared.push(ComparedErrors {
                name: comparison["name"].as_str().unwrap_or_default().to_owned(),
                structures: comparison["structures"].as_u64().unwrap_or(0),
                energy_mae: errors["energy_mae"].as_f64(),
                force_mae: errors["force_mae"].as_f64(),
            });
        }
    }
    sets
}

/// (new − old) / old, of positive numbers.
fn relative_change(old: f64, new: f64) -> Option<f64> {
    let change = (new - old) / old;
    (old > 0.0 && change.is_finite()).then_some(change)
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use wire::WalkConditions;

    use super::*;

    fn record(
        number: u32,
        parent: u32,
        state: VersionState,
        test: [f64; 2],
        held_out: [f64; 2],
    ) -> VersionRecord {
        let set = |name: &str, kind: &str, structures: u64, [parent, version]: [f64; 2]| {
            json!({ "name": name, "kind": kind, "structures": structures, "first": { "force_mae": 0.2 }, "parent": { "force_mae": parent },
                    "version": { "force_mae": version, "stress_mae": null } })
        };
        let refused = state == VersionState::Refused;
        VersionRecord {
            number,
            parent,
            state,
            reason: if refused { "NaN".into() } else { String::new() },
            method: "native".into(),
            structures: 10 * u64::from(number),
            last_decision: 1,
            labels: 9 * u64::from(number),
            model_hash: String::new(),
            mixture_hash: String::new(),
            figures: json!({ "sets": [set("liquid", "test", 5, test),
                set("held_out", "held_out", u64::from(number), held_out), "of another program"],
                "comparisons": [{ "name": "control", "structures": 9,
                    "sets": [{ "name": "liquid", "errors": { "force_mae": 0.19 } }] }] }),
            seconds: 60.0,
            core_hours: 0.5,
            time: 1000 * i64::from(number),
        }
    }

    fn walk(number: u32, version: u32, origin: &str, accepted: u32) -> WalkStatus {
        WalkStatus {
            walk: number,
            origin: origin.into(),
            accepted,
            conditions: Some(WalkConditions { version, ..WalkConditions::default() }),
            ..WalkStatus::default()
        }
    }

    #[test]
    fn versions_have_their_errors_and_what_their_walks_found() {
        let records = [
            record(1, 0, VersionState::Registered, [0.2, 0.1], [0.4, 0.3]),
            record(2, 1, VersionState::Refused, [0.1, 0.5], [0.3, 0.9]),
            record(3, 1, VersionState::Registered, [0.1, 0.25], [0.3, 0.2]),
        ];
        let walks = [walk(0, 0, "biased", 7), walk(1, 0, "control", 3), walk(2, 1, "biased", 4)];
        let all = summaries(&records, 1, &walks, &[(0, 5), (1, 2), (2, 1)]);
        let versions = CampaignVersions { all, refit: None };
        let states: Vec<_> = versions.all.iter().map(|version| version.state.name()).collect();
        assert_eq!(states, ["earlier", "in_force", "refused", "not_taken_up"]);
        let found: Vec<_> = versions.all.iter().map(|version| (version.accepted, version.labelled)).collect();
        assert_eq!(found, [(7, 7), (4, 1), (0, 0), (0, 0)]);
        assert_eq!((versions.in_force().unwrap().number, versions.sets()), (1, vec!["liquid", "held_out"]));
        let first = versions.numbered(0).unwrap();
        assert_eq!((first.parent, first.errors_on("liquid").unwrap().force_mae()), (None, Some(0.2)));
        let third = versions.numbered(3).unwrap();
        let liquid = third.errors_on("liquid").unwrap();
        assert!((liquid.change_since_first().unwrap() - 0.25).abs() < 1e-12);
        assert!((liquid.change_from_parent().unwrap() - 1.5).abs() < 1e-12);
        let [control] = &liquid.compared[..] else { panic!("one comparison: {liquid:?}") };
        let found = (control.name.as_str(), control.structures, control.force_mae, control.energy_mae);
        assert_eq!(found, ("control", 9, Some(0.19), None));
        assert!(third.errors_on("held_out").unwrap().compared.is_empty());
        let held_out = third.errors_on("held_out").unwrap();
        assert!(held_out.change_since_first().unwrap().abs() < 1e-12);
        assert_eq!(first.errors_on("liquid").unwrap().change_since_first(), None);
        assert!((held_out.change_from_parent().unwrap() + 1.0 / 3.0).abs() < 1e-12);
        assert_eq!((versions.core_hours_until(0), versions.core_hours_until(3)), (0.0, 1.5));
    }

    #[test]
    fn a_refit_under_way_is_the_process_that_lives() {
        let process = |kind: &str, state: &str| ProcessRecord {
            kind: kind.into(),
            state: state.into(),
            remark: "epoch 3".into(),
            ..ProcessRecord::default()
        };
        let find = |processes: &[ProcessRecord]| {
            let status = CampaignStatus { processes: processes.to_vec(), ..CampaignStatus::default() };
            RefitUnderWay::find(&status, &[record(4, 0, VersionState::Refused, [0.1; 2], [0.1; 2])])
        };
        let [walker, dead] = [process("walker", "running"), process("refitter", "dead")];
        assert_eq!(find(&[walker.clone(), dead.clone()]), None);
        let found = find(&[walker, dead, process("refitter", "running")]).unwrap();
        assert_eq!((found.number, found.remark.as_str()), (5, "epoch 3"));
    }
}

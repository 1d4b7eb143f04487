//! The label jobs of a structure, their attempts, and the potential's errors against the labels.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use atoms::Vec3;
use atoms::cell::{norm, sub};
use serde::Serialize;
use store::{
    Exclusion, JobDetails, LabelDetails, LabelRecord, LabelStatus, LoggedOperation, Store, StoreError,
    StructureLabel, Supersession,
};
use wire::{CandidateView, ContentHash};

use crate::energy_errors::{OffsetSummary, ProtocolEnergyOffsets};

/// A label job and its history.
#[derive(Clone, Debug, Serialize)]
pub struct LabelJob {
    /// The job with its attempts.
    #[serde(flatten)]
    pub details: JobDetails,
    /// Known core-seconds of all its attempts. `None` if none are known.
    pub core_seconds: Option<f64>,
    /// Manual actions on the job and its labels: `drop`, `retry`, `prioritise`, `exclude`, `include`.
    pub manual_actions: Vec<ManualAction>,
}

/// A manual action on a job.
#[derive(Clone, Debug, Serialize)]
pub struct ManualAction {
    /// ms since 1970.
    pub time: i64,
    /// `drop`, `retry`, `prioritise`, `exclude` or `include`.
    pub action: String,
    /// The new priority.
    pub priority: Option<i64>,
    /// Why its label was excluded.
    pub reason: Option<String>,
}

/// A label of any status: in use, a check, superseded or excluded.
#[derive(Clone, Debug, Serialize)]
pub struct CandidateLabel {
    /// Name of the protocol.
    pub protocol: String,
    /// Its hash.
    pub protocol_hash: String,
    /// Its current status.
    pub status: LabelStatus,
    /// Its source, as text.
    pub source: String,
    /// When it was stored, ms since 1970.
    pub received: i64,
    /// When and why another label replaced it.
    pub superseded: Option<Supersession>,
    /// When and why it was excluded from the data set.
    pub excluded: Option<Exclusion>,
    /// Energy, eV.
    pub energy: f64,
    /// Energy per atom, eV.
    pub energy_per_atom: f64,
    /// Largest force, eV/Å.
    pub max_force: f64,
    /// Pressure −tr(stress)/3, eV/Å³. `None` without a stress.
    pub pressure: Option<f64>,
    /// Further results of the calculation.
    pub details: LabelDetails,
    /// The potential's errors. `None` for imported structures, whose model forces are not stored.
    pub model: Option<ForceError>,
}

/// Errors of the potential against a label.
#[derive(Clone, Debug, Serialize)]
pub struct ForceError {
    /// E_model − E_label per atom, eV. Mostly the difference of the energy references.
    pub energy_per_atom: f64,
    /// The same without the element offsets, eV. `None` if too few labels support the composition.
    pub energy_error_per_atom: Option<f64>,
    /// The offsets, fitted to labels of the same protocol.
    pub energy_offsets: OffsetSummary,
    /// Mean of |F_model − F_label| over the atoms, eV/Å.
    pub mean: f64,
    /// The largest of them, eV/Å.
    pub largest: f64,
    /// The atom with the largest error.
    pub atom: usize,
    /// |F_model − F_label| of each atom, eV/Å.
    pub atoms: Vec<f64>,
}

pub(super) async fn jobs(store: &Store, content: ContentHash) -> Result<Vec<LabelJob>, StoreError> {
    let mut jobs = Vec::new();
    for details in store.jobs_of(content).await? {
        let known = details.attempts_made.iter().filter_map(|attempt| attempt.core_seconds);
        let core_seconds = known.reduce(|sum, seconds| sum + seconds);
        let manual_actions = store.manual_operations(details.job.job).await?;
        jobs.push(LabelJob {
            core_seconds,
            manual_actions: manual_actions.into_iter().map(ManualAction::from_operation).collect(),
            details,
        });
    }
    Ok(jobs)
}

/// `model` is the candidate with the potential's energy and forces.
pub(super) async fn labels(
    store: &Store,
    content: ContentHash,
    model: Option<&CandidateView<'_>>,
) -> Result<Vec<CandidateLabel>, StoreError> {
    let (mut references, mut labels) = (BTreeMap::new(), Vec::new());
    let version = match model {
        Some(view) => store.walk_versions().await?.version_of(view.id().walk.0),
        None => 0,
    };
    for label in store.labels_of(content).await? {
        let Some(view) = model else {
            labels.push(CandidateLabel::new(label, None));
            continue;
        };
        let protocol = label.protocol.hash;
        let references = match references.entry(protocol.0) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => new.insert(ProtocolEnergyOffsets::fit(store, protocol, version).await?),
        };
        let made = &label.record.label;
        let model = ForceError::new(view, made.energy, &made.forces, references);
        labels.push(CandidateLabel::new(label, Some(model)));
    }
    Ok(labels)
}

impl ManualAction {
    fn from_operation(operation: LoggedOperation) -> Self {
        let priority = operation.detail["priority"].as_i64();
        let reason = operation.detail["reason"].as_str().map(str::to_owned);
        Self { time: operation.time, action: operation.kind, priority, reason }
    }
}

impl CandidateLabel {
    fn new(label: StructureLabel, model: Option<ForceError>) -> Self {
        let StructureLabel { protocol, record } = label;
        let LabelRecord { status, label, source, received, superseded, excluded } = record;
        let atoms = label.forces.len().max(1) as f64;
        Self {
            protocol: protocol.name,
            protocol_hash: protocol.hash.to_string(),
            status,
            source: source.to_string(),
            received,
            superseded,
            excluded,
            energy: label.energy,
            energy_per_atom: label.energy / atoms,
            max_force: label.max_force(),
            pressure: label.stress.map(|stress| -(stress[0][0] + stress[1][1] + stress[2][2]) / 3.0),
            model,
            details: label.details,
        }
    }
}

impl ForceError {
    fn new(
        view: &CandidateView<'_>,
        energy: f64,
        forces: &[Vec3],
        references: &ProtocolEnergyOffsets,
    ) -> Self {
        let pairs = view.forces.iter().zip(forces);
        let atoms: Vec<f64> = pairs.map(|(model, label)| norm(sub(*model, *label))).collect();
        let (atom, largest) =
            atoms.iter().copied().enumerate().fold((0, 0.0), |worst, error| match error.1 > worst.1 {
                true => error,
                false => worst,
            });
        let n = atoms.len().max(1) as f64;
        let energy_per_atom = (view.energy() - energy) / n;
        Self {
            energy_per_atom,
            energy_error_per_atom: references.error_per_atom(&view.structure(), view.energy(), energy),
            energy_offsets: references.summary(),
            mean: atoms.iter().sum::<f64>() / n,
            largest,
            atom,
            atoms,
        }
    }
}

//! The label jobs of a structure, what became of each attempt, and how far the potential is from the labels.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use atoms::Vec3;
use atoms::cell::{norm, sub};
use serde::Serialize;
use store::{
    Exclusion, JobDetails, LabelDetails, LabelRecord, LabelSource, LabelStatus, Operation, Store, StoreError,
    StructureLabel, Supersession,
};
use wire::{CandidateView, ContentHash};

use crate::energies::{Offsets, Zeros};

/// A label job with everything that happened to it.
#[derive(Clone, Debug, Serialize)]
pub struct LabelJob {
    /// The job with its attempts.
    #[serde(flatten)]
    pub details: JobDetails,
    /// Core-seconds of all its attempts, as far as they are known; none if of none.
    pub core_seconds: Option<f64>,
    /// What people did to it and its labels: `drop`, `retry`, `prioritise`, `exclude`, `include`.
    pub by_hand: Vec<ByHand>,
}

/// What somebody did to a job.
#[derive(Clone, Debug, Serialize)]
pub struct ByHand {
    /// ms since 1970.
    pub time: i64,
    /// `drop`, `retry`, `prioritise`, `exclude` or `include`.
    pub action: String,
    /// The priority that it was given.
    pub priority: Option<i64>,
    /// Why its label was excluded.
    pub reason: Option<String>,
}

/// A label, a check, a superseded or an excluded label.
#[derive(Clone, Debug, Serialize)]
pub struct StoryLabel {
    /// Name of the protocol.
    pub protocol: String,
    /// Its hash.
    pub protocol_hash: String,
    /// What it is now.
    pub standing: LabelStatus,
    /// Where it came from, in words.
    pub source: String,
    /// When it came, ms since 1970.
    pub received: i64,
    /// When and why another came in its place.
    pub superseded: Option<Supersession>,
    /// When and why it was taken out of the data set.
    pub excluded: Option<Exclusion>,
    /// Energy, eV.
    pub energy: f64,
    /// Energy an atom, eV.
    pub energy_per_atom: f64,
    /// Largest force, eV/Å.
    pub largest_force: f64,
    /// Pressure −tr(stress)/3, eV/Å³; none without a stress.
    pub pressure: Option<f64>,
    /// What else the calculation says.
    pub details: LabelDetails,
    /// How far the potential is from it; none of imported structures, whose model forces are not kept.
    pub model: Option<ForceError>,
}

/// The potential beside a label.
#[derive(Clone, Debug, Serialize)]
pub struct ForceError {
    /// E_model − E_label an atom, eV: mostly the difference of their zeros.
    pub energy_per_atom: f64,
    /// The same without the offsets of the elements, eV; none if too few labels speak for the composition.
    pub energy_error_per_atom: Option<f64>,
    /// The offsets, from labels of the same protocol.
    pub energy_offsets: Offsets,
    /// Mean of |F_model − F_label| over the atoms, eV/Å.
    pub mean: f64,
    /// The largest, eV/Å.
    pub largest: f64,
    /// The atom that has it.
    pub atom: usize,
    /// |F_model − F_label| of each atom, eV/Å.
    pub atoms: Vec<f64>,
}

pub(super) async fn jobs(store: &Store, content: ContentHash) -> Result<Vec<LabelJob>, StoreError> {
    let mut jobs = Vec::new();
    for details in store.jobs_of(content).await? {
        let known = details.attempts_made.iter().filter_map(|attempt| attempt.core_seconds);
        let core_seconds = known.reduce(|sum, seconds| sum + seconds);
        let by_hand = store.manual_operations(details.job.job).await?;
        jobs.push(LabelJob { core_seconds, by_hand: by_hand.into_iter().map(ByHand::of).collect(), details });
    }
    Ok(jobs)
}

/// `model`: the candidate, with the potential's energy and forces.
pub(super) async fn labels(
    store: &Store,
    content: ContentHash,
    model: Option<&CandidateView<'_>>,
) -> Result<Vec<StoryLabel>, StoreError> {
    let (mut zeros, mut labels) = (BTreeMap::new(), Vec::new());
    for label in store.labels_of(content).await? {
        let Some(view) = model else {
            labels.push(StoryLabel::of(label, None));
            continue;
        };
        let protocol = label.protocol.hash;
        let zeros = match zeros.entry(protocol.0) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => new.insert(Zeros::read(store, protocol).await?),
        };
        let made = &label.record.label;
        let model = ForceError::of(view, made.energy, &made.forces, zeros);
        labels.push(StoryLabel::of(label, Some(model)));
    }
    Ok(labels)
}

impl ByHand {
    fn of(operation: Operation) -> Self {
        let priority = operation.detail["priority"].as_i64();
        let reason = operation.detail["reason"].as_str().map(str::to_owned);
        Self { time: operation.time, action: operation.kind, priority, reason }
    }
}

impl StoryLabel {
    fn of(label: StructureLabel, model: Option<ForceError>) -> Self {
        let StructureLabel { protocol, record } = label;
        let LabelRecord { status: standing, label, source, received, superseded, excluded } = record;
        let atoms = label.forces.len().max(1) as f64;
        Self {
            protocol: protocol.name,
            protocol_hash: protocol.hash.to_string(),
            standing,
            source: in_words(&source),
            received,
            superseded,
            excluded,
            energy: label.energy,
            energy_per_atom: label.energy / atoms,
            largest_force: label.max_force(),
            pressure: label.stress.map(|stress| -(stress[0][0] + stress[1][1] + stress[2][2]) / 3.0),
            model,
            details: label.details,
        }
    }
}

fn in_words(source: &LabelSource) -> String {
    match source {
        LabelSource::Attempt { job, attempt } => format!("attempt {attempt} of job {job}"),
        LabelSource::Import { file, frame } => format!("{file}, frame {frame}"),
    }
}

impl ForceError {
    fn of(view: &CandidateView<'_>, energy: f64, forces: &[Vec3], zeros: &Zeros) -> Self {
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
            energy_error_per_atom: zeros.error_per_atom(&view.structure(), view.energy(), energy),
            energy_offsets: zeros.shown(),
            mean: atoms.iter().sum::<f64>() / n,
            largest,
            atom,
            atoms,
        }
    }
}

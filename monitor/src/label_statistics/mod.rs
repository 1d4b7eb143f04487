//! Statistics of the labels of a campaign: the potential's errors, whether the grade predicted them, and which
//! structures have no label.

pub mod comparison;
pub(crate) mod frames;
mod json;
pub mod parity;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, HashSet};

use analysis::{Bins, Completion, ForceErrors};
use atoms::cell::{norm, sub};
use serde_json::Value;
use store::{
    AtomGrades, FailedCandidate, JobState, LabelledCandidate, Protocol, Store, StoreError, WalkVersions,
};
use wire::{ContentHash, Origin};

use self::comparison::{COMPARISON_BOOTSTRAP, WalkComparison};
use self::frames::ComparedFrames;
use self::parity::Parity;
use crate::energy_errors::{EnergyErrors, ProtocolEnergyOffsets};
use crate::versions::newest_with_labels;

/// Force errors above this count as large, eV/Å, as in the paper.
pub const LARGE_FORCE_ERROR: f64 = 1.0;

/// Rows read from the store at a time.
const PAGE_ROWS: u32 = 256;
/// Largest number of atoms kept for ranks and quantiles. Beyond it a systematic sample is kept.
const MAX_SAMPLES: usize = 1 << 20;
/// The same of each version of the potential, for comparisons between versions.
const MAX_SAMPLES_OF_VERSION: usize = 1 << 18;

/// Force errors by both grades of the original mixture.
#[derive(Clone, Debug)]
pub struct ErrorsByGrade {
    /// Labelled structures.
    pub structures: u64,
    /// By γ.
    pub gamma: ForceErrors,
    /// By γ_nbr.
    pub gamma_nbr: ForceErrors,
}

/// Statistics of the labels of one protocol, of structures from walks with one version of the potential: its forces and grades
/// say nothing about another version.
#[derive(Clone, Debug)]
pub struct LabelStatistics {
    /// The version. `None` in a campaign whose walks all had version 0.
    pub version: Option<u32>,
    /// The errors of each version with labels, of all its structures, by number; each by its own grades. Empty in a campaign whose
    /// walks all had version 0.
    pub by_version: BTreeMap<u32, ErrorsByGrade>,
    /// Of all structures.
    pub all: ErrorsByGrade,
    /// Of structures from biased walks.
    pub biased: ErrorsByGrade,
    /// Of frames from control walks.
    pub control: ErrorsByGrade,
    /// Energy errors of all structures.
    pub energies: EnergyErrors,
    /// Energies, forces and stresses of the potential beside those of the labels.
    pub parity: Parity,
    /// Labelled structures that both a biased walk and a control walk found, for example before the bias separates
    /// them. `all` counts them once, and the comparison excludes them.
    pub shared: u64,
    /// Labelled and failed structures by their largest γ, with the names of the failed ones.
    pub by_gamma: Completion<String>,
    /// The same by V/V₀.
    pub by_expansion: Completion<String>,
    /// Structures, a sample of atoms, and failures, for [`Self::comparison`].
    compared: ComparedFrames,
}

/// Reads the labels of one protocol page by page. Without `version`, the statistics are those of the newest version with labels.
pub async fn read(
    store: &Store,
    protocol: ContentHash,
    version: Option<u32>,
) -> Result<LabelStatistics, StoreError> {
    // Walks are in the store before their candidates: the versions of all up to this one are known.
    let newest = store.newest_candidate().await?;
    let versions = store.walk_versions().await?;
    let version = match version {
        Some(version) => version,
        None => newest_with_labels(store, protocol, &versions).await?,
    };
    let mut statistics = LabelStatistics {
        version: (!versions.is_single()).then_some(version),
        by_version: BTreeMap::new(),
        all: ErrorsByGrade::new(MAX_SAMPLES),
        biased: ErrorsByGrade::new(MAX_SAMPLES),
        control: ErrorsByGrade::new(MAX_SAMPLES),
        energies: EnergyErrors::new(ProtocolEnergyOffsets::fit(store, protocol, version).await?),
        parity: Parity::new(),
        shared: 0,
        by_gamma: Completion::new(Bins::for_grades()),
        by_expansion: Completion::new(Bins::for_volume_ratio()),
        compared: ComparedFrames::new(store.matched_walks().await?),
    };
    statistics.compared.unfinished = unfinished(store, protocol).await?;
    let shared = store.structures_of_both_origins().await?;
    let mut after = 0;
    loop {
        let page = store.labelled_after(protocol, after, PAGE_ROWS).await?;
        let Some(last) = page.last() else { break };
        after = last.decision;
        let known = page.iter().filter(|row| row.decision <= newest);
        known.for_each(|row| statistics.labelled(row, (&versions, version), &shared));
    }
    let mut after = 0;
    loop {
        let page = store.failed_after(protocol, after, PAGE_ROWS).await?;
        let Some(last) = page.last() else { break };
        after = last.decision;
        let own = page.iter().filter(|candidate| {
            candidate.decision <= newest && versions.version_of(candidate.walk) == version
        });
        own.for_each(|candidate| statistics.failed(candidate, &shared));
    }
    Ok(statistics)
}

/// Number of label jobs of a protocol that wait or are in work.
async fn unfinished(store: &Store, protocol: ContentHash) -> Result<u64, StoreError> {
    let protocols = store.protocols().await?;
    let is_of = |name: &str| protocols.iter().any(|found| found.hash == protocol && found.name == name);
    let jobs = store.jobs_by_protocol().await?.into_iter();
    let waiting =
        jobs.filter(|(name, state, _)| is_of(name) && matches!(state, JobState::Queued | JobState::Leased));
    Ok(waiting.map(|(.., number)| number).sum())
}

impl LabelStatistics {
    /// Biased walks compared with their controls. The confidence intervals may take seconds in a large campaign.
    pub fn comparison(&self) -> WalkComparison {
        WalkComparison::new(&self.compared, COMPARISON_BOOTSTRAP)
    }

    /// The JSON of `calmwalk force-errors`, for labels of this protocol, without sentences and without [`Self::comparison`].
    pub fn to_json(&self, protocol: &Protocol) -> Value {
        json::to_json(protocol, self)
    }

    fn for_origin(&mut self, origin: Origin, mut change: impl FnMut(&mut ErrorsByGrade)) {
        let of_origin = if origin == Origin::Biased { &mut self.biased } else { &mut self.control };
        [&mut self.all, of_origin].into_iter().for_each(&mut change);
    }

    /// Adds a labelled structure if its walk had `version`. `shared`: structures that walks of both origins found.
    fn labelled(
        &mut self,
        row: &LabelledCandidate,
        (versions, version): (&WalkVersions, u32),
        shared: &HashSet<ContentHash>,
    ) {
        let LabelledCandidate { block, original, label, .. } = row;
        let view = block.view();
        let origin = view.origin();
        let (of, is_shared) = (versions.version_of(view.id().walk.0), shared.contains(&view.id().content));
        let error = self.energies.error_per_atom(&row.structure, view.energy(), label.energy);
        if of == version {
            self.compared.add(row, is_shared, error);
        }
        if is_shared && origin == Origin::Control {
            // Counted with the biased walk.
            return;
        }
        let errors = view.forces.iter().zip(&label.forces);
        let errors: Vec<_> = errors.map(|(model, label)| norm(sub(*model, *label))).collect();
        if !versions.is_single() {
            self.of_version(of).labelled(original, &errors);
        }
        if of != version {
            return;
        }
        match is_shared {
            false => self.for_origin(origin, |grades| grades.labelled(original, &errors)),
            true => {
                self.shared += 1;
                self.all.labelled(original, &errors);
            }
        }
        self.energies.add(error);
        self.parity.add(row, error);
        // A job with a label may have failed to make another one.
        if matches!(row.job, Some(JobState::Labelled | JobState::Queued | JobState::Leased)) {
            self.by_gamma.add_labelled(row.gamma);
            self.by_expansion.add_labelled(row.relative_volume);
        }
    }

    fn of_version(&mut self, version: u32) -> &mut ErrorsByGrade {
        self.by_version.entry(version).or_insert_with(|| ErrorsByGrade::new(MAX_SAMPLES_OF_VERSION))
    }

    /// Adds a candidate whose label failed. `shared`: structures that walks of both origins found. Each has one job, and counts
    /// with the biased walk.
    fn failed(&mut self, candidate: &FailedCandidate, shared: &HashSet<ContentHash>) {
        let is_shared = shared.contains(&candidate.content);
        self.compared.add_failed(candidate, is_shared);
        if is_shared && candidate.origin == Origin::Control {
            return;
        }
        self.by_gamma.add_failed(candidate.gamma, candidate.candidate.clone());
        self.by_expansion.add_failed(candidate.relative_volume, candidate.candidate.clone());
        match is_shared {
            true => self.all.unlabelled(&candidate.original),
            false => self.for_origin(candidate.origin, |of| of.unlabelled(&candidate.original)),
        }
    }
}

impl ErrorsByGrade {
    fn new(samples: usize) -> Self {
        let errors = ForceErrors::new(Bins::for_grades(), LARGE_FORCE_ERROR, samples);
        Self { structures: 0, gamma: errors.clone(), gamma_nbr: errors }
    }

    fn labelled(&mut self, original: &AtomGrades, errors: &[f64]) {
        self.structures += 1;
        for (by, grades) in [(&mut self.gamma, &original.gamma), (&mut self.gamma_nbr, &original.gamma_nbr)] {
            grades.iter().zip(errors).for_each(|(grade, error)| by.add(*grade, *error));
        }
    }

    fn unlabelled(&mut self, original: &AtomGrades) {
        original.gamma.iter().for_each(|grade| self.gamma.add_unlabelled(*grade));
        original.gamma_nbr.iter().for_each(|grade| self.gamma_nbr.add_unlabelled(*grade));
    }
}

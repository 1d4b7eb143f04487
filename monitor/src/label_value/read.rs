//! Reads what values are computed from.

use std::collections::hash_map::Entry;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use atoms::Structure;
use calm::grade::maximum;
use store::{PendingJobs, QueuedStructure, Store, StoreError, WalkVersions};
use wire::{CompletionPredictors, ContentHash};

use super::{CoveringLabel, FeatureScales, MeanFeatures, QueuedLabel};
use crate::calibration::{CalibrationReader, CalibrationState};
use crate::completion_model::{CompletionExample, CompletionModel, MAX_FINISHED, with_other_versions};
use crate::label_cost::CostEstimator;

/// Largest number of queued structures that get a value: the oldest of the highest priority. The others follow in the order in
/// which they were found.
pub const MAX_QUEUED: u32 = 1_000;

/// Reads the rows of the order, and keeps what does not change of each structure and what was learned from labels.
pub struct LabelOrderReader {
    structures: KnownStructures,
    calibrations: CalibrationReader,
}

/// What does not change of the structures of the last reading.
struct KnownStructures {
    /// The version of the potential of the walks, whose mixture gives the scales.
    version: u32,
    scales: FeatureScales,
    /// By decision.
    known: HashMap<i64, KnownProperties>,
}

/// What does not change of a structure.
struct KnownProperties {
    predictors: Option<CompletionPredictors>,
    features: Option<Arc<MeanFeatures>>,
}

/// What the order is computed from.
#[derive(Clone, Debug)]
pub struct OrderInputs {
    /// Structures that wait for their labels.
    pub rows: Vec<QueuedLabel>,
    /// Structures with labels, and those whose labels are in work.
    pub covering: Vec<CoveringLabel>,
    /// The model of completion of the version of the walks; `None` before the first finished label.
    pub completion: Option<CompletionModel>,
}

/// What was learned from the finished structures of one version of the potential.
struct VersionModels<'a> {
    /// `None` before the first label.
    calibration: Option<&'a CalibrationState>,
    completion: Option<CompletionModel>,
}

impl LabelOrderReader {
    /// For a campaign whose walks have this version of the potential. Features are comparable by the scales of its mixture;
    /// structures of other versions do not cover one another.
    pub fn new(version: u32, scales: FeatureScales) -> Self {
        let structures = KnownStructures { version, scales, known: HashMap::new() };
        Self { structures, calibrations: CalibrationReader::default() }
    }

    /// Reads the store. `protocol` is that in force.
    pub async fn read(&mut self, store: &Store, protocol: ContentHash) -> Result<OrderInputs, StoreError> {
        self.calibrations.read(store, protocol).await?;
        let structures = &mut self.structures;
        let queued = store.queued_structures(protocol, MAX_QUEUED).await?;
        // After the structures: versions that were read before may lack walks that have begun meanwhile.
        let versions = store.walk_versions().await?;
        let costs = CostEstimator::from_store(store, protocol).await?;
        let (mut used, mut covering, mut models) = (HashSet::new(), Vec::new(), HashMap::new());
        let mut of_queue: BTreeSet<u32> =
            queued.iter().map(|found| versions.version_of(found.walk)).collect();
        of_queue.insert(structures.version);
        for version in of_queue {
            let completion = structures.learn(store, protocol, version, &mut used, &mut covering).await?;
            let calibration = self.calibrations.of_version(version);
            models.insert(version, VersionModels { calibration, completion });
        }
        let mut rows = Vec::with_capacity(queued.len());
        for found in &queued {
            used.insert(found.decision);
            let version = versions.version_of(found.walk);
            let gamma = maximum(&found.original.gamma);
            let known = structures.known(
                store,
                version,
                found.decision,
                &found.structure,
                gamma,
                found.relative_volume,
            );
            let known = known.await?;
            match (found.leased, &known.features) {
                (true, None) => {}
                (true, Some(features)) => {
                    let features = Arc::clone(features);
                    covering.push(CoveringLabel { decision: found.decision, version, features });
                }
                (false, _) => rows.push(row(found, &versions, known, &models[&version], &costs)),
            }
        }
        structures.known.retain(|decision, _| used.contains(decision));
        let completion = models.remove(&structures.version).and_then(|models| models.completion);
        Ok(OrderInputs { rows, covering, completion })
    }
}

impl KnownStructures {
    /// Learns from the finished structures of a version which of them complete. Adds the decisions on them to `used`, and those
    /// that cover others to `covering`.
    async fn learn(
        &mut self,
        store: &Store,
        protocol: ContentHash,
        version: u32,
        used: &mut HashSet<i64>,
        covering: &mut Vec<CoveringLabel>,
    ) -> Result<Option<CompletionModel>, StoreError> {
        let finished = store.finished_structures(protocol, Some(version), MAX_FINISHED).await?;
        let mut examples = Vec::with_capacity(finished.len());
        for found in &finished {
            used.insert(found.decision);
            let gamma = found.gamma.unwrap_or(f64::NAN);
            let known =
                self.known(store, version, found.decision, &found.structure, gamma, found.relative_volume);
            let known = known.await?;
            let example = |predictors: &CompletionPredictors| CompletionExample {
                predictors: predictors.clone(),
                completed: found.labelled,
                seed_structure: found.seed_structure,
                walk: found.walk,
            };
            examples.extend(known.predictors.as_ref().map(example));
            if let Some(features) = known.features.as_ref().filter(|_| found.labelled) {
                let features = Arc::clone(features);
                covering.push(CoveringLabel { decision: found.decision, version, features });
            }
        }
        Ok(CompletionModel::fit(&with_other_versions(store, protocol, examples).await?.examples))
    }

    /// What does not change of a structure, computed the first time.
    async fn known(
        &mut self,
        store: &Store,
        version: u32,
        decision: i64,
        structure: &Structure,
        gamma: f64,
        relative_volume: Option<f64>,
    ) -> Result<&KnownProperties, StoreError> {
        let place = match self.known.entry(decision) {
            Entry::Occupied(known) => return Ok(known.into_mut()),
            Entry::Vacant(place) => place,
        };
        let predictors = CompletionPredictors::of_structure(structure, gamma, relative_volume).ok();
        let features = match version == self.version {
            true => store.features_of(decision).await?,
            false => None,
        };
        let features =
            features.and_then(|features| MeanFeatures::new(&structure.species, &features, &self.scales));
        Ok(place.insert(KnownProperties { predictors, features: features.map(Arc::new) }))
    }
}

fn row(
    found: &QueuedStructure,
    versions: &WalkVersions,
    known: &KnownProperties,
    models: &VersionModels<'_>,
    costs: &CostEstimator,
) -> QueuedLabel {
    let QueuedStructure { seed_structure, formula, structure, original, .. } = found;
    let size = PendingJobs {
        seed_structure: *seed_structure,
        formula: formula.clone(),
        atoms: u32::try_from(structure.species.len()).unwrap_or(u32::MAX),
        jobs: 1,
    };
    let completion = models.completion.as_ref().zip(known.predictors.as_ref());
    QueuedLabel {
        job: found.job,
        decision: found.decision,
        priority: found.priority,
        version: versions.version_of(found.walk),
        expected_error: models.calibration.and_then(|found| mean_error(found, &original.gamma_nbr)),
        completion: completion.map(|(model, predictors)| model.probability(predictors)),
        core_hours: costs.predict_job(&size).map(|cost| cost.expected),
        overtaken: found.overtaken,
        features: known.features.clone(),
    }
}

/// Mean expected force error of the atoms, eV/Å; `None` if it is unknown of all.
fn mean_error(calibration: &CalibrationState, gamma_nbr: &[f64]) -> Option<f64> {
    let errors: Vec<f64> = gamma_nbr.iter().filter_map(|gamma| calibration.expected_error(*gamma)).collect();
    (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64)
}

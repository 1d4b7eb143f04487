//! Updates a new mixture with the accepted candidates of a campaign that have no label.
//!
//! A mixture that is built from labelled structures knows nothing of structures whose label is pending, failed or was taken out, so
//! that walkers would find them again.

use std::collections::HashSet;
use std::sync::Arc;

use calm::{Grades, Mixture};
use orchestrator::selector::{SelectorSettings, UpdateProtocol, update_settings_in_force};
use potentials::ModelWithFeatures;
use store::{CampaignRecord, Fate, Store, StoredCandidate};
use tokio_util::sync::CancellationToken;

use crate::exit_status::CommandError;
use crate::features::FeatureCalculator;
use crate::output::log_and_warn;
use crate::replay::recorded_settings;

/// Candidates per read; their features are not needed, but are read with them.
const CANDIDATES: u32 = 16;

/// A mixture after the updates, and what the candidates did to it.
pub struct MixtureAfterUpdates {
    /// Id of the campaign.
    pub campaign: String,
    pub mixture: Mixture,
    /// Candidates that updated it.
    pub applied: u64,
    /// Candidates that the mixture covered already, so that walkers would not collect them.
    pub covered: u64,
    /// Candidates that the model cannot evaluate or the mixture cannot be updated with.
    pub left_out: u64,
}

/// Applies candidates to a mixture, one after another.
struct CandidateUpdater<'a> {
    settings: SelectorSettings,
    search: calm::UpdateSettings,
    calculator: FeatureCalculator,
    grades: Grades,
    found: MixtureAfterUpdates,
    stop: &'a CancellationToken,
}

/// The settings of a campaign's selector.
///
/// # Errors
/// A campaign that never updates its mixture.
pub fn updating_settings(campaign: &CampaignRecord) -> Result<SelectorSettings, CommandError> {
    let settings = recorded_settings(campaign)?;
    if settings.update == UpdateProtocol::Never {
        return Err(CommandError::Input(format!(
            "--campaign: campaign {} never updates its mixture (calm.update = \"never\"); expected one that does",
            campaign.id
        )));
    }
    Ok(settings)
}

/// Applies the candidates in decision order by the campaign's rules: those that meet the collection rule under the mixture so far
/// update it. Features are those of `model`, to which `mixture` belongs. `None` after a cancellation of `stop`.
///
/// Warns of a candidate that the model cannot evaluate or the mixture cannot be updated with, and continues.
///
/// A candidate counts as labelled if `calmwalk export` writes it under the protocol in force. Updates are as the campaign's are now:
/// once it has switched to additive ones, also those by earlier candidates are additive.
///
/// # Errors
/// A campaign that never updates its mixture, a damaged database.
pub async fn apply(
    store: &Store,
    model: &Arc<dyn ModelWithFeatures>,
    mixture: Mixture,
    stop: &CancellationToken,
) -> Result<Option<MixtureAfterUpdates>, CommandError> {
    let mut updater = CandidateUpdater::new(store, model, mixture, stop).await?;
    let protocol = store.protocol_in_force().await?.map(|protocol| protocol.hash);
    let mut last = 0;
    loop {
        let page = store.candidates_without_label(protocol, last, CANDIDATES).await?;
        let Some(end) = page.last() else { return Ok(Some(updater.found)) };
        last = end.decision;
        if !updater.apply_all(page.iter()) {
            return Ok(None);
        }
    }
}

/// As [`apply`], for all accepted candidates but those of the decisions in `known`.
pub async fn apply_others(
    store: &Store,
    model: &Arc<dyn ModelWithFeatures>,
    mixture: Mixture,
    known: &HashSet<i64>,
    stop: &CancellationToken,
) -> Result<Option<MixtureAfterUpdates>, CommandError> {
    let mut updater = CandidateUpdater::new(store, model, mixture, stop).await?;
    let mut last = 0;
    loop {
        let page = store.candidates(last, false, CANDIDATES).await?;
        let Some(end) = page.last() else { return Ok(Some(updater.found)) };
        last = end.decision;
        let is_other = |candidate: &&StoredCandidate| {
            candidate.fate == Fate::Accepted && !known.contains(&candidate.decision)
        };
        if !updater.apply_all(page.iter().filter(is_other)) {
            return Ok(None);
        }
    }
}

impl<'a> CandidateUpdater<'a> {
    async fn new(
        store: &Store,
        model: &Arc<dyn ModelWithFeatures>,
        mixture: Mixture,
        stop: &'a CancellationToken,
    ) -> Result<Self, CommandError> {
        let record = store.campaign().await?;
        let settings = updating_settings(&record)?;
        let search = update_settings_in_force(&settings.search, &store.values().await?);
        let campaign = record.id.to_string();
        let found = MixtureAfterUpdates { campaign, mixture, applied: 0, covered: 0, left_out: 0 };
        let calculator = FeatureCalculator::new(Arc::clone(model));
        Ok(Self { settings, search, calculator, grades: Grades::default(), found, stop })
    }

    /// Applies these candidates in order. Returns false if it was stopped.
    fn apply_all<'c>(&mut self, candidates: impl Iterator<Item = &'c StoredCandidate>) -> bool {
        for candidate in candidates {
            if self.stop.is_cancelled() {
                return false;
            }
            self.apply_or_warn(candidate);
        }
        true
    }

    fn apply_or_warn(&mut self, candidate: &StoredCandidate) {
        if let Err(error) = self.apply(candidate) {
            let (campaign, id) = (&self.found.campaign, candidate.block.view().id());
            log_and_warn(format_args!("campaign {campaign}, candidate {id} is left out: {error}"));
            self.found.left_out += 1;
        }
    }

    fn apply(&mut self, candidate: &StoredCandidate) -> Result<(), Box<dyn std::error::Error>> {
        let elements = self.calculator.compute(&candidate.block.view().structure())?;
        let (mixture, features) = (&self.found.mixture, self.calculator.features());
        self.grades.evaluate(mixture, &elements, features, None)?;
        if !self.settings.collection.is_met(&self.grades.gamma) {
            self.found.covered += 1;
            return Ok(());
        }
        let outcome = calm::update(mixture, &elements, features, &self.search)?;
        self.found.mixture = mixture.with_changes(&outcome.changed)?;
        self.found.applied += 1;
        Ok(())
    }
}

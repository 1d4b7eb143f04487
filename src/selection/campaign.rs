//! The candidates of a campaign as a pool.

use orchestrator::selector::VERSION;
use store::records::{Fate, StoredCandidate};
use store::{Location, Store};

use super::{FeatureIdentity, ItemPlace, PoolItem, StructureSource};
use crate::exit_status::CommandError;
use crate::output::log_and_warn;
use crate::replay;

/// Candidates per read; each has up to megabytes of features.
const PAGE: u32 = 16;

/// Which candidates of campaigns are part of a pool, and which of their stored features are used.
#[derive(Clone, Debug)]
pub struct CandidateChoice {
    /// The features of the selection. Others that a campaign has stored are not used.
    pub features: FeatureIdentity,
    /// Dimension D of the features.
    pub dimension: usize,
    /// Leave out accepted candidates.
    pub declined_only: bool,
    /// Leave out candidates without stored features that can be used.
    pub no_evaluation: bool,
}

/// The candidates of a campaign's biased walks, in decision order.
pub struct CampaignCandidates {
    pub store: Store,
    /// Its index among the campaigns of the pool.
    number: u32,
    /// Id of the campaign.
    pub id: String,
    choice: CandidateChoice,
    /// Candidates before this decision have stored features of the selection.
    same_features_before: i64,
    last: i64,
    /// Candidates that were left out because the store has no features of them for the selection.
    pub left_out: u64,
    /// Every candidate was read.
    pub(super) is_read: bool,
    runtime: tokio::runtime::Runtime,
}

impl CampaignCandidates {
    /// Opens campaign `number` of the pool for reading.
    pub fn open(location: &Location, number: u32, choice: CandidateChoice) -> Result<Self, CommandError> {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(CommandError::failed)?;
        let (store, campaign, files, versions) = runtime.block_on(async {
            let store = Store::open_read_only(location).await?;
            let (campaign, files) = (store.campaign().await?, store.grade_files().await?);
            let versions = store.decisions_of_kind(VERSION).await?;
            Ok::<_, CommandError>((store, campaign, files, versions))
        })?;
        let id = campaign.id.to_string();
        let stored = choice.features.is_stored_by(&replay::resolved(&campaign)?, &files);
        let same_features = stored.unwrap_or_else(|error| {
            log_and_warn(format_args!(
                "campaign {id}: the features that it has stored are not used, because their projection is unknown: {error}"
            ));
            false
        });
        // Later versions of the potential have other features.
        let same_features_before = match (same_features, versions.first()) {
            (false, _) => 0,
            (true, None) => i64::MAX,
            (true, Some(version)) => version.sequence,
        };
        Ok(Self {
            store,
            number,
            id,
            choice,
            same_features_before,
            last: 0,
            left_out: 0,
            is_read: false,
            runtime,
        })
    }

    /// The next candidates; none at the end.
    pub(super) fn next_page(&mut self) -> Result<Vec<PoolItem>, CommandError> {
        loop {
            let page = self.runtime.block_on(self.store.candidates(self.last, false, PAGE))?;
            let Some(last) = page.last() else { return Ok(Vec::new()) };
            self.last = last.decision;
            let declined_only = self.choice.declined_only;
            let kept = page.into_iter().filter(|found| !declined_only || found.fate != Fate::Accepted);
            let mut items: Vec<_> = kept.map(|found| self.item(found)).collect();
            if self.choice.no_evaluation {
                let all = items.len();
                items.retain(|item| item.features.is_some());
                self.left_out += (all - items.len()) as u64;
            }
            if !items.is_empty() {
                return Ok(items);
            }
        }
    }

    fn item(&self, found: StoredCandidate) -> PoolItem {
        let view = found.block.view();
        let structure = view.structure();
        let size = structure.len() * self.choice.dimension;
        let is_same = found.decision < self.same_features_before;
        PoolItem {
            structure,
            source: StructureSource::Candidate { campaign: self.number, decision: found.decision },
            features: found.features.filter(|features| is_same && features.len() == size),
            place: ItemPlace::Candidate(view.id().to_string()),
        }
    }

    /// The candidate of a decision.
    pub(super) fn candidate(&self, decision: i64) -> Result<StoredCandidate, CommandError> {
        let found = self.runtime.block_on(self.store.candidates(decision - 1, false, 1))?;
        let found = found.into_iter().find(|found| found.decision == decision);
        found.ok_or_else(|| CommandError::Failed(format!("the candidate of decision {decision} is gone")))
    }
}

//! Reads the data of a report from the store.

use std::collections::BTreeMap;

use monitor::calibration::{self, CalibrationState};
use monitor::completion_model::CompletionReport;
use monitor::end_reason::CampaignEnd;
use monitor::history::CampaignHistory;
use monitor::label_statistics::comparison::WalkComparison;
use monitor::label_statistics::{self, LabelStatistics};
use monitor::versions::{CampaignVersions, newest_with_labels};
use serde_json::Value;
use store::{
    CampaignRecord, CampaignStatus, FailureCount, FateCount, LabelCost, Protocol, SeedStructure, Store,
    StoreError, Unlabelled,
};

use super::collections::Collections;
use super::walk_traces::{self, GroupTraces};

/// Largest number of labels in the cost figure: the newest.
const MAX_COSTS: u32 = 100_000;
/// Number of parts into which the decision log is divided.
const MAX_PARTS: u64 = 200;

/// Data of a campaign.
pub struct ReportData {
    /// Id and configuration.
    pub campaign: CampaignRecord,
    /// Counts, walks, budget.
    pub status: CampaignStatus,
    /// The configuration in force with every default filled in.
    pub configuration: Value,
    /// Values that the selector stores about its mixture, by name.
    pub values: BTreeMap<String, Value>,
    /// Seed structures.
    pub seed_structures: Vec<SeedStructure>,
    /// Fates of candidates along the decision log.
    pub fates: Vec<FateCount>,
    /// Fates by seed structure.
    pub fates_by_seed_structure: Vec<FateCount>,
    /// The collected structures.
    pub collections: Collections,
    /// Traces of the biased walks, by group.
    pub walk_traces: Vec<GroupTraces>,
    /// Versions of the potential.
    pub versions: CampaignVersions,
    /// `None` without a label protocol.
    pub labels: Option<ProtocolLabels>,
    /// Samples of the campaign over time.
    pub history: CampaignHistory,
    /// Start of the campaign, ms since 1970.
    pub started: Option<i64>,
}

/// Labels of the protocol in force.
pub struct ProtocolLabels {
    /// The protocol.
    pub protocol: Protocol,
    /// Statistics of force errors and completion.
    pub statistics: LabelStatistics,
    /// Biased walks beside their controls.
    pub comparison: WalkComparison,
    /// Bounds of the force error by grade.
    pub calibration: CalibrationState,
    /// Cost of each label, newest first.
    pub costs: Vec<LabelCost>,
    /// Failures of attempts.
    pub failures: Vec<FailureCount>,
    /// Structures whose labels failed for good.
    pub unlabelled: Vec<Unlabelled>,
    /// Which labels complete; `None` before the first finished one.
    pub completion: Option<CompletionReport>,
}

impl ReportData {
    /// Reads the data page by page. Grades, force errors and features are those of one version of the potential: `version`, or
    /// the newest with labels.
    pub async fn read(store: &Store, version: Option<u32>) -> Result<Self, StoreError> {
        let campaign = store.campaign().await?;
        let seed_structures = store.seed_structures().await?;
        let protocol = store.protocol_in_force().await?;
        let decisions = store.newest_mixture().await?.decision;
        let part = u32::try_from(decisions.max(1).unsigned_abs().div_ceil(MAX_PARTS)).unwrap_or(u32::MAX);
        let (mut status, values) = (store.status().await?, store.values().await?);
        status.finished = CampaignEnd::read(store, &status).await?.is_some();
        let versions = CampaignVersions::read(store, &status, &values).await?;
        let values =
            values.into_iter().filter_map(|(name, text)| Some((name, serde_json::from_str(&text).ok()?)));
        let (walks, hash) = (store.walk_versions().await?, protocol.as_ref().map(|protocol| protocol.hash));
        let version = match (version, hash) {
            (Some(version), _) => version,
            (None, Some(hash)) => newest_with_labels(store, hash, &walks).await?,
            (None, None) => walks.newest(),
        };
        let collections = Collections::read(store, hash, &seed_structures, &walks, version).await?;
        let labels = match protocol {
            Some(protocol) => Some(ProtocolLabels::read(store, protocol, version).await?),
            None => None,
        };
        let walk_traces = walk_traces::read(store, &status, version).await?;
        let first = store.operations(0, 1).await?;
        Ok(Self {
            status,
            versions,
            walk_traces,
            configuration: serde_json::from_str(&campaign.configuration_in_force).unwrap_or_default(),
            values: values.collect(),
            fates: store.fates_by_decision(part).await?,
            fates_by_seed_structure: store.fates_by_seed_structure().await?,
            history: CampaignHistory::read(store, 0).await?,
            started: first.first().map(|operation| operation.time),
            campaign,
            seed_structures,
            collections,
            labels,
        })
    }
}

impl ReportData {
    /// The threshold of the collection rule.
    pub fn collection_threshold(&self) -> Option<f64> {
        monitor::walk_trace::threshold(&self.campaign.configuration_in_force)
    }
}

impl ProtocolLabels {
    async fn read(store: &Store, protocol: Protocol, version: u32) -> Result<Self, StoreError> {
        let hash = protocol.hash;
        let statistics = label_statistics::read(store, hash, Some(version)).await?;
        Ok(Self {
            comparison: statistics.comparison(),
            statistics,
            calibration: calibration::read(store, hash, version).await?,
            costs: store.label_costs(hash, MAX_COSTS).await?,
            failures: store.failures(hash).await?,
            unlabelled: store.unlabelled(hash, version, true).await?,
            completion: CompletionReport::read(store, hash, version).await?,
            protocol,
        })
    }
}

//! Everything that a report says, read from the store.

use std::collections::BTreeMap;

use serde_json::Value;
use store::{
    Campaign, FailureCount, FateCount, LabelCost, Protocol, SeedStructure, Status, Store, StoreError,
    Unlabelled,
};

use super::collections::Collections;
use crate::label_statistics::{self, LabelStatistics};

/// Labels whose cost is shown: the newest.
const COSTS: u32 = 100_000;
/// Parts into which the decision log is cut.
const PARTS: u64 = 200;

/// A campaign as it stands.
pub struct ReportData {
    /// What it is.
    pub campaign: Campaign,
    /// Counts, walks, budget.
    pub standing: Status,
    /// The configuration in force, every default filled in.
    pub configuration: Value,
    /// What the selector keeps of its mixture, by name.
    pub values: BTreeMap<String, Value>,
    /// Seed structures.
    pub seeds: Vec<SeedStructure>,
    /// What became of candidates, along the decision log.
    pub fates: Vec<FateCount>,
    /// The same by seed structure.
    pub fates_by_seed: Vec<FateCount>,
    /// What was collected.
    pub sample: Collections,
    /// What is there if labels are made at all.
    pub labels: Option<Labels>,
    /// When the campaign was begun, ms since 1970.
    pub begun: Option<i64>,
}

/// Labels of the protocol in force.
pub struct Labels {
    /// The protocol.
    pub protocol: Protocol,
    /// Force errors by grade, and which structures got their labels.
    pub learned: LabelStatistics,
    /// What each label took, newest first.
    pub costs: Vec<LabelCost>,
    /// Failures that attempts met.
    pub failures: Vec<FailureCount>,
    /// Where labels finally failed.
    pub unlabelled: Vec<Unlabelled>,
}

impl ReportData {
    /// Reads it, page by page.
    pub async fn read(store: &Store) -> Result<Self, StoreError> {
        let campaign = store.campaign().await?;
        let seeds = store.seed_structures().await?;
        let protocol = store.protocol_in_force().await?;
        let decisions = store.newest_mixture().await?.decision;
        let part = u32::try_from(decisions.max(1).unsigned_abs().div_ceil(PARTS)).unwrap_or(u32::MAX);
        let values = store.values().await?.into_iter();
        let values = values.filter_map(|(name, text)| Some((name, serde_json::from_str(&text).ok()?)));
        let sample =
            Collections::read(store, protocol.as_ref().map(|protocol| protocol.hash), &seeds).await?;
        let labels = match protocol {
            Some(protocol) => Some(Labels::read(store, protocol).await?),
            None => None,
        };
        let first = store.operations(0, 1).await?;
        Ok(Self {
            standing: store.status().await?,
            configuration: serde_json::from_str(&campaign.configuration_in_force).unwrap_or_default(),
            values: values.collect(),
            fates: store.fates_by_decision(part).await?,
            fates_by_seed: store.fates_by_seed_structure().await?,
            begun: first.first().map(|operation| operation.time),
            campaign,
            seeds,
            sample,
            labels,
        })
    }
}

impl Labels {
    async fn read(store: &Store, protocol: Protocol) -> Result<Self, StoreError> {
        let hash = protocol.hash;
        Ok(Self {
            learned: label_statistics::read(store, hash).await?,
            costs: store.label_costs(hash, COSTS).await?,
            failures: store.failures(hash).await?,
            unlabelled: store.unlabelled(hash, true).await?,
            protocol,
        })
    }
}

//! The label queue of a campaign: its costs, failures, and the structures without labels.

use serde_json::{Value, json};
use store::{CampaignStatus, FailureCount, JobState, Store, StoreError, Unlabelled};

use crate::label_cost::{self, CostEstimator, QueueCost};
use crate::label_progress::{self, LabelUnderWay};
use crate::versions::newest_with_labels;

/// Largest number of labelled structures for which ranges of grades and volumes are computed.
const MAX_STRUCTURES: u64 = 20_000;

/// Costs and failures of the labels of the current protocol.
#[derive(Clone, Debug, Default)]
pub struct LabelQueue {
    /// Costs of the labels so far, and of the queued ones.
    pub cost: QueueCost,
    /// Failures by class.
    pub failures: Vec<FailureCount>,
    /// Structures whose labels failed for good, by seed structure.
    pub unlabelled: Vec<Unlabelled>,
    /// The label jobs of each protocol.
    pub by_protocol: Vec<ProtocolJobs>,
    /// Labels that are being made, the longest first; at most [`label_progress::MAX_RUNNING`].
    pub running: Vec<LabelUnderWay>,
    /// Structures found by both biased and control walks, with one label each; not counted in large campaigns.
    pub shared: Option<u64>,
}

/// The label jobs of one protocol.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ProtocolJobs {
    /// Name of the protocol.
    pub protocol: String,
    /// Whether new labels are made by it.
    pub in_force: bool,
    /// Number of jobs in each state.
    pub counts: Vec<(JobState, u64)>,
}

impl LabelQueue {
    /// Reads the store. Empty if there is no protocol yet.
    pub async fn read(store: &Store, status: &CampaignStatus) -> Result<Self, StoreError> {
        let shared = match status.candidates.control <= MAX_STRUCTURES {
            true => Some(store.structures_of_both_origins().await?.len() as u64),
            false => None,
        };
        let Some(protocol) = store.protocol_in_force().await? else {
            return Ok(Self { shared, ..Self::default() });
        };
        let unlabelled = match (status.labels.failed, status.labels.labelled) {
            (0, _) => Vec::new(),
            (_, labelled) => {
                let version = newest_with_labels(store, protocol.hash, &store.walk_versions().await?).await?;
                store.unlabelled(protocol.hash, version, labelled <= MAX_STRUCTURES).await?
            }
        };
        let costs = CostEstimator::from_store(store, protocol.hash).await?;
        Ok(Self {
            cost: label_cost::queue_cost(store, protocol.hash, &costs).await?,
            running: label_progress::read(store, &costs).await?,
            failures: store.failures(protocol.hash).await?,
            unlabelled,
            by_protocol: by_protocol(&store.jobs_by_protocol().await?, &protocol.name),
            shared,
        })
    }

    /// Adds it to the JSON of a status.
    pub(crate) fn add_to(&self, json: &mut Value, status: &CampaignStatus) {
        json["labels_per_hour"] = json!(labels_per_hour(status));
        json["cost"] = json!({ "core_hours": status.budget.used.core_hours, "queue": self.cost });
        json["labels_in_progress"] = json!(self.running);
        json["failures"] = json!(self.failures);
        json["unlabelled"] = json!(self.unlabelled);
        json["shared_structures"] = json!(self.shared);
    }
}

/// Average number of labels per hour of running time.
pub fn labels_per_hour(status: &CampaignStatus) -> Option<f64> {
    let used = &status.budget.used;
    (used.wall_hours > 0.0).then(|| used.labels as f64 / used.wall_hours)
}

fn by_protocol(jobs: &[(String, JobState, u64)], in_force: &str) -> Vec<ProtocolJobs> {
    let of_one = |jobs: &[(String, JobState, u64)]| ProtocolJobs {
        protocol: jobs[0].0.clone(),
        in_force: jobs[0].0 == in_force,
        counts: jobs.iter().map(|(_, state, count)| (*state, *count)).collect(),
    };
    jobs.chunk_by(|a, b| a.0 == b.0).map(of_one).collect()
}

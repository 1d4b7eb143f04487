//! Pass 1: clusters of the features of each element in each shard, and their combination.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, PoisonError};

use calm::build::{BuildSettings, ShardClustering, ShardClusters, partition};

use super::Build;
use super::passes::ShardResult;
use super::progress::Progress;
use super::state::{FinishedShard, Partition, State};
use super::stream::{Shard, ShardHash};
use super::workers::{Counters, run_pass};
use crate::exit_status::Failure;

/// The clusters of each element, by index and hash of the shard.
pub(super) type Clusters = BTreeMap<(u64, ShardHash), Vec<ShardClusters>>;

/// What pass 1 found in the shards of this process.
pub(super) struct Clustered {
    /// Number of structures in all files.
    pub structures: u64,
    /// Of the shards.
    pub hashes: BTreeMap<u64, ShardHash>,
    /// Of the shards, and of shards with other contents.
    pub clusters: Clusters,
}

impl Build {
    /// Pass 1. `None` once it was stopped.
    pub(super) fn partition(&mut self) -> Result<Option<Partition>, Failure> {
        if let Some(partition) = self.state.partition()? {
            return Ok(Some(partition));
        }
        let Some(found) = self.cluster()? else { return Ok(None) };
        let partition = found.combine(&self.settings, self.work.model.elements().len())?;
        self.state.save_partition(&partition)?;
        Ok(Some(partition))
    }

    /// Clusters the shards of this process. `None` once it was stopped.
    pub(super) fn cluster(&mut self) -> Result<Option<Clustered>, Failure> {
        let Self { work, settings, state, bytes } = self;
        let mut clusters = known(state)?;
        let finished: BTreeSet<(u64, ShardHash)> = clusters.keys().copied().collect();
        let hashes = Mutex::new(BTreeMap::new());
        let is_finished = |shard: &Shard| {
            hashes.lock().unwrap_or_else(PoisonError::into_inner).insert(shard.index, shard.hash);
            Ok(finished.contains(&(shard.index, shard.hash)))
        };
        let elements = work.model.elements().len();
        let begin = |shard| {
            (0..elements).map(|element| ShardClustering::new(settings, shard, element).map(Some)).collect()
        };
        let counters = Counters::default();
        let progress = Progress::new(1, None, *bytes, &counters);
        let mut unsaved = Vec::new();
        let ended = run_pass(
            work,
            is_finished,
            begin,
            &counters,
            |result| {
                let ShardResult { index, hash, elements } = result;
                let elements: Vec<_> = elements.into_iter().flatten().collect();
                clusters.insert((index, hash), elements.clone());
                unsaved.push(FinishedShard { index, hash, elements });
                if state.is_due() {
                    state.save_clusters(&std::mem::take(&mut unsaved))?;
                }
                Ok(())
            },
            || progress.show(),
        );
        state.save_clusters(&unsaved)?;
        let Some(structures) = ended? else { return Ok(None) };
        progress.end(structures);
        let hashes = hashes.into_inner().unwrap_or_else(PoisonError::into_inner);
        Ok(Some(Clustered { structures, hashes, clusters }))
    }
}

/// The clusters of all shards that are known.
pub(super) fn known(state: &State) -> Result<Clusters, Failure> {
    Ok(state.clusters()?.into_iter().map(|shard| ((shard.index, shard.hash), shard.elements)).collect())
}

impl Clustered {
    /// Combines the clusters of the shards in their order.
    pub(super) fn combine(self, settings: &BuildSettings, elements: usize) -> Result<Partition, Failure> {
        let Self { structures, hashes, clusters } = self;
        let of = |element: usize| {
            let shards = hashes.iter().filter_map(|(&index, &hash)| clusters.get(&(index, hash)));
            let shards: Vec<_> = shards.map(|elements| elements[element].clone()).collect();
            partition(settings, element, &shards).map_err(Failure::failed)
        };
        let elements = (0..elements).map(of).collect::<Result<_, _>>()?;
        Ok(Partition { structures, hashes: hashes.into_values().collect(), elements })
    }
}

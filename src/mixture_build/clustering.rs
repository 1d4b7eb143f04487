//! Pass 1: clusters of the features of each element in each shard, and their combination.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, PoisonError};

use calm::build::{BuildSettings, Partitioner, ShardClustering};

use super::MixtureBuild;
use super::cluster_log::KnownShards;
use super::passes::ShardResult;
use super::progress::PassProgress;
use super::state::Partition;
use super::stream::{Shard, ShardHash};
use super::workers::{Counters, run_pass};
use crate::exit_status::CommandError;

/// What pass 1 found.
pub(super) struct Clustered {
    /// Number of structures in all files.
    pub structures: u64,
    /// Of the shards.
    pub hashes: BTreeMap<u64, ShardHash>,
    /// The clusters of the shards.
    pub known: KnownShards,
}

impl MixtureBuild {
    /// Pass 1. `None` once it was stopped.
    pub(super) fn partition(&mut self) -> Result<Option<Partition>, CommandError> {
        if let Some(partition) = self.state.partition()? {
            return Ok(Some(partition));
        }
        let Some(found) = self.cluster()? else { return Ok(None) };
        let partition = found.combine(&self.settings, self.context.model.model.elements().len())?;
        self.state.save_partition(&partition)?;
        Ok(Some(partition))
    }

    /// Clusters the shards of this process. `None` once it was stopped.
    pub(super) fn cluster(&mut self) -> Result<Option<Clustered>, CommandError> {
        let Self { context, settings, state, cache, bytes } = self;
        let mut known = state.known_shards()?;
        let finished: BTreeSet<(u64, ShardHash)> = known.shards().collect();
        let hashes = Mutex::new(BTreeMap::new());
        let is_finished = |shard: &Shard| {
            hashes.lock().unwrap_or_else(PoisonError::into_inner).insert(shard.index, shard.hash);
            Ok(finished.contains(&(shard.index, shard.hash)))
        };
        let elements = context.model.model.elements().len();
        let begin = |shard| {
            (0..elements).map(|element| ShardClustering::new(settings, shard, element).map(Some)).collect()
        };
        let counters = Counters::default();
        let progress = PassProgress::new(1, context.part, None, *bytes, &counters);
        let ended = run_pass(
            (context, cache),
            is_finished,
            begin,
            &counters,
            |ShardResult { index, hash, elements }| {
                known.append(index, hash, &elements.into_iter().flatten().collect::<Vec<_>>())?;
                if state.is_due() { state.save_known_shards(&known) } else { Ok(()) }
            },
            || progress.show(),
        );
        state.save_known_shards(&known)?;
        let Some(structures) = ended? else { return Ok(None) };
        progress.end(structures);
        let hashes = hashes.into_inner().unwrap_or_else(PoisonError::into_inner);
        Ok(Some(Clustered { structures, hashes, known }))
    }
}

impl Clustered {
    /// Combines the clusters of the shards in their order.
    pub(super) fn combine(
        self,
        settings: &BuildSettings,
        elements: usize,
    ) -> Result<Partition, CommandError> {
        let Self { structures, hashes, known } = self;
        let partitioners = (0..elements).map(|element| Partitioner::new(settings, element));
        let mut partitioners: Vec<_> =
            partitioners.collect::<Result<_, _>>().map_err(CommandError::failed)?;
        for (&index, &hash) in &hashes {
            let found = known.read(index, hash)?.ok_or_else(|| {
                let path = known.path().display();
                CommandError::Failed(format!(
                    "{path}: the clusters of shard {index} are missing; remove the directory and start over"
                ))
            })?;
            for (partitioner, of_element) in partitioners.iter_mut().zip(&found) {
                partitioner.add(of_element).map_err(CommandError::failed)?;
            }
        }
        let elements = partitioners.into_iter().map(Partitioner::finish).collect();
        Ok(Partition { structures, hashes: hashes.into_values().collect(), elements })
    }
}

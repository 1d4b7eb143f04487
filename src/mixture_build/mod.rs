//! Builds a mixture from files of training data: three passes over their shards, by several threads, with a state on disk.
//!
//! `calm::build` has the numbers. The artifact depends on model, data and settings, but not on threads and interruptions: a
//! shard is always computed in the same order, the clusters of pass 1 are combined in the order of the shards, and the sums of
//! passes 2 and 3 are exact.

mod identity;
mod passes;
mod progress;
mod state;
mod stream;
mod workers;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use calm::Projection;
use calm::build::{
    BuildError, BuildSettings, BuiltComponent, BuiltElement, BuiltMixture, CalibrationPass,
    ElementHistograms, ElementPartition, ElementSums, ExactSums, ScatterPass, ShardClustering, ShardClusters,
    components, partition,
};

use self::identity::Identity;
use self::passes::{ElementPass, ShardResult};
use self::progress::Progress;
use self::state::{FinishedShard, Partition, RunningSums, State};
pub use self::stream::data_files;
use self::stream::{Shard, ShardHash};
pub use self::workers::Work;
use self::workers::{Counters, run_pass};
use crate::exit_status::Failure;
use crate::output::{self, print_stderr};

/// A build under way.
pub struct Build {
    work: Work,
    settings: BuildSettings,
    state: State,
    /// Total size of the data files.
    bytes: u64,
}

/// Where a pass ended.
enum Ended<T> {
    Finished(T),
    Interrupted,
}

impl Build {
    /// Begins a build, or continues the one whose state lies beside `output`.
    ///
    /// `model_hash` is the BLAKE3 hash of the model's file.
    ///
    /// # Errors
    /// Invalid settings; the state of another build.
    pub fn open(
        work: Work,
        settings: BuildSettings,
        model_hash: String,
        output: &Path,
        restart: bool,
    ) -> Result<Self, Failure> {
        ShardClustering::new(&settings, 0, 0).map_err(Failure::input)?;
        let identity = Identity::new(model_hash, settings.clone(), &work.files);
        let (state, exists) = State::open(output, &identity, restart)?;
        if exists {
            print_stderr(format_args!("continuing from {}", state.directory().display()));
        }
        Ok(Self { bytes: stream::total_bytes(&work.files)?, work, settings, state })
    }

    /// Takes the passes that are left. `None` if it was stopped; the same build then continues.
    pub fn run(
        &mut self,
        projection: Projection,
        projection_seed: Option<i64>,
    ) -> Result<Option<BuiltMixture>, Failure> {
        let Some(partition) = self.partition()? else { return Ok(None) };
        let Some(components) = self.components(&partition)? else { return Ok(None) };
        let Some(histograms) = self.histograms(&partition, &components)? else { return Ok(None) };
        let elements = components.into_iter().zip(histograms).map(|(components, histograms)| {
            Some(BuiltElement { components: components?, histograms: histograms? })
        });
        let symbols = self.work.model.elements().iter().map(|element| element.symbol().to_owned()).collect();
        BuiltMixture::new(symbols, projection, projection_seed, self.settings.clone(), elements.collect())
            .map(Some)
            .map_err(Failure::failed)
    }

    /// Removes the state, which a written artifact no longer needs.
    pub fn finish(self) -> Result<(), Failure> {
        self.state.remove()
    }

    /// Pass 1.
    fn partition(&mut self) -> Result<Option<Partition>, Failure> {
        if let Some(partition) = self.state.partition()? {
            return Ok(Some(partition));
        }
        let Self { work, settings, state, bytes } = self;
        let known = state.clusters()?.into_iter().map(|shard| ((shard.index, shard.hash), shard.elements));
        let mut clusters: BTreeMap<(u64, ShardHash), Vec<ShardClusters>> = known.collect();
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
        let of = |element: usize| {
            let shards = hashes.iter().filter_map(|(&index, &hash)| clusters.get(&(index, hash)));
            let shards: Vec<_> = shards.map(|elements| elements[element].clone()).collect();
            partition(settings, element, &shards).map_err(Failure::failed)
        };
        let partition = Partition {
            structures,
            elements: (0..elements).map(of).collect::<Result<_, _>>()?,
            hashes: hashes.into_values().collect(),
        };
        state.save_partition(&partition)?;
        Ok(Some(partition))
    }

    /// Pass 2, and the components of each element.
    fn components(
        &mut self,
        partition: &Partition,
    ) -> Result<Option<Vec<Option<Vec<BuiltComponent>>>>, Failure> {
        let dimension = self.settings.dimension;
        let begin = |element: usize| {
            let centroids = &partition.elements[element].centroids;
            (!centroids.is_empty()).then(|| ScatterPass::new(dimension, centroids)).transpose()
        };
        let sums = match self.sums(2, partition, begin, |sums: &ElementSums| sums.to_row())? {
            Ended::Finished(sums) => sums,
            Ended::Interrupted => return Ok(None),
        };
        let of = |(found, sums): (&ElementPartition, Option<ExactSums>)| {
            let built = |sums: ExactSums| {
                let sums = ElementSums::from_row(dimension, &sums.totals())?;
                components(&found.centroids, &sums)
            };
            sums.map(built).transpose().map_err(Failure::failed)
        };
        partition.elements.iter().zip(sums).map(of).collect::<Result<_, _>>().map(Some)
    }

    /// Pass 3: the histograms of each element.
    fn histograms(
        &mut self,
        partition: &Partition,
        components: &[Option<Vec<BuiltComponent>>],
    ) -> Result<Option<Vec<Option<ElementHistograms>>>, Failure> {
        let begin = |element: usize| components[element].as_deref().map(CalibrationPass::new).transpose();
        let sums = match self.sums(3, partition, begin, |found: &ElementHistograms| found.to_row())? {
            Ended::Finished(sums) => sums,
            Ended::Interrupted => return Ok(None),
        };
        let of = |sums: Option<ExactSums>| {
            sums.map(|sums| ElementHistograms::from_row(&sums.totals())).transpose().map_err(Failure::failed)
        };
        sums.into_iter().map(of).collect::<Result<_, _>>().map(Some)
    }

    /// Pass 2 or 3: the sums of each element over all shards.
    fn sums<P: ElementPass>(
        &mut self,
        pass: usize,
        partition: &Partition,
        begin: impl Fn(usize) -> Result<Option<P>, BuildError> + Sync,
        to_row: impl Fn(&P::Partial) -> Vec<f64>,
    ) -> Result<Ended<Vec<Option<ExactSums>>>, Failure> {
        let Self { work, state, bytes, .. } = self;
        let mut sums = state.sums(pass)?;
        if sums.finished.len() == partition.hashes.len() {
            return Ok(Ended::Finished(sums.elements));
        }
        let elements = partition.elements.len();
        sums.elements.resize(elements, None);
        let counters = Counters::default();
        let progress = Progress::new(pass, Some(partition.structures), *bytes, &counters);
        let finished = sums.finished.clone();
        let is_finished = |shard: &Shard| {
            if partition.hashes.get(shard.index as usize) != Some(&shard.hash) {
                return Err(changed_since_pass_1(shard));
            }
            Ok(finished.contains(&shard.index))
        };
        let ended = run_pass(
            work,
            is_finished,
            |_| (0..elements).map(&begin).collect(),
            &counters,
            |result| {
                add(
                    &mut sums,
                    result.index,
                    result.elements.iter().map(|found| found.as_ref().map(&to_row)),
                )?;
                if state.is_due() { state.save_sums(pass, &sums) } else { Ok(()) }
            },
            || progress.show(),
        );
        state.save_sums(pass, &sums)?;
        let Some(structures) = ended? else { return Ok(Ended::Interrupted) };
        if structures != partition.structures {
            return Err(Failure::Input(format!(
                "the data files have {} now, pass 1 found {}; begin anew with --restart",
                output::count(structures, "structure"),
                partition.structures
            )));
        }
        progress.end(structures);
        Ok(Ended::Finished(sums.elements))
    }
}

fn changed_since_pass_1(shard: &Shard) -> Failure {
    let place = shard.structures.first().map_or(String::new(), |first| format!(" (from {})", first.place()));
    Failure::Input(format!(
        "the structures of shard {}{place} have changed since pass 1; restore the files, or begin anew with --restart",
        shard.index
    ))
}

/// Adds a shard to the sums, or nothing.
fn add(
    sums: &mut RunningSums,
    shard: u64,
    rows: impl Iterator<Item = Option<Vec<f64>>>,
) -> Result<(), Failure> {
    let mut elements = sums.elements.clone();
    for (sum, row) in elements.iter_mut().zip(rows) {
        if let Some(row) = row {
            let sum = sum.get_or_insert_with(|| ExactSums::new(row.len()));
            sum.add(&row).map_err(|error| Failure::Failed(format!("shard {shard}: {error}")))?;
        }
    }
    sums.elements = elements;
    sums.finished.insert(shard);
    Ok(())
}

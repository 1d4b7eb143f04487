//! Builds a mixture from files of training data: three passes over their shards, by several threads, with a state on disk.
//!
//! `calm::build` has the numbers. The artifact depends on model, data and settings, but not on threads and interruptions: a
//! shard is always computed in the same order, the clusters of pass 1 are combined in the order of the shards, and the sums of
//! passes 2 and 3 are exact.

mod cluster_log;
mod clustering;
mod feature_cache;
mod identity;
mod merge;
mod part;
mod passes;
mod progress;
mod projection;
mod state;
mod stream;
mod sums;
mod workers;

use std::path::Path;

use calm::Projection;
use calm::build::{
    BuildSettings, BuiltComponent, BuiltElement, BuiltMixture, ElementHistograms, ShardClustering,
};

use self::feature_cache::FeatureCache;
use self::identity::Identity;
pub use self::merge::{Merged, PartsMerge};
pub use self::part::BuildPart;
pub use self::projection::{PROJECTED, projected};
use self::state::{BuildState, PartEnd};
pub use self::workers::PassContext;
use crate::exit_status::CommandError;
use crate::output::print_stderr;

/// The defaults of a build, by `calmwalk calm build` and by a refit.
pub struct BuildDefaults;

impl BuildDefaults {
    /// Candidate numbers of components for each element.
    pub const CANDIDATES: [usize; 5] = [1, 2, 4, 8, 16];
    /// Structures in a shard.
    pub const SHARD_SIZE: u64 = 1000;
    /// Disk space for features, bytes.
    pub const MAX_FEATURE_BYTES: u64 = 4_000_000_000;
}

/// A build under way.
pub struct MixtureBuild {
    context: PassContext,
    settings: BuildSettings,
    state: BuildState,
    cache: FeatureCache,
    /// Total size of the data files.
    bytes: u64,
}

impl MixtureBuild {
    /// Begins a build, or continues the one whose state is beside `output`. Of a part of the work, other parts may be under way.
    ///
    /// `model_hash` is the BLAKE3 hash of the model's file, `projection` that of its features.
    ///
    /// # Errors
    /// Invalid settings; the state of another build (unless `restart`, which is for the whole).
    pub fn open(
        context: PassContext,
        settings: BuildSettings,
        model_hash: String,
        projection: &Projection,
        output: &Path,
        restart: bool,
    ) -> Result<Self, CommandError> {
        ShardClustering::new(&settings, 0, 0).map_err(CommandError::input)?;
        let identity = Identity::new(model_hash, projection, settings.clone(), &context.files);
        let (state, exists) = match context.part {
            None => BuildState::open(output, &identity, restart)?,
            Some(part) => BuildState::open_part(output, &identity, part)?,
        };
        if exists {
            print_stderr(format_args!("continuing from {}", state.directory().display()));
        }
        let identity = serde_json::to_vec(&identity).map_err(CommandError::failed)?;
        let (directory, limit) = (state.directory(), context.max_feature_bytes);
        let cache = FeatureCache::open(directory, context.shards(), identity, settings.dimension, limit);
        Ok(Self { bytes: context.files.total_bytes()?, context, settings, state, cache })
    }

    /// Takes the passes that are left. `None` if it was stopped; the same build then continues.
    pub fn run(
        &mut self,
        projection: Projection,
        projection_seed: Option<i64>,
    ) -> Result<Option<BuiltMixture>, CommandError> {
        let Some(partition) = self.partition()? else { return Ok(None) };
        let Some(components) = self.components(&partition)? else { return Ok(None) };
        let Some(histograms) = self.histograms(&partition, &components)? else { return Ok(None) };
        let settings = self.settings.clone();
        mixture(self.context.model.symbols(), projection, projection_seed, settings, components, histograms)
            .map(Some)
    }

    /// Takes the part through one pass, from 1 to 3. Returns whether it came to the end; otherwise it was stopped, and the same
    /// command continues.
    ///
    /// # Errors
    /// The pass before is not merged yet.
    pub fn run_part(&mut self, pass: u8) -> Result<bool, CommandError> {
        let not_merged = |pass: u8| {
            CommandError::Failed(format!(
                "pass {pass} is not merged yet: when all its parts are done, run calmwalk calm merge"
            ))
        };
        if pass == 1 {
            let Some(found) = self.cluster()? else { return Ok(false) };
            self.state.save_part_end(&PartEnd { structures: found.structures, hashes: found.hashes })?;
            return Ok(true);
        }
        let partition = self.state.partition()?.ok_or_else(|| not_merged(1))?;
        if pass == 2 {
            return Ok(self.sums_of_pass_2(&partition)?.is_some());
        }
        let components = self.merged_components(&partition)?.ok_or_else(|| not_merged(2))?;
        Ok(self.sums_of_pass_3(&partition, &components)?.is_some())
    }

    /// Removes the state, which a written artifact no longer needs.
    pub fn finish(self) -> Result<(), CommandError> {
        self.state.remove()
    }
}

/// The mixture of the results of all passes, by element index.
fn mixture(
    symbols: Vec<String>,
    projection: Projection,
    projection_seed: Option<i64>,
    settings: BuildSettings,
    components: Vec<Option<Vec<BuiltComponent>>>,
    histograms: Vec<Option<ElementHistograms>>,
) -> Result<BuiltMixture, CommandError> {
    let elements = components.into_iter().zip(histograms).map(|(components, histograms)| {
        Some(BuiltElement { components: components?, histograms: histograms? })
    });
    BuiltMixture::new(symbols, projection, projection_seed, settings, elements.collect())
        .map_err(CommandError::failed)
}

//! Builds a mixture from files of training data: three passes over their shards, by several threads, with a state on disk.
//!
//! `calm::build` has the numbers. The artifact depends on model, data and settings, but not on threads and interruptions: a
//! shard is always computed in the same order, the clusters of pass 1 are combined in the order of the shards, and the sums of
//! passes 2 and 3 are exact.

mod clustering;
mod identity;
mod passes;
mod progress;
mod state;
mod stream;
mod sums;
mod workers;

use std::path::Path;

use calm::Projection;
use calm::build::{BuildSettings, BuiltElement, BuiltMixture, ShardClustering};

use self::identity::Identity;
use self::state::State;
pub use self::stream::{ShardReader, data_files, total_bytes};
pub use self::workers::Work;
use crate::exit_status::Failure;
use crate::output::print_stderr;

/// A build under way.
pub struct Build {
    work: Work,
    settings: BuildSettings,
    state: State,
    /// Total size of the data files.
    bytes: u64,
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
}

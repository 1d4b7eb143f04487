//! What a refit needs to know.

use std::path::PathBuf;

use monitor::refit_progress::LabelSplit;
use potentials::grace::Precision;
use serde::{Deserialize, Serialize};

use crate::config::{ControlFrames, RefitMethod, RefitStart};
use crate::log;
use crate::process_config::HashedFile;

/// Configuration of a refit, which is read from standard input as those of other processes.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RefitterConfig {
    /// Parent process, with which it ends; `None` if it was started by hand.
    pub parent: Option<u32>,
    /// Directory of the campaign, or URL of its store.
    pub location: PathBuf,
    /// Directory of the campaign on this host: it works in `refit/N` below it.
    pub directory: PathBuf,
    /// Number of the version that the new one is trained from; 0 is that of the configuration.
    pub parent_version: u32,
    /// The model of that version.
    pub parent_model: HashedFile,
    /// The model of version 0, whose errors on the replay data are the measure of `max_replay_error_ratio`.
    pub first_model: HashedFile,
    /// The artifact of the parent, with its projection.
    pub parent_mixture: HashedFile,
    /// Precision of evaluations.
    pub precision: Precision,
    /// Random seed of the campaign.
    pub rng_seed: u64,
    /// The section `[refit]`.
    pub settings: RefitSettings,
    /// Its log.
    pub log: Option<log::LogConfig>,
}

/// The section `[refit]` with absolute paths and hashes.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RefitSettings {
    /// Labelled structures of what the potential knows.
    pub replay: Vec<HashedFile>,
    /// Weight of each of them in the training, times its `calmwalk_weight`.
    pub replay_weight: f64,
    /// What trains the model.
    pub method: RefitMethod,
    /// Share of the seed structures whose labels are never trained on.
    pub held_out: f64,
    /// See [`crate::config::RefitSection::max_replay_error_ratio`].
    pub max_replay_error_ratio: f64,
    /// See [`crate::config::RefitSection::max_held_out_error_ratio`].
    pub max_held_out_error_ratio: f64,
    /// Number of threads; 0: all cores.
    pub threads: usize,
    /// The weights from which a version is trained.
    pub start: RefitStart,
    /// What the labels of control frames are for.
    pub control_frames: ControlFrames,
    /// Structures whose errors are shown.
    pub test_sets: Vec<TestSet>,
    /// Structures to train with in place of the campaign's.
    pub comparisons: Vec<TestSet>,
}

impl RefitterConfig {
    /// What labels are for.
    pub fn label_split(&self) -> LabelSplit {
        let RefitSettings { held_out, control_frames, .. } = self.settings;
        let compares_controls = control_frames == ControlFrames::Compare;
        LabelSplit { held_out, compares_controls, rng_seed: self.rng_seed }
    }

    /// The model from which the version is trained.
    pub fn begin(&self) -> &HashedFile {
        match self.settings.start {
            RefitStart::Parent => &self.parent_model,
            RefitStart::First => &self.first_model,
        }
    }

    /// Number of the version of that model.
    pub fn begin_version(&self) -> u32 {
        match self.settings.start {
            RefitStart::Parent => self.parent_version,
            RefitStart::First => 0,
        }
    }
}

impl RefitSettings {
    /// Number of threads to use.
    pub fn threads(&self) -> usize {
        match self.threads {
            0 => std::thread::available_parallelism().map_or(1, |cores| cores.get()),
            threads => threads,
        }
    }
}

/// A file of labelled structures with a name.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct TestSet {
    /// Name.
    pub name: String,
    /// File.
    pub file: HashedFile,
}

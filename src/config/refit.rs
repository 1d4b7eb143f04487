//! `[refit]`

use std::num::{NonZeroU32, NonZeroU64};
use std::path::PathBuf;

use calm::rules::Positive;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use toml::Spanned;
use upfit::Optimiser;

use super::defaults;
use crate::duration::Duration;

/// How the potential is trained anew while the campaign runs.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RefitSection {
    /// Extended XYZ files of labelled structures that the potential knows: its training data, or a sample of them.
    #[schemars(with = "Vec<PathBuf>", length(min = 1))]
    pub replay: Vec<Spanned<PathBuf>>,
    /// Weight of each structure of `replay` in the training, times its `calmwalk_weight`. A label of the campaign has the weight 1.
    #[serde(default = "defaults::replay_weight")]
    pub replay_weight: Positive,
    /// A refit starts when the campaign has accepted this many structures since the last attempt. Default: when all walks have
    /// ended.
    #[serde(default)]
    pub after_structures: Option<NonZeroU32>,
    /// In live mode, a refit also starts this long after the last attempt, if there is anything new. Default: none.
    #[serde(default)]
    pub after_time: Option<Duration>,
    /// Number of versions to train; the campaign ends with the last one. Refused ones do not count.
    #[serde(default = "defaults::max_versions")]
    pub max_versions: NonZeroU32,
    /// Share of the seed structures whose labels no version is trained on; these labels judge each version. From 0 up to, not
    /// including, 1.
    #[serde(default = "defaults::held_out")]
    #[schemars(extend("minimum" = 0, "exclusiveMaximum" = 1))]
    pub held_out: f64,
    /// Largest mean absolute error of the forces on `replay`, relative to that of version 0. A version with more is refused.
    #[serde(default = "defaults::max_replay_error_ratio")]
    pub max_replay_error_ratio: Positive,
    /// Largest mean absolute error of the forces on the held-out labels, relative to that of the parent. A version with more is
    /// refused.
    #[serde(default = "defaults::max_held_out_error_ratio")]
    pub max_held_out_error_ratio: Positive,
    /// Number of times that calmwalk tries a training that crashes.
    #[serde(default = "defaults::refit_attempts")]
    pub max_attempts: NonZeroU32,
    /// Number of threads of a refit. 0: all cores.
    #[serde(default)]
    pub threads: usize,
    /// What trains the model.
    #[serde(default)]
    pub method: RefitMethod,
    /// The weights from which each version is trained.
    #[serde(default)]
    pub start: RefitStart,
    /// What the labels of control frames are for.
    #[serde(default)]
    pub control_frames: ControlFrames,
    /// Further labelled structures. calmwalk shows the errors of each version on them; they decide nothing.
    #[serde(default)]
    pub test_sets: Vec<TestSetSection>,
    /// Labelled structures. For each version, calmwalk trains a second model with them in place of the campaign's labels: with as
    /// many, from the first on. It shows the errors beside those of the version.
    #[serde(default)]
    pub comparisons: Vec<TestSetSection>,
}

/// The weights from which a version is trained.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RefitStart {
    /// Those of the version in force.
    #[default]
    Parent,
    /// Those of version 0.
    First,
}

/// What the labels of control frames are for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ControlFrames {
    /// Versions are trained on them too.
    #[default]
    Train,
    /// For each version, calmwalk trains a second model with them in place of the structures of biased walks.
    Compare,
}

/// What trains the model: a table with one key.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum RefitMethod {
    /// calmwalk itself, as `calmwalk upfit`.
    Native(NativeRefit),
    /// A program of the user.
    Command(CommandRefit),
}

/// Settings of the training by calmwalk.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct NativeRefit {
    /// Number of passes over the training set. Default: 40 with `optimiser = "soap"`, 100 with `"adam"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epochs: Option<NonZeroU64>,
    /// Number of structures for each update.
    pub batch_size: NonZeroU32,
    /// What turns gradients into steps.
    pub optimiser: Optimiser,
    /// Learning rate; it falls by half a cosine. With `optimiser = "soap"`, it rises to this value during the first 100 updates.
    /// Default: 0.05 with `"soap"`, 0.001 with `"adam"`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub learning_rate: Option<Positive>,
    /// Learning rate at the end, at most `learning_rate`. Default: a hundredth of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("minimum" = 0))]
    pub min_learning_rate: Option<f64>,
    /// Weights of the errors of energies, forces and stresses.
    pub loss: RefitLoss,
    /// Weight of the errors of the energy per atom. Default: that of `loss`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("minimum" = 0))]
    pub energy_weight: Option<f64>,
    /// Weight of the errors of force components. Default: that of `loss`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("minimum" = 0))]
    pub force_weight: Option<f64>,
    /// Weight of the errors of stress components. Default: that of `loss`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("minimum" = 0))]
    pub stress_weight: Option<f64>,
    /// δ of the Huber loss: larger errors count linearly; eV/atom, eV/Å and eV/Å³.
    pub huber_delta: Positive,
    /// Do not train the weights whose names begin with one of these.
    pub freeze: Vec<String>,
    /// Number of epochs without a new minimum of the validation loss after which the training ends. Default: never.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub patience: Option<NonZeroU64>,
    /// Decay, at each update, of a moving average of the weights; calmwalk validates and writes the average in their place. From
    /// 0 up to, not including, 1. Default: no average.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("minimum" = 0, "exclusiveMaximum" = 1))]
    pub average: Option<f64>,
    /// Share of the training structures for validation; structures of one seed structure stay together. From 0 up to, not including,
    /// 1. 0: no validation; the last weights are written.
    #[schemars(extend("minimum" = 0, "exclusiveMaximum" = 1))]
    pub validation_share: f64,
}

/// Weights of the errors in the loss, as `calmwalk upfit --loss`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RefitLoss {
    /// Energy 20, forces 5, stress 20.
    #[default]
    Demo,
    /// Energy 1, forces 5, stress 0.1; after 5/12 of the epochs 25, 1 and 0.1.
    Paper,
}

/// Settings of the training by a program.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CommandRefit {
    /// The program and its arguments.
    #[schemars(length(min = 1))]
    pub program: Vec<String>,
    /// Time after which calmwalk kills the program. Default: no limit.
    #[serde(default)]
    pub time_limit: Option<Duration>,
}

/// `[[refit.test_sets]]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TestSetSection {
    /// Name, of letters, digits, `_` and `-`.
    #[schemars(extend("pattern" = "^[A-Za-z0-9_-]+$"))]
    pub name: String,
    /// Extended XYZ file of labelled structures.
    #[schemars(with = "PathBuf")]
    pub file: Spanned<PathBuf>,
}

impl RefitSection {
    /// Every file that it names.
    pub(super) fn files(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        let of_test_sets = self.test_sets.iter_mut().chain(&mut self.comparisons).map(|set| &mut set.file);
        self.replay.iter_mut().chain(of_test_sets).map(Spanned::get_mut)
    }

    /// The program that trains the model, if it is a path.
    pub(super) fn program_path(&mut self) -> Option<&mut String> {
        match &mut self.method {
            RefitMethod::Command(command) => command.program.first_mut().filter(|name| name.contains('/')),
            RefitMethod::Native(_) => None,
        }
    }
}

impl RefitMethod {
    /// The name of its key: `native` or `command`.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Native(_) => "native",
            Self::Command(_) => "command",
        }
    }
}

impl Default for RefitMethod {
    fn default() -> Self {
        Self::Native(NativeRefit::default())
    }
}

impl NativeRefit {
    /// Number of passes over the training set.
    pub fn epochs(&self) -> u64 {
        self.epochs.map_or(self.optimiser.default_epochs(), NonZeroU64::get)
    }

    /// `learning_rate`, or that of the optimiser.
    pub fn first_learning_rate(&self) -> f64 {
        self.learning_rate.map_or(self.optimiser.default_learning_rate(), Positive::get)
    }
}

impl Default for NativeRefit {
    fn default() -> Self {
        Self {
            epochs: None,
            batch_size: defaults::nonzero(8),
            optimiser: Optimiser::default(),
            learning_rate: None,
            min_learning_rate: None,
            loss: RefitLoss::default(),
            energy_weight: None,
            force_weight: None,
            stress_weight: None,
            huber_delta: defaults::positive(0.01),
            freeze: Vec::new(),
            patience: None,
            average: None,
            validation_share: 0.1,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::config::{Config, demo_without_refit};

    /// The demo in `directory` with these lines behind it.
    fn config(directory: &str, lines: &str) -> Config {
        let path = Path::new(directory).join("c.toml");
        Config::from_draft(&path, format!("{}\n{lines}", demo_without_refit())).unwrap().config
    }

    #[test]
    fn paths_are_relative_to_the_configuration_and_not_part_of_what_a_campaign_is() {
        let lines = "[refit]\nreplay = [\"r.extxyz\", \"/s.extxyz\"]\n\
                     method = { command = { program = [\"./train.sh\", \"a/b\"] } }\n\
                     test_sets = [{ name = \"liquid\", file = \"liquid.extxyz\" }]\n";
        let [here, there] = ["/a", "/b"].map(|directory| config(directory, lines));
        let refit = here.refit.as_ref().unwrap();
        let replay: Vec<_> = refit.replay.iter().map(|path| path.get_ref().as_path()).collect();
        assert_eq!(replay, [Path::new("/a/r.extxyz"), Path::new("/s.extxyz")]);
        assert_eq!(refit.test_sets[0].file.get_ref(), Path::new("/a/liquid.extxyz"));
        let RefitMethod::Command(command) = &refit.method else { panic!("a command") };
        assert_eq!(command.program, ["/a/./train.sh", "a/b"]);
        let identity = |config: &Config| serde_json::to_value(config.without_paths()).unwrap();
        assert_eq!(identity(&here), identity(&there));
        let RefitMethod::Command(command) = here.without_paths().refit.unwrap().method else {
            panic!("a command")
        };
        assert_eq!(command.program, ["", "a/b"]);
        // A program that is no path is looked for in PATH.
        let lines = "[refit]\nreplay = [\"r\"]\nmethod = { command = { program = [\"train\"] } }\n";
        let mut refit = config("/a", lines).refit.unwrap();
        assert_eq!(refit.program_path(), None);
    }

    #[test]
    fn campaigns_without_a_refit_are_what_they_were() {
        let value = serde_json::to_value(config("/a", "")).unwrap();
        assert_eq!(value.get("refit"), None);
        let with = serde_json::to_value(config("/a", "[refit]\nreplay = [\"r\"]\n")).unwrap();
        assert_eq!(with["refit"]["method"]["native"]["batch_size"], 8);
    }
}

//! A configuration that is not written yet, with the files that it names. `calmwalk init` chooses values by it.

use std::path::Path;

use super::loader::Loader;
use super::seed_structures::SourcedStructure;
use super::short_range::{PairRange, pair_ranges};
use crate::config::{Config, ConfigError, LabelMethod, Loaded, Warning};
use crate::loaded_model::LoadedModel;

/// What the configuration names.
pub struct CampaignDraft {
    /// The model.
    pub model: LoadedModel,
    /// Seed structures that walks can start from.
    pub seed_structures: Vec<SourcedStructure>,
    /// The pairs of elements in the seed structures.
    pub pair_ranges: Vec<PairRange>,
    /// Settings that are valid but likely mistakes.
    pub warnings: Vec<Warning>,
}

impl CampaignDraft {
    /// Reads the files as `validate` does, for a configuration with this text that will have this path. Does not look for a
    /// program that makes labels: it may not be on this host.
    ///
    /// # Errors
    /// Everything that is wrong in the text, otherwise the first error in the files.
    pub fn read(path: &Path, text: &str) -> Result<Self, ConfigError> {
        let Loaded { config, text, mut warnings } = Config::from_draft(path, text.to_owned())?;
        let loader = Loader { path, text: &text, config: &config };
        let model = loader.model()?;
        let artifact = loader.artifact(&model)?;
        let mut seeds = loader.seed_structures(&*model.shared())?;
        if let LabelMethod::Potential(_) = &config.label.method {
            loader.protocol(&mut seeds)?;
        }
        warnings.extend(loader.plan_walks(&mut seeds)?);
        loader.check_update_target(&seeds.valid)?;
        warnings.extend(loader.suspicious_grades(&model, &artifact, &seeds.valid, None)?);
        warnings.extend(loader.suspicious_seed_structures(&seeds));
        let pair_ranges = pair_ranges(&config, &seeds.valid);
        warnings.extend(loader.repulsion_in_bonds(&pair_ranges));
        Ok(Self { model, seed_structures: seeds.valid, pair_ranges, warnings })
    }
}

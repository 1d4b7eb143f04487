//! `calmwalk calm merge`

use std::path::PathBuf;

use calm::build::BuildSettings;

use super::build::{report, stopped, write_mixture};
use super::campaign_updates::UpdateSource;
use crate::atomic_file::check_outputs;
use crate::cli::{CommandError, ExitStatus};
use crate::feature_variant::FeatureVariant;
use crate::loaded_model::LoadedModel;
use crate::mixture_build::{Merged, PartsMerge, projected};
use crate::mixture_files::MixtureFiles;
use crate::output::print;
use crate::signals::stop_token;

/// Merge the parts of a pass of `calmwalk calm build --part`
///
/// Run it when all parts of a pass are done: after pass 1 it finds the components, after pass 2 their covariances, and after pass 3
/// it writes the artifact. The result does not depend on the number of parts.
#[derive(Debug, clap::Args)]
pub struct CalmMergeArgs {
    /// GRACE model (kokkos.npz) of the build
    #[arg(long, value_name = "MODEL.npz")]
    model: PathBuf,
    /// The value of --output that the parts were run with
    #[arg(long, short, value_name = "CALM.npz")]
    output: PathBuf,
    /// After pass 3, also write a copy of the model with the new mixture, for LAMMPS and calmwalk
    #[arg(long, value_name = "MODEL.npz", conflicts_with = "feature_variant")]
    embed: Option<PathBuf>,
    /// After pass 3, also update the mixture with the accepted candidates of this campaign that have no label, as `calm build` does
    #[arg(long, value_name = "DIR")]
    campaign: Option<PathBuf>,
    /// The --feature-variant of the parts
    #[arg(long, value_name = "VARIANT")]
    feature_variant: Option<FeatureVariant>,
}

impl CalmMergeArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let outputs = std::iter::once(&self.output).chain(&self.embed).map(PathBuf::as_path);
        check_outputs(outputs, &[(&self.model, "the model")])?;
        let campaign = self.campaign.as_deref().map(UpdateSource::find).transpose()?;
        let model = LoadedModel::load(&self.model)?;
        let hash = model.identity(&self.model)?;
        let mut merge = PartsMerge::open(&self.output, &hash)?;
        let BuildSettings { seed, dimension, .. } = *merge.settings();
        let norms = match self.feature_variant {
            Some(FeatureVariant::Linear | FeatureVariant::Hidden) => 0,
            _ => model.basis().map_or(0, |(_, layers)| 1 + layers),
        };
        let dimension = dimension.saturating_sub(norms);
        let (model, projection, seed) = projected(&self.model, model, self.feature_variant, seed, dimension)?;
        match merge.run(model.symbols(), projection, seed)? {
            Merged::Pass(pass) => {
                print(|out| writeln!(out, "pass {pass} of 3 is merged; continue with --pass {}", pass + 1))?;
            }
            Merged::Mixture(mixture) => {
                let embed = self.embed.as_deref().map(|copy| (self.model.as_path(), copy));
                let files = MixtureFiles { embed, output: &self.output };
                let updates =
                    write_mixture(&mixture, files, &model.model.shared(), campaign.as_ref(), &stop_token()?)?;
                let Some(updates) = updates else { return Ok(stopped()) };
                merge.finish()?;
                report(&mixture, &self.output, &updates)?;
            }
        }
        Ok(ExitStatus::Done)
    }
}

//! The mixture of a new version.

use std::collections::HashSet;
use std::path::Path;

use calm::build::{ArtifactVersion, BuildSettings};
use calm::{Artifact, Projection};
use potentials::grace::GraceModel;
use store::Store;
use tokio_util::sync::CancellationToken;

use super::failure::RefitFailure;
use super::native::files;
use super::settings::RefitterConfig;
use crate::artifact_checks::check_sound;
use crate::exit_status::CommandError;
use crate::feature_variant::FeatureModel;
use crate::file_hash;
use crate::grace_projection::with_projection;
use crate::mixture_build::{BuildDefaults, MixtureBuild, PROJECTED, PassContext, projected};
use crate::mixture_files::{MixtureFiles, write_beside};
use crate::unlabelled_updates;

/// Builds the mixture of a model from the replay data and the labels that it was trained on, and updates it with the accepted
/// candidates that are not among them. `None` after a cancellation of `stop`.
///
/// # Errors
/// Refused: data that no sound mixture comes from. Failed: a full disk, the database.
pub async fn build(
    config: &RefitterConfig,
    store: &Store,
    (model_file, labels, output): (&Path, &Path, &Path),
    trained_on: &HashSet<i64>,
    stop: &CancellationToken,
) -> Result<Option<()>, RefitFailure> {
    let (found, projection, seed) = model(config, model_file)?;
    let settings = BuildSettings {
        dimension: projection.feature_dimension,
        seed: config.rng_seed,
        candidates: BuildDefaults::CANDIDATES.to_vec(),
        shard_size: BuildDefaults::SHARD_SIZE,
    };
    // The weight of replay data in the training is none of the mixture: its structures stand for those that they were drawn from.
    let mut data = files(&config.settings, labels)?;
    data.files.iter_mut().for_each(|file| file.weight = 1.0);
    let context = PassContext {
        model: found.clone(),
        files: data,
        shard_size: BuildDefaults::SHARD_SIZE,
        part: None,
        seed: config.rng_seed,
        threads: config.settings.threads(),
        max_feature_bytes: BuildDefaults::MAX_FEATURE_BYTES,
        stop: stop.clone(),
    };
    let hash = file_hash::hash(model_file).map_err(CommandError::failed)?;
    let beside = output.to_owned();
    let work = tokio::task::spawn_blocking(move || {
        let mut build = MixtureBuild::open(context, settings, hash, &projection, &beside, false)?;
        let built = build.run(projection, seed).map_err(RefitFailure::of_input)?;
        Ok::<_, RefitFailure>(built.map(|built| (build, built)))
    });
    let Some((build, built)) = work.await.map_err(CommandError::failed)?? else { return Ok(None) };
    let artifact = write_beside(&built, output)?;
    let original = Artifact::load(&artifact).map_err(CommandError::failed)?;
    check_sound(&original, output).map_err(RefitFailure::Refused)?;
    let updated = unlabelled_updates::apply_others(
        store,
        &found.model.shared(),
        original.mixture.clone(),
        trained_on,
        stop,
    )
    .await?;
    let Some(updated) = updated else { return Ok(None) };
    let version =
        ArtifactVersion::new(&artifact, &original.mixture, &updated.mixture).map_err(CommandError::failed)?;
    let files = MixtureFiles { embed: None, output };
    files.write_version(&version, &artifact, &updated.campaign)?;
    build.finish()?;
    Ok(Some(()))
}

/// The model with a projection of its features: its own, or that of its parent's artifact.
///
/// # Errors
/// Refused: a model whose features do not fit the projection. Failed: the parent's artifact.
fn model(
    config: &RefitterConfig,
    path: &Path,
) -> Result<(FeatureModel, Projection, Option<i64>), RefitFailure> {
    let mut model = GraceModel::load(path).map_err(RefitFailure::of_model)?;
    let is_its_own = model.projection().is_some();
    if !is_its_own {
        let projection = Projection::load(&config.parent_mixture.path).map_err(CommandError::input)?;
        model = with_projection(model, &projection).map_err(RefitFailure::refused)?;
    }
    let found = projected(path, model.into(), None, config.rng_seed, PROJECTED);
    let (found, projection, seed) = found.map_err(RefitFailure::of_input)?;
    Ok((found, projection, seed.filter(|_| is_its_own)))
}

//! Updates the mixture of a version of the potential with what the campaign has accepted since its training set was fixed.

use std::fs;
use std::io::Cursor;
use std::path::Path;
use std::sync::Arc;

use calm::Artifact;
use calm::build::ArtifactVersion;
use potentials::grace::GraceModel;
use store::{Fate, Store};
use tokio_util::sync::CancellationToken;

use crate::exit_status::CommandError;
use crate::mixture_files::open;
use crate::unlabelled_updates;

/// Candidates per read.
const CANDIDATES: u32 = 16;

/// Number of structures by what they did to a mixture.
#[derive(Clone, Copy, Debug, Default)]
pub struct MixtureUpdates {
    /// They updated it.
    pub applied: u64,
    /// It covered them already.
    pub covered: u64,
    /// They could not be evaluated or taken up.
    pub left_out: u64,
}

/// The file of an artifact after the updates, in decision order, by what the campaign has accepted after the decision `after`: the
/// same bytes without any update. `load` gives the model and the artifact, if they are needed. `None` after a cancellation of `stop`.
pub async fn updated_artifact(
    store: &Store,
    path: &Path,
    after: i64,
    load: impl FnOnce() -> Result<(Arc<GraceModel>, Artifact), CommandError>,
    stop: &CancellationToken,
) -> Result<Option<(Vec<u8>, MixtureUpdates)>, CommandError> {
    if !has_accepted(store, after).await? {
        return Ok(Some((read(path)?, MixtureUpdates::default())));
    }
    let (model, original) = load()?;
    let known = (1..=after).collect();
    let found =
        unlabelled_updates::apply_others(store, &model, original.mixture.clone(), &known, stop).await?;
    let Some(found) = found else { return Ok(None) };
    let updates = MixtureUpdates { applied: found.applied, covered: found.covered, left_out: found.left_out };
    if updates.applied == 0 {
        return Ok(Some((read(path)?, updates)));
    }
    let version =
        ArtifactVersion::new(path, &original.mixture, &found.mixture).map_err(CommandError::failed)?;
    let out = version.write_artifact(open(path)?, Cursor::new(Vec::new()), &found.campaign);
    Ok(Some((out.map_err(CommandError::failed)?.into_inner(), updates)))
}

/// Whether a structure of a biased walk was accepted after this decision.
async fn has_accepted(store: &Store, after: i64) -> Result<bool, CommandError> {
    let mut last = after;
    loop {
        let page = store.candidates(last, false, CANDIDATES).await?;
        if page.iter().any(|candidate| candidate.fate == Fate::Accepted) {
            return Ok(true);
        }
        let Some(end) = page.last() else { return Ok(false) };
        last = end.decision;
    }
}

/// The bytes of a file of a version.
pub fn read(path: &Path) -> Result<Vec<u8>, CommandError> {
    fs::read(path).map_err(|error| CommandError::Failed(format!("cannot read {}: {error}", path.display())))
}

//! Updates of a built mixture by the unlabelled candidates of a campaign (`--campaign`).

use std::path::Path;
use std::sync::Arc;

use calm::build::{ArtifactVersion, BuiltMixture};
use calm::{Artifact, Mixture};
use potentials::ModelWithFeatures;
use store::{Location, Store};
use tokio_util::sync::CancellationToken;

use crate::cli::{CommandError, block_on, campaign_location};
use crate::mixture_files::{MixtureFiles, write_beside};
use crate::output::count;
use crate::unlabelled_updates::{self, MixtureAfterUpdates};

/// The campaign from which the updates of a new mixture come.
pub(super) struct UpdateSource(Location);

impl UpdateSource {
    /// Opens the campaign of a directory or URL once, so that errors are found before hours of work.
    ///
    /// # Errors
    /// There is no campaign, or it never updates its mixture.
    pub(super) fn find(path: &Path) -> Result<Self, CommandError> {
        let found = Self(campaign_location::parse(path)?);
        block_on(found.check())??;
        Ok(found)
    }

    async fn check(&self) -> Result<(), CommandError> {
        let store = Store::open_read_only(&self.0).await?;
        let campaign = store.campaign().await;
        store.close().await;
        unlabelled_updates::updating_settings(&campaign?).map(drop)
    }

    /// Updates the mixture and writes its files. `model` computes the features. Returns what is said of the updates, or `None` if
    /// `stop` was cancelled before they ended.
    pub(super) fn write(
        &self,
        mixture: &BuiltMixture,
        files: MixtureFiles<'_>,
        model: &Arc<dyn ModelWithFeatures>,
        stop: &CancellationToken,
    ) -> Result<Option<String>, CommandError> {
        let built = write_beside(mixture, files.output)?;
        let original = Artifact::load(&built).map_err(CommandError::failed)?.mixture;
        let Some(found) = block_on(self.update(model, original.clone(), stop))?? else {
            return Ok(None);
        };
        let version =
            ArtifactVersion::new(&built, &original, &found.mixture).map_err(CommandError::failed)?;
        files.write_version(&version, &built, &found.campaign)?;
        Ok(Some(describe(&found)))
    }

    async fn update(
        &self,
        model: &Arc<dyn ModelWithFeatures>,
        original: Mixture,
        stop: &CancellationToken,
    ) -> Result<Option<MixtureAfterUpdates>, CommandError> {
        let store = Store::open_read_only(&self.0).await?;
        let found = unlabelled_updates::apply(&store, model, original, stop).await;
        store.close().await;
        found
    }
}

/// A line about the updates.
fn describe(found: &MixtureAfterUpdates) -> String {
    let MixtureAfterUpdates { campaign, applied, covered, left_out, .. } = found;
    let all = count(applied + covered + left_out, "accepted candidate");
    let were = |number: u64| if number == 1 { "was" } else { "were" };
    let covered = format!("{covered} {} covered already", were(*covered));
    let parts = match *left_out {
        0 => format!("{applied} updated the mixture and {covered}"),
        n => format!(
            "{applied} updated the mixture, {covered} and {n} {} left out (see the warnings)",
            were(n)
        ),
    };
    format!("campaign {campaign}: {all} without a label, of which {parts}\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn candidates_that_were_left_out_are_mentioned() {
        let mixture = Mixture::new(0, vec![vec![Arc::new(calm::Component::unknown_element(2))]]).unwrap();
        let found = |left_out| MixtureAfterUpdates {
            campaign: "x".into(),
            mixture: mixture.clone(),
            applied: 3,
            covered: 1,
            left_out,
        };
        let all = "campaign x: 4 accepted candidates without a label, of which 3 updated the mixture and 1 was covered already\n";
        assert_eq!(describe(&found(0)), all);
        let some = "campaign x: 6 accepted candidates without a label, of which 3 updated the mixture, 1 was covered already and 2 were left \
                    out (see the warnings)\n";
        assert_eq!(describe(&found(2)), some);
    }
}

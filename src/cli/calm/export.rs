//! `calmwalk calm export`

use std::path::{Path, PathBuf};
use std::sync::Arc;

use calm::build::ArtifactVersion;
use calm::{Artifact, Mixture};
use serde_json::Value;
use store::Store;
use tempfile::TempDir;

use crate::atomic_file::check_outputs;
use crate::cli::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::mixture_files::MixtureFiles;
use crate::output::{count, print};
use crate::replay::{self, RelocatedFilesArgs};
use crate::versions::{self, VersionOnDisk};

/// Write the mixture of a campaign, at any version, as a CALM artifact
///
/// The artifact is a copy of the campaign's original one with the covariances and counts that updates have changed since. Use it to grade
/// structures by what the campaign has covered, with calm score, gracemaker or LAMMPS, or to start another campaign. Only reads, and
/// works while the campaign runs.
///
/// The store has the newest version. calmwalk computes earlier ones from the accepted candidates, and checks that every update is as
/// recorded. Version 0 is the original mixture. The mixture of a new version of the potential has the number that the decision log gives
/// it. Numbers are rounded to single precision, as in every artifact.
#[derive(Debug, clap::Args)]
pub struct CalmExportArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Version of the mixture, as in the decision log [default: the newest]
    #[arg(long, value_name = "V")]
    version: Option<u64>,
    /// File for the artifact; an existing file is replaced
    #[arg(long, short, value_name = "OUT.npz")]
    output: PathBuf,
    /// Also write a copy of the campaign's model with this mixture, for LAMMPS and calmwalk
    #[arg(long, value_name = "MODEL.npz")]
    embed: Option<PathBuf>,
    #[command(flatten)]
    moved: RelocatedFilesArgs,
}

/// A version of a campaign's mixture and the files that it belongs to.
struct Version {
    campaign: String,
    newest: u64,
    artifact: PathBuf,
    /// With --embed.
    model: Option<PathBuf>,
    original: Artifact,
    mixture: Arc<Mixture>,
    /// The files above, if they are those of a version of the potential.
    _copies: TempDir,
}

impl CalmExportArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let found = block_on(self.read())??;
        let version = ArtifactVersion::new(&found.artifact, &found.original.mixture, &found.mixture);
        let version = version.map_err(CommandError::input)?;
        let files =
            MixtureFiles { embed: found.model.as_deref().zip(self.embed.as_deref()), output: &self.output };
        files.write_version(&version, &found.artifact, &found.campaign)?;
        self.report(&found)?;
        Ok(ExitStatus::Done)
    }

    async fn read(&self) -> Result<Version, CommandError> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let found = self.read_from(&store).await;
        store.close().await;
        found
    }

    async fn read_from(&self, store: &Store) -> Result<Version, CommandError> {
        let campaign = store.campaign().await?;
        let (resolved, files) = (replay::resolved(&campaign)?, store.grade_files().await?);
        if !matches!(resolved["files"][replay::ARTIFACT], Value::String(_)) {
            return Err(CommandError::Input(
                "the campaign began with the mixture of its model, which it never changes: expected one with calm.artifact"
                    .to_owned(),
            ));
        }
        let newest = store.newest_mixture().await?;
        let wanted = self.version.unwrap_or(newest.version);
        if wanted > newest.version {
            return Err(CommandError::Input(format!(
                "--version {wanted}: the mixture of the campaign has versions 0 to {} so far",
                newest.version
            )));
        }
        let copies = tempfile::tempdir().map_err(CommandError::failed)?;
        let begin = versions::taken_up_before(store, wanted).await?;
        let (artifact, model) = match &begin {
            Some(decision) => {
                let found = VersionOnDisk::taken_up_by(store, decision, copies.path()).await?;
                (found.mixture.path, self.embed.as_ref().map(|_| found.model.path))
            }
            None => {
                let find = |key| replay::find_one(key, &resolved, &files, &self.moved);
                (find(replay::ARTIFACT)?, self.embed.as_ref().map(|_| find(replay::MODEL)).transpose()?)
            }
        };
        self.check_outputs(&artifact, model.as_deref())?;
        let original = Artifact::load(&artifact).map_err(CommandError::input)?;
        let mixture = if wanted == begin.as_ref().map_or(0, |decision| decision.mixture_version) {
            Arc::new(original.mixture.at_version(wanted))
        } else if wanted == newest.version {
            let stored = newest.components.iter();
            let stored = stored.map(|one| (one.element as usize, one.slot as usize, &one.bytes[..]));
            let restored = original.mixture.restored(wanted, stored);
            Arc::new(restored.map_err(|error| CommandError::Failed(format!("damaged database: {error}")))?)
        } else {
            replay::mixture_of(store, wanted, &original, begin.as_ref()).await?
        };
        let (campaign, newest) = (campaign.id.to_string(), newest.version);
        Ok(Version { campaign, newest, artifact, model, original, mixture, _copies: copies })
    }

    fn check_outputs(&self, artifact: &Path, model: Option<&Path>) -> Result<(), CommandError> {
        let model = model.map(|path| (path, "the model of the campaign"));
        let inputs: Vec<_> =
            std::iter::once((artifact, "the artifact of the campaign")).chain(model).collect();
        check_outputs(std::iter::once(&self.output).chain(&self.embed).map(PathBuf::as_path), &inputs)
    }

    fn report(&self, found: &Version) -> Result<(), CommandError> {
        let Version { newest, original, mixture, .. } = found;
        let pairs = original.mixture.iter().zip(mixture.iter());
        let changed = pairs.filter(|((.., before), (.., now))| before != now).count();
        let all = count(mixture.iter().count() as u64, "component");
        print(|out| {
            writeln!(
                out,
                "mixture version {} of 0 to {newest}: {changed} of {all} changed",
                mixture.version()
            )?;
            let outputs = std::iter::once(&self.output).chain(&self.embed);
            outputs.into_iter().try_for_each(|path| writeln!(out, "wrote {}", path.display()))
        })
    }
}

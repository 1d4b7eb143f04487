//! `calmwalk versions … roll-back`

use std::fs;
use std::io::{self, Cursor, Write};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use calm::build::ArtifactVersion;
use orchestrator::selector::CampaignMode;
use potentials::ModelWithFeatures;
use serde_json::json;
use store::{
    CampaignLock, Fate, Location, Store, VersionFiles, VersionRecord, VersionState, unix_milliseconds,
};
use tokio_util::sync::CancellationToken;

use super::errors::figures_of_same_model;
use super::files::VersionSource;
use super::{CommandError, ExitStatus, KnownVersions, block_on, registered};
use crate::mixture_files::open;
use crate::output::{count, print, print_json, warn_if_unencrypted};
use crate::replay::RelocatedFilesArgs;
use crate::signals::stop_token;
use crate::unlabelled_updates;

/// The name of the lock holder in messages of other processes.
const HOLDER: &str = "calmwalk versions roll-back";
/// Candidates per read.
const CANDIDATES: u32 = 16;

/// Go back to an earlier version: register its files as a new version
///
/// Registers the model of N under the next number; later refits train it further. Updates the mixture of N with the structures that the
/// campaign has accepted since N's training set was fixed, so that walks do not find them again. Labels, decisions and other versions
/// stay.
///
/// A reproducible campaign must not be running: the next calmwalk run switches to the version and restarts all walks from their seed
/// structures. A running live campaign switches within seconds.
#[derive(Debug, clap::Args)]
pub struct VersionsRollBackArgs {
    /// Number of the version to go back to; 0 is the potential of the configuration
    #[arg(value_name = "N")]
    number: u32,
    /// Only show what would be registered
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    moved: RelocatedFilesArgs,
}

/// A new version with the files of an earlier one.
struct RolledBack {
    number: u32,
    mode: CampaignMode,
    /// What the structures accepted since did to the mixture.
    updates: Updates,
}

/// Number of structures by what they did to the mixture.
#[derive(Clone, Copy, Default)]
struct Updates {
    applied: u64,
    covered: u64,
    left_out: u64,
}

impl VersionsRollBackArgs {
    pub fn run(self, location: &Location, json: bool) -> Result<ExitStatus, CommandError> {
        warn_if_unencrypted(location);
        let stop = stop_token()?;
        let Some(done) = block_on(self.roll_back(location, &stop))?? else {
            return Ok(ExitStatus::Interrupted);
        };
        if json {
            let Updates { applied, covered, left_out } = done.updates;
            let candidates = json!({ "applied": applied, "covered": covered, "left_out": left_out });
            print_json(&json!({
                "version": done.number, "parent": self.number, "candidates": candidates, "dry_run": self.dry_run,
            }))?;
        } else {
            print(|out| done.write(out, self.number, self.dry_run))?;
        }
        Ok(ExitStatus::Done)
    }

    /// `None` after a cancellation of `stop`.
    async fn roll_back(
        &self,
        location: &Location,
        stop: &CancellationToken,
    ) -> Result<Option<RolledBack>, CommandError> {
        let store = match self.dry_run {
            true => Store::open_read_only(location).await?,
            false => Store::open(location).await?,
        };
        let done = self.register(&store, location, stop).await;
        store.close().await;
        done
    }

    async fn register(
        &self,
        store: &Store,
        location: &Location,
        stop: &CancellationToken,
    ) -> Result<Option<RolledBack>, CommandError> {
        let (number, begun) = (self.number, Instant::now());
        let mode = match store.campaign().await?.mode == CampaignMode::Live.name() {
            true => CampaignMode::Live,
            false => CampaignMode::Reproducible,
        };
        let _lock = match mode {
            CampaignMode::Reproducible if !self.dry_run => {
                Some(CampaignLock::acquire_at(location, HOLDER).await?)
            }
            CampaignMode::Reproducible | CampaignMode::Live => None,
        };
        let known = KnownVersions::read(store).await?;
        refuse_newest(&known, number)?;
        let versions = &known.versions;
        let source = (number > 0).then(|| registered(versions, number)).transpose()?;
        let last_decision = source.map_or(0, |source| source.last_decision);
        let files = VersionSource::find(store, number, &self.moved).await?;
        let Some((mixture, updates)) = mixture(store, &files, last_decision, stop).await? else {
            return Ok(None);
        };
        let files = VersionFiles { model: read(&files.model.path)?, mixture };
        let [model_hash, mixture_hash] = files.hashes();
        let record = VersionRecord {
            number: VersionRecord::next_number(versions),
            parent: number,
            state: VersionState::Registered,
            reason: String::new(),
            method: VersionRecord::ROLLBACK.to_owned(),
            // Refits count from the last attempt.
            structures: versions.iter().map(|version| version.structures).max().unwrap_or(0),
            last_decision,
            labels: source.map_or(0, |source| source.labels),
            model_hash,
            mixture_hash,
            figures: figures_of_same_model(versions, number),
            seconds: begun.elapsed().as_secs_f64(),
            core_hours: 0.0,
            time: unix_milliseconds(),
        };
        if !self.dry_run {
            store.add_version(&record, Some(&files)).await?;
        }
        Ok(Some(RolledBack { number: record.number, mode, updates }))
    }
}

/// Refuses to go back to the newest version, or to one that it is already.
fn refuse_newest(known: &KnownVersions, number: u32) -> Result<(), CommandError> {
    let newest = known.newest();
    let current = newest.map_or(0, |newest| newest.number);
    if current == number {
        return Err(CommandError::Input(format!(
            "version {number} is the newest one already: expected an earlier version"
        )));
    }
    let is_same =
        newest.is_some_and(|newest| newest.method == VersionRecord::ROLLBACK && newest.parent == number);
    match is_same {
        true => {
            Err(CommandError::Input(format!("version {current}, the newest one, is version {number} again")))
        }
        false => Ok(()),
    }
}

/// The artifact of a version, updated with what the campaign has accepted after this decision. `None` after a cancellation of
/// `stop`.
async fn mixture(
    store: &Store,
    files: &VersionSource,
    after: i64,
    stop: &CancellationToken,
) -> Result<Option<(Vec<u8>, Updates)>, CommandError> {
    let path = &files.mixture.path;
    if !has_accepted(store, after).await? {
        return Ok(Some((read(path)?, Updates::default())));
    }
    let model: Arc<dyn ModelWithFeatures> = files.model_files()?.load()?;
    let original = files.artifact()?;
    let covered = (1..=after).collect();
    let found =
        unlabelled_updates::apply_others(store, &model, original.mixture.clone(), &covered, stop).await?;
    let Some(found) = found else { return Ok(None) };
    let updates = Updates { applied: found.applied, covered: found.covered, left_out: found.left_out };
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

fn read(path: &Path) -> Result<Vec<u8>, CommandError> {
    fs::read(path).map_err(|error| CommandError::Failed(format!("cannot read {}: {error}", path.display())))
}

impl RolledBack {
    fn write(&self, out: &mut dyn Write, again: u32, dry_run: bool) -> io::Result<()> {
        let Self { number, mode, updates } = self;
        let Updates { applied, covered, left_out } = *updates;
        let registered = if dry_run { "would register" } else { "registered" };
        writeln!(out, "{registered} version {number}: version {again} again")?;
        let all = applied + covered + left_out;
        if all > 0 {
            let left_out = match left_out {
                0 => String::new(),
                left_out => format!(", {left_out} left out (see the warnings)"),
            };
            let all = count(all, "structure");
            writeln!(
                out,
                "{all} accepted since: {applied} updated its mixture, {covered} covered already{left_out}"
            )?;
        }
        if dry_run {
            return writeln!(out, "nothing was changed");
        }
        match mode {
            CampaignMode::Reproducible => {
                writeln!(out, "the next calmwalk run restarts all walks from their seed structures with it")
            }
            CampaignMode::Live => {
                writeln!(
                    out,
                    "all walks restart from their seed structures with it: at once if the campaign runs, else at the next calmwalk run"
                )
            }
        }
    }
}

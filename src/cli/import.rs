//! `calmwalk import`

use std::path::{Path, PathBuf};

use atoms::{FileError, Structure};
use serde_json::json;
use store::records::{Label, Protocol};
use store::{CampaignLock, ImportCounts, QueuedImports, Store, unix_milliseconds};
use wire::ContentHash;
use workers::labeller::LabelBounds;

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::label_setup;
use crate::output::{count, print, print_json};
use crate::xyz_reader::{XyzReader, label};

/// Import labelled structures, or structures for labelling
///
/// Imports labels: each frame needs energy and forces, named energy and forces or REF_energy and REF_forces; stress is optional. If one
/// frame is invalid or exceeds label.max_force, max_stress or max_energy_per_atom, imports nothing from any file. You can safely import
/// a file again: known structures do not change, and a different label for a labelled structure is stored as a check.
///
/// With --queue, frames need no labels. The structures join the label queue of the current protocol, behind candidates of the same
/// priority. `calmwalk export --imported` exports them. Structures that have a label or wait for one stay as they are.
///
/// The campaign must not be running: imported structures change which candidates are duplicates, and the decision log records from
/// where on.
#[derive(Debug, clap::Args)]
pub struct ImportArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Extended XYZ files
    #[arg(value_name = "FILES", required = true)]
    files: Vec<PathBuf>,
    /// Label protocol of the structures; a new name creates a protocol [default: current protocol of the campaign]
    #[arg(long, value_name = "NAME")]
    protocol: Option<String>,
    /// Queue the structures for labelling, such as those of calmwalk select
    #[arg(long, conflicts_with = "protocol")]
    queue: bool,
    /// Priority in the queue; higher values are labelled first. Candidates have 10, control frames 0
    #[arg(long, value_name = "N", requires = "queue", default_value_t = 0, allow_negative_numbers = true)]
    priority: i32,
    /// Read and check the files without importing anything
    #[arg(long)]
    dry_run: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The frames of one file with their numbers in it.
struct ImportedFile {
    name: String,
    frames: Vec<(u64, Structure, Label)>,
    /// First line of each frame, from 1.
    lines: Vec<usize>,
}

impl ImportedFile {
    /// Applies the campaign's bounds for its own labels.
    fn check(&self, bounds: &LabelBounds) -> Result<(), CommandError> {
        for ((_, _, label), line) in self.frames.iter().zip(&self.lines) {
            if let Some(problem) = bounds.rejects(label.energy, &label.forces, label.stress.as_ref()) {
                return Err(CommandError::Input(format!(
                    "{}:{line}: {problem}: nothing was imported; correct the label, remove the frame, or raise the limit if it is \
                     correct",
                    self.name
                )));
            }
        }
        Ok(())
    }
}

impl ImportArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        if self.queue {
            let structures: Vec<_> =
                self.files.iter().map(|path| read_unlabelled(path)).collect::<Result<_, _>>()?;
            let structures = structures.concat();
            if self.dry_run {
                return self.print_dry_run(structures.len());
            }
            let QueuedImports { queued, known } = block_on(self.queue_structures(&structures))??;
            if self.json {
                print_json(&json!({ "queued": queued, "known": known, "dry_run": false }))?;
                return Ok(ExitStatus::Done);
            }
            print(|out| {
                writeln!(out, "queued {} for labelling; {known} already known", count(queued, "structure"))
            })?;
            return Ok(ExitStatus::Done);
        }
        let files: Vec<_> = self.files.iter().map(|path| read(path)).collect::<Result<_, _>>()?;
        if self.dry_run {
            block_on(self.check(&files))??;
            return self.print_dry_run(files.iter().map(|file| file.frames.len()).sum());
        }
        let (protocol, imported) = block_on(self.import(&files))??;
        let ImportCounts { labels, checks, known } = imported;
        if self.json {
            let name = &protocol.name;
            print_json(
                &json!({ "labels": labels, "checks": checks, "known": known, "protocol": name, "dry_run": false }),
            )?;
            return Ok(ExitStatus::Done);
        }
        print(|out| {
            let name = &protocol.name;
            let (labels, checks) = (count(labels, "label"), count(checks, "check"));
            writeln!(out, "imported {labels} and {checks} of protocol '{name}'; {known} already known")
        })?;
        Ok(ExitStatus::Done)
    }

    /// Applies the campaign's bounds for its own labels, and changes nothing.
    async fn check(&self, files: &[ImportedFile]) -> Result<(), CommandError> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let bounds = label_setup::read_bounds(&store).await?;
        store.close().await;
        files.iter().try_for_each(|file| file.check(&bounds))
    }

    fn print_dry_run(&self, frames: usize) -> Result<ExitStatus, CommandError> {
        if self.json {
            print_json(&json!({ "frames": frames, "dry_run": true }))?;
        } else {
            print(|out| {
                writeln!(out, "{} can be imported; nothing was changed", count(frames as u64, "frame"))
            })?;
        }
        Ok(ExitStatus::Done)
    }

    async fn queue_structures(
        &self,
        structures: &[(String, u64, Structure)],
    ) -> Result<QueuedImports, CommandError> {
        let location = self.location.get()?;
        let store = Store::open(&location).await?;
        // Imported structures change which candidates are duplicates: exclude a run.
        let _lock = CampaignLock::acquire_at(&location, "calmwalk import").await?;
        current_protocol(&store).await?;
        let queued = store.queue_imports(structures, self.priority, unix_milliseconds()).await?;
        store.close().await;
        Ok(queued)
    }

    async fn import(&self, files: &[ImportedFile]) -> Result<(Protocol, ImportCounts), CommandError> {
        let location = self.location.get()?;
        let store = Store::open(&location).await?;
        // Imported structures change which candidates are duplicates: exclude a run.
        let _lock = CampaignLock::acquire_at(&location, "calmwalk import").await?;
        let bounds = label_setup::read_bounds(&store).await?;
        files.iter().try_for_each(|file| file.check(&bounds))?;
        let protocol = match &self.protocol {
            Some(name) => protocol_named(&store, name).await?,
            None => current_protocol(&store).await?,
        };
        let mut all = ImportCounts::default();
        for ImportedFile { name, frames, .. } in files {
            let imported = store.import(protocol.hash, name, frames, unix_milliseconds()).await?;
            all.labels += imported.labels;
            all.checks += imported.checks;
            all.known += imported.known;
        }
        store.close().await;
        Ok((protocol, all))
    }
}

fn read(path: &Path) -> Result<ImportedFile, CommandError> {
    let name = path.display().to_string();
    let (mut frames, mut lines) = (Vec::new(), Vec::new());
    for (number, frame) in XyzReader::open(path).map_err(CommandError::input)?.enumerate() {
        let frame = frame.map_err(CommandError::input)?;
        let label =
            label(&frame).map_err(|error| CommandError::Input(format!("{name}:{}: {error}", frame.line)))?;
        frames.push((number as u64, frame.structure, label));
        lines.push(frame.line);
    }
    if frames.is_empty() {
        return Err(CommandError::input(FileError::Empty(path.to_owned())));
    }
    Ok(ImportedFile { name, frames, lines })
}

/// The structures of a file with its name and their numbers in it.
fn read_unlabelled(path: &Path) -> Result<Vec<(String, u64, Structure)>, CommandError> {
    let name = path.display().to_string();
    let mut structures = Vec::new();
    for (number, frame) in XyzReader::open(path).map_err(CommandError::input)?.enumerate() {
        let frame = frame.map_err(CommandError::input)?;
        let wrong = |error| CommandError::Input(format!("{name}:{}: {error}", frame.line));
        frame.structure.validate().map_err(wrong)?;
        structures.push((name.clone(), number as u64, frame.structure));
    }
    if structures.is_empty() {
        return Err(CommandError::input(FileError::Empty(path.to_owned())));
    }
    Ok(structures)
}

/// The current protocol of the campaign.
async fn current_protocol(store: &Store) -> Result<Protocol, CommandError> {
    store.protocol_in_force().await?.ok_or_else(|| {
        CommandError::Input(
            "the campaign has no label protocol yet: start it with calmwalk run first, or use --protocol"
                .to_owned(),
        )
    })
}

/// The protocol of this name, created if it does not exist.
async fn protocol_named(store: &Store, name: &str) -> Result<Protocol, CommandError> {
    if let Some(known) = store.protocols().await?.into_iter().find(|protocol| protocol.name == name) {
        return Ok(known);
    }
    if name.trim().is_empty() {
        return Err(CommandError::Input("--protocol is empty; expected a name".to_owned()));
    }
    let settings = serde_json::json!({ "method": "import" });
    let hash = ContentHash(*blake3::hash(format!("calmwalk import protocol {name}").as_bytes()).as_bytes());
    let protocol = Protocol { hash, name: name.to_owned(), settings };
    store.register_protocol(&protocol, unix_milliseconds()).await?;
    Ok(protocol)
}

//! `calmwalk import`

use std::path::{Path, PathBuf};

use atoms::extxyz::{Frame, Labels};
use atoms::{FileError, Structure};
use store::records::{Label, LabelDetails, Protocol};
use store::{CampaignLock, ImportCounts, Store, unix_milliseconds};
use wire::ContentHash;
use workers::labeller::LabelBounds;

use super::{CampaignLocation, Ended, Failure, block_on};
use crate::frames::Frames;
use crate::labelling;
use crate::output::{count, print};

/// Take in labelled structures that exist already
///
/// Every frame needs energy and forces, as energy and forces or REF_energy and REF_forces; stress is taken if there is
/// one. If one frame is not right, or beyond the bounds of label.largest_force, largest_stress and largest_energy, nothing is taken from any
/// file. An import may be repeated: what is known is left as
/// it is, and other numbers for a structure that has its label are kept as checks beside it.
///
/// Not while the campaign runs: what is known decides what is a duplicate, so it changes between two runs only, and the
/// decision log says when.
#[derive(Debug, clap::Args)]
pub struct Import {
    #[command(flatten)]
    location: CampaignLocation,
    /// Extended XYZ
    #[arg(value_name = "FILES", required = true)]
    files: Vec<PathBuf>,
    /// Protocol by which they were labelled; a new name makes a new protocol [default: that of the campaign]
    #[arg(long, value_name = "NAME")]
    protocol: Option<String>,
}

/// Frames of one file, each with its number in it.
struct File {
    name: String,
    frames: Vec<(u64, Structure, Label)>,
    /// The line where each frame begins, from 1.
    lines: Vec<usize>,
}

impl File {
    /// Labels beyond the campaign's bounds are no more believed than those that it makes.
    fn check(&self, bounds: &LabelBounds) -> Result<(), Failure> {
        for ((_, _, label), line) in self.frames.iter().zip(&self.lines) {
            if let Some(problem) = bounds.refuses(label.energy, &label.forces, label.stress.as_ref()) {
                return Err(Failure::Input(format!(
                    "{}:{line}: {problem}: nothing is imported; correct the label or leave the frame out, or raise the key if it is \
                     right",
                    self.name
                )));
            }
        }
        Ok(())
    }
}

impl Import {
    pub fn run(self) -> Result<Ended, Failure> {
        let files: Vec<_> = self.files.iter().map(|path| read(path)).collect::<Result<_, _>>()?;
        let (protocol, imported) = block_on(self.import(&files))??;
        let ImportCounts { labels, checks, known } = imported;
        print(|out| {
            let name = &protocol.name;
            let (labels, checks) = (count(labels, "label"), count(checks, "check"));
            writeln!(out, "{labels}, {checks}, {known} known already, by protocol '{name}'")
        })?;
        Ok(Ended::Done)
    }

    async fn import(&self, files: &[File]) -> Result<(Protocol, ImportCounts), Failure> {
        let location = self.location.get()?;
        let store = Store::open(&location).await?;
        // What is known decides what is a duplicate: it changes between two runs, not within one.
        let _lock = CampaignLock::acquire_at(&location, "calmwalk import").await?;
        let bounds = labelling::bounds(&store).await?;
        files.iter().try_for_each(|file| file.check(&bounds))?;
        let protocol = match &self.protocol {
            Some(name) => protocol_named(&store, name).await?,
            None => own_protocol(&store).await?,
        };
        let mut all = ImportCounts::default();
        for File { name, frames, .. } in files {
            let imported = store.import(protocol.hash, name, frames, unix_milliseconds()).await?;
            all.labels += imported.labels;
            all.checks += imported.checks;
            all.known += imported.known;
        }
        store.close().await;
        Ok((protocol, all))
    }
}

fn read(path: &Path) -> Result<File, Failure> {
    let name = path.display().to_string();
    let (mut frames, mut lines) = (Vec::new(), Vec::new());
    for (number, frame) in Frames::open(path).map_err(Failure::input)?.enumerate() {
        let frame = frame.map_err(Failure::input)?;
        let label =
            label(&frame).map_err(|error| Failure::Input(format!("{name}:{}: {error}", frame.line)))?;
        frames.push((number as u64, frame.structure, label));
        lines.push(frame.line);
    }
    if frames.is_empty() {
        return Err(Failure::input(FileError::Empty(path.to_owned())));
    }
    Ok(File { name, frames, lines })
}

fn label(frame: &Frame) -> Result<Label, String> {
    match frame
        .labels()
        .map_err(|error| format!("{} is {}, expected {}", error.key, error.found, error.expected))?
    {
        Labels { energy: Some(energy), forces: Some(forces), stress } => {
            Ok(Label { energy, forces, stress, details: LabelDetails::default() })
        }
        Labels { energy, .. } => {
            let missing = if energy.is_none() { "energy" } else { "forces" };
            Err(format!("the frame has no {missing}: expected {missing} or REF_{missing}"))
        }
    }
}

/// The protocol by which the campaign itself labels.
async fn own_protocol(store: &Store) -> Result<Protocol, Failure> {
    store.protocol_in_force().await?.ok_or_else(|| {
        Failure::Input(
            "the campaign has no label protocol yet: run it first, or name one with --protocol".to_owned(),
        )
    })
}

/// The protocol of that name, made if the campaign has none so named.
async fn protocol_named(store: &Store, name: &str) -> Result<Protocol, Failure> {
    if let Some(known) = store.protocols().await?.into_iter().find(|protocol| protocol.name == name) {
        return Ok(known);
    }
    if name.trim().is_empty() {
        return Err(Failure::Input("--protocol is empty; expected a name".to_owned()));
    }
    let settings = serde_json::json!({ "method": "import" });
    let hash = ContentHash(*blake3::hash(format!("calmwalk import protocol {name}").as_bytes()).as_bytes());
    let protocol = Protocol { hash, name: name.to_owned(), settings };
    store.register_protocol(&protocol, unix_milliseconds()).await?;
    Ok(protocol)
}

//! `calmwalk export`

use std::io::Write;
use std::path::PathBuf;

use atoms::extxyz::{Column, Entries, Frame, Keys, Labels, Value, write_frame};
use store::records::Protocol;
use store::{DATABASE, ExportFilter, ExportRow, ExportSource, LOCK, Store};

use super::{CampaignLocation, Ended, Failure, block_on};
use crate::output::{Bar, print};
use crate::whole_file::{WholeFile, cannot_write, refuse_to_replace};

/// Structures read at a time.
const PAGE: u32 = 200;

const BAR: &str = "{spinner} {pos} structures";

/// Write the labelled structures as extended XYZ
///
/// Structures stand in the order of the decisions, whatever the order in which their labels came: the same campaign
/// gives the same bytes. Beside the label each has candidate_id, seed_structure, walk, segment, step, origin,
/// mixture_version (after the decision), mixture_version_seen (by the walker), protocol, protocol_hash and
/// relative_volume (V/V₀), and the columns gamma and gamma_nbr under the ORIGINAL mixture. Imported structures have
/// source_file and source_frame (from 0) instead. Where the calculation gives them there are energy_without_smearing (eV),
/// the cell's magnetic moment magmom and the column magmoms (μ_B).
#[derive(Debug, clap::Args)]
pub struct Export {
    #[command(flatten)]
    location: CampaignLocation,
    /// File to write; an existing one is replaced when all is written
    #[arg(long, short, value_name = "FILE.extxyz")]
    output: PathBuf,
    /// Names of energy, forces and stress
    #[arg(long, value_enum, default_value_t = KeyNames::Ase)]
    keys: KeyNames,
    /// Add the frames of control walks
    #[arg(long)]
    control: bool,
    /// Add the structures that were imported, behind the others
    #[arg(long)]
    imported: bool,
    /// Labels of this protocol; needed if there are labels of several
    #[arg(long, value_name = "NAME")]
    protocol: Option<String>,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum KeyNames {
    /// energy, forces, stress
    Ase,
    /// REF_energy, REF_forces, REF_stress
    Mace,
    /// as ase, with the energy also as free_energy
    Grace,
}

/// What an export came to.
#[derive(Default)]
struct Count {
    frames: u64,
    without_stress: u64,
}

impl Export {
    pub fn run(self) -> Result<Ended, Failure> {
        let (count, labels) = block_on(self.export())??;
        if matches!(self.keys, KeyNames::Grace) && (1..count.frames).contains(&count.without_stress) {
            let (without, frames) = (count.without_stress, count.frames);
            let warning = "have no stress: gracemaker will then use none of the file";
            let _ = writeln!(std::io::stderr(), "{without} of the {frames} structures {warning}");
        }
        print(|out| {
            writeln!(out, "{} structures in {}", count.frames, self.output.display())?;
            let store::Labels { queued, leased, failed, dropped, .. } = labels;
            if queued + leased + failed + dropped == 0 {
                return writeln!(out, "every accepted structure is labelled");
            }
            let waiting = queued + leased;
            writeln!(
                out,
                "accepted without a label: {waiting} not labelled yet, {failed} failed, {dropped} dropped"
            )
        })?;
        Ok(Ended::Done)
    }

    async fn export(&self) -> Result<(Count, store::Labels), Failure> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let protocol = self.choose_protocol(&store).await?;
        let filter = self.filter(&protocol);
        let files = [DATABASE.to_owned(), format!("{DATABASE}-wal"), LOCK.to_owned()];
        let [database, log, lock] = files.map(|name| self.location.location.join(name));
        let own = [&database, &log, &lock].map(|file| (file.as_path(), "a file of the campaign itself"));
        refuse_to_replace(&self.output, own)?;
        let mut output = WholeFile::create(&self.output)?;
        let (mut count, mut last, bar) = (Count::default(), None, Bar::new(None, BAR));
        loop {
            let page = store.labelled(&filter, last, PAGE).await?;
            let Some(row) = page.last() else { break };
            last = Some(row.place);
            for row in page {
                count.frames += 1;
                count.without_stress += u64::from(row.label.stress.is_none());
                let frame = frame(row, self.keys.into());
                write_frame(&mut output, &frame).map_err(|error| cannot_write(&self.output, error))?;
            }
            bar.set(count.frames, String::new);
        }
        output.finish()?;
        let labels = store.status().await?.labels;
        store.close().await;
        Ok((count, labels))
    }

    fn filter(&self, protocol: &Protocol) -> ExportFilter {
        let Self { control, imported, .. } = *self;
        ExportFilter { protocol: protocol.hash, biased: true, control, imported }
    }

    /// The protocol asked for, or the only one that has labels of what is exported.
    async fn choose_protocol(&self, store: &Store) -> Result<Protocol, Failure> {
        let protocols = store.protocols().await?;
        let names = |protocols: &[Protocol]| {
            let names: Vec<_> = protocols.iter().map(|protocol| format!("'{}'", protocol.name)).collect();
            names.join(", ")
        };
        let mut with_labels = Vec::new();
        for protocol in &protocols {
            let wanted = self.protocol.as_ref().is_none_or(|name| *name == protocol.name);
            if wanted && !store.labelled(&self.filter(protocol), None, 1).await?.is_empty() {
                with_labels.push(protocol.clone());
            }
        }
        match (with_labels.as_slice(), &self.protocol) {
            ([protocol], _) => Ok(protocol.clone()),
            ([], Some(name)) if !protocols.iter().any(|protocol| protocol.name == *name) => {
                Err(Failure::Input(format!(
                    "the campaign has no protocol '{name}'; it has {}",
                    names(&protocols)
                )))
            }
            ([], _) => Err(Failure::Input(self.nothing_to_export(&store.status().await?))),
            (several, _) => Err(Failure::Input(format!(
                "there are labels of several protocols, which do not belong in one file: choose one with --protocol \
                 ({})",
                names(several)
            ))),
        }
    }

    fn nothing_to_export(&self, status: &store::Status) -> String {
        let store::Labels { queued, leased, failed, dropped, .. } = status.labels;
        let imported =
            if self.imported || status.imported == 0 { "" } else { "; --imported adds what was imported" };
        format!(
            "nothing to export: no structure has a label ({} not labelled yet, {failed} failed, {dropped} \
             dropped){imported}",
            queued + leased
        )
    }
}

impl From<KeyNames> for Keys {
    fn from(names: KeyNames) -> Self {
        match names {
            KeyNames::Ase => Self::Ase,
            KeyNames::Mace => Self::Mace,
            KeyNames::Grace => Self::Grace,
        }
    }
}

fn frame(row: ExportRow, keys: Keys) -> Frame {
    let mut frame = Frame::from(row.structure);
    let label = row.label;
    let labels = Labels { energy: Some(label.energy), forces: Some(label.forces), stress: label.stress };
    frame.set_labels(&labels, keys);
    let scalars = |values| Column { width: 1, entries: Entries::Real(values) };
    let details = label.details;
    if let Some(moments) = details.magnetic_moments {
        frame.arrays.insert("magmoms".to_owned(), scalars(moments));
    }
    let mut info = |key: &str, value: Value| frame.info.insert(key.to_owned(), value);
    for (key, number) in
        [("energy_without_smearing", details.energy_without_smearing), ("magmom", details.magnetisation)]
    {
        if let Some(number) = number {
            info(key, number.into());
        }
    }
    info("protocol", row.protocol_name.into());
    info("protocol_hash", row.protocol.to_string().chars().take(16).collect::<String>().into());
    match row.source {
        ExportSource::Candidate {
            id,
            seed_structure_name,
            origin,
            mixture_version_after,
            block,
            original,
            ..
        } => {
            let view = block.view();
            info("candidate_id", id.into());
            info("seed_structure", seed_structure_name.into());
            info("walk", i64::from(view.id().walk.0).into());
            info("segment", i64::from(view.id().segment).into());
            info("step", whole(view.id().step));
            info("origin", origin.name().into());
            info("mixture_version", whole(mixture_version_after));
            info("mixture_version_seen", whole(view.mixture_version()));
            info("relative_volume", view.relative_volume().into());
            frame.arrays.insert("gamma".to_owned(), scalars(original.gamma));
            frame.arrays.insert("gamma_nbr".to_owned(), scalars(original.gamma_nbr));
        }
        ExportSource::Import { file, frame } => {
            info("origin", "imported".into());
            info("source_file", file.into());
            info("source_frame", whole(frame));
        }
    }
    frame
}

fn whole(number: u64) -> Value {
    Value::Int(i64::try_from(number).unwrap_or(i64::MAX))
}

//! `calmwalk export`

pub mod frame;
mod split;

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::path::PathBuf;

use atoms::extxyz::{Keys, write_frame};
use store::records::Protocol;
use store::{DATABASE, ExportCursor, ExportFilter, ExportRow, ExportSource, JobState, LOCK, Store};

use self::split::Shares;
use super::{CampaignLocation, Ended, Failure, block_on};
use crate::condition::Condition;
use crate::output::{self, Bar, print};
use crate::whole_file::{WholeFile, cannot_write, refuse_to_replace};

/// Structures read at a time.
const PAGE: u32 = 200;

const BAR: &str = "{spinner} {pos} structures";

/// Write the labelled structures as extended XYZ
///
/// Structures stand in the order of the decisions, whatever the order in which their labels came: the same campaign
/// gives the same bytes. Beside the label each has campaign, candidate_id, seed_structure, walk, segment, step, origin,
/// mixture_version (after the decision), mixture_version_seen (by the walker), protocol, protocol_hash and
/// relative_volume (V/V₀), and the columns gamma and gamma_nbr under the ORIGINAL mixture. Imported structures have
/// source_file and source_frame (from 0) instead. Where the calculation gives them there are energy_without_smearing (eV),
/// the cell's magnetic moment magmom and the column magmoms (μ_B). A damaged database is not exported: everything that is
/// read has a checksum, and what is missing is found by a second look. See docs/export.md.
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
    /// Only structures that meet this condition, as 'gamma > 2 and element = Mo'
    ///
    /// Numbers (= != < <= > >=): gamma, gamma_nbr (the largest, original mixture), volume (V/V₀), temperature (K), walk, step,
    /// mixture_version, atoms, energy (eV, of the label), energy_per_atom, max_force (eV/Å, of the label). Texts (= !=): element (one of
    /// the atoms is it), kind (biased, control, imported), seed (name of the seed structure, in quotes if it has spaces). With and,
    /// or, not and parentheses.
    #[arg(long = "where", value_name = "CONDITION")]
    condition: Option<Condition>,
    /// Divide into several files by seed structure, as train=0.9,test=0.1: FILE-train and FILE-test
    ///
    /// Everything that was found from a seed structure goes to the same file, so that no test set has its like in training;
    /// shares are those of the seed structures. Imported structures go to the first file.
    #[arg(long, value_name = "NAME=SHARE,…")]
    split: Option<Shares>,
    /// Another number deals the seed structures otherwise
    #[arg(long, value_name = "NUMBER", default_value_t = 0, requires = "split")]
    split_seed: u64,
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
    /// energy, force, virial
    Gap,
}

/// What an export came to.
#[derive(Default)]
struct Count {
    frames: u64,
    without_stress: u64,
    /// Seed structures that they come from.
    seed_structures: BTreeSet<u32>,
}

/// An export, and what is not in it.
struct Exported {
    /// Files, what they hold, and how many seed structures go there.
    counts: Vec<(PathBuf, Count, usize)>,
    labels: store::Labels,
    /// Structures whose labels are by other protocols.
    others: u64,
}

/// A file to write, and what goes there.
struct Part {
    path: PathBuf,
    file: WholeFile,
    count: Count,
    /// Seed structures that go there, whether anything was found from them or not.
    dealt: usize,
}

/// Refuses an export that lacks structures which have their labels.
async fn refuse_to_miss(
    store: &Store,
    filter: &ExportFilter,
    mut missing: BTreeSet<ExportCursor>,
) -> Result<(), Failure> {
    if missing.is_empty() {
        return Ok(());
    }
    // What was dropped, or labelled again, since it was counted is not missing.
    let now = store.labelled_cursors(filter).await?;
    missing.retain(|place| now.contains(place));
    let place = match missing.first() {
        None => return Ok(()),
        Some(ExportCursor::Candidate(decision)) => format!("that of decision {decision}"),
        Some(ExportCursor::Import(number)) => format!("import-{number}"),
    };
    Err(Failure::Failed(format!(
        "damaged database: {} of {} labelled structures cannot be found where they should be, the first is {place}; nothing was \
         written: calmwalk store check says what is damaged; restore the campaign from a backup",
        missing.len(),
        now.len()
    )))
}

impl Export {
    pub fn run(self) -> Result<Ended, Failure> {
        let Exported { counts, labels, others } = block_on(self.export())??;
        for (path, count, _) in &counts {
            if matches!(self.keys, KeyNames::Grace) && (1..count.frames).contains(&count.without_stress) {
                let (without, frames, path) = (count.without_stress, count.frames, path.display());
                let warning = "have no stress: gracemaker will then use none of the file";
                let _ =
                    writeln!(std::io::stderr(), "{without} of the {frames} structures in {path} {warning}");
            }
        }
        print(|out| {
            for (path, count, dealt) in &counts {
                let from = if self.split.is_none() {
                    String::new()
                } else {
                    format!(
                        ", found from {} of the {dealt} seed structures that go there",
                        count.seed_structures.len()
                    )
                };
                writeln!(out, "{} in {}{from}", output::count(count.frames, "structure"), path.display())?;
            }
            if others > 0 {
                let others = output::count(others, "structure");
                writeln!(
                    out,
                    "left out for their labels by other protocols, which --protocol chooses: {others}"
                )?;
            }
            let store::Labels { queued, leased, failed, dropped, again, failed_again, excluded, .. } = labels;
            if excluded > 0 {
                writeln!(out, "excluded by hand and left out: {excluded} (calmwalk exclude --list)")?;
            }
            // Those that are labelled again have labels.
            let (waiting, failed) =
                ((queued + leased).saturating_sub(again), failed.saturating_sub(failed_again));
            if waiting + failed + dropped == 0 {
                return writeln!(out, "every accepted structure is labelled");
            }
            writeln!(
                out,
                "accepted without a label: {waiting} not labelled yet, {failed} failed, {dropped} dropped"
            )
        })?;
        Ok(Ended::Done)
    }

    async fn export(&self) -> Result<Exported, Failure> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        store.check_for_export().await?;
        let protocol = self.choose_protocol(&store).await?;
        let (filter, campaign) = (self.filter(&protocol), store.campaign().await?.id.to_string());
        let (mut parts, dealt) = self.parts(&store).await?;
        let mut missing = store.labelled_cursors(&filter).await?;
        let (mut frames, mut last, bar) = (0, None, Bar::new(None, BAR));
        loop {
            let page = store.labelled(&filter, last, PAGE).await?;
            let Some(row) = page.last() else { break };
            last = Some(row.cursor);
            for row in page {
                missing.remove(&row.cursor);
                if self.condition.as_ref().is_some_and(|condition| !condition.is_met(&frame::facts(&row))) {
                    continue;
                }
                frames += 1;
                let seed = match &row.source {
                    ExportSource::Candidate { seed_structure, .. } => Some(*seed_structure),
                    ExportSource::Import { .. } => None,
                };
                let part = seed.and_then(|seed| dealt.get(&seed)).copied().unwrap_or_default();
                parts[part].write(row, seed, self.keys.into(), &campaign)?;
            }
            bar.set(frames, String::new);
        }
        refuse_to_miss(&store, &filter, missing).await?;
        if let (0, Some(condition)) = (frames, &self.condition) {
            return Err(Failure::Input(format!("no labelled structure meets --where '{condition}'")));
        }
        let mut counts = Vec::new();
        for Part { path, file, count, dealt } in parts {
            file.finish()?;
            counts.push((path, count, dealt));
        }
        let labels = store.status().await?.labels;
        let jobs = store.jobs_by_protocol().await?.into_iter();
        let by_others =
            jobs.filter(|(name, state, _)| *name != protocol.name && *state == JobState::Labelled);
        let others = by_others.map(|(.., count)| count).sum();
        store.close().await;
        Ok(Exported { counts, labels, others })
    }

    /// The files to write, and which of them each seed structure goes to.
    async fn parts(&self, store: &Store) -> Result<(Vec<Part>, BTreeMap<u32, usize>), Failure> {
        let Some(shares) = &self.split else {
            return Ok((vec![self.part(self.output.clone(), 0)?], BTreeMap::new()));
        };
        let seeds = store.seed_structures().await?.into_iter();
        let seeds: Vec<_> = seeds.map(|seed| (seed.index, seed.name)).collect();
        let dealt = shares
            .deal(&seeds, self.split_seed)
            .map_err(|error| Failure::Input(format!("--split: {error}")))?;
        let mut parts = Vec::new();
        for (number, name) in shares.names().enumerate() {
            let seeds = dealt.values().filter(|part| **part == number).count();
            parts.push(self.part(split::path(&self.output, name), seeds)?);
        }
        Ok((parts, dealt))
    }

    fn part(&self, path: PathBuf, dealt: usize) -> Result<Part, Failure> {
        let files = [DATABASE.to_owned(), format!("{DATABASE}-wal"), LOCK.to_owned()];
        let [database, log, lock] = files.map(|name| self.location.location.join(name));
        let own = [&database, &log, &lock].map(|file| (file.as_path(), "a file of the campaign itself"));
        refuse_to_replace(&path, own)?;
        Ok(Part { file: WholeFile::create(&path)?, path, count: Count::default(), dealt })
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
        let store::Labels { queued, leased, failed, dropped, excluded, .. } = status.labels;
        let imported =
            if self.imported || status.imported == 0 { "" } else { "; --imported adds what was imported" };
        format!(
            "nothing to export: no structure has a label ({} not labelled yet, {failed} failed, {dropped} \
             dropped, {excluded} excluded){imported}",
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
            KeyNames::Gap => Self::Gap,
        }
    }
}

impl Part {
    fn write(
        &mut self,
        row: ExportRow,
        seed: Option<u32>,
        keys: Keys,
        campaign: &str,
    ) -> Result<(), Failure> {
        self.count.frames += 1;
        self.count.without_stress += u64::from(row.label.stress.is_none());
        self.count.seed_structures.extend(seed);
        let frame = frame::frame(row, keys, campaign);
        write_frame(&mut self.file, &frame).map_err(|error| cannot_write(&self.path, error))
    }
}

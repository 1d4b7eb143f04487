//! `calmwalk export`

mod draw;
mod split;

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::num::NonZeroUsize;
use std::path::PathBuf;

use atoms::extxyz::{Frame, LabelKeys, write_frame};
use serde_json::{Value, json};
use store::records::Protocol;
use store::{DATABASE, ExportCursor, ExportFilter, ExportRow, ExportSource, JobState, LOCK, Store};
use wire::{WalkConditions, WalkId};

use self::draw::{Drawn, WalkDraw};
use self::split::Shares;
use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::atomic_file::{AtomicFile, cannot_write, refuse_to_replace};
use crate::export_frame;
use crate::filter::StructureFilter;
use crate::output::{self, Bar, print, print_json};

/// Structures per read.
const PAGE: u32 = 200;

const BAR: &str = "{spinner} {pos} structures";

/// Write the labelled structures to an extended XYZ file
///
/// Structures are in the order of the decisions, whenever their labels were computed: the same campaign gives the same bytes. Each frame
/// has its label and
///
/// - where it comes from: campaign, candidate_id, seed_structure, walk, segment, step and origin; an imported structure has source_file
///   and source_frame (from 0) instead;
///
/// - mixture_version (after the decision), mixture_version_seen (by the walker), protocol, protocol_hash and relative_volume (V/V₀);
///
/// - per atom gamma and gamma_nbr under the original mixture;
///
/// - if the calculation provides them: energy_without_smearing (eV), magmom (magnetic moment of the cell, μ_B) and per atom magmoms (μ_B).
///
/// With several versions of the potential, calmwalk_version is the version that drove the walk. Do not compare grades of different
/// versions. Fails without writing a file if the database is damaged or incomplete. See docs/export.md.
#[derive(Debug, clap::Args)]
pub struct ExportArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// File to write; an existing file is replaced once the export is complete
    #[arg(long, short, value_name = "FILE.extxyz")]
    output: PathBuf,
    /// Names for energy, forces and stress, as the training program expects them
    #[arg(long, value_enum, default_value_t = KeyNames::Ase)]
    keys: KeyNames,
    /// Include the frames of control walks
    #[arg(long)]
    control: bool,
    /// Include imported structures, after the others
    #[arg(long)]
    imported: bool,
    /// Export only structures that match a filter, such as 'gamma > 2 and element = Mo'
    ///
    /// Combine comparisons with and, or, not and parentheses. A comparison with a missing value is false.
    ///
    /// Numbers of the structure (= != < <= > >=): gamma and gamma_nbr (largest of its atoms, original mixture), gamma_current (mixture at
    /// the decision), relative_volume (V/V₀), kinetic_temperature (K), atoms, fragments (sets of atoms that bonds join),
    /// mixture_version (after the decision). Of its walk: walk, step, temperature (K), tau, version (of the
    /// potential). Of its label: energy (eV), energy_per_atom (eV), max_force (eV/Å).
    ///
    /// Texts (= !=): element (any atom of the structure), origin (biased, control or imported), seed_structure (its name, in quotes if it
    /// contains spaces), group (of the walk, see [[walks]]), retry_adjustment (any of those with which the label was computed after
    /// failures, such as other_moments).
    #[arg(long = "where", value_name = "FILTER")]
    condition: Option<StructureFilter>,
    /// Export at most N structures of each walk, drawn at random from those that match --where
    ///
    /// Biased and control walks count by themselves; imported structures are not drawn. A larger N keeps what a smaller one draws.
    #[arg(long, value_name = "N")]
    per_walk: Option<NonZeroUsize>,
    /// Random seed of the draw
    #[arg(long, value_name = "N", default_value_t = 0, requires = "per_walk")]
    draw_rng_seed: u64,
    /// Split into several files, such as train=0.9,test=0.1 for FILE-train and FILE-test
    ///
    /// Assigns the seed structures to the files at random, in these proportions. All structures found from one seed structure go to the
    /// same file, which keeps training and test sets independent. Imported structures go to the first file.
    #[arg(long, value_name = "NAME=SHARE,…")]
    split: Option<Shares>,
    /// Random seed of the split
    #[arg(long, value_name = "N", default_value_t = 0, requires = "split")]
    split_rng_seed: u64,
    /// Export the labels of this protocol; required if there are labels of several protocols
    #[arg(long, value_name = "NAME")]
    protocol: Option<String>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum KeyNames {
    /// ASE: energy, forces, stress
    Ase,
    /// MACE: REF_energy, REF_forces, REF_stress
    Mace,
    /// gracemaker: as ase, with the energy also as free_energy
    Grace,
    /// GAP: energy, force, virial
    Gap,
}

/// What a file contains.
#[derive(Default)]
struct Count {
    frames: u64,
    without_stress: u64,
    /// Seed structures of the frames.
    seed_structures: BTreeSet<u32>,
}

/// The result of an export.
struct Exported {
    /// Files with their contents and the number of seed structures assigned to each.
    counts: Vec<(PathBuf, Count, usize)>,
    labels: store::LabelJobCounts,
    /// Structures with labels of other protocols, which are not exported.
    others: u64,
    /// With `--per-walk`.
    drawn: Option<Drawn>,
}

/// Accepted structures that have no label.
struct WithoutLabel {
    waiting: u64,
    failed: u64,
    dropped: u64,
}

/// A file to write.
struct ExportFile {
    path: PathBuf,
    file: AtomicFile,
    count: Count,
    /// Seed structures assigned to this file, also those without labelled structures.
    assigned: usize,
}

/// Checks that no labelled structure is missing from the export.
async fn check_completeness(
    store: &Store,
    filter: &ExportFilter,
    mut missing: BTreeSet<ExportCursor>,
) -> Result<(), CommandError> {
    if missing.is_empty() {
        return Ok(());
    }
    // Structures that were dropped or relabelled since the first count are not missing.
    let now = store.labelled_cursors(filter).await?;
    missing.retain(|place| now.contains(place));
    let place = match missing.first() {
        None => return Ok(()),
        Some(ExportCursor::Candidate(decision)) => format!("that of decision {decision}"),
        Some(ExportCursor::Import(number)) => format!("import-{number}"),
    };
    Err(CommandError::Failed(format!(
        "damaged database: {} of {} labelled structures are missing, the first is {place}; nothing was written. calmwalk store \
         check shows the damage; restore the campaign from a backup",
        missing.len(),
        now.len()
    )))
}

impl ExportArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let exported = block_on(self.export())??;
        for (path, count, _) in &exported.counts {
            if matches!(self.keys, KeyNames::Grace) && (1..count.frames).contains(&count.without_stress) {
                let (without, frames, path) = (count.without_stress, count.frames, path.display());
                let warning = "have no stress: gracemaker will ignore the stress of the whole file";
                let _ =
                    writeln!(std::io::stderr(), "{without} of the {frames} structures in {path} {warning}");
            }
        }
        if self.json {
            print_json(&exported.as_json())?;
        } else {
            print(|out| self.write(out, &exported))?;
        }
        Ok(ExitStatus::Done)
    }

    fn write(&self, out: &mut dyn Write, exported: &Exported) -> io::Result<()> {
        for (path, count, assigned) in &exported.counts {
            let from = if self.split.is_none() {
                String::new()
            } else {
                format!(
                    ", from {} of the {assigned} seed structures assigned to it",
                    count.seed_structures.len()
                )
            };
            writeln!(out, "{} in {}{from}", output::count(count.frames, "structure"), path.display())?;
        }
        if let Some(drawn) = &exported.drawn {
            drawn.write(out)?;
        }
        if exported.others > 0 {
            let others = output::count(exported.others, "structure");
            writeln!(out, "not exported: {others} with labels of other protocols (select with --protocol)")?;
        }
        let missing = WithoutLabel::of(&exported.labels);
        let excluded = exported.labels.excluded;
        if excluded > 0 {
            writeln!(out, "not exported: {excluded} with excluded labels (see calmwalk exclude --list)")?;
        }
        let WithoutLabel { waiting, failed, dropped } = missing;
        if waiting + failed + dropped == 0 {
            return writeln!(out, "all accepted structures are labelled");
        }
        writeln!(
            out,
            "accepted structures without a label: {waiting} not labelled yet, {failed} failed, {dropped} dropped"
        )
    }

    async fn export(&self) -> Result<Exported, CommandError> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        store.check_for_export().await?;
        let protocol = self.select_protocol(&store).await?;
        let (filter, campaign) = (self.filter(&protocol), store.campaign().await?.id.to_string());
        let (mut parts, assigned) = self.parts(&store).await?;
        let conditions = store.walk_conditions().await?;
        let drawn = self.draw(&store, &filter, &conditions).await?;
        let mut missing = store.labelled_cursors(&filter).await?;
        let (mut frames, mut last, bar) = (0, None, Bar::new(None, BAR));
        loop {
            let page = store.labelled(&filter, last, PAGE).await?;
            let Some(row) = page.last() else { break };
            last = Some(row.cursor);
            for row in page {
                missing.remove(&row.cursor);
                let is_drawn = drawn.as_ref().is_none_or(|drawn| drawn.has(&row));
                if !is_drawn || !self.matches(&row, &conditions) {
                    continue;
                }
                frames += 1;
                let seed = match &row.source {
                    ExportSource::Candidate { seed_structure, .. } => Some(*seed_structure),
                    ExportSource::Import { .. } => None,
                };
                let part = seed.and_then(|seed| assigned.get(&seed)).copied().unwrap_or_default();
                let has_stress = row.label.stress.is_some();
                let frame = export_frame::frame(row, self.keys.into(), &campaign, &conditions);
                parts[part].write(&frame, seed, has_stress)?;
            }
            bar.set(frames, String::new);
        }
        check_completeness(&store, &filter, missing).await?;
        if let (0, Some(condition)) = (frames, &self.condition) {
            return Err(CommandError::Input(format!("no labelled structure matches --where '{condition}'")));
        }
        let mut counts = Vec::new();
        for ExportFile { path, file, count, assigned } in parts {
            file.finish()?;
            counts.push((path, count, assigned));
        }
        let labels = store.status().await?.labels;
        let jobs = store.jobs_by_protocol().await?.into_iter();
        let by_others =
            jobs.filter(|(name, state, _)| *name != protocol.name && *state == JobState::Labelled);
        let others = by_others.map(|(.., count)| count).sum();
        store.close().await;
        Ok(Exported { counts, labels, others, drawn })
    }

    /// Whether a structure matches `--where`.
    fn matches(&self, row: &ExportRow, conditions: &BTreeMap<WalkId, WalkConditions>) -> bool {
        let matches = |condition: &StructureFilter| condition.matches(&export_frame::facts(row, conditions));
        self.condition.as_ref().is_none_or(matches)
    }

    /// Draws structures of each walk, in a first read of all of them.
    async fn draw(
        &self,
        store: &Store,
        filter: &ExportFilter,
        conditions: &BTreeMap<WalkId, WalkConditions>,
    ) -> Result<Option<Drawn>, CommandError> {
        let Some(per_walk) = self.per_walk else { return Ok(None) };
        let (mut draw, mut last) = (WalkDraw::new(per_walk, self.draw_rng_seed), None);
        loop {
            let page = store.labelled(filter, last, PAGE).await?;
            let Some(row) = page.last() else { return Ok(Some(draw.finish())) };
            last = Some(row.cursor);
            page.iter().filter(|row| self.matches(row, conditions)).for_each(|row| draw.offer(row));
        }
    }

    /// The files to write, and the index of the file of each seed structure.
    async fn parts(&self, store: &Store) -> Result<(Vec<ExportFile>, BTreeMap<u32, usize>), CommandError> {
        let Some(shares) = &self.split else {
            return Ok((vec![self.part(self.output.clone(), 0)?], BTreeMap::new()));
        };
        let seeds = store.seed_structures().await?.into_iter();
        let seeds: Vec<_> = seeds.map(|seed| (seed.index, seed.name)).collect();
        let assigned = shares
            .assign(&seeds, self.split_rng_seed)
            .map_err(|error| CommandError::Input(format!("--split: {error}")))?;
        let mut parts = Vec::new();
        for (number, name) in shares.names().enumerate() {
            let seeds = assigned.values().filter(|part| **part == number).count();
            parts.push(self.part(split::path(&self.output, name), seeds)?);
        }
        Ok((parts, assigned))
    }

    fn part(&self, path: PathBuf, assigned: usize) -> Result<ExportFile, CommandError> {
        let files = [DATABASE.to_owned(), format!("{DATABASE}-wal"), LOCK.to_owned()];
        let [database, log, lock] = files.map(|name| self.location.location.join(name));
        let own = [&database, &log, &lock].map(|file| (file.as_path(), "a file of the campaign itself"));
        refuse_to_replace(&path, own)?;
        Ok(ExportFile { file: AtomicFile::create(&path)?, path, count: Count::default(), assigned })
    }

    fn filter(&self, protocol: &Protocol) -> ExportFilter {
        let Self { control, imported, .. } = *self;
        ExportFilter { protocol: protocol.hash, biased: true, control, imported }
    }

    /// The requested protocol, or the only one with labels to export.
    async fn select_protocol(&self, store: &Store) -> Result<Protocol, CommandError> {
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
                Err(CommandError::Input(format!(
                    "the campaign has no protocol '{name}'; it has {}",
                    names(&protocols)
                )))
            }
            ([], _) => Err(CommandError::Input(self.nothing_to_export(&store.status().await?))),
            (several, _) => Err(CommandError::Input(format!(
                "there are labels of several protocols, which must not be mixed in one file: select one with --protocol \
                 ({})",
                names(several)
            ))),
        }
    }

    fn nothing_to_export(&self, status: &store::CampaignStatus) -> String {
        let store::LabelJobCounts { queued, leased, failed, dropped, excluded, .. } = status.labels;
        let imported = if self.imported || status.imported == 0 {
            ""
        } else {
            "; use --imported to export imported structures"
        };
        format!(
            "nothing to export: no structure has a label ({} not labelled yet, {failed} failed, {dropped} \
             dropped, {excluded} excluded){imported}",
            queued + leased
        )
    }
}

impl Exported {
    fn as_json(&self) -> Value {
        let file = |(path, count, assigned): &(PathBuf, Count, usize)| {
            json!({
                "path": path, "structures": count.frames, "without_stress": count.without_stress,
                "seed_structures": count.seed_structures.len(), "assigned_seed_structures": assigned,
            })
        };
        let WithoutLabel { waiting, failed, dropped } = WithoutLabel::of(&self.labels);
        json!({
            "files": self.counts.iter().map(file).collect::<Vec<_>>(), "other_protocols": self.others,
            "excluded": self.labels.excluded,
            "without_label": { "waiting": waiting, "failed": failed, "dropped": dropped },
        })
    }
}

impl WithoutLabel {
    fn of(labels: &store::LabelJobCounts) -> Self {
        // Structures that wait for a replacement label have a label.
        let waiting = (labels.queued + labels.leased).saturating_sub(labels.relabelling);
        let failed = labels.failed.saturating_sub(labels.failed_under_new_protocol);
        Self { waiting, failed, dropped: labels.dropped }
    }
}

impl From<KeyNames> for LabelKeys {
    fn from(names: KeyNames) -> Self {
        match names {
            KeyNames::Ase => Self::Ase,
            KeyNames::Mace => Self::Mace,
            KeyNames::Grace => Self::Grace,
            KeyNames::Gap => Self::Gap,
        }
    }
}

impl ExportFile {
    fn write(&mut self, frame: &Frame, seed: Option<u32>, has_stress: bool) -> Result<(), CommandError> {
        self.count.frames += 1;
        self.count.without_stress += u64::from(!has_stress);
        self.count.seed_structures.extend(seed);
        write_frame(&mut self.file, frame).map_err(|error| cannot_write(&self.path, error))
    }
}

//! The labels of a campaign as files: to train on, to judge with, and to compare with.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, HashSet};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use atoms::extxyz::{ExtxyzWriteError, LabelKeys, write_frame};
use monitor::refit_progress::{LabelPurpose, LabelSet, LabelSplit};
use serde::{Deserialize, Serialize};
use store::{ExportCursor, ExportFilter, ExportRow, Store};
use tokio_util::sync::CancellationToken;
use wire::{WalkConditions, WalkId};

use crate::atomic_file::{AtomicFile, cannot_write};
use crate::exit_status::CommandError;
use crate::export_frame;

/// Rows read at a time.
const PAGE: u32 = 200;

/// What a refit begins with. It stays the same however often the refit is interrupted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrozenSet {
    /// Number of the version to train.
    pub number: u32,
    /// Hash of the protocol of the labels.
    pub protocol: String,
    /// The newest decision whose label counts.
    pub last_decision: i64,
    /// Number of structures that biased walks had found until then.
    pub accepted: u64,
}

/// The labels of a campaign as files in the directory of a refit.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelFiles {
    /// Number of structures in each of the files; a file without structures does not exist.
    counts: BTreeMap<LabelFile, u64>,
    /// Decisions on the candidates of the training set.
    pub trained_on: Vec<i64>,
    /// Decisions on the candidates of the other files.
    pub others: Vec<i64>,
    /// Numbers of the imported structures, which are all in the training set.
    pub imports: Vec<i64>,
    /// The [`LabelSet`] of the training set; empty without a protocol.
    pub label_set: String,
}

/// One of the files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LabelFile {
    /// Labels to train on.
    Training,
    /// Labels of seed structures that no version is trained on.
    HeldOut,
    /// Labels of control frames, if they are for comparisons.
    Control,
    /// Labels that came after the training set was fixed.
    Since,
}

impl LabelFile {
    const ALL: [Self; 4] = [Self::Training, Self::HeldOut, Self::Control, Self::Since];

    fn name(self) -> &'static str {
        match self {
            Self::Training => "train.extxyz",
            Self::HeldOut => "held_out.extxyz",
            Self::Control => "control.extxyz",
            Self::Since => "since.extxyz",
        }
    }
}

impl LabelFiles {
    /// The file, unless there are no structures for it.
    pub fn path(&self, directory: &Path, file: LabelFile) -> Option<PathBuf> {
        (self.count(file) > 0).then(|| directory.join(file.name()))
    }

    /// Number of structures in it.
    pub fn count(&self, file: LabelFile) -> u64 {
        self.counts.get(&file).copied().unwrap_or(0)
    }
}

/// Which labels are written.
pub enum LabelChoice<'a> {
    /// Those until the last decision of the set, which it is fixed with.
    OfSet,
    /// Those that are in none of these files: they came since.
    Since(&'a LabelFiles),
}

/// Where each label belongs.
enum LabelSorter {
    OfSet { split: LabelSplit, last_decision: i64 },
    Since(HashSet<ExportCursor>),
}

impl LabelSorter {
    fn new(choice: &LabelChoice<'_>, split: LabelSplit, last_decision: i64) -> Self {
        match choice {
            LabelChoice::OfSet => Self::OfSet { split, last_decision },
            LabelChoice::Since(LabelFiles { trained_on, others, imports, .. }) => {
                let candidates =
                    trained_on.iter().chain(others).map(|number| ExportCursor::Candidate(*number));
                let imports = imports.iter().map(|number| ExportCursor::Import(*number));
                Self::Since(candidates.chain(imports).collect())
            }
        }
    }

    /// The file of a row, if it has one.
    fn file(&self, row: &ExportRow) -> Option<LabelFile> {
        match self {
            Self::OfSet { split, last_decision } => {
                let is_later =
                    matches!(row.cursor, ExportCursor::Candidate(decision) if decision > *last_decision);
                (!is_later).then(|| split.purpose(row).into())
            }
            Self::Since(of_set) => (!of_set.contains(&row.cursor)).then_some(LabelFile::Since),
        }
    }
}

impl From<LabelPurpose> for LabelFile {
    fn from(purpose: LabelPurpose) -> Self {
        match purpose {
            LabelPurpose::Training => Self::Training,
            LabelPurpose::HeldOut => Self::HeldOut,
            LabelPurpose::Control => Self::Control,
        }
    }
}

/// Writes these labels. `None` after a cancellation of `stop`.
///
/// # Errors
/// The database, a full disk.
pub async fn write(
    store: &Store,
    (directory, set): (&Path, &FrozenSet),
    split: LabelSplit,
    choice: LabelChoice<'_>,
    stop: &CancellationToken,
) -> Result<Option<LabelFiles>, CommandError> {
    let mut found = LabelFiles::default();
    let Some(protocol) = store.protocol_in_force().await? else { return Ok(Some(found)) };
    let filter = ExportFilter { protocol: protocol.hash, biased: true, control: true, imported: true };
    let sorter = LabelSorter::new(&choice, split, set.last_decision);
    let mut label_set = LabelSet::new(protocol.hash);
    let (campaign, conditions) = (store.campaign().await?.id.to_string(), store.walk_conditions().await?);
    let mut files = BTreeMap::new();
    let mut last = None;
    loop {
        let page = store.labelled(&filter, last, PAGE).await?;
        let Some(end) = page.last() else { break };
        last = Some(end.cursor);
        if stop.is_cancelled() {
            return Ok(None);
        }
        for row in page {
            let Some(kind) = sorter.file(&row) else { continue };
            let path = directory.join(kind.name());
            let file = match files.entry(kind) {
                Entry::Occupied(file) => file.into_mut(),
                Entry::Vacant(place) => place.insert(AtomicFile::create(&path)?),
            };
            match (kind, row.cursor) {
                (LabelFile::Training, ExportCursor::Candidate(decision)) => found.trained_on.push(decision),
                (_, ExportCursor::Candidate(decision)) => found.others.push(decision),
                (_, ExportCursor::Import(number)) => found.imports.push(number),
            }
            if kind == LabelFile::Training {
                label_set.add(row.cursor, row.label.energy);
            }
            write_row(file, row, &campaign, &conditions).map_err(|error| cannot_write(&path, error))?;
            *found.counts.entry(kind).or_default() += 1;
        }
    }
    for kind in LabelFile::ALL {
        if let Some(file) = files.remove(&kind) {
            file.finish()?;
        }
    }
    found.label_set = label_set.hash();
    Ok(Some(found))
}

fn write_row(
    file: &mut impl Write,
    row: ExportRow,
    campaign: &str,
    conditions: &BTreeMap<WalkId, WalkConditions>,
) -> Result<(), ExtxyzWriteError> {
    write_frame(file, &export_frame::frame(row, LabelKeys::Ase, campaign, conditions))
}

/// A value that is kept in a file of the directory from its first computation on; `None` if that was stopped.
///
/// # Errors
/// Those of the computation; a file that cannot be read or written.
pub async fn kept<T: Serialize + for<'a> Deserialize<'a>, E: From<CommandError>>(
    path: PathBuf,
    compute: impl AsyncFnOnce() -> Result<Option<T>, E>,
) -> Result<Option<T>, E> {
    if let Some(value) = read_kept(&path)? {
        return Ok(Some(value));
    }
    let Some(value) = compute().await? else { return Ok(None) };
    let mut file = AtomicFile::create(&path)?;
    let text = serde_json::to_string_pretty(&value).map_err(CommandError::failed)?;
    writeln!(file, "{text}").map_err(|error| cannot_write(&path, error))?;
    file.finish()?;
    Ok(Some(value))
}

/// `None` if there is no such file.
fn read_kept<T: for<'a> Deserialize<'a>>(path: &Path) -> Result<Option<T>, CommandError> {
    match fs::read(path) {
        Ok(bytes) => serde_json::from_slice(&bytes).map(Some).map_err(|error| {
            CommandError::Failed(format!("{}: {error}: remove its directory to begin again", path.display()))
        }),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(CommandError::Failed(format!("cannot read {}: {error}", path.display()))),
    }
}

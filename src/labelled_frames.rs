//! Reads labelled structures.

use std::path::Path;
use std::sync::Arc;

use ::upfit::{LabelledFrame, UpfitError};
use atoms::extxyz::Frame;
use serde::Serialize;
use tokio_util::sync::CancellationToken;

use crate::exit_status::CommandError;
use crate::file_hash;
use crate::output::{count, log_and_warn};
use crate::structure_files::{FileLine, StructureFile, StructureFiles};

/// The key of a frame with the name of its seed structure, as `calmwalk export` writes it.
const GROUP: &str = "seed_structure";
/// The key with the name of the candidate.
const CANDIDATE: &str = "candidate_id";

/// A file of labelled structures, for the note in the model.
#[derive(Clone, Debug, Serialize)]
pub struct DataFile {
    file: String,
    /// BLAKE3.
    hash: String,
    /// Those used.
    structures: u64,
    /// Of the file; structures may have weights of their own.
    weight: f64,
    /// Whether it was named for validation.
    validation: bool,
}

impl DataFile {
    /// As a file that was named for validation.
    pub fn for_validation(self) -> Self {
        Self { validation: true, ..self }
    }

    /// Refuses a file for validation with the content of one to train with. `self` is for validation.
    ///
    /// # Errors
    /// Such a file among `others`.
    pub fn refuse_copy(&self, others: &[Self]) -> Result<(), CommandError> {
        match others.iter().find(|other| other.hash == self.hash) {
            Some(Self { file, .. }) => Err(CommandError::Input(format!(
                "{}, a file of validation data, has the same content as {file}, a file of training data; expected other structures",
                self.file
            ))),
            None => Ok(()),
        }
    }

    /// The same without the directory of the file.
    pub fn without_directory(self) -> Self {
        let name = Path::new(&self.file).file_name();
        Self { file: name.map_or_else(String::new, |name| name.to_string_lossy().into_owned()), ..self }
    }
}

/// Wrong input: exit code 2; failures on the way: exit code 1.
pub fn command_error(error: UpfitError) -> CommandError {
    if error.is_wrong_input() { CommandError::input(error) } else { CommandError::failed(error) }
}

/// Refuses files whose formats have no labels. The name shows the format, with or without the extension of a compression.
pub fn check_formats<'a>(paths: impl IntoIterator<Item = &'a Path>) -> Result<(), CommandError> {
    for path in paths {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        let name = name.strip_suffix(".gz").or_else(|| name.strip_suffix(".zst")).unwrap_or(&name);
        if ![".xyz", ".extxyz"].iter().any(|ending| name.ends_with(ending)) {
            return Err(CommandError::Input(format!(
                "{}: POSCAR files and dumps of LAMMPS have no labels; expected extended XYZ with energy and forces, a name that ends in \
                 .extxyz or .xyz, with or without .gz or .zst",
                path.display()
            )));
        }
    }
    Ok(())
}

/// Labelled structures, and the files that they come from.
pub type ReadFrames = (Vec<LabelledFrame>, Vec<DataFile>);

/// The labelled structures of all files; `None` if it was asked to stop. Warns of stresses that are left out.
///
/// # Errors
/// A structure that cannot be read; labels that [`LabelledFrame::new`] refuses.
pub fn read_frames(
    files: &StructureFiles,
    stop: &CancellationToken,
) -> Result<Option<ReadFrames>, CommandError> {
    let Some((read, stresses_left_out)) = read_without_warning(files, stop)? else {
        return Ok(None);
    };
    if stresses_left_out > 0 {
        log_and_warn(format_args!(
            "the stresses of {} are left out: not periodic in all three directions",
            count(stresses_left_out, "structure")
        ));
    }
    Ok(Some(read))
}

/// The same, with the number of stresses that are left out instead of the warning.
pub fn read_without_warning(
    files: &StructureFiles,
    stop: &CancellationToken,
) -> Result<Option<(ReadFrames, u64)>, CommandError> {
    let mut reader = files.reader(Arc::default());
    let (mut frames, mut counts) = (Vec::new(), vec![0; files.files.len()]);
    let mut stresses_left_out = 0_u64;
    while let Some((frame, file)) = reader.next()? {
        if stop.is_cancelled() {
            return Ok(None);
        }
        counts[reader.file_index()] += 1;
        let (labelled, has_stress) = labelled_frame(frame, &file)?;
        stresses_left_out += u64::from(has_stress && labelled.stress.is_none());
        frames.push(LabelledFrame { file: reader.file_index(), ..labelled });
    }
    let file = |(file, structures): (&StructureFile, u64)| -> Result<DataFile, CommandError> {
        let hash = file_hash::hash(&file.path).map_err(|error| {
            CommandError::Unreadable(format!("{}: cannot be read: {error}", file.path.display()))
        })?;
        let name = file.path.display().to_string();
        Ok(DataFile { file: name, hash, structures, weight: file.weight, validation: false })
    };
    let sources = files.files.iter().zip(counts).map(file).collect::<Result<_, _>>()?;
    Ok(Some(((frames, sources), stresses_left_out)))
}

/// The frame with its labels, and whether these have a stress.
fn labelled_frame(frame: Frame, file: &StructureFile) -> Result<(LabelledFrame, bool), CommandError> {
    let labels =
        frame.labels().map_err(|error| CommandError::Input(format!("{}: {error}", file.path.display())))?;
    let has_stress = labels.stress.is_some();
    let mut place = FileLine { file: Arc::clone(&file.path), line: frame.line }.to_string();
    if let Some(candidate) = frame.info.get(CANDIDATE) {
        // What commands such as calmwalk exclude need.
        place += &format!(" (candidate {candidate})");
    }
    let group = frame.info.get(GROUP).map_or_else(|| place.clone(), ToString::to_string);
    let weight = file.weight_of(&frame)?;
    let labelled = LabelledFrame::new(place, group, frame.structure, labels, weight);
    Ok((labelled.map_err(command_error)?, has_stress))
}

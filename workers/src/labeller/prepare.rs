//! Preparing a calculation and reading its results. Runs nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::path::Path;

use atoms::Structure;
use dft::{CalculationInput, CalculationResults, DftBackend, Exit, Failure, PinnedFile, RetryAdjustment};
use store::{CalculationRecord, StoreError};

use super::ExecutionSettings;
use super::calculation_runner::WORK;
use super::file_error::file_error;
use super::input_diff::input_diff;
use super::retry_decision::failure_at;

/// Beside [`WORK`]: input files that all calculations share.
pub(super) const DATA: &str = "data";

/// Bytes of a GB.
const GIGABYTE: f64 = 1e9;

/// The input of a calculation and its record in the store.
pub(super) struct PreparedInput {
    pub input: CalculationInput,
    pub record: CalculationRecord,
    /// Seconds.
    pub time_limit: f64,
    /// Bytes.
    pub memory_limit: Option<u64>,
    /// Whether to avoid nodes where it failed.
    pub avoids_nodes: bool,
}

/// Prepares everything that is needed before the start.
pub(super) fn prepare(
    code: &dyn DftBackend,
    execution: &ExecutionSettings,
    structure: &Structure,
    remedies: &BTreeSet<RetryAdjustment>,
) -> Result<PreparedInput, Failure> {
    let input = code.input(structure, remedies)?;
    let (size, mut record) = (code.size(structure), CalculationRecord::default());
    record.cores = Some(execution.cores);
    record.atoms = u32::try_from(size.atoms).ok();
    record.electrons = Some(size.electrons).filter(|electrons| electrons.is_finite());
    record.k_points = u32::try_from(size.k_points).ok();
    if !remedies.is_empty() {
        record.remedies = names_of_effective(code, structure, remedies, &input)?;
        record.difference = Some(input_diff(&code.input(structure, &BTreeSet::new())?, &input));
    }
    let twice = |remedy| if remedies.contains(&remedy) { 2.0 } else { 1.0 };
    let memory = execution.memory.map(|gigabytes| twice(RetryAdjustment::MoreMemory) * GIGABYTE * gigabytes);
    Ok(PreparedInput {
        input,
        record,
        time_limit: twice(RetryAdjustment::MoreTime) * execution.time_limit,
        // The conversion saturates.
        memory_limit: memory.map(|bytes| bytes as u64),
        avoids_nodes: remedies.contains(&RetryAdjustment::OtherNode),
    })
}

/// Names of the adjustments, separated by commas. Other moments are left out where the input has none, since the
/// calculation then starts as without them. Everything else acts outside the input as well.
fn names_of_effective(
    code: &dyn DftBackend,
    structure: &Structure,
    adjustments: &BTreeSet<RetryAdjustment>,
    input: &CalculationInput,
) -> Result<Option<String>, Failure> {
    let mut effective = adjustments.clone();
    if effective.remove(&RetryAdjustment::OtherMoments) && code.input(structure, &effective)? != *input {
        effective = adjustments.clone();
    }
    let names: Vec<_> = effective.iter().map(|adjustment| adjustment.name()).collect();
    Ok((!names.is_empty()).then(|| names.join(",")))
}

/// Writes the input into the directory of a calculation.
///
/// # Errors
/// The input cannot be written, or a file to be copied no longer has the hash in the protocol.
pub(super) fn write(directory: &Path, input: &CalculationInput) -> Result<(), StoreError> {
    let copy = |(name, original): (&String, &PinnedFile)| match original.content() {
        Ok(content) => Ok((name.clone(), content)),
        Err(error) => Err(file_error(original.path(), error)),
    };
    let data = input.data.iter().map(copy).collect::<Result<BTreeMap<_, _>, _>>()?;
    let written = fill(&directory.join(WORK), &input.files).and_then(|()| fill(&directory.join(DATA), &data));
    written.map_err(|error| file_error(directory, error))
}

/// Creates a folder with these files.
fn fill(folder: &Path, files: &BTreeMap<String, Vec<u8>>) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    for (name, bytes) in files {
        let path = folder.join(name);
        path.parent().map_or(Ok(()), fs::create_dir_all)?;
        fs::write(path, bytes)?;
    }
    Ok(())
}

/// Checks and reads the results of a calculation. If it reached a limit, that is the failure, whatever its files
/// contain.
pub(super) fn read(
    code: &dyn DftBackend,
    structure: &Structure,
    work: &Path,
    exit: Exit,
) -> Result<CalculationResults, Failure> {
    code.read(structure, work, exit).map_err(|failure| failure_at(exit, failure))
}

#[cfg(test)]
mod tests {
    use atoms::{Cell, Species};
    use dft::{CalculationSize, SetupError};
    use store::records::OTHER_MOMENTS;

    use super::*;

    /// A program whose input has a moment, or none.
    struct Program {
        moment: Option<f64>,
    }

    impl DftBackend for Program {
        fn identity(&self) -> serde_json::Value {
            serde_json::Value::Null
        }

        fn supports(&self, _: &BTreeSet<Species>) -> Result<(), SetupError> {
            Ok(())
        }

        fn input(
            &self,
            _: &Structure,
            adjustments: &BTreeSet<RetryAdjustment>,
        ) -> Result<CalculationInput, Failure> {
            let factor = if adjustments.contains(&RetryAdjustment::OtherMoments) { 0.5 } else { 1.0 };
            let moment = self.moment.map(|moment| ("input".to_owned(), (factor * moment).to_string().into()));
            Ok(CalculationInput { files: moment.into_iter().collect(), ..CalculationInput::default() })
        }

        fn read(&self, _: &Structure, _: &Path, _: Exit) -> Result<CalculationResults, Failure> {
            Ok(CalculationResults::default())
        }

        fn size(&self, _: &Structure) -> CalculationSize {
            CalculationSize::default()
        }
    }

    #[test]
    fn other_moments_are_recorded_where_they_change_the_input() {
        assert_eq!(RetryAdjustment::OtherMoments.name(), OTHER_MOMENTS);
        let structure = Structure {
            species: vec!["Fe".parse().unwrap()],
            positions: vec![[0.0; 3]],
            cell: Cell::orthorhombic(3.0, 3.0, 3.0),
            periodic: [true; 3],
        };
        let recorded = |moment: Option<f64>, adjustments: &[RetryAdjustment]| {
            let adjustments = adjustments.iter().copied().collect();
            let prepared =
                prepare(&Program { moment }, &ExecutionSettings::default(), &structure, &adjustments);
            prepared.unwrap().record.remedies
        };
        let both = [RetryAdjustment::MoreTime, RetryAdjustment::OtherMoments];
        assert_eq!(recorded(Some(1.0), &both).as_deref(), Some("other_moments,more_time"));
        assert_eq!(recorded(Some(0.0), &both).as_deref(), Some("more_time"));
        assert_eq!(recorded(None, &both).as_deref(), Some("more_time"));
        assert_eq!(recorded(None, &both[1..]), None);
        assert_eq!(recorded(Some(1.0), &both[..1]).as_deref(), Some("more_time"));
    }
}

//! Before a calculation, and after it: files and numbers, nothing runs here.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::Path;

use atoms::Structure;
use dft::{Calculated, Code, Exit, Failure, Input, Remedy};
use store::CalculationRecord;

use super::Running;
use super::difference::difference;
use super::keeper::WORK;

/// Bytes of a GB.
const GIGABYTE: f64 = 1e9;

/// What a calculation starts from, and what is said of it in the store.
pub(super) struct Prepared {
    pub input: Input,
    pub record: CalculationRecord,
    /// Seconds.
    pub time_limit: f64,
    /// Bytes.
    pub memory_limit: Option<u64>,
    /// Whether it is not to run where it failed.
    pub avoids_nodes: bool,
}

/// Everything that is known before anything is started.
pub(super) fn prepare(
    code: &dyn Code,
    running: &Running,
    structure: &Structure,
    remedies: &BTreeSet<Remedy>,
) -> Result<Prepared, Failure> {
    let input = code.input(structure, remedies)?;
    let (size, mut record) = (code.size(structure), CalculationRecord::default());
    record.cores = Some(running.cores);
    record.atoms = u32::try_from(size.atoms).ok();
    record.electrons = Some(size.electrons).filter(|electrons| electrons.is_finite());
    record.k_points = u32::try_from(size.k_points).ok();
    if !remedies.is_empty() {
        let names: Vec<_> = remedies.iter().map(|remedy| remedy.name()).collect();
        record.remedies = Some(names.join(","));
        record.difference = Some(difference(&code.input(structure, &BTreeSet::new())?, &input));
    }
    let twice = |remedy| if remedies.contains(&remedy) { 2.0 } else { 1.0 };
    let memory = running.memory.map(|gigabytes| twice(Remedy::MoreMemory) * GIGABYTE * gigabytes);
    Ok(Prepared {
        input,
        record,
        time_limit: twice(Remedy::MoreTime) * running.time_limit,
        // The conversion saturates.
        memory_limit: memory.map(|bytes| bytes as u64),
        avoids_nodes: remedies.contains(&Remedy::OtherNode),
    })
}

/// Makes the directory of a calculation, with its input in it.
pub(super) fn write(directory: &Path, input: &Input) -> io::Result<()> {
    let work = directory.join(WORK);
    fs::create_dir_all(&work)?;
    for (name, bytes) in &input.files {
        let path = work.join(name);
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder)?;
        }
        fs::write(path, bytes)?;
    }
    Ok(())
}

/// Judges a calculation that ended so, and reads its numbers. Where a limit has ended it, that is why it failed, whatever
/// its files look like.
pub(super) fn read(
    code: &dyn Code,
    structure: &Structure,
    work: &Path,
    exit: Exit,
) -> Result<Calculated, Failure> {
    code.read(structure, work, exit).map_err(|failure| match exit {
        Exit::TimeLimit | Exit::OutOfMemory | Exit::LostNode => exit.failure(),
        Exit::Code(_) | Exit::Signal(_) => failure,
    })
}

//! Unfinished files of a killed process.

use std::fs;
use std::path::Path;

use crate::atomic_file::cannot_write;
use crate::cli::CommandError;

/// Number of random characters in the name of a temporary file, as `tempfile` makes it.
const RANDOM: usize = 6;

/// Removes the temporary files `.NAME.RANDOM.part` beside the file NAME, which a killed process has left; `target` is its path without
/// symbolic links. A directory that cannot be read has none.
///
/// # Errors
/// A file that cannot be removed.
pub fn remove_left_parts(target: &Path) -> Result<(), CommandError> {
    let (Some(directory), Some(name)) = (target.parent(), target.file_name()) else { return Ok(()) };
    let name = name.to_string_lossy();
    for entry in fs::read_dir(directory).into_iter().flatten().flatten() {
        let is_part = is_part_of(&entry.file_name().to_string_lossy(), &name);
        if is_part && entry.file_type().is_ok_and(|kind| kind.is_file()) {
            fs::remove_file(entry.path()).map_err(|error| cannot_write(&entry.path(), error))?;
        }
    }
    Ok(())
}

fn is_part_of(file: &str, name: &str) -> bool {
    let random = file.strip_prefix('.').and_then(|rest| rest.strip_prefix(name));
    let random = random.and_then(|rest| rest.strip_prefix('.')?.strip_suffix(".part"));
    random.is_some_and(|random| {
        random.len() == RANDOM && random.chars().all(|letter| letter.is_ascii_alphanumeric())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atomic_file::AtomicFile;

    #[test]
    fn only_parts_of_this_file_are_removed() {
        let directory = tempfile::tempdir().unwrap();
        let here = |name: &str| directory.path().join(name);
        let others = ["new.npz", ".new.npz.upfit.aB3x9Z.part", ".new.npz.part", ".old.npz.aB3x9Z.part"];
        others.iter().for_each(|name| fs::write(here(name), "").unwrap());
        // As a killed process leaves it.
        std::mem::forget(AtomicFile::create(&here("new.npz")).unwrap());
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 5);
        remove_left_parts(&here("new.npz")).unwrap();
        let left = fs::read_dir(directory.path()).unwrap().map(|entry| entry.unwrap().file_name());
        let mut left: Vec<_> = left.map(|name| name.into_string().unwrap()).collect();
        left.sort();
        let mut expected = others;
        expected.sort();
        assert_eq!(left, expected);
        remove_left_parts(&here("missing/new.npz")).unwrap();
    }
}

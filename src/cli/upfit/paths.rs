//! Finds errors in paths before hours of work.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::left_parts::remove_left_parts;
use crate::atomic_file::{AtomicFile, refuse_to_replace};
use crate::cli::CommandError;

/// Checks that no file of structures is given twice, and that outputs can be written, and replace neither an input nor each
/// other. Two names of one file are recognised. Removes what a killed process left beside the outputs. Each file of structures
/// comes with a description.
pub fn check_paths(
    model: &Path,
    structures: &[(&Path, &str)],
    outputs: &[&Path],
) -> Result<(), CommandError> {
    refuse_the_same(structures)?;
    let mut known = BTreeMap::new();
    for output in outputs {
        refuse_to_replace(output, std::iter::once((model, "the model")))?;
        refuse_to_replace(output, structures.iter().copied())?;
        if let Some(other) = known.insert(resolved(output), output) {
            let (output, other) = (output.display(), other.display());
            return Err(CommandError::Input(format!(
                "{output} and {other}: one file is named for two outputs"
            )));
        }
        remove_left_parts(&resolved(output))?;
        AtomicFile::create(output).map(drop)?;
    }
    Ok(())
}

/// Refuses two names of one file. Each comes with a description.
fn refuse_the_same(files: &[(&Path, &str)]) -> Result<(), CommandError> {
    let mut known = BTreeMap::new();
    for (path, what) in files {
        if let Some((other, of_other)) = known.insert(resolved(path), (path, what)) {
            let (path, other) = (path.display(), other.display());
            return Err(CommandError::Input(format!(
                "{path}, {what}, is the same file as {other}, {of_other}; expected different files"
            )));
        }
    }
    Ok(())
}

/// The absolute path without symbolic links. The file need not exist.
pub fn resolved(path: &Path) -> PathBuf {
    let of_new = || {
        let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
        let parent = parent.unwrap_or(Path::new(".")).canonicalize().ok()?;
        Some(parent.join(path.file_name()?))
    };
    path.canonicalize().ok().or_else(of_new).unwrap_or_else(|| path.to_owned())
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn names_of_one_file_are_recognised() {
        let directory = tempfile::tempdir().unwrap();
        let here = |name: &str| directory.path().join(name);
        fs::create_dir(here("data")).unwrap();
        fs::write(here("data/a.xyz"), "").unwrap();
        symlink(here("data/a.xyz"), here("link.xyz")).unwrap();
        assert_eq!(resolved(&here("link.xyz")), resolved(&here("data/../data/a.xyz")));
        // Files that do not exist yet.
        assert_eq!(resolved(&here("new.npz")), resolved(&here("data/../new.npz")));
        assert_ne!(resolved(&here("new.npz")), resolved(&here("other.npz")));
    }
}

//! Output files that appear complete or not at all.

use std::collections::BTreeMap;
use std::fs::{self, File, Permissions};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use tempfile::{Builder, TempPath};

use crate::exit_status::CommandError;

/// A file that is written to a temporary file beside its target and renamed when it is complete. A killed process
/// leaves the old file unchanged.
pub struct AtomicFile {
    target: PathBuf,
    file: BufWriter<File>,
    /// `None` for a device or a pipe, which is written to directly.
    temporary: Option<TempPath>,
}

impl AtomicFile {
    /// Creates the temporary file for `target`.
    pub fn create(target: &Path) -> Result<Self, CommandError> {
        let cannot = |error| cannot_create(target, error);
        // Replaces the target of a symbolic link, not the link.
        let target = target.canonicalize().unwrap_or_else(|_| target.to_owned());
        if fs::metadata(&target).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
            let file = File::options().write(true).open(&target).map_err(cannot)?;
            return Ok(Self { target, file: BufWriter::new(file), temporary: None });
        }
        let Some(name) = target.file_name().filter(|_| !target.is_dir()) else {
            return Err(cannot(io::ErrorKind::IsADirectory.into()));
        };
        let directory =
            target.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        fs::metadata(directory).map_err(cannot)?;
        let prefix = format!(".{}.", name.to_string_lossy());
        let mut builder = Builder::new();
        let builder = builder.prefix(&prefix).suffix(".part").permissions(Permissions::from_mode(0o666));
        let (file, temporary) = builder.tempfile_in(directory).map_err(cannot)?.into_parts();
        Ok(Self { target, file: BufWriter::new(file), temporary: Some(temporary) })
    }

    /// Renames the complete file to its target, for good.
    pub fn finish(self) -> Result<(), CommandError> {
        let Self { target, file, temporary } = self;
        let cannot = |error| cannot_write(&target, error);
        let file = file.into_inner().map_err(|error| cannot(error.into_error()))?;
        let Some(temporary) = temporary else { return Ok(()) };
        file.sync_all().map_err(cannot)?;
        temporary.persist(&target).map_err(|error| cannot(error.error))?;
        // So that the name lasts through a power cut, too; not every file system can do this.
        let parent = target.parent().filter(|parent| !parent.as_os_str().is_empty());
        let _ = File::open(parent.unwrap_or(Path::new("."))).and_then(|parent| parent.sync_all());
        Ok(())
    }
}

/// The failure to write an output file.
pub fn cannot_write(path: &Path, error: impl std::fmt::Display) -> CommandError {
    CommandError::Failed(format!("cannot write {}: {error}", path.display()))
}

/// The failure to create an output file. A wrong path is wrong input.
pub fn cannot_create(path: &Path, error: io::Error) -> CommandError {
    use io::ErrorKind as Kind;
    let message = format!("cannot write {}: {error}", path.display());
    match error.kind() {
        Kind::NotFound | Kind::NotADirectory | Kind::IsADirectory | Kind::PermissionDenied => {
            CommandError::Input(message)
        }
        _ => CommandError::Failed(message),
    }
}

/// Refuses an output that would overwrite one of these files. Each comes with a description.
pub fn refuse_to_replace<'a>(
    output: &Path,
    files: impl IntoIterator<Item = (&'a Path, &'a str)>,
) -> Result<(), CommandError> {
    let Ok(output_file) = output.canonicalize() else { return Ok(()) };
    let same = |(file, _): &(&Path, &str)| file.canonicalize().is_ok_and(|file| file == output_file);
    match files.into_iter().find(same) {
        Some((_, what)) => {
            let shown = output.display();
            Err(CommandError::Input(format!("{shown} is {what}: name another file for the output")))
        }
        None => Ok(()),
    }
}

/// Checks the outputs of a command before its work: they can be written, and replace neither an input, which comes with a description, nor
/// each other. Two names of one file are recognised.
pub fn check_outputs<'a>(
    outputs: impl IntoIterator<Item = &'a Path>,
    inputs: &[(&Path, &str)],
) -> Result<(), CommandError> {
    let mut known = BTreeMap::new();
    for output in outputs {
        refuse_to_replace(output, inputs.iter().copied())?;
        if let Some(other) = known.insert(resolved(output), output)
            && !fs::metadata(output).is_ok_and(|found| !found.is_file())
        {
            let (output, other) = (output.display(), other.display());
            return Err(CommandError::Input(format!(
                "{output} and {other}: one file is named for two outputs"
            )));
        }
        // Opening and closing a pipe would end its reader.
        if !fs::metadata(output).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
            AtomicFile::create(output).map(drop)?;
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

impl Write for AtomicFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for AtomicFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn the_file_appears_when_it_is_complete() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("out");
        fs::write(&path, "old").unwrap();
        let mut file = AtomicFile::create(&path).unwrap();
        file.write_all(b"new").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        drop(file);
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);

        let mut file = AtomicFile::create(&path).unwrap();
        file.write_all(b"new").unwrap();
        file.finish().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_directory_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        assert!(AtomicFile::create(directory.path()).is_err());
        assert!(AtomicFile::create(&directory.path().join("missing/out")).is_err());
    }

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

        let check = |outputs: &[&str]| {
            let outputs: Vec<_> = outputs.iter().map(|name| here(name)).collect();
            let input = here("data/a.xyz");
            check_outputs(outputs.iter().map(PathBuf::as_path), &[(&input, "the input")])
                .map_err(|error| error.to_string())
        };
        assert_eq!(check(&["new.npz", "other.npz"]), Ok(()));
        // A device can take several outputs.
        assert_eq!(check(&["/dev/null", "/dev/null"]), Ok(()));
        assert!(check(&["new.npz", "data/../new.npz"]).unwrap_err().contains("named for two outputs"));
        assert!(check(&["new.npz", "link.xyz"]).unwrap_err().contains("is the input: name another file"));
        assert!(check(&["missing/new.npz"]).is_err());
        assert!(!here("new.npz").exists());
    }
}

//! What Slurm last said of the jobs that live: one labeller asks, and all of the campaign read the answer.
//!
//! It is only believed about jobs that are in it. Of one that is not, whoever waits for it asks for itself.

use std::fs;
use std::path::Path;

use ::slurm::Commands;
use dft::result_file;

use super::{Job, SQUEUE_INTERVAL};

/// Beside the directories of calculations.
const CACHE_FILE: &str = "calmwalk-squeue";

/// Whether the job was said to live lately, or nobody answers.
pub(super) async fn is_alive(commands: &Commands, job: &Job) -> bool {
    let path = job.directory.with_file_name(CACHE_FILE);
    let names = match read_recent(&path) {
        Some(names) => names,
        None => match commands.queue("%j", &[]).await {
            Ok(names) => {
                write_cache(&path, &names);
                names
            }
            Err(error) => return !error.is_missing(),
        },
    };
    names.lines().any(|name| name == job.name)
}

/// Removes it from the directory that held those of calculations.
pub(in super::super) fn remove_cache(root: &Path) {
    let _ = fs::remove_file(root.join(CACHE_FILE));
}

/// The answer, if it is not old. Clocks that do not agree make it look older, or ask for it again.
fn read_recent(path: &Path) -> Option<String> {
    let age = fs::metadata(path).and_then(|file| file.modified()).ok()?.elapsed().ok()?;
    if age >= SQUEUE_INTERVAL {
        return None;
    }
    String::from_utf8(result_file::read(path).ok()?).ok()
}

/// What cannot be written is asked again by all.
fn write_cache(path: &Path, names: &str) {
    let unfinished = path.with_extension(std::process::id().to_string());
    let _ = fs::write(&unfinished, names).and_then(|()| fs::rename(&unfinished, path));
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;

    #[test]
    fn an_answer_is_read_for_a_while() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(CACHE_FILE);
        assert_eq!(read_recent(&path), None);
        write_cache(&path, "a\nb\n");
        assert_eq!(read_recent(&path).as_deref(), Some("a\nb\n"));
        for moment in [SystemTime::now() - SQUEUE_INTERVAL, SystemTime::now() + SQUEUE_INTERVAL] {
            fs::File::options().write(true).open(&path).unwrap().set_modified(moment).unwrap();
            assert_eq!(read_recent(&path), None);
        }
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }
}

//! A shared cache of the running jobs: one labeller queries Slurm, and all labellers of the campaign read the
//! answer.
//!
//! It counts only for jobs that it contains. A labeller whose job is missing queries Slurm itself.

use std::fs;
use std::path::Path;
use std::time::Duration;

use ::batch::SlurmClient;
use dft::result_file;

use super::job::CalculationJob;

/// Time between two queries to Slurm.
pub(super) const SQUEUE_INTERVAL: Duration = Duration::from_secs(20);
/// File beside the directories of calculations.
const CACHE_FILE: &str = "calmwalk-squeue";

/// Whether Slurm recently reported the job as alive, or does not answer.
pub(super) async fn is_alive(commands: &SlurmClient, job: &CalculationJob) -> bool {
    let path = job.directory.with_file_name(CACHE_FILE);
    let names = match read_recent(&path) {
        Some(names) => names,
        None => match commands.queue("%j", &[]).await {
            Ok(names) => {
                write_cache(&path, &names);
                names
            }
            Err(error) => return !error.is_missing() && is_listed(None, &job.name),
        },
    };
    is_listed(Some(&names), &job.name)
}

/// Whether the job of that name counts as alive by Slurm's list of the unfinished ones, one name a line; `None` if Slurm does
/// not answer: then nothing is concluded.
pub fn is_listed(names: Option<&str>, job: &str) -> bool {
    names.is_none_or(|names| names.lines().any(|name| name == job))
}

/// Removes the cache from the directory of a campaign's calculations.
pub(in super::super) fn remove_cache(root: &Path) {
    let _ = fs::remove_file(root.join(CACHE_FILE));
}

/// The cached answer, if it is recent. Clock differences only make it look older, or cause another query.
fn read_recent(path: &Path) -> Option<String> {
    let age = fs::metadata(path).and_then(|file| file.modified()).ok()?.elapsed().ok()?;
    if age >= SQUEUE_INTERVAL {
        return None;
    }
    String::from_utf8(result_file::read(path).ok()?).ok()
}

/// If it cannot be written, every labeller queries Slurm itself.
fn write_cache(path: &Path, names: &str) {
    let unfinished = path.with_extension(std::process::id().to_string());
    let _ = fs::write(&unfinished, names).and_then(|()| fs::rename(&unfinished, path));
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;

    #[test]
    fn a_cached_answer_expires() {
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

//! What Slurm last said of the jobs that live: one labeller asks, and all of the campaign read the answer.
//!
//! It is only believed about jobs that are in it. Of one that is not, whoever waits for it asks for itself.

use std::fs;
use std::path::Path;

use ::slurm::SlurmClient;
use dft::result_file;

use super::{Job, LOOK};

/// Beside the directories of calculations.
const FILE: &str = "calmwalk-squeue";

/// Whether the job was said to live lately, or nobody answers.
pub(super) async fn lives(commands: &SlurmClient, job: &Job) -> bool {
    let path = job.directory.with_file_name(FILE);
    let names = match lately(&path) {
        Some(names) => names,
        None => match commands.queue("%j", &[]).await {
            Ok(names) => {
                leave(&path, &names);
                names
            }
            Err(error) => return !error.is_missing(),
        },
    };
    names.lines().any(|name| name == job.name)
}

/// Removes it from the directory that held those of calculations.
pub(in super::super) fn forget(home: &Path) {
    let _ = fs::remove_file(home.join(FILE));
}

/// The answer, if it is not old. Clocks that do not agree make it look older, or ask for it again.
fn lately(path: &Path) -> Option<String> {
    let age = fs::metadata(path).and_then(|file| file.modified()).ok()?.elapsed().ok()?;
    if age >= LOOK {
        return None;
    }
    String::from_utf8(result_file::read(path).ok()?).ok()
}

/// What cannot be written is asked again by all.
fn leave(path: &Path, names: &str) {
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
        let path = directory.path().join(FILE);
        assert_eq!(lately(&path), None);
        leave(&path, "a\nb\n");
        assert_eq!(lately(&path).as_deref(), Some("a\nb\n"));
        for moment in [SystemTime::now() - LOOK, SystemTime::now() + LOOK] {
            fs::File::options().write(true).open(&path).unwrap().set_modified(moment).unwrap();
            assert_eq!(lately(&path), None);
        }
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }
}

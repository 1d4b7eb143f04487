//! A job of a custom batch system, and the files in its directory.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use ::batch::JobId;
use dft::result_file;
use serde::{Deserialize, Serialize};

/// What each submission runs.
pub(super) const SCRIPT: &str = "run.sh";
/// The request to its runner.
pub(super) const REQUEST: &str = "order.json";
/// A link that the job that calculates creates; it leads to the number of its submission.
pub(super) const BEGUN: &str = "begun";
/// Where the link leads when no job may calculate any more.
const CLOSED: &str = "none";
/// Largest number of submissions of a calculation that were not refused: a job may be submitted twice if an answer is lost, and again
/// after it was cancelled before it began.
pub const MAX_SUBMISSIONS: usize = 4;
/// Submissions have numbers from 1 to this, those that were refused too.
pub const MAX_NUMBER: u32 = 12;

/// Identifies the job of a calculation.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(in super::super) struct CustomJob {
    /// Name of the batch system.
    pub scheduler: String,
    pub directory: PathBuf,
    /// The user who submitted it: others may not see it.
    pub user: u32,
    /// Time within which it ends after it has begun, s.
    pub time_limit: u64,
}

/// A submission of a job. Its file exists before the job is submitted.
#[derive(Clone, Debug, PartialEq)]
pub struct JobSubmission {
    /// From 1.
    pub number: u32,
    /// `None` if the answer of the batch system was lost.
    pub id: Option<JobId>,
    /// Time since it was submitted.
    pub age: Duration,
}

impl CustomJob {
    /// The script of a submission.
    pub fn script(&self, number: u32) -> PathBuf {
        script(&self.directory, number)
    }

    /// The output of a submission.
    pub fn log(&self, number: u32) -> PathBuf {
        log(&self.directory, number)
    }

    /// The submission that calculates, and the time since it began.
    pub fn begun(&self) -> Option<(u32, Duration)> {
        let link = self.directory.join(BEGUN);
        let number = fs::read_link(&link).ok()?.to_str()?.parse().ok()?;
        let time = fs::symlink_metadata(&link).and_then(|link| link.modified()).ok()?;
        Some((number, time.elapsed().unwrap_or_default()))
    }

    /// Whether its directory has what a job needs to begin. Somebody may have removed a part of it.
    pub(super) fn can_begin(&self) -> bool {
        [SCRIPT, REQUEST].iter().all(|file| self.directory.join(file).is_file())
    }

    /// The submissions so far that were not refused.
    pub(super) fn submissions(&self) -> Vec<JobSubmission> {
        (1..=MAX_NUMBER).filter_map(|number| self.submission(number)).collect()
    }

    fn submission(&self, number: u32) -> Option<JobSubmission> {
        let path = self.note(number);
        let time = fs::symlink_metadata(&path).and_then(|file| file.modified()).ok()?;
        let text = result_file::read(&path).ok().and_then(|bytes| String::from_utf8(bytes).ok());
        let id = text.and_then(|text| JobId::at_start_of(&text));
        Some(JobSubmission { number, id, age: time.elapsed().unwrap_or_default() })
    }

    /// Whether there may be a further submission.
    pub(super) fn may_be_submitted(&self) -> bool {
        self.submissions().len() < MAX_SUBMISSIONS && self.free_numbers().next().is_some()
    }

    /// Numbers that no submission has had. That of a refused one is not used again: if there is a job all the same, it may
    /// calculate under this number.
    fn free_numbers(&self) -> impl Iterator<Item = u32> {
        let is_there = |path: PathBuf| path.symlink_metadata().is_ok();
        (1..=MAX_NUMBER)
            .filter(move |number| !is_there(self.refusal(*number)) && !is_there(self.note(*number)))
    }

    /// Notes a submission before it is made; `None` if there were too many.
    pub fn begin_submission(&self) -> io::Result<Option<u32>> {
        if !self.may_be_submitted() {
            return Ok(None);
        }
        for number in self.free_numbers() {
            match File::create_new(self.note(number)) {
                Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
                created => return created.map(|_| Some(number)),
            }
        }
        Ok(None)
    }

    /// Notes the id of a submitted job.
    pub fn end_submission(&self, number: u32, id: &JobId) -> io::Result<()> {
        File::options().write(true).open(self.note(number))?.write_all(id.as_str().as_bytes())
    }

    /// Keeps every job from calculating. Returns `false` if one has begun.
    pub fn close(&self) -> io::Result<bool> {
        match std::os::unix::fs::symlink(CLOSED, self.directory.join(BEGUN)) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(self.is_closed()),
            closed => closed.map(|()| true),
        }
    }

    /// Whether no job may calculate any more.
    pub fn is_closed(&self) -> bool {
        fs::read_link(self.directory.join(BEGUN)).is_ok_and(|target| target == Path::new(CLOSED))
    }

    /// Notes that the batch system refused a submission. It no longer counts, and its number is not used again.
    pub fn forget_submission(&self, number: u32) -> io::Result<()> {
        File::create(self.refusal(number))?;
        fs::remove_file(self.note(number))
    }

    fn note(&self, number: u32) -> PathBuf {
        self.directory.join(format!("submission-{number}"))
    }

    fn refusal(&self, number: u32) -> PathBuf {
        self.directory.join(format!("submission-{number}.refused"))
    }
}

pub(super) fn script(directory: &Path, number: u32) -> PathBuf {
    directory.join(format!("submission-{number}.job"))
}

pub(super) fn log(directory: &Path, number: u32) -> PathBuf {
    directory.join(format!("submission-{number}.log"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn submissions_are_noted_before_they_are_made() {
        let home = tempfile::tempdir().unwrap();
        let job = CustomJob {
            scheduler: "PBS".to_owned(),
            directory: home.path().to_owned(),
            user: 0,
            time_limit: 60,
        };
        assert_eq!(job.begin_submission().unwrap(), Some(1));
        assert_eq!(job.begin_submission().unwrap(), Some(2));
        job.end_submission(2, &JobId::from(7)).unwrap();
        let found: Vec<_> = job.submissions().into_iter().map(|one| (one.number, one.id)).collect();
        assert_eq!(found, [(1, None), (2, Some(JobId::from(7)))]);
        job.forget_submission(1).unwrap();
        let numbers: Vec<_> = (0..4).map(|_| job.begin_submission().unwrap()).collect();
        assert_eq!(numbers, [Some(3), Some(4), Some(5), None]);
        (3..=5).for_each(|number| job.forget_submission(number).unwrap());
        for number in 6..=MAX_NUMBER {
            assert_eq!(job.begin_submission().unwrap(), Some(number));
            job.forget_submission(number).unwrap();
        }
        assert_eq!((job.begin_submission().unwrap(), job.submissions().len()), (None, 1));
        assert_eq!(job.begun(), None);
        std::os::unix::fs::symlink("3", home.path().join(BEGUN)).unwrap();
        assert_eq!(job.begun().map(|(number, _)| number), Some(3));
    }
}

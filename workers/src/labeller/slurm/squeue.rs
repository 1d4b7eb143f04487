//! The output of squeue about a job.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use ::batch::{JobId, JobPhase, SlurmError};
use dft::Exit;

use super::super::calculation_runner::{CalculationEnd, EndReason};
use super::super::log::last_lines;
use super::job::{BEGUN, LOG};

/// A job, as `squeue` shows it.
#[derive(Clone, Debug, PartialEq)]
pub struct SqueueJob {
    /// Its number.
    pub id: JobId,
    /// State in Slurm's terms, such as `RUNNING`.
    state: String,
    /// Nodes on which it runs or ran.
    nodes: String,
    /// Run time, s.
    seconds: f64,
    /// Why it waits or how it ended.
    reason: String,
}

impl SqueueJob {
    /// The format for `squeue`.
    pub const FORMAT: &str = "%i|%T|%N|%M|%r";

    /// The jobs in an answer. Records of rejected `sbatch` calls are no jobs.
    ///
    /// # Errors
    /// [`SlurmError::UnexpectedOutput`]
    pub fn parse_all(text: &str) -> Result<Vec<Self>, SlurmError> {
        let jobs: Vec<_> = text.lines().map(Self::parse).collect::<Result<_, _>>()?;
        Ok(jobs.into_iter().filter(|reported| !reported.was_refused()).collect())
    }

    pub(super) fn parse(line: &str) -> Result<Self, SlurmError> {
        let unreadable = || SlurmError::UnexpectedOutput {
            program: "squeue",
            found: line.to_owned(),
            expected: "what --format asks for",
        };
        let fields: Vec<_> = line.splitn(5, '|').collect();
        let [id, state, nodes, time, reason] = fields[..] else { return Err(unreadable()) };
        Ok(Self {
            id: JobId::from(id.parse::<u64>().map_err(|_| unreadable())?),
            state: state.to_owned(),
            nodes: nodes.to_owned(),
            seconds: seconds(time),
            reason: reason.to_owned(),
        })
    }

    pub(super) fn phase(&self) -> JobPhase {
        JobPhase::from_state(&self.state)
    }

    /// Whether it has ended.
    pub fn is_over(&self) -> bool {
        self.phase() == JobPhase::Over
    }

    /// Whether its script ended by itself.
    pub(super) fn ran_to_its_end(&self) -> bool {
        matches!(self.state.as_str(), "COMPLETED" | "FAILED")
    }

    /// Whether this is only the record of a rejected `sbatch` call: such a job never existed.
    fn was_refused(&self) -> bool {
        self.state == "FAILED" && self.nodes.is_empty()
    }

    /// The exit that the state implies. If memory is measured but not confined, a job killed for its memory has the
    /// state `FAILED`.
    fn exit(&self) -> Option<Exit> {
        match self.state.as_str() {
            "TIMEOUT" | "DEADLINE" => Some(Exit::TimeLimit),
            "OUT_OF_MEMORY" => Some(Exit::OutOfMemory),
            "NODE_FAIL" | "BOOT_FAIL" | "PREEMPTED" => Some(Exit::LostNode),
            _ => None,
        }
    }

    /// The node that may be at fault. Nodes of cancelled jobs are not.
    fn node(&self) -> Option<String> {
        let blamed = ["NODE_FAIL", "BOOT_FAIL", "LAUNCH_FAILED", "OUT_OF_MEMORY", "FAILED", "COMPLETED"];
        let node = blamed.contains(&self.state.as_str()).then(|| self.nodes.clone());
        node.filter(|node| !node.is_empty())
    }
}

impl fmt::Display for SqueueJob {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "job {} is {}", self.id, self.state)?;
        if !self.nodes.is_empty() {
            write!(f, " on {}", self.nodes)?;
        }
        match self.reason.as_str() {
            "" | "None" => Ok(()),
            reason => write!(f, " ({reason})"),
        }
    }
}

/// The most informative of several jobs with the same name: of jobs submitted twice, one did nothing.
pub(super) fn most_informative(jobs: &[SqueueJob]) -> Option<&SqueueJob> {
    let said_more = jobs.iter().find(|reported| reported.state != "COMPLETED");
    said_more.or_else(|| jobs.first())
}

/// The jobs to cancel, of those with the same name. What ends already is left alone.
pub fn jobs_to_cancel(jobs: &[SqueueJob]) -> Vec<JobId> {
    let living =
        jobs.iter().filter(|reported| !matches!(reported.phase(), JobPhase::Over | JobPhase::Completing));
    living.map(|reported| reported.id.clone()).collect()
}

/// What a job left in its directory.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Traces {
    /// The end of Slurm's log, which gives the reason if Slurm ended the job.
    log: String,
    /// Time from its start to the last entry of the log, s.
    seconds: f64,
}

impl Traces {
    /// The end of a log, and the time from the job's start to the last entry of it, s.
    pub fn new(log: String, seconds: f64) -> Self {
        Self { log, seconds }
    }

    pub(in super::super) fn log(&self) -> &str {
        &self.log
    }

    pub(in super::super) fn seconds(&self) -> f64 {
        self.seconds
    }

    pub(super) fn read(directory: &Path) -> Self {
        let log = directory.join(LOG);
        let changed = |path: &Path| fs::metadata(path).and_then(|file| file.modified()).ok();
        let times = changed(&directory.join(BEGUN)).zip(changed(&log));
        let lasted = times.and_then(|(begun, ended)| ended.duration_since(begun).ok());
        Self { log: last_lines(&log), seconds: lasted.unwrap_or_default().as_secs_f64() }
    }

    fn exit(&self) -> Option<Exit> {
        let speaks_of = |words: &[&str]| words.iter().any(|words| self.log.contains(words));
        if speaks_of(&["memory limit", "oom_kill", "oom-kill", "OOM Killed"]) {
            return Some(Exit::OutOfMemory);
        }
        speaks_of(&["DUE TO TIME LIMIT"]).then_some(Exit::TimeLimit)
    }

    /// What the log says of the end: Slurm's last line, or the last line of all. The shell may write `Terminated` after Slurm.
    fn last_words(&self) -> Option<&str> {
        let of_slurm = self.log.lines().rfind(|line| line.starts_with("slurmstepd"));
        of_slurm.or_else(|| self.log.lines().next_back())
    }
}

/// Infers how a calculation ended whose job is over or unknown to Slurm and whose runner recorded no end.
pub fn infer_end(reported: Option<&SqueueJob>, traces: &Traces) -> CalculationEnd {
    let mut remark = match reported {
        Some(reported) => format!("Slurm reports: {reported}; its runner did not record an end"),
        None => "Slurm no longer knows its job, and its runner did not record an end".to_owned(),
    };
    if let Some(line) = traces.last_words() {
        remark += &format!("; the job's log says: {line}");
    }
    let exit = reported.and_then(SqueueJob::exit).or_else(|| traces.exit());
    CalculationEnd {
        how: EndReason::Ended(exit.unwrap_or(Exit::LostNode)),
        program: PathBuf::new(),
        seconds: reported.map_or(traces.seconds, |reported| reported.seconds),
        memory: 0,
        node: reported.and_then(SqueueJob::node),
        remark: Some(remark),
    }
}

/// Parses `1-02:03:04`, `2:03:04` or `3:04`; 0 for anything else.
fn seconds(time: &str) -> f64 {
    let (days, time) = time.split_once('-').unwrap_or(("0", time));
    let parts = time.split(':').map(|part| part.parse::<f64>().ok());
    let sum = parts.reduce(|sum, part| Some(60.0 * sum? + part?)).flatten();
    let days: Option<f64> = days.parse().ok();
    sum.zip(days).map_or(0.0, |(sum, days)| 86_400.0 * days + sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reported(state: &str) -> SqueueJob {
        SqueueJob::parse(&format!("12|{state}|node7|1:01|None")).unwrap()
    }

    #[test]
    fn lines_of_squeue_are_read() {
        let job = SqueueJob::parse("12|RUNNING|node7|1-02:03:04|Node | failure").unwrap();
        assert_eq!((job.id.number(), job.phase(), job.seconds), (Some(12), JobPhase::Running, 93_784.0));
        assert_eq!(job.to_string(), "job 12 is RUNNING on node7 (Node | failure)");
        assert!(
            SqueueJob::parse("12|RUNNING|node7").is_err()
                && SqueueJob::parse("x|RUNNING||0:00|None").is_err()
        );
        for (time, expected) in
            [("0:00", 0.0), ("1:01", 61.0), ("2:03:04", 7384.0), ("INVALID", 0.0), ("", 0.0)]
        {
            assert_eq!(seconds(time), expected, "{time}");
        }
    }

    #[test]
    fn a_job_without_a_recorded_end_ends_as_slurm_reports() {
        use Exit::{LostNode, OutOfMemory, TimeLimit};
        let expected = [
            ("TIMEOUT", TimeLimit, None),
            ("OUT_OF_MEMORY", OutOfMemory, Some("node7")),
            ("NODE_FAIL", LostNode, Some("node7")),
            ("FAILED", LostNode, Some("node7")),
            ("CANCELLED", LostNode, None),
            ("PREEMPTED", LostNode, None),
        ];
        for (state, exit, node) in expected {
            let end = infer_end(Some(&reported(state)), &Traces::default());
            assert_eq!((end.how, end.node.as_deref()), (EndReason::Ended(exit), node), "{state}");
            assert_eq!(end.seconds, 61.0);
            assert!(end.remark.unwrap().contains(state));
        }
    }

    /// Log lines of Slurm 22.05.
    #[test]
    fn the_log_gives_the_end_of_a_forgotten_job() {
        use Exit::{LostNode, OutOfMemory, TimeLimit};
        let cancelled = "slurmstepd-n1: error: *** JOB 1 ON n1 CANCELLED AT 2026-11-22T12:06:38";
        let memory = "slurmstepd-n1: error: StepId=1.batch exceeded memory limit (434741248 > 104857600), being killed";
        let killed = "slurmstepd: error: Detected 1 oom_kill event in StepId=1.batch. Some of the step tasks have been OOM Killed.";
        let logs = [
            (String::new(), LostNode),
            (format!("{cancelled} ***"), LostNode),
            (format!("{cancelled} DUE TO NODE FAILURE, SEE SLURMCTLD LOG FOR DETAILS ***"), LostNode),
            (format!("{cancelled} DUE TO TIME LIMIT ***"), TimeLimit),
            (format!("{memory}\n{cancelled} ***"), OutOfMemory),
            (killed.to_owned(), OutOfMemory),
        ];
        for (log, exit) in logs {
            let traces = Traces { log: log.clone(), seconds: 7.0 };
            let forgotten = infer_end(None, &traces);
            assert_eq!(
                (forgotten.how, forgotten.seconds, forgotten.node),
                (EndReason::Ended(exit), 7.0, None)
            );
            let remark = forgotten.remark.unwrap();
            assert!(remark.ends_with(log.lines().last().unwrap_or("an end")), "{remark}");
            // The shell appends its message after Slurm's.
            let ended = Traces { log: format!("{log}\nTerminated"), seconds: 7.0 };
            let forgotten = infer_end(None, &ended);
            assert_eq!(forgotten.how, EndReason::Ended(exit));
            let remark = forgotten.remark.unwrap();
            assert!(remark.ends_with(log.lines().last().unwrap_or("Terminated")), "{remark}");
            // Cases without a state of their own in Slurm.
            assert_eq!(infer_end(Some(&reported("FAILED")), &traces).how, EndReason::Ended(exit), "{log}");
            assert_eq!(
                infer_end(Some(&reported("TIMEOUT")), &traces).how,
                EndReason::Ended(TimeLimit),
                "{log}"
            );
        }
    }

    #[test]
    fn a_job_that_slurm_refused_is_ignored() {
        let refused = SqueueJob::parse("3|FAILED||0:00|BadConstraints").unwrap();
        assert!(refused.was_refused() && !reported("FAILED").was_refused());
        assert!(!SqueueJob::parse("3|CANCELLED||0:00|None").unwrap().was_refused());
    }

    #[test]
    fn of_two_jobs_with_one_name_the_informative_one_counts() {
        let jobs = [reported("COMPLETED"), reported("TIMEOUT")];
        assert_eq!(most_informative(&jobs), Some(&jobs[1]));
        assert_eq!(most_informative(&jobs[..1]), Some(&jobs[0]));
        assert_eq!(most_informative(&[]), None);
    }
}

//! How a calculation ended whose runner recorded no end.

use std::fs;
use std::path::{Path, PathBuf};

use ::batch::{CustomScheduler, JobId, PolledState};
use dft::Exit;

use super::super::calculation_runner::{CalculationEnd, EndReason};
use super::super::log::last_lines;
use super::super::slurm::Traces;
use super::job::{BEGUN, CustomJob};

/// Infers how a calculation ended whose job is over or unknown and whose runner recorded no end: from what the batch system has written
/// into the job's output.
pub fn infer_custom_end(
    scheduler: &CustomScheduler,
    id: Option<&JobId>,
    state: PolledState,
    traces: &Traces,
) -> CalculationEnd {
    let text = traces.log();
    let line_with = |texts: &[String]| {
        text.lines().rfind(|line| texts.iter().any(|text| line.contains(text))).map(str::to_owned)
    };
    let reasons = [
        (line_with(&scheduler.log.out_of_memory), Exit::OutOfMemory),
        (line_with(&scheduler.log.time_limit), Exit::TimeLimit),
    ];
    let found = reasons.into_iter().find_map(|(line, exit)| Some((line?, exit)));
    let (line, exit) = match found {
        Some((line, exit)) => (Some(line), exit),
        None => (text.lines().next_back().map(str::to_owned), Exit::LostNode),
    };
    let name = &scheduler.name;
    let mut remark = match (id, state) {
        (None, _) => format!("the id of its job at {name} is unknown, and its time limit is over"),
        (Some(id), PolledState::Vanished) => format!("{name} no longer knows its job {id}"),
        (Some(id), state) => format!("{name} reports: job {id} is {}", state.name()),
    };
    remark += ", and its runner did not record an end";
    if let Some(line) = line {
        remark += &format!("; the job's log says: {line}");
    }
    CalculationEnd {
        how: EndReason::Ended(exit),
        program: PathBuf::new(),
        seconds: traces.seconds(),
        memory: 0,
        node: None,
        remark: Some(remark),
    }
}

/// What the submission with this number has left.
pub(super) fn traces(job: &CustomJob, number: u32) -> Traces {
    let log = job.log(number);
    Traces::new(last_lines(&log), seconds(&job.directory.join(BEGUN), &log))
}

/// Time from the begin of a job to the last entry of its log, s.
fn seconds(begun: &Path, log: &Path) -> f64 {
    let changed = |path: &Path| fs::symlink_metadata(path).and_then(|file| file.modified()).ok();
    let lasted = changed(begun).zip(changed(log)).and_then(|(begun, ended)| ended.duration_since(begun).ok());
    lasted.unwrap_or_default().as_secs_f64()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_log_of_the_job_says_why_it_was_ended() {
        let home = tempfile::tempdir().unwrap();
        let scheduler: CustomScheduler = toml::from_str(
            r#"
            name = "PBS"
            submit = "qsub"
            poll = "qstat {id}"
            states = { pending = [], running = ["R"], completed = ["F"] }
            vanished = ["Unknown"]
            cancel = "qdel {id}"
            script = "{command}"
            log = { time_limit = ["job killed: walltime"], out_of_memory = ["job killed: mem"] }
            "#,
        )
        .unwrap();
        let job = CustomJob {
            scheduler: "PBS".to_owned(),
            directory: home.path().to_owned(),
            user: 0,
            time_limit: 60,
        };
        for (log, exit) in [
            ("", Exit::LostNode),
            ("starts\n=>> PBS: job killed: walltime 61 exceeded limit 60\nTerminated", Exit::TimeLimit),
            ("=>> PBS: job killed: mem 2097152kb exceeded limit 1048576kb", Exit::OutOfMemory),
        ] {
            fs::write(job.log(2), log).unwrap();
            let end =
                infer_custom_end(&scheduler, Some(&JobId::from(7)), PolledState::Completed, &traces(&job, 2));
            assert_eq!(end.how, EndReason::Ended(exit), "{log}");
            let remark = end.remark.unwrap();
            assert!(
                remark.starts_with("PBS reports: job 7 is COMPLETED, and its runner did not"),
                "{remark}"
            );
            assert!(exit == Exit::LostNode || remark.contains("the job's log says: =>> PBS"), "{remark}");
        }
        let remark =
            infer_custom_end(&scheduler, None, PolledState::Vanished, &traces(&job, 1)).remark.unwrap();
        assert!(remark.starts_with("the id of its job at PBS is unknown"), "{remark}");
    }
}

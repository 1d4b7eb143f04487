//! The scripts of a job. They contain everything needed to submit the job again.

use std::fs;
use std::io;
use std::path::Path;
use std::time::Duration;

use ::batch::{CustomClient, JobRequest, quoted};

use super::super::calculation_runner::{self, Calculation, NODE_VARIABLE, RunnerRequest};
use super::super::slurm::runner;
use super::job::{self, BEGUN, MAX_NUMBER, REQUEST, SCRIPT};

/// The time limit of the job exceeds that of the runner, which ends the calculation in order, by this, s.
const MARGIN: f64 = 60.0;

/// Time within which a job ends after it has begun, s.
pub(super) fn time_limit(calculation: &Calculation) -> u64 {
    let seconds = (calculation.time_limit + MARGIN).ceil();
    if seconds < u64::MAX as f64 { seconds as u64 } else { u64::MAX }
}

/// Writes everything that the job of a calculation needs into its directory.
pub(super) fn write(
    calculation: Calculation,
    client: &CustomClient,
    cores: u32,
    gpus: u32,
) -> io::Result<()> {
    let directory = calculation.directory.clone();
    let run = quoted(&text(&directory.join(SCRIPT))?);
    for number in 1..=MAX_NUMBER {
        let request = JobRequest {
            name: name(&directory),
            cores,
            gpus,
            memory: calculation.memory_limit,
            time_limit: Some(Duration::from_secs(time_limit(&calculation))),
            directory: directory.clone(),
            output: job::log(&directory, number),
            command: format!("sh {run} {number}"),
        };
        let script = client.job_script(&request).map_err(io::Error::other)?;
        fs::write(job::script(&directory, number), script)?;
    }
    fs::write(directory.join(SCRIPT), run_script(&calculation)?)?;
    calculation_runner::send_request(
        fs::File::create(directory.join(REQUEST))?,
        &RunnerRequest::Run(calculation),
    )
}

/// What each submission runs, with its number: only the one that creates the link calculates.
fn run_script(calculation: &Calculation) -> io::Result<String> {
    let (directory, runner) = (quoted(&text(&calculation.directory)?), runner(&calculation.runner)?);
    Ok(format!(
        "#!/bin/sh\n# Once, however often it is submitted.\ncd -- {directory} && ln -sn \"$1\" {BEGUN} || exit 0\n\
         {NODE_VARIABLE}=$(hostname)\nexport {NODE_VARIABLE}\n{runner} < {REQUEST}\n\
         # The runner must not be the process that the batch system has started.\nexit $?\n"
    ))
}

/// Name of the job: those of the directories of campaign and calculation.
fn name(directory: &Path) -> String {
    let last = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let campaign = directory.parent().map(last).filter(|name| name.starts_with("calmwalk-"));
    let of_calculation = match &campaign {
        Some(_) => last(directory),
        // Batch systems want names that begin with a letter.
        None => format!("calmwalk-{}", last(directory)),
    };
    campaign.into_iter().chain([of_calculation]).collect::<Vec<_>>().join("-")
}

fn text(path: &Path) -> io::Result<String> {
    let text = path.to_str().map(str::to_owned);
    text.ok_or_else(|| io::Error::other(format!("{} is not UTF-8", path.display())))
}

#[cfg(test)]
mod tests {
    use ::batch::CustomScheduler;

    use super::super::super::calculation_runner::RunnerCommand;
    use super::*;

    #[test]
    fn each_submission_has_a_script_and_an_output_of_its_own() {
        let home = tempfile::tempdir().unwrap();
        let scheduler: CustomScheduler = toml::from_str(
            r##"
            name = "files"
            submit = "cat"
            poll = "cat {id}"
            states = { pending = [], running = ["R"], completed = ["F"] }
            vanished = ["No such file"]
            cancel = "rm {id}"
            script = "#J -n {cores} -g {gpus} -m {memory_mb} -t {minutes} -o {output}\n{command}\n"
            "##,
        )
        .unwrap();
        let runner = RunnerCommand {
            program: "/opt/it's/calmwalk".into(),
            arguments: vec!["calculation-runner".to_owned()],
        };
        let calculation = Calculation::example(home.path(), runner);
        write(calculation, &CustomClient::new(scheduler, Duration::ZERO), 4, 2).unwrap();
        let here = home.path().display();
        for number in 1..=MAX_NUMBER {
            let script = fs::read_to_string(job::script(home.path(), number)).unwrap();
            let expected = format!(
                "#J -n 4 -g 2 -m 1908 -t 61 -o {here}/submission-{number}.log\nsh {here}/run.sh {number}\n"
            );
            assert_eq!(script, expected);
        }
        let run = fs::read_to_string(home.path().join(SCRIPT)).unwrap();
        assert!(run.contains(r"'/opt/it'\''s/calmwalk' 'calculation-runner' < order.json"), "{run}");
        // The first submission calculates, the second one does nothing.
        fs::write(
            home.path().join(SCRIPT),
            run.replace("< order.json", ">> done; true").replace("'/opt/it'\\''s/calmwalk'", "echo"),
        )
        .unwrap();
        for number in ["2", "1"] {
            let status = std::process::Command::new("sh").arg(home.path().join(SCRIPT)).arg(number).status();
            assert!(status.unwrap().success());
        }
        assert_eq!(fs::read_link(home.path().join(BEGUN)).unwrap(), Path::new("2"));
        assert_eq!(fs::read_to_string(home.path().join("done")).unwrap().lines().count(), 1);
    }
}

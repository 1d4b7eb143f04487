//! The examples of `configs/`, with stand-ins for the commands of PBS and LSF.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use proptest::prelude::*;
use tempfile::TempDir;

use super::*;
use crate::job_id::JobId;

const EXAMPLES: [&str; 2] = ["pbs", "lsf"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The batch system of `configs/NAME.toml`.
fn example(name: &str) -> CustomScheduler {
    let text = fs::read_to_string(root().join(format!("configs/{name}.toml"))).unwrap();
    text.parse::<toml::Table>().unwrap()["launch"]["custom"].clone().try_into().unwrap()
}

/// A batch system on this host.
struct StandIn {
    home: TempDir,
    client: CustomClient,
}

impl StandIn {
    fn new(name: &str) -> Self {
        Self::with_timeout(name, Duration::from_secs(60))
    }

    fn with_timeout(name: &str, timeout: Duration) -> Self {
        let home = tempfile::tempdir().unwrap();
        let commands = root().join("tests/stand_ins").join(name);
        let path = format!("{}:{}", commands.display(), std::env::var("PATH").unwrap());
        let environment: Vec<(OsString, OsString)> =
            vec![("PATH".into(), path.into()), ("STAND_IN_QUEUE".into(), home.path().join("queue").into())];
        fs::create_dir(home.path().join("queue")).unwrap();
        let client = CustomClient::new(example(name), timeout).with_environment(environment);
        Self { home, client }
    }

    fn switch(&self, name: &str, on: bool) {
        let path = self.home.path().join("queue").join(name);
        if on { fs::write(path, "").unwrap() } else { fs::remove_file(path).unwrap() }
    }

    /// A job that ends when the file `go` exists, with this exit code, or with its directory.
    fn job(&self, name: &str, code: i32) -> PathBuf {
        let here = self.home.path().display().to_string();
        let command = format!("until [ -e {here}/go ] || [ ! -d {here} ]; do sleep 0.02; done; exit {code}");
        let request = JobRequest {
            name: name.to_owned(),
            directory: self.home.path().to_owned(),
            output: self.home.path().join("job.out"),
            command,
            ..JobRequest::example()
        };
        let path = self.home.path().join(format!("{name}.job"));
        fs::write(&path, self.client.job_script(&request).unwrap()).unwrap();
        path
    }

    async fn submit(&self, script: &Path, after: Option<&JobId>) -> JobId {
        self.client.submit(script, after, |full| panic!("{full}")).await.unwrap()
    }

    async fn wait_for(&self, id: &JobId, state: PolledState) {
        for _ in 0..1000 {
            if self.client.poll(id).await.unwrap() == state {
                return;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        panic!("{id}: {:?}, not {state:?}", self.client.poll(id).await);
    }
}

#[test]
fn the_examples_have_no_fault() {
    for name in EXAMPLES {
        assert_eq!(example(name).invalid_setting(), None, "{name}");
    }
}

#[test]
fn the_script_of_an_example_asks_for_what_the_job_needs() {
    let [all, least] = [
        JobRequest { gpus: 2, memory: Some(3 << 30), ..JobRequest::example() },
        JobRequest { gpus: 0, memory: None, time_limit: None, ..JobRequest::example() },
    ];
    for (name, with, without) in [
        (
            "pbs",
            &["#PBS -l select=1:ncpus=16:ngpus=2:mem=3072mb", "#PBS -l walltime=24:00:00"][..],
            &["#PBS -l select=1:ncpus=16"][..],
        ),
        (
            "lsf",
            &["#BSUB -gpu \"num=2\"", "#BSUB -M 3072MB", "#BSUB -W 1440", "#BSUB -n 16"],
            &["#BSUB -n 16"],
        ),
    ] {
        let client = CustomClient::new(example(name), Duration::ZERO);
        let lines = |job: &JobRequest| -> Vec<String> {
            client.job_script(job).unwrap().lines().map(str::to_owned).collect()
        };
        let (full, plain) = (lines(&all), lines(&least));
        assert!(with.iter().all(|line| full.contains(&(*line).to_owned())), "{full:?}");
        assert!(without.iter().all(|line| plain.contains(&(*line).to_owned())), "{plain:?}");
        let asks =
            |line: &String| ["gpu", "mem", "MB", "-W", "walltime"].iter().any(|word| line.contains(word));
        assert!(!plain.iter().any(asks), "{plain:?}");
        assert!(plain.iter().all(|line| !line.is_empty()), "{plain:?}");
    }
}

#[tokio::test]
async fn jobs_of_an_example_are_submitted_polled_and_cancelled() {
    for (name, failed) in [("pbs", PolledState::Completed), ("lsf", PolledState::Failed)] {
        let system = StandIn::new(name);
        system.switch("hold", true);
        let first = system.submit(&system.job("first", 0), None).await;
        let second = system.submit(&system.job("second", 1), Some(&first)).await;
        assert!(first < second);
        assert_eq!(system.client.poll(&first).await.unwrap(), PolledState::Pending);
        system.switch("hold", false);
        system.wait_for(&first, PolledState::Running).await;
        system.wait_for(&second, PolledState::Running).await;
        let third = system.submit(&system.job("third", 0), None).await;
        system.wait_for(&third, PolledState::Running).await;
        system.client.cancel(&third).await.unwrap();
        system.wait_for(&third, failed).await;
        fs::write(system.home.path().join("go"), "").unwrap();
        system.wait_for(&first, PolledState::Completed).await;
        system.wait_for(&second, failed).await;
        // Neither what has ended nor what never was is an error.
        system.client.cancel(&first).await.unwrap();
        let none = JobId::from(7);
        system.client.cancel(&none).await.unwrap();
        assert_eq!(system.client.poll(&none).await.unwrap(), PolledState::Vanished);
    }
}

#[tokio::test]
async fn a_batch_system_that_does_not_answer_says_nothing_about_a_job() {
    for name in EXAMPLES {
        let system = StandIn::new(name);
        let id = system.submit(&system.job("job", 0), None).await;
        system.switch("down", true);
        let error = system.client.poll(&id).await.unwrap_err().to_string();
        assert!(error.contains("(launch.custom.poll) failed with exit status: 255"), "{error}");
        system.switch("down", false);
        system.client.cancel(&id).await.unwrap();
    }
}

#[tokio::test]
async fn a_full_queue_is_waited_for() {
    for name in EXAMPLES {
        let system = StandIn::new(name);
        system.switch("full", true);
        let script = system.job("job", 0);
        let mut said = String::new();
        let on_full = |full: &CustomError| {
            said = full.to_string();
            system.switch("full", false);
        };
        let id = system.client.submit(&script, None, on_full).await.unwrap();
        let begin = format!("{} accepts no further jobs for now (", system.client.scheduler().name);
        assert!(said.starts_with(&begin), "{said}");
        system.client.cancel(&id).await.unwrap();
    }
}

#[tokio::test]
async fn a_command_that_hangs_is_killed() {
    let system = StandIn::with_timeout("lsf", Duration::from_millis(300));
    system.switch("down", true);
    let submitted = system.client.submit(&system.job("job", 0), None, |full| panic!("{full}")).await;
    let error = submitted.unwrap_err().to_string();
    assert_eq!(error, "`bsub ` (launch.custom.submit) did not answer within 0 s");
}

#[tokio::test]
async fn answers_that_cannot_be_read_name_key_and_command() {
    let mut scheduler = example("lsf");
    let script = tempfile::NamedTempFile::new().unwrap();
    scheduler.submit = "echo 'Request <7> queued'".to_owned();
    scheduler.poll = "true {id}".to_owned();
    let client = CustomClient::new(scheduler.clone(), Duration::from_secs(60));
    let error = client.submit(script.path(), None, |_| ()).await.unwrap_err().to_string();
    assert_eq!(
        error,
        "`echo 'Request <7> queued'` (launch.custom.submit) printed \"Request <7> queued\"; expected the id of the job after \
         \"Job <\" (launch.custom.id_after)"
    );
    let error = client.poll(&JobId::from(7)).await.unwrap_err().to_string();
    assert_eq!(error, "`true 7` (launch.custom.poll) printed \"\"; expected the state of the job");
    // A word that the configuration does not have.
    scheduler.poll = "echo MIGRATING {id}".to_owned();
    scheduler.cancel = "no-such-command {id}".to_owned();
    let client = CustomClient::new(scheduler, Duration::from_secs(60));
    assert_eq!(client.poll(&JobId::from(7)).await.unwrap(), PolledState::Running);
    assert!(client.cancel(&JobId::from(7)).await.unwrap_err().is_missing());
}

#[test]
fn faults_of_a_configuration_name_their_key() {
    let changed = |change: &dyn Fn(&mut CustomScheduler)| {
        let mut scheduler = example("pbs");
        change(&mut scheduler);
        let (key, found, expected) = scheduler.invalid_setting().expect("a fault");
        (key, format!("{found}; expected {expected}"))
    };
    type Change = fn(&mut CustomScheduler);
    let changes: [(&str, &str, Change); 12] = [
        ("name", "no name", |s| s.name = " ".to_owned()),
        ("poll", "a text with {id}", |s| s.poll = "qstat".to_owned()),
        ("cancel", "one of {id} in place of {job}", |s| s.cancel = "qdel {id} {job}".to_owned()),
        ("submit", "no command", |s| s.submit.clear()),
        ("submit", "a command with {start_after}", |s| s.submit = "qsub {script}".to_owned()),
        ("submit", "in place of {file}", |s| s.submit += " {file}"),
        ("states.running", "\"R\", as another state", |s| s.states.pending.push("R".to_owned())),
        ("states.running", "an empty list", |s| s.states.running.clear()),
        ("vanished", "an empty list", |s| s.vanished.clear()),
        ("log.time_limit", "an empty text", |s| s.log.time_limit.push(String::new())),
        ("script", "a script without it", |s| s.script = "true".to_owned()),
        ("script", "in line 3 (\"#PBS {queue}\")", |s| {
            s.script = s.script.replace("#PBS -j oe", "#PBS {queue}")
        }),
    ];
    for (key, text, change) in changes {
        let (found, message) = changed(&change);
        assert!(found == key && message.contains(text), "{key}: {found} is {message}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Where a job can ask for them, paths reach the shell unchanged; the batch system gets them as they are, or not at all.
    #[test]
    fn paths_reach_the_shell_unchanged(name in "[ -~]{1,12}") {
        let directory = PathBuf::from(format!("/x/{name}"));
        let mut scheduler = example("pbs");
        let job = JobRequest { directory: directory.clone(), ..JobRequest::example() };
        scheduler.script = "printf %s {directory}; {command}".to_owned();
        let script = CustomClient::new(scheduler.clone(), Duration::ZERO).job_script(&job).unwrap();
        let output = std::process::Command::new("sh").args(["-c", &script]).output().unwrap();
        prop_assert_eq!(String::from_utf8(output.stdout).unwrap(), directory.to_str().unwrap());
        scheduler.script = "#PBS -d {directory}\n{command}".to_owned();
        if let Ok(script) = CustomClient::new(scheduler, Duration::ZERO).job_script(&job) {
            prop_assert_eq!(script, format!("#PBS -d {}\ntrue", directory.display()));
            prop_assert!(!name.contains([' ', '\'', '"', '$', '#', ';']));
        }
    }
}

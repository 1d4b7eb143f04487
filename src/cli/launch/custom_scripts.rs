//! Scripts of the jobs of a custom batch system.

use std::path::Path;
use std::time::Duration;

use orchestrator::batch::{CustomClient, DesiredJobs, JobNames, JobRequest, Role, quoted};

use super::LaunchArgs;
use super::commands::{JobCommands, text};
use super::cores_of_jobs::CoresOfJobs;
use super::templates::fill;
use crate::exit_status::CommandError;

/// What each job runs.
const TEMPLATE: &str = include_str!("custom_job.sh");
/// A job is asked to end this long before its time limit.
const MARGIN: Duration = Duration::from_secs(120);

/// What the scripts depend on.
pub(super) struct CustomScripts<'a> {
    pub launch: &'a LaunchArgs,
    pub client: &'a CustomClient,
    pub names: &'a JobNames,
    pub directory: &'a Path,
    pub folder: &'a Path,
    pub commands: &'a JobCommands<'a>,
    pub cores: CoresOfJobs,
}

/// Name of the script that is submitted for a job.
pub(super) fn job_file(role: Role) -> String {
    format!("{}.job", role.name())
}

impl CustomScripts<'_> {
    /// Names and texts of all scripts: what is submitted for each job, and what the job runs.
    pub fn all(&self, wanted: DesiredJobs) -> Result<Vec<(String, String)>, CommandError> {
        let agent = if wanted.agents > 0 { self.commands.agent()? } else { String::new() };
        let orchestrator = format!("{} --host \"$(hostname)\"", self.commands.orchestrator(wanted)?);
        let labeller = self.commands.labeller();
        let mut scripts = Vec::new();
        for role in wanted.roles() {
            let (cores, gpus, command) = match role {
                Role::Orchestrator => (self.cores.orchestrator, self.launch.gpus, &orchestrator),
                Role::Agent(_) => (self.cores.agent, self.launch.gpus, &agent),
                Role::Labeller(_) => (self.cores.labeller, 0, &labeller),
            };
            let name = format!("{}.sh", role.name());
            let run = self.run_script(role, command)?;
            let request = JobRequest {
                name: self.names.job_name(role),
                cores: u32::try_from(cores).unwrap_or(u32::MAX),
                gpus,
                memory: self.launch.memory,
                time_limit: self.time_limit(),
                directory: self.directory.to_owned(),
                output: self.folder.join(format!("{}.out", role.name())),
                command: format!("bash {}", quoted(&text(&self.folder.join(&name))?)),
            };
            let job = self.client.job_script(&request).map_err(CommandError::input)?;
            scripts.extend([(job_file(role), job), (name, run)]);
        }
        Ok(scripts)
    }

    fn time_limit(&self) -> Option<Duration> {
        self.launch.time.map(|limit| limit.0)
    }

    /// What a job runs.
    fn run_script(&self, role: Role, command: &str) -> Result<String, CommandError> {
        let limit = self.time_limit().map_or(0, |limit| {
            // Half of a very short one.
            limit.saturating_sub(MARGIN).max(limit / 2).as_secs().max(1)
        });
        let stop = self.commands.stop();
        let finally = match role {
            Role::Orchestrator => {
                format!("if [ \"$code\" = 0 ]; then {stop} --pending; else {stop}; fi")
            }
            // They end when the orchestrator does.
            Role::Agent(_) | Role::Labeller(_) => ":".to_owned(),
        };
        let values = [
            ("role", role.name()),
            ("limit", limit.to_string()),
            ("log", quoted(&text(&self.folder.join(format!("{}.log", role.name())))?)),
            ("command", command.to_owned()),
            ("resubmit", self.commands.resubmit()),
            ("finally", finally),
        ];
        fill("custom_job.sh", TEMPLATE, &values)
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;
    use std::process::{Command, Output};

    use super::*;

    /// Runs a job whose command is this shell command, with stand-ins for what follows it.
    fn run(here: &Path, limit: u64, command: &str) -> (Output, String, String) {
        let log = here.join("log");
        let values = [
            ("role", "agent-0".to_owned()),
            ("limit", limit.to_string()),
            ("log", log.display().to_string()),
            ("command", format!("bash -c {}", quoted(command))),
            ("resubmit", format!("touch {}", here.join("again").display())),
            ("finally", format!("echo $code > {}", here.join("finally").display())),
        ];
        let script = fill("custom_job.sh", TEMPLATE, &values).unwrap().replace("pause=20", "pause=0");
        let output = Command::new("bash").args(["-c", &script]).output().unwrap();
        let [log, last] =
            [log, here.join("finally")].map(|path| fs::read_to_string(path).unwrap_or_default());
        (output, log, last)
    }

    #[test]
    fn a_job_repeats_ends_or_is_submitted_again() {
        const ENDLESS: &str = "trap 'exit 130' TERM; while :; do sleep 0.02; done";
        for (name, limit, command, code, tries, again) in [
            ("done", 0, "exit 0", 0, 1, false),
            ("wrong input", 0, "exit 2", 2, 1, false),
            ("failing", 0, "exit 1", 1, 5, false),
            ("stopped", 0, "exit 130", 130, 1, true),
            ("at its time limit", 1, ENDLESS, 130, 1, true),
            // The batch system cancels it.
            (
                "cancelled",
                0,
                "trap 'exit 130' TERM; kill -TERM $(ps -o ppid= $PPID); while :; do sleep 0.02; done",
                130,
                1,
                false,
            ),
        ] {
            let home = tempfile::tempdir().unwrap();
            let (output, log, last) = run(home.path(), limit, command);
            assert_eq!(output.status.code(), Some(code), "{name}: {log}");
            assert_eq!(log.matches(", try ").count(), tries, "{name}: {log}");
            assert_eq!(home.path().join("again").exists(), again, "{name}: {log}");
            let expected = if again { String::new() } else { format!("{code}\n") };
            assert_eq!(last, expected, "{name}: {log}");
        }
    }
}

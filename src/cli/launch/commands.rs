//! The commands that the jobs of a campaign run.

use std::path::Path;

use orchestrator::batch::{DesiredJobs, quoted};
use wire::net::Tls;

use super::{LaunchArgs, System, absolute};
use crate::campaign::LoadedCampaign;
use crate::exit_status::CommandError;
use crate::output::log_and_warn;
use crate::runtime::reference_check;

/// The file in the campaign's directory to which the orchestrator announces its endpoint.
pub(super) const ENDPOINT: &str = "endpoint";
/// How long an agent or labeller waits for the campaign, and an orchestrator for its predecessor. The job then tries again.
const WAIT_TIMEOUT: &str = "--wait-timeout=15m";
/// Environment variable with the number of GPUs of a job.
const GPUS_VARIABLE: &str = "CALMWALK_GPUS";

/// The commands that the jobs run, quoted for a shell.
pub(super) struct JobCommands<'a> {
    launch: &'a LaunchArgs,
    program: String,
    config: String,
    directory: String,
    endpoint: String,
    store: Option<&'a str>,
    /// With `--accept-reference-check`: identity of the check that is accepted.
    accepted_check: Option<String>,
}

impl<'a> JobCommands<'a> {
    pub fn new(
        launch: &'a LaunchArgs,
        campaign: &'a LoadedCampaign,
        directory: &Path,
    ) -> Result<Self, CommandError> {
        Ok(Self {
            launch,
            program: text(&std::env::current_exe().map_err(CommandError::failed)?)?,
            config: text(&absolute(&launch.config)?)?,
            directory: text(directory)?,
            endpoint: text(&directory.join(ENDPOINT))?,
            store: campaign.config.run.store.as_deref(),
            // The job may be requeued after the configuration has changed, with differences that the user has not seen.
            accepted_check: launch
                .accept_reference_check
                .then(|| reference_check::identity(campaign))
                .transpose()?,
        })
    }

    fn command<'w>(&'w self, words: impl IntoIterator<Item = &'w str>) -> String {
        let words = [self.program.as_str()].into_iter().chain(words);
        words.map(quoted).collect::<Vec<_>>().join(" ")
    }

    /// A command that starts walkers: it knows the number of GPUs of its job.
    fn walking<'w>(&'w self, words: impl IntoIterator<Item = &'w str>) -> String {
        let command = self.command(words);
        match self.launch.gpus {
            0 => command,
            gpus => format!("env {GPUS_VARIABLE}={gpus} {command}"),
        }
    }

    pub fn orchestrator(&self, wanted: DesiredJobs) -> Result<String, CommandError> {
        let mut words = vec!["run", &self.config, "--directory", &self.directory, WAIT_TIMEOUT];
        if self.launch.adopt {
            words.push("--adopt");
        }
        let accepted =
            self.accepted_check.as_ref().map(|identity| format!("--accept-reference-check={identity}"));
        words.extend(accepted.as_deref());
        let tls = self.certificates("orchestrator")?;
        if wanted.agents > 0 {
            let endpoint = if tls.is_some() { "tcp/0.0.0.0:0" } else { "tcp/127.0.0.1:0" };
            words.extend(["--listen", endpoint, "--announce", &self.endpoint]);
            words.extend(tls.iter().flat_map(|directory| ["--tls", directory]));
        }
        Ok(self.walking(words))
    }

    pub fn agent(&self) -> Result<String, CommandError> {
        let join = format!("@{}", self.endpoint);
        let (walkers, threads) = (self.launch.walkers.to_string(), self.launch.threads.to_string());
        let tls = self.certificates("agent")?;
        self.check_reachable(tls.is_some())?;
        let words = ["agent", "--join", &join, "--walkers", &walkers, "--threads", &threads, WAIT_TIMEOUT];
        Ok(self.walking(words.into_iter().chain(tls.iter().flat_map(|directory| ["--tls", directory]))))
    }

    pub fn labeller(&self) -> String {
        let (store, concurrency) =
            (self.store.unwrap_or(&self.directory), self.launch.concurrency.to_string());
        self.command([
            "label",
            "--store",
            store,
            "--concurrency",
            &concurrency,
            WAIT_TIMEOUT,
            "--grace-period=60s",
        ])
    }

    /// The command that ends the campaign's other jobs.
    pub fn stop(&self) -> String {
        self.launch("--stop")
    }

    /// The command with which a job of a custom batch system submits itself again.
    pub fn resubmit(&self) -> String {
        self.launch("--resubmit")
    }

    fn launch(&self, option: &str) -> String {
        let on = match self.launch.on {
            System::Slurm => "slurm",
            System::Custom => "custom",
        };
        self.command(["launch", &self.config, "--on", on, "--directory", &self.directory, option])
    }

    /// The directory with the certificate of `role`, "orchestrator" or "agent", after a check of its files.
    fn certificates(&self, role: &str) -> Result<Option<String>, CommandError> {
        let Some(tls) = &self.launch.tls else { return Ok(None) };
        let directory = absolute(&tls.join(role))?;
        let certificates = Tls::from_directory(&directory);
        let checked = match role {
            "orchestrator" => certificates.check_for_orchestrator(),
            _ => certificates.check_for_agent(),
        };
        checked.map_err(CommandError::input)?;
        text(&directory).map(Some)
    }

    /// Without certificates, all jobs must run on the orchestrator's node. The script of a custom batch system may say so.
    fn check_reachable(&self, tls: bool) -> Result<(), CommandError> {
        let is_node = |option: &String| option.starts_with("--nodelist") || option.starts_with("-w");
        if tls || self.launch.options.iter().any(is_node) {
            return Ok(());
        }
        if self.launch.on == System::Custom {
            log_and_warn(
                "WARNING: without --tls, agents reach the orchestrator only if launch.custom.script puts all jobs on one node",
            );
            return Ok(());
        }
        Err(CommandError::Input(
            "agents on other nodes than the orchestrator's need certificates: create them and pass their directory with --tls \
             (docs/slurm.md), or run all jobs on one node with '-- --nodelist=NODE'"
                .to_owned(),
        ))
    }
}

/// A path as text for a script.
pub(super) fn text(path: &Path) -> Result<String, CommandError> {
    let text = path.to_str().filter(|text| !text.contains('\n'));
    text.map(str::to_owned).ok_or_else(|| {
        CommandError::Input(format!(
            "{}: a path in a job script must be UTF-8 without line breaks",
            path.display()
        ))
    })
}

//! Scripts and `sbatch` options of each kind of job.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};

use orchestrator::slurm::{DesiredJobs, JobNames, JobOptions, JobPhase, Plan, Role, SlurmJob};
use wire::net::Tls;

use super::templates::{self, AGENT, COMMON, LABELLER, ORCHESTRATOR, TemplateValues, fill, quoted, template};
use super::{FOLDER, LaunchArgs, absolute};
use crate::atomic_file::cannot_write;
use crate::campaign::LoadedCampaign;
use crate::exit_status::CommandError;
use crate::runtime::reference_check;

/// The file in the campaign's directory to which the orchestrator announces its endpoint.
const ENDPOINT: &str = "endpoint";
/// How long an agent or labeller waits for the campaign, and an orchestrator for its predecessor. The job then tries again.
const WAIT_TIMEOUT: &str = "--wait-timeout=15m";

/// Everything needed to submit the jobs of a campaign.
pub struct JobSpecs {
    directory: PathBuf,
    folder: PathBuf,
    /// Names and texts of the scripts.
    scripts: Vec<(&'static str, String)>,
    options: Vec<String>,
    walkers: u32,
}

impl JobSpecs {
    pub fn new(
        launch: &LaunchArgs,
        campaign: &LoadedCampaign,
        directory: &Path,
        wanted: DesiredJobs,
    ) -> Result<Self, CommandError> {
        let folder = directory.join(FOLDER);
        let commands = Commands::new(launch, campaign, directory)?;
        let job = quoted(&text(&folder.join(COMMON))?);
        let config = &campaign.config;
        // run.walkers = 0 is one walker per core, that is, as many as the job has cores.
        let cores = match config.run.walkers {
            0 => config.run.threads_per_walker.get().max(2),
            walkers => walkers * config.run.threads_per_walker.get() + config.label.concurrency,
        };
        let values = |cpus: usize, command: String| {
            [
                ("cpus", cpus.to_string()),
                ("command", command),
                ("stop", commands.stop()),
                ("job", job.clone()),
            ]
        };
        let site = launch.template.as_deref();
        let script = |name: &'static str, values: &TemplateValues<'_>| {
            template(site, name).and_then(|template| fill(name, &template, values)).map(|text| (name, text))
        };
        let mut scripts = vec![script(ORCHESTRATOR, &values(cores, commands.orchestrator(wanted)?))?];
        if wanted.agents > 0 {
            scripts
                .push(script(AGENT, &values((launch.walkers * launch.threads) as usize, commands.agent()?))?);
        }
        if wanted.labellers > 0 {
            scripts.push(script(LABELLER, &values(launch.concurrency as usize, commands.labeller()))?);
        }
        scripts.push((COMMON, template(site, COMMON)?));
        Ok(Self {
            directory: directory.into(),
            folder,
            scripts,
            options: options(launch),
            walkers: launch.walkers,
        })
    }

    /// Excludes concurrent launches, if the file system supports locks. Otherwise Slurm runs only one of two jobs with the same
    /// name at a time.
    pub fn lock(&self) -> Result<Option<File>, CommandError> {
        fs::create_dir_all(&self.folder).map_err(|error| cannot_write(&self.folder, error))?;
        let path = self.folder.join("launch.lock");
        let file = File::options().create(true).append(true).open(&path);
        let file = file.map_err(|error| cannot_write(&path, error))?;
        Ok(file.lock().is_ok().then_some(file))
    }

    /// Writes the scripts.
    pub fn write(&self) -> Result<(), CommandError> {
        self.scripts.iter().try_for_each(|(name, text)| templates::write(&self.folder.join(name), text))
    }

    /// Removes the endpoint file before a new orchestrator starts. It may still say that the campaign is finished, and agents
    /// would exit.
    pub fn remove_endpoint(&self) -> Result<(), CommandError> {
        let path = self.directory.join(ENDPOINT);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(cannot_write(&path, error)),
            _ => Ok(()),
        }
    }

    /// The existing job of the orchestrator that is not cancelled, if there is one.
    pub fn orchestrator_job(&self, jobs: &[SlurmJob], cancelled: &[u64]) -> Option<u64> {
        let is_active = |job: &&SlurmJob| matches!(job.phase(), JobPhase::Pending | JobPhase::Running);
        let mut active = jobs.iter().filter(|job| job.role == Role::Orchestrator).filter(is_active);
        active.find(|job| !cancelled.contains(&job.id)).map(|job| job.id)
    }

    /// The `sbatch` request of a job.
    pub fn request(&self, role: Role, orchestrator: Option<u64>) -> JobOptions<'_> {
        let (script, name) = match role {
            Role::Orchestrator => (ORCHESTRATOR, role.name()),
            Role::Agent(_) => (AGENT, role.name()),
            Role::Labeller(_) => (LABELLER, role.name()),
        };
        JobOptions {
            script: self.folder.join(script),
            log: self.folder.join(format!("{name}.log")),
            directory: &self.directory,
            walkers: self.walkers,
            orchestrator,
            options: &self.options,
        }
    }

    /// Prints what would be written and submitted.
    pub fn print(
        &self,
        out: &mut dyn Write,
        names: &JobNames,
        plan: &Plan,
        jobs: &[SlurmJob],
    ) -> io::Result<()> {
        for (name, text) in &self.scripts {
            writeln!(out, "==> {}\n{text}", self.folder.join(name).display())?;
        }
        if !plan.cancel.is_empty() {
            let ids: Vec<_> = plan.cancel.iter().map(u64::to_string).collect();
            writeln!(out, "scancel {}", ids.join(" "))?;
        }
        let orchestrator = self.orchestrator_job(jobs, &plan.cancel);
        for submission in &plan.submit {
            let arguments = self.request(submission.role, orchestrator).arguments(names, submission);
            let words: Vec<_> = arguments.iter().map(|word| quoted(&word.to_string_lossy())).collect();
            writeln!(out, "sbatch {}", words.join(" "))?;
        }
        if plan.cancel.is_empty() && plan.submit.is_empty() {
            writeln!(out, "all jobs exist already")?;
        }
        Ok(())
    }
}

/// Options of `sbatch` for every job.
fn options(launch: &LaunchArgs) -> Vec<String> {
    let named = [("time", &launch.time), ("partition", &launch.partition), ("account", &launch.account)];
    let named = named.iter().filter_map(|(name, value)| Some(format!("--{name}={}", value.as_ref()?)));
    named.chain(launch.options.iter().cloned()).collect()
}

/// The commands that the jobs run, quoted for a shell.
struct Commands<'a> {
    launch: &'a LaunchArgs,
    program: String,
    config: String,
    directory: String,
    endpoint: String,
    store: Option<&'a str>,
    /// With `--accept-reference-check`: identity of the check that is accepted.
    accepted_check: Option<String>,
}

impl<'a> Commands<'a> {
    fn new(
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

    fn orchestrator(&self, wanted: DesiredJobs) -> Result<String, CommandError> {
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
        Ok(self.command(words))
    }

    fn agent(&self) -> Result<String, CommandError> {
        let join = format!("@{}", self.endpoint);
        let (walkers, threads) = (self.launch.walkers.to_string(), self.launch.threads.to_string());
        let tls = self.certificates("agent")?;
        self.check_reachable(tls.is_some())?;
        let words = ["agent", "--join", &join, "--walkers", &walkers, "--threads", &threads, WAIT_TIMEOUT];
        Ok(self.command(words.into_iter().chain(tls.iter().flat_map(|directory| ["--tls", directory]))))
    }

    fn labeller(&self) -> String {
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

    fn stop(&self) -> String {
        let words = ["launch", &self.config, "--on", "slurm", "--directory", &self.directory, "--stop"];
        self.command(words)
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

    /// Without certificates, all jobs must run on the orchestrator's node.
    fn check_reachable(&self, tls: bool) -> Result<(), CommandError> {
        let is_node = |option: &String| option.starts_with("--nodelist") || option.starts_with("-w");
        if tls || self.launch.options.iter().any(is_node) {
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
fn text(path: &Path) -> Result<String, CommandError> {
    let text = path.to_str().filter(|text| !text.contains('\n'));
    text.map(str::to_owned).ok_or_else(|| {
        CommandError::Input(format!(
            "{}: a path in a job script must be UTF-8 without line breaks",
            path.display()
        ))
    })
}

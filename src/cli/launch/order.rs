//! What is ordered from the batch system: scripts and options of each kind of job.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};

use orchestrator::slurm::{DesiredJobs, Job, JobNames, JobOptions, Phase, Plan, Role};
use wire::net::Tls;

use super::scripts::{self, AGENT, COMMON, LABELLER, ORCHESTRATOR, Values, fill, quoted, template};
use super::{FOLDER, Launch, absolute};
use crate::campaign::Campaign;
use crate::outcome::Failure;
use crate::whole_file::cannot_write;

/// Where the orchestrator writes down where it is, in the campaign's directory.
const ENDPOINT: &str = "endpoint";
/// How long an agent waits for an orchestrator, and the orchestrator for its predecessor, min. The job is tried again then.
const PATIENCE: &str = "--patience=15";

/// All that jobs are made of.
pub struct Order {
    directory: PathBuf,
    folder: PathBuf,
    /// Names and texts of the scripts.
    scripts: Vec<(&'static str, String)>,
    options: Vec<String>,
    walkers: u32,
}

impl Order {
    pub fn new(
        launch: &Launch,
        campaign: &Campaign,
        directory: &Path,
        wanted: DesiredJobs,
    ) -> Result<Self, Failure> {
        let folder = directory.join(FOLDER);
        let commands = Commands::new(launch, campaign, directory)?;
        let job = quoted(&text(&folder.join(COMMON))?);
        let config = &campaign.config;
        // "One a core" is as many as the job is given.
        let leading = match config.run.walkers {
            0 => config.run.threads.get().max(2),
            walkers => walkers * config.run.threads.get() + config.label.slots,
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
        let script = |name: &'static str, values: &Values<'_>| {
            template(site, name).and_then(|template| fill(name, &template, values)).map(|text| (name, text))
        };
        let leading = values(leading, commands.orchestrator(wanted)?);
        let mut scripts = vec![script(ORCHESTRATOR, &leading)?];
        if wanted.agents > 0 {
            scripts
                .push(script(AGENT, &values((launch.walkers * launch.threads) as usize, commands.agent()?))?);
        }
        if wanted.labellers > 0 {
            scripts.push(script(LABELLER, &values(launch.slots as usize, commands.labeller()))?);
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

    /// One who launches at a time, where the file system can lock. Where it cannot, Slurm itself sees to it that of two
    /// jobs of one name one waits.
    pub fn lock(&self) -> Result<Option<File>, Failure> {
        fs::create_dir_all(&self.folder).map_err(|error| cannot_write(&self.folder, error))?;
        let path = self.folder.join("launch.lock");
        let file = File::options().create(true).append(true).open(&path);
        let file = file.map_err(|error| cannot_write(&path, error))?;
        Ok(file.lock().is_ok().then_some(file))
    }

    /// Writes the scripts.
    pub fn write(&self) -> Result<(), Failure> {
        self.scripts.iter().try_for_each(|(name, text)| scripts::write(&self.folder.join(name), text))
    }

    /// Before a new orchestrator begins: agents would take the end of the last one for that of the campaign.
    pub fn forget_the_end(&self) -> Result<(), Failure> {
        let path = self.directory.join(ENDPOINT);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(cannot_write(&path, error)),
            _ => Ok(()),
        }
    }

    /// The orchestrator's job that stays, if there is one.
    pub fn leader(&self, jobs: &[Job], cancelled: &[u64]) -> Option<u64> {
        let stays = |job: &&Job| matches!(job.phase(), Phase::Pending | Phase::Running);
        let mut leaders = jobs.iter().filter(|job| job.role == Role::Orchestrator).filter(stays);
        leaders.find(|job| !cancelled.contains(&job.id)).map(|job| job.id)
    }

    /// How a job is submitted.
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

    /// Says what would be written and submitted.
    pub fn show(&self, out: &mut dyn Write, names: &JobNames, plan: &Plan, jobs: &[Job]) -> io::Result<()> {
        for (name, text) in &self.scripts {
            writeln!(out, "==> {}\n{text}", self.folder.join(name).display())?;
        }
        if !plan.cancel.is_empty() {
            let ids: Vec<_> = plan.cancel.iter().map(u64::to_string).collect();
            writeln!(out, "scancel {}", ids.join(" "))?;
        }
        let leader = self.leader(jobs, &plan.cancel);
        for submission in &plan.submit {
            let arguments = self.request(submission.role, leader).arguments(names, submission);
            let words: Vec<_> = arguments.iter().map(|word| quoted(&word.to_string_lossy())).collect();
            writeln!(out, "sbatch {}", words.join(" "))?;
        }
        if plan.cancel.is_empty() && plan.submit.is_empty() {
            writeln!(out, "every job is there already")?;
        }
        Ok(())
    }
}

/// Options of `sbatch` that hold for every job.
fn options(launch: &Launch) -> Vec<String> {
    let named = [("time", &launch.time), ("partition", &launch.partition), ("account", &launch.account)];
    let named = named.iter().filter_map(|(name, value)| Some(format!("--{name}={}", value.as_ref()?)));
    named.chain(launch.options.iter().cloned()).collect()
}

/// The commands of the jobs, for a shell.
struct Commands<'a> {
    launch: &'a Launch,
    program: String,
    config: String,
    directory: String,
    endpoint: String,
    store: Option<&'a str>,
}

impl<'a> Commands<'a> {
    fn new(launch: &'a Launch, campaign: &'a Campaign, directory: &Path) -> Result<Self, Failure> {
        Ok(Self {
            launch,
            program: text(&std::env::current_exe().map_err(Failure::failed)?)?,
            config: text(&absolute(&launch.config)?)?,
            directory: text(directory)?,
            endpoint: text(&directory.join(ENDPOINT))?,
            store: campaign.config.run.store.as_deref(),
        })
    }

    fn command<'w>(&'w self, words: impl IntoIterator<Item = &'w str>) -> String {
        let words = [self.program.as_str()].into_iter().chain(words);
        words.map(quoted).collect::<Vec<_>>().join(" ")
    }

    fn orchestrator(&self, wanted: DesiredJobs) -> Result<String, Failure> {
        let mut words = vec!["run", &self.config, "--directory", &self.directory, PATIENCE];
        if self.launch.adopt {
            words.push("--adopt");
        }
        let tls = self.certificates("orchestrator")?;
        if wanted.agents > 0 {
            let everywhere = if tls.is_some() { "tcp/0.0.0.0:0" } else { "tcp/127.0.0.1:0" };
            words.extend(["--listen", everywhere, "--announce", &self.endpoint]);
            words.extend(tls.iter().flat_map(|directory| ["--tls", directory]));
        }
        Ok(self.command(words))
    }

    fn agent(&self) -> Result<String, Failure> {
        let join = format!("@{}", self.endpoint);
        let (walkers, threads) = (self.launch.walkers.to_string(), self.launch.threads.to_string());
        let tls = self.certificates("agent")?;
        self.check_reach(tls.is_some())?;
        let words = ["agent", "--join", &join, "--walkers", &walkers, "--threads", &threads, PATIENCE];
        Ok(self.command(words.into_iter().chain(tls.iter().flat_map(|directory| ["--tls", directory]))))
    }

    fn labeller(&self) -> String {
        let (store, slots) = (self.store.unwrap_or(&self.directory), self.launch.slots.to_string());
        self.command(["label", "--store", store, "--slots", &slots, "--wait=15", "--grace=60"])
    }

    fn stop(&self) -> String {
        let words = ["launch", &self.config, "--on", "slurm", "--directory", &self.directory, "--stop"];
        self.command(words)
    }

    /// Where the certificate of the orchestrator, or that of agents, is.
    fn certificates(&self, of: &str) -> Result<Option<String>, Failure> {
        let Some(tls) = &self.launch.tls else { return Ok(None) };
        let directory = absolute(&tls.join(of))?;
        let certificates = Tls::from_directory(&directory);
        let checked = match of {
            "orchestrator" => certificates.check_for_orchestrator(),
            _ => certificates.check_for_agent(),
        };
        checked.map_err(Failure::input)?;
        text(&directory).map(Some)
    }

    /// Without certificates only agents beside the orchestrator reach it.
    fn check_reach(&self, tls: bool) -> Result<(), Failure> {
        let is_node = |option: &String| option.starts_with("--nodelist") || option.starts_with("-w");
        if tls || self.launch.options.iter().any(is_node) {
            return Ok(());
        }
        Err(Failure::Input(
            "agents on other nodes than the orchestrator's need certificates: make them and name them with --tls \
             (docs/slurm.md), or keep everything on one node with '-- --nodelist=NODE'"
                .to_owned(),
        ))
    }
}

/// A path that a script can have in it.
fn text(path: &Path) -> Result<String, Failure> {
    let text = path.to_str().filter(|text| !text.contains('\n'));
    text.map(str::to_owned).ok_or_else(|| {
        Failure::Input(format!("{}: the name of a path in a job's script must be plain text", path.display()))
    })
}

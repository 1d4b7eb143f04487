//! Scripts and options of each kind of job.

use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use orchestrator::batch::{
    BatchScheduler, CampaignJob, DesiredJobs, JobId, JobNames, JobOptions, JobPhase, Plan, Role, quoted,
};

use super::commands::{ENDPOINT, JobCommands, text};
use super::cores_of_jobs::CoresOfJobs;
use super::custom_scripts::{self, CustomScripts};
use super::templates::{self, AGENT, COMMON, LABELLER, ORCHESTRATOR, TemplateValues, fill, template};
use super::{LaunchArgs, System};
use crate::atomic_file::cannot_write;
use crate::campaign::LoadedCampaign;
use crate::exit_status::CommandError;
use crate::output::log_and_warn;

/// Bytes per unit M of `--mem`.
const MEBIBYTE: u64 = 1 << 20;

/// Everything needed to submit the jobs of a campaign.
pub struct JobSpecs {
    on: System,
    directory: PathBuf,
    folder: PathBuf,
    /// Names and texts of the scripts.
    scripts: Vec<(String, String)>,
    options: Vec<String>,
    /// Options of jobs with walkers.
    walk_options: Vec<String>,
    walkers: u32,
}

impl JobSpecs {
    pub fn new(
        launch: &LaunchArgs,
        campaign: &LoadedCampaign,
        directory: &Path,
        wanted: DesiredJobs,
        names: &JobNames,
        scheduler: &BatchScheduler,
    ) -> Result<Self, CommandError> {
        let folder = directory.join(launch.on.folder());
        let commands = JobCommands::new(launch, campaign, directory)?;
        let config = &campaign.config;
        let cores = CoresOfJobs {
            // run.walkers = 0 is one walker per core, that is, as many as the job has cores.
            orchestrator: match config.run.walkers {
                0 => config.run.threads_per_walker.get().max(2),
                walkers => walkers * config.run.threads_per_walker.get() + config.label.concurrency,
            },
            agent: (launch.walkers * launch.threads) as usize,
            labeller: launch.concurrency as usize,
        };
        let scripts = match scheduler {
            BatchScheduler::Slurm(_) => slurm_scripts(launch, &folder, &commands, wanted, cores)?,
            BatchScheduler::Custom(custom) => {
                let client = custom.client();
                let scripts = CustomScripts {
                    launch,
                    client,
                    names,
                    directory,
                    folder: &folder,
                    commands: &commands,
                    cores,
                };
                scripts.all(wanted)?
            }
        };
        let options = options(launch);
        let gpus = (launch.gpus > 0).then(|| format!("--gres=gpu:{}", launch.gpus));
        Ok(Self {
            on: launch.on,
            directory: directory.into(),
            folder,
            scripts,
            // The user's own options come last.
            walk_options: gpus.into_iter().chain(options.iter().cloned()).collect(),
            options,
            walkers: launch.walkers,
        })
    }

    /// The folder of the scripts.
    pub fn folder(&self) -> &Path {
        &self.folder
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
    pub fn orchestrator_job(&self, jobs: &[CampaignJob], cancelled: &[JobId]) -> Option<JobId> {
        let is_active = |job: &&CampaignJob| matches!(job.phase(), JobPhase::Pending | JobPhase::Running);
        let mut active = jobs.iter().filter(|job| job.role == Role::Orchestrator).filter(is_active);
        active.find(|job| !cancelled.contains(&job.id)).map(|job| job.id.clone())
    }

    /// The request of a job.
    pub fn request(&self, role: Role, orchestrator: Option<JobId>) -> JobOptions<'_> {
        let of_slurm = match role {
            Role::Orchestrator => ORCHESTRATOR,
            Role::Agent(_) => AGENT,
            Role::Labeller(_) => LABELLER,
        };
        let script = match self.on {
            System::Slurm => of_slurm.to_owned(),
            System::Custom => custom_scripts::job_file(role),
        };
        JobOptions {
            script: self.folder.join(script),
            log: self.folder.join(format!("{}.log", role.name())),
            directory: &self.directory,
            walkers: self.walkers,
            orchestrator,
            options: if matches!(role, Role::Labeller(_)) { &self.options } else { &self.walk_options },
        }
    }

    /// What would be written and submitted.
    pub fn shown(
        &self,
        scheduler: &BatchScheduler,
        names: &JobNames,
        plan: &Plan,
        jobs: &[CampaignJob],
    ) -> Result<String, CommandError> {
        let mut lines = Vec::new();
        for (name, text) in &self.scripts {
            lines.push(format!("==> {}\n{text}", self.folder.join(name).display()));
        }
        match scheduler {
            BatchScheduler::Slurm(_) if plan.cancel.is_empty() => {}
            BatchScheduler::Slurm(_) => {
                let ids: Vec<_> = plan.cancel.iter().map(JobId::as_str).collect();
                lines.push(format!("scancel {}", ids.join(" ")));
            }
            BatchScheduler::Custom(custom) => {
                for id in &plan.cancel {
                    lines.push(custom.client().cancel_command(id).map_err(CommandError::failed)?);
                }
            }
        }
        let orchestrator = self.orchestrator_job(jobs, &plan.cancel);
        for submission in &plan.submit {
            let request = self.request(submission.role, orchestrator.clone());
            lines.push(match scheduler {
                BatchScheduler::Slurm(_) => {
                    let arguments = request.arguments(names, submission);
                    let words: Vec<_> =
                        arguments.iter().map(|word| quoted(&word.to_string_lossy())).collect();
                    format!("sbatch {}", words.join(" "))
                }
                BatchScheduler::Custom(custom) => {
                    let after =
                        request.orchestrator.as_ref().filter(|_| submission.role != Role::Orchestrator);
                    custom.client().submit_command(&request.script, after).map_err(CommandError::failed)?
                }
            });
        }
        if plan.cancel.is_empty() && plan.submit.is_empty() {
            lines.push("all jobs exist already".to_owned());
        }
        Ok(lines.join("\n") + "\n")
    }
}

/// Excludes concurrent launches, if the file system supports locks. Otherwise Slurm runs only one of two jobs with the same
/// name at a time.
pub fn lock(folder: &Path) -> Result<Option<File>, CommandError> {
    fs::create_dir_all(folder).map_err(|error| cannot_write(folder, error))?;
    let path = folder.join("launch.lock");
    let file = File::options().create(true).append(true).open(&path);
    let file = file.map_err(|error| cannot_write(&path, error))?;
    if let Err(error) = file.lock() {
        if folder.ends_with(super::CUSTOM_FOLDER) {
            log_and_warn(format_args!(
                "WARNING: cannot lock {} ({error}): do not launch the campaign twice at the same time",
                path.display()
            ));
        }
        return Ok(None);
    }
    Ok(Some(file))
}

/// The scripts of Slurm jobs: one for each kind, and what they share.
fn slurm_scripts(
    launch: &LaunchArgs,
    folder: &Path,
    commands: &JobCommands<'_>,
    wanted: DesiredJobs,
    cores: CoresOfJobs,
) -> Result<Vec<(String, String)>, CommandError> {
    let job = quoted(&text(&folder.join(COMMON))?);
    let values = |cpus: usize, command: String| {
        [("cpus", cpus.to_string()), ("command", command), ("stop", commands.stop()), ("job", job.clone())]
    };
    let site = launch.template.as_deref();
    let script = |name: &str, values: &TemplateValues<'_>| {
        let text = template(site, name).and_then(|template| fill(name, &template, values));
        text.map(|text| (name.to_owned(), text))
    };
    let mut scripts =
        vec![script(ORCHESTRATOR, &values(cores.orchestrator, commands.orchestrator(wanted)?))?];
    if wanted.agents > 0 {
        scripts.push(script(AGENT, &values(cores.agent, commands.agent()?))?);
    }
    if wanted.labellers > 0 {
        scripts.push(script(LABELLER, &values(cores.labeller, commands.labeller()))?);
    }
    scripts.push((COMMON.to_owned(), template(site, COMMON)?));
    Ok(scripts)
}

/// Options of `sbatch` for every job.
fn options(launch: &LaunchArgs) -> Vec<String> {
    let memory = launch.memory.map(|bytes| format!("{}M", bytes.div_ceil(MEBIBYTE)));
    let time = launch.time.map(|limit| limit.to_string());
    let named =
        [("time", &time), ("partition", &launch.partition), ("account", &launch.account), ("mem", &memory)];
    let named = named.iter().filter_map(|(name, value)| Some(format!("--{name}={}", value.as_ref()?)));
    named.chain(launch.options.iter().cloned()).collect()
}

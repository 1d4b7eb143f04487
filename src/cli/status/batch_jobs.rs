//! The batch jobs of a campaign in `calmwalk status`.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::time::Duration;

use orchestrator::batch::{
    BatchError, BatchScheduler, CampaignJob, CustomCommands, JobId, JobPhase, JobRecords, Role, SlurmCommands,
};
use serde_json::{Value, json};
use store::Location;
use tokio::time::timeout;

use super::page::StatusLayout;
use crate::cli::launch::{CUSTOM_FOLDER, FOLDER, job_names};
use crate::output::TextTable;

/// How long `calmwalk status` waits for the batch system.
const TIMEOUT: Duration = Duration::from_secs(4);

/// The jobs of a campaign.
#[derive(Debug)]
pub enum BatchJobs {
    /// There is no batch system, or it has no jobs of this campaign.
    None,
    /// Jobs with the exit codes of failed ones.
    Known(Vec<(CampaignJob, Option<String>)>),
    /// The batch system gives no answer, for this reason.
    Unknown(String),
}

impl BatchJobs {
    /// Queries the batch system.
    pub async fn query(location: &Location) -> Self {
        let schedulers = match schedulers(location) {
            Ok(schedulers) => schedulers,
            Err(error) => return Self::Unknown(error.to_string()),
        };
        let location = match location {
            Location::Directory(directory) => {
                Location::Directory(directory.canonicalize().unwrap_or_else(|_| directory.clone()))
            }
            Location::Server(url) => Location::Server(url.clone()),
        };
        let mut all = Vec::new();
        for scheduler in schedulers {
            match timeout(TIMEOUT, query_jobs(&scheduler, &location)).await {
                Ok(Ok(jobs)) => all.extend(jobs),
                Ok(Err(error)) if error.is_missing() => {}
                Ok(Err(error)) => return Self::Unknown(error.to_string()),
                Err(_) => return Self::Unknown(format!("no answer within {} s", TIMEOUT.as_secs())),
            }
        }
        if all.is_empty() { Self::None } else { Self::Known(all) }
    }

    /// Adds the jobs to the JSON output.
    pub fn add_to(&self, json: &mut Value) {
        match self {
            Self::None => {}
            Self::Known(jobs) => json["jobs"] = jobs.iter().map(|(job, code)| as_json(job, code)).collect(),
            Self::Unknown(why) => json["jobs_unknown"] = why.as_str().into(),
        }
    }

    /// Writes a table of the jobs; if they do not fit, jobs that are not running have priority.
    pub fn write(&self, out: &mut dyn Write, page: &StatusLayout) -> io::Result<()> {
        let jobs = match self {
            Self::None => return Ok(()),
            Self::Unknown(why) => {
                return writeln!(out, "\njobs        no answer from the batch system: {why}");
            }
            Self::Known(jobs) => jobs,
        };
        let runs = |job: &CampaignJob| job.role != Role::Orchestrator && job.phase() == JobPhase::Running;
        let mut shown: Vec<_> = jobs.iter().collect();
        if shown.len() > page.others {
            shown.sort_by_key(|(job, _)| (runs(job), job.role));
            shown.truncate(page.others);
            shown.sort_by_key(|(job, _)| (job.role, &job.id));
        }
        let mut table = TextTable::new(&["job", ">id", "state", "node", "since", ">time left", "remark"]);
        for (job, code) in &shown {
            table.push(line(job, code.as_deref()));
        }
        page.table(out, &table, shown.len(), jobs.len(), "jobs")
    }
}

/// The batch systems on which a campaign was launched: without job scripts, it never was. Jobs of a custom one are recorded in the
/// directory of the campaign.
fn schedulers(location: &Location) -> Result<Vec<BatchScheduler>, BatchError> {
    let slurm = BatchScheduler::Slurm(SlurmCommands::with_timeout(TIMEOUT));
    let Location::Directory(directory) = location else { return Ok(vec![slurm]) };
    let folder = directory.join(CUSTOM_FOLDER);
    let custom = JobRecords::read(&folder)?.map(|records| {
        let commands = CustomCommands::new(records.scheduler, &folder, TIMEOUT);
        BatchScheduler::Custom(Box::new(commands))
    });
    Ok(directory.join(FOLDER).is_dir().then_some(slurm).into_iter().chain(custom).collect())
}

/// Active jobs, and for each role without an active job the last one that ended.
async fn query_jobs(
    scheduler: &BatchScheduler,
    location: &Location,
) -> Result<Vec<(CampaignJob, Option<String>)>, BatchError> {
    let mut jobs = scheduler.jobs(&job_names(location)).await?;
    let mut last: BTreeMap<Role, (bool, JobId)> = BTreeMap::new();
    for job in &jobs {
        let found = (job.phase() != JobPhase::Over, job.id.clone());
        if last.get(&job.role).is_none_or(|last| *last < found) {
            last.insert(job.role, found);
        }
    }
    let is_last = |job: &CampaignJob| last.get(&job.role).is_some_and(|(lives, id)| !lives && *id == job.id);
    jobs.retain(|job| job.phase() != JobPhase::Over || is_last(job));
    jobs.sort_by_key(|job| (job.role, job.id.clone()));
    let mut known = Vec::new();
    for job in jobs {
        let failed = job.phase() == JobPhase::Over && job.state != "COMPLETED";
        // The batch system may no longer know the job.
        let code = if failed { scheduler.exit_code(&job.id).await.ok().flatten() } else { None };
        known.push((job, code));
    }
    Ok(known)
}

fn line(job: &CampaignJob, code: Option<&str>) -> Vec<String> {
    let has_started = job.phase() != JobPhase::Pending;
    let reason = job.reason.clone().unwrap_or_default();
    let remark = match (job.phase(), code) {
        (JobPhase::Pending, _) if job.start != "N/A" => format!("{reason}; expected start {}", job.start),
        (_, Some(code)) if reason.is_empty() => format!("exit code {code}"),
        (_, Some(code)) => format!("exit code {code}, {reason}"),
        _ => reason,
    };
    vec![
        job.role.to_string(),
        job.id.to_string(),
        job.state.to_lowercase(),
        job.nodes.clone(),
        if has_started { job.start.clone() } else { String::new() },
        if job.phase() == JobPhase::Over { String::new() } else { job.time_left.clone() },
        remark,
    ]
}

fn as_json(job: &CampaignJob, code: &Option<String>) -> Value {
    let CampaignJob { id, role, state, nodes, start, time_left, walkers, reason } = job;
    let (kind, number) = match role {
        Role::Orchestrator => ("orchestrator", None),
        Role::Agent(number) => ("agent", Some(number)),
        Role::Labeller(number) => ("labeller", Some(number)),
    };
    // An id that is no number is text.
    let id = id.number().map_or_else(|| json!(id.as_str()), |number| json!(number));
    json!({
        "kind": kind, "number": number, "id": id, "state": state, "node": nodes, "start": start,
        "time_left": time_left, "walkers": walkers, "reason": reason, "exit_code": code,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: StatusLayout = StatusLayout { walks: 8, others: 8, few: 8, width: 120 };

    fn job(id: u64, role: Role, state: &str) -> CampaignJob {
        CampaignJob {
            id: id.into(),
            role,
            state: state.into(),
            nodes: "node7".into(),
            start: "2026-11-21T20:15:00".into(),
            time_left: "1:00:00".into(),
            walkers: None,
            reason: None,
        }
    }

    #[test]
    fn jobs_are_shown_with_state_and_remark() {
        let mut waiting = job(13, Role::Agent(0), "PENDING");
        (waiting.nodes, waiting.start) = (String::new(), "N/A".into());
        waiting.reason = Some("Resources".into());
        let failed = job(9, Role::Agent(1), "FAILED");
        let jobs = BatchJobs::Known(vec![
            (job(12, Role::Orchestrator, "RUNNING"), None),
            (waiting, None),
            (failed, Some("1:0".into())),
        ]);
        let mut text = Vec::new();
        jobs.write(&mut text, &PAGE).unwrap();
        let expected = [
            "job           id  state    node   since                time left  remark",
            "orchestrator  12  running  node7  2026-11-21T20:15:00    1:00:00",
            "agent 0       13  pending                                1:00:00  Resources",
            "agent 1        9  failed   node7  2026-11-21T20:15:00             exit code 1:0",
        ];
        assert_eq!(String::from_utf8(text).unwrap().trim().lines().collect::<Vec<_>>(), expected);
        let mut value = json!({});
        jobs.add_to(&mut value);
        assert_eq!(value["jobs"][2]["exit_code"], "1:0");
        assert_eq!((&value["jobs"][1]["kind"], &value["jobs"][1]["number"]), (&json!("agent"), &json!(0)));
    }

    #[test]
    fn nothing_is_shown_without_jobs() {
        let mut value = json!({});
        BatchJobs::None.add_to(&mut value);
        let mut text = Vec::new();
        BatchJobs::None.write(&mut text, &PAGE).unwrap();
        assert_eq!((value, text.len()), (json!({}), 0));
    }
}

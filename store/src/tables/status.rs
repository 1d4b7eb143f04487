//! The state of a campaign, read from indexes.

use wire::WalkId;

use super::{
    assignments, budget, exclude, job_counts, lower_states, pauses, processes, relabel, walk_conditions,
    walk_progress, walk_trace,
};
use crate::Store;
use crate::budget::{Budget, BudgetStatus};
use crate::checksum::joined;
use crate::database::query;
use crate::error::Result;
use crate::processes::ProcessRecord;
use crate::status::{CampaignStatus, Candidates, LabelJobCounts, WalkStatus};
use crate::unix_milliseconds;
use crate::walk_progress::{TotalThroughput, WalkProgressRecord};

const END_BY_BUDGET: &str = "budget";

const FATES: &str = "SELECT origin, fate, number FROM candidate_count";

/// The same for tables of an earlier version, which keep no counts.
pub(crate) const COUNTED_FATES: &str =
    "SELECT origin, coalesce(reason, fate), count(*) FROM candidate GROUP BY origin, fate, reason";

/// Accepted candidates of biased walks.
pub(crate) const ACCEPTED: &str = "SELECT CAST(coalesce(sum(number), 0) AS BIGINT) FROM candidate_count
    WHERE origin = 'biased' AND fate = 'accepted'";

const OF_FATE: &str = "SELECT CAST(coalesce(sum(number), 0) AS BIGINT) FROM candidate_count
    WHERE origin = $1 AND fate = $2";

/// The same as [`ACCEPTED`], counted, for tables of an earlier version.
const COUNTED_ACCEPTED: &str = "SELECT count(*) FROM candidate WHERE origin = 'biased' AND fate = 'accepted'";

/// The query for [`WalkStatus`]; its end selects the walks. The table has zeros before a walk starts and where it
/// is not graded.
macro_rules! walks {
    ($which:literal) => {
        concat!(
            "SELECT ",
            joined!(walk),
            ", walk, coalesce(name, '') AS seed_structure, origin, state, reason, FALSE AS paused, step, segment,
                CASE WHEN relative_volume > 0 THEN tau END AS tau, CASE WHEN relative_volume > 0 THEN temperature END AS temperature,
                nullif(relative_volume, 0) AS relative_volume, nullif(gamma_max, 0) AS gamma_max, CAST(NULL AS DOUBLE PRECISION) AS steps_per_second, accepted,
                rejected, rollbacks
            FROM walk LEFT JOIN seed_structure ON seed_structure.seed = walk.seed_structure ",
            $which
        )
    };
}
pub(super) use walks;

impl Store {
    /// A snapshot of the campaign's state. Processes are ordered by kind and number. A dead process has the state
    /// `dead`, whatever state it reported last, unless it has `failed`, or is `backing_off` and an orchestrator
    /// lives. A process on another host without a heartbeat for a minute is `unresponsive`. A walk stopped by a time
    /// limit has the state `budget`. While no process leads the campaign, walks are shown at their checkpoints and
    /// have no speed.
    pub async fn status(&self) -> Result<CampaignStatus> {
        let now = unix_milliseconds();
        let mut transaction = self.database.begin_read().await?;
        let are_counted = transaction.has_table("candidate_count").await?;
        let fates = query(if are_counted { FATES } else { COUNTED_FATES });
        let fates: Vec<(String, String, u64)> = fates.fetch_all(&mut transaction).await?;
        let states = job_counts::states(&mut transaction).await?;
        let asked = relabel::relabel_requests(&mut transaction).await?;
        let excluded = exclude::count(&mut transaction).await?;
        let lower_states = lower_states::count(&mut transaction).await?;
        let oldest_lease = job_counts::oldest_lease(&mut transaction).await?;
        let labels_last_hour = job_counts::labels_in_last_hour(&mut transaction, now).await?;
        let mut walks: Vec<WalkStatus> = query(walks!("ORDER BY walk")).fetch_all(&mut transaction).await?;
        let mut conditions = walk_conditions::read(&mut transaction).await?;
        let volumes = assignments::reference_volumes(&mut transaction).await?;
        let original = walk_trace::last_original_grades(&mut transaction).await?;
        for walk in &mut walks {
            walk.gamma_max_original = original.get(&walk.walk).copied();
            walk.conditions = conditions.remove(&WalkId(walk.walk));
            walk.reference_volume = volumes.get(&walk.walk).copied();
        }
        let rejected = query("SELECT CAST(coalesce(sum(rejected), 0) AS BIGINT) FROM walk");
        let rejected: u64 = rejected.fetch_one(&mut transaction).await?;
        let sql = "SELECT mixture_version, round FROM decision ORDER BY sequence DESC LIMIT 1";
        let last: Option<(u64, u64)> = query(sql).fetch_optional(&mut transaction).await?;
        let (mixture_version, round) = last.unwrap_or_default();
        let imported = query("SELECT count(*) FROM import").fetch_one(&mut transaction).await?;
        let processes = processes::all(&mut transaction).await?;
        let run_active = processes.iter().any(ProcessRecord::is_leading);
        let is_refitting =
            processes.iter().any(|found| found.kind == ProcessRecord::REFITTER && !found.is_dead());
        let (limits, used) = budget::read(&mut transaction, now).await?;
        let paused = pauses::read(&mut transaction).await?;
        let mut total = TotalThroughput::default();
        if run_active {
            apply_progress(&mut walks, &walk_progress::recent(&mut transaction, now).await?);
            total = walk_progress::total(&mut transaction, now).await?;
        }
        transaction.commit().await?;
        let labels = LabelJobCounts { excluded, lower_states, ..labels(&states, &asked) };
        let time_used_up = limits.time_used_up(&used);
        set_budget_reason(&mut walks, time_used_up, &limits);
        for walk in &mut walks {
            walk.paused = walk.is_active() && paused.contains(&WalkId(walk.walk));
            walk.steps_per_second = walk.steps_per_second.filter(|_| !walk.paused);
        }
        let no_more_labels = labels.leased == 0 && (labels.queued == 0 || limits.forbids_attempts(&used));
        Ok(CampaignStatus {
            candidates: candidates(&fates, rejected),
            imported,
            run_active,
            mixture_version,
            round,
            finished: !walks.is_empty()
                && !walks.iter().any(WalkStatus::is_active)
                && no_more_labels
                && !is_refitting,
            budget: BudgetStatus { used_up: used_up(time_used_up, &walks), limits, used },
            labels,
            oldest_lease,
            labels_last_hour,
            steps_per_second: total.steps_per_second,
            walkers_busy: total.walkers_busy,
            walks,
            processes: with_visible_state(processes),
        })
    }

    /// Number of accepted candidates of biased walks.
    pub async fn accepted_structures(&self) -> Result<u64> {
        let mut transaction = self.database.begin_read().await?;
        let are_counted = transaction.has_table("candidate_count").await?;
        let accepted = query(if are_counted { ACCEPTED } else { COUNTED_ACCEPTED });
        let accepted = accepted.fetch_one(&mut transaction).await?;
        transaction.commit().await?;
        Ok(accepted)
    }

    /// Number of candidates of an origin that were accepted, or declined for this reason. `None` if the tables of an earlier version
    /// keep no counts.
    pub async fn candidates_of_fate(&self, origin: &str, reason: Option<&str>) -> Result<Option<u64>> {
        let mut transaction = self.database.begin_read().await?;
        let number = match transaction.has_table("candidate_count").await? {
            true => {
                let sum = query(OF_FATE).bind(origin).bind(reason.unwrap_or("accepted"));
                Some(sum.fetch_one(&mut transaction).await?)
            }
            false => None,
        };
        transaction.commit().await?;
        Ok(number)
    }
}

/// Adds the speed of running walks, and their progress since the last checkpoint.
fn apply_progress(walks: &mut [WalkStatus], progress: &[WalkProgressRecord]) {
    for walk in walks.iter_mut().filter(|walk| walk.is_active()) {
        let Ok(found) = progress.binary_search_by_key(&walk.walk, |latest| latest.walk) else { continue };
        let latest = &progress[found];
        walk.steps_per_second = latest.steps_per_second;
        walk.reference_step = latest.reference_step.filter(|_| walk.reference_volume.is_none());
        if walk.reference_step.is_some() {
            walk.temperature = latest.temperature;
        } else if (latest.segment, latest.step) > (walk.segment, walk.step) {
            (walk.segment, walk.step, walk.tau) = (latest.segment, latest.step, latest.tau);
            (walk.temperature, walk.relative_volume) = (latest.temperature, latest.relative_volume);
            walk.gamma_max = latest.gamma_max;
        }
    }
}

/// Sets the budget that ended walks. Running walks count as stopped while a time limit is reached.
fn set_budget_reason(walks: &mut [WalkStatus], time: Option<&'static str>, limits: &Budget) {
    let structures = limits.structures_by.as_deref().unwrap_or("collect.max_structures");
    for walk in walks {
        if walk.state == END_BY_BUDGET {
            structures.clone_into(&mut walk.reason);
        }
        if let (Some(key), "waiting" | "running") = (time, walk.state.as_str()) {
            (walk.state, walk.reason) = (END_BY_BUDGET.to_owned(), key.to_owned());
        }
    }
}

/// The limit that ended walks: a time limit, or the one that walks of the newest version of the potential name. What ended walks of
/// earlier versions was raised since.
fn used_up(time: Option<&'static str>, walks: &[WalkStatus]) -> Option<String> {
    let version = |walk: &WalkStatus| walk.conditions.as_ref().map_or(0, |of| of.version);
    let newest = walks.iter().map(version).max();
    let is_ended = |walk: &&WalkStatus| walk.state == END_BY_BUDGET && Some(version(walk)) == newest;
    let ended = || walks.iter().rfind(is_ended).map(|walk| walk.reason.clone());
    time.map(str::to_owned).or_else(ended)
}

fn candidates(fates: &[(String, String, u64)], rejected_by_guards: u64) -> Candidates {
    let mut candidates = Candidates { rejected_by_guards, ..Candidates::default() };
    for (origin, fate, count) in fates {
        if origin == "control" {
            candidates.control += count;
            continue;
        }
        candidates.seen += count;
        let declined = &mut candidates.declined;
        match fate.as_str() {
            "accepted" => candidates.accepted += count,
            "covered" => declined.covered += count,
            "duplicate" => declined.duplicate += count,
            "too_close" => declined.too_close += count,
            "budget" => declined.budget += count,
            "backlog" => declined.backlog += count,
            "unlikely_to_complete" => declined.unlikely_to_complete += count,
            "grade_too_large" => declined.grade_too_large += count,
            _ => {}
        }
    }
    candidates
}

fn labels(states: &[(String, u64)], asked: &[(String, u64)]) -> LabelJobCounts {
    let of = |states: &[(String, u64)], name: &str| {
        states.iter().find(|(state, _)| state == name).map_or(0, |(_, count)| *count)
    };
    let (number, asked) = (|name: &str| of(states, name), |name: &str| of(asked, name));
    LabelJobCounts {
        queued: number("queued"),
        leased: number("leased"),
        labelled: number("labelled"),
        failed: number("failed"),
        dropped: number("dropped"),
        superseded: number("superseded"),
        relabelling: asked("queued") + asked("leased"),
        relabel_failed: asked("labelled") + asked("failed"),
        failed_under_new_protocol: asked("failed"),
        excluded: 0,
        lower_states: 0,
    }
}

/// Orders processes by kind and number. A dead process keeps its own state only if the orchestrator has given it up
/// or waits before it restarts it.
fn with_visible_state(mut processes: Vec<ProcessRecord>) -> Vec<ProcessRecord> {
    let ranks = [ProcessRecord::ORCHESTRATOR, ProcessRecord::WALKER, ProcessRecord::LABELLER];
    let rank = |kind: &str| ranks.iter().position(|k| *k == kind).unwrap_or(ranks.len());
    processes.sort_by_key(|process| (rank(&process.kind), process.number));
    let run_active = processes.iter().any(ProcessRecord::is_leading);
    for process in &mut processes {
        let state = process.state.as_str();
        let stays = state.starts_with("failed") || (run_active && state == "backing_off");
        if process.is_dead() && !stays {
            process.state = "dead".to_owned();
        } else if process.is_unresponsive() && matches!(state, "running" | "stopping") {
            process.state = "unresponsive".to_owned();
        }
    }
    processes
}

#[cfg(test)]
mod tests {
    use wire::WalkConditions;

    use super::*;

    #[test]
    fn a_limit_that_ended_walks_of_an_earlier_version_is_not_used_up() {
        let walk = |state: &str, version| WalkStatus {
            state: state.into(),
            reason: "budget.structures".into(),
            conditions: Some(WalkConditions { version, ..WalkConditions::default() }),
            ..WalkStatus::default()
        };
        let ended = || vec![walk("completed", 0), walk(END_BY_BUDGET, 0)];
        assert_eq!(used_up(None, &ended()).as_deref(), Some("budget.structures"));
        let went_on = [ended(), vec![walk("completed", 1)]].concat();
        assert_eq!(used_up(None, &went_on), None);
        assert_eq!(used_up(Some("budget.wall_hours"), &went_on).as_deref(), Some("budget.wall_hours"));
    }
}

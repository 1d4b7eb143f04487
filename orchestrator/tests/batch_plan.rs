//! Submitted and cancelled jobs: explicit cases, then arbitrary launches while jobs start, end and are requeued.

use orchestrator::batch::{
    CampaignJob, DesiredJobs, JobId, JobNames, JobPhase, Plan, Role, Submission, plan,
};
use proptest::prelude::*;

const WANTED: DesiredJobs = DesiredJobs { agents: 2, walkers: 4, labellers: 1 };

fn job(id: u64, role: Role, state: &str) -> CampaignJob {
    let walkers = matches!(role, Role::Agent(_)).then_some(WANTED.walkers);
    CampaignJob {
        id: id.into(),
        role,
        state: state.into(),
        nodes: String::new(),
        start: "N/A".into(),
        time_left: "1:00".into(),
        walkers,
        reason: None,
    }
}

fn ids(numbers: &[u64]) -> Vec<JobId> {
    numbers.iter().copied().map(JobId::from).collect()
}

fn submission(role: Role, after_end_of: &[u64]) -> Submission {
    Submission { role, after_end_of: ids(after_end_of) }
}

#[test]
fn at_first_everything_is_submitted_and_the_orchestrator_first() {
    let Plan { cancel, submit } = plan(&WANTED, &[]);
    assert!(cancel.is_empty());
    let roles = [Role::Orchestrator, Role::Agent(0), Role::Agent(1), Role::Labeller(0)];
    assert_eq!(submit, roles.map(|role| submission(role, &[])));
}

#[test]
fn only_what_is_missing_is_submitted() {
    let mut jobs = vec![
        job(1, Role::Orchestrator, "RUNNING"),
        job(2, Role::Agent(0), "PENDING"),
        job(3, Role::Agent(1), "FAILED"),
        job(4, Role::Labeller(0), "CONFIGURING"),
    ];
    assert_eq!(plan(&WANTED, &jobs).submit, [submission(Role::Agent(1), &[])]);
    jobs.push(job(5, Role::Agent(1), "REQUEUE_HOLD"));
    assert_eq!(plan(&WANTED, &jobs), Plan::default());
}

#[test]
fn replacements_wait_for_completing_jobs() {
    let jobs = [
        job(1, Role::Orchestrator, "COMPLETING"),
        job(2, Role::Agent(0), "RUNNING"),
        job(3, Role::Agent(1), "RUNNING"),
        job(4, Role::Labeller(0), "RUNNING"),
    ];
    let expected = Plan { cancel: vec![], submit: vec![submission(Role::Orchestrator, &[1])] };
    assert_eq!(plan(&WANTED, &jobs), expected);
}

#[test]
fn undesired_jobs_are_cancelled() {
    let jobs = [
        job(7, Role::Orchestrator, "PENDING"),
        // Two orchestrators were submitted at once: the first stays. Of two jobs of agent 0, the running one stays.
        job(8, Role::Orchestrator, "PENDING"),
        job(2, Role::Agent(0), "PENDING"),
        job(3, Role::Agent(0), "RUNNING"),
        job(4, Role::Agent(1), "RUNNING"),
        job(5, Role::Agent(2), "RUNNING"),
        job(6, Role::Labeller(0), "PENDING"),
        job(9, Role::Labeller(1), "COMPLETING"),
    ];
    assert_eq!(plan(&WANTED, &jobs), Plan { cancel: ids(&[8, 2, 5]), submit: vec![] });
}

#[test]
fn agents_with_another_number_of_walkers_are_replaced() {
    let mut jobs = vec![
        job(1, Role::Orchestrator, "RUNNING"),
        job(2, Role::Agent(0), "RUNNING"),
        job(3, Role::Agent(1), "RUNNING"),
        job(4, Role::Labeller(0), "RUNNING"),
    ];
    jobs[1].walkers = Some(8);
    // A site that does not keep comments.
    jobs[2].walkers = None;
    let expected = Plan { cancel: ids(&[2]), submit: vec![submission(Role::Agent(0), &[2])] };
    assert_eq!(plan(&WANTED, &jobs), expected);
}

#[test]
fn job_names_match_the_plan() {
    let names = JobNames::new("0123456789ab");
    for role in WANTED.roles() {
        assert_eq!(names.role(&names.job_name(role)), Some(role));
    }
}

/// A job in a batch system that supports `singleton` and `afterany`.
#[derive(Clone, Debug)]
struct Known {
    job: CampaignJob,
    after: Vec<JobId>,
    requeue: bool,
}

#[derive(Debug, Default)]
struct System {
    jobs: Vec<Known>,
    last: u64,
}

impl System {
    fn submit(&mut self, wanted: &DesiredJobs, submission: Submission) {
        self.last += 1;
        let mut job = job(self.last, submission.role, "PENDING");
        job.walkers = job.walkers.map(|_| wanted.walkers);
        self.jobs.push(Known { job, after: submission.after_end_of, requeue: false });
    }

    fn cancel(&mut self, id: &JobId) {
        if let Some(known) = self.jobs.iter_mut().find(|known| known.job.id == *id) {
            known.requeue = false;
            match known.job.phase() {
                JobPhase::Pending => known.job.state = "CANCELLED".into(),
                JobPhase::Running => known.job.state = "COMPLETING".into(),
                JobPhase::Completing | JobPhase::Over => {}
            }
        }
    }

    fn phase(&self, id: &JobId) -> JobPhase {
        self.jobs.iter().find(|known| known.job.id == *id).map_or(JobPhase::Over, |known| known.job.phase())
    }

    fn may_begin(&self, known: &Known) -> bool {
        let before = |other: &&Known| {
            other.job.role == known.job.role
                && (other.job.phase() == JobPhase::Running
                    || other.job.phase() == JobPhase::Pending && other.job.id < known.job.id)
        };
        known.job.phase() == JobPhase::Pending
            && !self.jobs.iter().any(|other| before(&other))
            && known.after.iter().all(|id| self.phase(id) == JobPhase::Over)
    }

    /// A state change of a job by the system itself.
    fn moves(&mut self, place: usize, choice: u8) {
        let Some(known) = self.jobs.get(place % self.jobs.len().max(1)) else { return };
        let begins = self.may_begin(known);
        let known = &mut self.jobs[place % self.last as usize];
        known.job.state = match (known.job.phase(), choice % 3) {
            (JobPhase::Pending, _) if begins => "RUNNING".into(),
            (JobPhase::Running, 0 | 1) => {
                known.requeue = choice.is_multiple_of(3);
                "COMPLETING".into()
            }
            (JobPhase::Completing, _) if known.requeue => "PENDING".into(),
            (JobPhase::Completing, _) => "COMPLETED".into(),
            _ => return,
        };
    }

    fn shown(&self) -> Vec<CampaignJob> {
        self.jobs.iter().map(|known| known.job.clone()).collect()
    }

    fn check(&self, most: &DesiredJobs) {
        let running = |role: Role| {
            let running = self.jobs.iter().filter(move |known| known.job.phase() == JobPhase::Running);
            running.filter(move |known| known.job.role == role).count()
        };
        assert!(running(Role::Orchestrator) <= 1, "{self:#?}");
        let agents: Vec<_> = self
            .jobs
            .iter()
            .filter(|known| known.job.phase() == JobPhase::Running && known.job.walkers.is_some())
            .collect();
        let walkers: u32 = agents.iter().filter_map(|known| known.job.walkers).sum();
        assert!(walkers <= most.agents * most.walkers, "{self:#?}");
        assert!(agents.iter().all(|known| running(known.job.role) == 1), "{self:#?}");
    }
}

/// A launch in progress: the remaining actions of a plan made earlier.
#[derive(Debug, Default)]
struct Launcher {
    wanted: Option<DesiredJobs>,
    plan: Plan,
}

impl Launcher {
    fn step(&mut self, system: &mut System) {
        let Some(wanted) = self.wanted else { return };
        if let Some(id) = self.plan.cancel.pop() {
            system.cancel(&id);
        } else if !self.plan.submit.is_empty() {
            system.submit(&wanted, self.plan.submit.remove(0));
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn there_are_never_two_orchestrators_nor_too_many_agents(
        steps in proptest::collection::vec((0..8_u8, any::<u8>(), any::<u8>()), 0..200),
        asked in proptest::collection::vec((0..4_u32, 1..3_u32, 0..2_u32), 1..4),
    ) {
        let asked: Vec<_> = asked.into_iter()
            .map(|(agents, walkers, labellers)| DesiredJobs { agents, walkers, labellers })
            .collect();
        let most = |of: fn(&DesiredJobs) -> u32| asked.iter().map(of).max().unwrap_or(0);
        let most = DesiredJobs { agents: most(|w| w.agents), walkers: most(|w| w.walkers), labellers: 0 };
        let mut system = System::default();
        let mut launchers: [Launcher; 3] = Default::default();
        for (kind, which, choice) in steps {
            let launcher = &mut launchers[which as usize % 3];
            match kind {
                0 => {
                    let wanted = asked[choice as usize % asked.len()];
                    *launcher = Launcher { wanted: Some(wanted), plan: plan(&wanted, &system.shown()) };
                }
                1..4 => launcher.step(&mut system),
                _ => system.moves(which as usize, choice),
            }
            system.check(&most);
        }
        // From any state, a launch without concurrent changes leaves the desired jobs, and a second launch does
        // nothing.
        let wanted = asked[0];
        for known in &mut system.jobs {
            if known.job.phase() == JobPhase::Completing {
                known.job.state = "COMPLETED".into();
            }
        }
        let mut last = Launcher { wanted: Some(wanted), plan: plan(&wanted, &system.shown()) };
        while last.plan != Plan::default() {
            last.step(&mut system);
        }
        prop_assert_eq!(plan(&wanted, &system.shown()), Plan::default());
        for role in wanted.roles() {
            let living = system.jobs.iter().filter(|known| known.job.role == role);
            let living = living.filter(|k| matches!(k.job.phase(), JobPhase::Pending | JobPhase::Running)).count();
            prop_assert_eq!(living, 1);
        }
    }
}

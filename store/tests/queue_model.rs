//! Compares the queue with a small model, under random operations and a simulated clock.

use std::collections::{BTreeMap, BTreeSet};

use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use store::{CompleteOutcome, ExportFilter, FailOutcome, JobState, Lease, Store, StoreError};

use crate::common::*;

const JOBS: u64 = 4;
const LIMIT: u32 = 2;
const SECONDS: u32 = 10;

#[derive(Clone, Debug)]
enum Step {
    Wait(u16),
    Lease(u8),
    Renew(usize),
    Complete(usize),
    Fail(usize),
    Release(u8),
    Drop(usize),
    Retry(usize),
    Prioritise(usize, i32),
    Reopen,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        3 => (0..9_000_u16).prop_map(Step::Wait),
        8 => (0..3_u8).prop_map(Step::Lease),
        1 => any::<usize>().prop_map(Step::Renew),
        4 => any::<usize>().prop_map(Step::Complete),
        4 => any::<usize>().prop_map(Step::Fail),
        1 => (0..3_u8).prop_map(Step::Release),
        1 => any::<usize>().prop_map(Step::Drop),
        2 => any::<usize>().prop_map(Step::Retry),
        1 => (any::<usize>(), 0..3_i32).prop_map(|(job, priority)| Step::Prioritise(job, priority)),
        1 => Just(Step::Reopen),
    ]
}

#[derive(Clone, Debug, PartialEq)]
struct ModelJob {
    state: JobState,
    priority: i32,
    holder: Option<String>,
    expires: Option<i64>,
    attempts: u32,
    failures: u32,
    /// Attempts that delivered a result; the first one's is the label.
    results: Vec<u32>,
}

impl ModelJob {
    fn change_to(&mut self, state: JobState) {
        (self.state, self.holder, self.expires) = (state, None, None);
    }

    /// There are too few steps for a job to reach the limit of losses.
    fn lose(&mut self) {
        self.change_to(JobState::Queued);
    }

    fn fail(&mut self) {
        self.failures += 1;
        self.change_to(if self.failures >= LIMIT { JobState::Failed } else { JobState::Queued });
    }
}

/// Jobs by index in decision order.
struct Model(BTreeMap<usize, ModelJob>);

impl Model {
    fn lease(&mut self, holder: &str, now: i64) -> Option<usize> {
        for job in self.0.values_mut().filter(|job| job.expires.is_some_and(|expires| expires <= now)) {
            job.lose();
        }
        let queued = self.0.iter_mut().filter(|(_, job)| job.state == JobState::Queued);
        let (place, job) = queued.max_by_key(|(place, job)| (job.priority, std::cmp::Reverse(*place)))?;
        job.state = JobState::Leased;
        job.holder = Some(holder.to_owned());
        job.expires = Some(now + 1000 * i64::from(SECONDS));
        job.attempts += 1;
        Some(*place)
    }
}

struct Run {
    database: TestDatabase,
    store: Store,
    names: Vec<String>,
    model: Model,
    leases: Vec<(usize, Lease)>,
    now: i64,
}

impl Run {
    async fn new() -> Self {
        let database = TestDatabase::new();
        let store = database.create().await;
        let names = accept(&store, JOBS).await;
        let job = ModelJob {
            state: JobState::Queued,
            priority: 10,
            holder: None,
            expires: None,
            attempts: 0,
            failures: 0,
            results: Vec::new(),
        };
        let model = Model((0..JOBS as usize).map(|place| (place, job.clone())).collect());
        Self { database, store, names, model, leases: Vec::new(), now: 0 }
    }

    /// Any lease ever given, lost or not.
    fn pick(&mut self, which: usize) -> Option<(&mut ModelJob, Lease)> {
        let (place, lease) = self.leases.get(which.checked_rem(self.leases.len())?)?.clone();
        Some((self.model.0.get_mut(&place)?, lease))
    }

    async fn step(&mut self, step: Step) {
        let (now, store) = (self.now, self.store.clone());
        match step {
            Step::Wait(milliseconds) => self.now += i64::from(milliseconds),
            Step::Reopen => {
                store.close().await;
                self.store = self.database.open().await;
            }
            Step::Lease(holder) => {
                let holder = format!("host/{holder}");
                let leased = store.lease(protocol("dft").hash, &holder, now, SECONDS).await.unwrap();
                let expected = self.model.lease(&holder, now);
                assert_eq!(leased.as_ref().map(|lease| &lease.candidate), expected.map(|k| &self.names[k]));
                self.leases.extend(expected.zip(leased));
            }
            Step::Renew(which) => {
                let Some((job, lease)) = self.pick(which) else { return };
                let holds = job.state == JobState::Leased && job.attempts == lease.attempt;
                if holds {
                    job.expires = Some(now + 1000 * i64::from(SECONDS));
                }
                assert_eq!(store.renew(&lease, now, SECONDS).await.unwrap(), holds);
            }
            Step::Complete(which) => {
                let Some((job, lease)) = self.pick(which) else { return };
                if !job.results.contains(&lease.attempt) {
                    job.results.push(lease.attempt);
                }
                let first = job.results[0] == lease.attempt;
                if job.state != JobState::Dropped {
                    job.change_to(JobState::Labelled);
                }
                let expected = if first { CompleteOutcome::Label } else { CompleteOutcome::KeptAsCheck };
                let energy = -f64::from(lease.attempt);
                assert_eq!(store.complete(&lease, &label(energy), now).await.unwrap(), expected);
            }
            Step::Fail(which) => {
                let Some((job, lease)) = self.pick(which) else { return };
                let expected = if job.state == JobState::Leased && job.attempts == lease.attempt {
                    job.fail();
                    if job.state == JobState::Failed { FailOutcome::Failed } else { FailOutcome::Requeued }
                } else {
                    FailOutcome::LeaseLost
                };
                assert_eq!(store.fail(&lease, "class", "log", LIMIT, now).await.unwrap(), expected);
            }
            Step::Release(holder) => {
                let holder = format!("host/{holder}");
                let held = |job: &&mut ModelJob| job.holder.as_ref() == Some(&holder);
                let held: Vec<_> = self.model.0.values_mut().filter(held).collect();
                assert_eq!(store.release_all(&holder, now).await.unwrap(), held.len());
                held.into_iter().for_each(ModelJob::lose);
            }
            queue_admin => self.queue_admin(queue_admin).await,
        }
    }

    async fn queue_admin(&mut self, step: Step) {
        use JobState::{Dropped, Failed, Labelled, Leased, Queued};
        let (Step::Drop(which) | Step::Retry(which) | Step::Prioritise(which, _)) = step else { return };
        let place = which % JOBS as usize;
        let (name, now) = (self.names[place].as_str(), self.now);
        let job = self.model.0.get_mut(&place).unwrap();
        let (allowed, done) = match step {
            Step::Drop(_) => {
                let allowed = matches!(job.state, Queued | Leased | Failed);
                (allowed, self.store.drop_job(name, now).await)
            }
            Step::Retry(_) => (matches!(job.state, Failed | Dropped), self.store.retry_job(name, now).await),
            Step::Prioritise(_, priority) => {
                (matches!(job.state, Queued | Leased), self.store.prioritise_job(name, priority, now).await)
            }
            _ => return,
        };
        if !allowed {
            assert!(matches!(done, Err(StoreError::WrongState { .. })));
            return;
        }
        assert_eq!(done.unwrap(), name);
        match step {
            Step::Drop(_) => job.change_to(Dropped),
            Step::Prioritise(_, priority) => job.priority = priority,
            _ => {
                job.failures = 0;
                job.change_to(if job.results.is_empty() { Queued } else { Labelled });
            }
        }
    }

    async fn compare(&self) {
        let mut jobs = self.store.queue_list(None, 100, 0).await.unwrap();
        jobs.sort_by_key(|job| job.job);
        assert_eq!(jobs.len(), self.names.len());
        let mut open = BTreeSet::new();
        for ((place, expected), job) in self.model.0.iter().zip(&jobs) {
            let details = self.store.queue_show(&self.names[*place]).await.unwrap();
            let results = details.energies.iter().map(|(_, energy)| -energy as u32).collect();
            let found = ModelJob {
                state: job.state,
                priority: job.priority,
                holder: job.holder.clone(),
                expires: job.expires,
                attempts: job.attempts,
                failures: job.failures,
                results,
            };
            assert_eq!(&found, expected, "job {place}");
            assert_eq!(details.attempts_made.len() as u32, job.attempts);
            let under_way = details.attempts_made.iter().filter(|attempt| attempt.outcome.is_none()).count();
            assert_eq!(under_way, usize::from(job.state == JobState::Leased), "job {place}");
            open.extend((under_way > 0).then_some(*place));
        }
        let filter =
            ExportFilter { protocol: protocol("dft").hash, biased: true, control: true, imported: true };
        let exported = self.store.labelled(&filter, None, 100).await.unwrap();
        let labelled = self.model.0.values().filter(|job| job.state == JobState::Labelled);
        let energies: Vec<f64> = labelled.map(|job| -f64::from(job.results[0])).collect();
        assert_eq!(exported.iter().map(|row| row.label.energy).collect::<Vec<_>>(), energies);
        let labels = self.store.status().await.unwrap().labels;
        let found = [labels.queued, labels.leased, labels.labelled, labels.failed, labels.dropped];
        let states =
            [JobState::Queued, JobState::Leased, JobState::Labelled, JobState::Failed, JobState::Dropped];
        let number = |state| self.model.0.values().filter(|job| job.state == state).count() as u64;
        assert_eq!((found, labels.leased as usize), (states.map(number), open.len()));
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        // A server answers each of the statements by itself.
        cases: if std::env::var_os("CALMWALK_POSTGRES").is_some() { 12 } else { 40 },
        max_shrink_iters: 200,
        failure_persistence: None,
        rng_seed: RngSeed::Fixed(20),
        ..ProptestConfig::default()
    })]

    #[test]
    fn the_queue_agrees_with_its_model(steps in proptest::collection::vec(step(), 1..50)) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let mut run = Run::new().await;
            for step in steps {
                run.step(step).await;
                run.compare().await;
            }
        });
    }
}

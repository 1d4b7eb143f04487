//! A campaign in live mode whose walkers offer recorded candidates as fast as possible.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use atoms::{MinDistanceRule, Uniform};
use calm::forgetting::ForgettingAlarm;
use calm::rules::{MaximumGrade, MaximumGradeUpdate, Positive};
use calm::{CollectionRule, CovarianceUpdateKind, UpdateRule, UpdateSettings};
use orchestrator::reactor::{Notice, Reactor};
use orchestrator::selector::{
    CampaignMode, OnForgetting, SeedStructurePlan, Selector, SelectorSettings, SelectorSnapshot,
    UpdateProtocol,
};
use store::{CampaignRecord, Fate, Location, Protocol, Store};
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;
use wire::messages::{Assignment, AssignmentReport, Outcome, WalkEnd};
use wire::transport::Incoming;
use wire::{CandidateBlock, ContentHash, WalkConditions};

use crate::recording::{CAMPAIGN, Model, crystal, progress};

/// Size of a walk's checkpoint with 108 atoms, bytes: three states of positions, velocities, forces and energies.
pub const CHECKPOINT: usize = 27_000;
/// Capacity of the channel from walkers to reactor, as in a campaign.
const CHANNEL: usize = 64;

/// The paper's rules for aluminium; structures are collected above `threshold` (in the paper, γ_max > 1.5).
pub fn settings(threshold: f64) -> SelectorSettings {
    let positive = |number: f64| Positive::try_from(number).unwrap();
    SelectorSettings {
        mode: CampaignMode::Live,
        walks_per_round: 1,
        steps_per_assignment: 1000,
        update: UpdateProtocol::Cumulative,
        search: UpdateSettings {
            covariance_update: CovarianceUpdateKind::Convex,
            alpha_values: None,
            stop: UpdateRule::MaximumGrade(MaximumGradeUpdate { target: positive(1.25) }),
        },
        forgetting_alarm: ForgettingAlarm::default(),
        on_forgetting: OnForgetting::default(),
        collection: CollectionRule::MaximumGrade(MaximumGrade { threshold: positive(threshold) }),
        max_per_walk: u32::MAX,
        max_per_seed_structure: None,
        max_structures: None,
        max_steps_without_structure: None,
        stop_groups: Vec::new(),
        control: false,
        control_share: 0.5,
        min_distances: MinDistanceRule::Uniform(Uniform::default()),
        max_grade: None,
        declined_feature_bytes: 1_000_000_000,
        version: Default::default(),
        refit_at: None,
    }
}

/// A selector at the start of the campaign, with one seed structure per walk.
pub fn selector(model: &Model, walks: usize, settings: &SelectorSettings) -> Selector {
    let seeds = seed_structures(walks);
    let (grader, original) = (model.grader.clone(), Arc::clone(&model.original));
    let training = Some(model.training.clone());
    Selector::restore(
        settings.clone(),
        CAMPAIGN,
        seeds,
        grader,
        original,
        training,
        SelectorSnapshot::default(),
    )
    .unwrap()
}

/// The seed structures.
pub fn seed_structures(walks: usize) -> Vec<SeedStructurePlan> {
    (0..walks)
        .map(|k| SeedStructurePlan {
            name: format!("fcc-{k}"),
            structure: crystal(),
            walks: vec![WalkConditions::default()],
        })
        .collect()
}

/// The campaign's database, with a label protocol, so that every accept queues a job.
pub async fn create_store(location: Location, walks: usize) -> Store {
    let campaign = CampaignRecord {
        id: CAMPAIGN,
        program_version: "bench".into(),
        mode: "live".into(),
        configuration: String::new(),
        resolved_configuration: "{}".into(),
        configuration_in_force: "{}".into(),
    };
    let seed = |index| store::SeedStructure {
        index,
        name: format!("fcc-{index}"),
        source: "bench".into(),
        structure: crystal(),
    };
    let seeds: Vec<_> = (0..walks as u32).map(seed).collect();
    let store = Store::create(location, &campaign, &seeds, 0).await.unwrap();
    let hash = ContentHash([7; 32]);
    let protocol = Protocol { hash, name: "reference".into(), settings: serde_json::json!({}) };
    store.add_protocol(&protocol, 0).await.unwrap();
    store
}

/// The next candidate of a walk, or its end.
pub fn report(assignment: &Assignment, block: Option<CandidateBlock>) -> AssignmentReport {
    let mut checkpoint = vec![0; CHECKPOINT];
    checkpoint[..8].copy_from_slice(&assignment.number.to_le_bytes());
    AssignmentReport {
        walk: assignment.walk,
        assignment: assignment.number,
        outcome: block.map_or(Outcome::Ended(WalkEnd::Completed), Outcome::Candidate),
        checkpoint,
        progress: progress(assignment.number),
        start: None,
        trace: Vec::new(),
        frames: Vec::new(),
    }
}

/// Measurements of the whole path through reactor, selector and database.
#[derive(Default)]
pub struct Run {
    pub wall: Duration,
    /// Of all threads.
    pub processor: Duration,
    pub candidates: usize,
    pub accepted: usize,
    pub covered: usize,
    pub commits: usize,
}

/// Sends every recorded candidate from concurrent walkers through the reactor to the database.
pub async fn run(
    model: &Model,
    settings: &SelectorSettings,
    recording: &[Vec<CandidateBlock>],
    location: Location,
) -> Run {
    let walks = recording.len();
    let store = create_store(location, walks).await;
    let mut selector = selector(model, walks, settings);
    store.commit(&selector.start_walks()).await.unwrap();
    let (to_reactor, incoming) = mpsc::channel(CHANNEL);
    let reactor = Reactor {
        selector,
        store: store.clone(),
        incoming,
        stopping: CancellationToken::new(),
        walks_end: CancellationToken::new(),
        queue_limit: u64::MAX,
        completion: None,
    };
    let offers: Arc<Vec<_>> =
        Arc::new(recording.iter().map(|blocks| Mutex::new(blocks.clone().into_iter())).collect());
    let (begun, used) = (Instant::now(), processor_time());
    let walkers: Vec<_> = (0..walks as u32)
        .map(|walker| {
            let (to_reactor, offers) = (to_reactor.clone(), Arc::clone(&offers));
            tokio::spawn(async move { walk(walker, &to_reactor, &offers).await })
        })
        .collect();
    drop(to_reactor);
    let mut run = Run::default();
    reactor.run(|notice| run.record(&notice)).await.unwrap();
    (run.wall, run.processor) = (begun.elapsed(), processor_time() - used);
    for walker in walkers {
        walker.await.unwrap();
    }
    store.close().await;
    run
}

/// A walker as the reactor sees it: it offers the next recorded candidate of any walk it is assigned. The block is
/// validated in place, like one from another process.
async fn walk(
    walker: u32,
    to_reactor: &mpsc::Sender<Incoming>,
    offers: &[Mutex<std::vec::IntoIter<CandidateBlock>>],
) {
    let mut next = None;
    loop {
        let (reply, answer) = oneshot::channel();
        to_reactor.send(Incoming::Idle { walker, report: next.take(), reply }).await.unwrap();
        let Ok(Some(work)) = answer.await else { return };
        let block = offers[work.assignment.walk.0 as usize].lock().unwrap().next();
        next = Some(report(&work.assignment, block.map(checked)));
    }
}

/// The block after another validation.
pub fn checked(block: CandidateBlock) -> CandidateBlock {
    CandidateBlock::in_place(Arc::new(Bytes(block))).unwrap()
}

struct Bytes(CandidateBlock);

impl AsRef<[u8]> for Bytes {
    fn as_ref(&self) -> &[u8] {
        self.0.as_bytes()
    }
}

impl Run {
    fn record(&mut self, notice: &Notice<'_>) {
        let Notice::Committed(commit) = notice else { return };
        self.commits += 1;
        for candidate in &commit.candidates {
            self.candidates += 1;
            match candidate.fate {
                Fate::Accepted => self.accepted += 1,
                Fate::Declined(wire::messages::DeclineReason::Covered) => self.covered += 1,
                Fate::Declined(_) => {}
            }
        }
    }
}

/// Processor time of all threads of this process, in steps of 10 ms (Linux).
fn processor_time() -> Duration {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks =
        |field: usize| fields.get(field).and_then(|text| text.parse::<u64>().ok()).unwrap_or_default();
    Duration::from_millis(10 * (ticks(11) + ticks(12)))
}

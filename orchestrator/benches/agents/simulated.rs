//! Agents and their walkers, in one process.

use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use calm::{Grades, Mixture};
use serde::{Deserialize, Serialize};
use tokio::time::{Instant, sleep};
use wire::messages::Assignment;
use wire::mixture::SharedMixture;
use wire::net::{Address, AgentClient, AgentInfo, Membership, Slot, SlotReport};
use wire::{Candidate, CandidateBlock, CandidateId, ContentHash};

use crate::random::Random;
use crate::recording::{Model, progress};
use crate::{AGENTS, PERIODS, Plan, WALKERS, campaign, endpoint, now, period};

/// Number of recorded candidates.
const RECORDED: usize = 16;
/// One of this number of candidates is new to the mixture …
const NEW: u64 = 50;
/// … with an atom of this grade.
const GRADE: f64 = 2.0;

/// Measurements of the agents.
#[derive(Default, Deserialize, Serialize)]
pub struct Seen {
    /// Time from an offer to the next assignment in each period, s.
    pub waits: [Vec<f64>; PERIODS],
    /// For each agent: mixture versions, and when they were in its shared memory, s.
    pub versions: Vec<Vec<(u64, f64)>>,
}

/// A simulated host.
struct Host {
    joined: Membership,
    shared: Mutex<(SharedMixture, Vec<(u64, f64)>)>,
}

pub async fn agents(plan: Plan) {
    let model = Arc::new(Model::load());
    let recorded: Arc<Vec<_>> = Arc::new((0..RECORDED as u64).map(|number| model.at_rest(number)).collect());
    let directory = tempfile::tempdir_in("/dev/shm").unwrap();
    let (mut hosts, mut walkers) = (Vec::new(), Vec::new());
    for number in 0..AGENTS {
        let host = Arc::new(Host::join(number, plan, directory.path()).await);
        for slot in host.joined.slots() {
            let random = Random::new(walkers.len() as u64);
            let (recorded, host) = (Arc::clone(&recorded), Arc::clone(&host));
            let walker = Walker { recorded, host, random, grades: Grades::default() };
            walkers.push(tokio::spawn(walker.work(slot, plan)));
        }
        hosts.push(host);
    }
    let mut seen = Seen::default();
    for walker in walkers {
        for (offered, waited) in walker.await.unwrap() {
            if let Some(period) = period(offered, plan) {
                seen.waits[period].push(waited);
            }
        }
    }
    for host in hosts {
        host.joined.leave().await;
        seen.versions.push(std::mem::take(&mut host.shared.lock().unwrap().1));
    }
    println!("{}", serde_json::to_string(&seen).unwrap());
}

impl Host {
    async fn join(number: usize, plan: Plan, directory: &Path) -> Self {
        let walkers = (WALKERS / AGENTS) as u32;
        let agent = AgentInfo {
            id: format!("{:032x}", Random::new(number as u64).next()),
            host: "simulated".into(),
            pid: std::process::id(),
            program_version: "bench".into(),
            walkers,
            prefetch: 0,
        };
        let address = Address::Endpoint(endpoint(plan));
        let client = AgentClient::open(&address, None, agent, |why| eprintln!("waiting: {why}")).await;
        let joined = Arc::new(client.unwrap()).join().await.unwrap();
        let newest = joined.newest().await;
        let shared = SharedMixture::create(&directory.join(number.to_string()), &newest, walkers).unwrap();
        Self { joined, shared: Mutex::new((shared, Vec::new())) }
    }

    /// Publishes the mixture of an assignment before a walker gets it, as agents do.
    fn publish(&self, mixture: &Arc<Mixture>) {
        let (shared, versions) = &mut *self.shared.lock().unwrap();
        shared.publish(mixture).unwrap();
        if versions.last().is_none_or(|(last, _)| *last < mixture.version()) {
            versions.push((mixture.version(), now()));
        }
    }
}

/// A walker without dynamics.
struct Walker {
    recorded: Arc<Vec<Candidate>>,
    host: Arc<Host>,
    random: Random,
    grades: Grades,
}

impl Walker {
    /// Sends offers until it is shut down. Returns the time of each offer, and how long the walker waited, s.
    async fn work(mut self, mut slot: Slot, plan: Plan) -> Vec<(f64, f64)> {
        let (mut report, mut waits) = (SlotReport::Empty, Vec::new());
        loop {
            let (offered, begun) = (now(), Instant::now());
            let work = slot.exchange(&self.host.joined, &report).await.unwrap();
            waits.push((offered, begun.elapsed().as_secs_f64()));
            let Some(work) = work else { return waits };
            self.host.publish(&work.mixture);
            let walk = if plan.rate > 0.0 { WALKERS as f64 / plan.rate } else { 0.0 };
            sleep(Duration::from_secs_f64(walk * (0.5 + self.random.uniform()))).await;
            let candidate = self.candidate(&work.assignment, &work.mixture);
            report = SlotReport::Report(Box::new(campaign::report(
                &work.assignment,
                Some(CandidateBlock::encode(&candidate)),
            )));
        }
    }

    /// A recorded candidate with all atoms shifted slightly, so that it is no duplicate.
    fn candidate(&mut self, assignment: &Assignment, mixture: &Mixture) -> Candidate {
        let (walk, number) = (u64::from(assignment.walk.0), assignment.number);
        let mut candidate = self.recorded[(walk + number) as usize % RECORDED].clone();
        let shift = 1e-9 * (walk + WALKERS as u64 * number) as f64;
        candidate.structure.positions.iter_mut().for_each(|position| position[0] += shift);
        let step = progress(number).step;
        let content = ContentHash::from_structure(&candidate.structure);
        candidate.id = CandidateId { walk: assignment.walk, step, content, ..candidate.id };
        candidate.mixture_version = mixture.version();
        if (walk + number).is_multiple_of(NEW) {
            self.make_new(&mut candidate, mixture);
        }
        candidate
    }

    /// Moves the features of the first atom in a random direction until the candidate has the grade of a new structure.
    fn make_new(&mut self, candidate: &mut Candidate, mixture: &Mixture) {
        let dimension = mixture.dimension();
        let before = candidate.features[..dimension].to_vec();
        let direction: Vec<f64> = (0..dimension).map(|_| self.random.normal()).collect();
        let mut moved = |scale: f64| {
            let moved: Vec<f64> = before.iter().zip(&direction).map(|(z, d)| z + scale * d).collect();
            self.grades.evaluate(mixture, &[0], &moved, None).unwrap();
            (moved, self.grades.gamma[0])
        };
        // γ increases with the distance: double it until it is large enough, then bisect.
        let (mut low, mut high) = (0.0, 1e-6);
        while moved(high).1 < GRADE {
            (low, high) = (high, 2.0 * high);
        }
        for _ in 0..10 {
            let middle = 0.5 * (low + high);
            if moved(middle).1 < GRADE { low = middle } else { high = middle }
        }
        candidate.features[..dimension].copy_from_slice(&moved(high).0);
    }
}

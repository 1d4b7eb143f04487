//! Processes of walkers: the real protocol, and scripted walks.

use std::sync::Arc;

use calm::Mixture;
use wire::datagram::{DatagramWalker, OfferAnswer};
use wire::messages::Assignment;

use super::event::{Event, Exit};
use super::fault::{Direction, Time};
use super::planted::PlantedBug;
use super::scenario::SEED_STRUCTURES;
use super::world::World;
use crate::common::scripted::advance;
use crate::common::seed_structure;

/// Time between two questions about an offer.
const POLL_INTERVAL: Time = 5_000;
/// How long a walker waits for its orchestrator.
const ANSWER_TIMEOUT: Time = 600_000;
/// The same after it was asked to stop.
const STOPPING_TIMEOUT: Time = 20_000;
/// How often it sends the same offer.
const MAX_OFFERS: u32 = 5;

/// A process of a walker.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct WalkerKey {
    pub session: u64,
    pub number: u32,
    pub incarnation: u32,
}

/// A walker that runs.
pub struct WalkerProcess {
    client: DatagramWalker,
    /// Number of its current offer.
    offer: u64,
    phase: Phase,
    pub stopped_until: Time,
    sigterm: bool,
}

enum Phase {
    Waiting { last_answer: Time, offers: u32 },
    Working { assignment: Box<Assignment>, mixture: Arc<Mixture> },
}

impl World {
    /// The process of a walker that started last, if it runs.
    pub fn newest_walker(&self, session: u64, number: u32) -> Option<WalkerKey> {
        let of = |key: &&WalkerKey| (key.session, key.number) == (session, number);
        self.walkers.keys().filter(of).max_by_key(|key| key.incarnation).copied()
    }

    pub fn new_walker(&mut self, key: WalkerKey) {
        let incarnation = match self.bug {
            Some(PlantedBug::IncarnationIgnored) => 1,
            _ => key.incarnation,
        };
        let client = DatagramWalker::new(key.session, key.number, incarnation);
        let phase = Phase::Waiting { last_answer: self.now, offers: 0 };
        let process = WalkerProcess { client, offer: 0, phase, stopped_until: 0, sigterm: false };
        self.walkers.insert(key, process);
        let delay = self.random.between(100, 1_000);
        self.after(delay, Event::WalkerStarts(key));
    }

    /// The process, unless it is gone or stopped; then the event comes later.
    fn active_walker(&mut self, key: WalkerKey, event: impl FnOnce() -> Event) -> bool {
        let Some(process) = self.walkers.get(&key) else { return false };
        let until = process.stopped_until;
        if until > self.now {
            self.at(until, event());
        }
        until <= self.now
    }

    pub fn walker_starts(&mut self, key: WalkerKey) {
        if self.active_walker(key, || Event::WalkerStarts(key)) {
            self.begin_offer(key, None);
        }
    }

    fn begin_offer(&mut self, key: WalkerKey, report: Option<wire::messages::AssignmentReport>) {
        let now = self.now;
        let Some(process) = self.walkers.get_mut(&key) else { return };
        let report = report.map(|report| report.map_candidate(|block| block.view().to_candidate()));
        process.client.begin_offer(report);
        process.offer += 1;
        process.phase = Phase::Waiting { last_answer: now, offers: 1 };
        let offer = process.offer;
        self.send_offer(key);
        self.after(POLL_INTERVAL, Event::WalkerPolls(key, offer));
    }

    fn send_offer(&mut self, key: WalkerKey) {
        let process = &self.walkers[&key];
        let event = Event::ToServer { from: key, sequence: process.offer, bytes: process.client.offer() };
        self.send(Direction::ToOrchestrator, key.number, event);
    }

    pub fn walker_polls(&mut self, key: WalkerKey, offer: u64) {
        if !self.active_walker(key, || Event::WalkerPolls(key, offer)) {
            return;
        }
        let process = &self.walkers[&key];
        let Phase::Waiting { last_answer, .. } = process.phase else { return };
        if process.offer != offer {
            return;
        }
        let timeout = if process.sigterm { STOPPING_TIMEOUT } else { ANSWER_TIMEOUT };
        if self.now - last_answer > timeout {
            return self.walker_exits(key, Exit::Failed);
        }
        // A poll is no offer.
        let event = Event::ToServer { from: key, sequence: 0, bytes: process.client.poll() };
        self.send(Direction::ToOrchestrator, key.number, event);
        self.after(POLL_INTERVAL, Event::WalkerPolls(key, offer));
    }

    pub fn answer_arrives(&mut self, key: WalkerKey, bytes: Vec<u8>) {
        if !self.active_walker(key, || Event::ToWalker { to: key, bytes: bytes.clone() }) {
            return;
        }
        let now = self.now;
        let process = self.walkers.get_mut(&key).unwrap();
        let answer = process.client.receive(&bytes);
        let Phase::Waiting { last_answer, offers } = &mut process.phase else { return };
        match answer {
            Err(why) => self.fail(format!("walker {} cannot read an answer: {why}", key.number)),
            Ok(None) => {}
            Ok(Some(OfferAnswer::Pending)) => *last_answer = now,
            Ok(Some(OfferAnswer::Unknown)) if *offers == MAX_OFFERS => self.walker_exits(key, Exit::Failed),
            Ok(Some(OfferAnswer::Unknown)) => {
                (*last_answer, *offers) = (now, *offers + 1);
                self.send_offer(key);
            }
            Ok(Some(OfferAnswer::Shutdown)) => self.walker_exits(key, Exit::Done),
            Ok(Some(OfferAnswer::Assignment(assignment, version))) => {
                self.walker_works(key, assignment, version);
            }
        }
    }

    fn walker_works(&mut self, key: WalkerKey, assignment: Box<Assignment>, version: u64) {
        let process = self.walkers.get_mut(&key).unwrap();
        let offer = process.offer;
        if !self.known.offers.contains(&(key, offer)) {
            return self.fail(format!("walker {} got an answer to an offer that never arrived", key.number));
        }
        let mixture = self.runs.get(&key.session).and_then(|run| run.shared_memory.get(&version)).cloned();
        let Some(mixture) = mixture else {
            return self.fail(format!("walker {} cannot read version {version} of the mixture", key.number));
        };
        self.check_mixture_of(&format!("walker {}", key.number), &assignment, &mixture);
        let Some(process) = self.walkers.get(&key) else { return };
        let time = if process.sigterm { 200 } else { self.random.between(1_500, 5_000) };
        let process = self.walkers.get_mut(&key).unwrap();
        process.phase = Phase::Working { assignment, mixture };
        self.after(time, Event::WalkerFinishes(key, offer));
    }

    /// Asks a walker to stop: it reports after the current step.
    pub fn terminate_walker(&mut self, key: WalkerKey) {
        let Some(process) = self.walkers.get_mut(&key) else { return };
        process.sigterm = true;
        if let Phase::Working { .. } = process.phase {
            let offer = process.offer;
            self.after(200, Event::WalkerFinishes(key, offer));
        }
    }

    pub fn walker_finishes(&mut self, key: WalkerKey, offer: u64) {
        if !self.active_walker(key, || Event::WalkerFinishes(key, offer)) {
            return;
        }
        let process = self.walkers.get_mut(&key).unwrap();
        let Phase::Working { assignment, mixture } = &process.phase else { return };
        if process.offer != offer {
            return;
        }
        let of = |number: &usize| seed_structure(*number).structure == assignment.seed_structure;
        let script = (0..SEED_STRUCTURES).find(of).expect("one of the scenario");
        let pause = process.sigterm.then_some(2);
        let events = self.scenario.script(script, assignment.conditions.version);
        let report = advance(&events, assignment, mixture, pause);
        self.tell(format!(
            "walker {} (incarnation {}) offers its report on walk {}, assignment {}: {}",
            key.number,
            key.incarnation,
            report.walk,
            report.assignment,
            outcome(&report.outcome)
        ));
        self.begin_offer(key, Some(report));
    }

    /// The process of a walker ends.
    pub fn walker_exits(&mut self, key: WalkerKey, exit: Exit) {
        if self.walkers.remove(&key).is_some() {
            self.tell(format!("walker {} (incarnation {}) has ended: {exit:?}", key.number, key.incarnation));
            self.after(1, Event::WalkerGone(key, exit));
        }
    }
}

fn outcome(outcome: &wire::messages::Outcome) -> String {
    use wire::messages::Outcome;
    match outcome {
        Outcome::Candidate(block) => format!("candidate at step {}", block.view().id().step),
        Outcome::StepsDone => "steps done".into(),
        Outcome::Interrupted => "interrupted".into(),
        Outcome::Ended(end) => format!("ended, {}", end.name()),
    }
}

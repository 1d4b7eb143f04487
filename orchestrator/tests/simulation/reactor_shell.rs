//! What the shell of the reactor does around its core: messages and answers, reads of what has changed, and commits.

use std::sync::Arc;

use store::StoreError;
use store::records::Fate;
use wire::datagram::AnswerDatagram;
use wire::transport::WorkItem;

use super::event::Event;
use super::fault::Direction;
use super::faulty_store::CommitTry;
use super::planted::PlantedBug;
use super::refit::RunRefits;
use super::run::TICK;
use super::walker::WalkerKey;
use super::world::World;

/// Most messages of walkers that may wait for the reactor: an offer and an exit of each, and some progress.
const MAX_INCOMING: usize = 64 + 2 * 8;

impl World {
    pub fn message_arrives(&mut self, from: WalkerKey, sequence: u64, bytes: Vec<u8>) {
        let session = from.session;
        if !self.is_active(session, || Event::ToServer { from, sequence, bytes: bytes.clone() }) {
            return;
        }
        let elapsed = self.elapsed();
        let run = self.runs.get_mut(&session).unwrap();
        let Ok((walker, reports)) = run.server.receive(&bytes) else { return };
        match reports {
            true => run.walkers.delivered(walker, elapsed),
            false => run.walkers.heartbeat(walker, elapsed),
        }
        if run.incarnations.get(&walker) != Some(&from.incarnation) {
            return self.fail(format!(
                "incarnation {} of walker {walker} is heard, which was replaced",
                from.incarnation
            ));
        }
        if sequence > 0 {
            self.known.offers.insert((from, sequence));
        }
        self.pump(session);
    }

    /// Lets everything happen that needs no time: answers, decisions, the next assignments.
    pub fn pump(&mut self, session: u64) {
        self.deliver(session);
        self.advance(session);
        self.deliver(session);
        self.plan_supervision(session);
        self.end_if_over(session);
    }

    /// Passes answers to walkers, and messages to the reactor.
    pub(super) fn deliver(&mut self, session: u64) {
        loop {
            let Some(run) = self.runs.get_mut(&session) else { return };
            let mut sent = Vec::new();
            run.server.answer_decided(|work| sent.push(work.clone()));
            run.agents.answer_decided(|work| sent.push(work.clone()));
            let answers = run.server.take_answers();
            let mut incoming = run.server.take_incoming();
            incoming.extend(run.agents.take_incoming());
            let replies = run.agents.take_replies();
            let told = run.agents.take_events();
            sent.into_iter().for_each(|work| self.assignment_leaves(session, work));
            for AnswerDatagram { walker, incarnation, bytes } in answers {
                let newest = self.runs[&session].incarnations.get(&walker).copied();
                let incarnation = match self.bug {
                    Some(PlantedBug::IncarnationIgnored) => newest.unwrap_or(incarnation),
                    _ => incarnation,
                };
                let to = WalkerKey { session, number: walker, incarnation };
                self.send(Direction::ToWalker, walker, Event::ToWalker { to, bytes });
            }
            told.into_iter().for_each(|event| self.agent_event(session, event));
            replies.into_iter().for_each(|(request, bytes)| self.reply_leaves(request, bytes));
            if incoming.len() > MAX_INCOMING {
                self.fail(format!("{} messages wait for the reactor", incoming.len()));
            }
            if incoming.is_empty() {
                return;
            }
            let run = self.runs.get_mut(&session).unwrap();
            if run.finished {
                // The channel to the reactor is closed: who waits is shut down.
                continue;
            }
            if let Err(error) = run.core.receive(incoming) {
                return self.fail(format!("the selector cannot decide: {error}"));
            }
        }
    }

    /// An assignment is sent to a walker: everything that it depends on must be in the store. Publishes its mixture.
    pub(super) fn assignment_leaves(&mut self, session: u64, work: WorkItem) {
        if Some(session) == self.leader() {
            self.check_assignment(&work.assignment);
        }
        self.known.sent.add(&work);
        let run = self.runs.get_mut(&session).unwrap();
        let version = work.mixture.version();
        let before = run.shared_memory.values().next_back();
        let mixture = match (self.bug, before) {
            (Some(PlantedBug::TornMixture), Some(before)) if version > before.version() => {
                Arc::new(before.at_version(version))
            }
            _ => work.mixture,
        };
        run.shared_memory.entry(version).or_insert(mixture);
    }

    /// What the reactor does after a batch of messages or a commit.
    pub(super) fn advance(&mut self, session: u64) {
        let (now, instant, bug) = (self.now, self.instant(), self.bug);
        let Some(run) = self.runs.get_mut(&session).filter(|run| !run.finished && run.writing.is_none())
        else {
            return;
        };
        let skips = |bug_of_read, has_read| has_read && bug == Some(bug_of_read);
        let read = (|| {
            if run.core.needs_unfinished_jobs(instant)
                && !skips(PlantedBug::QueueLengthRemembered, run.has_read[1])
            {
                let unfinished = self.store.read(now, async |store| store.unfinished_jobs().await)?;
                run.core.set_unfinished_jobs(unfinished, instant);
                run.has_read[1] = true;
            }
            if run.core.needs_paused_walks(instant) && !skips(PlantedBug::PauseRemembered, run.has_read[0]) {
                let paused = self.store.read(now, async |store| store.paused_walks().await)?;
                run.core.set_paused_walks(paused, instant);
                run.has_read[0] = true;
            }
            Ok::<_, StoreError>(())
        })();
        if let Err(error) = read {
            return self.run_ends(session, &error.to_string());
        }
        run.core.schedule();
        match run.core.take_commit() {
            Some(commit) => {
                run.writing = Some(commit);
                if bug == Some(PlantedBug::AnswerBeforeCommit) {
                    run.core.send_replies();
                }
                let time = self.random.between(1, 400);
                self.after(time, Event::CommitDue(session));
            }
            None => {
                run.core.send_replies();
                if run.core.is_over() {
                    run.finished = true;
                    self.tell(format!("the reactor of run {session} has ended"));
                }
            }
        }
        self.plan_tick(session);
    }

    pub(super) fn plan_tick(&mut self, session: u64) {
        let Some(run) = self.runs.get_mut(&session) else { return };
        let wanted = run.core.waiting() > 0 || run.finished;
        if wanted && !std::mem::replace(&mut run.ticks, wanted) {
            self.after(TICK, Event::RunTick(session));
        }
    }

    pub fn run_tick(&mut self, session: u64) {
        if !self.is_active(session, || Event::RunTick(session)) {
            return;
        }
        self.runs.get_mut(&session).unwrap().ticks = false;
        self.check_labels(session);
        self.pump(session);
        self.plan_tick(session);
    }

    /// After the last walk, labellers are asked to end when no structure waits for a label.
    pub(super) fn check_labels(&mut self, session: u64) {
        let (now, wall, elapsed) = (self.now, self.wall_clock(), self.elapsed());
        let run = self.runs.get_mut(&session).unwrap();
        if !run.finished || run.stopping.is_cancelled() {
            return;
        }
        let makes_room = run.refits.as_ref().is_some_and(RunRefits::makes_room);
        let pending = self.store.read(now, async |store| store.has_pending_labels(wall).await);
        // Walks of a newer version do not wait for the labels of those that made room.
        if makes_room || pending.is_ok_and(|pending| !pending) || self.bug == Some(PlantedBug::QueueAbandoned)
        {
            let actions = run.labellers.stop(elapsed);
            self.act_on_labellers(session, actions);
        }
    }

    pub fn commit_due(&mut self, session: u64) {
        if !self.is_active(session, || Event::CommitDue(session)) {
            return;
        }
        let run = self.runs.get_mut(&session).unwrap();
        let Some(mut commit) = run.writing.take() else { return };
        if self.bug == Some(PlantedBug::CheckpointForgotten) && !commit.candidates.is_empty() {
            commit.walks.clear();
        }
        match self.store.commit(self.now, session, &commit) {
            CommitTry::Written => {
                self.tell(format!(
                    "run {session} has committed {} decisions, {} candidates",
                    commit.decisions.len(),
                    commit.candidates.len()
                ));
                self.known.decisions += commit.decisions.len() as i64;
                let accepted = commit.candidates.iter().filter(|candidate| candidate.fate == Fate::Accepted);
                self.known.accepted.extend(accepted.map(|candidate| candidate.block.view().id().to_string()));
                self.runs.get_mut(&session).unwrap().core.send_replies();
                self.pump(session);
            }
            CommitTry::Again => {
                run.writing = Some(commit);
                self.after(1_000, Event::CommitDue(session));
            }
            CommitTry::Failed(error @ (StoreError::DuplicateCandidate(_) | StoreError::Inconsistent(_))) => {
                self.fail(format!("a commit contradicts the store: {error}"));
            }
            CommitTry::Failed(error) => self.run_ends(session, &error.to_string()),
        }
    }
}

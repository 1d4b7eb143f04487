//! The thread of a device while its server runs: takes calls, sends batches, and hands out results.

use std::collections::{HashMap, VecDeque};
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use tracing::warn;

use crate::batch_limit::LimitFile;
use crate::call::{BondGeometry, Call, Wanted};
use crate::error::CallError;
use crate::events::DeviceEvent;
use crate::faults::ServerFault;
use crate::process::ServerEvent;
use crate::recipient::Recipient;
use crate::same_model::ModelReference;
use crate::schedule::{DeviceBatch, NextBatch, Schedule, Ticket, TicketKind};
use crate::server::{BatchRequest, Outstanding, Server};
use crate::setup::DeviceSetup;

/// The call of the reference structure.
pub(crate) const REFERENCE: u64 = 0;
/// Time without any event.
const IDLE: Duration = Duration::from_secs(3600);

/// A call without result.
pub(crate) struct PendingCall {
    pub client: u64,
    pub work: CallKind,
    pub recipient: Recipient,
}

/// What a call asks for.
pub(crate) enum CallKind {
    Evaluate { geometry: BondGeometry, features: bool },
    PullBack { cotangent: Vec<f64> },
}

/// A batch that the server has.
pub(crate) struct SentBatch {
    pub call: Outstanding,
    pub batch: DeviceBatch,
}

/// A result that is nonsense, until the reference structure tells whether that is the server's fault.
pub(crate) struct SuspectResult {
    pub ticket: Ticket,
    pub outcome: Result<Vec<f64>, String>,
}

/// The thread while its server runs.
pub(crate) struct ServerLoop<'a> {
    pub setup: &'a DeviceSetup,
    pub progress: &'a dyn Fn(&str),
    pub server: Option<Server>,
    pub generation: u64,
    pub test_structure: BondGeometry,
    /// The model, and what it gave for the test structure at the start.
    pub reference: ModelReference,
    pub schedule: Schedule,
    /// Keeps the size of batches for the next start.
    pub limit_file: Option<LimitFile>,
    /// The last structure of each client.
    pub clients: HashMap<u64, BondGeometry>,
    pub calls: HashMap<u64, PendingCall>,
    pub sent: VecDeque<SentBatch>,
    pub suspects: Vec<SuspectResult>,
    /// How often the server has failed at each call that has no result yet.
    pub crashes: HashMap<u64, u32>,
    /// Failures of the server since its last answer to a client.
    pub failures: u32,
    /// Calls that were refused since then because the server failed at them.
    pub refusals: u32,
    pub next_id: u64,
    pub busy_since: Option<Instant>,
    pub started: Instant,
    pub given_up: Option<String>,
}

impl ServerLoop<'_> {
    /// Works until the device is closed.
    pub fn run(&mut self) {
        loop {
            let next = self.dispatch();
            let deadline = self.sent.front().map(|sent| sent.call.deadline());
            let until = [next, deadline].into_iter().flatten().min();
            let timeout = until.map_or(IDLE, |until| until.saturating_duration_since(Instant::now()));
            let is_open = match self.setup.incoming.recv_timeout(timeout) {
                Ok(event) => self.handle(event),
                Err(RecvTimeoutError::Timeout) => true,
                Err(RecvTimeoutError::Disconnected) => false,
            };
            self.check_deadline();
            self.note_time();
            if !is_open {
                self.give_up("the device has ended");
                return;
            }
        }
    }

    /// Returns whether the device goes on.
    pub fn handle(&mut self, event: DeviceEvent) -> bool {
        match event {
            DeviceEvent::Call { client, call, recipient } => self.accept(client, call, recipient),
            DeviceEvent::Server { generation, event } => {
                let is_current = self.server.as_ref().is_some_and(|server| server.is_of(generation));
                match event {
                    _ if !is_current => {}
                    ServerEvent::Line(line) => self.take_answer(&line),
                    ServerEvent::Ended => {
                        let names = self.setup.settings.names();
                        let batch = self.take_oldest();
                        self.restart(ServerFault::Exited(format!("{names}: the server has exited")), batch);
                    }
                }
            }
            DeviceEvent::WarmUp { geometry, most, done } => {
                let _ = done.send(self.warm_up(&geometry, most));
            }
            DeviceEvent::Close => return false,
        }
        true
    }

    fn accept(&mut self, client: u64, call: Result<Call, String>, recipient: Recipient) {
        if let Some(reason) = &self.given_up {
            return recipient.refuse(&CallError::Unavailable(reason.clone()));
        }
        let known = self.clients.get(&client).map(BondGeometry::shape);
        let accepted = call.and_then(|call| match call {
            Call::Evaluate { geometry, wanted } => {
                let Wanted { features, forces, pull_back_follows } = wanted;
                let kind = TicketKind::Evaluate { follows: pull_back_follows, features, forces };
                Ok((geometry.shape(), kind, CallKind::Evaluate { geometry, features }))
            }
            Call::PullBack { cotangent, with_energy } => match known {
                Some(shape) => {
                    let work = CallKind::PullBack { cotangent };
                    Ok((shape, TicketKind::PullBack { with_energy }, work))
                }
                None => Err("a pull-back before the first evaluation".to_owned()),
            },
        });
        match accepted {
            Err(error) => recipient.refuse(&CallError::Failed(error)),
            Ok((shape, kind, work)) => {
                let id = self.next_id;
                self.next_id += 1;
                self.calls.insert(id, PendingCall { client, work, recipient });
                self.schedule.add(Ticket { id, client, kind, shape, since: Instant::now(), alone: false });
            }
        }
    }

    /// Sends what can be sent. Returns when there may be more.
    fn dispatch(&mut self) -> Option<Instant> {
        while self.server.is_some() {
            match self.schedule.next(Instant::now()) {
                NextBatch::Send(batch) => self.send(batch),
                NextBatch::WaitUntil(time) => return Some(time),
                NextBatch::Wait => return None,
            }
        }
        None
    }

    fn send(&mut self, batch: DeviceBatch) {
        let now = Instant::now();
        let waited: f64 = batch.tickets().iter().map(|one| now.duration_since(one.since).as_secs_f64()).sum();
        match self.write_and_send(&batch) {
            Ok(call) => {
                self.sent.push_back(SentBatch { call, batch });
                self.busy_since.get_or_insert(now);
                self.setup.note(|statistics| statistics.waited += waited);
            }
            // It exited when it was idle, or while it computed the batch before.
            Err(fault @ ServerFault::Exited(_)) => {
                self.schedule.abort_newest();
                self.schedule.put_back(batch.tickets());
                let before = self.take_oldest();
                self.restart(fault, before);
            }
            Err(fault) => {
                self.schedule.abort_newest();
                self.handle_fault(fault, batch);
            }
        }
    }

    /// The calls that the server is working on.
    fn take_oldest(&mut self) -> Vec<Ticket> {
        self.sent.pop_front().map(|sent| sent.batch.tickets()).unwrap_or_default()
    }

    fn write_and_send(&mut self, batch: &DeviceBatch) -> Result<Outstanding, ServerFault> {
        let Self { server, calls, clients, test_structure, setup, .. } = self;
        let server = server.as_mut().ok_or(ServerFault::Stopped)?;
        let settings = &setup.settings;
        let geometry = |ticket: &Ticket| match calls.get(&ticket.id).map(|call| &call.work) {
            Some(CallKind::Evaluate { geometry, .. }) => geometry,
            _ => clients.get(&ticket.client).unwrap_or(test_structure),
        };
        let cotangent = |ticket: &Ticket| match calls.get(&ticket.id).map(|call| &call.work) {
            Some(CallKind::PullBack { cotangent }) => Some(&cotangent[..]),
            _ => None,
        };
        let with_energy = |ticket: &Ticket| ticket.kind == TicketKind::PullBack { with_energy: true };
        match batch {
            DeviceBatch::Evaluate { slot, tickets } => {
                server.write(*slot, &tickets.iter().map(geometry).collect::<Vec<_>>())?;
                let wants = |one: &Ticket| matches!(one.kind, TicketKind::Evaluate { features: true, .. });
                let needs = |one: &Ticket| matches!(one.kind, TicketKind::Evaluate { forces: true, .. });
                let (features, forces) = (tickets.iter().any(wants), tickets.iter().any(needs));
                server.send(*slot, BatchRequest::Evaluate { features, forces }, settings)
            }
            DeviceBatch::PullBackKept { slot, tickets } => {
                let arena = &mut server.arenas[*slot];
                arena.write_cotangents(tickets.iter().map(|one| one.as_ref().and_then(cotangent)));
                let is_with_energy = |one: &Option<Ticket>| one.as_ref().is_some_and(with_energy);
                arena.write_energy_cotangents(tickets.iter().map(is_with_energy));
                let with_energy = tickets.iter().any(is_with_energy);
                server.send(*slot, BatchRequest::PullBack { with_energy }, settings)
            }
            DeviceBatch::PullBackAnew { slot, tickets } => {
                server.write(*slot, &tickets.iter().map(geometry).collect::<Vec<_>>())?;
                let arena = &mut server.arenas[*slot];
                arena.write_cotangents(tickets.iter().map(cotangent));
                arena.write_energy_cotangents(tickets.iter().map(with_energy));
                let with_energy = tickets.iter().any(with_energy);
                server.send(*slot, BatchRequest::PullBack { with_energy }, settings)
            }
        }
    }

    fn take_answer(&mut self, line: &str) {
        let names = self.setup.settings.names();
        let Some(SentBatch { call, batch }) = self.sent.pop_front() else {
            let fault = ServerFault::Nonsense(format!("{names}: an answer without a call"));
            return self.restart(fault, Vec::new());
        };
        let now = Instant::now();
        if let Some(next) = self.sent.front_mut() {
            next.call.begun = now;
        }
        let Some(server) = &mut self.server else { return };
        match server.answer(line, &call, &names) {
            Ok((compiled, seconds)) => {
                // Compiling says nothing about how long walkers need.
                let time = if compiled { Duration::ZERO } else { now.duration_since(call.begun) };
                self.schedule.done(now, time);
                self.setup.note(|statistics| statistics.computed += seconds);
                self.count(&call, &batch, compiled, now);
                self.deliver(&call, &batch);
            }
            Err(fault) => {
                self.schedule.abort_oldest();
                self.handle_fault(fault, batch);
            }
        }
    }

    /// Hands out the results of a batch.
    fn deliver(&mut self, call: &Outstanding, batch: &DeviceBatch) {
        let members: Vec<Option<Ticket>> = match batch {
            DeviceBatch::Evaluate { tickets, .. } | DeviceBatch::PullBackAnew { tickets, .. } => {
                tickets.iter().copied().map(Some).collect()
            }
            DeviceBatch::PullBackKept { tickets, .. } => tickets.clone(),
        };
        for (place, ticket) in members.into_iter().enumerate() {
            let Some(ticket) = ticket else { continue };
            let Some(server) = &mut self.server else { return };
            let mut parts = server.arenas[call.slot].result(place, call.kind);
            if ticket.id == REFERENCE {
                let energies = parts.energies.to_vec();
                self.check_reference(&energies);
                continue;
            }
            if let Some(CallKind::Evaluate { features: false, .. }) =
                self.calls.get(&ticket.id).map(|call| &call.work)
            {
                parts.features = &[];
            }
            if let Some(what) = parts.not_finite() {
                let mut numbers = vec![0.0; parts.len()];
                parts.write(&mut numbers);
                warn!(what, client = ticket.client, "nonsense from the python server");
                self.suspect(ticket, Ok(numbers));
                continue;
            }
            self.crashes.remove(&ticket.id);
            (self.failures, self.refusals) = (0, 0);
            if let Some(call) = self.calls.remove(&ticket.id) {
                call.recipient.answer(parts.len(), |out| parts.write(out));
                if let CallKind::Evaluate { geometry, .. } = call.work {
                    self.clients.insert(call.client, geometry);
                }
            }
        }
    }

    fn check_deadline(&mut self) {
        let is_over = |sent: &SentBatch| sent.call.deadline() <= Instant::now();
        if let Some(sent) = self.sent.front().filter(|sent| is_over(sent)) {
            let seconds = sent.call.timeout.as_secs();
            let names = self.setup.settings.names();
            let batch = self.take_oldest();
            self.restart(ServerFault::Timeout(format!("{names}: no answer for {seconds} s")), batch);
        }
    }

    fn count(&mut self, call: &Outstanding, batch: &DeviceBatch, compiled: bool, now: Instant) {
        let tickets = batch.tickets();
        let bonds: usize = tickets.iter().map(|one| one.shape.bonds).sum();
        let seconds = now.duration_since(call.begun).as_secs_f64();
        self.setup.note(|statistics| {
            statistics.batches += 1;
            statistics.structures += tickets.len() as u64;
            statistics.bonds += bonds as u64;
            statistics.largest_batch = statistics.largest_batch.max(tickets.len() as u64);
            statistics.compiled += if compiled { seconds } else { 0.0 };
        });
    }

    /// Adds the time since the last event, if the server had work.
    fn note_time(&mut self) {
        let now = Instant::now();
        let busy = self.busy_since.map_or(0.0, |since| now.duration_since(since).as_secs_f64());
        self.busy_since = (!self.sent.is_empty()).then_some(now);
        let elapsed = now.duration_since(self.started).as_secs_f64();
        self.setup.note(|statistics| {
            statistics.busy += busy;
            statistics.elapsed = elapsed;
        });
    }
}

//! The thread of a device: takes calls, sends batches, hands out results, and starts the server again when it fails.

use std::collections::{HashMap, HashSet, VecDeque};
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;
use tracing::{info, warn};
use wire::DeviceStatistics;

use crate::call::{BondGeometry, Call};
use crate::description::AdapterFeatures;
use crate::device::{CallError, DeviceError, DeviceInfo, Recipient};
use crate::faults::Fault;
use crate::process::ServerEvent;
use crate::schedule::{DeviceBatch, Kind, Next, Schedule, Ticket};
use crate::self_test::{self, TestSubject};
use crate::server::{Outstanding, Server, ServerSetup, Synchronous};
use crate::settings::PythonSettings;
use crate::shapes::Shape;

/// A server that fails so many times without an answer in between is given up.
const MAX_FAILURES: u32 = 3;
/// The call of the reference structure.
const REFERENCE: u64 = 0;
/// Largest relative difference of the reference structure's energies from those at the start.
const REFERENCE_TOLERANCE: f64 = 1e-5;
/// Time without any event.
const IDLE: Duration = Duration::from_secs(3600);

/// What the thread waits for.
#[derive(Debug)]
pub(crate) enum DeviceEvent {
    /// A client calls.
    Call { client: u64, call: Result<Call, String>, recipient: Recipient },
    /// A server has something to say.
    Server { generation: u64, event: ServerEvent },
    /// Evaluate copies of a structure in batches of all sizes, so that programs are compiled and memory is known.
    WarmUp { geometry: BondGeometry, done: SyncSender<()> },
    /// The device ends.
    Close,
}

/// A device's thread before its server runs.
pub(crate) struct Worker {
    settings: PythonSettings,
    package: PathBuf,
    memory: PathBuf,
    events: Sender<DeviceEvent>,
    incoming: Receiver<DeviceEvent>,
    statistics: Arc<Mutex<DeviceStatistics>>,
    stop: CancellationToken,
    broken: CancellationToken,
}

/// A call without result.
struct PendingCall {
    client: u64,
    work: Work,
    recipient: Recipient,
}

enum Work {
    Evaluate { geometry: BondGeometry, features: bool },
    PullBack { cotangent: Vec<f64> },
}

/// A batch that the server has.
struct SentBatch {
    call: Outstanding,
    batch: DeviceBatch,
}

/// A result that is nonsense, until the reference structure tells whether that is the server's fault.
struct Suspect {
    ticket: Ticket,
    outcome: Result<Vec<f64>, String>,
}

/// The thread while its server runs.
struct Running<'a> {
    worker: &'a Worker,
    progress: &'a dyn Fn(&str),
    server: Option<Server>,
    generation: u64,
    identity: String,
    reference: (BondGeometry, Vec<f64>),
    schedule: Schedule,
    /// The last structure of each client.
    clients: HashMap<u64, BondGeometry>,
    calls: HashMap<u64, PendingCall>,
    sent: VecDeque<SentBatch>,
    suspects: Vec<Suspect>,
    /// Calls that a failure has interrupted.
    interrupted: HashSet<u64>,
    failures: u32,
    next_id: u64,
    busy_since: Option<Instant>,
    started: Instant,
    given_up: Option<String>,
}

impl Worker {
    pub fn new(
        settings: PythonSettings,
        (package, memory): (PathBuf, PathBuf),
        (events, incoming): (Sender<DeviceEvent>, Receiver<DeviceEvent>),
        statistics: Arc<Mutex<DeviceStatistics>>,
        (stop, broken): (CancellationToken, CancellationToken),
    ) -> Self {
        Self { settings, package, memory, events, incoming, statistics, stop, broken }
    }

    fn setup(&self) -> ServerSetup<'_> {
        ServerSetup {
            settings: &self.settings,
            package: &self.package,
            memory: &self.memory,
            events: &self.events,
            stop: &self.stop,
        }
    }

    /// Starts the server, tells whether that went well, and works until the device is closed.
    pub fn run(self, progress: &dyn Fn(&str), ready: &SyncSender<Result<DeviceInfo, DeviceError>>) {
        let mut early = Vec::new();
        match self.begin(progress, &mut early) {
            Ok((mut running, info)) => {
                let _ = ready.send(Ok(info));
                if early.into_iter().all(|event| running.handle(event)) {
                    running.run();
                }
            }
            Err(error) => {
                let _ = ready.send(Err(error));
            }
        }
    }

    fn begin<'a>(
        &'a self,
        progress: &'a dyn Fn(&str),
        early: &mut Vec<DeviceEvent>,
    ) -> Result<(Running<'a>, DeviceInfo), DeviceError> {
        progress(&format!("starting {}", self.settings.names()));
        let mut server = Server::start(&self.setup(), 0, &self.incoming, early).map_err(start_error)?;
        let description = server.description.clone();
        info!(
            pid = server.pid(),
            adapter = description.adapter,
            device = description.device,
            "python server"
        );
        {
            let mut statistics = self.statistics.lock().unwrap_or_else(PoisonError::into_inner);
            statistics.adapter.clone_from(&description.adapter);
            statistics.device.clone_from(&description.device);
        }
        let elements = description.check().map_err(DeviceError::Server)?;
        let dimension = match description.features.form {
            AdapterFeatures::None => 0,
            AdapterFeatures::Raw | AdapterFeatures::Final => description.features.dimension,
        };
        let epsilon = if description.precision == "double" { f64::EPSILON } else { f64::from(f32::EPSILON) };
        let subject = TestSubject { elements: &elements, cutoff: description.cutoff(), dimension, epsilon };
        progress("testing the derivatives of the model");
        let names = || self.settings.names();
        let refused = |source| DeviceError::SelfTest { names: names(), source };
        let reference = self_test::reference(&subject).map_err(|error| refused(error.into()))?;
        let setup = self.setup();
        let incoming = &self.incoming;
        let mut calls = Synchronous { server: &mut server, setup: &setup, incoming, early, fault: None };
        let tested = self_test::run(&subject, &mut calls);
        if let Some(fault) = calls.fault.take() {
            return Err(start_error(server.end(fault)));
        }
        let report = tested.map_err(refused)?;
        let found = calls.round_trip(&[&reference], None).map_err(start_error)?;
        let energies = found.into_iter().next().map(|one| one.energies).unwrap_or_default();
        let limit = description.max_structures.unwrap_or(u32::MAX).min(self.settings.max_batch.get());
        let running = Running {
            worker: self,
            progress,
            server: Some(server),
            generation: 0,
            identity: description.identity.clone(),
            reference: (reference, energies),
            schedule: Schedule::new(limit as usize),
            clients: HashMap::new(),
            calls: HashMap::new(),
            sent: VecDeque::new(),
            suspects: Vec::new(),
            interrupted: HashSet::new(),
            failures: 0,
            next_id: REFERENCE + 1,
            busy_since: None,
            started: Instant::now(),
            given_up: None,
        };
        Ok((running, DeviceInfo { description, self_test: report }))
    }
}

fn start_error(fault: Fault) -> DeviceError {
    match fault {
        Fault::Stopped => DeviceError::Stopped,
        other => DeviceError::Server(other.message().to_owned()),
    }
}

impl Running<'_> {
    fn run(&mut self) {
        loop {
            let next = self.dispatch();
            let deadline = self.sent.front().map(|sent| sent.call.deadline);
            let until = [next, deadline].into_iter().flatten().min();
            let timeout = until.map_or(IDLE, |until| until.saturating_duration_since(Instant::now()));
            let is_open = match self.worker.incoming.recv_timeout(timeout) {
                Ok(event) => self.handle(event),
                Err(RecvTimeoutError::Timeout) => {
                    self.check_deadline();
                    true
                }
                Err(RecvTimeoutError::Disconnected) => false,
            };
            self.note_time();
            if !is_open {
                self.give_up("the device has ended");
                return;
            }
        }
    }

    /// Returns whether the device goes on.
    fn handle(&mut self, event: DeviceEvent) -> bool {
        match event {
            DeviceEvent::Call { client, call, recipient } => self.accept(client, call, recipient),
            DeviceEvent::Server { generation, event } => {
                let is_current = self.server.as_ref().is_some_and(|server| server.is_of(generation));
                match event {
                    _ if !is_current => {}
                    ServerEvent::Line(line) => self.take_answer(&line),
                    ServerEvent::Ended => {
                        let names = self.worker.settings.names();
                        self.restart(Fault::Exited(format!("{names}: the server has exited")));
                    }
                }
            }
            DeviceEvent::WarmUp { geometry, done } => {
                self.warm_up(&geometry);
                let _ = done.send(());
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
            Call::Evaluate { geometry, features, pull_back_follows } => {
                let kind = Kind::Evaluate { follows: pull_back_follows, features };
                Ok((geometry.shape(), kind, Work::Evaluate { geometry, features }))
            }
            Call::PullBack { cotangent } => match known {
                Some(shape) => Ok((shape, Kind::PullBack, Work::PullBack { cotangent })),
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
                Next::Send(batch) => self.send(batch),
                Next::WaitUntil(time) => return Some(time),
                Next::Wait => return None,
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
                self.note(|statistics| statistics.waited += waited);
            }
            Err(fault) => {
                self.schedule.abort_newest();
                self.handle_fault(fault, batch);
            }
        }
    }

    fn write_and_send(&mut self, batch: &DeviceBatch) -> Result<Outstanding, Fault> {
        let Self { server, calls, clients, reference, worker, .. } = self;
        let server = server.as_mut().ok_or(Fault::Stopped)?;
        let settings = &worker.settings;
        let geometry = |ticket: &Ticket| match calls.get(&ticket.id).map(|call| &call.work) {
            Some(Work::Evaluate { geometry, .. }) => geometry,
            _ => clients.get(&ticket.client).unwrap_or(&reference.0),
        };
        let cotangent = |ticket: &Ticket| match calls.get(&ticket.id).map(|call| &call.work) {
            Some(Work::PullBack { cotangent }) => Some(&cotangent[..]),
            _ => None,
        };
        match batch {
            DeviceBatch::Evaluate { slot, tickets } => {
                server.write(*slot, &tickets.iter().map(geometry).collect::<Vec<_>>())?;
                let wants = |one: &Ticket| matches!(one.kind, Kind::Evaluate { features: true, .. });
                server.send(*slot, Some(tickets.iter().any(wants)), settings)
            }
            DeviceBatch::PullBackKept { slot, tickets } => {
                server.arenas[*slot]
                    .write_cotangents(tickets.iter().map(|one| one.as_ref().and_then(cotangent)));
                server.send(*slot, None, settings)
            }
            DeviceBatch::PullBackAnew { slot, tickets } => {
                server.write(*slot, &tickets.iter().map(geometry).collect::<Vec<_>>())?;
                server.arenas[*slot].write_cotangents(tickets.iter().map(cotangent));
                server.send(*slot, None, settings)
            }
        }
    }

    fn take_answer(&mut self, line: &str) {
        let names = self.worker.settings.names();
        let Some(SentBatch { call, batch }) = self.sent.pop_front() else {
            return self.restart(Fault::Nonsense(format!("{names}: an answer without a call")));
        };
        let Some(server) = &mut self.server else { return };
        match server.answer(line, &call, &names) {
            Ok((compiled, seconds)) => {
                let now = Instant::now();
                self.schedule.done(now);
                self.note(|statistics| statistics.computed += seconds);
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
                self.judge(&energies);
                continue;
            }
            if let Some(Work::Evaluate { features: false, .. }) =
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
            self.interrupted.remove(&ticket.id);
            if let Some(call) = self.calls.remove(&ticket.id) {
                call.recipient.answer(parts.len(), |out| parts.write(out));
                if let Work::Evaluate { geometry, .. } = call.work {
                    self.clients.insert(call.client, geometry);
                }
            }
        }
        if self.interrupted.is_empty() && self.suspects.is_empty() {
            self.failures = 0;
        }
    }

    /// Asks for a result once more, alone; if that has been tried, asks the reference structure.
    fn suspect(&mut self, ticket: Ticket, outcome: Result<Vec<f64>, String>) {
        if !ticket.alone {
            return self.schedule.put_back(std::iter::once(Ticket { alone: true, ..ticket }));
        }
        if self.suspects.is_empty() {
            let kind = Kind::Evaluate { follows: false, features: false };
            let shape = self.reference.0.shape();
            let reference =
                Ticket { id: REFERENCE, client: REFERENCE, kind, shape, since: Instant::now(), alone: true };
            self.schedule.put_back(std::iter::once(reference));
        }
        self.suspects.push(Suspect { ticket, outcome });
    }

    /// Compares the reference structure with what it was at the start. If it is the same, suspicious results are those of the model.
    fn judge(&mut self, energies: &[f64]) {
        let expected = &self.reference.1;
        let size = expected.iter().map(|x| x.abs()).fold(1.0, f64::max);
        let same = energies.len() == expected.len()
            && energies.iter().zip(expected).all(|(a, b)| (a - b).abs() <= REFERENCE_TOLERANCE * size);
        if !same {
            let names = self.worker.settings.names();
            let sum = |energies: &[f64]| energies.iter().sum::<f64>();
            let message = format!(
                "{names}: the energy of the test structure is {} eV; it was {} eV at the start",
                sum(energies),
                sum(expected)
            );
            return self.restart(Fault::Nonsense(message));
        }
        for Suspect { ticket, outcome } in std::mem::take(&mut self.suspects) {
            self.interrupted.remove(&ticket.id);
            let Some(call) = self.calls.remove(&ticket.id) else { continue };
            match outcome {
                Ok(numbers) => {
                    if let Work::Evaluate { geometry, .. } = call.work {
                        self.clients.insert(call.client, geometry);
                    }
                    call.recipient.answer(numbers.len(), |out| out.copy_from_slice(&numbers));
                }
                Err(message) => call.recipient.refuse(&CallError::Failed(message)),
            }
        }
    }

    fn handle_fault(&mut self, fault: Fault, batch: DeviceBatch) {
        let tickets = batch.tickets();
        let bonds: usize = tickets.iter().map(|one| one.shape.bonds).sum();
        match fault {
            Fault::Memory(message) if tickets.len() > 1 => {
                warn!(
                    message,
                    structures = tickets.len(),
                    bonds,
                    "the device is short of memory: smaller batches"
                );
                self.schedule.limit_bonds(bonds / 2);
                let limit = self.schedule.max_bonds() as u64;
                self.note(|statistics| {
                    statistics.max_bonds = Some(limit);
                    statistics.last_failure = Some(message);
                });
                self.schedule.put_back(tickets.into_iter());
            }
            Fault::Reported(message) if tickets.iter().any(|one| one.id == REFERENCE) => {
                self.restart(Fault::Nonsense(message));
            }
            Fault::Reported(message) => {
                warn!(message, "a call of the python server failed");
                for ticket in tickets.into_iter().rev() {
                    self.suspect(ticket, Err(message.clone()));
                }
            }
            fault => {
                self.interrupted.extend(tickets.iter().map(|one| one.id));
                self.schedule.put_back(tickets.into_iter());
                self.restart(fault);
            }
        }
    }

    fn check_deadline(&mut self) {
        let is_over = |sent: &SentBatch| sent.call.deadline <= Instant::now();
        if let Some(sent) = self.sent.front().filter(|sent| is_over(sent)) {
            let seconds = (sent.call.deadline - sent.call.sent).as_secs();
            let names = self.worker.settings.names();
            self.restart(Fault::Timeout(format!("{names}: no answer for {seconds} s")));
        }
    }

    /// Ends the server and starts another one. Calls without results are sent again.
    fn restart(&mut self, mut fault: Fault) {
        for SentBatch { batch, .. } in std::mem::take(&mut self.sent).into_iter().rev() {
            let tickets = batch.tickets();
            self.interrupted.extend(tickets.iter().map(|one| one.id));
            self.schedule.put_back(
                tickets.into_iter().filter(|one| one.id != REFERENCE).collect::<Vec<_>>().into_iter(),
            );
        }
        let suspects = std::mem::take(&mut self.suspects);
        self.schedule
            .put_back(suspects.into_iter().map(|suspect| suspect.ticket).collect::<Vec<_>>().into_iter());
        self.schedule.forget_server(REFERENCE);
        loop {
            if let Some(server) = self.server.take() {
                fault = server.end(fault);
            }
            self.failures += 1;
            let message = fault.message().to_owned();
            warn!(message, failures = self.failures, "the python server failed");
            self.note(|statistics| statistics.last_failure = Some(message.clone()));
            if self.failures >= MAX_FAILURES || fault == Fault::Stopped {
                let reason = format!(
                    "the model's server failed {MAX_FAILURES} times in a row; the last time: {message}"
                );
                return self.give_up(&reason);
            }
            (self.progress)(&format!("{message}; starting the server again"));
            self.generation += 1;
            self.note(|statistics| statistics.restarts += 1);
            let mut early = Vec::new();
            let worker = self.worker;
            match Server::start(&worker.setup(), self.generation, &worker.incoming, &mut early) {
                Ok(server) if server.description.identity == self.identity => self.server = Some(server),
                Ok(server) => {
                    let names = worker.settings.names();
                    fault = server
                        .end(Fault::Nonsense(format!("{names}: the model has changed since the start")));
                }
                Err(start) => fault = start,
            }
            for event in early {
                if !self.handle(event) {
                    fault = Fault::Stopped;
                }
            }
            if self.server.is_some() && fault != Fault::Stopped {
                return;
            }
        }
    }

    /// Refuses all calls, now and later.
    fn give_up(&mut self, reason: &str) {
        self.given_up = Some(reason.to_owned());
        self.worker.broken.cancel();
        for (_, call) in self.calls.drain() {
            call.recipient.refuse(&CallError::Unavailable(reason.to_owned()));
        }
    }

    /// Evaluates batches of one, two, four … copies, so that their programs are compiled, and finds how many fit into the memory.
    fn warm_up(&mut self, geometry: &BondGeometry) {
        let worker = self.worker;
        let setup = worker.setup();
        let Some(server) = self.server.as_mut().filter(|_| self.sent.is_empty()) else { return };
        let has_features = server.description.features.form != AdapterFeatures::None;
        let dimension = if has_features { server.description.features.dimension } else { 0 };
        let cotangent = vec![0.0; geometry.positions.len() * dimension];
        let mut early = Vec::new();
        let mut fault = None;
        let mut copies = 1;
        while copies <= self.schedule.max_structures() {
            (self.progress)(&format!("preparing batches of {copies}"));
            let structures = vec![geometry; copies];
            let mut calls = Synchronous {
                server,
                setup: &setup,
                incoming: &worker.incoming,
                early: &mut early,
                fault: None,
            };
            let made = calls.round_trip(&structures, None).and_then(|_| match has_features {
                true => calls.round_trip(&structures, Some(&vec![&cotangent[..]; copies])).map(drop),
                false => Ok(()),
            });
            match made {
                Ok(()) => copies *= 2,
                Err(Fault::Memory(message)) if copies > 1 => {
                    let Shape { bonds, .. } = geometry.shape();
                    info!(message, copies, "the memory of the device takes fewer structures");
                    self.schedule.limit_bonds(bonds * copies / 2);
                    break;
                }
                Err(other) => {
                    fault = Some(other);
                    break;
                }
            }
        }
        if let Some(fault) = fault {
            self.restart(fault);
        }
        for event in early {
            // A device that was closed meanwhile learns so again from its channel.
            self.handle(event);
        }
    }

    fn note(&self, change: impl FnOnce(&mut DeviceStatistics)) {
        change(&mut self.worker.statistics.lock().unwrap_or_else(PoisonError::into_inner));
    }

    fn count(&mut self, call: &Outstanding, batch: &DeviceBatch, compiled: bool, now: Instant) {
        let tickets = batch.tickets();
        let bonds: usize = tickets.iter().map(|one| one.shape.bonds).sum();
        let seconds = now.duration_since(call.sent).as_secs_f64();
        self.note(|statistics| {
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
        self.note(|statistics| {
            statistics.busy += busy;
            statistics.elapsed = elapsed;
        });
    }
}

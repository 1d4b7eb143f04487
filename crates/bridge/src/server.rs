//! A server and its arenas: one batch after the other, with deadlines.

use std::collections::HashSet;
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use potentials::grace::Precision;
use serde_json::json;

use crate::batch::{BatchArena, BatchKind};
use crate::call::BondGeometry;
use crate::description::{AdapterFeatures, ModelDescription, PROTOCOL};
use crate::events::DeviceEvent;
use crate::faults::{ServerFault, ServerReply};
use crate::process::{ServerEvent, ServerProcess};
use crate::self_test::{Asked, Evaluate, TestResult};
use crate::settings::PythonSettings;
use crate::setup::DeviceSetup;
use crate::shapes::Shape;

/// Interval at which a synchronous call looks whether the device was asked to stop.
const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// A call that the server has not answered yet.
#[derive(Clone, Debug)]
pub(crate) struct Outstanding {
    pub id: u64,
    pub kind: BatchKind,
    pub slot: usize,
    /// When the server could begin with it: it was sent, and the call before it was answered.
    pub begun: Instant,
    /// Time for it from then on.
    pub timeout: Duration,
}

/// What a batch is sent for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum BatchRequest {
    /// Energies, and features and forces if wanted.
    Evaluate { features: bool, forces: bool },
    /// The gradient of the features, and of the energy if wanted.
    PullBack { with_energy: bool },
}

impl BatchRequest {
    /// The request for which the same program is made: that is one whether the features are read or not.
    fn program(self) -> Self {
        match self {
            Self::Evaluate { forces, .. } => Self::Evaluate { features: true, forces },
            pull_back => pull_back,
        }
    }
}

impl From<BatchKind> for BatchRequest {
    fn from(kind: BatchKind) -> Self {
        match kind {
            BatchKind::Evaluate { features, forces } => Self::Evaluate { features, forces },
            BatchKind::PullBack { energy, .. } => Self::PullBack { with_energy: energy },
        }
    }
}

impl Outstanding {
    /// When its answer is overdue.
    pub fn deadline(&self) -> Instant {
        self.begun + self.timeout
    }
}

/// A started server that has said hello.
pub(crate) struct Server {
    process: ServerProcess,
    generation: u64,
    pub description: ModelDescription,
    pub arenas: [BatchArena; 2],
    /// Shapes ([`Self::program_shape`]) that were evaluated or pulled back since the start: later calls of them are quick.
    known_shapes: HashSet<(Shape, BatchRequest)>,
    next_id: u64,
    /// Id of the last evaluation in each arena.
    evaluations: [Option<u64>; 2],
}

impl Server {
    /// Starts a server and says hello. Events of earlier servers are dropped; calls that come meanwhile go to `early`.
    ///
    /// # Errors
    /// Why there is none.
    pub fn start(
        setup: &DeviceSetup,
        generation: u64,
        early: &mut Vec<DeviceEvent>,
    ) -> Result<Self, ServerFault> {
        let settings = &setup.settings;
        let tag = move |event| DeviceEvent::Server { generation, event };
        let mut process = ServerProcess::start(settings, &setup.package, setup.events.clone(), tag)
            .map_err(ServerFault::Exited)?;
        let precision = match settings.precision {
            Precision::Double => "double",
            Precision::Mixed => "single",
        };
        let hello = json!({
            "call": "hello", "protocol": PROTOCOL, "adapter": settings.adapter, "model": settings.model, "options": settings.options,
            "device": settings.device, "precision": precision, "threads": settings.threads, "cache": settings.cache,
        });
        let sent = process.send(&hello.to_string());
        let deadline = Instant::now() + settings.compile_timeout;
        let wait = LineReader { setup, generation, early };
        let line = sent
            .map_err(|error| ServerFault::Exited(format!("{}: {error}", settings.names())))
            .and_then(|()| wait.line(deadline, "hello"));
        let description = line.and_then(|line| {
            ServerReply::read(&line, None, &settings.names())?;
            let nonsense =
                |error: String| ServerFault::Reported(format!("{}, hello: {error}", settings.names()));
            let description: ModelDescription =
                serde_json::from_str(&line).map_err(|error| nonsense(error.to_string()))?;
            description.check().map_err(nonsense)?;
            Ok(description)
        });
        match description {
            Ok(description) => {
                let dimension = match description.features.form {
                    AdapterFeatures::None => 0,
                    _ => description.features.dimension,
                };
                let arenas = [0, 1].map(|number| BatchArena::new(&setup.memory, number, dimension));
                let (known_shapes, evaluations) = (HashSet::new(), [None; 2]);
                Ok(Self { process, generation, description, arenas, known_shapes, next_id: 1, evaluations })
            }
            Err(fault) => Err(with_end(fault, process)),
        }
    }

    /// Whether an event is this server's.
    pub fn is_of(&self, generation: u64) -> bool {
        self.generation == generation
    }

    /// Its process.
    pub fn pid(&self) -> u32 {
        self.process.pid()
    }

    /// Ends it. A fault that says nothing of the process gets its last words.
    pub fn end(self, fault: ServerFault) -> ServerFault {
        with_end(fault, self.process)
    }

    /// Writes structures into a slot's arena.
    ///
    /// # Errors
    /// Shared memory that is full.
    pub fn write(&mut self, slot: usize, structures: &[&BondGeometry]) -> Result<(), ServerFault> {
        let (padding, cutoff) = (self.description.padding, self.description.cutoff());
        self.evaluations[slot] = None;
        let written = self.arenas[slot].write(structures, padding, cutoff);
        written.map_err(|error| ServerFault::Arena(format!("shared memory for a batch: {error}")))
    }

    /// Sends the batch of a slot.
    ///
    /// # Errors
    /// The server has exited.
    pub fn send(
        &mut self,
        slot: usize,
        request: BatchRequest,
        settings: &PythonSettings,
    ) -> Result<Outstanding, ServerFault> {
        let id = self.next_id;
        self.next_id += 1;
        let (kind, evaluation) = match request {
            BatchRequest::Evaluate { features, forces } => {
                (BatchKind::Evaluate { features, forces }, Some(id))
            }
            BatchRequest::PullBack { with_energy } => {
                (BatchKind::PullBack { kept: self.evaluations[slot], energy: with_energy }, None)
            }
        };
        self.evaluations[slot] = evaluation;
        let arena = &self.arenas[slot];
        let is_known = self.known_shapes.contains(&(self.program_shape(slot), request.program()));
        let timeout = if is_known { settings.timeout } else { settings.compile_timeout };
        let message = arena.message(id, kind);
        let sent = self.process.send(&message);
        sent.map_err(|error| ServerFault::Exited(format!("{}: {error}", settings.names())))?;
        Ok(Outstanding { id, kind, slot, begun: Instant::now(), timeout })
    }

    /// What decides whether a framework has a program for the batch of a slot. Without padding there is a new number of bonds in nearly
    /// every batch, and a program is not made for each: only the size of the batch counts.
    fn program_shape(&self, slot: usize) -> Shape {
        let shape = self.arenas[slot].shape();
        if self.description.padding {
            shape
        } else {
            Shape { atoms: shape.atoms.next_power_of_two(), ..Shape::default() }
        }
    }

    /// Takes in the answer to the oldest call. Returns whether the shape was new, and the time that the adapter took, s.
    ///
    /// # Errors
    /// What the server reports, or that the line is no answer.
    pub fn answer(
        &mut self,
        line: &str,
        call: &Outstanding,
        names: &str,
    ) -> Result<(bool, f64), ServerFault> {
        let reply = ServerReply::read(line, Some(call.id), names)?;
        let program = BatchRequest::from(call.kind).program();
        self.arenas[call.slot].unlink();
        let is_new = self.known_shapes.insert((self.program_shape(call.slot), program));
        Ok((reply.compiled || (is_new && self.description.padding), reply.seconds))
    }
}

/// The fault with how the process ended.
fn with_end(fault: ServerFault, process: ServerProcess) -> ServerFault {
    let ended = process.end();
    match fault {
        ServerFault::Exited(message) => ServerFault::Exited(format!("{message}; the server ended: {ended}")),
        ServerFault::Timeout(message) => ServerFault::Timeout(format!("{message}; the server: {ended}")),
        other => other,
    }
}

/// Waits for a line of a server, and keeps other events.
pub(crate) struct LineReader<'a> {
    pub setup: &'a DeviceSetup,
    pub generation: u64,
    pub early: &'a mut Vec<DeviceEvent>,
}

impl LineReader<'_> {
    /// The next line.
    ///
    /// # Errors
    /// None has come in time, the server has exited, or the device was asked to stop.
    pub fn line(self, deadline: Instant, call: &str) -> Result<String, ServerFault> {
        let names = self.setup.settings.names();
        loop {
            if self.setup.stop.is_cancelled() {
                return Err(ServerFault::Stopped);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(ServerFault::Timeout(format!("{names}, {call}: no answer in time")));
            }
            match self.setup.incoming.recv_timeout(left.min(POLL_INTERVAL)) {
                Ok(DeviceEvent::Server { generation, event }) if generation == self.generation => match event
                {
                    ServerEvent::Line(line) => return Ok(line),
                    ServerEvent::Ended => {
                        return Err(ServerFault::Exited(format!("{names}, {call}: no answer")));
                    }
                },
                Ok(DeviceEvent::Server { .. }) | Err(RecvTimeoutError::Timeout) => {}
                Ok(other) => self.early.push(other),
                Err(RecvTimeoutError::Disconnected) => return Err(ServerFault::Stopped),
            }
        }
    }
}

/// Synchronous calls, for the self-test and to warm up.
pub(crate) struct Synchronous<'a> {
    pub server: &'a mut Server,
    pub setup: &'a DeviceSetup,
    pub early: &'a mut Vec<DeviceEvent>,
    /// The last fault, as the test knows messages only.
    pub fault: Option<ServerFault>,
}

impl Synchronous<'_> {
    /// Sends a batch in the arena of a slot and waits. A pull-back from what was kept must follow the evaluation of the same structures.
    ///
    /// # Errors
    /// Faults of the server.
    pub fn round_trip(
        &mut self,
        slot: usize,
        structures: &[&BondGeometry],
        asked: Asked<'_>,
    ) -> Result<Vec<TestResult>, ServerFault> {
        let settings = &self.setup.settings;
        if !matches!(asked, Asked::Gradients { kept: true, .. }) {
            self.server.write(slot, structures)?;
        }
        let features = self.server.description.features.form != AdapterFeatures::None;
        let request = match asked {
            Asked::Forces => BatchRequest::Evaluate { features, forces: true },
            Asked::NoForces => BatchRequest::Evaluate { features, forces: false },
            Asked::Gradients { cotangents, with_energy, .. } => {
                let arena = &mut self.server.arenas[slot];
                arena.write_cotangents(cotangents.iter().map(|one| Some(*one)));
                arena.write_energy_cotangents(cotangents.iter().map(|_| with_energy));
                BatchRequest::PullBack { with_energy }
            }
        };
        let call = self.server.send(slot, request, settings)?;
        let generation = self.server.generation;
        let wait = LineReader { setup: self.setup, generation, early: self.early };
        let what = if matches!(request, BatchRequest::Evaluate { .. }) { "evaluate" } else { "pull_back" };
        let line = wait.line(call.deadline(), what)?;
        self.server.answer(&line, &call, &settings.names())?;
        let results = (0..structures.len()).map(|k| {
            let parts = self.server.arenas[slot].result(k, call.kind);
            match parts.not_finite() {
                Some(what) => Err(ServerFault::Reported(format!("{}, {what}", settings.names()))),
                None => Ok(TestResult {
                    energies: parts.energies.to_vec(),
                    vectors: parts.vectors.to_vec(),
                    virial: parts.virial.to_vec(),
                    features: parts.features.to_vec(),
                }),
            }
        });
        results.collect()
    }

    fn keep_fault<T>(&mut self, result: Result<T, ServerFault>) -> Result<T, String> {
        result.map_err(|fault| {
            let message = fault.message().to_owned();
            self.fault = Some(fault);
            message
        })
    }
}

impl Evaluate for Synchronous<'_> {
    fn ask(&mut self, structures: &[&BondGeometry], asked: Asked<'_>) -> Result<Vec<TestResult>, String> {
        let result = self.round_trip(0, structures, asked);
        self.keep_fault(result)
    }
}

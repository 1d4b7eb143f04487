//! A client of a device, of the same process or of another one.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use atoms::PotentialError;
use tokio_util::sync::CancellationToken;
use wire::ipc::{CallAddress, CallClient};

use crate::call::{self, BondGeometry, Call, Topology, Wanted};
use crate::device::Device;
use crate::error::CallError;
use crate::recipient::read_answer;

/// How a model reaches its device.
pub(crate) enum DeviceConnection {
    /// In this process. Clients are dealt evenly over the devices.
    Local(Vec<Arc<Device>>),
    /// Through shared memory.
    Shared(CallAddress, CancellationToken),
}

/// Makes one call at a time.
#[derive(Debug)]
pub(crate) enum Client {
    Local {
        device: Arc<Device>,
        number: u64,
    },
    /// The topology that the service has, if any.
    Shared {
        calls: Box<CallClient>,
        known: Option<Arc<Topology>>,
    },
}

/// Clients that potentials of a model have used, for the next ones: a walk makes a potential for each assignment, and a client costs both
/// ends memory.
pub(crate) struct ClientPool {
    connection: DeviceConnection,
    idle: Mutex<Vec<Client>>,
}

impl ClientPool {
    /// An empty pool.
    pub fn new(connection: DeviceConnection) -> Self {
        Self { connection, idle: Mutex::default() }
    }

    /// The devices of this process.
    pub fn devices(&self) -> &[Arc<Device>] {
        match &self.connection {
            DeviceConnection::Local(devices) => devices,
            DeviceConnection::Shared(..) => &[],
        }
    }

    /// An idle client, or a new one.
    ///
    /// # Errors
    /// The service of the device has exited.
    pub fn take(&self) -> Result<Client, PotentialError> {
        let idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner).pop();
        idle.map_or_else(|| Client::connect(&self.connection), Ok)
    }

    /// Keeps a client that is no longer used.
    pub fn release(&self, client: Client) {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner).push(client);
    }
}

impl Client {
    fn connect(connection: &DeviceConnection) -> Result<Self, PotentialError> {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        match connection {
            DeviceConnection::Local(devices) => {
                let number = NEXT.fetch_add(1, Ordering::Relaxed);
                let device = Arc::clone(&devices[number as usize % devices.len()]);
                Ok(Self::Local { device, number })
            }
            DeviceConnection::Shared(address, stopping) => {
                let calls = CallClient::connect(address, stopping.clone());
                let calls = calls.map_err(|error| PotentialError::Unavailable(error.to_string()))?;
                Ok(Self::Shared { calls: Box::new(calls), known: None })
            }
        }
    }

    /// As [`Device::call`] for an evaluation.
    pub fn evaluate(&mut self, geometry: BondGeometry, wanted: Wanted) -> Result<Vec<f64>, PotentialError> {
        match self {
            Self::Local { device, number } => {
                device.call(*number, Call::Evaluate { geometry, wanted }).map_err(error)
            }
            Self::Shared { calls, known } => {
                let is_new = known.as_ref().is_none_or(|known| !Arc::ptr_eq(known, &geometry.topology));
                let length = call::evaluate_words(&geometry, is_new);
                let write = |words: &mut [u64]| call::write_evaluate(&geometry, wanted, is_new, words);
                let numbers = shared(calls, length, write)?;
                *known = Some(geometry.topology);
                Ok(numbers)
            }
        }
    }

    /// As [`Device::call`] for a pull-back.
    pub fn pull_back(&mut self, cotangent: &[f64], with_energy: bool) -> Result<Vec<f64>, PotentialError> {
        match self {
            Self::Local { device, number } => {
                let cotangent = cotangent.to_vec();
                device.call(*number, Call::PullBack { cotangent, with_energy }).map_err(error)
            }
            Self::Shared { calls, .. } => {
                let write = |words: &mut [u64]| call::write_pull_back(cotangent, with_energy, words);
                shared(calls, 1 + cotangent.len(), write)
            }
        }
    }
}

fn error(error: CallError) -> PotentialError {
    match error {
        CallError::Unavailable(message) => PotentialError::Unavailable(message),
        CallError::Failed(message) => PotentialError::Failed(message),
    }
}

/// A call through shared memory.
fn shared(
    calls: &CallClient,
    length: usize,
    write: impl FnOnce(&mut [u64]),
) -> Result<Vec<f64>, PotentialError> {
    let answer = calls.call(length, write, read_answer);
    match answer.map_err(|error| PotentialError::Unavailable(error.to_string()))? {
        Some(answer) => answer.map_err(error),
        None => Err(PotentialError::Unavailable("asked to stop during a call of the device".to_owned())),
    }
}

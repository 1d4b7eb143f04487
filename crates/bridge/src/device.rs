//! A device with a model: one server for all walkers of a host.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, Sender, SyncSender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use atoms::{NeighbourList, Structure};
use potentials::ModelWithFeatures;
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;
use wire::DeviceStatistics;
use wire::ipc::IncomingCall;

use crate::call::{BondGeometry, Call, Topology};
use crate::description::ModelDescription;
use crate::model::PythonModel;
use crate::self_test::{SelfTestError, SelfTestReport};
use crate::settings::PythonSettings;
use crate::worker::{DeviceEvent, Worker};

/// Why a device cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// The server does not start, or does not answer.
    #[error("{0}")]
    Server(String),
    /// The model's derivatives are wrong.
    #[error("{names}: {source}")]
    SelfTest {
        /// Adapter and environment.
        names: String,
        /// What is wrong.
        source: SelfTestError,
    },
    /// A file or directory cannot be written.
    #[error("cannot write {path}: {source}")]
    File {
        /// Where.
        path: String,
        /// Why.
        source: std::io::Error,
    },
    /// The program was asked to stop.
    #[error("interrupted while the server of the model was started")]
    Stopped,
}

/// Why a call has no result.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CallError {
    /// The device is not there any more.
    #[error("{0}")]
    Unavailable(String),
    /// The model cannot evaluate this structure.
    #[error("{0}")]
    Failed(String),
}

/// Who gets the result of a call.
#[derive(Debug)]
pub(crate) enum Recipient {
    /// A thread of this process.
    Channel(SyncSender<Result<Vec<f64>, CallError>>),
    /// Another process.
    Shared(IncomingCall),
}

/// What a device tells of itself when it is ready.
#[derive(Clone, Debug)]
pub struct DeviceInfo {
    /// The model.
    pub description: ModelDescription,
    /// The figures of the self-test.
    pub self_test: SelfTestReport,
}

/// A running device. Dropping it ends its server.
#[derive(Debug)]
pub struct Device {
    events: Sender<DeviceEvent>,
    info: DeviceInfo,
    statistics: Arc<Mutex<DeviceStatistics>>,
    thread: Option<JoinHandle<()>>,
    stop: CancellationToken,
    /// Cancelled when the device has failed for good.
    broken: CancellationToken,
    /// Where the server's package is.
    _package: TempDir,
}

/// Writes the package to a directory of its own.
fn write_package() -> Result<TempDir, DeviceError> {
    let failed = |source| DeviceError::File { path: std::env::temp_dir().display().to_string(), source };
    let directory = tempfile::Builder::new().prefix("calmwalk-python-").tempdir().map_err(failed)?;
    crate::package::write(directory.path()).map_err(failed)?;
    Ok(directory)
}

/// Where files are in memory.
fn memory() -> PathBuf {
    let shared = Path::new("/dev/shm");
    if shared.is_dir() { shared.to_owned() } else { std::env::temp_dir() }
}

impl Device {
    /// Starts a server, and tests its model. `progress` gets what is being done.
    ///
    /// # Errors
    /// A server that does not start, or a model that fails the test.
    pub fn start(
        settings: PythonSettings,
        stop: &CancellationToken,
        progress: impl Fn(&str) + Send + 'static,
    ) -> Result<Self, DeviceError> {
        let stop = stop.child_token();
        let broken = CancellationToken::new();
        let statistics = Arc::new(Mutex::new(DeviceStatistics::default()));
        let (events, incoming) = mpsc::channel();
        let (ready, started) = mpsc::sync_channel(1);
        let package = write_package()?;
        let worker = Worker::new(
            settings,
            (package.path().to_owned(), memory()),
            (events.clone(), incoming),
            Arc::clone(&statistics),
            (stop.clone(), broken.clone()),
        );
        let thread = thread::Builder::new()
            .name("python-device".to_owned())
            .spawn(move || worker.run(&progress, &ready))
            .map_err(|error| DeviceError::Server(format!("cannot start a thread: {error}")))?;
        let info = started
            .recv()
            .unwrap_or_else(|_| Err(DeviceError::Server("the device's thread has crashed".to_owned())));
        match info {
            Ok(info) => {
                Ok(Self { events, info, statistics, thread: Some(thread), stop, broken, _package: package })
            }
            Err(error) => {
                let _ = thread.join();
                Err(error)
            }
        }
    }

    /// The model and its test.
    pub fn info(&self) -> &DeviceInfo {
        &self.info
    }

    /// What the device has done.
    pub fn statistics(&self) -> DeviceStatistics {
        self.statistics.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Cancelled when the server has failed three times in a row: no call has a result any more.
    pub fn broken(&self) -> &CancellationToken {
        &self.broken
    }

    /// Evaluates copies of a structure in batches of one, two, four, … of them: frameworks compile, and it is found how many the memory of
    /// the device takes. Of use for devices other than a processor, and for frameworks that compile.
    ///
    /// # Errors
    /// An element that the model does not support, or an invalid structure.
    pub fn warm_up(&self, model: &PythonModel, structure: &Structure, skin: f64) -> Result<(), String> {
        let species = model.element_indices(&structure.species).map_err(|error| error.to_string())?;
        let mut list = NeighbourList::new(model.description().cutoff(), skin);
        list.update(structure).map_err(|error| error.to_string())?;
        let geometry = BondGeometry::of(structure, Topology::of(&species, &list, None));
        let (done, ended) = mpsc::sync_channel(1);
        if self.events.send(DeviceEvent::WarmUp { geometry, done }).is_ok() {
            // The thread may have crashed.
            let _ = ended.recv();
        }
        Ok(())
    }

    /// A call of a client of this process. Returns when it has its result: energies `[n]`, forces `[n × 3]`, virial `[9]` and
    /// features `[n × D]` if wanted; or gradients `[n × 3]` and their virial `[9]`.
    ///
    /// # Errors
    /// A device that has failed, or a structure that the model cannot evaluate.
    pub fn call(&self, client: u64, call: Call) -> Result<Vec<f64>, CallError> {
        let (sender, receiver) = mpsc::sync_channel(1);
        self.submit(client, Ok(call), Recipient::Channel(sender));
        receiver.recv().unwrap_or_else(|_| Err(CallError::Unavailable("the device has ended".to_owned())))
    }

    pub(crate) fn submit(&self, client: u64, call: Result<Call, String>, recipient: Recipient) {
        if let Err(unsent) = self.events.send(DeviceEvent::Call { client, call, recipient })
            && let DeviceEvent::Call { recipient, .. } = unsent.0
        {
            recipient.refuse(&CallError::Unavailable("the device has ended".to_owned()));
        }
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        self.stop.cancel();
        let _ = self.events.send(DeviceEvent::Close);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// First word of an answer in shared memory.
pub(crate) mod status {
    pub const OK: u64 = 0;
    pub const UNAVAILABLE: u64 = 1;
    pub const FAILED: u64 = 2;
}

impl Recipient {
    /// Gives the recipient `length` numbers, which `write` writes.
    pub fn answer(self, length: usize, write: impl FnOnce(&mut [f64])) {
        match self {
            Self::Channel(sender) => {
                let mut numbers = vec![0.0; length];
                write(&mut numbers);
                let _ = sender.send(Ok(numbers));
            }
            Self::Shared(call) => call.answer(1 + length, |words| {
                words[0] = status::OK;
                write(bytemuck::cast_slice_mut(&mut words[1..]));
            }),
        }
    }

    /// Gives the recipient an error.
    pub fn refuse(self, error: &CallError) {
        match self {
            Self::Channel(sender) => {
                let _ = sender.send(Err(error.clone()));
            }
            Self::Shared(call) => {
                let (status, message) = match error {
                    CallError::Unavailable(message) => (status::UNAVAILABLE, message),
                    CallError::Failed(message) => (status::FAILED, message),
                };
                let bytes = message.as_bytes();
                call.answer(2 + bytes.len().div_ceil(8), |words| {
                    words.fill(0);
                    (words[0], words[1]) = (status, bytes.len() as u64);
                    bytemuck::cast_slice_mut::<u64, u8>(&mut words[2..])[..bytes.len()]
                        .copy_from_slice(bytes);
                });
            }
        }
    }
}

//! A device with a model: one server for all walkers of a host.

use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::mpsc::{self, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use atoms::{NeighbourList, Species, Structure};
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;
use wire::DeviceStatistics;

use crate::abandoned::{PACKAGE_PREFIX, hold, memory, remove_abandoned};
use crate::call::{BondGeometry, Call, Topology};
use crate::error::{CallError, DeviceError};
use crate::events::DeviceEvent;
use crate::recipient::Recipient;
use crate::settings::PythonSettings;
use crate::setup::DeviceSetup;
use crate::worker::{self, DeviceInfo};

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
    _package: PackageDir,
}

/// A directory with the server's package, which is removed on drop.
#[derive(Debug)]
pub(crate) struct PackageDir {
    directory: TempDir,
    /// Closing it releases the lock.
    _held: File,
}

impl PackageDir {
    /// Writes the package to a directory of its own in this one.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn new_in(parent: &Path) -> io::Result<Self> {
        loop {
            let directory = tempfile::Builder::new().prefix(PACKAGE_PREFIX).tempdir_in(parent)?;
            let _held = match File::open(directory.path()) {
                // Another process removed it as abandoned.
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                opened => opened?,
            };
            if hold(&_held, directory.path()) {
                crate::package::write(directory.path())?;
                return Ok(Self { directory, _held });
            }
        }
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        self.directory.path()
    }
}

impl Device {
    /// Starts a server, and tests its model. `progress` gets what is being done. With `same_bits`, a server that is started again later
    /// must give the same bits.
    ///
    /// # Errors
    /// A server that does not start, or a model that fails the test.
    pub fn start(
        settings: PythonSettings,
        same_bits: bool,
        stop: &CancellationToken,
        progress: impl Fn(&str) + Send + 'static,
    ) -> Result<Self, DeviceError> {
        let stop = stop.child_token();
        let broken = CancellationToken::new();
        let statistics = Arc::new(Mutex::new(DeviceStatistics::default()));
        let (events, incoming) = mpsc::channel();
        let (ready, started) = mpsc::sync_channel(1);
        remove_abandoned();
        let temporary = std::env::temp_dir();
        let package = PackageDir::new_in(&temporary)
            .map_err(|source| DeviceError::File { path: temporary.display().to_string(), source })?;
        let setup = DeviceSetup {
            settings,
            same_bits,
            package: package.path().to_owned(),
            memory: memory(),
            events: events.clone(),
            incoming,
            statistics: Arc::clone(&statistics),
            stop: stop.clone(),
            broken: broken.clone(),
        };
        let thread = thread::Builder::new()
            .name("python-device".to_owned())
            .spawn(move || worker::run(&setup, &progress, &ready))
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

    /// Evaluates copies of a structure in batches of one, two, four, … and `most` of them: frameworks compile, and it is found how many
    /// the memory of the device takes. Returns whether each copy has the same bits, whatever the size of the batch. Of use for devices other
    /// than a processor, for frameworks that compile, and where bits matter.
    ///
    /// # Errors
    /// An element that the model does not support, an invalid structure, or a server that fails at such a batch.
    pub fn warm_up(&self, structure: &Structure, skin: f64, most: usize) -> Result<bool, String> {
        let description = self.info.description();
        let index = |species: &Species| {
            let known = description.elements.iter().position(|symbol| symbol == species.symbol());
            known.ok_or_else(|| format!("the model does not support {species}"))
        };
        let species = structure.species.iter().map(index).collect::<Result<Vec<_>, _>>()?;
        let mut list = NeighbourList::new(description.cutoff(), skin);
        list.update(structure).map_err(|error| error.to_string())?;
        let geometry = BondGeometry::from_structure(structure, Topology::from_list(&species, &list, None));
        let (done, ended) = mpsc::sync_channel(1);
        let is_sent = self.events.send(DeviceEvent::WarmUp { geometry, most, done }).is_ok();
        let outcome = if is_sent { ended.recv().ok() } else { None };
        outcome.unwrap_or_else(|| Err("the device has ended".to_owned()))
    }

    /// A call of a client of this process. Returns when it has its result: energies `[n]`, forces `[n × 3]` and virial `[9]` if wanted, and
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

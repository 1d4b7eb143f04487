//! What a device's thread works with.

use std::path::PathBuf;
use std::sync::mpsc::{Receiver, Sender};
use std::sync::{Arc, Mutex, PoisonError};

use tokio_util::sync::CancellationToken;
use wire::DeviceStatistics;

use crate::events::DeviceEvent;
use crate::settings::PythonSettings;

/// Settings, places, and the ends of channels.
pub(crate) struct DeviceSetup {
    pub settings: PythonSettings,
    /// Whether a server that is started again must give the same bits.
    pub same_bits: bool,
    /// Where the package is.
    pub package: PathBuf,
    /// Where arenas are made.
    pub memory: PathBuf,
    /// For the threads that read what a server says.
    pub events: Sender<DeviceEvent>,
    pub incoming: Receiver<DeviceEvent>,
    pub statistics: Arc<Mutex<DeviceStatistics>>,
    /// Cancelled when the device is dropped.
    pub stop: CancellationToken,
    /// Cancelled by the thread when the device has failed for good.
    pub broken: CancellationToken,
}

impl DeviceSetup {
    /// Changes the statistics.
    pub fn note(&self, change: impl FnOnce(&mut DeviceStatistics)) {
        change(&mut self.statistics.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

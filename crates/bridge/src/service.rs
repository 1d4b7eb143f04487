//! A device for the processes of this host.

use std::collections::HashMap;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use tokio_util::sync::CancellationToken;
use tracing::warn;
use wire::ipc::{CallAddress, CallServer, IpcError};
use wire::shm_dir::ShmDir;

use crate::call::{self, Call, Topology};
use crate::device::Device;
use crate::recipient::Recipient;

/// Takes calls of other processes. Dropping it ends that, but not the device.
#[derive(Debug)]
pub struct DeviceService {
    address: CallAddress,
    stop: CancellationToken,
    thread: Option<JoinHandle<()>>,
}

impl DeviceService {
    /// Opens the service in a prepared directory of shared memory, for a number of clients with messages of usually at most `words` words.
    ///
    /// # Errors
    /// Errors of iceoryx2 and of the operating system.
    pub fn open(
        device: &Arc<Device>,
        shm_dir: &ShmDir,
        session: u64,
        clients: u32,
        words: usize,
    ) -> Result<Self, IpcError> {
        let server = CallServer::open(shm_dir, session, clients, words)?;
        let (address, stop) = (server.address().clone(), CancellationToken::new());
        let (device, stopping) = (Arc::clone(device), stop.clone());
        let thread = thread::Builder::new().name("device-calls".to_owned()).spawn(move || {
            if let Err(error) = serve(&device, server, &stopping) {
                warn!(%error, "calls of the device");
            }
        });
        let thread = thread.map_err(|error| IpcError::new("start a thread", error))?;
        Ok(Self { address, stop, thread: Some(thread) })
    }

    /// How clients find it.
    pub fn address(&self) -> &CallAddress {
        &self.address
    }
}

impl Drop for DeviceService {
    fn drop(&mut self) {
        self.stop.cancel();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn serve(device: &Device, server: CallServer, stop: &CancellationToken) -> Result<(), IpcError> {
    let mut topologies: HashMap<u64, Arc<Topology>> = HashMap::new();
    server.run(stop, |incoming| {
        let client = incoming.client();
        let call = call::read(incoming.words(), topologies.get(&client));
        if let Ok(Call::Evaluate { geometry, .. }) = &call {
            topologies.insert(client, Arc::clone(&geometry.topology));
        }
        device.submit(client, call, Recipient::Shared(incoming));
    })
}

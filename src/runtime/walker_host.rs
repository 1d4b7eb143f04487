//! What the walker processes of a host share: messages, the mixture and the calls of a device, all in shared memory. A campaign's own
//! host and an agent's have the same.

use std::sync::Arc;

use bridge::{Device, DeviceService};
use calm::Mixture;
use orchestrator::launcher::Launch;
use wire::ipc::{CallAddress, IpcServer, ServerHandle, Sizes, call_space_needed, space_needed};
use wire::mixture::SharedMixture;
use wire::shm_dir::{PreparedDir, ShmDir};
use workers::settings::WalkSettings;

use crate::exit_status::CommandError;
use crate::log;
use crate::process_config::{self, WalkerConfig, WalkerModel};

/// How much the walkers of a host share.
#[derive(Clone, Copy, Debug)]
pub struct HostSizes {
    /// Number of walkers.
    pub walkers: u32,
    /// Largest message of a walker, bytes. It has the features of all atoms, as the largest reply of a device has.
    pub message_bytes: usize,
    /// Number of devices that walkers call.
    pub devices: usize,
}

/// The mixtures that walkers grade with.
#[derive(Clone, Copy)]
pub struct HostMixtures<'a> {
    /// The newest version.
    pub newest: &'a Arc<Mixture>,
    /// The original one.
    pub original: &'a Arc<Mixture>,
}

/// The open shared memory of a host.
pub struct HostMemory {
    /// The mixtures, for its walkers.
    pub mixture: SharedMixture,
    /// Their messages.
    pub server: IpcServer,
    /// Their calls of each device.
    pub calls: Vec<DeviceService>,
    /// Keeps the directory.
    pub prepared: PreparedDir,
}

impl HostSizes {
    /// Shared memory that is needed at the start, bytes.
    ///
    /// # Errors
    /// Sizes that overflow.
    pub fn space_needed(self, mixture: &Mixture) -> Result<u64, CommandError> {
        let mixture = SharedMixture::space_needed(mixture, self.walkers).map_err(CommandError::failed)?;
        let calls = call_space_needed(self.callers(), self.call_words()) * self.devices as u64;
        Ok(mixture + space_needed(&self.messages()) + calls)
    }

    /// Walkers of a device.
    fn callers(self) -> u32 {
        self.walkers.div_ceil(self.devices.max(1) as u32)
    }

    fn messages(self) -> Sizes {
        Sizes { walkers: self.walkers, message_bytes: self.message_bytes }
    }

    fn call_words(self) -> usize {
        self.message_bytes / 8
    }
}

impl HostMemory {
    /// Prepares the directory and opens everything in it.
    ///
    /// # Errors
    /// Too little shared memory, another process that uses the directory, errors of iceoryx2.
    pub fn open(
        place: &ShmDir,
        sizes: HostSizes,
        HostMixtures { newest, original }: HostMixtures<'_>,
        session: u64,
        devices: &[Arc<Device>],
    ) -> Result<Self, CommandError> {
        let prepared = place.prepare(sizes.space_needed(newest)?).map_err(CommandError::failed)?;
        let mixture = SharedMixture::create(&place.mixture(), newest, sizes.walkers);
        let mut mixture = mixture.map_err(CommandError::failed)?;
        mixture.publish_original(original).map_err(CommandError::failed)?;
        let server = IpcServer::open(place, sizes.messages(), session).map_err(CommandError::failed)?;
        let calls = devices.iter().zip(session..).map(|(device, session)| {
            DeviceService::open(device, place, session, sizes.callers(), sizes.call_words())
        });
        let calls = calls.collect::<Result<_, _>>().map_err(CommandError::failed)?;
        Ok(Self { mixture, server, calls, prepared })
    }

    /// Where the calls of each device go.
    pub fn addresses(&self) -> Vec<CallAddress> {
        self.calls.iter().map(|calls| calls.address().clone()).collect()
    }
}

/// Returns the function that launches a walker. Walkers are dealt evenly over `devices`.
pub fn walker_launcher(
    model: WalkerModel,
    devices: Vec<CallAddress>,
    threads: usize,
    settings: WalkSettings,
    line: ServerHandle,
) -> impl FnMut(u32, u32) -> Launch + Send + 'static {
    let parent = std::process::id();
    move |number, incarnation| {
        line.expect(number, incarnation);
        let device = devices.get(number as usize % devices.len().max(1)).cloned();
        let setup = WalkerConfig {
            parent,
            connect_info: line.connect_info(number, incarnation),
            model: model.clone(),
            device,
            threads,
            settings: settings.clone(),
            log: log::child_config(),
        };
        Launch::this_program(["walker"], process_config::to_bytes(&setup)).without_database()
    }
}

//! The thread of a device: starts its server and tests the model.

use std::collections::{HashMap, VecDeque};
use std::sync::mpsc::SyncSender;
use std::time::Instant;

use tracing::info;

use crate::batch_limit::LimitFile;
use crate::description::{AdapterFeatures, ModelDescription};
use crate::error::DeviceError;
use crate::faults::ServerFault;
use crate::same_model::ModelReference;
use crate::schedule::Schedule;
use crate::self_test::{self, Asked, SelfTestReport, TestSubject};
use crate::server::{Server, Synchronous};
use crate::server_loop::{REFERENCE, ServerLoop};
use crate::setup::DeviceSetup;

/// What a device tells of itself when it is ready.
#[derive(Clone, Debug)]
pub struct DeviceInfo {
    /// The model, and what it gives for the test structure.
    pub reference: ModelReference,
    /// The figures of the self-test.
    pub self_test: SelfTestReport,
}

impl DeviceInfo {
    /// The model.
    pub fn description(&self) -> &ModelDescription {
        &self.reference.description
    }
}

/// Starts the server, tells whether that went well, and works until the device is closed.
pub(crate) fn run(
    setup: &DeviceSetup,
    progress: &dyn Fn(&str),
    ready: &SyncSender<Result<DeviceInfo, DeviceError>>,
) {
    let (begun, info) = match begin(setup, progress) {
        Ok((running, info)) => (Some(running), Ok(info)),
        Err(error) => (None, Err(error)),
    };
    let _ = ready.send(info);
    if let Some(mut running) = begun {
        running.run();
    }
}

fn begin<'a>(
    setup: &'a DeviceSetup,
    progress: &'a dyn Fn(&str),
) -> Result<(ServerLoop<'a>, DeviceInfo), DeviceError> {
    // No walker knows the device before it has started.
    let early = &mut Vec::new();
    progress(&format!("starting {}", setup.settings.names()));
    let mut server = Server::start(setup, 0, early).map_err(start_error)?;
    let description = server.description.clone();
    info!(pid = server.pid(), adapter = description.adapter, device = description.device, "python server");
    setup.note(|statistics| {
        statistics.adapter.clone_from(&description.adapter);
        statistics.device.clone_from(&description.device);
    });
    let elements = description.check().map_err(DeviceError::Server)?;
    let dimension = match description.features.form {
        AdapterFeatures::None => 0,
        AdapterFeatures::Raw | AdapterFeatures::Final => description.features.dimension,
    };
    let epsilon = if description.precision == "double" { f64::EPSILON } else { f64::from(f32::EPSILON) };
    let combined = setup.settings.combined_gradients;
    if combined && !description.evaluates_without_forces {
        return Err(DeviceError::AlwaysForces(setup.settings.names()));
    }
    let subject =
        TestSubject { elements: &elements, cutoff: description.cutoff(), dimension, combined, epsilon };
    progress("testing the derivatives of the model");
    let names = || setup.settings.names();
    let refused = |source| DeviceError::SelfTest { names: names(), source };
    let test_structure = self_test::reference(&subject).map_err(|error| refused(error.into()))?;
    let mut calls = Synchronous { server: &mut server, setup, early, fault: None };
    let tested = self_test::run(&subject, &mut calls);
    if let Some(fault) = calls.fault.take() {
        return Err(start_error(server.end(fault)));
    }
    let report = tested.map_err(refused)?;
    let found = calls.round_trip(0, &[&test_structure], Asked::Forces).map_err(start_error)?;
    let energies = found.into_iter().next().map(|one| one.energies).unwrap_or_default();
    let limit = description.max_structures.unwrap_or(u32::MAX).min(setup.settings.max_batch.get());
    let limit_file = LimitFile::new(&setup.settings, &description);
    let reference = ModelReference { description, energies };
    let mut running = ServerLoop {
        setup,
        progress,
        server: Some(server),
        generation: 0,
        test_structure,
        reference: reference.clone(),
        schedule: Schedule::new(limit as usize, reference.description.padding),
        limit_file,
        clients: HashMap::new(),
        calls: HashMap::new(),
        sent: VecDeque::new(),
        suspects: Vec::new(),
        crashes: HashMap::new(),
        failures: 0,
        refusals: 0,
        next_id: REFERENCE + 1,
        busy_since: None,
        started: Instant::now(),
        given_up: None,
    };
    running.use_kept_limit();
    Ok((running, DeviceInfo { reference, self_test: report }))
}

fn start_error(fault: ServerFault) -> DeviceError {
    match fault {
        ServerFault::Stopped => DeviceError::Stopped,
        other => DeviceError::Server(other.message().to_owned()),
    }
}

//! Potentials behind a Python program: models of PyTorch, TensorFlow and others, on any device.
//!
//! A [`Device`] runs one server process (`python -m calmwalk.server`, see `docs/python-protocol.md`) and gives it the calls of many
//! walkers in batches. A [`PythonModel`] is what the walkers see: a model like any other, whose evaluators call the device, in the same
//! process or through shared memory ([`DeviceService`]).

mod abandoned;
mod arena;
mod batch;
mod batch_limit;
mod call;
mod client;
mod description;
mod device;
mod error;
mod events;
mod faults;
mod feature_map;
mod model;
mod package;
mod process;
mod recipient;
mod recovery;
mod same_model;
mod schedule;
mod self_test;
mod server;
mod server_loop;
mod service;
mod settings;
mod setup;
mod shapes;
mod warm_up;
mod worker;

pub use abandoned::remove_abandoned;
pub use call::{BondGeometry, Topology};
pub use description::{AdapterFeatures, ModelDescription, RawFeatures};
pub use device::Device;
pub use error::{CallError, DeviceError};
pub use feature_map::RawProjection;
pub use model::{PythonModel, PythonPotential};
pub use same_model::ModelReference;
pub use self_test::{SelfTestError, SelfTestReport};
pub use service::DeviceService;
pub use settings::PythonSettings;
pub use worker::DeviceInfo;

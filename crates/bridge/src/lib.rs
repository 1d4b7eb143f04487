//! Potentials behind a Python program: models of PyTorch, TensorFlow and others, on any device.
//!
//! A [`Device`] runs one server process (`python -m calmwalk.server`, see `docs/python-protocol.md`) and gives it the calls of many
//! walkers in batches. A [`PythonModel`] is what the walkers see: a model like any other, whose evaluators call the device, in the same
//! process or through shared memory ([`DeviceService`]).

mod arena;
mod batch;
mod call;
mod description;
mod device;
mod faults;
mod feature_map;
mod model;
mod package;
mod potential;
mod process;
mod schedule;
mod self_test;
mod server;
mod service;
mod settings;
mod shapes;
mod worker;

pub use call::{BondGeometry, Topology};
pub use description::{AdapterFeatures, ModelDescription, RawFeatures};
pub use device::{CallError, Device, DeviceError, DeviceInfo};
pub use feature_map::RawProjection;
pub use model::PythonModel;
pub use potential::PythonPotential;
pub use self_test::{SelfTestError, SelfTestReport};
pub use service::DeviceService;
pub use settings::{PythonDevice, PythonSettings};

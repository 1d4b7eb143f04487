//! Molecular dynamics: velocity Verlet, Langevin (BAOAB) and Nosé–Hoover chains, counter-based random numbers,
//! volume ramps, and checkpoints from which a run resumes bit for bit. Relaxation of positions.
//!
//! ```text
//!  Checkpoint ──resume──▶ Dynamics ──step(potential)──▶ Dynamics ──checkpoint()──▶ Checkpoint
//! ```
//!
//! Units: Å, fs, u, eV, K.

mod checkpoint;
mod dynamics;
mod error;
mod fire;
mod langevin;
mod nose_hoover;
mod random;
mod state;
mod thermostat;
mod volume_ramp;
mod wrong_setting;

pub use checkpoint::Checkpoint;
pub use dynamics::{Dynamics, DynamicsSettings, default_time_step};
pub use error::DynamicsError;
pub use fire::{Fire, Relaxed};
pub use langevin::{Langevin, LangevinSettings};
pub use nose_hoover::{NoseHooverChain, NoseHooverSettings};
pub use random::{Stream, StreamId, philox};
pub use state::{State, kinetic_energy, masses, maxwell_boltzmann, momentum, temperature};
pub use thermostat::{Thermostat, ThermostatSettings};
pub use volume_ramp::{VolumeRamp, scale_volume};
pub use wrong_setting::WrongSetting;

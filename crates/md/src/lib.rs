//! Molecular dynamics: velocity Verlet, Langevin (BAOAB), Nosé–Hoover chains and stochastic velocity rescaling, the
//! Martyna–Tobias–Klein barostat, counter-based random numbers, volume ramps, and checkpoints from which a run resumes
//! bit for bit. Relaxation of positions.
//!
//! ```text
//!  Checkpoint ──resume──▶ Dynamics ──step(potential)──▶ Dynamics ──checkpoint()──▶ Checkpoint
//! ```
//!
//! Units: Å, fs, u, eV, K.

mod barostat;
mod barostat_settings;
mod bulk_modulus;
mod cell_freedom;
mod cell_motion;
mod checkpoint;
mod dynamics;
mod error;
mod fire;
mod langevin;
mod lattice_reduction;
mod nose_hoover;
mod random;
mod state;
mod strain_rate;
mod thermostat;
mod velocity_rescaling;
mod volume_ramp;
mod wrong_setting;

pub use barostat::{Barostat, CellThermostat};
pub use barostat_settings::{BAR_PER_EV_A3, BarostatSettings};
pub use bulk_modulus::bulk_modulus;
pub use cell_freedom::CellFreedom;
pub use cell_motion::CellMotion;
pub use checkpoint::Checkpoint;
pub use dynamics::{Dynamics, DynamicsSettings, default_time_step};
pub use error::DynamicsError;
pub use fire::{Fire, Relaxed};
pub use langevin::{Langevin, LangevinSettings};
pub use nose_hoover::{NoseHooverChain, NoseHooverSettings};
pub use random::{Stream, StreamId, philox};
pub use state::{
    State, kinetic_energy, kinetic_tensor, masses, maxwell_boltzmann, momentum, temperature, thermal_energy,
};
pub use thermostat::{Thermostat, ThermostatSettings};
pub use velocity_rescaling::{VelocityRescaling, VelocityRescalingSettings};
pub use volume_ramp::{VolumeRamp, extent, scale_volume};
pub use wrong_setting::WrongSetting;

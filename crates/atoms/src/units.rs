//! Physical constants in internal units: eV, Å, fs, u, K, elementary charge (CODATA 2018).

/// Boltzmann constant, eV/K.
pub const BOLTZMANN: f64 = 8.617_333_262e-5;

/// Acceleration of 1 u under 1 eV/Å, Å/fs²: force × this / mass(u) = acceleration.
pub const ACCELERATION: f64 = 9.648_533_212_331e-3;

/// e²/(4πε₀), eV Å.
pub const COULOMB: f64 = 14.399_645_478;

/// Bohr radius, Å.
pub const BOHR: f64 = 0.529_177_210_903;

/// 1 eV/Å³ in GPa.
pub const GPA_PER_EV_A3: f64 = 160.217_663_4;

//! Tests of GRACE and of classical potentials.

mod common;

mod classical;
mod grace_deep_files;
mod grace_derivatives;
mod grace_features;
mod grace_files;
mod grace_golden;
mod grace_mixed;
mod grace_training;
mod grace_variants;
mod lammps;
mod potential_files;

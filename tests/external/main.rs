//! Tests of the whole program that need other programs: servers, DFT codes, a terminal, a browser. The module docs name the
//! requirements. A test fails if a requirement is missing.
//!
//! `cargo test --test external browser::` runs the tests of one module.

#[path = "../common/mod.rs"]
mod common;

mod browser;
mod dft;
mod faults;
mod gracemaker_engine;
mod gracemaker_refit;
mod loaders;
mod pictures;
mod postgres_faults;
mod python_agents;
mod python_models;
mod selection;
mod slurm;
mod slurm_build;
mod slurm_labels;
mod watch;

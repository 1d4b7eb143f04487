//! Tests of the whole program that need other programs: servers, DFT codes, a terminal, a browser. The first lines of each module
//! name what it needs. A test fails that lacks it.
//!
//! `cargo test --test external browser::` runs those of one module.

#[path = "../common/mod.rs"]
mod common;

mod browser;
mod dft;
mod faults;
mod loaders;
mod pictures;
mod postgres_faults;
mod selection;
mod slurm;
mod slurm_build;
mod slurm_labels;
mod watch;

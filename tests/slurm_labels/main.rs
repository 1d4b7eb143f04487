//! Labels as jobs of their own on a real Slurm: `SLURM_CONF=$(.ci/slurm start) cargo test --test slurm_labels`.

#[path = "../common/mod.rs"]
mod common;

mod allocation;
mod daemon;
mod ends;
mod found_again;
mod jobs;

//! Labels made by Slurm jobs on a real Slurm: `SLURM_CONF=$(.ci/slurm start) cargo test --test external slurm_labels::`.

mod allocation;
mod daemon;
mod ends;
mod found_again;
mod full_queue;
mod jobs;
mod reference_check;

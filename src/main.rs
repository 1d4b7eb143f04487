//! calmwalk expands the training set of an interatomic potential. Walkers run molecular dynamics biased along the
//! gradient of the CALM extrapolation grade, a selector accepts the structures that are new, and labellers label
//! them.

mod all_cores;
mod artifact_checks;
mod atomic_file;
mod build_info;
mod calibration_file;
mod calm_validation;
mod campaign;
mod cli;
mod config;
mod csv;
mod csv_reader;
mod disk_forecast;
mod duration;
mod exit_status;
mod export_frame;
mod feature_variant;
mod features;
mod file_hash;
mod filter;
mod forgetting;
mod grace_projection;
mod initial_mixture;
mod label_line;
mod label_method;
mod label_setup;
mod labelled_frames;
mod left_out;
mod loaded_model;
mod log;
mod mixture_build;
mod mixture_files;
mod nearest_name;
mod notify;
mod output;
mod page;
mod process_config;
mod progress;
mod python_model;
mod refit;
mod reliability_filter;
mod replay;
mod report;
mod rerun;
mod runtime;
mod selection;
mod signals;
mod structure_files;
mod summary;
mod trajectory;
mod unlabelled_updates;
mod upfit_run;
mod versions;
mod web;
mod wording;
mod xyz_reader;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    match cli::run(arguments) {
        Ok(ended) => ended.exit_code(),
        Err(failure) => {
            tracing::error!("{failure}");
            output::print_stderr(format_args!("calmwalk: {failure}"));
            failure.exit_code()
        }
    }
}

//! calmwalk expands the training set of an interatomic potential: walkers run molecular dynamics biased along the
//! gradient of the CALM extrapolation grade, a selector decides what is new, and what is new is labelled.

mod actors;
mod bill;
mod budget;
mod campaign;
mod cli;
mod condition;
mod config;
mod duration;
mod ends;
mod energies;
mod forecast;
mod forgetting;
mod frames;
mod interrupt;
mod labelling;
mod learned;
mod log;
mod mixture;
mod notify;
mod origin;
mod outcome;
mod output;
mod progress;
mod replay;
mod report;
mod setup;
mod story;
mod summary;
mod unlabelled;
mod web;
mod whole_file;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    match cli::run(arguments) {
        Ok(ended) => ended.exit_code(),
        Err(failure) => {
            tracing::error!("{failure}");
            output::show(format_args!("calmwalk: {failure}"));
            failure.exit_code()
        }
    }
}

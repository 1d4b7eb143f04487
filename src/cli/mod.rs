//! The command line: one file a command.

mod calm;
mod export;
mod import;
mod init;
mod md;
mod queue;
mod run;
mod status;
mod validate;

use std::future::Future;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::config::ConfigError;

/// Expands the training set of an interatomic potential by molecular dynamics biased towards what it does not know.
///
/// Exit codes: 0 done, 1 failed, 2 wrong input or configuration, 130 interrupted.
#[derive(Debug, Parser)]
#[command(name = "calmwalk", version, max_term_width = 100)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

// The commands' own documentation is their help.
#[derive(Debug, Subcommand)]
enum Command {
    Init(init::Init),
    Validate(validate::Validate),
    Run(run::Run),
    Status(status::Status),
    Queue(queue::Queue),
    Export(export::Export),
    #[command(subcommand)]
    Calm(calm::Calm),
    Import(import::Import),
    Md(md::Md),
}

/// How a command ended that did not fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// All done.
    Done,
    /// Stopped by Ctrl-C or SIGTERM, in order.
    Interrupted,
}

/// Why a command failed.
#[derive(Debug)]
pub enum Failure {
    /// Wrong input or configuration: exit code 2.
    Input(String),
    /// Anything else: exit code 1.
    Failed(String),
}

impl Ended {
    /// 0 or 130.
    pub fn exit_code(self) -> ExitCode {
        ExitCode::from(match self {
            Self::Done => 0,
            Self::Interrupted => 130,
        })
    }
}

impl Failure {
    /// Wrong input.
    pub fn input(error: impl ToString) -> Self {
        Self::Input(error.to_string())
    }

    /// Any other failure.
    pub fn failed(error: impl ToString) -> Self {
        Self::Failed(error.to_string())
    }

    /// 2 or 1.
    pub fn exit_code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Input(_) => 2,
            Self::Failed(_) => 1,
        })
    }
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (Self::Input(message) | Self::Failed(message)) = self;
        f.write_str(message)
    }
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        Self::input(error)
    }
}

impl From<store::StoreError> for Failure {
    fn from(error: store::StoreError) -> Self {
        use store::StoreError as E;
        match error {
            E::Database(_) | E::DiskFull | E::Busy | E::Damaged { .. } | E::Inconsistent(_) => Self::failed(error),
            _ => Self::input(error),
        }
    }
}

/// Carries out a command.
pub fn run(arguments: Arguments) -> Result<Ended, Failure> {
    match arguments.command {
        Command::Init(command) => command.run(),
        Command::Validate(command) => command.run(),
        Command::Run(command) => command.run(),
        Command::Status(command) => command.run(),
        Command::Queue(command) => command.run(),
        Command::Export(command) => command.run(),
        Command::Calm(command) => command.run(),
        Command::Import(command) => command.run(),
        Command::Md(command) => command.run(),
    }
}

/// The directory of a campaign, as an argument.
#[derive(Debug, clap::Args)]
struct CampaignDirectory {
    /// Directory of the campaign
    #[arg(value_name = "DIR")]
    directory: PathBuf,
}

/// Runs what waits on the database.
fn block_on<T>(future: impl Future<Output = T>) -> Result<T, Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(Failure::failed)?;
    Ok(runtime.block_on(future))
}

//! The command line: one file a command.

mod agent;
mod calm;
mod clean;
mod dashboard;
pub mod errors;
mod exclude;
mod explain;
mod export;
mod import;
mod init;
mod keep;
mod label;
mod labeller;
mod launch;
mod md;
mod place;
mod plan;
mod queue;
mod relabel;
mod replay;
mod report;
mod run;
pub mod status;
mod store;
mod validate;
mod walker;
mod walks;
mod watch;

use std::future::Future;
use std::path::PathBuf;

use ::store::Location;
use clap::{Parser, Subcommand};

use crate::exit_status::{ExitStatus, Failure};

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
    Plan(plan::Plan),
    Run(run::Run),
    Agent(agent::Agent),
    Label(label::Label),
    Launch(launch::Launch),
    Status(status::Status),
    Dashboard(dashboard::Dashboard),
    Watch(watch::Watch),
    Errors(errors::Errors),
    Queue(queue::Queue),
    Relabel(relabel::Relabel),
    Exclude(exclude::Exclude),
    Walks(walks::Walks),
    Explain(explain::Explain),
    Export(export::Export),
    Report(report::Report),
    Replay(replay::Replay),
    #[command(subcommand)]
    Calm(calm::Calm),
    Import(import::Import),
    Store(store::StoreCommand),
    Md(md::Md),
    Clean(clean::Clean),
    #[command(hide = true)]
    Walker(walker::Walker),
    #[command(hide = true)]
    Labeller(labeller::Labeller),
    #[command(hide = true)]
    Keep(keep::Keep),
}

/// Carries out a command.
pub fn run(arguments: Arguments) -> Result<ExitStatus, Failure> {
    match arguments.command {
        Command::Init(command) => command.run(),
        Command::Validate(command) => command.run(),
        Command::Plan(command) => command.run(),
        Command::Run(command) => command.run(),
        Command::Agent(command) => command.run(),
        Command::Label(command) => command.run(),
        Command::Launch(command) => command.run(),
        Command::Status(command) => command.run(),
        Command::Dashboard(command) => command.run(),
        Command::Watch(command) => command.run(),
        Command::Errors(command) => command.run(),
        Command::Queue(command) => command.run(),
        Command::Relabel(command) => command.run(),
        Command::Exclude(command) => command.run(),
        Command::Walks(command) => command.run(),
        Command::Explain(command) => command.run(),
        Command::Export(command) => command.run(),
        Command::Report(command) => command.run(),
        Command::Replay(command) => command.run(),
        Command::Calm(command) => command.run(),
        Command::Import(command) => command.run(),
        Command::Store(command) => command.run(),
        Command::Md(command) => command.run(),
        Command::Clean(command) => command.run(),
        Command::Walker(command) => command.run(),
        Command::Labeller(command) => command.run(),
        Command::Keep(command) => command.run(),
    }
}

/// Where a campaign is kept, as an argument.
#[derive(Debug, clap::Args)]
struct CampaignLocation {
    /// Directory of the campaign or of its configuration, or the postgres:// URL of its store
    #[arg(value_name = "DIR")]
    location: PathBuf,
}

impl CampaignLocation {
    /// Not a type of the argument: what is shown of a wrong argument would show its password.
    fn get(&self) -> Result<Location, Failure> {
        place::location(&self.location)
    }
}

/// Runs what waits on the database.
fn block_on<T>(future: impl Future<Output = T>) -> Result<T, Failure> {
    let runtime =
        tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(Failure::failed)?;
    let done = runtime.block_on(future);
    // A label that was given back goes on in its thread; nobody waits for it.
    runtime.shutdown_background();
    Ok(done)
}

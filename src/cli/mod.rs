//! The command line: one module per command, with its arguments, what it does and what it prints.

mod agent;
mod calculation_runner;
mod calm;
mod campaign_location;
mod clean;
mod dashboard;
mod estimate;
mod exclude;
mod explain;
mod export;
pub mod force_errors;
mod import;
mod init;
mod label;
mod label_file;
mod labeller;
mod launch;
mod lower_states;
mod md;
mod queue;
mod relabel;
mod replay;
mod report;
mod run;
mod schema;
mod select;
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

use crate::duration::Duration;
use crate::exit_status::{ExitStatus, Failure};

/// Grow the training set of an interatomic potential by molecular dynamics biased towards structures it does not know.
///
/// Exit codes: 0 success, 1 failure, 2 invalid input or configuration, 130 interrupted.
#[derive(Debug, Parser)]
#[command(name = "calmwalk", version, max_term_width = 100)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

// The help text of a command is the documentation of its type.
#[derive(Debug, Subcommand)]
enum Command {
    Init(init::Init),
    Validate(validate::Validate),
    Schema(schema::Schema),
    Estimate(estimate::Estimate),
    Run(run::Run),
    Agent(agent::Agent),
    Label(label::Label),
    LabelFile(label_file::LabelFile),
    Launch(launch::Launch),
    Status(status::Status),
    Dashboard(dashboard::Dashboard),
    Watch(watch::Watch),
    ForceErrors(force_errors::ForceErrors),
    Queue(queue::Queue),
    Relabel(relabel::Relabel),
    Exclude(exclude::Exclude),
    LowerStates(lower_states::LowerStates),
    Walks(walks::Walks),
    Explain(explain::Explain),
    Export(export::Export),
    Report(report::Report),
    Replay(replay::Replay),
    #[command(subcommand)]
    Calm(calm::Calm),
    Select(select::Select),
    Import(import::Import),
    Store(store::StoreCommand),
    Md(md::Md),
    Clean(clean::Clean),
    #[command(hide = true)]
    Walker(walker::Walker),
    #[command(hide = true)]
    Labeller(labeller::Labeller),
    #[command(hide = true)]
    CalculationRunner(calculation_runner::CalculationRunner),
}

/// Runs the command.
pub fn run(arguments: Arguments) -> Result<ExitStatus, Failure> {
    match arguments.command {
        Command::Init(command) => command.run(),
        Command::Validate(command) => command.run(),
        Command::Schema(command) => command.run(),
        Command::Estimate(command) => command.run(),
        Command::Run(command) => command.run(),
        Command::Agent(command) => command.run(),
        Command::Label(command) => command.run(),
        Command::LabelFile(command) => command.run(),
        Command::Launch(command) => command.run(),
        Command::Status(command) => command.run(),
        Command::Dashboard(command) => command.run(),
        Command::Watch(command) => command.run(),
        Command::ForceErrors(command) => command.run(),
        Command::Queue(command) => command.run(),
        Command::Relabel(command) => command.run(),
        Command::Exclude(command) => command.run(),
        Command::LowerStates(command) => command.run(),
        Command::Walks(command) => command.run(),
        Command::Explain(command) => command.run(),
        Command::Export(command) => command.run(),
        Command::Report(command) => command.run(),
        Command::Replay(command) => command.run(),
        Command::Calm(command) => command.run(),
        Command::Select(command) => command.run(),
        Command::Import(command) => command.run(),
        Command::Store(command) => command.run(),
        Command::Md(command) => command.run(),
        Command::Clean(command) => command.run(),
        Command::Walker(command) => command.run(),
        Command::Labeller(command) => command.run(),
        Command::CalculationRunner(command) => command.run(),
    }
}

/// The argument that names a campaign.
#[derive(Debug, clap::Args)]
struct CampaignLocation {
    /// Campaign: its directory, the directory of its configuration, or the postgres:// URL of its store
    #[arg(value_name = "DIR")]
    location: PathBuf,
}

impl CampaignLocation {
    /// The location is parsed here and not by clap, whose error message would print the password of a URL.
    fn get(&self) -> Result<Location, Failure> {
        campaign_location::parse(&self.location)
    }
}

/// Parser of an argument that is a wall-clock time between `min` and `max`, limits included.
fn duration_between(
    min: &'static str,
    max: &'static str,
) -> impl Fn(&str) -> Result<Duration, String> + Clone {
    let parse_limit = |text: &str| text.parse::<Duration>().expect("a time with its unit");
    let limits = parse_limit(min)..=parse_limit(max);
    move |text| {
        let duration = text.parse()?;
        limits.contains(&duration).then_some(duration).ok_or_else(|| format!("expected {min} to {max}"))
    }
}

/// Runs a future that uses the database to its end.
fn block_on<T>(future: impl Future<Output = T>) -> Result<T, Failure> {
    let runtime =
        tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(Failure::failed)?;
    let output = runtime.block_on(future);
    // A thread may still compute a label that was already returned to the queue: do not wait for it.
    runtime.shutdown_background();
    Ok(output)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_definition_of_the_command_line_is_consistent() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn durations_are_checked_against_their_limits() {
        let parse = duration_between("200ms", "1h");
        assert_eq!(
            (parse("2s"), parse("1h")),
            (Ok(Duration::from_seconds(2)), Ok(Duration::from_seconds(3600)))
        );
        assert_eq!(parse("100ms").unwrap_err(), "expected 200ms to 1h");
        assert!(parse("2").unwrap_err().contains("such as"));
    }
}

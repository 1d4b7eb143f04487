//! The command line: one module per command, with its arguments, what it does and what it prints.

mod agent;
mod calculation_runner;
mod calibration;
mod calm;
mod campaign_location;
mod clean;
mod completions;
mod dashboard;
mod doctor;
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
mod refit;
mod refitter;
mod relabel;
mod replay;
mod report;
mod rerun;
mod run;
mod schema;
mod seed_structure_table;
mod select;
pub mod status;
mod store;
mod upfit;
mod validate;
mod versions;
mod walker;
mod walks;
mod watch;

use std::future::Future;
use std::path::PathBuf;

use ::store::Location;
use clap::{Parser, Subcommand};

use crate::build_info;
use crate::duration::Duration;
use crate::exit_status::{CommandError, ExitStatus};

/// Grow the training set of an interatomic potential by molecular dynamics biased towards structures it does not know.
///
/// Exit codes: 0 success, 1 failure, 2 invalid input or configuration, 130 interrupted.
#[derive(Debug, Parser)]
#[command(name = "calmwalk", version, long_version = build_info::long_version(), max_term_width = 100)]
pub struct Arguments {
    /// Print results, warnings and errors only, no progress
    #[arg(long, global = true)]
    quiet: bool,
    #[command(subcommand)]
    command: CliCommand,
}

// The help text of a command is the documentation of its type.
#[derive(Debug, Subcommand)]
enum CliCommand {
    Init(init::InitArgs),
    Validate(validate::ValidateArgs),
    Schema(schema::SchemaArgs),
    Estimate(estimate::EstimateArgs),
    Run(run::RunArgs),
    Agent(agent::AgentArgs),
    Label(label::LabelArgs),
    LabelFile(label_file::LabelFileArgs),
    Launch(launch::LaunchArgs),
    Status(status::StatusArgs),
    Dashboard(dashboard::DashboardArgs),
    Watch(watch::WatchArgs),
    ForceErrors(force_errors::ForceErrorsArgs),
    Queue(queue::QueueArgs),
    Relabel(relabel::RelabelArgs),
    Exclude(exclude::ExcludeArgs),
    LowerStates(lower_states::LowerStatesArgs),
    Walks(walks::WalksArgs),
    Explain(explain::ExplainArgs),
    Export(export::ExportArgs),
    Report(report::ReportArgs),
    Replay(replay::ReplayArgs),
    Rerun(rerun::RerunArgs),
    Versions(versions::VersionsArgs),
    Refit(refit::RefitArgs),
    #[command(subcommand)]
    Calm(calm::CalmCommand),
    Select(select::SelectArgs),
    Upfit(upfit::UpfitArgs),
    Import(import::ImportArgs),
    Store(store::StoreArgs),
    Md(md::MdArgs),
    Doctor(doctor::DoctorArgs),
    Clean(clean::CleanArgs),
    Completions(completions::CompletionsArgs),
    Man(completions::ManArgs),
    #[command(hide = true)]
    Walker(walker::WalkerArgs),
    #[command(hide = true)]
    Labeller(labeller::LabellerArgs),
    #[command(hide = true)]
    Refitter(refitter::RefitterArgs),
    #[command(hide = true)]
    CalculationRunner(calculation_runner::CalculationRunnerArgs),
}

/// Runs the command.
pub fn run(arguments: Arguments) -> Result<ExitStatus, CommandError> {
    if arguments.quiet {
        crate::output::set_quiet();
    }
    match arguments.command {
        CliCommand::Init(command) => command.run(),
        CliCommand::Validate(command) => command.run(),
        CliCommand::Schema(command) => command.run(),
        CliCommand::Estimate(command) => command.run(),
        CliCommand::Run(command) => command.run(),
        CliCommand::Agent(command) => command.run(),
        CliCommand::Label(command) => command.run(),
        CliCommand::LabelFile(command) => command.run(),
        CliCommand::Launch(command) => command.run(),
        CliCommand::Status(command) => command.run(),
        CliCommand::Dashboard(command) => command.run(),
        CliCommand::Watch(command) => command.run(),
        CliCommand::ForceErrors(command) => command.run(),
        CliCommand::Queue(command) => command.run(),
        CliCommand::Relabel(command) => command.run(),
        CliCommand::Exclude(command) => command.run(),
        CliCommand::LowerStates(command) => command.run(),
        CliCommand::Walks(command) => command.run(),
        CliCommand::Explain(command) => command.run(),
        CliCommand::Export(command) => command.run(),
        CliCommand::Report(command) => command.run(),
        CliCommand::Replay(command) => command.run(),
        CliCommand::Rerun(command) => command.run(),
        CliCommand::Versions(command) => command.run(),
        CliCommand::Refit(command) => command.run(),
        CliCommand::Calm(command) => command.run(),
        CliCommand::Select(command) => command.run(),
        CliCommand::Upfit(command) => command.run(),
        CliCommand::Import(command) => command.run(),
        CliCommand::Store(command) => command.run(),
        CliCommand::Md(command) => command.run(),
        CliCommand::Doctor(command) => command.run(),
        CliCommand::Clean(command) => command.run(),
        CliCommand::Completions(command) => command.run(),
        CliCommand::Man(command) => command.run(),
        CliCommand::Walker(command) => command.run(),
        CliCommand::Labeller(command) => command.run(),
        CliCommand::Refitter(command) => command.run(),
        CliCommand::CalculationRunner(command) => command.run(),
    }
}

/// The argument that names a campaign.
#[derive(Debug, clap::Args)]
struct CampaignArgs {
    /// Campaign: its directory, the directory of its configuration, or the postgres:// URL of its store
    #[arg(value_name = "DIR")]
    location: PathBuf,
}

impl CampaignArgs {
    /// The location is parsed here and not by clap, whose error message would print the password of a URL.
    fn get(&self) -> Result<Location, CommandError> {
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
fn block_on<T>(future: impl Future<Output = T>) -> Result<T, CommandError> {
    let runtime =
        tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(CommandError::failed)?;
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

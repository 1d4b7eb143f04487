//! `calmwalk calm`: commands for CALM mixtures, without a campaign.

mod baseline;
mod build;
mod campaign_updates;
mod compare;
mod export;
mod filter;
mod info;
mod merge;
mod other_scores;
mod recalibrate;
mod sample;
mod score;
mod score_calibration;
mod score_labels;
mod score_list;
mod score_table;
mod scorer;
mod validate;
mod validate_labels;

pub(super) use self::score::load;
use super::{CommandError, ExitStatus};

/// Build, recalibrate, compare, export, inspect and test CALM mixtures and baselines; sample data, grade structures, and judge grades by
/// errors
#[derive(Debug, clap::Subcommand)]
pub enum CalmCommand {
    Baseline(baseline::CalmBaselineArgs),
    Build(build::CalmBuildArgs),
    Compare(compare::CalmCompareArgs),
    Export(export::CalmExportArgs),
    Filter(filter::CalmFilterArgs),
    Info(info::CalmInfoArgs),
    Merge(merge::CalmMergeArgs),
    Recalibrate(recalibrate::CalmRecalibrateArgs),
    Sample(sample::CalmSampleArgs),
    Score(score::CalmScoreArgs),
    Validate(validate::CalmValidateArgs),
}

impl CalmCommand {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        match self {
            Self::Baseline(command) => command.run(),
            Self::Build(command) => command.run(),
            Self::Compare(command) => command.run(),
            Self::Export(command) => command.run(),
            Self::Filter(command) => command.run(),
            Self::Info(command) => command.run(),
            Self::Merge(command) => command.run(),
            Self::Recalibrate(command) => command.run(),
            Self::Sample(command) => command.run(),
            Self::Score(command) => command.run(),
            Self::Validate(command) => command.run(),
        }
    }
}

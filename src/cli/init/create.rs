//! Writes the configuration of a user's own campaign.

use std::io::{self, BufReader, IsTerminal};
use std::path::Path;

use super::own_campaign::{OwnCampaign, OwnCampaignArgs};
use super::questions::TerminalQuestions;
use super::suggestion::SuggestedSettings;
use super::text::configuration;
use super::{CONFIG, SCHEMA, refuse_existing, write_all};
use crate::campaign::CampaignDraft;
use crate::config::FILL_IN;
use crate::exit_status::{CommandError, ExitStatus};
use crate::output::{count, log_and_warn, print};

/// Writes the configuration and the schema, and prints what to do next.
pub fn create(directory: &Path, options: OwnCampaignArgs) -> Result<ExitStatus, CommandError> {
    let [config, schema] = [CONFIG, SCHEMA].map(|name| directory.join(name));
    refuse_existing([config.as_path(), schema.as_path()].into_iter())?;
    let campaign = complete(options)?;
    campaign.check()?;
    let read = |settings: &SuggestedSettings| {
        let text = configuration(directory, &campaign, settings)?;
        let draft = CampaignDraft::read(&config, &text).map_err(|error| {
            CommandError::Input(format!(
                "nothing is written, since calmwalk validate would refuse it: {error}"
            ))
        })?;
        Ok::<_, CommandError>((text, draft))
    };
    let (_, draft) = read(&SuggestedSettings::first_guess())?;
    let suggested = SuggestedSettings::from_draft(&draft, campaign.artifact.is_some());
    let (text, draft) = read(&suggested)?;
    draft.warnings.iter().for_each(log_and_warn);
    write_all(directory, [(CONFIG, text.as_bytes())])?;
    let (unfilled, config) = (text.matches(&format!("\"{FILL_IN}")).count(), config.display());
    print(|out| {
        writeln!(
            out,
            "created {config} for {}; next:",
            count(draft.seed_structures.len(), "seed structure")
        )?;
        if unfilled > 0 {
            writeln!(out, "  complete {} that begin with {}", count(unfilled, "value"), FILL_IN.trim())?;
        }
        writeln!(out, "  calmwalk validate {config}")?;
        writeln!(out, "  calmwalk estimate {config}")?;
        writeln!(out, "  calmwalk run {config}")
    })?;
    Ok(ExitStatus::Done)
}

/// The campaign of these options. Asks for what is missing, if there is a terminal.
fn complete(options: OwnCampaignArgs) -> Result<OwnCampaign, CommandError> {
    let missing = options.missing();
    let is_terminal = io::stdin().is_terminal() && io::stderr().is_terminal();
    if !missing.is_empty() && !is_terminal {
        return Err(CommandError::Input(format!(
            "{} missing: expected --model, --structures and --label, and with --label potential also --label-source (on \
             a terminal, calmwalk asks for them)",
            missing.join(", ")
        )));
    }
    TerminalQuestions { reader: BufReader::new(io::stdin()), writer: io::stderr() }.complete(options)
}

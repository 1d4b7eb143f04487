//! `calmwalk schema`

use super::{CommandError, ExitStatus};
use crate::config::schema_text;
use crate::output::print;

/// Print the JSON schema of the configuration of a campaign
///
/// With the schema, an editor completes and checks campaign files. docs/configuration.md describes how.
#[derive(Debug, clap::Args)]
pub struct SchemaArgs {}

impl SchemaArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        print(|out| out.write_all(schema_text().as_bytes()))?;
        Ok(ExitStatus::Done)
    }
}

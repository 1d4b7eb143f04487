//! `calmwalk doctor`

mod check;
mod directory;
mod machine;
mod program;
mod programs;
mod python;
mod requirements;

use std::path::PathBuf;

use serde_json::json;

use self::check::{MachineCheck, write_table};
use self::requirements::Requirements;
use super::{CommandError, ExitStatus, campaign_location};
use crate::output::{count, print, print_json};
use crate::{build_info, runtime};

/// Check what this machine has for campaigns, and what is missing for which feature
///
/// Checks shared memory, limits, the file system of the campaign, processor, Python environment, device, DFT codes and batch systems.
/// Changes nothing, and runs other programs only to ask for their versions. With CONFIG, the exit code is 1 if this campaign needs
/// something that is missing; without, it is 0.
#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Also check what the campaign with this configuration (TOML) needs
    #[arg(value_name = "CONFIG")]
    config: Option<PathBuf>,
    /// Directory of the campaign [default: path of the configuration without its extension, or the current directory]
    #[arg(long, value_name = "DIR")]
    directory: Option<PathBuf>,
    /// Python environment to check: a virtual environment, a conda prefix, or an interpreter [default: that of the configuration,
    /// or python3 on the path]
    #[arg(long, value_name = "ENV")]
    python: Option<PathBuf>,
    /// Print the checks as JSON
    #[arg(long)]
    json: bool,
}

impl DoctorArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let needs = self.config.as_deref().map(Requirements::read).transpose()?;
        let checks = self.checks(needs.as_ref())?;
        if self.json {
            let version = json!({ "version": env!("CARGO_PKG_VERSION"), "commit": build_info::COMMIT });
            let missing = checks.iter().filter(|check| check.is_missing()).count();
            print_json(&json!({ "calmwalk": version, "checks": checks, "missing": missing }))?;
        } else {
            print(|out| write_table(out, &checks))?;
        }
        let missing: Vec<_> =
            checks.iter().filter(|check| check.is_missing()).map(|check| check.name()).collect();
        match (&self.config, missing.as_slice()) {
            (Some(config), [_, ..]) => Err(CommandError::Failed(format!(
                "{} needs {} that this machine does not have: {}",
                config.display(),
                count(missing.len() as u64, "thing"),
                missing.join(", ")
            ))),
            _ => Ok(ExitStatus::Done),
        }
    }

    /// All checks, in the order of the table.
    fn checks(&self, needs: Option<&Requirements>) -> Result<Vec<MachineCheck>, CommandError> {
        let mut checks = vec![machine::processor()];
        let walkers = u64::from(needs.map_or_else(runtime::cores, Requirements::walkers));
        checks.push(machine::shared_memory(needs.and_then(Requirements::shared_memory)));
        checks.push(machine::open_files(walkers));
        checks.push(machine::processes(walkers));
        match needs.and_then(|needs| needs.config.run.store.as_deref()) {
            Some(url) => checks.push(directory::server(url)?),
            None => checks
                .extend(directory::checks(&self.campaign_directory(), needs.and_then(Requirements::disk))),
        }
        let named = self.python.as_deref().map(|environment| (&[][..], environment));
        checks.extend(python::checks(named.or_else(|| needs.and_then(Requirements::python))));
        checks.push(programs::device());
        checks.extend(programs::codes());
        let slurm = needs.is_some_and(Requirements::slurm);
        checks.extend(
            programs::schedulers()
                .into_iter()
                .map(|(name, check)| check.required_if(slurm && name == "sbatch")),
        );
        checks.extend(needs.map(Requirements::checks).unwrap_or_default());
        Ok(checks)
    }

    fn campaign_directory(&self) -> PathBuf {
        let default = || self.config.as_deref().map(campaign_location::default_directory);
        self.directory.clone().or_else(default).unwrap_or_else(|| PathBuf::from("."))
    }
}

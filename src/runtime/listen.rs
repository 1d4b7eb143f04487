//! The endpoint where agents of other hosts reach a run.

use std::fs;
use std::io::{ErrorKind, Write};
use std::net::IpAddr;
use std::path::{Path, PathBuf};

use wire::net::{Announcement, CertificateFault, Endpoint, Tls};

use crate::atomic_file::{AtomicFile, cannot_write};
use crate::exit_status::{CommandError, ExitStatus};
use crate::output::log_and_warn;

/// Where agents of other hosts may join.
#[derive(Clone, Debug)]
pub struct Listen {
    /// The address.
    pub endpoint: Endpoint,
    /// Certificates. Required unless the address is loopback.
    pub tls: Option<Tls>,
    /// File to announce the endpoint in.
    pub announce: Option<PathBuf>,
    /// Name by which other hosts reach this one.
    pub host: String,
}

impl Listen {
    /// Checks the certificates before any work begins and warns about those that will soon be invalid.
    ///
    /// # Errors
    /// Fails if no agent could join with these certificates.
    pub fn check(&self) -> Result<(), CommandError> {
        let Some(tls) = &self.tls else { return Ok(()) };
        let checked = tls.check_for_orchestrator().map_err(CommandError::input)?;
        checked.warnings.iter().for_each(|warning| log_and_warn(format_args!("WARNING: {warning}")));
        let endpoint = self.endpoint.with_host_name(&self.host).map_err(CommandError::input)?;
        let host = endpoint.plain_host();
        if checked.is_valid_for(host) {
            return Ok(());
        }
        let names = checked.names.join(", ");
        if self.announce.is_some() {
            let fault = CertificateFault::OtherNames { names, host: host.to_owned() };
            return Err(CommandError::input(fault.at(&tls.certificate)));
        }
        // The name that agents use is unknown here, but it is hardly that of another host.
        if host.parse::<IpAddr>().is_err() {
            log_and_warn(format_args!(
                "WARNING: agents cannot connect to {host}: the certificate is for {names}"
            ));
        }
        Ok(())
    }

    /// Announces the endpoint in the file.
    pub fn announce(&self, endpoint: &Endpoint) -> Result<(), CommandError> {
        let Some(path) = &self.announce else { return Ok(()) };
        let endpoint = endpoint.with_host_name(&self.host).map_err(CommandError::input)?;
        write_announcement(path, &Announcement::Endpoint(endpoint))
    }

    /// Removes the announcement of an earlier run.
    pub fn clear_announcement(&self) -> Result<(), CommandError> {
        self.announce.as_deref().map_or(Ok(()), remove)
    }

    /// Announces that there is no more work, or removes the announcement if the run was interrupted.
    pub fn announce_end(&self, ended: ExitStatus) -> Result<(), CommandError> {
        match (self.announce.as_deref(), ended) {
            (None, _) => Ok(()),
            (Some(path), ExitStatus::Done | ExitStatus::NoWalkCompleted) => {
                write_announcement(path, &Announcement::Over)
            }
            (Some(path), ExitStatus::Interrupted) => remove(path),
        }
    }
}

fn remove(path: &Path) -> Result<(), CommandError> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(cannot_write(path, error)),
        _ => Ok(()),
    }
}

fn write_announcement(path: &Path, announcement: &Announcement) -> Result<(), CommandError> {
    let mut file = AtomicFile::create(path)?;
    write!(file, "{announcement}").map_err(|error| cannot_write(path, error))?;
    file.finish()
}

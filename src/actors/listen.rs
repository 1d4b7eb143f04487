//! Where agents of other hosts find a run.

use std::fs;
use std::io::{ErrorKind, Write};
use std::net::IpAddr;
use std::path::{Path, PathBuf};

use wire::net::{Announcement, CertificateFault, Endpoint, Tls};

use crate::outcome::{Ended, Failure};
use crate::output::warn;
use crate::whole_file::{WholeFile, cannot_write};

/// Where agents of other hosts may join.
#[derive(Clone, Debug)]
pub struct Listen {
    /// The address.
    pub endpoint: Endpoint,
    /// Needed for everything but loopback.
    pub tls: Option<Tls>,
    /// The file in which agents find it.
    pub announce: Option<PathBuf>,
    /// By which name others reach this host.
    pub host: String,
}

impl Listen {
    /// Checks the certificates before any work begins, and says what will be wrong with them before long.
    ///
    /// # Errors
    /// With these certificates no agent could join.
    pub fn check(&self) -> Result<(), Failure> {
        let Some(tls) = &self.tls else { return Ok(()) };
        let checked = tls.check_for_orchestrator().map_err(Failure::input)?;
        checked.warnings.iter().for_each(|warning| warn(format_args!("WARNING: {warning}")));
        let endpoint = self.endpoint.with_host_name(&self.host).map_err(Failure::input)?;
        let host = endpoint.plain_host();
        if checked.is_valid_for(host) {
            return Ok(());
        }
        let names = checked.names.join(", ");
        if self.announce.is_some() {
            let fault = CertificateFault::OtherNames { names, host: host.to_owned() };
            return Err(Failure::input(fault.at(&tls.certificate)));
        }
        // By which name agents connect is not known here, but hardly by that of another host.
        if host.parse::<IpAddr>().is_err() {
            warn(format_args!("WARNING: agents cannot connect to {host}: the certificate is for {names}"));
        }
        Ok(())
    }

    /// Writes down where agents find this run.
    pub fn announce(&self, endpoint: &Endpoint) -> Result<(), Failure> {
        let Some(path) = &self.announce else { return Ok(()) };
        let endpoint = endpoint.with_host_name(&self.host).map_err(Failure::input)?;
        write_down(path, &Announcement::Endpoint(endpoint))
    }

    /// What an earlier run wrote down does not hold any more.
    pub fn begins(&self) -> Result<(), Failure> {
        self.announce.as_deref().map_or(Ok(()), remove)
    }

    /// Writes down that there is no more work, or that nobody is there for the time being.
    pub fn has_ended(&self, ended: Ended) -> Result<(), Failure> {
        match (self.announce.as_deref(), ended) {
            (None, _) => Ok(()),
            (Some(path), Ended::Done | Ended::NoneInOrder) => write_down(path, &Announcement::Over),
            (Some(path), Ended::Interrupted) => remove(path),
        }
    }
}

fn remove(path: &Path) -> Result<(), Failure> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(cannot_write(path, error)),
        _ => Ok(()),
    }
}

fn write_down(path: &Path, announcement: &Announcement) -> Result<(), Failure> {
    let mut file = WholeFile::create(path)?;
    write!(file, "{announcement}").map_err(|error| cannot_write(path, error))?;
    file.finish()
}

//! Where agents of other hosts find a run.

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use wire::net::{Announcement, Endpoint, Tls};

use crate::outcome::{Ended, Failure};
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
    /// Writes down where agents find this run.
    pub fn announce(&self, endpoint: &Endpoint) -> Result<(), Failure> {
        let Some(path) = &self.announce else { return Ok(()) };
        let endpoint = endpoint.of_host(&self.host).map_err(Failure::input)?;
        write_down(path, &Announcement::At(endpoint))
    }

    /// What an earlier run wrote down does not hold any more.
    pub fn begins(&self) -> Result<(), Failure> {
        self.announce.as_deref().map_or(Ok(()), remove)
    }

    /// Writes down that there is no more work, or that nobody is there for the time being.
    pub fn has_ended(&self, ended: Ended) -> Result<(), Failure> {
        match (self.announce.as_deref(), ended) {
            (None, _) => Ok(()),
            (Some(path), Ended::Done) => write_down(path, &Announcement::Over),
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

//! Where agents look for the orchestrator: always in one place, or wherever a file says that it is now.

use std::fmt;
use std::fs;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use tokio::time::sleep;

use super::NetError;
use super::endpoint::{Endpoint, EndpointError};

/// Between two looks whether the campaign is over.
const POLL_INTERVAL: Duration = Duration::from_secs(5);
/// What stands in the file of a campaign that is over.
const OVER: &str = "over";

/// Where agents look for the orchestrator.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// It is always here.
    Endpoint(Endpoint),
    /// It writes into this file where it is, each time that it is started: `@FILE`.
    File(PathBuf),
}

/// What the orchestrator writes into its file: a line of text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Announcement {
    /// It is here.
    Endpoint(Endpoint),
    /// There is no more work.
    Over,
}

impl Address {
    /// Where the orchestrator is now, as far as is known.
    pub(super) fn resolve(&self) -> Result<Announcement, NetError> {
        let path = match self {
            Self::Endpoint(endpoint) => return Ok(Announcement::Endpoint(endpoint.clone())),
            Self::File(path) => path,
        };
        let text = fs::read_to_string(path).map_err(|source| match source.kind() {
            ErrorKind::NotFound => NetError::EndpointFileMissing { path: path.clone() },
            _ => NetError::EndpointFile { path: path.clone(), source },
        })?;
        let found =
            |_| NetError::InvalidAnnouncement { path: path.clone(), found: text.chars().take(80).collect() };
        text.parse().map_err(found)
    }

    /// Waits until the file says that the campaign is over.
    pub async fn wait_until_over(&self) {
        if let Self::Endpoint(_) = self {
            std::future::pending().await
        }
        while !matches!(self.resolve(), Ok(Announcement::Over)) {
            sleep(POLL_INTERVAL).await;
        }
    }
}

impl FromStr for Address {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Self, EndpointError> {
        match text.strip_prefix('@').filter(|path| !path.is_empty()) {
            Some(path) => Ok(Self::File(path.into())),
            None => Ok(Self::Endpoint(text.parse()?)),
        }
    }
}

impl From<Endpoint> for Address {
    fn from(endpoint: Endpoint) -> Self {
        Self::Endpoint(endpoint)
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Endpoint(endpoint) => endpoint.fmt(f),
            Self::File(path) => write!(f, "@{}", path.display()),
        }
    }
}

impl FromStr for Announcement {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Self, EndpointError> {
        match text.trim_end() {
            OVER => Ok(Self::Over),
            endpoint => Ok(Self::Endpoint(endpoint.parse()?)),
        }
    }
}

impl fmt::Display for Announcement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Endpoint(endpoint) => writeln!(f, "{endpoint}"),
            Self::Over => writeln!(f, "{OVER}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_and_written() {
        for text in ["tcp/head:7447", "@campaign/endpoint", "@/a b/c"] {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        }
        for text in ["", "@", "head:7447", "campaign/endpoint"] {
            assert!(text.parse::<Address>().is_err(), "{text}");
        }
    }

    #[test]
    fn a_file_says_where_the_orchestrator_is() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("endpoint");
        let address: Address = format!("@{}", path.display()).parse().unwrap();
        assert!(matches!(address.resolve(), Err(NetError::EndpointFileMissing { .. })));
        for announcement in [Announcement::Endpoint("tcp/node7:4711".parse().unwrap()), Announcement::Over] {
            fs::write(&path, announcement.to_string()).unwrap();
            assert_eq!(address.resolve().unwrap(), announcement);
        }
        fs::write(&path, "something else\n").unwrap();
        let error = address.resolve().unwrap_err().to_string();
        assert!(error.contains("something else") && error.contains("tcp/HOST:PORT"), "{error}");
    }
}

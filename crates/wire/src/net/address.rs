//! How agents find the orchestrator: at a fixed endpoint, or by an endpoint file.

use std::fmt;
use std::fs;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use tokio::time::sleep;

use super::NetError;
use super::endpoint::{Endpoint, EndpointError};

/// Interval between checks whether the campaign is over.
const POLL_INTERVAL: Duration = Duration::from_secs(5);
/// Content of the endpoint file of a campaign that is over.
const OVER: &str = "over";

/// How agents find the orchestrator.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// At this endpoint.
    Endpoint(Endpoint),
    /// At the endpoint in this file, which the orchestrator writes at every start: `@FILE`.
    File(PathBuf),
}

/// Content of the endpoint file: one line of text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Announcement {
    /// The orchestrator listens here.
    Endpoint(Endpoint),
    /// There is no more work.
    Over,
}

impl Address {
    /// The current endpoint of the orchestrator.
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

    /// Waits until the endpoint file says that the campaign is over. Never returns for a fixed endpoint.
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
    fn endpoint_files_are_resolved() {
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

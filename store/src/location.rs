//! Location of a campaign: a directory on this host, or a server.

mod protection;

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use sqlx::postgres::PgConnectOptions;

use crate::error::{Result, StoreError};

/// Schema for URLs that name none.
const SCHEMA: &str = "public";
/// Longest schema name: with prefixes it must fit the 63 bytes of a PostgreSQL identifier.
const MAX_SCHEMA_LENGTH: usize = 50;

/// Where a campaign is kept.
#[derive(Clone, Debug)]
pub enum Location {
    /// A directory on this host, with SQLite.
    Directory(PathBuf),
    /// A database schema on a server, with PostgreSQL.
    Server(ServerUrl),
}

/// `postgres://user@host:port/database?schema=name`, with further libpq parameters. User, password and other
/// settings may also come from the environment (such as `PGPASSWORD`) and from `~/.pgpass`. Neither `Display` nor
/// `Debug` shows the password.
#[derive(Clone)]
pub struct ServerUrl {
    pub(crate) options: Box<PgConnectOptions>,
    pub(crate) schema: String,
    shown: String,
    has_password: bool,
    is_unprotected: bool,
}

impl ServerUrl {
    /// The URL without its password.
    pub fn as_str(&self) -> &str {
        &self.shown
    }

    /// Whether the URL itself contains a password. A URL that is written down should not.
    pub fn has_password(&self) -> bool {
        self.has_password
    }

    /// Identifies the campaign by server, port, database and schema, independent of the form of the URL and of the
    /// user.
    pub fn campaign_key(&self) -> String {
        let options = &self.options;
        let host = match options.get_socket() {
            Some(directory) => directory.display().to_string(),
            None => options.get_host().to_ascii_lowercase(),
        };
        let database = options.get_database().unwrap_or(options.get_username());
        format!("{host}:{}/{database}?schema={}", options.get_port(), self.schema)
    }

    /// Whether the connection crosses a network without protection because the URL asks for it.
    pub fn is_unprotected(&self) -> bool {
        self.is_unprotected
    }
}

impl Location {
    /// Whether a text denotes a server rather than a directory.
    pub fn is_server(text: &str) -> bool {
        text.starts_with("postgres://") || text.starts_with("postgresql://")
    }
}

impl FromStr for Location {
    type Err = StoreError;

    /// Parses a URL that begins with `postgres://` or `postgresql://`. Any text that is no URL is a directory.
    fn from_str(text: &str) -> Result<Self> {
        let is_url = text.split_once("://").is_some_and(|(scheme, _)| is_scheme(scheme));
        if is_url { Ok(Self::Server(text.parse()?)) } else { Ok(Self::Directory(text.into())) }
    }
}

/// RFC 3986: a letter, then letters, digits, +, - and dots.
fn is_scheme(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_alphabetic())
        && text.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '+' | '-' | '.'))
}

impl FromStr for ServerUrl {
    type Err = StoreError;

    fn from_str(url: &str) -> Result<Self> {
        let UrlParts { shown, plain, schema, has_password } = UrlParts::parse(url)?;
        if !Location::is_server(url) {
            let reason = "it must begin with postgres:// (a campaign in a directory needs no run.store, and the name of a directory contains no ://)";
            return Err(StoreError::Url { url: shown, reason: reason.to_owned() });
        }
        let valid = |c: char| matches!(c, 'a'..='z' | '0'..='9' | '_');
        if schema.is_empty() || schema.len() > MAX_SCHEMA_LENGTH || !schema.chars().all(valid) {
            let reason = format!(
                "the schema '{schema}' must consist of at most {MAX_SCHEMA_LENGTH} lower-case letters, digits and underscores"
            );
            return Err(StoreError::Url { url: shown, reason });
        }
        protection::check_parameters(&plain)
            .map_err(|reason| StoreError::Url { url: shown.clone(), reason })?;
        // The parser's own message may show a part of the URL.
        let options: PgConnectOptions = plain.parse().map_err(|_| StoreError::Url {
            url: shown.clone(),
            reason: "it should look like postgres://user@host:5432/database?schema=name".into(),
        })?;
        let (options, is_unprotected) =
            protection::resolve(options).map_err(|reason| StoreError::Url { url: shown.clone(), reason })?;
        Ok(Self { options: Box::new(options), schema, shown, has_password, is_unprotected })
    }
}

/// A URL taken apart.
struct UrlParts {
    /// Without password.
    shown: String,
    /// Without schema.
    plain: String,
    schema: String,
    has_password: bool,
}

impl UrlParts {
    fn parse(url: &str) -> Result<Self> {
        let (begin, parameters) = url.split_once('?').unwrap_or((url, ""));
        let (scheme, rest) = begin.split_once("://").unwrap_or(("", begin));
        let (mut shown, mut plain) = (String::new(), begin.to_owned());
        let mut has_password = false;
        // A password may contain any character except '/', '?' and '#', which end it.
        let (authority, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
        match authority.rsplit_once('@') {
            Some((user, host)) => {
                let name = user.split(':').next().unwrap_or_default();
                has_password = user.contains(':');
                shown += &format!("{scheme}://{name}@{host}{path}");
            }
            None => shown += begin,
        }
        let (mut schema, mut separator) = (SCHEMA, ['?', '?']);
        for parameter in parameters.split('&').filter(|parameter| !parameter.is_empty()) {
            let (key, value) = parameter.split_once('=').unwrap_or((parameter, ""));
            if key == "schema" {
                schema = value;
            } else {
                plain += &format!("{}{parameter}", std::mem::replace(&mut separator[1], '&'));
            }
            if key == "password" {
                has_password = true;
            } else {
                shown += &format!("{}{parameter}", std::mem::replace(&mut separator[0], '&'));
            }
        }
        if path.contains('@') {
            let reason = "write the '/' in its password as %2F".to_owned();
            return Err(StoreError::Url { url: format!("{scheme}://…"), reason });
        }
        Ok(Self { shown, plain, schema: schema.to_owned(), has_password })
    }
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Directory(directory) => directory.display().fmt(f),
            Self::Server(url) => url.fmt(f),
        }
    }
}

impl fmt::Display for ServerUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.shown)
    }
}

impl fmt::Debug for ServerUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("ServerUrl").field(&self.shown).finish()
    }
}

impl From<&Path> for Location {
    fn from(directory: &Path) -> Self {
        Self::Directory(directory.into())
    }
}

impl From<&PathBuf> for Location {
    fn from(directory: &PathBuf) -> Self {
        Self::Directory(directory.clone())
    }
}

impl From<PathBuf> for Location {
    fn from(directory: PathBuf) -> Self {
        Self::Directory(directory)
    }
}

impl From<&Self> for Location {
    fn from(location: &Self) -> Self {
        location.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_password_is_used_and_never_shown() {
        for url in [
            "postgres://anna:s3cret@host:5433/lab?schema=alloy&sslmode=require",
            "postgres://anna:s3c@ret@host:5433/lab?schema=alloy&sslmode=verify-full",
            "postgresql://anna@host:5433/lab?password=s3cret&schema=alloy&sslmode=disable",
        ] {
            let location: Location = url.parse().unwrap();
            let Location::Server(server) = &location else { panic!("{location}") };
            assert!(server.has_password());
            assert_eq!((server.schema.as_str(), server.options.get_host()), ("alloy", "host"));
            assert_eq!((server.options.get_port(), server.options.get_username()), (5433, "anna"));
            for shown in [format!("{location}"), format!("{location:?}"), server.as_str().to_owned()] {
                assert!(!shown.contains("s3c") && !shown.contains("ret"), "{shown}");
                assert!(shown.contains("anna@host:5433/lab?schema=alloy"), "{shown}");
            }
            let again: ServerUrl = server.as_str().parse().unwrap();
            assert!(!again.has_password() && again.as_str() == server.as_str());
        }
    }

    #[test]
    fn invalid_urls_are_refused_without_showing_them() {
        for url in [
            "postgres://anna:s3/cret@host/lab",
            "postgres://anna:s3cret@host:port/lab",
            "postgres://anna:s3cret@host/lab?schema=Alloy",
            "postgres://anna:s3cret@host/lab?schema=a;drop",
            "postgres://anna:s3cret@host/lab?schema=",
        ] {
            let error = url.parse::<Location>().unwrap_err();
            assert!(matches!(error, StoreError::Url { .. }));
            for shown in [format!("{error}"), format!("{error:?}")] {
                assert!(!shown.contains("s3") && !shown.contains("cret"), "{shown}");
            }
        }
        let location: Location = "campaigns/alloy".parse().unwrap();
        assert!(matches!(location, Location::Directory(directory) if directory.ends_with("alloy")));
    }

    #[test]
    fn the_campaign_key_is_independent_of_the_form_of_the_url() {
        let place = |url: &str| url.parse::<ServerUrl>().unwrap().campaign_key();
        let expected = place("postgres://anna@localhost/lab?schema=alloy");
        for same in [
            "postgresql://localhost:5432/lab?schema=alloy",
            "postgres://bert:s3cret@LOCALHOST/lab?application_name=x&schema=alloy",
            "postgres:///?dbname=lab&host=localhost&schema=alloy",
        ] {
            assert_eq!(place(same), expected, "{same}");
        }
        for other in ["localhost/lab", "localhost:5433/lab?schema=alloy", "localhost/lap?schema=alloy"] {
            assert_ne!(place(&format!("postgres://{other}")), expected, "{other}");
        }
    }

    #[test]
    fn the_default_schema_is_public() {
        let server: ServerUrl = "postgres://host/lab?host=/run/postgresql&port=5433".parse().unwrap();
        assert_eq!(server.schema, "public");
        assert_eq!(server.as_str(), "postgres://host/lab?host=/run/postgresql&port=5433");
    }
}

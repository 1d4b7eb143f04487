//! The configuration whose files are read, and its errors and warnings about them.

use std::path::{Path, PathBuf};

use toml::Spanned;

use crate::config::{Config, ConfigError, Warning, location_of_offset};

/// Reads files. Errors name the line of the configuration that names the file.
pub(super) struct Loader<'a> {
    /// Path of the configuration file.
    pub path: &'a Path,
    /// Its text.
    pub text: &'a str,
    /// The parsed configuration.
    pub config: &'a Config,
}

impl Loader<'_> {
    pub(super) fn file_error(
        &self,
        key: &str,
        file: &Spanned<PathBuf>,
        message: impl ToString,
    ) -> ConfigError {
        let at = location_of_offset(self.path, self.text, file.span().start);
        ConfigError::File { at, key: key.to_owned(), message: message.to_string() }
    }

    pub(super) fn warning(&self, key: &str, file: &Spanned<PathBuf>, message: String) -> Warning {
        Warning {
            at: location_of_offset(self.path, self.text, file.span().start),
            key: key.to_owned(),
            message,
        }
    }
}

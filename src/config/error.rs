//! What is wrong with a configuration, and where.

use std::path::{Path, PathBuf};

/// Why a configuration cannot be used: exit code 2.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// A file that cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// TOML that is none, an unknown key, a value of the wrong kind.
    #[error("{at}: {message}")]
    Parse {
        /// `file:line:column`.
        at: String,
        /// What was found and expected.
        message: String,
    },
    /// A value that does not go with the others.
    #[error("{at}: {key} is {found}; expected {expected}")]
    Value {
        /// `file:line`.
        at: String,
        /// The key.
        key: String,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A file that the configuration names and that cannot be used.
    #[error("{at}: {key}: {message}")]
    File {
        /// `file:line` of the configuration.
        at: String,
        /// The key.
        key: String,
        /// What is wrong with the file.
        message: String,
    },
}

impl ConfigError {
    /// The place of a TOML error, with a suggestion for an unknown key.
    pub(crate) fn parse(path: &Path, text: &str, error: &toml::de::Error) -> Self {
        let (line, column) = error.span().map_or((1, 1), |span| line_and_column(text, span.start));
        let at = format!("{}:{line}:{column}", path.display());
        let mut message = error.message().trim().replace('\n', "; ");
        let shown = text.lines().nth(line - 1).unwrap_or_default().trim();
        if let Some(suggestion) = suggestion(&message) {
            message += &format!("; did you mean `{suggestion}`?");
        }
        if !shown.is_empty() {
            message += &format!("\n  {line} | {shown}");
        }
        Self::Parse { at, message }
    }
}

/// `file:line` of a dotted key; the file alone where it is not written out.
pub fn place(path: &Path, text: &str, key: &str) -> String {
    let (section, name) = key.rsplit_once('.').unwrap_or(("", key));
    let mut current = "";
    for (index, line) in text.lines().enumerate() {
        let line = line.trim();
        if let Some(header) = line.strip_prefix('[').and_then(|rest| rest.split(']').next()) {
            current = header;
        }
        let found = line.split('=').next().map(str::trim);
        if line.contains('=') && (found == Some(key) && current.is_empty() || found == Some(name) && current == section) {
            return format!("{}:{}", path.display(), index + 1);
        }
    }
    path.display().to_string()
}

/// `file:line` of a byte offset.
pub fn place_of_offset(path: &Path, text: &str, offset: usize) -> String {
    format!("{}:{}", path.display(), line_and_column(text, offset).0)
}

fn line_and_column(text: &str, offset: usize) -> (usize, usize) {
    let before = text.get(..offset).unwrap_or(text);
    let column = before.rsplit('\n').next().map_or(0, |line| line.chars().count());
    (before.matches('\n').count() + 1, column + 1)
}

/// The nearest of the names in "unknown field `x`, expected one of `a`, `b`", if one is near.
fn suggestion(message: &str) -> Option<&str> {
    let mut names = message.split('`').skip(1).step_by(2);
    if !message.starts_with("unknown") {
        return None;
    }
    let found = names.next()?;
    let likeness = |name: &str| strsim::jaro_winkler(found, name);
    names.max_by(|a, b| likeness(a).total_cmp(&likeness(b))).filter(|name| likeness(name) > 0.7)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_key_gets_the_nearest_name() {
        let message = "unknown field `temprature`, expected one of `steps`, `temperature`, `tau`";
        assert_eq!(suggestion(message), Some("temperature"));
        assert_eq!(suggestion("unknown field `zzz`, expected `steps`"), None);
        assert_eq!(suggestion("invalid type: string `steps`, expected u64"), None);
    }

    #[test]
    fn keys_are_found_in_their_section() {
        let text = "[a]\nx = 1\n[b]\n# x\nx = 2\n";
        assert_eq!(place(Path::new("f"), text, "b.x"), "f:5");
        assert_eq!(place(Path::new("f"), text, "c.x"), "f");
        assert_eq!(place_of_offset(Path::new("f"), text, 5), "f:2");
    }
}

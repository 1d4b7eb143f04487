//! What is wrong with a configuration, and where.

use std::path::{Path, PathBuf};

use super::check::Wrong;

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
    /// A file that is no text.
    #[error("{}:{line}: found bytes that are not text; expected a configuration in TOML (UTF-8)", path.display())]
    Encoding {
        /// The file.
        path: PathBuf,
        /// Where the first of them stands.
        line: usize,
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
    /// A wrong value in the configuration of that text.
    pub(super) fn value(path: &Path, text: &str, (key, found, expected): Wrong) -> Self {
        Self::Value { at: place(path, text, key), key: key.to_owned(), found, expected }
    }

    /// The place of a TOML error in plain words, with a suggestion for an unknown key.
    pub(crate) fn parse(path: &Path, text: &str, error: &toml::de::Error) -> Self {
        let (line, column) = error.span().map_or((1, 1), |span| line_and_column(text, span.start));
        let at = format!("{}:{line}:{column}", path.display());
        let shown = text.lines().nth(line - 1).unwrap_or_default().trim();
        let mut message = in_plain_words(error);
        // What the whole file lacks has no line of its own.
        let of_whole = (line, column) == (1, 1) && message.starts_with("missing");
        if !(shown.is_empty() || of_whole) {
            message += &format!("\n  {line} | {shown}");
        }
        Self::Parse { at, message }
    }
}

/// The text of a configuration.
pub fn read_text(path: &Path) -> Result<String, ConfigError> {
    let bytes = std::fs::read(path).map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
    String::from_utf8(bytes).map_err(|error| {
        let before = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = 1 + before.iter().filter(|byte| **byte == b'\n').count();
        ConfigError::Encoding { path: path.to_owned(), line }
    })
}

/// What is wrong with TOML, with a suggestion for an unknown key.
pub fn in_plain_words(error: &toml::de::Error) -> String {
    let message = translated(&error.message().trim().replace('\n', "; "));
    match suggestion(&message) {
        Some(suggestion) => format!("{message}; did you mean `{suggestion}`?"),
        None => message,
    }
}

/// The words of the parser, which are those of Rust, in the words of those who write configurations.
fn translated(message: &str) -> String {
    let words = [
        ("unknown field", "unknown key"),
        ("missing field", "missing key"),
        ("unknown variant", "unknown value"),
        ("expected a nonzero u64", "expected a whole number above 0"),
        ("expected a nonzero u32", "expected a whole number above 0"),
        ("expected a nonzero usize", "expected a whole number above 0"),
        ("expected u64", "expected a whole number, 0 or more"),
        ("expected u32", "expected a whole number, 0 or more"),
        ("expected usize", "expected a whole number, 0 or more"),
        ("expected f64", "expected a number"),
        ("expected a sequence", "expected a list in [ ]"),
    ];
    let message = words.iter().fold(message.to_owned(), |message, (from, to)| message.replace(from, to));
    match message
        .strip_prefix("unexpected keys in table: ")
        .and_then(|rest| rest.split_once(", available keys: "))
    {
        Some((found, known)) => format!("unknown key `{found}`, expected `{}`", known.replace(", ", "`, `")),
        None => message,
    }
}

/// `file:line` of a dotted key; that of its section where it is not written out, or the file alone.
pub fn place(path: &Path, text: &str, key: &str) -> String {
    let (section, name) = key.rsplit_once('.').unwrap_or(("", key));
    let mut current = "";
    let mut nearest = path.display().to_string();
    for (index, line) in text.lines().enumerate() {
        let line = line.trim();
        if let Some(header) = line.strip_prefix('[').and_then(|rest| rest.split(']').next()) {
            current = header.trim();
            if current == section {
                nearest = format!("{}:{}", path.display(), index + 1);
            }
        }
        let found = line.split('=').next().map(str::trim);
        if line.contains('=')
            && (found == Some(key) && current.is_empty() || found == Some(name) && current == section)
        {
            return format!("{}:{}", path.display(), index + 1);
        }
    }
    nearest
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

/// The nearest of the names in "unknown key `x`, expected one of `a`, `b`", if one is near.
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
        let message = "unknown key `temprature`, expected one of `steps`, `temperature`, `tau`";
        assert_eq!(suggestion(message), Some("temperature"));
        assert_eq!(suggestion("unknown key `zzz`, expected `steps`"), None);
        assert_eq!(suggestion("invalid type: string `steps`, expected u64"), None);
    }

    #[test]
    fn keys_are_found_in_their_section() {
        let text = "[a]\nx = 1\n[b]\n# x\nx = 2\n";
        assert_eq!(place(Path::new("f"), text, "b.x"), "f:5");
        assert_eq!(place(Path::new("f"), text, "b.y"), "f:3");
        assert_eq!(place(Path::new("f"), text, "c.x"), "f");
        assert_eq!(place_of_offset(Path::new("f"), text, 5), "f:2");
    }
}

//! Errors of a configuration, with their locations.

use std::ops::Range;
use std::path::{Path, PathBuf};

use toml::de::{DeTable, DeValue};

use super::hints::Unknown;

/// A value that a rule refuses: its key, what was found, what was expected.
pub type InvalidValue = (String, String, String);

/// Why a configuration is refused (exit code 2).
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// A file that cannot be read.
    #[error("cannot read {}: {source}{}", path.display(), suggested_file(path))]
    Read {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// A file that is not UTF-8 text.
    #[error("{}:{line}: found bytes that are not text; expected a configuration in TOML (UTF-8)", path.display())]
    Encoding {
        /// The file.
        path: PathBuf,
        /// Line of the first invalid byte.
        line: usize,
    },
    /// Invalid TOML, an unknown key, or a value of the wrong type.
    #[error("{at}: {message}")]
    Parse {
        /// `file:line:column`.
        at: String,
        /// What was found and expected.
        message: String,
    },
    /// A value out of its range, or one that contradicts other keys.
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
    /// A file named by the configuration that cannot be used.
    #[error("{at}: {key}: {message}")]
    File {
        /// `file:line` of the configuration.
        at: String,
        /// The key.
        key: String,
        /// The problem of the file.
        message: String,
    },
    /// Several errors.
    #[error("{} errors in {}:\n{}", errors.len(), path.display(), lines(errors))]
    Several {
        /// The file.
        path: PathBuf,
        /// The errors, in the order of the file.
        errors: Vec<ConfigError>,
    },
}

/// Largest number of errors that are printed.
const MAX_PRINTED_ERRORS: usize = 12;

/// Largest number of characters of a line that are printed.
const MAX_LINE_LENGTH: usize = 120;

fn lines(errors: &[ConfigError]) -> String {
    let mut lines: Vec<_> = errors.iter().take(MAX_PRINTED_ERRORS).map(ToString::to_string).collect();
    if errors.len() > MAX_PRINTED_ERRORS {
        lines.push(format!("… and {} more", errors.len() - MAX_PRINTED_ERRORS));
    }
    lines.join("\n")
}

/// Suggests the configuration in `path` if `path` is a directory that `calmwalk init` made.
fn suggested_file(path: &Path) -> String {
    let inside = path.join("campaign.toml");
    if inside.is_file() { format!("; did you mean {}?", inside.display()) } else { String::new() }
}

impl ConfigError {
    /// Combines errors, each with its offset in the file; `None` if there are none.
    pub fn all(path: &Path, problems: Vec<(usize, Self)>) -> Option<Self> {
        let mut errors: Vec<_> = problems.into_iter().map(|(_, error)| error).collect();
        match errors.len() {
            0 | 1 => errors.pop(),
            _ => Some(Self::Several { path: path.to_owned(), errors }),
        }
    }

    /// A file from which no configuration can be deserialized.
    pub(crate) fn unreadable(path: &Path) -> Self {
        Self::Parse { at: path.display().to_string(), message: "expected a configuration".to_owned() }
    }

    /// An error at `span`, with the text of its line. `key` is the dotted key that the error is about, empty if the message names it.
    pub(super) fn parse(
        path: &Path,
        text: &str,
        span: Option<Range<usize>>,
        message: String,
        key: &str,
    ) -> Self {
        let (line, column) = span.map_or((1, 1), |span| line_and_column(text, span.start));
        let at = format!("{}:{line}:{column}", path.display());
        let shown: String =
            text.lines().nth(line - 1).unwrap_or_default().trim().chars().take(MAX_LINE_LENGTH).collect();
        let mut message = if key.is_empty() { message } else { format!("{key}: {message}") };
        // A table that is missing from the whole file has no line.
        let of_whole_file = (line, column) == (1, 1) && message.starts_with("missing");
        if !(shown.is_empty() || of_whole_file) {
            message += &format!("\n  {line} | {shown}");
        }
        Self::Parse { at, message }
    }
}

/// Reads the text of a configuration.
pub fn read_text(path: &Path) -> Result<String, ConfigError> {
    let bytes = std::fs::read(path).map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
    String::from_utf8(bytes).map_err(|error| {
        let before = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = 1 + before.iter().filter(|byte| **byte == b'\n').count();
        ConfigError::Encoding { path: path.to_owned(), line }
    })
}

/// The message of a TOML error in the words of a user, with a suggestion for an unknown key.
pub fn user_message(error: &toml::de::Error) -> String {
    let message = translated(&error.message().trim().replace('\n', "; "));
    match Unknown::from_message(&message).and_then(|unknown| unknown.nearest()) {
        Some(suggestion) => format!("{message}; did you mean `{suggestion}`?"),
        None => message,
    }
}

/// Replaces the parser's Rust terms by those of TOML.
pub(super) fn translated(message: &str) -> String {
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

/// `file:line` of a dotted key; if it is not written out, of the innermost table that would have it; otherwise the file alone.
pub fn location(path: &Path, text: &str, key: &str) -> String {
    let (table, _) = DeTable::parse_recoverable(text);
    match offset_of_key(table.get_ref(), key) {
        Some(offset) => location_of_offset(path, text, offset),
        None => path.display().to_string(),
    }
}

/// Offset of a dotted key, or of the innermost table that would have it.
pub(super) fn offset_of_key(table: &DeTable<'_>, key: &str) -> Option<usize> {
    let (name, rest) = key.split_once('.').unwrap_or((key, ""));
    let (found, value) = table.get_key_value(name)?;
    let inside = match value.get_ref() {
        DeValue::Table(inner) if !rest.is_empty() => offset_of_key(inner, rest),
        // Elements of an array have numbers as keys.
        DeValue::Array(tables) if !rest.is_empty() => {
            let (number, rest) = rest.split_once('.').unwrap_or((rest, ""));
            let table = number.parse::<usize>().ok().and_then(|number| tables.get(number));
            table.map(|table| match table.get_ref() {
                DeValue::Table(inner) => offset_of_key(inner, rest).unwrap_or(table.span().start),
                _ => table.span().start,
            })
        }
        _ => None,
    };
    Some(inside.unwrap_or(found.span().start))
}

/// `file:line` of a byte offset.
pub fn location_of_offset(path: &Path, text: &str, offset: usize) -> String {
    format!("{}:{}", path.display(), line_and_column(text, offset).0)
}

pub(super) fn line_and_column(text: &str, offset: usize) -> (usize, usize) {
    let before = text.get(..offset).unwrap_or(text);
    let column = before.rsplit('\n').next().map_or(0, |line| line.chars().count());
    (before.matches('\n').count() + 1, column + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_found_in_their_section() {
        let text = "[a]\nx = 1\n[b]\n# x\nx = 2\n";
        assert_eq!(location(Path::new("f"), text, "b.x"), "f:5");
        assert_eq!(location(Path::new("f"), text, "b.y"), "f:3");
        assert_eq!(location(Path::new("f"), text, "c.x"), "f");
        assert_eq!(location_of_offset(Path::new("f"), text, 5), "f:2");
        let text = "[a]\nb = { c = { d = 1 },\n  e = 2 }\n[a.f.g]\nh = 3\n";
        for (key, line) in
            [("a.b.c.d", 2), ("a.b.e", 3), ("a.b.x", 2), ("a.f.g.h", 5), ("a.f.g.x", 4), ("a.x", 1)]
        {
            assert_eq!(location(Path::new("f"), text, key), format!("f:{line}"), "{key}");
        }
    }
}

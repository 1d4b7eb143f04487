//! What is wrong with a configuration, and where.

use std::ops::Range;
use std::path::{Path, PathBuf};

use toml::de::{DeTable, DeValue};

use super::hints::Unknown;

/// A value that a rule refuses: its key, what was found, what was expected.
pub type Wrong = (String, String, String);

/// Why a configuration cannot be used: exit code 2.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// A file that cannot be read.
    #[error("cannot read {}: {source}{}", path.display(), what_instead(path))]
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
    /// Several of these.
    #[error("{} errors in {}:\n{}", errors.len(), path.display(), lines(errors))]
    Several {
        /// The file.
        path: PathBuf,
        /// In the order of the file.
        errors: Vec<ConfigError>,
    },
}

/// Errors of a file that are told.
const MOST_ERRORS: usize = 12;

/// Characters of a line that are shown.
const MOST_OF_A_LINE: usize = 120;

fn lines(errors: &[ConfigError]) -> String {
    let mut lines: Vec<_> = errors.iter().take(MOST_ERRORS).map(ToString::to_string).collect();
    if errors.len() > MOST_ERRORS {
        lines.push(format!("… and {} more", errors.len() - MOST_ERRORS));
    }
    lines.join("\n")
}

/// The directory that `init` makes is taken for its configuration easily.
fn what_instead(path: &Path) -> String {
    let inside = path.join("campaign.toml");
    if inside.is_file() { format!("; did you mean {}?", inside.display()) } else { String::new() }
}

impl ConfigError {
    /// All of these, each with where it stands; `None` if there are none.
    pub fn all(path: &Path, problems: Vec<(usize, Self)>) -> Option<Self> {
        let mut errors: Vec<_> = problems.into_iter().map(|(_, error)| error).collect();
        match errors.len() {
            0 | 1 => errors.pop(),
            _ => Some(Self::Several { path: path.to_owned(), errors }),
        }
    }

    /// A file of which nothing could be read.
    pub(crate) fn unreadable(path: &Path) -> Self {
        Self::Parse { at: path.display().to_string(), message: "expected a configuration".to_owned() }
    }

    /// What is wrong at a place of a file, with its line. `key` is the dotted key that it is about, if the message does not say.
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
            text.lines().nth(line - 1).unwrap_or_default().trim().chars().take(MOST_OF_A_LINE).collect();
        let mut message = if key.is_empty() { message } else { format!("{key}: {message}") };
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
    match Unknown::of(&message).and_then(|unknown| unknown.nearest()) {
        Some(suggestion) => format!("{message}; did you mean `{suggestion}`?"),
        None => message,
    }
}

/// The words of the parser, which are those of Rust, in the words of those who write configurations.
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

/// `file:line` of a dotted key; that of the table that should have it where it is not written out, or the file alone.
pub fn place(path: &Path, text: &str, key: &str) -> String {
    let (table, _) = DeTable::parse_recoverable(text);
    match nearest(table.get_ref(), key) {
        Some(offset) => place_of_offset(path, text, offset),
        None => path.display().to_string(),
    }
}

/// Where a dotted key stands, or the innermost of the tables that should have it.
pub(super) fn nearest(table: &DeTable<'_>, key: &str) -> Option<usize> {
    let (name, rest) = key.split_once('.').unwrap_or((key, ""));
    let (found, value) = table.get_key_value(name)?;
    let inside = match value.get_ref() {
        DeValue::Table(inner) if !rest.is_empty() => nearest(inner, rest),
        // Tables of an array by their number.
        DeValue::Array(tables) if !rest.is_empty() => {
            let (number, rest) = rest.split_once('.').unwrap_or((rest, ""));
            let table = number.parse::<usize>().ok().and_then(|number| tables.get(number));
            table.map(|table| match table.get_ref() {
                DeValue::Table(inner) => nearest(inner, rest).unwrap_or(table.span().start),
                _ => table.span().start,
            })
        }
        _ => None,
    };
    Some(inside.unwrap_or(found.span().start))
}

/// `file:line` of a byte offset.
pub fn place_of_offset(path: &Path, text: &str, offset: usize) -> String {
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
        assert_eq!(place(Path::new("f"), text, "b.x"), "f:5");
        assert_eq!(place(Path::new("f"), text, "b.y"), "f:3");
        assert_eq!(place(Path::new("f"), text, "c.x"), "f");
        assert_eq!(place_of_offset(Path::new("f"), text, 5), "f:2");
        let text = "[a]\nb = { c = { d = 1 },\n  e = 2 }\n[a.f.g]\nh = 3\n";
        for (key, line) in
            [("a.b.c.d", 2), ("a.b.e", 3), ("a.b.x", 2), ("a.f.g.h", 5), ("a.f.g.x", 4), ("a.x", 1)]
        {
            assert_eq!(place(Path::new("f"), text, key), format!("f:{line}"), "{key}");
        }
    }
}

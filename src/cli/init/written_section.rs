//! Sections of a configuration as text, each key with its comment.

use std::path::{Component, Path};

use crate::config::usual_range;
use crate::exit_status::CommandError;

/// Columns of a key and its value, before the comment.
const WIDTH: usize = 31;

/// A section.
pub struct WrittenSection {
    /// `[name]`
    pub header: String,
    /// Its keys.
    pub keys: Vec<WrittenKey>,
}

/// A key with its value and what it means.
pub struct WrittenKey {
    pub name: &'static str,
    value: String,
    comment: String,
}

impl WrittenSection {
    /// A section with this header.
    pub fn new(header: impl Into<String>, keys: Vec<WrittenKey>) -> Self {
        Self { header: header.into(), keys }
    }

    /// Header and keys, a line each.
    pub fn text(&self) -> String {
        let lines: Vec<_> = self.keys.iter().map(WrittenKey::line).collect();
        format!("{}\n{}", self.header, lines.join("\n"))
    }
}

impl WrittenKey {
    /// A key, its value in TOML, and its comment.
    pub fn new(name: &'static str, value: impl Into<String>, comment: impl Into<String>) -> Self {
        Self { name, value: value.into(), comment: comment.into() }
    }

    /// A comment that ends with the usual range of a dotted key, if there is one.
    pub fn with_range(comment: &str, key: &str) -> String {
        usual_range(key).map_or(comment.to_owned(), |range| format!("{comment} (usual: {range})"))
    }

    /// The key with its value and, behind it, the comment.
    pub fn line(&self) -> String {
        let setting = format!("{} = {}", self.name, self.value);
        format!("{setting:<WIDTH$}   # {}", self.comment)
    }
}

/// A list of values in TOML.
pub fn list(values: impl IntoIterator<Item = String>) -> String {
    format!("[{}]", values.into_iter().collect::<Vec<_>>().join(", "))
}

/// A path as a configuration in `directory` names it, in quotes: relative if it is below the directory, otherwise absolute.
pub fn path_value(directory: &Path, path: &Path) -> Result<String, CommandError> {
    let [base, path] = [directory, path].map(|path| std::path::absolute(path).map_err(CommandError::failed));
    let (base, path) = (base?, path?);
    let is_plain = |inside: &&Path| !inside.components().any(|part| part == Component::ParentDir);
    let named = path.strip_prefix(&base).ok().filter(is_plain).unwrap_or(&path);
    match named.to_str() {
        Some(text) => Ok(quoted(text)),
        None => Err(CommandError::Input(format!(
            "{}: the path is not UTF-8 text; expected one that a configuration can name",
            named.display()
        ))),
    }
}

/// A text as a value of TOML.
pub fn quoted(text: &str) -> String {
    toml::Value::from(text).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_below_the_directory_are_relative() {
        let value = |path: &str| path_value(Path::new("/a/run"), Path::new(path)).unwrap();
        assert_eq!(value("/a/run/models/m.npz"), "\"models/m.npz\"");
        assert_eq!(value("/a/run/./m.npz"), "\"m.npz\"");
        for path in ["/a/other/m.npz", "/a/run/../m.npz", "/a/runs/m.npz"] {
            assert_eq!(value(path), format!("\"{path}\""));
        }
    }
}

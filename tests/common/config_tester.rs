//! Tests invalid configurations: exit code 2, a clean message, and nothing written.

use std::fs;
use std::path::Path;

use tempfile::TempDir;

use super::{demo, refuse};

/// A directory for trying configurations.
pub struct ConfigTester(TempDir);

impl ConfigTester {
    /// Creates an empty one.
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    /// Path of the directory.
    pub fn path(&self) -> &Path {
        self.0.path()
    }

    /// Writes a file to it.
    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::write(self.0.path().join(name), content).unwrap();
    }

    /// The message with which `validate` and `run` refuse this configuration.
    pub fn refused(&self, text: impl AsRef<[u8]>) -> String {
        self.write("c.toml", text);
        let before = self.files();
        let message = refuse(self.0.path(), ["validate", "c.toml"]);
        assert_eq!(refuse(self.0.path(), ["run", "c.toml"]), message);
        assert!(message.starts_with("calmwalk: "), "{message}");
        assert!(!message.contains("panicked") && !message.contains("RUST_BACKTRACE"), "{message}");
        assert_eq!(self.files(), before, "nothing may be written");
        message
    }

    /// Replaces `from` in the demo. The configuration must be refused with a message that contains all `words`.
    pub fn refused_with(&self, from: &str, to: &str, words: &[&str]) {
        let message = self.refused(changed(from, to));
        for word in words {
            assert!(message.contains(word), "{message}\nexpected {word}");
        }
    }

    fn files(&self) -> Vec<String> {
        let entries = fs::read_dir(self.0.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

/// The aluminium demo with its first `from` replaced.
pub fn changed(from: &str, to: &str) -> String {
    let text = demo("aluminium.toml");
    assert!(text.contains(from), "the demo has no {from}");
    text.replacen(from, to, 1)
}

/// This configuration without its section `[refit]`, which needs a mixture that can be updated.
pub fn without_refit(text: &str) -> String {
    let begin = text.find("\n[refit]").expect("the demo trains its potential");
    let end = begin + text[begin..].find("\n[budget]").expect("the next section");
    format!("{}{}", &text[..begin], &text[end..])
}

/// Number of the demo's line that contains this text.
pub fn line(of: &str) -> usize {
    let text = demo("aluminium.toml");
    1 + text.lines().position(|line| line.contains(of)).unwrap_or_else(|| panic!("the demo has no {of}"))
}

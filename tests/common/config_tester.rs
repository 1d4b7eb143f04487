//! Trying wrong configurations: exit code 2, a message without noise, nothing written.

use std::fs;
use std::path::Path;

use tempfile::TempDir;

use super::{demo, refuse};

/// A directory in which configurations are tried.
pub struct ConfigTester(TempDir);

impl ConfigTester {
    /// An empty one.
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        self.0.path()
    }

    /// Puts a file there.
    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::write(self.0.path().join(name), content).unwrap();
    }

    /// What `validate` and `run` say of this configuration, which neither of them takes.
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

    /// The demo with something else in the place of `from` is refused, and the message has all these words.
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

/// Line of the demo in which this stands.
pub fn line(of: &str) -> usize {
    let text = demo("aluminium.toml");
    1 + text.lines().position(|line| line.contains(of)).unwrap_or_else(|| panic!("the demo has no {of}"))
}

//! The end of what a program said.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Bytes of each stream that are kept.
const TAIL: u64 = 3000;

/// The last lines of its standard output and standard error.
pub(super) fn tail(work: &Path) -> String {
    let streams = ["stdout", "stderr"].map(|name| (name, last_lines(&work.join(name))));
    let said = streams.iter().filter(|(_, text)| !text.is_empty());
    said.map(|(name, text)| format!("{name}:\n{text}\n")).collect()
}

/// As many whole lines as fit, or the end of the only one; nothing of a file that cannot be read.
pub(super) fn last_lines(path: &Path) -> String {
    let read = || -> std::io::Result<(u64, Vec<u8>)> {
        let mut file = File::open(path)?;
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(length.saturating_sub(TAIL)))?;
        let mut bytes = Vec::new();
        file.take(TAIL).read_to_end(&mut bytes)?;
        Ok((length, bytes))
    };
    let Ok((length, bytes)) = read() else { return String::new() };
    let text = String::from_utf8_lossy(&bytes);
    let text = match text.split_once('\n') {
        Some((_, whole)) if length > TAIL && !whole.trim().is_empty() => whole,
        _ => &text,
    };
    text.trim().to_owned()
}

//! The end of a program's output.

use std::path::Path;

use dft::result_file;

/// Bytes kept of each stream.
const TAIL_BYTES: u64 = 3000;

/// The last lines of its standard output and standard error.
pub(super) fn tail(work: &Path) -> String {
    let streams = ["stdout", "stderr"].map(|name| (name, last_lines(&work.join(name))));
    let said = streams.iter().filter(|(_, text)| !text.is_empty());
    said.map(|(name, text)| format!("{name}:\n{text}\n")).collect()
}

/// As many whole lines as fit, or the end of a single line; empty if the file cannot be read.
pub(super) fn last_lines(path: &Path) -> String {
    let Ok(tail) = result_file::tail(path, TAIL_BYTES) else { return String::new() };
    let text = String::from_utf8_lossy(&tail.bytes);
    let text = match text.split_once('\n') {
        Some((_, whole)) if tail.length > TAIL_BYTES && !whole.trim().is_empty() => whole,
        _ => &text,
    };
    text.trim().to_owned()
}

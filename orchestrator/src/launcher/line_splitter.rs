//! Splits a stream of bytes into lines.

/// Longer lines are split, so that output without line endings does not fill the memory.
const MAX_LINE_BYTES: usize = 8192;

/// Splits a stream of bytes into lines.
#[derive(Debug, Default)]
pub(super) struct LineSplitter {
    bytes: Vec<u8>,
    /// Number of bytes already returned.
    given: usize,
}

impl LineSplitter {
    pub fn push(&mut self, bytes: &[u8]) {
        self.bytes.drain(..self.given);
        self.given = 0;
        self.bytes.extend_from_slice(bytes);
    }

    /// The next complete line, without line ending.
    pub fn next_line(&mut self) -> Option<String> {
        let left = &self.bytes[self.given..];
        let window = &left[..left.len().min(MAX_LINE_BYTES)];
        let length = match window.iter().position(|byte| *byte == b'\n') {
            Some(end) => end + 1,
            None if window.len() == MAX_LINE_BYTES => MAX_LINE_BYTES,
            None => return None,
        };
        self.given += length;
        Some(text(&window[..length]))
    }

    /// The rest at the end of the stream.
    pub fn rest(&mut self) -> Option<String> {
        let rest = std::mem::take(self);
        let rest = &rest.bytes[rest.given..];
        (!rest.is_empty()).then(|| text(rest))
    }
}

fn text(line: &[u8]) -> String {
    String::from_utf8_lossy(line).trim_end().to_owned()
}

/// Whether a line may explain a failure. Rust's hint about backtraces after a panic does not.
pub(super) fn is_failure_reason(line: &str) -> bool {
    !line.is_empty() && !line.starts_with("note: run with `RUST_BACKTRACE=")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(chunks: &[&[u8]]) -> Vec<String> {
        let (mut lines, mut found) = (LineSplitter::default(), Vec::new());
        for chunk in chunks {
            lines.push(chunk);
            found.extend(std::iter::from_fn(|| lines.next_line()));
        }
        found.extend(lines.rest());
        assert_eq!(lines.rest(), None);
        found
    }

    #[test]
    fn lines_do_not_depend_on_chunk_boundaries() {
        let text = "one\r\n\nthr\u{e9}e\nlast".as_bytes();
        for cut in 0..=text.len() {
            let (head, tail) = text.split_at(cut);
            assert_eq!(lines(&[head, tail]), ["one", "", "thr\u{e9}e", "last"], "{cut}");
        }
        assert_eq!(lines(&[b"a\n"]), ["a"]);
        assert_eq!(lines(&[b"\xff\n"]), ["\u{fffd}"]);
    }

    #[test]
    fn long_lines_are_split() {
        let long = vec![b'x'; 2 * MAX_LINE_BYTES + 1];
        let lengths: Vec<usize> = lines(&[&long, b"\n"]).iter().map(String::len).collect();
        assert_eq!(lengths, [MAX_LINE_BYTES, MAX_LINE_BYTES, 1]);
    }

    #[test]
    fn the_backtrace_hint_is_not_the_reason_of_a_panic() {
        assert!(is_failure_reason("no such atom") && !is_failure_reason(""));
        assert!(!is_failure_reason(
            "note: run with `RUST_BACKTRACE=1` environment variable to display a backtrace"
        ));
    }
}

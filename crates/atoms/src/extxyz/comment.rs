//! Parses the comment line: `key=value` pairs with quotes, brackets and escapes.

use super::error::ExtxyzErrorKind;
use super::value::ExtxyzValue;

/// Keys whose value always stays text.
pub(super) fn is_verbatim(key: &str) -> bool {
    key.eq_ignore_ascii_case("uid")
}

/// The pairs of a comment line, in order.
///
/// Inside `"…"`, `'…'`, `{…}` and `[…]` white space belongs to the word. A backslash escapes the next
/// character. Spaces may surround `=`. A key without `=` is true. A line without any `=` is free text: its
/// words are keys with the value true, and a single apostrophe is allowed.
pub(super) fn parse(line: &str) -> Result<Vec<(String, ExtxyzValue)>, ExtxyzErrorKind> {
    let mut cursor = Cursor { line, at: 0, lenient: !line.contains('=') };
    let mut pairs = Vec::new();
    loop {
        cursor.skip_space();
        let Some(first) = cursor.peek() else { return Ok(pairs) };
        if first == '=' {
            return Err(ExtxyzErrorKind::NoKey { column: cursor.column(cursor.at) });
        }
        let key = cursor.word(true)?;
        cursor.skip_space();
        let value = if cursor.peek() == Some('=') {
            cursor.next();
            cursor.skip_space();
            cursor.value(&key)?
        } else {
            ExtxyzValue::Bool(true)
        };
        pairs.push((key, value));
    }
}

/// Quotes and escapes a word that would not be read back as it is.
pub(super) fn quote(word: &str) -> String {
    let bare = |c: char| c.is_ascii_graphic() && !r#""'{}[]\=,"#.contains(c);
    if !word.is_empty() && word.chars().all(bare) {
        return word.to_owned();
    }
    format!("\"{}\"", word.replace('\\', "\\\\").replace('"', "\\\""))
}

struct Cursor<'a> {
    line: &'a str,
    /// Byte offset of the next character.
    at: usize,
    /// Whether the end of the line closes open quotes.
    lenient: bool,
}

impl Cursor<'_> {
    fn rest(&self) -> &str {
        self.line.get(self.at..).unwrap_or("")
    }

    fn peek(&self) -> Option<char> {
        self.rest().chars().next()
    }

    fn next(&mut self) -> Option<char> {
        let next = self.peek();
        self.at += next.map_or(0, char::len_utf8);
        next
    }

    fn skip_space(&mut self) {
        self.at += self.rest().len() - self.rest().trim_start().len();
    }

    /// Column of the character at a byte offset, from 1. Linear in the line's length; for errors only.
    fn column(&self, at: usize) -> usize {
        self.line.get(..at).unwrap_or("").chars().count() + 1
    }

    /// A word up to white space (or an equals sign).
    fn word(&mut self, ends_at_equals: bool) -> Result<String, ExtxyzErrorKind> {
        let mut word = String::new();
        while let Some(c) = self.peek().filter(|c| !(c.is_whitespace() || ends_at_equals && *c == '=')) {
            self.next();
            match c {
                '\\' => word.extend(self.next()),
                '"' | '\'' => self.delimited(c, c, &mut word)?,
                '{' => self.delimited('{', '}', &mut word)?,
                '[' => self.delimited('[', ']', &mut word)?,
                _ => word.push(c),
            }
        }
        Ok(word)
    }

    /// Reads up to and including the closing delimiter.
    fn delimited(&mut self, open: char, close: char, word: &mut String) -> Result<(), ExtxyzErrorKind> {
        let start = self.at.saturating_sub(open.len_utf8());
        loop {
            match self.next() {
                Some('\\') => word.extend(self.next()),
                Some(c) if c == close => return Ok(()),
                Some(c) => word.push(c),
                None if self.lenient => return Ok(()),
                None => {
                    return Err(ExtxyzErrorKind::Unclosed { column: self.column(start), delimiter: open });
                }
            }
        }
    }

    fn value(&mut self, key: &str) -> Result<ExtxyzValue, ExtxyzErrorKind> {
        if self.rest().starts_with("[[") {
            return self.matrix(key);
        }
        let word = self.word(false)?;
        Ok(if is_verbatim(key) { ExtxyzValue::Text(word) } else { ExtxyzValue::parse(&word) })
    }

    /// `[[…], […]]` without quotes, up to the bracket that closes the first one.
    fn matrix(&mut self, key: &str) -> Result<ExtxyzValue, ExtxyzErrorKind> {
        let start = self.at;
        let mut depth = 0_usize;
        while let Some(c) = self.next() {
            match c {
                '[' => depth += 1,
                ']' => depth -= 1,
                _ => {}
            }
            if depth == 0 {
                let text = self.line.get(start..self.at).unwrap_or("");
                return ExtxyzValue::parse_json(text)
                    .ok_or_else(|| ExtxyzErrorKind::key(key, text, "rows of numbers"));
            }
        }
        Err(ExtxyzErrorKind::Unclosed { column: self.column(start), delimiter: '[' })
    }
}

//! Reads a TOML file and collects all of its errors, so that users see them together.
//!
//! serde stops at the first error. The reader then records the entry at which serde stopped, removes it from the parsed table, or
//! replaces it by a placeholder if it is required, and deserializes the rest again, until no error is left.

use std::path::Path;

use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeTable, DeValue, Deserializer, Error};

use super::error::{ConfigError, InvalidValue, line_and_column, offset_of_key, translated};
use super::hints::{self, KnownKeys};
use super::ranges::{self, RangedNumber};
use super::warning::Warning;

/// Largest number of errors that are collected: no user makes more.
const MAX_ERRORS: usize = 100;

/// Largest number of syntax errors that are shown: one missing quote or bracket makes an error of every later line.
const MAX_SYNTAX_ERRORS: usize = 3;

/// The mark of a value that only the user can give, as `calmwalk init` writes it; what is expected follows.
pub const FILL_IN: &str = "FILL IN: ";

/// A parsed file and its errors.
pub struct Document<'a> {
    path: &'a Path,
    text: &'a str,
    /// The contents of the file.
    table: Spanned<DeTable<'a>>,
    /// Errors with their offsets in the file.
    problems: Vec<(usize, ConfigError)>,
    /// Paths of the entries that already have an error; further errors of them are not reported.
    reported: Vec<Vec<String>>,
}

impl<'a> Document<'a> {
    /// Parses the text of a file.
    ///
    /// # Errors
    /// Invalid TOML, with one message for each faulty line.
    pub fn parse(path: &'a Path, text: &'a str) -> Result<Self, ConfigError> {
        let (table, errors) = DeTable::parse_recoverable(text);
        let mut problems: Vec<_> = errors
            .iter()
            .map(|error| (offset(error), ConfigError::parse(path, text, error.span(), plain(error), "")))
            .collect();
        problems.sort_by_key(|(offset, _)| *offset);
        // Later errors of a line, and most of those behind it, are consequences of its first.
        problems.dedup_by_key(|(offset, _)| line_and_column(text, *offset).0);
        problems.truncate(MAX_SYNTAX_ERRORS);
        match ConfigError::all(path, problems) {
            Some(error) => Err(error),
            None => Ok(Self { path, text, table, problems: Vec::new(), reported: Vec::new() }),
        }
    }

    /// Whether a table of the file has a key.
    pub fn has(&self, table: &str, key: &str) -> bool {
        let table = self.table.get_ref().get(table).and_then(|value| value.get_ref().as_table());
        table.is_some_and(|table| table.contains_key(key))
    }

    /// Deserializes the file and collects all errors. Required entries that are missing or invalid get their values from
    /// `placeholders`, the text of a valid file. Returns `None` if nothing can be deserialized.
    pub fn read<T: DeserializeOwned>(&mut self, placeholders: &str, known: &KnownKeys) -> Option<T> {
        let placeholders = DeTable::parse(placeholders).ok();
        let mut table = self.table.clone();
        for _ in 0..MAX_ERRORS {
            let error = match T::deserialize(Deserializer::from(table.clone())) {
                Ok(value) => return Some(value),
                Err(error) => error,
            };
            let root = table.get_mut();
            let repaired = match missing(&error) {
                Some(key) => {
                    let mut path = error.span().and_then(|span| holder(root, span)).unwrap_or_default();
                    path.push(key.to_owned());
                    self.report_missing(&path, &error);
                    let placeholder = placeholders.as_ref().and_then(|all| entry(all.get_ref(), &path));
                    match placeholder {
                        Some(found) => insert(root, &path, found),
                        None => path.pop().is_some() && remove(root, &path),
                    }
                }
                None => {
                    let path = innermost(root, offset(&error)).unwrap_or_default();
                    self.report_wrong(&path, &error, known);
                    remove(root, &path)
                }
            };
            if !repaired {
                return None;
            }
        }
        None
    }

    fn report_missing(&mut self, path: &[String], error: &Error) {
        if !self.is_reported(path) {
            self.reported.push(path.to_vec());
            let problem = ConfigError::parse(self.path, self.text, error.span(), plain(error), "");
            self.problems.push((offset(error), problem));
        }
    }

    /// Records an invalid entry. An entry that is invalid only because one of its own entries was removed is not reported.
    fn report_wrong(&mut self, path: &[String], error: &Error, known: &KnownKeys) {
        if !path.is_empty() {
            let follows = self.reported.iter().any(|reported| reported.starts_with(path));
            self.reported.push(path.to_vec());
            if follows {
                return;
            }
        }
        let (mut message, mut key) = (plain(error), path.join("."));
        if let Some(unknown) = hints::Unknown::from_message(&message) {
            let (holder, hint) = unknown.hint(path, known);
            // A key that is misspelt is not reported as missing too.
            self.reported.extend(hint.replacement.map(|name| [holder.as_slice(), &[name]].concat()));
            let is_key = unknown.is_key();
            // The message already says what to do.
            if !message.contains("; ") {
                message += &hint.text;
            }
            if is_key {
                key.clear();
            }
        }
        let problem = ConfigError::parse(self.path, self.text, error.span(), message, &key);
        self.problems.push((offset(error), problem));
    }

    fn is_reported(&self, path: &[String]) -> bool {
        self.reported.iter().any(|reported| path.starts_with(reported))
    }

    /// Compares the numbers of the file with the ranges of [`ranges`]. A number that is possible but unusual gives a warning. `walk`
    /// is the table that has the keys of `[walk]`.
    pub fn check_ranges(&mut self, walk: &str) -> Vec<Warning> {
        let mut warnings = Vec::new();
        for RangedNumber { range, key, value, offset } in
            ranges::numbers_with_ranges(self.table.get_ref(), walk)
        {
            let path: Vec<_> = key.split('.').map(str::to_owned).collect();
            if self.is_reported(&path) {
                continue;
            }
            if !range.is_possible(value) {
                self.push(offset, (key, range.written(value), range.expected()));
            } else if !range.is_usual(value) {
                warnings.push(Warning { at: self.location(offset), key, message: range.unusual(value) });
            }
        }
        warnings
    }

    /// Checks the rules between keys, unless the file has other errors, on which their results may depend.
    pub fn check_rules(&mut self, rules: impl FnOnce() -> Vec<InvalidValue>) {
        if self.problems.is_empty() {
            for wrong in rules() {
                self.push(self.offset_of(&wrong.0), wrong);
            }
        }
    }

    /// Refuses every text that begins with [`FILL_IN`].
    pub fn refuse_unfilled(&mut self) {
        let mut found = Vec::new();
        unfilled_in("", self.table.get_ref(), &mut found);
        found.into_iter().for_each(|(offset, wrong)| self.push(offset, wrong));
    }

    fn push(&mut self, offset: usize, (key, found, expected): InvalidValue) {
        let at = if self.table.get_ref().is_empty() {
            self.path.display().to_string()
        } else {
            self.location(offset)
        };
        self.problems.push((offset, ConfigError::Value { at, key, found, expected }));
    }

    fn location(&self, offset: usize) -> String {
        super::location_of_offset(self.path, self.text, offset)
    }

    fn offset_of(&self, key: &str) -> usize {
        offset_of_key(self.table.get_ref(), key).unwrap_or_default()
    }

    /// Ends the reading.
    ///
    /// # Errors
    /// All errors that were collected, in the order of the file.
    pub fn finish(mut self) -> Result<(), ConfigError> {
        self.problems.sort_by_key(|(offset, _)| *offset);
        ConfigError::all(self.path, self.problems).map_or(Ok(()), Err)
    }
}

/// Adds the values of a table that begin with [`FILL_IN`], with their offsets. `above` is the dotted key of the table.
fn unfilled_in(above: &str, table: &DeTable<'_>, found: &mut Vec<(usize, InvalidValue)>) {
    for (key, value) in table.iter() {
        let key =
            if above.is_empty() { key.get_ref().to_string() } else { format!("{above}.{}", key.get_ref()) };
        unfilled(&key, value, found);
    }
}

fn unfilled(key: &str, value: &Spanned<DeValue<'_>>, found: &mut Vec<(usize, InvalidValue)>) {
    match value.get_ref() {
        DeValue::String(text) => {
            if let Some(expected) = text.strip_prefix(FILL_IN) {
                let wrong = (key.to_owned(), "not filled in yet".to_owned(), expected.to_owned());
                found.push((value.span().start, wrong));
            }
        }
        DeValue::Array(values) => values.iter().for_each(|value| unfilled(key, value, found)),
        DeValue::Table(inner) => unfilled_in(key, inner, found),
        _ => {}
    }
}

fn offset(error: &Error) -> usize {
    error.span().map_or(0, |span| span.start)
}

fn plain(error: &Error) -> String {
    translated(&error.message().trim().replace('\n', "; "))
}

/// The key that is missing, if the error is about one.
fn missing(error: &Error) -> Option<&str> {
    error.message().strip_prefix("missing field `")?.split('`').next()
}

/// The path of the table at exactly this span.
fn holder(table: &DeTable<'_>, span: std::ops::Range<usize>) -> Option<Vec<String>> {
    table.iter().find_map(|(key, value)| {
        let DeValue::Table(inner) = value.get_ref() else { return None };
        let path = holder(inner, span.clone()).or_else(|| (value.span() == span).then(Vec::new));
        path.map(|path| [vec![key.get_ref().to_string()], path].concat())
    })
}

/// The path of the innermost entry whose key or value contains this offset.
fn innermost(table: &DeTable<'_>, offset: usize) -> Option<Vec<String>> {
    let inside = table.iter().find_map(|(key, value)| match value.get_ref() {
        DeValue::Table(inner) => {
            innermost(inner, offset).map(|path| [vec![key.get_ref().to_string()], path].concat())
        }
        _ => None,
    });
    inside.or_else(|| {
        let here = |(key, value): &(&Spanned<_>, &Spanned<_>)| {
            key.span().contains(&offset) || value.span().contains(&offset)
        };
        table.iter().find(here).map(|(key, _)| vec![key.get_ref().to_string()])
    })
}

/// The table that contains the last key of a path.
fn parent<'t, 'a>(table: &'t mut DeTable<'a>, path: &[String]) -> Option<&'t mut DeTable<'a>> {
    let Some((first, rest)) = path.split_first().filter(|(_, rest)| !rest.is_empty()) else {
        return Some(table);
    };
    match table.get_mut(first.as_str())?.get_mut() {
        DeValue::Table(inner) => parent(inner, rest),
        _ => None,
    }
}

fn remove(table: &mut DeTable<'_>, path: &[String]) -> bool {
    let removed = path.last().and_then(|last| parent(table, path)?.remove(last.as_str()));
    removed.is_some()
}

type Entry<'a> = (Spanned<std::borrow::Cow<'a, str>>, Spanned<DeValue<'a>>);

fn entry<'a>(table: &DeTable<'a>, path: &[String]) -> Option<Entry<'a>> {
    let (first, rest) = path.split_first()?;
    let (key, value) = table.get_key_value(first.as_str())?;
    match value.get_ref() {
        _ if rest.is_empty() => Some((key.clone(), value.clone())),
        DeValue::Table(inner) => entry(inner, rest),
        _ => None,
    }
}

fn insert<'a>(table: &mut DeTable<'a>, path: &[String], (key, value): Entry<'a>) -> bool {
    parent(table, path).is_some_and(|table| table.insert(key, value).is_none())
}

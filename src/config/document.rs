//! A TOML file as it is read: everything that is wrong with it, told at once.
//!
//! serde stops at the first error. So the entry that it stops at is noted and taken out of the parsed file, or replaced by a
//! stand-in where it has to be there, and the rest is read again, until nothing is left to complain about.

use std::path::Path;

use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeTable, DeValue, Deserializer, Error};

use super::error::{ConfigError, Wrong, line_and_column, nearest, translated};
use super::hints::{self, KnownKeys};
use super::ranges::{self, Found};
use super::warning::Warning;

/// More errors than this are not what a person made.
const MOST_ERRORS: usize = 100;

/// Errors of syntax that are told: a quote or a bracket too few makes one of every line behind it.
const MOST_SYNTAX_ERRORS: usize = 3;

/// A parsed file, and what was found wrong with it.
pub struct Document<'a> {
    path: &'a Path,
    text: &'a str,
    /// As it stands in the file.
    table: Spanned<DeTable<'a>>,
    /// With where they are, to be told in the order of the file.
    problems: Vec<(usize, ConfigError)>,
    /// Paths of what was wrong or missing: nothing more is to be said of them.
    noted: Vec<Vec<String>>,
}

impl<'a> Document<'a> {
    /// Parses the text of a file.
    ///
    /// # Errors
    /// What is no TOML, a line each.
    pub fn parse(path: &'a Path, text: &'a str) -> Result<Self, ConfigError> {
        let (table, errors) = DeTable::parse_recoverable(text);
        let mut problems: Vec<_> = errors
            .iter()
            .map(|error| (offset(error), ConfigError::parse(path, text, error.span(), plain(error), "")))
            .collect();
        problems.sort_by_key(|(offset, _)| *offset);
        // What follows on the same line follows from the first, and so does most of what comes behind.
        problems.dedup_by_key(|(offset, _)| line_and_column(text, *offset).0);
        problems.truncate(MOST_SYNTAX_ERRORS);
        match ConfigError::all(path, problems) {
            Some(error) => Err(error),
            None => Ok(Self { path, text, table, problems: Vec::new(), noted: Vec::new() }),
        }
    }

    /// Reads it, with values from `stand_ins`, a valid file, for those that have to be there and are wrong or missing. Notes
    /// everything that is wrong; `None` if so much is that nothing can be read.
    pub fn read<T: DeserializeOwned>(&mut self, stand_ins: &str, known: &KnownKeys) -> Option<T> {
        let stand_ins = DeTable::parse(stand_ins).ok();
        let mut table = self.table.clone();
        for _ in 0..MOST_ERRORS {
            let error = match T::deserialize(Deserializer::from(table.clone())) {
                Ok(value) => return Some(value),
                Err(error) => error,
            };
            let root = table.get_mut();
            let repaired = match missing(&error) {
                Some(key) => {
                    let mut path = error.span().and_then(|span| holder(root, span)).unwrap_or_default();
                    path.push(key.to_owned());
                    self.note_missing(&path, &error);
                    let stand_in = stand_ins.as_ref().and_then(|all| entry(all.get_ref(), &path));
                    match stand_in {
                        Some(found) => insert(root, &path, found),
                        None => path.pop().is_some() && remove(root, &path),
                    }
                }
                None => {
                    let path = innermost(root, offset(&error)).unwrap_or_default();
                    self.note_wrong(&path, &error, known);
                    remove(root, &path)
                }
            };
            if !repaired {
                return None;
            }
        }
        None
    }

    fn note_missing(&mut self, path: &[String], error: &Error) {
        if !self.is_noted(path) {
            self.noted.push(path.to_vec());
            let problem = ConfigError::parse(self.path, self.text, error.span(), plain(error), "");
            self.problems.push((offset(error), problem));
        }
    }

    /// An entry is taken out with what is in it, and may then be wrong for that.
    fn note_wrong(&mut self, path: &[String], error: &Error, known: &KnownKeys) {
        if !path.is_empty() {
            let follows = self.noted.iter().any(|noted| noted.starts_with(path));
            self.noted.push(path.to_vec());
            if follows {
                return;
            }
        }
        let (mut message, mut key) = (plain(error), path.join("."));
        if let Some(unknown) = hints::Unknown::of(&message) {
            let (holder, hint) = unknown.hint(path, known);
            // What is spelt wrongly is not missing as well.
            self.noted.extend(hint.instead.map(|name| [holder.as_slice(), &[name]].concat()));
            let is_key = unknown.is_key();
            // A message that says what to do needs no more.
            if !message.contains("; ") {
                message += &hint.words;
            }
            if is_key {
                key.clear();
            }
        }
        let problem = ConfigError::parse(self.path, self.text, error.span(), message, &key);
        self.problems.push((offset(error), problem));
    }

    fn is_noted(&self, path: &[String]) -> bool {
        self.noted.iter().any(|noted| path.starts_with(noted))
    }

    /// Compares the numbers of the file with the ranges of [`ranges`]; what is possible but unusual is a warning. `walk` is the
    /// table that has the keys of `[walk]`.
    pub fn check_ranges(&mut self, walk: &str) -> Vec<Warning> {
        let mut warnings = Vec::new();
        for Found { range, key, value, offset } in ranges::found(self.table.get_ref(), walk) {
            let path: Vec<_> = key.split('.').map(str::to_owned).collect();
            if self.is_noted(&path) {
                continue;
            }
            if !range.is_possible(value) {
                self.push(offset, (key, range.written(value), range.expected()));
            } else if !range.is_usual(value) {
                warnings.push(Warning { at: self.at(offset), key, message: range.unusual(value) });
            }
        }
        warnings
    }

    /// Notes values that do not go with the others, unless something is to be put right first that they may depend on.
    pub fn check_rules(&mut self, rules: impl FnOnce() -> Vec<Wrong>) {
        if self.problems.is_empty() {
            for wrong in rules() {
                self.push(self.offset_of(&wrong.0), wrong);
            }
        }
    }

    fn push(&mut self, offset: usize, (key, found, expected): Wrong) {
        let at =
            if self.table.get_ref().is_empty() { self.path.display().to_string() } else { self.at(offset) };
        self.problems.push((offset, ConfigError::Value { at, key, found, expected }));
    }

    fn at(&self, offset: usize) -> String {
        super::place_of_offset(self.path, self.text, offset)
    }

    fn offset_of(&self, key: &str) -> usize {
        nearest(self.table.get_ref(), key).unwrap_or_default()
    }

    /// All that was found wrong, in the order of the file.
    ///
    /// # Errors
    /// Anything.
    pub fn finish(mut self) -> Result<(), ConfigError> {
        self.problems.sort_by_key(|(offset, _)| *offset);
        ConfigError::all(self.path, self.problems).map_or(Ok(()), Err)
    }
}

fn offset(error: &Error) -> usize {
    error.span().map_or(0, |span| span.start)
}

fn plain(error: &Error) -> String {
    translated(&error.message().trim().replace('\n', "; "))
}

/// The key that an error misses.
fn missing(error: &Error) -> Option<&str> {
    error.message().strip_prefix("missing field `")?.split('`').next()
}

/// The path of the table that stands exactly there.
fn holder(table: &DeTable<'_>, span: std::ops::Range<usize>) -> Option<Vec<String>> {
    table.iter().find_map(|(key, value)| {
        let DeValue::Table(inner) = value.get_ref() else { return None };
        let path = holder(inner, span.clone()).or_else(|| (value.span() == span).then(Vec::new));
        path.map(|path| [vec![key.get_ref().to_string()], path].concat())
    })
}

/// The path of the innermost entry whose key or value holds this place.
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

/// The table that has the last key of a path.
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

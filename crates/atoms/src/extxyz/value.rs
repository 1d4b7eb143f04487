//! Values of the comment line.

use std::fmt;

use serde_json::Value;

use crate::cell::Matrix3;

/// The value of a key in the comment line.
///
/// JSON objects and nulls (`_JSON {…}`) are kept as text and written back unchanged.
#[derive(Clone, Debug, PartialEq)]
pub enum ExtxyzValue {
    /// `T` or `F`; a key without a value is true.
    Bool(bool),
    /// An integer.
    Int(i64),
    /// A real number.
    Real(f64),
    /// Anything else.
    Text(String),
    /// A vector; a matrix is a list of its rows.
    List(Vec<ExtxyzValue>),
}

impl ExtxyzValue {
    /// The number, if it is one.
    pub fn number(&self) -> Option<f64> {
        match self {
            Self::Int(value) => Some(*value as f64),
            Self::Real(value) => Some(*value),
            _ => None,
        }
    }

    /// The numbers of a vector, or of a matrix row by row.
    pub fn numbers(&self) -> Option<Vec<f64>> {
        match self {
            Self::List(values) => {
                let rows: Option<Vec<_>> = values.iter().map(Self::numbers).collect();
                rows.map(|rows| rows.concat())
            }
            _ => self.number().map(|value| vec![value]),
        }
    }

    /// The text, if it is one.
    pub fn text(&self) -> Option<&str> {
        match self {
            Self::Text(text) => Some(text),
            _ => None,
        }
    }

    /// Parses the text after `=`, with quotes and escapes already resolved.
    ///
    /// The first that applies: integers (separated by white space or commas), reals, booleans, JSON after
    /// `_JSON `, text.
    pub(super) fn parse(text: &str) -> Self {
        let words = || text.split(|c: char| c.is_whitespace() || c == ',').filter(|word| !word.is_empty());
        all(words(), |word| word.parse().ok().map(Self::Int))
            .or_else(|| all(words(), |word| word.parse().ok().map(Self::Real)))
            .or_else(|| all(words(), |word| logical(word).map(Self::Bool)))
            .or_else(|| text.strip_prefix("_JSON ").and_then(Self::parse_json))
            .unwrap_or_else(|| Self::Text(text.to_owned()))
    }

    /// JSON made of numbers, booleans, strings and arrays of them.
    pub(super) fn parse_json(text: &str) -> Option<Self> {
        from_json(&serde_json::from_str(text).ok()?)
    }

    /// The text, before quotes and escapes, that [`ExtxyzValue::parse`] and ASE read as this value.
    ///
    /// `None` for a list whose rows differ in length, or that contains numbers that are not finite below its
    /// first level: JSON or ASE cannot represent them.
    pub(super) fn to_text(&self) -> Option<String> {
        match self {
            Self::Text(text) if !stays_text(text) => Some(format!("_JSON {}", json_string(text))),
            Self::List(values) if !is_plain_vector(values) => {
                self.shape().filter(|_| self.is_finite()).map(|_| format!("_JSON {self}"))
            }
            Self::List(values) => Some(values.iter().map(Self::to_string).collect::<Vec<_>>().join(" ")),
            _ => Some(self.to_string()),
        }
    }

    /// Lengths of nested lists; `None` if they are ragged.
    fn shape(&self) -> Option<Vec<usize>> {
        let Self::List(values) = self else { return Some(vec![]) };
        let mut shape = vec![values.len()];
        let inner: Option<Vec<_>> = values.iter().map(Self::shape).collect();
        let inner = inner?;
        shape.extend(inner.first().into_iter().flatten());
        inner.windows(2).all(|pair| pair[0] == pair[1]).then_some(shape)
    }

    fn is_finite(&self) -> bool {
        match self {
            Self::Real(value) => value.is_finite(),
            Self::List(values) => values.iter().all(Self::is_finite),
            _ => true,
        }
    }
}

/// As in the comment line, before quotes; lists as in JSON.
impl fmt::Display for ExtxyzValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bool(value) => f.write_str(if *value { "T" } else { "F" }),
            Self::Int(value) => write!(f, "{value}"),
            Self::Real(value) => write!(f, "{value:?}"),
            Self::Text(text) => f.write_str(text),
            Self::List(values) => {
                let items: Vec<_> = values.iter().map(json_item).collect();
                write!(f, "[{}]", items.join(", "))
            }
        }
    }
}

fn json_item(value: &ExtxyzValue) -> String {
    match value {
        ExtxyzValue::Bool(value) => value.to_string(),
        ExtxyzValue::Text(text) => json_string(text),
        _ => value.to_string(),
    }
}

/// One value for a single word, a list for several; `None` if a word has another type.
fn all<'a>(
    words: impl Iterator<Item = &'a str>,
    parse: impl Fn(&str) -> Option<ExtxyzValue>,
) -> Option<ExtxyzValue> {
    let mut values = words.map(parse).collect::<Option<Vec<_>>>()?;
    match values.len() {
        0 | 1 => values.pop(),
        _ => Some(ExtxyzValue::List(values)),
    }
}

/// Parses a boolean in any of its spellings.
pub(super) fn logical(word: &str) -> Option<bool> {
    match word {
        "T" | "true" | "True" | "TRUE" => Some(true),
        "F" | "false" | "False" | "FALSE" => Some(false),
        _ => None,
    }
}

fn from_json(json: &Value) -> Option<ExtxyzValue> {
    match json {
        Value::Null | Value::Object(_) => None,
        Value::Bool(value) => Some(ExtxyzValue::Bool(*value)),
        Value::Number(number) if number.is_f64() => number.as_f64().map(ExtxyzValue::Real),
        Value::Number(number) => number.as_i64().map(ExtxyzValue::Int),
        Value::String(text) => Some(ExtxyzValue::Text(text.clone())),
        Value::Array(values) => values.iter().map(from_json).collect::<Option<_>>().map(ExtxyzValue::List),
    }
}

/// At least two numbers or booleans of one type, which need no JSON.
fn is_plain_vector(values: &[ExtxyzValue]) -> bool {
    values.len() > 1
        && (values.iter().all(|value| matches!(value, ExtxyzValue::Bool(_)))
            || values.iter().all(|value| matches!(value, ExtxyzValue::Int(_)))
            || values.iter().all(|value| matches!(value, ExtxyzValue::Real(_))))
}

/// Whether the bare text is read back as the same text, also by ASE.
///
/// Python parses `1_000` as a number, and non-ASCII files depend on the locale.
fn stays_text(text: &str) -> bool {
    let printable = text.bytes().all(|byte| (b' '..=b'~').contains(&byte));
    let number = matches!(
        ExtxyzValue::parse(&text.replace('_', "")),
        ExtxyzValue::Int(_) | ExtxyzValue::Real(_) | ExtxyzValue::List(_)
    );
    let words = text.contains(|c| c != ' ' && c != ',');
    let json = text.strip_prefix("_JSON ").is_none_or(|json| serde_json::from_str::<Value>(json).is_ok());
    printable && words && !number && json && ExtxyzValue::parse(text) == ExtxyzValue::Text(text.to_owned())
}

/// A JSON string in ASCII.
fn json_string(text: &str) -> String {
    let mut quoted = String::from("\"");
    for unit in text.encode_utf16() {
        match char::from_u32(u32::from(unit)) {
            Some(c @ ('"' | '\\')) => quoted.extend(['\\', c]),
            Some(c @ ' '..='~') => quoted.push(c),
            _ => quoted.push_str(&format!("\\u{unit:04x}")),
        }
    }
    quoted.push('"');
    quoted
}

impl From<bool> for ExtxyzValue {
    fn from(value: bool) -> Self {
        Self::Bool(value)
    }
}

impl From<i64> for ExtxyzValue {
    fn from(value: i64) -> Self {
        Self::Int(value)
    }
}

impl From<f64> for ExtxyzValue {
    fn from(value: f64) -> Self {
        Self::Real(value)
    }
}

impl From<&str> for ExtxyzValue {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

impl From<String> for ExtxyzValue {
    fn from(text: String) -> Self {
        Self::Text(text)
    }
}

impl<T: Into<ExtxyzValue>> From<Vec<T>> for ExtxyzValue {
    fn from(values: Vec<T>) -> Self {
        Self::List(values.into_iter().map(Into::into).collect())
    }
}

impl From<Matrix3> for ExtxyzValue {
    fn from(matrix: Matrix3) -> Self {
        matrix.map(|row| Self::from(row.to_vec())).to_vec().into()
    }
}

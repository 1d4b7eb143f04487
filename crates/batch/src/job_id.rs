//! Ids of jobs.

use std::cmp::Ordering;
use std::fmt;

use serde::{Deserialize, Serialize};

/// The id of a job, as its batch system writes it: `1234`, `1234.server`. It consists of ASCII letters, digits, `.`, `_` and
/// `-`, so that it can stand in any command. Ids are ordered by the number with which they begin: the oldest job comes first.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct JobId(String);

impl JobId {
    /// The id with which the text begins, after white space; `None` if there is none. A dot at its end is that of a sentence.
    pub fn at_start_of(text: &str) -> Option<Self> {
        let text = text.trim_start();
        let end = text.find(|c: char| !is_part(c)).unwrap_or(text.len());
        let id = text[..end].trim_end_matches(['.', '-']);
        id.contains(|c: char| c.is_ascii_alphanumeric()).then(|| Self(id.to_owned()))
    }

    /// The id.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// The id as a number, if it is one.
    pub fn number(&self) -> Option<u64> {
        self.0.parse().ok()
    }

    /// The number with which it begins.
    fn first_number(&self) -> u64 {
        let end = self.0.find(|c: char| !c.is_ascii_digit()).unwrap_or(self.0.len());
        self.0[..end].parse().unwrap_or(0)
    }
}

fn is_part(c: char) -> bool {
    c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-')
}

impl From<u64> for JobId {
    fn from(number: u64) -> Self {
        Self(number.to_string())
    }
}

impl TryFrom<String> for JobId {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        match Self::at_start_of(&text) {
            Some(id) if id.0 == text => Ok(id),
            _ => Err(format!("{text:?} is not the id of a job")),
        }
    }
}

impl fmt::Display for JobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.0)
    }
}

impl Ord for JobId {
    fn cmp(&self, other: &Self) -> Ordering {
        (self.first_number(), &self.0).cmp(&(other.first_number(), &other.0))
    }
}

impl PartialOrd for JobId {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_ends_where_no_id_can_go_on() {
        for (text, expected) in [
            ("1234.server.example\n", Some("1234.server.example")),
            ("1234> is submitted", Some("1234")),
            ("  12.", Some("12")),
            ("job-7_a", Some("job-7_a")),
            ("1234[].server", Some("1234")),
            ("", None),
            ("> 12", None),
            ("...", None),
        ] {
            assert_eq!(JobId::at_start_of(text).as_ref().map(JobId::as_str), expected, "{text}");
        }
        assert!(JobId::try_from("12 3".to_owned()).is_err() && JobId::try_from(String::new()).is_err());
    }

    #[test]
    fn the_oldest_job_comes_first() {
        let mut ids = ["100.a", "9.a", "20.b", "20.a"].map(|id| JobId::at_start_of(id).unwrap());
        ids.sort();
        assert_eq!(ids.map(|id| id.to_string()), ["9.a", "20.a", "20.b", "100.a"]);
        assert_eq!((JobId::from(12).number(), JobId::at_start_of("9.a").unwrap().number()), (Some(12), None));
    }
}

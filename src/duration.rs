//! Wall-clock times with their unit, in the configuration and on the command line: "90s", "10m", "2h 30m".

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::de::{Error, Unexpected, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A wall-clock time that is written with its unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, JsonSchema)]
#[schemars(
    with = "String",
    extend("pattern" = r"^\s*[0-9][0-9\s.a-zA-Zµ]*[a-zA-Zµ]\s*$", "examples" = ["90s", "10m", "2h 30m"])
)]
pub struct Duration(std::time::Duration);

/// What a value looks like, for error messages.
const EXPECTED: &str = "a time with its unit, such as \"90s\", \"10m\" or \"2h\"";

impl Duration {
    /// So many seconds.
    pub const fn from_seconds(seconds: u64) -> Self {
        Self(std::time::Duration::from_secs(seconds))
    }

    /// The same with a fraction; a negative number is none.
    pub fn from_fractional_seconds(seconds: f64) -> Self {
        Self(std::time::Duration::try_from_secs_f64(seconds).unwrap_or_default())
    }

    /// As the standard library has it.
    pub const fn get(self) -> std::time::Duration {
        self.0
    }

    /// In seconds.
    pub fn seconds(self) -> f64 {
        self.0.as_secs_f64()
    }
}

impl FromStr for Duration {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        humantime::parse_duration(text).map(Self).map_err(|_| format!("found '{text}', expected {EXPECTED}"))
    }
}

impl fmt::Display for Duration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        humantime::format_duration(self.0).fmt(f)
    }
}

impl Serialize for Duration {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Duration {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct DurationVisitor;
        impl Visitor<'_> for DurationVisitor {
            type Value = Duration;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(EXPECTED)
            }

            fn visit_str<E: Error>(self, text: &str) -> Result<Duration, E> {
                text.parse().map_err(|_| E::invalid_value(Unexpected::Str(text), &self))
            }
        }
        deserializer.deserialize_str(DurationVisitor)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_and_written_with_their_unit() {
        for (text, seconds, written) in [
            ("90s", 90.0, "1m 30s"),
            ("10m", 600.0, "10m"),
            ("2h 30m", 9000.0, "2h 30m"),
            ("1500ms", 1.5, "1s 500ms"),
        ] {
            let duration: Duration = text.parse().unwrap();
            assert_eq!((duration.seconds(), duration.to_string().as_str()), (seconds, written));
            assert_eq!(duration.to_string().parse(), Ok(duration));
        }
        for text in ["10", "", "m", "-3s", "10 parsecs"] {
            let error = text.parse::<Duration>().unwrap_err();
            assert!(error.contains("such as"), "{error}");
        }
    }
}

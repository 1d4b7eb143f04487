//! The share of a process in a build that several hosts make together.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Every n-th shard, from shard i − 1: part i of n.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct BuildPart {
    /// i, from 1.
    number: u64,
    /// Number of parts.
    of: u64,
}

/// More parts than any cluster has.
const MAX_PARTS: u64 = 100_000;

impl BuildPart {
    /// All shards.
    pub const WHOLE: Self = Self { number: 1, of: 1 };

    /// All parts of a build in `of` parts.
    pub fn all(of: u64) -> impl Iterator<Item = Self> {
        (1..=of).map(move |number| Self { number, of })
    }

    /// Whether it has this shard.
    pub fn has(self, shard: u64) -> bool {
        shard % self.of == self.number - 1
    }

    /// Number of its shards if there are `shards` in all.
    pub fn count(self, shards: u64) -> u64 {
        (shards + self.of - self.number) / self.of
    }

    /// Number of parts.
    pub fn total(self) -> u64 {
        self.of
    }

    /// Its name in file names, such as `2of8`.
    pub fn file_name(self) -> String {
        format!("{}of{}", self.number, self.of)
    }

    /// From its name in file names.
    pub fn from_file_name(name: &str) -> Option<Self> {
        let (number, of) = name.split_once("of")?;
        Self::new(number.parse().ok()?, of.parse().ok()?)
    }

    fn new(number: u64, of: u64) -> Option<Self> {
        ((1..=of).contains(&number) && of <= MAX_PARTS).then_some(Self { number, of })
    }
}

/// `2/8`
impl fmt::Display for BuildPart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.of)
    }
}

impl FromStr for BuildPart {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers =
            text.split_once('/').and_then(|(number, of)| Self::new(number.parse().ok()?, of.parse().ok()?));
        numbers.ok_or_else(|| "expected i/n with 1 ≤ i ≤ n, such as 2/8".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_shard_is_in_one_part() {
        for of in 1..8 {
            for shards in 0..20 {
                let counts: Vec<u64> = BuildPart::all(of).map(|part| part.count(shards)).collect();
                assert_eq!(counts.iter().sum::<u64>(), shards);
                for (part, count) in BuildPart::all(of).zip(counts) {
                    assert_eq!((0..shards).filter(|shard| part.has(*shard)).count() as u64, count);
                }
            }
        }
    }

    #[test]
    fn names_are_read_back() {
        let part: BuildPart = "2/8".parse().unwrap();
        assert_eq!((part.to_string(), part.file_name()), ("2/8".to_owned(), "2of8".to_owned()));
        assert_eq!(BuildPart::from_file_name("2of8"), Some(part));
        for wrong in ["", "2", "0/8", "9/8", "1/0", "-1/2", "a/b", "1/100001", "1.5/2"] {
            assert!(wrong.parse::<BuildPart>().is_err(), "{wrong}");
        }
        assert_eq!(BuildPart::from_file_name("0of2"), None);
    }
}

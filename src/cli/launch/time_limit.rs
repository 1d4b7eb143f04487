//! Time limits of jobs.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use crate::duration;

/// The time limit of a job: `"24h"`, or in a format of `sbatch` that says its units.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimeLimit(pub Duration);

impl FromStr for TimeLimit {
    type Err = String;

    /// Parses a time with its unit, `minutes:seconds`, `hours:minutes:seconds`, `days-hours`, `days-hours:minutes` or `days-hours:minutes:seconds`.
    fn from_str(text: &str) -> Result<Self, String> {
        let found = match text.contains([':', '-']) {
            true => seconds(text).map(Duration::from_secs),
            false => text.parse::<duration::Duration>().ok().map(duration::Duration::get),
        };
        found.filter(|limit| !limit.is_zero()).map(Self).ok_or_else(|| {
            "expected a time with its unit, such as 24h, or hours:minutes:seconds, such as 24:00:00"
                .to_owned()
        })
    }
}

/// As `sbatch` takes it, `days-hours:minutes:seconds`. A part of a second counts as a whole one.
impl fmt::Display for TimeLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = self.0.as_secs() + u64::from(self.0.subsec_nanos() > 0);
        let (days, rest) = (seconds / 86_400, seconds % 86_400);
        write!(f, "{days}-{:02}:{:02}:{:02}", rest / 3600, rest / 60 % 60, rest % 60)
    }
}

fn seconds(text: &str) -> Option<u64> {
    let (days, rest) = match text.split_once('-') {
        Some((days, rest)) => (Some(number(days)?), rest),
        None => (None, text),
    };
    let parts = rest.split(':').map(number).collect::<Option<Vec<_>>>()?;
    let of_day = match (&parts[..], days) {
        ([minutes, seconds], None) => minutes.checked_mul(60)?.checked_add(*seconds)?,
        ([hours], Some(_)) => hours.checked_mul(3600)?,
        ([hours, minutes], Some(_)) => hours.checked_mul(3600)?.checked_add(minutes * 60)?,
        ([hours, minutes, seconds], _) => {
            hours.checked_mul(3600)?.checked_add(minutes.checked_mul(60)?)?.checked_add(*seconds)?
        }
        _ => return None,
    };
    days.unwrap_or(0).checked_mul(86_400)?.checked_add(of_day)
}

/// A number of at most nine digits.
fn number(text: &str) -> Option<u64> {
    let is_number = (1..=9).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_digit());
    text.parse().ok().filter(|_| is_number)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_limits_have_units_or_the_format_of_sbatch() {
        for (text, expected) in [
            ("90m", Some((5400, "0-01:30:00"))),
            ("1day 2h", Some((93_600, "1-02:00:00"))),
            ("1:30", Some((90, "0-00:01:30"))),
            ("24:00:00", Some((86_400, "1-00:00:00"))),
            ("1-2", Some((93_600, "1-02:00:00"))),
            ("1-02:03", Some((93_780, "1-02:03:00"))),
            ("1-02:03:04", Some((93_784, "1-02:03:04"))),
            ("90", None),
            ("0", None),
            ("0:00", None),
            ("", None),
            ("1:2:3:4", None),
            ("+5", None),
            ("1-", None),
            ("9999999999:00", None),
        ] {
            let found = text.parse::<TimeLimit>().ok();
            let expected =
                expected.map(|(seconds, written)| (Duration::from_secs(seconds), written.to_owned()));
            assert_eq!(found.map(|limit| (limit.0, limit.to_string())), expected, "{text}");
        }
    }
}

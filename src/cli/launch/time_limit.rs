//! Time limits in the format of `sbatch`.

use std::time::Duration;

use crate::exit_status::CommandError;

/// Parses `minutes`, `minutes:seconds`, `hours:minutes:seconds`, `days-hours`, `days-hours:minutes` or
/// `days-hours:minutes:seconds`.
///
/// # Errors
/// Another text.
pub fn time_limit(text: &str) -> Result<Duration, CommandError> {
    seconds(text).filter(|seconds| *seconds > 0).map(Duration::from_secs).ok_or_else(|| {
        CommandError::Input(format!(
            "--time {text}: expected minutes, hours:minutes:seconds or days-hours:minutes:seconds, such as 24:00:00"
        ))
    })
}

fn seconds(text: &str) -> Option<u64> {
    let (days, rest) = match text.split_once('-') {
        Some((days, rest)) => (Some(number(days)?), rest),
        None => (None, text),
    };
    let parts = rest.split(':').map(number).collect::<Option<Vec<_>>>()?;
    let of_day = match (&parts[..], days) {
        ([minutes], None) => minutes.checked_mul(60)?,
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
    fn time_limits_are_read_as_sbatch_reads_them() {
        for (text, expected) in [
            ("90", Some(5400)),
            ("1:30", Some(90)),
            ("24:00:00", Some(86_400)),
            ("1-2", Some(93_600)),
            ("1-02:03", Some(93_780)),
            ("1-02:03:04", Some(93_784)),
            ("0", Some(0)),
            ("", None),
            ("1:2:3:4", None),
            ("+5", None),
            ("2h", None),
            ("1-", None),
            ("9999999999", None),
        ] {
            assert_eq!(seconds(text), expected, "{text}");
        }
        assert!(time_limit("0").is_err());
    }
}

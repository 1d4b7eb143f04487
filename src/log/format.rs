//! Formats a line of the log.

use std::fmt::{Debug, Write};

use serde_json::{Map, Value};
use tracing::Level;
use tracing::field::{Field, Visit};

const DAY: i64 = 86_400_000;

/// Message and named values of an event.
#[derive(Debug, Default)]
pub struct Fields {
    message: String,
    named: Map<String, Value>,
}

/// An event with its source.
#[derive(Debug)]
pub struct LogLine<'a> {
    /// ms since 1970.
    pub time: i64,
    pub level: Level,
    /// Name of the process, such as `walker 3`.
    pub process: &'a str,
    pub pid: u32,
    /// Module of the event.
    pub target: &'a str,
    pub fields: Fields,
}

/// zenoh adds this hint whenever it cannot accept a connection, even if a certificate was refused.
const FILE_LIMIT_HINT: &str = ". Hint: increase the system open file limit.";

impl Fields {
    /// Removes a hint that does not apply.
    pub fn remove_wrong_hint(&mut self) {
        let is_right = |why: &str| why.contains("(os error 23)") || why.contains("(os error 24)");
        if let Some(why) = self.message.strip_suffix(FILE_LIMIT_HINT)
            && !is_right(why)
        {
            self.message = format!("a connection was refused: {why}");
        }
    }
}

impl LogLine<'_> {
    /// Text for people, escaped to one line.
    pub fn text(&self) -> String {
        let Self { time, level, process, pid, fields, .. } = self;
        let mut text = format!("{} {level:<5} {process} [{pid}] ", format_utc(*time));
        for character in fields.message.chars() {
            match character.is_control() {
                true => text.extend(character.escape_default()),
                false => text.push(character),
            }
        }
        for (name, value) in &fields.named {
            // Writing to a string cannot fail.
            let _ = write!(text, " {name}={value}");
        }
        text.push('\n');
        text
    }

    /// One JSON object.
    pub fn json(&self) -> String {
        let Self { time, level, process, pid, target, fields } = self;
        let object = serde_json::json!({
            "time": format_utc(*time), "level": level.as_str().to_lowercase(), "process": process, "pid": pid,
            "target": target, "message": fields.message, "fields": fields.named,
        });
        format!("{object}\n")
    }
}

impl Visit for Fields {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        match field.name() {
            "message" => self.message = format!("{value:?}"),
            // Metadata of messages from the crate `log`.
            name if name.starts_with("log.") => {}
            name => drop(self.named.insert(name.to_owned(), format!("{value:?}").into())),
        }
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        match field.name() {
            "message" => self.message = value.to_owned(),
            name => drop(self.named.insert(name.to_owned(), value.into())),
        }
    }

    fn record_f64(&mut self, field: &Field, value: f64) {
        self.named.insert(field.name().to_owned(), value.into());
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.named.insert(field.name().to_owned(), value.into());
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.named.insert(field.name().to_owned(), value.into());
    }

    fn record_bool(&mut self, field: &Field, value: bool) {
        self.named.insert(field.name().to_owned(), value.into());
    }
}

/// Formats ms since 1970 as 2026-03-01T12:00:00.250Z (RFC 3339).
pub fn format_utc(milliseconds: i64) -> String {
    let (year, month, day) = date(milliseconds.div_euclid(DAY));
    let of_day = milliseconds.rem_euclid(DAY);
    let (hour, minute) = (of_day / 3_600_000, of_day / 60_000 % 60);
    let (second, thousandth) = (of_day / 1000 % 60, of_day % 1000);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}.{thousandth:03}Z")
}

/// Gregorian date of a day counted from 1970-01-01. Years start in March here, so that a leap day comes last.
fn date(day: i64) -> (i64, i64, i64) {
    // Days from 0000-03-01; 400 years have 146 097 days.
    let day = day + 719_468;
    let (era, day) = (day.div_euclid(146_097), day.rem_euclid(146_097));
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    // Month lengths from March are 31, 30, 31, 30, 31 twice, then 31 and the rest.
    let month = (5 * day + 2) / 153;
    let in_month = day - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    (400 * era + year + i64::from(month <= 2), month, in_month)
}

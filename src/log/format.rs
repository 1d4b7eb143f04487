//! Formats a line of the log.

use std::time::SystemTime;

use serde_json::{Map, Value, json};
use tracing::Event;
use tracing_serde::fields::AsMap;

use super::LogFormat;

/// zenoh adds this hint whenever it cannot accept a connection, even if a certificate was refused.
const FILE_LIMIT_HINT: &str = ". Hint: increase the system open file limit.";

/// The line of an event that happens now. `process` is the name of this process.
pub fn line(format: LogFormat, process: &str, event: &Event<'_>) -> String {
    let time = humantime::format_rfc3339_millis(SystemTime::now().max(SystemTime::UNIX_EPOCH));
    let (level, target, pid) = (event.metadata().level(), event.metadata().target(), std::process::id());
    let (message, fields) = message_and_fields(event);
    match format {
        LogFormat::Text => {
            let message = escape_control_characters(&message);
            let fields: String = fields.iter().map(|(name, value)| format!(" {name}={value}")).collect();
            format!("{time} {level:<5} {process} [{pid}] {message}{fields}\n")
        }
        LogFormat::Json => {
            let object = json!({
                "time": time.to_string(), "level": level.as_str().to_lowercase(), "process": process, "pid": pid,
                "target": target, "message": message, "fields": fields,
            });
            format!("{object}\n")
        }
    }
}

fn message_and_fields(event: &Event<'_>) -> (String, Map<String, Value>) {
    let Ok(Value::Object(mut fields)) = serde_json::to_value(event.field_map()) else {
        return (String::new(), Map::new());
    };
    match fields.remove("message") {
        Some(Value::String(message)) => (without_wrong_hint(message), fields),
        _ => (String::new(), fields),
    }
}

/// Removes a hint that does not apply.
fn without_wrong_hint(message: String) -> String {
    let is_right = |why: &str| why.contains("(os error 23)") || why.contains("(os error 24)");
    match message.strip_suffix(FILE_LIMIT_HINT) {
        Some(why) if !is_right(why) => format!("a connection was refused: {why}"),
        _ => message,
    }
}

fn escape_control_characters(message: &str) -> String {
    let mut text = String::with_capacity(message.len());
    for character in message.chars() {
        match character.is_control() {
            true => text.extend(character.escape_default()),
            false => text.push(character),
        }
    }
    text
}

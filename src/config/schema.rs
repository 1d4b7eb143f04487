//! The JSON schema of a campaign's configuration, from the types that are parsed and the ranges of their numbers.

use schemars::Schema;
use schemars::generate::SchemaSettings;
use schemars::transform::RecursiveTransform;
use serde_json::Value;

use super::Config;
use super::ranges::{RANGES, Range};

/// The schema, in the draft 7 that editors of TOML know.
pub fn schema() -> Value {
    let mut settings = SchemaSettings::draft07().with_transform(RecursiveTransform(as_toml));
    // Two keys of the same type may have different ranges.
    settings.inline_subschemas = true;
    let mut schema = settings.into_generator().into_root_schema_for::<Config>();
    schema.insert("title".into(), "Configuration of a calmwalk campaign".into());
    let mut schema = schema.to_value();
    for range in &RANGES {
        at_key(&mut schema, range.key, &mut |schema| restrict(schema, range));
    }
    schema
}

/// The schema as `calmwalk schema` prints it.
pub fn schema_text() -> String {
    format!("{:#}\n", schema())
}

/// Removes `none` from the thermostats: a campaign refuses it.
pub fn without_none(schema: &mut Schema) {
    if let Some(Value::Array(choices)) = schema.get_mut("oneOf") {
        choices.retain(|choice| choice["properties"].get("none").is_none());
    }
}

/// Calls `visit` with every schema of a dotted key.
pub(super) fn at_key(schema: &mut Value, key: &str, visit: &mut dyn FnMut(&mut Value)) {
    for choices in ["oneOf", "anyOf"] {
        let choices = schema.get_mut(choices).and_then(Value::as_array_mut);
        choices.into_iter().flatten().for_each(|choice| at_key(choice, key, visit));
    }
    if let Some(items) = schema.get_mut("items") {
        at_key(items, key, visit);
    }
    let (name, rest) = key.split_once('.').unwrap_or((key, ""));
    match schema.get_mut("properties").and_then(|properties| properties.get_mut(name)) {
        Some(property) if rest.is_empty() => visit(property),
        Some(property) => at_key(property, rest, visit),
        None => {}
    }
}

/// Adds the limits of a number, and to its description what limits cannot say.
fn restrict(schema: &mut Value, range: &Range) {
    let [least, most] = range.possible;
    if ["number", "integer"].iter().any(|name| schema["type"] == *name) {
        if least > 0.0 {
            schema.as_object_mut().map(|schema| schema.remove("exclusiveMinimum"));
            schema["minimum"] = number(least);
        }
        schema["maximum"] = number(most);
    }
    let description = schema["description"].as_str().unwrap_or_default();
    schema["description"] = format!("{description} {}", range.note()).trim_start().into();
}

/// Whole numbers without a decimal point.
fn number(x: f64) -> Value {
    if x.fract() == 0.0 { (x as u64).into() } else { x.into() }
}

/// Removes what has no meaning in TOML: null, the machine's format of a number, defaults of tables (their keys have
/// their own) and of required keys, and line breaks of comments.
fn as_toml(schema: &mut Schema) {
    schema.remove("format");
    if let Some(Value::String(description)) = schema.get_mut("description") {
        *description = description.replace('\n', " ");
    }
    let is_table = schema.get("properties").is_some();
    if is_table || schema.get("default").is_some_and(Value::is_null) {
        schema.remove("default");
    }
    if let Some(Value::Array(values)) = schema.get_mut("enum") {
        values.retain(|value| !value.is_null());
    }
    if let Some(Value::Array(types)) = schema.get_mut("type") {
        types.retain(|name| name != "null");
        if let [only] = types.as_slice() {
            let only = only.clone();
            schema.insert("type".into(), only);
        }
    }
    if let Some(Value::Array(choices)) = schema.get_mut("anyOf") {
        choices.retain(|choice| choice["type"] != "null");
        if let [Value::Object(only)] = choices.as_slice() {
            let only = only.clone();
            schema.remove("anyOf");
            let schema = schema.ensure_object();
            for (key, value) in only {
                schema.entry(key).or_insert(value);
            }
        }
    }
    let required = schema.get("required").and_then(Value::as_array).cloned().unwrap_or_default();
    for name in required.iter().filter_map(Value::as_str) {
        let key = schema.get_mut("properties").and_then(|properties| properties.get_mut(name));
        key.and_then(Value::as_object_mut).map(|key| key.remove("default"));
    }
}

//! The JSON schema of the configuration: the published copy is current, and it accepts what the program accepts.

use std::fs;
use std::path::Path;

use regex::Regex;
use serde_json::{Value, json};

use crate::common::{calmwalk, config, demo, succeed};

fn published() -> String {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/campaign.schema.json")).unwrap()
}

fn parsed(toml: &str) -> Value {
    serde_json::to_value(toml.parse::<toml::Table>().unwrap()).unwrap()
}

fn as_list(value: &Value) -> impl Iterator<Item = &Value> {
    value.as_array().into_iter().flatten()
}

/// Places where a value violates a schema. Supports only the keywords of this schema.
fn faults(schema: &Value, value: &Value, at: &str) -> Vec<String> {
    let mut faults = Vec::new();
    let mut expect = |holds: bool, what: &Value| {
        if !holds {
            faults.push(format!("{at}: {value} is not {what}"));
        }
    };
    let number = value.as_f64().unwrap_or(f64::NAN);
    let text = value.as_str().unwrap_or_default();
    let below = |limit: &Value| limit.as_f64().unwrap();
    for (keyword, rule) in schema.as_object().unwrap() {
        match keyword.as_str() {
            "type" => expect(is_of_type(value, rule.as_str().unwrap()), rule),
            "const" => expect(value == rule, rule),
            "enum" => expect(as_list(rule).any(|one| one == value), rule),
            "minimum" => expect(number >= below(rule), rule),
            "exclusiveMinimum" => expect(number > below(rule), rule),
            "maximum" => expect(number <= below(rule), rule),
            "exclusiveMaximum" => expect(number < below(rule), rule),
            "pattern" => expect(Regex::new(rule.as_str().unwrap()).unwrap().is_match(text), rule),
            "minItems" => expect(as_list(value).count() as u64 >= rule.as_u64().unwrap(), rule),
            "required" => {
                as_list(rule).for_each(|key| expect(value.get(key.as_str().unwrap()).is_some(), key))
            }
            "oneOf" => {
                expect(as_list(rule).filter(|one| faults_of(one, value).is_empty()).count() == 1, rule);
            }
            "anyOf" => expect(as_list(rule).any(|one| faults_of(one, value).is_empty()), rule),
            "$schema" | "title" | "description" | "default" | "examples" => {}
            "items" | "properties" | "patternProperties" | "additionalProperties" => {}
            unknown => panic!("{at}: the keyword {unknown}"),
        }
    }
    for (index, item) in as_list(value).enumerate().filter(|_| schema["items"].is_object()) {
        faults.extend(self::faults(&schema["items"], item, &format!("{at}[{index}]")));
    }
    for (key, inner) in value.as_object().into_iter().flatten() {
        let at = format!("{at}.{key}");
        match schema_of_key(schema, key) {
            Some(Value::Bool(false)) => faults.push(format!("{at}: unknown key")),
            Some(schema) if schema.is_object() => faults.extend(self::faults(schema, inner, &at)),
            _ => {}
        }
    }
    faults
}

fn faults_of(schema: &Value, value: &Value) -> Vec<String> {
    faults(schema, value, "")
}

fn is_of_type(value: &Value, name: &str) -> bool {
    match name {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_u64() || value.is_i64(),
        "number" => value.is_number(),
        unknown => panic!("the type {unknown}"),
    }
}

fn schema_of_key<'a>(schema: &'a Value, key: &str) -> Option<&'a Value> {
    let fitting = |(pattern, _): &(&String, &Value)| Regex::new(pattern).unwrap().is_match(key);
    let by_pattern =
        || schema["patternProperties"].as_object()?.iter().find(fitting).map(|(_, schema)| schema);
    schema["properties"].get(key).or_else(by_pattern).or_else(|| schema.get("additionalProperties"))
}

#[test]
fn the_published_schema_is_current() {
    let directory = tempfile::tempdir().unwrap();
    let printed = succeed(directory.path(), ["schema"]);
    assert!(printed == published(), "run `calmwalk schema > docs/campaign.schema.json`");
}

#[test]
fn every_campaign_of_the_project_is_valid() {
    let schema: Value = serde_json::from_str(&published()).unwrap();
    let mut campaigns = 0;
    for entry in fs::read_dir(config("")).unwrap() {
        let path = entry.unwrap().path();
        // The configurations of `calmwalk md` are not campaigns.
        let is_of_md = path.file_name().unwrap().to_string_lossy().starts_with("md-");
        if path.extension().is_some_and(|extension| extension == "toml") && !is_of_md {
            let mut text = fs::read_to_string(&path).unwrap();
            // A batch system is a table of a campaign.
            if path.ends_with("pbs.toml") || path.ends_with("lsf.toml") {
                text = demo("aluminium.toml") + &text;
            }
            assert_eq!(faults_of(&schema, &parsed(&text)), [""; 0], "{}", path.display());
            campaigns += 1;
        }
    }
    assert!(campaigns >= 4);
}

#[test]
fn init_writes_the_schema_and_a_campaign_that_names_it() {
    let directory = tempfile::tempdir().unwrap();
    succeed(directory.path(), ["init", "here"]);
    let text = fs::read_to_string(directory.path().join("here/campaign.toml")).unwrap();
    let path = text.lines().next().unwrap().strip_prefix("#:schema ").unwrap();
    let schema = fs::read_to_string(directory.path().join("here").join(path)).unwrap();
    assert_eq!(faults_of(&serde_json::from_str(&schema).unwrap(), &parsed(&text)), [""; 0]);
    assert!(schema == published());
}

/// Sets a dotted key.
fn set(campaign: &mut Value, key: &str, value: Value) {
    *key.split('.').fold(campaign, |table, name| &mut table[name]) = value;
}

#[test]
fn the_schema_takes_and_refuses_what_the_program_does() {
    let directory = tempfile::tempdir().unwrap();
    let schema: Value = serde_json::from_str(&published()).unwrap();
    let vasp =
        json!({ "vasp": { "version": "5.4.4", "pseudopotentials": "/", "pseudopotential_variants": {} } });
    let replay = json!([config("data/al_eam_1l/seed_frames.extxyz").display().to_string()]);
    for (key, value, takes) in [
        ("walk.time_step", json!(0.5), true),
        ("walk.time_step", json!(50), false),
        ("walk.time_step", json!(0), false),
        ("walk.tua", json!(0.5), false),
        ("walk.biased_steps", json!(1.5), false),
        ("walk.volume_ramp.from", json!(0.01), false),
        ("walk.thermostat", json!({ "langevin": { "friction": 0.01 } }), true),
        ("walk.thermostat", json!({ "langevin": { "friction": 0 } }), false),
        ("walk.thermostat", json!({ "langevin": { "friction": 1000 } }), false),
        ("walk.thermostat", json!({ "langevin": { "fricton": 0.01 } }), false),
        ("walk.thermostat", json!({ "nose_hoover": { "relaxation_time": 100.0 } }), true),
        ("walk.thermostat", json!({ "nose_hoover": { "relaxation_time": 9, "chain_length": 0 } }), false),
        ("walk.thermostat", json!({ "none": {} }), false),
        ("collect.criterion", json!({ "rule": "atom_count", "fraction": 0.2 }), true),
        ("collect.criterion", json!({ "rule": "atom_count", "fraction": 1.1 }), false),
        ("collect.criterion", json!({ "rule": "maximum_grade", "fraction": 0.2 }), false),
        ("collect.update_target", json!({ "rule": "maximum_grade", "target": 1.2 }), true),
        ("collect.update_target", json!({ "rule": "maximum" }), false),
        ("calm.alpha_values", json!([0.1, 1]), true),
        ("calm.alpha_values", json!([]), false),
        ("calm.alpha_values", json!([2]), false),
        ("label.time_limit", json!("2h 30m"), true),
        ("label.time_limit", json!("30"), false),
        ("label.time_limit", json!(30), false),
        ("label.batch_options", json!(["long"]), false),
        ("label.pass_environment", json!(["MYCODE_*"]), true),
        ("label.pass_environment", json!(["*MYCODE"]), false),
        ("label.guard", json!({ "min_bond_lengths": { "Al-O": 1.5 }, "min_angle": 30 }), true),
        ("label.guard", json!({ "min_bond_lengths": { "AlO": 1.5 } }), false),
        ("label.guard", json!({ "min_bond_lengths": { "Al-O": 0.0 } }), false),
        ("label.guard", json!({ "min_angle": 100 }), false),
        ("label.method", json!({ "abinit": { "pseudopotential_variants": { "Al": "Al.psp8" } } }), true),
        ("label.method", json!({ "abinit": { "cutoff": 10 } }), false),
        ("label.method", json!({ "abnit": {} }), false),
        ("label.method", json!({ "espresso": { "pseudopotential_variants": { "Fe": "Fe.UPF" } } }), true),
        ("label.method", json!({ "espresso": { "ecutwfc": 40 } }), false),
        ("label.method", vasp, true),
        ("stop.max_steps_without_structure", json!(1000), true),
        ("stop.max_steps_without_structure", json!(0), false),
        ("stop.walks", json!([]), true),
        ("stop.walks", json!("hot"), false),
        ("stop.min_improvement", json!(-0.1), false),
        ("launch", json!({ "custom": { "name": "PBS" } }), false),
        ("launch", json!({ "custm": {} }), false),
        ("notify.on", json!(["end"]), true),
        ("notify.on", json!(["begin"]), false),
        ("notify.command", json!([]), false),
        (
            "refit",
            json!({ "replay": replay, "method": { "native": { "epochs": 2, "loss": "paper" } } }),
            true,
        ),
        (
            "refit",
            json!({ "replay": replay, "held_out": 0, "method": { "command": { "program": ["p"] } } }),
            true,
        ),
        ("refit", json!({ "replay": replay, "test_sets": [{ "name": "t", "file": replay[0] }] }), true),
        ("refit", json!({ "replay": replay, "test_sets": [{ "name": "a b", "file": replay[0] }] }), false),
        ("refit", json!({ "replay": replay, "held_out": 1 }), false),
        ("refit", json!({ "replay": replay, "threads": 5000 }), false),
        ("refit", json!({ "replay": replay, "method": { "command": { "program": [] } } }), false),
        ("refit", json!({ "replay": replay, "method": { "native": { "average": 1.0 } } }), false),
        (
            "refit",
            json!({ "replay": replay, "method": { "native": {}, "command": { "program": ["p"] } } }),
            false,
        ),
        ("refit", json!({ "replay": [] }), false),
        ("refit", json!({}), false),
    ] {
        let mut campaign = parsed(&demo("aluminium.toml"));
        set(&mut campaign, key, value.clone());
        let faults = faults_of(&schema, &campaign);
        assert_eq!(faults.is_empty(), takes, "{key} = {value}: {faults:?}");
        fs::write(directory.path().join("c.toml"), toml::to_string(&campaign).unwrap()).unwrap();
        // A DFT code may not be installed.
        if !(takes && key == "label.method") {
            let code = calmwalk(directory.path(), ["validate", "c.toml"]).status.code();
            assert_eq!(code, Some(if takes { 0 } else { 2 }), "{key} = {value}");
        }
    }
}

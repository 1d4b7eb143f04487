//! `calmwalk doctor` and `calmwalk --version`: what the machine has, and what a campaign needs of it.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::common::campaign::Small;
use crate::common::{calmwalk, refuse, stderr, succeed};

fn checks(here: &Path, arguments: &[&str]) -> Vec<Value> {
    let output = calmwalk(here, ["doctor", "--json"].iter().chain(arguments));
    let all: Value = serde_json::from_slice(&output.stdout).unwrap();
    let checks = all["checks"].as_array().unwrap().clone();
    let missing =
        checks.iter().filter(|check| check["required"] == true && check["present"] == false).count();
    assert_eq!(all["missing"], missing);
    checks
}

fn check<'a>(checks: &'a [Value], name: &str) -> &'a Value {
    checks.iter().find(|check| check["check"] == name).unwrap_or_else(|| panic!("{name} in {checks:?}"))
}

#[test]
fn a_campaign_has_what_it_needs_or_the_table_says_what_is_missing() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    let table = succeed(here, ["doctor", "campaign.toml"]);
    for name in
        ["processor", "shared memory", "open files", "file locks", "vasp_std", "sbatch", "label method"]
    {
        assert!(table.contains(name), "{table}");
    }
    assert!(!table.contains("MISSING"), "{table}");
    assert!(!here.join("campaign").exists(), "nothing is made");
    let found = checks(here, &["campaign.toml"]);
    assert_eq!(check(&found, "files")["found"], "fit together");
    assert!(check(&found, "file system")["found"].as_str().unwrap().contains("local, writable"));

    let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
    let method = "method = { command = { command = [\"no-such-program\"], version = \"1\" } }";
    let lines = text.lines().map(|line| if line.starts_with("method = ") { method } else { line });
    fs::write(here.join("other.toml"), lines.collect::<Vec<_>>().join("\n")).unwrap();
    let output = calmwalk(here, ["doctor", "other.toml", "--python", "nowhere"]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let (table, message) = (String::from_utf8(output.stdout.clone()).unwrap(), stderr(&output));
    assert!(table.contains("MISSING  Python") && message.contains("Python"), "{table}{message}");
    assert!(table.contains("MISSING  label method") && message.contains("label method"), "{table}{message}");
}

#[test]
fn without_a_configuration_nothing_is_required_to_succeed() {
    let directory = tempfile::tempdir().unwrap();
    succeed(directory.path(), ["doctor", "--python", "nowhere"]);
    let message = refuse(directory.path(), ["doctor", "missing.toml"]);
    assert!(message.contains("missing.toml"), "{message}");
}

#[test]
fn the_version_has_commit_features_and_instructions() {
    let directory = tempfile::tempdir().unwrap();
    let (long, short) = (succeed(directory.path(), ["--version"]), succeed(directory.path(), ["-V"]));
    assert_eq!(long.lines().next(), short.lines().next());
    for name in ["commit", "build", "features", "instructions"] {
        assert!(long.lines().any(|line| line.starts_with(name)), "{long}");
    }
}

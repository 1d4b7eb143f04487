//! Checks that the files of `configs/` and `docs/configuration.md` describe the configuration as it is.

use std::collections::BTreeSet;
use std::path::Path;

use atoms::Species;
use calm::CovarianceUpdateKind;
use serde_json::{Value, json};

use super::Config;
use super::changes::differences;
use super::ranges::{RANGES, Range};
use super::schema::{at_key, schema};

const CAMPAIGNS: [&str; 6] = [
    "aluminium.toml",
    "silicon.toml",
    "silicon-dft.toml",
    "nickel-aluminium-hydrogen.toml",
    "foundation-expansion.toml",
    "foundation-campaign.toml",
];

fn read(path: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap()
}

/// A file of `configs/`. The section of refits is in force; where it is commented out as a whole, with its required key alone.
fn campaign(name: &str) -> String {
    let (mut is_refit, mut text) = (false, String::new());
    for line in read(&format!("configs/{name}")).lines() {
        is_refit = line.starts_with("# [refit]") || (is_refit && !line.is_empty());
        let line = match line.strip_prefix("#   ").filter(|_| is_refit) {
            Some(key) if key.starts_with("replay = ") => key.to_owned(),
            Some(key) => format!("# {key}"),
            None if is_refit => line.trim_start_matches("# ").to_owned(),
            None => line.to_owned(),
        };
        text += &(line + "\n");
    }
    assert!(text.contains("\n[refit] "), "{name}");
    text
}

/// A configuration with every default filled in.
fn resolved(text: &str) -> Value {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("c.toml");
    std::fs::write(&path, text).unwrap();
    let mut config = Config::load(&path).unwrap().config;
    config.seed_structures.files.truncate(1);
    let text = serde_json::to_string(&config).unwrap();
    serde_json::from_str(&text.replace(&directory.path().display().to_string(), "")).unwrap()
}

/// (section, key, whether it is commented out) of every line `key = …` or `# key = …`, and the number of the line.
fn keys(text: &str) -> Vec<(String, String, bool, usize)> {
    let (mut section, mut keys) = (String::new(), Vec::new());
    for (number, line) in text.lines().enumerate() {
        if let Some(header) = line.strip_prefix('[').and_then(|rest| rest.split(']').next()) {
            section = header.to_owned();
            // A table of its own is a key of the table above.
            let above =
                header.split_once('.').map(|(above, key)| (above, key.split('.').next().unwrap_or(key)));
            keys.extend(above.map(|(above, key)| (above.to_owned(), key.to_owned(), false, number)));
        }
        let (commented, rest) = line.strip_prefix("# ").map_or((false, line), |rest| (true, rest));
        let name = rest.split_once(" = ").map(|(name, _)| name);
        let is_key = |name: &&str| name.chars().all(|c| c.is_ascii_lowercase() || c == '_');
        keys.extend(name.filter(is_key).map(|name| (section.clone(), name.to_owned(), commented, number)));
    }
    keys
}

/// The text with every commented key put in force, but for alternatives of keys that are in force already.
fn uncommented(text: &str) -> String {
    let found = keys(text);
    let mut in_force: BTreeSet<_> =
        found.iter().filter(|key| !key.2).map(|(section, key, ..)| (section, key)).collect();
    let mut lines: Vec<_> = text.lines().collect();
    for (section, key, _, number) in found.iter().filter(|key| key.2) {
        if in_force.insert((section, key)) {
            lines[*number] = &lines[*number][2..];
        }
    }
    lines.join("\n")
}

/// What the file says behind a key: the comment of its line and of the lines below that continue it.
fn comment_of(text: &str, section: &str, key: &str) -> String {
    let place =
        keys(text).into_iter().find(|(s, k, ..)| (s.as_str(), k.as_str()) == (section, key)).unwrap().3;
    let mut lines = text.lines().skip(place);
    let first = lines.next().unwrap().to_owned();
    lines.take_while(|line| line.starts_with("   ")).fold(first, |all, line| all + line)
}

#[test]
fn keys_that_are_commented_out_show_their_defaults() {
    for name in CAMPAIGNS {
        // A barostat is an alternative to the ramp.
        let text = campaign(name).replace("\nvolume_ramp = ", "\n# ramp: ");
        let (mut differ, before_all) = (Vec::new(), resolved(&text));
        // Reproducible mode refuses these keys.
        let others = ["after_time", "min_completion_probability"].iter().fold(text.clone(), |text, key| {
            text.replace(&format!("\n# {key} = "), &format!("\n# live: {key} = "))
        });
        differences("", &before_all, &resolved(&uncommented(&others)), &mut differ);
        for (key, before, after) in differ {
            let expected = match key.as_str() {
                // These have no default value: what holds without them is the same as this value here …
                "calm.alpha_values" => {
                    let kind = before_all["calm"]["covariance_update"].clone();
                    json!(serde_json::from_value::<CovarianceUpdateKind>(kind).unwrap().default_alphas())
                }
                "walk.time_step" => json!(md::default_time_step(&["Al".parse::<Species>().unwrap()])),
                // … or said in words.
                _ => {
                    let (section, key) = key.split_once('.').unwrap();
                    // Of a table of its own, what is said of the table.
                    let key = key.split('.').next().unwrap_or(key);
                    assert!(
                        comment_of(&text, section, key).to_lowercase().contains("left out"),
                        "{name}: {key}"
                    );
                    after.clone()
                }
            };
            assert_eq!((&before, &after), (&Value::Null, &expected), "{name}: {key}");
        }
    }
}

/// The keys of each section.
fn all_keys() -> Vec<(String, BTreeSet<String>)> {
    let resolved = resolved(&campaign("aluminium.toml"));
    let sections = resolved.as_object().unwrap().iter();
    sections
        .map(|(name, section)| (name.clone(), section.as_object().unwrap().keys().cloned().collect()))
        .collect()
}

#[test]
fn every_key_is_listed() {
    for name in CAMPAIGNS {
        let listed = keys(&campaign(name));
        for (section, keys) in all_keys() {
            let of_section = listed.iter().filter(|key| key.0 == section).map(|key| key.1.clone());
            assert_eq!(of_section.collect::<BTreeSet<_>>(), keys, "{name}: [{section}]");
        }
    }
}

#[test]
fn the_reference_describes_every_key() {
    let text = read("docs/configuration.md");
    for (section, keys) in all_keys() {
        let heading = format!("\n## `[{section}]`");
        let chapter = text.split(&heading).nth(1).unwrap_or_else(|| panic!("no chapter on [{section}]"));
        let chapter = chapter.split("\n## ").next().unwrap_or_default();
        let rows = chapter.lines().filter_map(|line| line.strip_prefix("| `")?.split('`').next());
        let described: BTreeSet<_> =
            rows.map(|key| key.split('.').next().unwrap_or(key).to_owned()).collect();
        assert_eq!(described, keys, "docs/configuration.md: [{section}]");
    }
}

#[test]
fn the_schema_describes_every_key() {
    let schema = schema();
    for (section, keys) in all_keys() {
        let described = schema["properties"][&section]["properties"].as_object().unwrap();
        assert_eq!(described.keys().cloned().collect::<BTreeSet<_>>(), keys, "[{section}]");
        for (key, schema) in described {
            assert!(schema["description"].is_string(), "{section}.{key}");
        }
    }
}

#[test]
fn the_schema_has_every_key_of_the_reference() {
    let (mut schema, text) = (schema(), read("docs/configuration.md"));
    let (campaign, _) = text.split_once("\n## `calmwalk md`").unwrap();
    let mut keys = 0;
    for chapter in campaign.split("\n## ").skip(1) {
        let (heading, rows) = chapter.split_once('\n').unwrap();
        let section = heading.strip_prefix("`[").and_then(|rest| rest.strip_suffix("]`"));
        for row in rows.lines().filter_map(|line| line.strip_prefix("| `")) {
            let key = row.split(['`', ' ']).next().unwrap();
            let section = section.map(|section| section.trim_matches(['[', ']']));
            let key = section.map_or(key.to_owned(), |section| format!("{section}.{key}"));
            let mut found = false;
            at_key(&mut schema, &key, &mut |_| found = true);
            assert!(found, "{key}");
            keys += 1;
        }
    }
    assert!(keys > RANGES.len());
}

/// The examples of batch systems make valid campaigns, and the page repeats them.
#[test]
fn the_batch_systems_of_the_page_are_those_of_the_files() {
    let page = read("docs/batch-systems.md");
    for name in ["pbs", "lsf"] {
        let text = read(&format!("configs/{name}.toml"));
        let table = &text[text.find("[launch.custom]").unwrap()..];
        assert!(page.contains(&format!("```toml\n{table}```\n")), "{name}");
        let with = |label: &str| campaign("aluminium.toml").replacen("[label]\n", label, 1) + "\n" + table;
        let resolved = resolved(&with("[label]\n"));
        assert!(resolved["launch"]["custom"]["script"].is_string());
        for key in super::changes::CHANGEABLE.iter().filter_map(|key| key.strip_prefix("launch.")) {
            assert!(resolved["launch"].pointer(&format!("/{}", key.replace('.', "/"))).is_some(), "{key}");
        }
    }
}

#[test]
fn the_reference_has_every_range() {
    let text = read("docs/configuration.md");
    let chapter = text.split("\n## Usual numbers").nth(1).unwrap().split("\n## ").next().unwrap();
    let rows: Vec<_> = chapter.lines().filter(|line| line.starts_with("| `")).collect();
    let expected: Vec<_> = RANGES
        .iter()
        .map(|range @ Range { key, unit, possible, usual, .. }| {
            let [[least, most], [from, to]] =
                [possible, usual].map(|bounds| bounds.map(|bound| range.shown(bound)));
            let possible =
                if possible[0] != 0.0 { format!("{least} to {most}") } else { format!("at most {most}") };
            format!("| `{key}` | {unit} | {possible} | {from} to {to} |").replace("|  |", "| |")
        })
        .collect();
    assert_eq!(rows, expected);
}

#[test]
fn every_range_is_that_of_a_key() {
    let sections: std::collections::BTreeMap<_, _> = all_keys().into_iter().collect();
    for Range { key, .. } in &RANGES {
        let mut parts = key.split('.');
        let (section, key) = (parts.next().unwrap(), parts.next().unwrap());
        assert!(sections[section].contains(key), "{section}.{key}");
    }
}

#[test]
fn the_reference_says_which_keys_may_change() {
    let text = read("docs/configuration.md");
    let mut section = "";
    let mut changeable = BTreeSet::new();
    for line in text.lines() {
        section = line.strip_prefix("## `[").and_then(|rest| rest.split(']').next()).unwrap_or(section);
        let cells: Vec<_> = line.split('|').map(str::trim).collect();
        if let [_, key, .., "yes", _] = cells[..] {
            changeable.insert(format!("{section}.{}", key.trim_matches('`')));
        }
    }
    let expected = super::changes::CHANGEABLE
        .map(|key| if key == "seed_structures" { "seed_structures.files" } else { key }.to_owned());
    assert_eq!(changeable, BTreeSet::from(expected));
}

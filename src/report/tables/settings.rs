//! Every key of the configuration in force, section by section.

use serde_json::Value;

use super::super::report_data::ReportData;
use super::{PageTable, TableCell, text};

/// Sections in the order of the configuration file. Other sections follow.
const SECTIONS: [&str; 12] = [
    "campaign",
    "potential",
    "calm",
    "seed_structures",
    "walk",
    "collect",
    "guard",
    "label",
    "budget",
    "stop",
    "run",
    "notify",
];
/// Hashes of files and the list of seed structures have their own tables.
const EXCLUDED_SECTIONS: [&str; 2] = ["files", "seed_structures"];

/// The table: a heading for each section, then its keys. A key without a value is shown as not set.
pub fn settings(data: &ReportData) -> PageTable {
    let caption = "The configuration in force, with every default filled in. Units are those of the documentation: eV, Å, fs, K. \
                   Files are named by their BLAKE3 hashes under Versions and provenance.";
    let mut table = PageTable::new("settings", caption, &["key", "value"]).whole();
    for (section, pairs) in sections(&data.configuration) {
        table.rows.push(vec![text(format!("[{section}]"))]);
        table.rows.extend(pairs.into_iter().map(|(key, value)| {
            let name = key.strip_prefix(&format!("{section}.")).unwrap_or(&key).to_owned();
            let shown = value.clone().unwrap_or_else(|| "not set".into());
            let key = TableCell { shown: name, exact: key, is_number: false };
            vec![key, TableCell { shown, exact: value.unwrap_or_default(), is_number: false }]
        }));
    }
    table
}

/// A full key and its value; `None` where the key is not set.
type Setting = (String, Option<String>);

/// Each section that has keys, in the order of [`SECTIONS`]. Keys outside any section belong to `campaign`.
fn sections(configuration: &Value) -> Vec<(String, Vec<Setting>)> {
    let mut found: Vec<(String, Vec<Setting>)> =
        SECTIONS.iter().map(|name| ((*name).to_owned(), Vec::new())).collect();
    for (name, value) in configuration.as_object().into_iter().flatten() {
        if EXCLUDED_SECTIONS.contains(&name.as_str()) {
            continue;
        }
        let section = if value.is_object() { name.as_str() } else { "campaign" };
        let at = found.iter().position(|(known, _)| known == section).unwrap_or_else(|| {
            found.push((section.to_owned(), Vec::new()));
            found.len() - 1
        });
        // Show the hash in place of a file.
        let mut pairs = Vec::new();
        flatten(name, value, &mut pairs);
        let hash = |key: &str| configuration["files"][key].as_str().map(str::to_owned);
        found[at].1.extend(pairs.into_iter().map(|(key, value)| {
            let value = value.or_else(|| hash(&key));
            (key, value)
        }));
    }
    found.retain(|(_, pairs)| !pairs.is_empty());
    found
}

/// Every value below a key with its full key, as text; `None` for null.
pub(super) fn flatten(key: &str, value: &Value, pairs: &mut Vec<Setting>) {
    match value {
        Value::Object(object) => {
            for (name, value) in object {
                flatten(&format!("{key}.{name}"), value, pairs);
            }
        }
        Value::Null => pairs.push((key.to_owned(), None)),
        Value::String(text) => pairs.push((key.to_owned(), Some(text.clone()))),
        other => pairs.push((key.to_owned(), Some(other.to_string()))),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn every_key_stands_below_its_section_in_the_order_of_the_file() {
        let configuration = json!({
            "walk": { "temperature": 300.0, "thermostat": { "kind": "langevin" }, "volume_ramp": null },
            "instructions": "avx2", "seed_structures": ["a 12ab"], "files": { "potential.model": "ff00" },
            "potential": { "model": null }, "later": { "key": [1, 2] }, "collect": {},
        });
        let found: Vec<_> = sections(&configuration)
            .into_iter()
            .flat_map(|(section, pairs)| {
                pairs.into_iter().map(move |(key, value)| format!("[{section}] {key} {value:?}"))
            })
            .collect();
        let expected = [
            "[campaign] instructions Some(\"avx2\")",
            "[potential] potential.model Some(\"ff00\")",
            "[walk] walk.temperature Some(\"300.0\")",
            "[walk] walk.thermostat.kind Some(\"langevin\")",
            "[walk] walk.volume_ramp None",
            "[later] later.key Some(\"[1,2]\")",
        ];
        assert_eq!(found, expected);
    }
}

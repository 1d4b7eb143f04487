//! Versions of the potential in words.

use monitor::versions::{CampaignVersions, RefitUnderWay, VersionSetErrors, VersionSummary};

use crate::output::{TextTable, count, decimals};
use crate::wording::cost::core_time;

/// The version in force, with those that wait or were refused: `version 2 in force, trained on 120 labels; 1 refused`.
pub fn in_force(versions: &CampaignVersions, version: &VersionSummary) -> String {
    let trained = match version.number {
        0 => "that of the configuration".to_owned(),
        _ => format!("trained on {}", count(version.labels, "label")),
    };
    let newer = versions.all.iter().filter(|other| other.is_registered() && other.number > version.number);
    let newer: Vec<_> = newer.map(|other| other.number.to_string()).collect();
    let newer = match newer.as_slice() {
        [] => String::new(),
        numbers => format!("; newer, no walk has used: {}", numbers.join(", ")),
    };
    let refused = versions.all.iter().filter(|other| !other.is_registered()).count();
    let refused = if refused == 0 { String::new() } else { format!("; {refused} refused") };
    format!("version {} in force, {trained}{newer}{refused}", version.number)
}

/// A refused attempt with its reason.
pub fn refused(version: &VersionSummary) -> String {
    format!("version {} was refused: {}", version.number, version.reason)
}

/// A registered version with its cost.
pub fn registered(version: &VersionSummary) -> String {
    let VersionSummary { number, labels, core_hours, .. } = version;
    format!(
        "version {number} of the potential is registered: trained on {}, {}",
        count(*labels, "label"),
        core_time(*core_hours)
    )
}

/// The refit under way, with what its process says.
pub fn refit(refit: &RefitUnderWay) -> String {
    let remark = if refit.remark.is_empty() { String::new() } else { format!(": {}", refit.remark) };
    format!("training version {}{remark}", refit.number)
}

/// A table with a row for each data set: the force MAE of each registered version, and of the models that were trained for comparison
/// with the newest one.
pub fn table(versions: &CampaignVersions) -> String {
    let registered: Vec<_> = versions.all.iter().filter(|version| version.is_registered()).collect();
    let newest = registered.last();
    let mut compared: Vec<&str> = Vec::new();
    for set in newest.iter().flat_map(|version| &version.errors) {
        let names = set.compared.iter().map(|found| found.name.as_str());
        let new: Vec<_> = names.filter(|name| !compared.contains(name)).collect();
        compared.extend(new);
    }
    let titles = registered.iter().map(|version| match version.number {
        0 => ">version 0".to_owned(),
        number => format!(">{number} ({})", count(version.labels, "label")),
    });
    let titles = ["force MAE (eV/Å)".to_owned(), ">structures".to_owned()].into_iter().chain(titles);
    let titles: Vec<_> = titles.chain(compared.iter().map(|name| format!(">{name}"))).collect();
    let titles: Vec<_> = titles.iter().map(String::as_str).collect();
    let mut table = TextTable::new(&titles);
    for name in versions.sets() {
        let last = newest.and_then(|version| version.errors_on(name));
        let mut row = vec![name.to_owned(), last.map_or("–".to_owned(), |set| set.structures.to_string())];
        for version in &registered {
            row.push(decimals(version.errors_on(name).and_then(VersionSetErrors::force_mae), 4));
        }
        for comparison in &compared {
            let found = last.and_then(|set| set.compared.iter().find(|found| found.name == *comparison));
            row.push(decimals(found.and_then(|found| found.force_mae), 4));
        }
        table.push(row);
    }
    let mut text = Vec::new();
    // Writing to memory cannot fail.
    let _ = table.write(&mut text);
    let mut text = String::from_utf8_lossy(&text).into_owned();
    if let (Some(version), false) = (newest, compared.is_empty()) {
        let (names, number) = (compared.join(", "), version.number);
        text += &format!(
            "{names}: trained like version {number}, on as many of these structures in place of the campaign's\n"
        );
    }
    text
}

#[cfg(test)]
pub mod tests {
    use monitor::versions::{ComparedErrors, ErrorFigures, VersionStanding};

    use super::*;

    /// Version 0, version 1, a refused attempt, and version 3 in force, with the force MAE of two data sets; and a refit under way.
    pub fn example() -> CampaignVersions {
        let figures = |force_mae| {
            let energy_mae = Some(0.01);
            Some(ErrorFigures { force_mae: Some(force_mae), energy_mae, ..ErrorFigures::default() })
        };
        let set = |name: &str, kind: &str, structures, parent: Option<f64>, version| VersionSetErrors {
            name: name.into(),
            kind: kind.into(),
            structures,
            first: parent.and_then(|_| figures(if kind == "test" { 0.2 } else { 0.4 })),
            parent: parent.and_then(figures),
            version: figures(version),
            compared: match parent {
                Some(_) if kind == "test" => vec![ComparedErrors {
                    name: "control".into(),
                    structures: 9,
                    energy_mae: None,
                    force_mae: Some(0.3),
                }],
                _ => Vec::new(),
            },
        };
        let version = |number: u32, state, errors| VersionSummary {
            number,
            state,
            parent: number.checked_sub(1).map(|_| number / 2),
            method: if number == 0 { "configuration" } else { "native" }.into(),
            reason: String::new(),
            labels: 40 * u64::from(number),
            structures: 50 * u64::from(number),
            accepted: 60,
            labelled: 55,
            errors,
            seconds: 600.0 * f64::from(number),
            core_hours: 2.5 * f64::from(number),
            time: (number > 0).then_some(1_700_000_000_000),
        };
        let errors = |held_out, parent: Option<f64>, liquid| {
            vec![
                set("liquid", "test", 5, parent, liquid),
                set("held_out", "held_out", held_out, parent.map(|error| 2.0 * error), 2.0 * liquid),
            ]
        };
        let mut all = vec![
            version(0, VersionStanding::Earlier, errors(10, None, 0.2)),
            version(1, VersionStanding::Earlier, errors(10, Some(0.2), 0.1)),
            version(2, VersionStanding::Refused, errors(20, Some(0.1), 0.4)),
            version(3, VersionStanding::InForce, errors(30, Some(0.1), 0.25)),
        ];
        all[2].reason = "the force MAE on the held-out set rose from 0.2 to 0.8 eV/Å".into();
        let refit = RefitUnderWay {
            number: 4,
            host: "node7".into(),
            started: 0,
            state: "running".into(),
            remark: "epoch 12 of 50".into(),
        };
        CampaignVersions { all, refit: Some(refit) }
    }

    #[test]
    fn versions_are_compared_set_by_set() {
        let versions = example();
        let text = table(&versions);
        let rows: Vec<Vec<_>> = text.lines().skip(1).map(|line| line.split_whitespace().collect()).collect();
        assert_eq!(rows.len(), 3, "{text}");
        // Errors that rise are there all the same; those of refused versions are not.
        assert_eq!(rows[0], ["liquid", "5", "0.2000", "0.1000", "0.2500", "0.3000"]);
        assert_eq!(rows[1], ["held_out", "30", "0.4000", "0.2000", "0.5000", "–"]);
        assert!(text.contains("version 0  1 (40 labels)  3 (120 labels)  control\n"), "{text}");
        assert!(text.contains("control: trained like version 3, on as many of these structures"), "{text}");
        let line = in_force(&versions, versions.in_force().unwrap());
        assert_eq!(line, "version 3 in force, trained on 120 labels; 1 refused");
        assert_eq!(refit(versions.refit.as_ref().unwrap()), "training version 4: epoch 12 of 50");
        assert!(refused(&versions.all[2]).starts_with("version 2 was refused: the force MAE"));
    }
}

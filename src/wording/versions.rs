//! Versions of the potential in words.

use monitor::versions::{CampaignVersions, RefitUnderWay, VersionSummary};

use crate::output::{TextTable, count, decimals};
use crate::wording::cost::two_digits;

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
        numbers => format!("; not taken up yet: {}", numbers.join(", ")),
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
        "version {number} of the potential is registered: trained on {}, {} core-hours",
        count(*labels, "label"),
        two_digits(*core_hours)
    )
}

/// The refit under way, with what its process says.
pub fn refit(refit: &RefitUnderWay) -> String {
    let remark = if refit.remark.is_empty() { String::new() } else { format!(": {}", refit.remark) };
    format!("training version {}{remark}", refit.number)
}

/// A table with a row for each version and data set: force and energy MAE, and the changes of the force MAE relative to the parent
/// and to version 0 in per cent.
pub fn table(versions: &CampaignVersions) -> String {
    let mut table = TextTable::new(&[
        "version",
        ">labels",
        "set",
        ">structures",
        ">energy MAE (meV/atom)",
        ">force MAE (eV/Å)",
        ">from parent (%)",
        ">from version 0 (%)",
    ]);
    for version in &versions.all {
        let state = if version.is_registered() { "" } else { " refused" };
        for set in &version.errors {
            let energy = set.version.and_then(|errors| errors.energy_mae);
            table.push(vec![
                format!("{}{state}", version.number),
                version.labels.to_string(),
                set.name.clone(),
                set.structures.to_string(),
                decimals(energy.map(|error| 1000.0 * error), 1),
                decimals(set.force_mae(), 4),
                percent(set.change_from_parent()),
                percent(set.change_since_first()),
            ]);
        }
    }
    let mut text = Vec::new();
    // Writing to memory cannot fail.
    let _ = table.write(&mut text);
    String::from_utf8_lossy(&text).into_owned()
}

/// A change with its sign, in per cent.
pub fn percent(change: Option<f64>) -> String {
    change.map_or("–".to_owned(), |change| format!("{:+.0}", 100.0 * change))
}

#[cfg(test)]
pub mod tests {
    use monitor::versions::{ErrorFigures, VersionSetErrors, VersionStanding};

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
    fn versions_are_compared_with_their_parent_and_with_version_0() {
        let versions = example();
        let text = table(&versions);
        let rows: Vec<Vec<_>> = text.lines().skip(1).map(|line| line.split_whitespace().collect()).collect();
        assert_eq!(rows.len(), 8, "{text}");
        assert_eq!(rows[0], ["0", "0", "liquid", "5", "10.0", "0.2000", "–", "–"]);
        assert_eq!(rows[2], ["1", "40", "liquid", "5", "10.0", "0.1000", "-50", "-50"]);
        assert_eq!(rows[5], ["2", "refused", "80", "held_out", "20", "10.0", "0.8000", "+300", "+100"]);
        // It rises, and is there all the same.
        assert_eq!(rows[6], ["3", "120", "liquid", "5", "10.0", "0.2500", "+150", "+25"]);
        let line = in_force(&versions, versions.in_force().unwrap());
        assert_eq!(line, "version 3 in force, trained on 120 labels; 1 refused");
        assert_eq!(refit(versions.refit.as_ref().unwrap()), "training version 4: epoch 12 of 50");
        assert!(refused(&versions.all[2]).starts_with("version 2 was refused: the force MAE"));
    }
}

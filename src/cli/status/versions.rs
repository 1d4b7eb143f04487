//! Versions of the potential in `calmwalk status`.

use std::io::{self, Write};

use monitor::versions::{CampaignVersions, VersionSummary};

use super::page::StatusLayout;
use crate::output::{TextTable, decimals};
use crate::wording::versions;

const SECONDS_PER_MINUTE: f64 = 60.0;

/// Writes the version in force, refused ones, and the refit under way. Nothing in a campaign that has never trained a version, and on
/// a screen, where [`short`] is shown.
pub fn write_head(out: &mut dyn Write, found: &CampaignVersions, page: &StatusLayout) -> io::Result<()> {
    if !page.is_unlimited() {
        return Ok(());
    }
    if let Some(version) = found.in_force() {
        page.titled(out, "potential", &versions::in_force(found, version))?;
        let mut refused = found.all.iter().filter(|version| !version.is_registered());
        refused.try_for_each(|version| page.titled(out, "", &versions::refused(version)))?;
    }
    match &found.refit {
        Some(refit) => page.titled(out, "refit", &versions::refit(refit)),
        None => Ok(()),
    }
}

/// The same in a few words, after those about the mixture: `; potential version 3, 1 refused; training version 4`.
pub fn short(found: &CampaignVersions) -> String {
    let in_force = found.in_force().map(|version| format!("; potential version {}", version.number));
    let refused = match found.all.iter().filter(|version| !version.is_registered()).count() {
        0 => String::new(),
        refused => format!(", {refused} refused"),
    };
    let refit = found.refit.as_ref().map(|refit| format!("; training version {}", refit.number));
    [in_force.unwrap_or_default(), refused, refit.unwrap_or_default()].concat()
}

/// Writes a table of the versions with the force MAE on each data set.
pub fn write(out: &mut dyn Write, found: &CampaignVersions, page: &StatusLayout) -> io::Result<()> {
    if found.all.is_empty() {
        return Ok(());
    }
    let sets = found.sets();
    let of_sets: Vec<_> = sets.iter().map(|set| format!(">{set} (eV/Å)")).collect();
    let mut titles =
        vec!["Versions", "state", ">labels", ">accepted", ">labelled", ">wall time (min)", ">core-hours"];
    titles.extend(of_sets.iter().map(String::as_str));
    let mut table = TextTable::new(&titles);
    found.all.iter().for_each(|version| table.push(row(version, &sets)));
    page.table(out, &table, found.all.len(), found.all.len(), "versions")
}

fn row(version: &VersionSummary, sets: &[&str]) -> Vec<String> {
    let was_trained = version.number > 0;
    let mut row = vec![
        version.number.to_string(),
        version.state.name().replace('_', " "),
        version.labels.to_string(),
        version.accepted.to_string(),
        version.labelled.to_string(),
        decimals(was_trained.then_some(version.seconds / SECONDS_PER_MINUTE), 1),
        decimals(was_trained.then_some(version.core_hours), 2),
    ];
    let force_mae = |set: &&str| version.errors_on(set).and_then(|errors| errors.force_mae());
    row.extend(sets.iter().map(|set| decimals(force_mae(set), 4)));
    row
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wording::versions::tests::example;

    fn text(found: &CampaignVersions) -> String {
        let (mut out, page) = (Vec::new(), StatusLayout { width: 120, ..StatusLayout::unlimited() });
        write_head(&mut out, found, &page).unwrap();
        write(&mut out, found, &page).unwrap();
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn versions_are_listed_with_their_errors() {
        let shown = text(&example());
        for expected in [
            "potential   version 3 in force, trained on 120 labels; 1 refused",
            "            version 2 was refused: the force MAE on the held-out set rose from 0.2 to 0.8 eV/Å",
            "refit       training version 4: epoch 12 of 50",
        ] {
            assert!(shown.contains(expected), "{shown}");
        }
        let last: Vec<_> = shown.lines().last().unwrap().split_whitespace().collect();
        assert_eq!(
            last,
            ["3", "in", "force", "120", "60", "55", "30.0", "7.50", "0.2500", "0.5000"],
            "{shown}"
        );
        let first = shown.lines().find(|line| line.starts_with("0 ")).unwrap();
        assert!(first.split_whitespace().eq(["0", "earlier", "0", "60", "55", "–", "–", "0.2000", "0.4000"]));
        assert_eq!(short(&example()), "; potential version 3, 1 refused; training version 4");
        let none = CampaignVersions::default();
        assert_eq!((text(&none), short(&none)), (String::new(), String::new()));
    }
}

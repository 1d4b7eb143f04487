//! Versions of the potential, their errors, and how well their grades predicted them.

use atoms::units::GPA_PER_EV_A3;
use monitor::label_statistics::{LARGE_FORCE_ERROR, LabelStatistics};
use monitor::versions::{CampaignVersions, VersionSetErrors};

use super::labels::ranking;
use super::{PageTable, count, percent, real, text};

/// All versions and refused attempts. Without rows if the campaign has never trained one, as the next table.
pub fn versions(found: &CampaignVersions) -> PageTable {
    let titles = [
        "version",
        "state",
        "trained from",
        "labels",
        "accepted",
        "labelled",
        "wall time (s)",
        "core-hours",
        "refused because",
    ];
    let caption = "Versions of the potential: labels in the training set, structures accepted from its biased walks, structures with \
                   a label that its walks found, and the time of the refit. Version 0 is that of the configuration.";
    let mut table = PageTable::new("versions", caption, &titles);
    for version in &found.all {
        table.rows.push(vec![
            text(version.number.to_string()),
            text(version.state.name().replace('_', " ")),
            text(version.parent.map_or(String::new(), |parent| parent.to_string())),
            count(version.labels),
            count(version.accepted),
            count(version.labelled),
            real(version.seconds, 0),
            real(version.core_hours, 3),
            text(&version.reason),
        ]);
    }
    table
}

/// Errors of every version on every data set.
pub fn errors(found: &CampaignVersions) -> PageTable {
    let titles = [
        "version",
        "set",
        "structures",
        "energy MAE (eV/atom)",
        "force MAE (eV Å^{−1})",
        "force RMSE (eV Å^{−1})",
        "stress MAE (GPa)",
        "change from parent (%)",
        "change from version 0 (%)",
    ];
    let caption = "Errors of each version on each data set, refused ones included, and the changes of its force MAE relative to the \
                   version from which it was trained and to version 0, on the same structures. Held-out sets grow with the campaign.";
    let mut table = PageTable::new("version-errors", caption, &titles);
    for version in &found.all {
        let state = if version.is_registered() { "" } else { " (refused)" };
        for set in &version.errors {
            let VersionSetErrors { name, structures, version: errors, .. } = set;
            table.rows.push(vec![
                text(format!("{}{state}", version.number)),
                text(name),
                count(*structures),
                real(errors.and_then(|errors| errors.energy_mae), 5),
                real(errors.and_then(|errors| errors.force_mae), 4),
                real(errors.and_then(|errors| errors.force_rmse), 4),
                real(errors.and_then(|errors| errors.stress_mae).map(|mae| GPA_PER_EV_A3 * mae), 4),
                percent(set.change_from_parent()),
                percent(set.change_since_first()),
            ]);
        }
    }
    table
}

/// How well the grades of each version predicted its errors. Without rows if all walks had version 0.
pub fn grades(statistics: &LabelStatistics) -> PageTable {
    let caption = format!(
        "Force error |F_{{model}} − F_{{label}}| of each version on the structures of its own walks, and its grades under its own original \
         mixture: mean and median error, Spearman’s ρ between grade and error, and ROC-AUC of the grade as a test for errors above \
         {LARGE_FORCE_ERROR} eV Å^{{−1}}."
    );
    let titles = [
        "version",
        "structures",
        "atoms",
        "mean error (eV Å^{−1})",
        "median",
        "ρ(γ)",
        "ρ(γ_{nbr})",
        "ROC-AUC(γ)",
        "ROC-AUC(γ_{nbr})",
        "sampled atoms",
    ];
    let mut table = PageTable::new("version-grades", &caption, &titles);
    for (version, grades) in &statistics.by_version {
        let gamma = &grades.gamma;
        let mut row = vec![
            text(version.to_string()),
            count(grades.structures),
            count(gamma.atoms()),
            real(gamma.mean(), 3),
            real(gamma.median(), 3),
        ];
        row.extend(ranking(grades));
        table.rows.push(row);
    }
    table
}

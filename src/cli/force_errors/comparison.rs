//! Biased walks beside their controls, as text.

use std::io::{self, Write};

use analysis::SHOWN_ERROR_THRESHOLDS;
use atoms::units::GPA_PER_EV_A3;
use monitor::label_statistics::LARGE_FORCE_ERROR;
use monitor::label_statistics::comparison::{ComparedGroup, PairedErrors, PairedQuantity, WalkComparison};

use crate::output::{TextTable, decimals};
use crate::wording::comparison::{
    ShownError, elements, estimate, failure_ranges, groups, known_errors, larger, median_range, notes,
    probability,
};

/// Writes the section; nothing without labelled structures.
pub fn write(out: &mut dyn Write, comparison: &WalkComparison) -> io::Result<()> {
    if comparison.pooled.all.structures == 0 {
        return Ok(());
    }
    writeln!(
        out,
        "\nbiased against control (docs/errors.md): matched, a biased candidate and the control frame of the same step; pooled, all \
         labelled structures"
    )?;
    for note in notes(comparison) {
        writeln!(out, "{note}")?;
    }
    if comparison.pairs.counts.pairs > 0 {
        write_pairs(out, &comparison.pairs)?;
    }
    let groups = groups(comparison);
    write_groups(out, &groups)?;
    write_areas(out, &groups)?;
    write_elements(out, comparison)
}

fn write_pairs(out: &mut dyn Write, pairs: &PairedErrors) -> io::Result<()> {
    let mut table = TextTable::new(&[
        "median over the pairs",
        ">pairs",
        ">biased",
        ">control",
        ">difference of medians",
        ">biased larger in",
        ">Wilcoxon p",
        ">sign test p",
    ]);
    for (ShownError { name, factor, digits: places, .. }, quantity) in known_errors(pairs) {
        let PairedQuantity { biased, control, difference_of_medians, tests, .. } = quantity;
        table.push(vec![
            name.into(),
            quantity.pairs.to_string(),
            estimate(biased, factor, places),
            estimate(control, factor, places),
            estimate(difference_of_medians, factor, places),
            larger(tests),
            probability(tests.wilcoxon_p),
            probability(tests.sign_p),
        ]);
    }
    writeln!(out)?;
    table.write(out)?;
    for (error, sides) in failure_ranges(pairs) {
        let sides: Vec<_> = sides.into_iter().map(|(side, range)| format!("{side} {range}")).collect();
        writeln!(out, "median for any errors of failed labels, {}: {}", error.name, sides.join(", "))?;
    }
    Ok(())
}

/// The structures of each group, then their atoms.
fn write_groups(out: &mut dyn Write, groups: &[(&str, &ComparedGroup)]) -> io::Result<()> {
    let mut structures = TextTable::new(&[
        "medians over structures",
        ">structures",
        ">failed",
        ">mean T (K)",
        ">mean V/V₀",
        ">MAE (eV/Å)",
        ">for any errors of failed",
        ">energy (meV/atom)",
        ">stress (GPa)",
    ]);
    let area = |grade: &str| format!(">ROC-AUC({grade}), {LARGE_FORCE_ERROR} eV/Å");
    let [by_gamma, by_gamma_nbr] = ["γ", "γ_nbr"].map(area);
    let mut atoms =
        TextTable::new(&["atoms", ">median |ΔF| (eV/Å)", ">ρ(γ)", ">ρ(γ_nbr)", &by_gamma, &by_gamma_nbr]);
    for (name, group) in groups {
        let between = group.median_force_mae_between.map(|range| median_range(range, 1.0, 3));
        structures.push(vec![
            (*name).into(),
            group.structures.to_string(),
            group.failed.to_string(),
            decimals(group.mean_temperature, 0),
            decimals(group.mean_relative_volume, 3),
            estimate(&group.median_force_mae, 1.0, 3),
            between.unwrap_or_else(|| "–".into()),
            estimate(&group.median_energy, 1000.0, 1),
            estimate(&group.median_stress, GPA_PER_EV_A3, 3),
        ]);
        atoms.push(vec![
            (*name).into(),
            estimate(&group.median_error, 1.0, 3),
            estimate(&group.gamma.spearman, 1.0, 3),
            estimate(&group.gamma_nbr.spearman, 1.0, 3),
            estimate(&group.gamma.area_above(LARGE_FORCE_ERROR), 1.0, 3),
            estimate(&group.gamma_nbr.area_above(LARGE_FORCE_ERROR), 1.0, 3),
        ]);
    }
    for table in [structures, atoms] {
        writeln!(out)?;
        table.write(out)?;
    }
    Ok(())
}

/// The ROC-AUC of γ_nbr for some thresholds of the force error. `--json` has all.
fn write_areas(out: &mut dyn Write, groups: &[(&str, &ComparedGroup)]) -> io::Result<()> {
    let titles = SHOWN_ERROR_THRESHOLDS.map(|threshold| format!(">errors above {threshold} eV/Å"));
    let titles: Vec<_> = ["ROC-AUC(γ_nbr)"].into_iter().chain(titles.iter().map(String::as_str)).collect();
    let mut table = TextTable::new(&titles);
    for (name, group) in groups {
        let areas =
            SHOWN_ERROR_THRESHOLDS.map(|threshold| estimate(&group.gamma_nbr.area_above(threshold), 1.0, 3));
        table.push([(*name).to_owned()].into_iter().chain(areas).collect());
    }
    writeln!(out)?;
    table.write(out)
}

/// By element, of matched structures and of all; nothing if all groups have one element.
fn write_elements(out: &mut dyn Write, comparison: &WalkComparison) -> io::Result<()> {
    let elements = elements(comparison);
    if elements.is_empty() {
        return Ok(());
    }
    let area = format!(">ROC-AUC(γ_nbr), {LARGE_FORCE_ERROR} eV/Å");
    let mut table =
        TextTable::new(&["element", "", ">atoms", ">median |ΔF| (eV/Å)", ">ρ(γ)", ">ρ(γ_nbr)", &area]);
    for (name, element) in elements {
        let area = element.gamma_nbr.roc_auc.first().copied().unwrap_or_default();
        table.push(vec![
            element.element.into(),
            name.into(),
            element.sampled_atoms.to_string(),
            estimate(&element.median_error, 1.0, 3),
            estimate(&element.gamma.spearman, 1.0, 3),
            estimate(&element.gamma_nbr.spearman, 1.0, 3),
            estimate(&area, 1.0, 3),
        ]);
    }
    writeln!(out)?;
    table.write(out)
}

//! Biased walks beside their controls, as text.

use std::io::{self, Write};

use analysis::{SHOWN_ERROR_THRESHOLDS, threshold_place};
use atoms::units::GPA_PER_EV_A3;
use monitor::label_statistics::LARGE_FORCE_ERROR;
use monitor::label_statistics::comparison::{ComparedGroup, PairedErrors, PairedQuantity, WalkComparison};

use crate::output::{TextTable, decimals};
use crate::wording::comparison::{estimate, larger, median_range, notes, probability};

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
    write_elements(out, &groups)
}

/// The groups with structures, by name.
fn groups(comparison: &WalkComparison) -> Vec<(&'static str, &ComparedGroup)> {
    let (matched, pooled) = (&comparison.matched, &comparison.pooled);
    let mut all = vec![
        ("matched biased", &matched.biased),
        ("matched control", &matched.control),
        ("pooled all", &pooled.all),
        ("pooled biased", &pooled.biased),
        ("pooled control", &pooled.control),
    ];
    all.retain(|(_, group)| group.structures > 0);
    all
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
    let quantities = [
        ("force MAE (eV/Å)", &pairs.force_mae, 1.0, 3),
        ("mean |ΔF| (eV/Å)", &pairs.mean_force_error, 1.0, 3),
        ("energy error (meV/atom)", &pairs.energy, 1000.0, 1),
        ("stress error (GPa)", &pairs.stress, GPA_PER_EV_A3, 3),
    ];
    for (name, quantity, factor, places) in quantities {
        if quantity.pairs > 0 {
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
    }
    writeln!(out)?;
    table.write(out)?;
    let sides = [("biased", pairs.force_mae.biased_between), ("control", pairs.force_mae.control_between)];
    for (name, range) in sides {
        if let Some(range) = range {
            let range = median_range(range, 3);
            writeln!(
                out,
                "{name} median of the force MAE, whatever the errors of failed labels: {range} eV/Å"
            )?;
        }
    }
    Ok(())
}

fn write_groups(out: &mut dyn Write, groups: &[(&str, &ComparedGroup)]) -> io::Result<()> {
    let area = format!(">ROC-AUC(γ_nbr), {LARGE_FORCE_ERROR} eV/Å");
    let mut table = TextTable::new(&[
        "",
        ">structures",
        ">failed",
        ">mean T (K)",
        ">mean V/V₀",
        ">median MAE (eV/Å)",
        ">median |ΔF| (eV/Å)",
        ">ρ(γ_nbr)",
        &area,
    ]);
    let large = threshold_place(LARGE_FORCE_ERROR);
    for (name, group) in groups {
        let area = large.and_then(|place| group.gamma_nbr.roc_auc.get(place)).copied().unwrap_or_default();
        table.push(vec![
            (*name).into(),
            group.structures.to_string(),
            group.failed.to_string(),
            decimals(group.mean_temperature, 0),
            decimals(group.mean_relative_volume, 3),
            estimate(&group.median_force_mae, 1.0, 3),
            estimate(&group.median_error, 1.0, 3),
            estimate(&group.gamma_nbr.spearman, 1.0, 3),
            estimate(&area, 1.0, 3),
        ]);
    }
    writeln!(out)?;
    table.write(out)
}

/// The ROC-AUC of γ_nbr for some thresholds of the force error. `--json` has all.
fn write_areas(out: &mut dyn Write, groups: &[(&str, &ComparedGroup)]) -> io::Result<()> {
    let titles = SHOWN_ERROR_THRESHOLDS.map(|threshold| format!(">errors above {threshold} eV/Å"));
    let titles: Vec<_> = ["ROC-AUC(γ_nbr)"].into_iter().chain(titles.iter().map(String::as_str)).collect();
    let mut table = TextTable::new(&titles);
    for (name, group) in groups {
        let area = |threshold: f64| {
            let place = threshold_place(threshold)?;
            group.gamma_nbr.roc_auc.get(place).map(|area| estimate(area, 1.0, 3))
        };
        let areas = SHOWN_ERROR_THRESHOLDS.map(|threshold| area(threshold).unwrap_or_default());
        table.push([(*name).to_owned()].into_iter().chain(areas).collect());
    }
    writeln!(out)?;
    table.write(out)
}

/// By element, of matched structures and of all; nothing if all groups have one element.
fn write_elements(out: &mut dyn Write, groups: &[(&str, &ComparedGroup)]) -> io::Result<()> {
    if groups.iter().all(|(_, group)| group.elements.len() < 2) {
        return Ok(());
    }
    let area = format!(">ROC-AUC(γ_nbr), {LARGE_FORCE_ERROR} eV/Å");
    let mut table =
        TextTable::new(&["element", "", ">atoms", ">median |ΔF| (eV/Å)", ">ρ(γ)", ">ρ(γ_nbr)", &area]);
    let mut numbered: Vec<_> = groups
        .iter()
        .filter(|(name, _)| name.starts_with("matched") || *name == "pooled all")
        .flat_map(|(name, group)| group.elements.iter().map(move |element| (*name, element)))
        .collect();
    // Stable: the groups of an element stay in order.
    numbered.sort_by_key(|(_, element)| element.element);
    for (name, element) in numbered {
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

//! Force error against either grade, for all labelled atoms, with nested percentile bands (as the paper's Fig. 2).

use ::figures::{AxisScale, Colour, Figure, LegendKey, Panel, legend};
use analysis::{binned_quantiles, logarithmic_edges, spearman};
use wire::Origin;

use super::super::collections::{CollectedAtom, Collections};
use super::super::style::{WIDTH, axis, grouped};
use super::super::{Csv, FigureContent, csv};
use super::errors::{MIN_ATOMS, middle, ribbons};
use super::{NO_LABELS, row};

/// A quantity of an atom.
type CollectedQuantity = fn(&CollectedAtom) -> f64;

/// Number of bins of a panel.
const BINS: usize = 18;

pub fn draw(collections: &Collections) -> Result<FigureContent, String> {
    let atoms = |origin: Origin| collections.both()[usize::from(origin == Origin::Control)].1.atoms.items();
    let labelled = atoms(Origin::Biased).chain(atoms(Origin::Control)).filter(|atom| atom.error.is_some());
    let labelled: Vec<CollectedAtom> = labelled.copied().collect();
    if labelled.is_empty() {
        return Err(NO_LABELS.into());
    }
    let description = "Percentiles of the force error against both grades";
    let mut figure = Figure::new("grades", description, WIDTH, 226.0);
    let mut numbers =
        Csv::new(&["panel", "low", "high", "atoms", "p5", "p10", "p25", "median", "p75", "p90", "p95"]);
    let panels: [(char, &str, CollectedQuantity); 2] =
        [('a', "γ", |atom| atom.gamma), ('b', "γ_{nbr}", |atom| atom.gamma_nbr)];
    let mut correlations = Vec::new();
    for ((letter, title, of), place) in panels.into_iter().zip(row(2, [46.0, 56.0, 12.0], 28.0, 162.0)) {
        let pairs = labelled.iter().filter_map(|atom| Some((of(atom), atom.error?)));
        let pairs: Vec<_> = pairs.filter(|(x, y)| x.is_finite() && y.is_finite()).collect();
        let (grades, errors): (Vec<_>, Vec<_>) = pairs.iter().copied().unzip();
        let x = axis(title, AxisScale::Logarithmic, &grades, Some(1.0));
        let y = axis("force error (eV Å^{−1})", AxisScale::Logarithmic, &errors, None);
        let edges = logarithmic_edges(x.low, x.high, BINS);
        let found = binned_quantiles(&edges, pairs);
        let mut panel = Panel::new(place, x, y);
        panel.vertical_line(1.0);
        for (ends, opacity) in [([0, 6], 0.13), ([1, 5], 0.2), ([2, 4], 0.3)] {
            ribbons(&mut panel, &found, ends, Colour::BLUE.faint(opacity));
        }
        for run in found.split(|band| band.number < MIN_ATOMS) {
            let median = |band: &analysis::QuantileBin| Some([middle(&panel, band), band.quantiles?[3]]);
            let points: Vec<_> = run.iter().filter_map(median).collect();
            panel.line(points, Colour::INK.dashed(1.3));
        }
        panel.panel_letter(letter);
        panel.draw(&mut figure);
        for band in &found {
            let mut cells = vec![letter.to_string(), csv::number(band.low), csv::number(band.high)];
            cells.push(band.number.to_string());
            cells.extend((0..7).map(|k| csv::number(band.quantiles.map(|quantiles| quantiles[k]))));
            numbers.push(&cells);
        }
        let rho = spearman(&grades, &errors).map_or("unknown".to_owned(), |rho| format!("{rho:.3}"));
        correlations
            .push(format!("{letter}, n = {} atoms, Spearman’s ρ = {rho}", grouped(grades.len() as u64)));
    }
    let keys = [
        (LegendKey::Line(Colour::INK.dashed(1.3)), "median"),
        (LegendKey::Area(Colour::BLUE.faint(0.5)), "P_{25}–P_{75}"),
        (LegendKey::Area(Colour::BLUE.faint(0.3)), "P_{10}–P_{90}"),
        (LegendKey::Area(Colour::BLUE.faint(0.13)), "P_{5}–P_{95}"),
    ];
    legend(&mut figure, [WIDTH - 8.0, 12.0], &keys);
    let caption = format!(
        "Force error |F_{{model}} − F_{{label}}| of all labelled atoms, of biased and control walks together, against (a) the grade γ and \
         (b) its average over the neighbourhood, γ_{{nbr}}, both under the original mixture. Black, medians; bands, P_{{25}}–P_{{75}}, \
         P_{{10}}–P_{{90}} and P_{{5}}–P_{{95}}, in bins of equal width on the logarithmic axis with at least {MIN_ATOMS} atoms. Dashed \
         grey, the calibrated threshold 1. {}.{}",
        correlations.join("; "),
        collections.of_version()
    );
    Ok(FigureContent { figure, caption, numbers })
}

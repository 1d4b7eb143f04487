//! Grades and force errors of biased walks against those of control walks.

use ::figures::{AxisScale, Figure, Panel};
use analysis::{Histogram, logarithmic_edges, quantile};
use wire::Origin;

use super::super::collections::{CollectedAtom, Collections};
use super::super::style::{WIDTH, axis, grouped, origins};
use super::super::{Csv, FigureContent};
use super::{NOTHING_COLLECTED, draw_histograms, origins_of, push_histograms, row, share_axis};

/// A quantity of an atom.
type AtomQuantity = fn(&CollectedAtom) -> Option<f64>;

/// Number of bins of a panel.
const BINS: usize = 40;

pub fn draw(collections: &Collections) -> Result<FigureContent, String> {
    let shown = origins_of(collections);
    if shown.is_empty() {
        return Err(NOTHING_COLLECTED.into());
    }
    let description = "Distributions of grades and force errors of biased and control walks";
    let mut figure = Figure::new("distributions", description, WIDTH, 168.0);
    let mut numbers = Csv::new(&["panel", "origin", "low", "high", "atoms"]);
    let panels: [(char, &str, AtomQuantity); 3] = [
        ('a', "γ", |atom| Some(atom.gamma)),
        ('b', "γ_{nbr}", |atom| Some(atom.gamma_nbr)),
        ('c', "force error (eV Å^{−1})", |atom| atom.error),
    ];
    let places = row(3, [40.0, 40.0, 10.0], 26.0, 106.0);
    for ((letter, title, of), place) in panels.into_iter().zip(places) {
        let values = |origin: Origin| -> Vec<f64> {
            let (_, collection) = collections.both()[usize::from(origin == Origin::Control)];
            collection.atoms.items().filter_map(of).filter(|x| x.is_finite()).collect()
        };
        let all: Vec<f64> = shown.iter().flat_map(|origin| values(*origin)).collect();
        let x = axis(title, AxisScale::Logarithmic, &all, (letter != 'c').then_some(1.0)).with_ticks(4);
        let edges = logarithmic_edges(x.low, x.high, BINS);
        let known = |origin: &Origin| !values(*origin).is_empty();
        let histogram = |origin: &Origin| (*origin, Histogram::from_values(edges.clone(), values(*origin)));
        let histograms: Vec<_> = shown.iter().filter(|origin| known(origin)).map(histogram).collect();
        let y = share_axis("atoms (%)", &histograms);
        let mut panel = Panel::new(place, x, if letter == 'a' { y } else { y.with_title("") });
        if histograms.is_empty() {
            panel.placeholder("no labels yet");
        }
        draw_histograms(&mut panel, &histograms);
        if letter != 'c' {
            panel.vertical_line(1.0);
        }
        panel.panel_letter(letter);
        push_histograms(&mut numbers, &letter.to_string(), &histograms);
        panel.draw(&mut figure);
    }
    origins(&mut figure, &shown);
    Ok(FigureContent { figure, caption: caption(collections, &shown), numbers })
}

fn caption(collections: &Collections, shown: &[Origin]) -> String {
    let of = |origin: &Origin| {
        let (_, collection) = collections.both()[usize::from(*origin == Origin::Control)];
        let atoms = &collection.atoms;
        let mut grades: Vec<_> = atoms.items().map(|atom| atom.gamma_nbr).filter(|x| x.is_finite()).collect();
        grades.sort_by(f64::total_cmp);
        let median = quantile(&grades, 0.5).map_or("unknown".to_owned(), |x| format!("{x:.2}"));
        let errors: Vec<_> = atoms.items().filter_map(|atom| atom.error).filter(|x| x.is_finite()).collect();
        let mean = match errors.len() {
            0 => "no labels".to_owned(),
            n => format!("mean force error {:.3} eV Å^{{−1}}", errors.iter().sum::<f64>() / n as f64),
        };
        let drawn = match (atoms.items().len() as u64) < atoms.total() {
            true => format!(", of which a sample of {} is shown", grouped(atoms.items().len() as u64)),
            false => String::new(),
        };
        format!(
            "{}: {} structures with {} atoms{drawn}, {} structures labelled, median γ_{{nbr}} {median}, {mean}",
            origin.name(),
            grouped(collection.structures.total()),
            grouped(atoms.total()),
            grouped(collection.labelled_of_version),
        )
    };
    let both: Vec<_> = shown.iter().map(of).collect();
    format!(
        "Atoms of all collected structures, under the original mixture. a, Grade γ. b, Its average over the neighbourhood, \
         γ_{{nbr}}. c, Force error |F_{{model}} − F_{{label}}| of the atoms of labelled structures. Dashed, the calibrated \
         threshold 1. Bins have equal widths on the logarithmic axis; axes omit 0.1 % of the atoms at either end. {}.{}{}",
        both.join("; "),
        collections.left_out(),
        collections.of_version()
    )
}

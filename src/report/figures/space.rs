//! Volumes and composition of the collected structures.

use ::figures::{Axis, AxisScale, Figure, Panel, Rectangle};
use analysis::{Histogram, linear_edges};
use wire::Origin;

use super::super::collections::{Collections, StructureSize};
use super::super::style::{WIDTH, axis, grouped, origin_style, origins};
use super::super::{Csv, FigureContent};
use super::{NOTHING_COLLECTED, draw_histograms, origins_of, push_histograms, row, share_axis};

/// A quantity of a structure.
type SizeQuantity = fn(&StructureSize) -> Option<f64>;

/// Number of bins of a histogram.
const BINS: usize = 24;
/// Largest number of elements with bars. Those with the most atoms are shown.
const MAX_ELEMENTS: usize = 12;

pub fn draw(collections: &Collections) -> Result<FigureContent, String> {
    let shown = origins_of(collections);
    if shown.is_empty() {
        return Err(NOTHING_COLLECTED.into());
    }
    let description = "Volumes and elements of collected structures";
    let mut figure = Figure::new("space", description, WIDTH, 168.0);
    let mut numbers = Csv::new(&["panel", "origin", "low", "high", "number"]);
    let places = row(3, [40.0, 44.0, 10.0], 26.0, 106.0);
    let panels: [(char, &str, SizeQuantity); 2] = [
        ('a', "V / V_{0}", |shape| Some(shape.relative_volume)),
        ('b', "volume (Å^{3} per atom)", |shape| shape.volume_per_atom),
    ];
    for ((letter, title, of), place) in panels.into_iter().zip(&places) {
        draw_volumes(&mut figure, &mut numbers, collections, &shown, (letter, title, of), *place);
    }
    draw_elements(&mut figure, &mut numbers, collections, &shown, places[2]);
    origins(&mut figure, &shown);
    let of = |origin: &Origin| {
        let (_, collection) = collections.both()[usize::from(*origin == Origin::Control)];
        let atoms: u64 = collection.elements.values().sum();
        let structures = grouped(collection.structures.total());
        format!("{}: {structures} structures, {} atoms", origin.name(), grouped(atoms))
    };
    let both: Vec<_> = shown.iter().map(of).collect();
    let caption = format!(
        "All collected structures, labelled or not. a, Volume relative to that of the seed structure. b, Volume per atom of \
         structures that are periodic in three directions. c, Share of the atoms by element{}. {}.",
        match collections.biased.elements.len().max(collections.control.elements.len()) > MAX_ELEMENTS {
            true => format!(", the {MAX_ELEMENTS} most frequent of them"),
            false => String::new(),
        },
        both.join("; ")
    );
    Ok(FigureContent { figure, caption, numbers })
}

fn draw_volumes(
    figure: &mut Figure,
    numbers: &mut Csv,
    collections: &Collections,
    shown: &[Origin],
    (letter, title, of): (char, &str, SizeQuantity),
    place: Rectangle,
) {
    let values = |origin: &Origin| -> Vec<f64> {
        let (_, collection) = collections.both()[usize::from(*origin == Origin::Control)];
        collection.structures.items().filter_map(of).filter(|x| x.is_finite()).collect()
    };
    let all: Vec<_> = shown.iter().flat_map(values).collect();
    let x = axis(title, AxisScale::Linear, &all, None).with_ticks(4);
    let edges = linear_edges(x.low, x.high, BINS);
    let shown = shown.iter().filter(|origin| !values(origin).is_empty());
    let histogram = |origin: &Origin| (*origin, Histogram::from_values(edges.clone(), values(origin)));
    let histograms: Vec<_> = shown.map(histogram).collect();
    let y = share_axis(if letter == 'a' { "structures (%)" } else { "" }, &histograms);
    let mut panel = Panel::new(place, x, y);
    if histograms.is_empty() {
        panel.placeholder("no periodic cell");
    }
    draw_histograms(&mut panel, &histograms);
    panel.panel_letter(letter);
    push_histograms(numbers, &letter.to_string(), &histograms);
    panel.draw(figure);
}

fn draw_elements(
    figure: &mut Figure,
    numbers: &mut Csv,
    collections: &Collections,
    shown: &[Origin],
    place: Rectangle,
) {
    let mut elements: Vec<_> =
        collections.biased.elements.keys().chain(collections.control.elements.keys()).collect();
    let of = |element: &atoms::Species, origin: Origin| {
        let (_, collection) = collections.both()[usize::from(origin == Origin::Control)];
        let all: u64 = collection.elements.values().sum();
        let number = collection.elements.get(element).copied().unwrap_or_default();
        (number, 100.0 * number as f64 / all.max(1) as f64)
    };
    elements.sort_unstable();
    elements.dedup();
    for element in &elements {
        for origin in shown {
            let symbol = element.symbol().to_owned();
            let (name, number) = (origin.name().to_owned(), of(element, *origin).0.to_string());
            numbers.push(&["c".to_owned(), name, symbol, String::new(), number]);
        }
    }
    let number = |element: &atoms::Species| of(element, Origin::Biased).0 + of(element, Origin::Control).0;
    elements.sort_by_key(|element| (std::cmp::Reverse(number(element)), **element));
    elements.truncate(MAX_ELEMENTS);
    let names: Vec<_> = elements.iter().map(|element| element.symbol().to_owned()).collect();
    let shares = elements.iter().flat_map(|element| shown.iter().map(|origin| of(element, *origin).1));
    let y = Axis::new("atoms (%)", AxisScale::Linear, 0.0, 1.08 * shares.fold(0.0, f64::max));
    let mut panel = Panel::new(place, Axis::categorical("element", &names), y);
    let width = 0.7 / shown.len() as f64;
    for (k, element) in elements.iter().enumerate() {
        for (n, origin) in shown.iter().enumerate() {
            let (left, style) = (k as f64 + 0.15 + width * n as f64, origin_style(*origin));
            let (_, share) = of(element, *origin);
            panel.bar([left, 0.0], [left + width, share], style.colour.faint(0.3));
            panel.line([[left, 0.0], [left, share], [left + width, share], [left + width, 0.0]], style.line);
        }
    }
    panel.panel_letter('c');
    panel.draw(figure);
}

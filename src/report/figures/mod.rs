//! The figures, a file each: from numbers to a drawing with its caption and its numbers.

mod collection;
mod completion;
mod cost;
mod distributions;
mod errors;
mod grades;
mod projection;
mod space;

use ::figures::{Axis, Panel, Rectangle, Scale};
use analysis::Histogram;
use wire::Origin;

use super::gathered::Gathered;
use super::sample::Sample;
use super::style::look;
use super::{Csv, Part, csv};

/// All of them, in the order of the page.
pub fn all(gathered: &Gathered) -> Vec<Part> {
    let part = |name, title, drawn| Part { name, title, drawn };
    vec![
        part("collection", "What was collected", collection::draw(gathered)),
        part("distributions", "Grades and force errors", distributions::draw(&gathered.sample)),
        part(
            "errors",
            "Force errors where structures are new, and where they are stretched",
            errors::draw(&gathered.sample),
        ),
        part("space", "Volumes and composition", space::draw(&gathered.sample)),
        part("features", "Feature space", projection::draw(&gathered.sample)),
        part("grades", "Force errors by grade", grades::draw(&gathered.sample)),
        part("cost", "What labels cost", cost::draw(gathered)),
        part("completion", "Structures that got their labels", completion::draw(gathered)),
    ]
}

/// Steps of a histogram as a panel shows them: shares in percent, of either origin.
fn draw_histograms(panel: &mut Panel, histograms: &[(Origin, Histogram)]) {
    for (origin, histogram) in histograms {
        let look = look(*origin);
        let (edges, shares) = (histogram.edges(), histogram.fractions());
        let mut outline = vec![[edges[0], 0.0]];
        for (edges, share) in edges.windows(2).zip(&shares) {
            outline.extend([[edges[0], 100.0 * share], [edges[1], 100.0 * share]]);
        }
        outline.push([edges[edges.len() - 1], 0.0]);
        panel.polygons([outline.clone()], Some(look.colour.faint(0.18)), None);
        panel.line(outline, look.line);
    }
}

/// A vertical axis for histograms.
fn share_axis(title: &str, histograms: &[(Origin, Histogram)]) -> Axis {
    let largest = histograms.iter().flat_map(|(_, histogram)| histogram.fractions()).fold(0.0, f64::max);
    Axis::new(title, Scale::Linear, 0.0, 108.0 * largest.max(1e-6))
}

/// Adds the bins of histograms to the numbers of a figure: panel, origin, lower edge, upper edge, count.
fn push_histograms(numbers: &mut Csv, panel: &str, histograms: &[(Origin, Histogram)]) {
    for (origin, histogram) in histograms {
        for (edges, count) in histogram.edges().windows(2).zip(histogram.counts()) {
            let cells =
                [panel.to_owned(), origin.name().to_owned(), csv::number(edges[0]), csv::number(edges[1])];
            numbers.push(&[&cells[..], &[count.to_string()]].concat());
        }
    }
}

/// The origins of which something was collected.
fn origins_of(sample: &Sample) -> Vec<Origin> {
    let both = sample.both().into_iter();
    both.filter(|(_, of)| of.structures.total() > 0).map(|(origin, _)| origin).collect()
}

/// Places of `number` panels beside each other, with room for the words at their axes.
fn row(number: usize, [left, gap, right]: [f64; 3], top: f64, height: f64) -> Vec<Rectangle> {
    let n = number as f64;
    let width = (super::style::WIDTH - left - right - gap * (n - 1.0)) / n;
    (0..number).map(|k| Rectangle { x: left + k as f64 * (width + gap), y: top, width, height }).collect()
}

/// Why nothing is shown of a campaign that has collected nothing.
const NOTHING_COLLECTED: &str = "No structure has been collected yet.";
/// Why nothing is shown of force errors.
const NO_LABELS: &str = "No structure has a label yet, so no force error is known.";

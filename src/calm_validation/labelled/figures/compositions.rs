//! Errors and grades by the composition of labelled structures (the paper's Fig. 4b and c, and 4a of labelled structures).

use ::figures::{Anchor, Axis, AxisScale, Colour, Figure, LegendKey, Marker, Panel, Rectangle, legend};

use super::super::report::{CompositionGroup, CompositionScan, ErrorSpread, LabelledReport, TrainingErrors};
use super::stroke;
use crate::csv::{Csv, number};
use crate::page::style::{WIDTH, axis, row};
use crate::page::{FigureContent, FigureEntry};

/// Height of a row of panels, and of one with room for its titles, points.
const PANEL: f64 = 120.0;
const ROW: f64 = 170.0;
const TOP: f64 = 36.0;
/// Scores whose means are drawn: γ and γ_nbr.
const SHOWN: usize = 2;

/// `None` if all structures have one composition.
pub fn draw(report: &LabelledReport, training: Option<TrainingErrors>) -> Option<FigureEntry> {
    if report.compositions.is_empty() {
        return None;
    }
    let description = "Errors of energy and forces and mean grades by composition";
    let height = TOP + ROW * report.compositions.len() as f64 - 8.0;
    let mut figure = Figure::new("composition-errors", description, WIDTH, height);
    let titles =
        ["element", "share", "quantity", "number", "mean", "p10", "p25", "median", "p75", "p90", "beyond"];
    let mut numbers = Csv::new(&titles);
    let names: Vec<_> = shown(report).map(|(k, name)| (LegendKey::Line(stroke(k)), name)).collect();
    legend(&mut figure, [WIDTH - 8.0, 12.0], &names);
    for (k, scan) in report.compositions.iter().enumerate() {
        let places = row(3, [46.0, 54.0, 8.0], TOP + ROW * k as f64, PANEL);
        draw_scan(&mut figure, (report, training), scan, &places, 3 * k);
        scan.groups.iter().for_each(|group| push(&mut numbers, report, scan, group));
    }
    let known = training.map_or("", |_| "; dashed, that on the training data");
    let caption = format!(
        "Errors of labelled structures by the share of an element among their atoms, to the nearest 10 %. Left, error of the \
                   energy per atom without the offsets of the elements; middle, force error |F_{{model}} − F_{{label}}| of an atom. Line, mean{known}; \
                   bands, P_{{25}}–P_{{75}} and P_{{10}}–P_{{90}}; ρ, Spearman’s ρ of the energy error and the mean γ of a structure, and of the \
                   force error and γ of an atom, over all compositions. Right, mean grade of the atoms; dashed, its limit."
    );
    let drawn = Ok(FigureContent { figure, caption, numbers });
    Some(FigureEntry { name: "composition-errors".into(), title: "Errors by composition", drawn })
}

/// Number and name of the scores that are drawn: the first with a limit.
fn shown(report: &LabelledReport) -> impl Iterator<Item = (usize, &str)> {
    let limited = report.scores.iter().enumerate().filter(|(_, score)| score.limit.is_some());
    limited.map(|(k, score)| (k, score.name.as_str())).take(SHOWN)
}

/// One of the errors of a group.
type SpreadOfGroup = fn(&CompositionGroup) -> Option<ErrorSpread>;

fn draw_scan(
    figure: &mut Figure,
    (report, training): (&LabelledReport, Option<TrainingErrors>),
    scan: &CompositionScan,
    places: &[Rectangle],
    first: usize,
) {
    let share = || Axis::new(&format!("{} (%)", scan.element), AxisScale::Linear, 0.0, 100.0);
    let gamma = report.scores.first();
    let ranks = [gamma.and_then(|score| score.energy_spearman), gamma.and_then(|score| score.spearman.value)];
    let errors: [(&str, f64, SpreadOfGroup); 2] = [
        ("energy error (meV/atom)", 1000.0, |group| group.energy),
        ("force error (eV Å^{−1})", 1.0, |group| group.forces),
    ];
    let known = [training.and_then(|errors| errors.energy), training.and_then(|errors| errors.force)];
    let panels = errors.into_iter().zip(ranks).zip(known).enumerate();
    for (k, (((title, factor, of), rho), known)) in panels {
        let known = known.map(|error| factor * error);
        let point = |group: &CompositionGroup| {
            of(group).map(|errors| {
                (100.0 * group.share, factor * errors.mean, errors.quantiles.map(|error| factor * error))
            })
        };
        let points: Vec<_> = scan.groups.iter().filter_map(point).collect();
        let values: Vec<_> =
            points.iter().flat_map(|(_, mean, quantiles)| quantiles.iter().chain([mean])).copied().collect();
        let mut panel = Panel::new(places[k], share(), axis(title, AxisScale::Logarithmic, &values, known));
        for (low, high, opacity) in [(0, 4, 0.15), (1, 3, 0.25)] {
            let band = points.iter().map(|(x, _, quantiles)| (*x, quantiles[low], quantiles[high]));
            panel.band(&band.collect::<Vec<_>>(), Colour::BLUE.faint(opacity));
        }
        let means: Vec<_> = points.iter().map(|(x, mean, _)| [*x, *mean]).collect();
        panel.line(means.clone(), Colour::BLUE.line(1.2));
        panel.dots(means, Marker::Disc, 1.8, Colour::BLUE, None);
        if let Some(known) = known {
            panel.line([[0.0, known], [100.0, known]], Colour::INK.dashed(0.9));
        }
        if points.is_empty() {
            panel.placeholder("too few labels");
        }
        if let Some(rho) = rho {
            let corner = [panel.x.low, panel.y.high];
            panel.text(corner, [4.0, 10.0], &format!("ρ = {rho:.3}"), Anchor::Start);
        }
        finish(figure, panel, first + k);
    }
    let mean = |group: &CompositionGroup, k: usize| group.scores.get(k).map(|score| score.mean);
    let curves: Vec<_> = shown(report)
        .map(|(k, _)| {
            let point = |group: &CompositionGroup| Some([100.0 * group.share, mean(group, k)?]);
            (k, scan.groups.iter().filter_map(point).collect::<Vec<_>>())
        })
        .collect();
    let values: Vec<_> = curves.iter().flat_map(|(_, points)| points).map(|[_, y]| *y).collect();
    let y = axis("mean grade", AxisScale::Logarithmic, &values, Some(1.0));
    let mut panel = Panel::new(places[2], share(), y);
    panel.line([[0.0, 1.0], [100.0, 1.0]], Colour::GREY.dashed(0.7));
    for (k, points) in curves {
        panel.line(points.clone(), stroke(k));
        panel.dots(points, Marker::Disc, 1.8, stroke(k).paint, None);
    }
    finish(figure, panel, first + 2);
}

fn finish(figure: &mut Figure, mut panel: Panel, number: usize) {
    panel.panel_letter(u8::try_from(number).map_or(' ', |number| char::from(b'a' + number)));
    panel.draw(figure);
}

fn push(numbers: &mut Csv, report: &LabelledReport, scan: &CompositionScan, group: &CompositionGroup) {
    let head = |quantity: &str| [scan.element.to_owned(), number(group.share), ::figures::plain(quantity)];
    let errors = [("energy error (eV/atom)", group.energy), ("force error (eV/Å)", group.forces)];
    for (quantity, errors) in errors {
        let Some(ErrorSpread { number: counted, mean, quantiles }) = errors else { continue };
        let mut cells = head(quantity).to_vec();
        cells.extend([counted.to_string(), number(mean)]);
        cells.extend(quantiles.map(number));
        cells.push(String::new());
        numbers.push(&cells);
    }
    for (score, found) in report.scores.iter().zip(&group.scores) {
        let mut cells = head(&score.name).to_vec();
        cells.extend([group.atoms.to_string(), number(found.mean)]);
        cells.extend([const { String::new() }; 5]);
        cells.push(number(found.beyond));
        numbers.push(&cells);
    }
}

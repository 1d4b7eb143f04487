//! Error of a structure against its grade, and errors on either side of grade 1 (the paper's figure of the benchmark, panels a and b).

use analysis::{GradedRow, Histogram, QuantileBin, binned_quantiles, decade_edges, quantile};
use figures::{Anchor, Axis, AxisScale, Colour, Figure, MarginalSide, Panel, Point, Rectangle};

use crate::csv::{Csv, number};
use crate::output::decimals;
use crate::page::FigureContent;
use crate::page::style::{WIDTH, axis};

/// The grade at which structures are divided.
const LIMIT: f64 = 1.0;
/// Bins with fewer structures are not drawn.
const MIN_STRUCTURES: u64 = 20;
/// Columns of [`QuantileBin::quantiles`]: bands from 10 to 90 and from 25 to 75 % with their opacity, and the median.
const BANDS: [(usize, usize, f64); 2] = [(1, 5, 0.15), (2, 4, 0.25)];
const MEDIAN: usize = 3;
const COLOURS: [Colour; 2] = [Colour::BLUE, Colour::VERMILLION];

/// The errors of the structures on one side of the limit.
struct Side {
    /// Structures, those outside the bins included.
    all: usize,
    counts: Vec<u64>,
    mean: Option<f64>,
    median: Option<f64>,
}

/// The figure. `grade` is the title of the grade's column.
pub fn draw(rows: &[GradedRow], grade: &str) -> Result<FigureContent, String> {
    let grades = decade_edges(rows.iter().map(|row| row.grade), Some(0.1 * LIMIT));
    let edges = decade_edges(rows.iter().map(|row| row.error.abs()), None);
    if grades.is_empty() || edges.is_empty() {
        return Err("No structure has a grade above zero, or none has an error.".into());
    }
    let bins = binned_quantiles(&grades, rows.iter().map(|row| (row.grade, row.error.abs())));
    let sides = [true, false].map(|within| Side::new(rows, &edges, within));
    let mut figure = Figure::new("errors", "Errors of structures against their grade", WIDTH, 246.0);
    let place = |x, width| Rectangle { x, y: 56.0, width, height: 146.0 };
    let [x, y] = draw_bins(&mut figure, &bins, grade, place(46.0, 162.0));
    draw_grades(&mut figure, &bins, x, place(46.0, 162.0));
    draw_errors(&mut figure, &sides, &edges, y, place(46.0, 162.0));
    draw_sides(&mut figure, &sides, &edges, place(304.0, 192.0));
    let caption = format!(
        "Absolute errors, in the unit of the table. a, against the grade {grade}: dashed, median; grey, mean; bands, P_{{25}}–P_{{75}} and \
         P_{{10}}–P_{{90}}, in ten bins a decade with at least {MIN_STRUCTURES} structures each; margins, distribution of the grade, and of the \
         errors on either side of grade 1 by themselves. b, distribution for the grades up to 1 (blue) \
         and above (red), as shares of all its structures. Not drawn are errors of zero, and those \
         that are both six decades below the largest and three below the median."
    );
    Ok(FigureContent { figure, caption, numbers: numbers(&bins, &sides, &edges) })
}

impl Side {
    fn new(rows: &[GradedRow], edges: &[f64], within: bool) -> Self {
        let rows = rows.iter().filter(|row| (row.grade <= LIMIT) == within);
        let mut errors: Vec<_> = rows.map(|row| row.error.abs()).collect();
        errors.sort_by(f64::total_cmp);
        let sum = errors.iter().sum::<f64>();
        Self {
            all: errors.len(),
            mean: (!errors.is_empty()).then(|| sum / errors.len() as f64),
            median: quantile(&errors, 0.5),
            counts: Histogram::from_values(edges.to_vec(), errors).counts().to_vec(),
        }
    }

    /// Outline of the histogram of shares, from zero to zero.
    fn outline(&self, edges: &[f64]) -> Vec<Point> {
        let all = self.all.max(1) as f64;
        let steps = edges.windows(2).zip(&self.counts);
        let steps = steps.flat_map(|(edges, count)| [edges[0], edges[1]].map(|x| [x, *count as f64 / all]));
        let (first, last) = ([edges[0], 0.0], [edges[edges.len() - 1], 0.0]);
        [first].into_iter().chain(steps).chain([last]).collect()
    }
}

/// Whether all structures of a bin have a grade up to the limit.
fn is_within(bin: &QuantileBin) -> bool {
    bin.high <= LIMIT * (1.0 + 1e-9)
}

fn colour(bin: &QuantileBin) -> Colour {
    COLOURS[usize::from(!is_within(bin))]
}

/// Draws panel a, and returns its axes.
fn draw_bins(figure: &mut Figure, bins: &[QuantileBin], grade: &str, place: Rectangle) -> [Axis; 2] {
    let is_shown = |bin: &&QuantileBin| bin.number >= MIN_STRUCTURES;
    let shown = || bins.iter().filter(is_shown);
    let values: Vec<_> = shown().filter_map(|bin| bin.quantiles).flat_map(|q| [q[1], q[5]]).collect();
    let ends: Vec<_> = shown().flat_map(|bin| [bin.low, bin.high]).collect();
    let x = axis(grade, AxisScale::Logarithmic, &ends, Some(LIMIT));
    let y = axis("absolute error", AxisScale::Logarithmic, &values, None);
    let mut panel = Panel::new(place, x.clone(), y.clone());
    let middle = |bin: &QuantileBin| (bin.low * bin.high).sqrt();
    for run in bins.split(|bin| bin.number < MIN_STRUCTURES) {
        for part in run.chunk_by(|a, b| is_within(a) == is_within(b)) {
            let colour = colour(&part[0]);
            for (low, high, opacity) in BANDS {
                let point = |bin: &QuantileBin| bin.quantiles.map(|q| (middle(bin), q[low], q[high]));
                panel.band(&part.iter().filter_map(point).collect::<Vec<_>>(), colour.faint(opacity));
            }
        }
        let mean = |bin: &QuantileBin| bin.mean.map(|mean| [middle(bin), mean]);
        panel.line(run.iter().filter_map(mean), Colour::GREY.line(1.0));
        let median = |bin: &QuantileBin| bin.quantiles.map(|q| [middle(bin), q[MEDIAN]]);
        panel.line(run.iter().filter_map(median), Colour::INK.dashed(1.1));
    }
    if shown().next().is_none() {
        panel.placeholder("too few structures");
    }
    panel.vertical_line(LIMIT);
    panel.panel_letter('a');
    panel.draw(figure);
    [x, y]
}

/// Distribution of the grade, above panel a.
fn draw_grades(figure: &mut Figure, bins: &[QuantileBin], x: Axis, place: Rectangle) {
    let above = Rectangle { y: place.y - 31.0, height: 28.0, ..place };
    let most = bins.iter().map(|bin| bin.number).max().unwrap_or(0) as f64;
    let count = Axis::new("", AxisScale::Linear, 0.0, 1.05 * most).without_ticks();
    let mut panel = Panel::new(above, x.with_title("").without_ticks(), count);
    for bin in bins.iter().filter(|bin| bin.number > 0) {
        panel.bar([bin.low, 0.0], [bin.high, bin.number as f64], colour(bin).faint(0.3));
    }
    panel.draw_as_margin(figure, MarginalSide::Below);
}

/// Distributions of the errors of either side, to the right of panel a.
fn draw_errors(figure: &mut Figure, sides: &[Side; 2], edges: &[f64], y: Axis, place: Rectangle) {
    let right = Rectangle { x: place.right() + 3.0, width: 30.0, ..place };
    let outlines = sides.each_ref().map(|side| side.outline(edges));
    let most = outlines.iter().flatten().map(|[_, share]| *share).fold(0.0, f64::max);
    let share = Axis::new("", AxisScale::Linear, 0.0, 1.05 * most).without_ticks();
    let mut panel = Panel::new(right, share, y.with_title("").without_ticks());
    for (outline, colour) in outlines.into_iter().zip(COLOURS) {
        let outline: Vec<_> = outline.into_iter().map(|[error, share]| [share, error]).collect();
        panel.polygons([outline.clone()], Some(colour.faint(0.18)), None);
        panel.line(outline, colour.line(0.9));
    }
    panel.draw_as_margin(figure, MarginalSide::Left);
}

fn draw_sides(figure: &mut Figure, sides: &[Side; 2], edges: &[f64], place: Rectangle) {
    let outlines = sides.each_ref().map(|side| side.outline(edges));
    let most = outlines.iter().flatten().map(|[_, share]| *share).fold(0.0, f64::max);
    let x = Axis::new("absolute error", AxisScale::Logarithmic, edges[0], edges[edges.len() - 1]);
    // Room for the words.
    let mut panel =
        Panel::new(place, x, Axis::new("share of the structures", AxisScale::Linear, 0.0, 1.35 * most));
    let top = [panel.x.low, panel.y.high];
    for (k, (side, outline)) in sides.iter().zip(outlines).enumerate() {
        panel.polygons([outline.clone()], Some(COLOURS[k].faint(0.18)), None);
        panel.line(outline, COLOURS[k].line(0.9));
        let [mean, median] = [side.mean, side.median].map(|error| decimals(error, 4));
        let words = format!("{} 1: mean {mean}, median {median}", ["≤", ">"][k]);
        panel.text(top, [4.0, 10.0 + 10.0 * k as f64], &words, Anchor::Start).colour = COLOURS[k];
    }
    panel.panel_letter('b');
    panel.draw(figure);
}

/// Bins of the grade, then bins of the error on either side.
fn numbers(bins: &[QuantileBin], sides: &[Side; 2], edges: &[f64]) -> Csv {
    let titles = ["what", "low", "high", "structures", "mean", "p10", "p25", "median", "p75", "p90"];
    let mut csv = Csv::new(&titles);
    for bin in bins {
        let mut cells = vec!["error by grade".to_owned(), number(bin.low), number(bin.high)];
        cells.extend([bin.number.to_string(), number(bin.mean)]);
        cells.extend((1..6).map(|k| number(bin.quantiles.map(|quantiles| quantiles[k]))));
        csv.push(&cells);
    }
    for (what, side) in ["errors up to grade 1", "errors above grade 1"].into_iter().zip(sides) {
        for (edges, count) in edges.windows(2).zip(&side.counts) {
            let mut cells = vec![what.to_owned(), number(edges[0]), number(edges[1]), count.to_string()];
            cells.extend([const { String::new() }; 6]);
            csv.push(&cells);
        }
    }
    csv
}

#[cfg(test)]
mod tests {
    use figures::to_svg;

    use super::*;

    fn row(grade: f64, error: f64) -> GradedRow {
        GradedRow { grade, error, class: None }
    }

    #[test]
    fn structures_are_divided_at_grade_1() {
        let rows: Vec<_> = (1..=40).map(|k| row(0.05 * f64::from(k), -0.1 * f64::from(k))).collect();
        let edges = decade_edges(rows.iter().map(|row| row.error.abs()), None);
        let [within, beyond] = [true, false].map(|is_within| Side::new(&rows, &edges, is_within));
        assert_eq!([&within, &beyond].map(|side| side.counts.iter().sum::<u64>()), [20, 20]);
        assert!((within.mean.unwrap() - 1.05).abs() < 1e-12 && (beyond.mean.unwrap() - 3.05).abs() < 1e-12);
        let outline = within.outline(&edges);
        assert_eq!((outline.len(), outline[0][1]), (2 * edges.len(), 0.0));
        // Shares are of all structures, also of those outside the bins.
        let with_zero: Vec<_> = [row(0.1, 0.0), row(0.1, 1.0)].into();
        let outline = Side::new(&with_zero, &edges, true).outline(&edges);
        assert_eq!(outline.iter().map(|[_, share]| *share).fold(0.0, f64::max), 0.5);
        let drawn = draw(&rows, "gamma_max").unwrap();
        let svg = to_svg(&drawn.figure);
        assert!(!svg.contains("NaN"));
        // Two panels and two margins have places of their own.
        assert_eq!(svg.matches("<clipPath").count(), 4, "{svg}");
        // The margin of the grade has a bar for each bin with structures, blue up to 1.
        let margin = svg.split("<clipPath").nth(2).and_then(|rest| rest.split('"').nth(1)).unwrap();
        let bars = |colour: &str| {
            let is_bar = |line: &&str| line.contains(margin) && line.contains(colour);
            svg.lines().filter(|line| line.starts_with("<path")).filter(is_bar).count()
        };
        let grades = decade_edges(rows.iter().map(|row| row.grade), Some(0.1));
        let bins = Histogram::from_values(grades.clone(), rows.iter().map(|row| row.grade));
        let filled = grades.windows(2).zip(bins.counts()).filter(|(_, count)| **count > 0);
        let (within, beyond): (Vec<_>, Vec<_>) = filled.partition(|(edges, _)| edges[1] < 1.01);
        assert_eq!([bars("#0072b2"), bars("#d55e00")], [within.len(), beyond.len()]);
        let text = String::from_utf8(drawn.numbers.into_bytes()).unwrap();
        let counted = |what: &str| -> u64 {
            let rows = text.lines().filter(|line| line.starts_with(what));
            rows.map(|line| line.split(',').nth(3).unwrap().parse::<u64>().unwrap()).sum()
        };
        assert_eq!(["error by grade", "errors up to", "errors above"].map(counted), [40, 20, 20]);
    }

    #[test]
    fn one_failed_structure_leaves_the_others_in_their_bins() {
        let rows: Vec<_> = (1..=40).map(|k| row(0.05 * f64::from(k), 0.1 * f64::from(k))).collect();
        let failed = [row(1e9, 1e12)];
        let drawn = draw(&[&rows[..], &failed].concat(), "gamma_max").unwrap();
        let text = String::from_utf8(drawn.numbers.into_bytes()).unwrap();
        let counts = text.lines().skip(1).map(|line| line.split(',').nth(3).unwrap().parse::<u64>().unwrap());
        // By grade, and by error on either side.
        assert_eq!(counts.sum::<u64>(), 2 * 41);
    }

    #[test]
    fn nothing_is_drawn_without_errors() {
        assert!(draw(&[row(0.5, 0.0)], "gamma_max").is_err() && draw(&[row(0.0, 1.0)], "gamma_max").is_err());
    }
}

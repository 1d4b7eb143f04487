//! Features projected onto their first two principal components, with 95 % contours (the paper's Fig. 7a).

use ::figures::{Axis, AxisScale, Colour, Figure, Panel, Rectangle};
use analysis::{Density2d, contours};
use wire::Origin;

use super::super::collections::Collections;
use super::super::features::{MAX_ELEMENTS, Plane, ProjectedPoints};
use super::super::style::{WIDTH, grouped, origin_style, origins};
use super::super::{Csv, FigureContent, csv};
use super::NOTHING_COLLECTED;

/// Share of the atoms inside a contour.
const CONTOUR_SHARE: f64 = 0.95;
/// Grid points of a density along each side.
const GRID: usize = 128;
/// Largest number of atoms drawn of each origin.
const MAX_DRAWN: usize = 1500;
/// Minimum number of atoms for a contour.
const MIN_ATOMS: usize = 50;

pub fn draw(collections: &Collections) -> Result<FigureContent, String> {
    if collections.both().iter().all(|(_, of)| of.structures.total() == 0) {
        return Err(NOTHING_COLLECTED.into());
    }
    let planes = collections.features.planes();
    if planes.is_empty() {
        return Err("The store has no features of the collected structures, or they do not differ.".into());
    }
    let columns = planes.len().min(3);
    let rows = planes.len().div_ceil(columns);
    let (side, height) =
        if columns == 1 { (250.0, 200.0) } else { (116.0 + 58.0 * (3 - columns) as f64, 128.0) };
    let gap = (WIDTH - 52.0 - columns as f64 * side) / columns.max(2) as f64;
    let description = "Features of atoms along their first two principal components";
    let mut figure = Figure::new("features", description, WIDTH, 66.0 + rows as f64 * (height + 44.0) - 44.0);
    let mut numbers = Csv::new(&["element", "origin", "what", "line", "pc1", "pc2"]);
    let left = if columns == 1 { 0.5 * (WIDTH - side) + 10.0 } else { 44.0 };
    for (k, plane) in planes.iter().enumerate() {
        let (column, row) = ((k % columns) as f64, (k / columns) as f64);
        let place = Rectangle {
            x: left + column * (side + gap),
            y: 28.0 + row * (height + 44.0),
            width: side,
            height,
        };
        draw_plane(&mut figure, &mut numbers, plane, place, (b'a' + k as u8) as char);
    }
    let shown: Vec<_> = [Origin::Biased, Origin::Control]
        .into_iter()
        .filter(|origin| planes.iter().any(|plane| !plane.points(*origin).atoms.is_empty()))
        .collect();
    origins(&mut figure, &shown);
    Ok(FigureContent { figure, caption: caption(collections, &planes), numbers })
}

impl Plane {
    fn points(&self, origin: Origin) -> &ProjectedPoints {
        if origin == Origin::Biased { &self.biased } else { &self.control }
    }
}

fn draw_plane(figure: &mut Figure, numbers: &mut Csv, plane: &Plane, place: Rectangle, letter: char) {
    let both = [(Origin::Control, &plane.control), (Origin::Biased, &plane.biased)];
    let lines: Vec<_> = both.iter().map(|(origin, points)| (*origin, contours_of(&points.atoms))).collect();
    let all = both
        .iter()
        .flat_map(|(_, points)| &points.atoms)
        .chain(lines.iter().flat_map(|(_, l)| l.iter().flatten()));
    let all: Vec<_> = all.copied().collect();
    let axis = |k: usize| {
        let (low, high) = all.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), point| {
            (low.min(point[k]), high.max(point[k]))
        });
        let margin = 0.05 * (high - low);
        let title = format!("PC {} ({:.1} %)", k + 1, 100.0 * plane.shares[k]);
        Axis::new(&title, AxisScale::Linear, low - margin, high + margin)
    };
    let mut panel = Panel::new(place, axis(0), axis(1));
    for (origin, points) in both {
        let style = origin_style(origin);
        let every = points.atoms.len().div_ceil(MAX_DRAWN).max(1);
        panel.dots(
            points.atoms.iter().step_by(every).copied(),
            style.marker,
            0.7,
            style.colour.faint(0.28),
            None,
        );
        push(numbers, plane, origin, "atom", points.atoms.iter().map(|point| (0, *point)));
    }
    for (origin, lines) in &lines {
        let style = origin_style(*origin);
        let closed = lines.iter().map(|line| line.iter().chain(line.first()).copied());
        panel.polygons(closed.clone(), None, Some(style.line));
        let numbered =
            lines.iter().enumerate().flat_map(|(k, line)| line.iter().map(move |point| (k, *point)));
        push(numbers, plane, *origin, "contour", numbered);
    }
    for (origin, points) in both {
        let style = origin_style(origin);
        let edge = Some(Colour::WHITE.line(0.5));
        panel.dots(points.centroids.iter().copied(), style.marker, 2.1, style.colour, edge);
        push(numbers, plane, origin, "centroid", points.centroids.iter().map(|point| (0, *point)));
    }
    let corner = [panel.x.low, panel.y.high];
    panel.text(corner, [6.0, 11.0], plane.element.symbol(), ::figures::Anchor::Start).bold = true;
    panel.panel_letter(letter);
    panel.draw(figure);
}

fn contours_of(atoms: &[[f64; 2]]) -> Vec<Vec<[f64; 2]>> {
    let density = Some(atoms).filter(|atoms| atoms.len() >= MIN_ATOMS);
    let Some(density) = density.and_then(|atoms| Density2d::from_points(atoms, GRID)) else {
        return Vec::new();
    };
    density.level(atoms, CONTOUR_SHARE).map_or(Vec::new(), |level| contours(&density, level))
}

fn push(
    numbers: &mut Csv,
    plane: &Plane,
    origin: Origin,
    what: &str,
    points: impl IntoIterator<Item = (usize, [f64; 2])>,
) {
    for (line, [x, y]) in points {
        let names = [plane.element.symbol(), origin.name(), what].map(str::to_owned);
        numbers.push(&[&names[..], &[line.to_string(), csv::number(x), csv::number(y)]].concat());
    }
}

fn caption(collections: &Collections, planes: &[Plane]) -> String {
    let of = |plane: &Plane| {
        let one = |origin: Origin| {
            let points = plane.points(origin);
            let (seen, kept) = (grouped(points.seen), grouped(points.atoms.len() as u64));
            let structures = points.centroids.len();
            format!("{} {kept} of {seen} atoms, {structures} centroids", origin.name())
        };
        format!("{}: {}, {}", plane.element.symbol(), one(Origin::Biased), one(Origin::Control))
    };
    let all: Vec<_> = planes.iter().map(of).collect();
    let elements = collections.biased.elements.len().max(collections.control.elements.len());
    let chosen = match elements > MAX_ELEMENTS {
        true => format!(" of the {MAX_ELEMENTS} elements with the most atoms"),
        false => String::new(),
    };
    format!(
        "Features z of atoms{chosen}, projected onto the first two principal components of both collections together, one projection for \
         each element; in brackets, the share of the variance. Lines enclose the smallest regions with 95 % of the atoms of either \
         collection, by a Gaussian kernel density with Scott’s bandwidth. Large marks are means of structures, small ones atoms \
         ({MAX_DRAWN} of either collection at most). From {} structures evenly spread over the \
         decision log: {}.{}",
        if planes.is_empty() { "no" } else { "up to 256 biased and 256 control" },
        all.join("; "),
        collections.of_version()
    )
}

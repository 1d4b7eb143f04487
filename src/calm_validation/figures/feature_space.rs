//! Components of the mixture and labelled atoms along the first two principal components of the features (the paper's figure of
//! clusters in the uncertainty feature space).

use std::f64::consts::TAU;

use figures::{Axis, AxisScale, Colour, Figure, LegendKey, Marker, Panel, Rectangle};

use super::super::Validation;
use super::super::feature_plane::{FeaturePlane, MAX_ATOMS, ProjectedComponent};
use super::layout::{PanelGrid, legend_rows, letter, panel_name};
use crate::csv::{self, Csv};
use crate::output;
use crate::page::FigureContent;
use crate::page::style::WIDTH;

/// Radius of the ellipse that holds 95 % of a normal distribution in two dimensions, √(−2 ln 0.05) standard deviations.
const RADIUS: f64 = 2.447_746_830_680_816;
/// Corners of an ellipse.
const CORNERS: usize = 72;
/// Opacity of atoms.
const OPACITY: f64 = 0.35;

pub fn draw(validation: &Validation) -> Result<FigureContent, String> {
    let planes = &validation.feature_planes;
    if planes.is_empty() {
        return Err("The mixture has no statistics of its data, as one from a model’s file, or none of the elements shown has data. If it is \
                    from a model’s file, give its artifact with --artifact."
            .into());
    }
    let grid = PanelGrid { number: planes.len(), height: 128.0, top: 36.0 };
    let description = "Components of the mixture along the first two principal components of the features";
    let mut figure = Figure::new("feature-space", description, WIDTH, grid.total_height());
    let mut numbers = Csv::new(&["element", "what", "number", "x", "y"]);
    let mut keys = vec![
        (LegendKey::Line(Colour::INK.line(0.9)), "component, 95 %".to_owned()),
        (LegendKey::Dot(Marker::Square, Colour::INK.into()), "centroid".into()),
    ];
    if planes.iter().any(|plane| plane.atoms != [0; 2]) {
        keys.push((LegendKey::Dot(Marker::Disc, Colour::BLUE.into()), "labelled atom, γ ≤ 1".into()));
        keys.push((LegendKey::Dot(Marker::Disc, Colour::VERMILLION.into()), "γ > 1".into()));
    }
    legend_rows(&mut figure, &keys);
    let mut facts = Vec::new();
    for (k, plane) in planes.iter().enumerate() {
        facts.push(draw_plane(&mut figure, &mut numbers, plane, grid.panel_rectangle(k), letter(k)));
    }
    let caption = format!(
        "Features along the first two principal components of the data behind the mixture, one projection for each element, with equal scales \
         along both axes; in brackets, the share of the variance. The axes follow from the covariances and centroids of the components, so the \
         data are not read again. Ellipses, 95 % of the normal distribution of each component. The range is that of the components: labelled \
         atoms outside it are counted and not drawn. Of each element, at most {MAX_ATOMS} labelled atoms with γ ≤ 1 and as many with γ > 1 \
         are drawn, evenly from all, so that blue and red are not in proportion. {}.",
        facts.join("; ")
    );
    Ok(FigureContent { figure, caption, numbers })
}

/// Draws an element, and says what is in the panel.
fn draw_plane(
    figure: &mut Figure,
    numbers: &mut Csv,
    plane: &FeaturePlane,
    place: Rectangle,
    letter: char,
) -> String {
    let outlines: Vec<_> = plane.components.iter().map(outline).collect();
    let [x, y] = axes(plane, &outlines, place);
    let is_shown =
        |point: &[f64; 2]| (x.low..=x.high).contains(&point[0]) && (y.low..=y.high).contains(&point[1]);
    let outside = plane.share(|point| !is_shown(point));
    let mut panel = Panel::new(place, x.clone(), y.clone());
    let colours = [("γ ≤ 1", Colour::BLUE), ("γ > 1", Colour::VERMILLION)];
    for ((what, colour), sample) in colours.into_iter().zip(&plane.samples) {
        panel.dots(sample.items().copied(), Marker::Disc, 0.8, colour.faint(OPACITY), None);
        sample.items().for_each(|point| push(numbers, plane, what, 0, *point));
    }
    for (k, (outline, component)) in outlines.into_iter().zip(&plane.components).enumerate() {
        outline.iter().for_each(|point| push(numbers, plane, "95 %", k, *point));
        panel.polygons([outline], None, Some(Colour::INK.line(0.9)));
        panel.dots([component.centroid], Marker::Square, 1.7, Colour::INK, None);
        push(numbers, plane, "centroid", k, component.centroid);
    }
    panel.panel_letter(letter);
    panel.draw(figure);
    let components = output::count(plane.components.len() as u64, "component");
    panel_name(figure, place, &plane.element, &components);
    let condition = plane.condition_number.map_or("beyond double precision".into(), |of| format!("{of:.1e}"));
    let mut facts = format!("{}: {components}, largest condition number {condition}", plane.element);
    if let Some(share) = outside {
        facts += &format!(", {:.1} % of the labelled atoms outside", 100.0 * share);
    }
    facts
}

/// Axes of one scale that hold all ellipses.
fn axes(plane: &FeaturePlane, outlines: &[Vec<[f64; 2]>], place: Rectangle) -> [Axis; 2] {
    let range = |k: usize| {
        let values = outlines.iter().flatten().map(|point| point[k]);
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)))
    };
    let ranges = [range(0), range(1)];
    let points = [place.width, place.height];
    let scales = [0, 1].map(|k| 1.1 * (ranges[k].1 - ranges[k].0) / points[k]);
    let scale = scales[0].max(scales[1]);
    [0, 1].map(|k| {
        let (middle, half) = (0.5 * (ranges[k].0 + ranges[k].1), 0.5 * scale * points[k]);
        let title = format!("PC {} ({:.1} %)", k + 1, 100.0 * plane.shares[k]);
        Axis::new(&title, AxisScale::Linear, middle - half, middle + half)
    })
}

/// The ellipse of a component: its centroid plus the Cholesky factor of its covariance times a circle.
fn outline(component: &ProjectedComponent) -> Vec<[f64; 2]> {
    let [xx, xy, yy] = component.covariance;
    let width = xx.max(0.0).sqrt();
    let skew = if width > 0.0 { xy / width } else { 0.0 };
    let height = (yy - skew * skew).max(0.0).sqrt();
    let corner = |k: usize| {
        let (sin, cos) = (TAU * k as f64 / CORNERS as f64).sin_cos();
        let [x, y] = component.centroid;
        [x + RADIUS * width * cos, y + RADIUS * (skew * cos + height * sin)]
    };
    (0..CORNERS).map(corner).collect()
}

fn push(numbers: &mut Csv, plane: &FeaturePlane, what: &str, number: usize, [x, y]: [f64; 2]) {
    let head = [plane.element.clone(), what.to_owned(), number.to_string()];
    numbers.push(&[&head[..], &[x, y].map(csv::number)].concat());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_ellipse_is_at_one_distance() {
        let covariance = [4.0, 1.2, 1.0];
        let component = ProjectedComponent { count: 5.0, centroid: [3.0, -1.0], covariance };
        let [xx, xy, yy] = covariance;
        for [x, y] in outline(&component) {
            let (x, y) = (x - 3.0, y + 1.0);
            let square = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy);
            assert!((square + 2.0 * 0.05_f64.ln()).abs() < 1e-9, "{square}");
        }
    }
}

//! How the origins look in figures.

use figures::{Colour, Figure, LegendKey, Marker, Stroke, legend};
use wire::Origin;

pub use crate::page::style::{WIDTH, axis, grouped};

/// Style of an origin, distinguishable by colour, dashes and marker shape.
#[derive(Clone, Copy, Debug)]
pub struct OriginStyle {
    /// Colour.
    pub colour: Colour,
    /// Line.
    pub line: Stroke,
    /// Mark.
    pub marker: Marker,
    /// Name in legends.
    pub name: &'static str,
}

/// How an origin looks.
pub fn origin_style(origin: Origin) -> OriginStyle {
    match origin {
        Origin::Biased => OriginStyle {
            colour: Colour::VERMILLION,
            line: Colour::VERMILLION.line(1.3),
            marker: Marker::Disc,
            name: "biased",
        },
        Origin::Control => OriginStyle {
            colour: Colour::BLUE,
            line: Stroke { dashes: &[4.0, 1.6], ..Colour::BLUE.line(1.3) },
            marker: Marker::Square,
            name: "control",
        },
    }
}

/// Draws the legend of the shown origins at the upper right.
pub fn origins(figure: &mut Figure, shown: &[Origin]) {
    let keys: Vec<_> = shown
        .iter()
        .map(|origin| (LegendKey::Line(origin_style(*origin).line), origin_style(*origin).name))
        .collect();
    legend(figure, [WIDTH - 8.0, 12.0], &keys);
}

//! Legends.

use crate::{Anchor, Figure, FigureItem, FigureText, Marker, Paint, Rectangle, Stroke, width};

/// The sample of a legend entry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LegendKey {
    /// A filled box.
    Area(Paint),
    /// A line.
    Line(Stroke),
    /// A marker.
    Dot(Marker, Paint),
}

/// Width of a sample and gap between entries, points.
const SAMPLE: f64 = 14.0;
const GAP: f64 = 12.0;

/// Draws entries in a row that ends at `right`, with the text on the baseline `base`.
pub fn legend(figure: &mut Figure, [right, base]: [f64; 2], keys: &[(LegendKey, &str)]) {
    let of = |words: &str| SAMPLE + 4.0 + FigureText::SIZE * width(words, false);
    let whole =
        keys.iter().map(|(_, words)| of(words)).sum::<f64>() + GAP * keys.len().saturating_sub(1) as f64;
    let mut x = right - whole;
    for (key, words) in keys {
        draw(figure, *key, Rectangle { x, y: base - 6.0, width: SAMPLE, height: 6.5 });
        figure.text([x + SAMPLE + 4.0, base], words, Anchor::Start);
        x += of(words) + GAP;
    }
}

fn draw(figure: &mut Figure, key: LegendKey, place: Rectangle) {
    let middle = place.y + 0.5 * place.height;
    match key {
        LegendKey::Area(paint) => figure.rectangle(place, paint),
        LegendKey::Line(stroke) => figure.line(vec![[place.x, middle], [place.right(), middle]], stroke),
        LegendKey::Dot(marker, fill) => {
            let centres = vec![[place.x + 0.5 * place.width, middle]];
            figure.items.push(FigureItem::Dots {
                centres,
                marker,
                radius: 2.2,
                fill,
                stroke: None,
                clip: None,
            });
        }
    }
}

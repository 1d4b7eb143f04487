//! Places of panels, and how scores look.

use figures::{
    Anchor, Axis, AxisScale, Colour, Figure, FigureText, LegendKey, Rectangle, Stroke, legend, width,
};

use crate::page::style::WIDTH;

/// Panels in rows of at most three.
pub struct PanelGrid {
    pub number: usize,
    /// Height of a panel, points.
    pub height: f64,
    /// Room above the first row, points.
    pub top: f64,
}

/// Room between panels, points: for axis titles below, and left of each panel.
const BELOW: f64 = 44.0;
const LEFT: f64 = 46.0;
const RIGHT: f64 = 8.0;
/// Widest single panel, points.
const WIDEST: f64 = 330.0;

impl PanelGrid {
    /// Height of the figure.
    pub fn total_height(&self) -> f64 {
        let rows = self.number.div_ceil(self.columns()) as f64;
        self.top + rows * (self.height + BELOW) - BELOW + 30.0
    }

    fn columns(&self) -> usize {
        self.number.clamp(1, 3)
    }

    /// The area of panel `k`.
    pub fn panel_rectangle(&self, k: usize) -> Rectangle {
        let columns = self.columns() as f64;
        let width = (WIDTH / columns - LEFT - RIGHT).min(WIDEST);
        let margin = 0.5 * (WIDTH - columns * (LEFT + width + RIGHT));
        let (row, column) = ((k / self.columns()) as f64, (k % self.columns()) as f64);
        Rectangle {
            x: margin + column * (LEFT + width + RIGHT) + LEFT,
            y: self.top + row * (self.height + BELOW),
            width,
            height: self.height,
        }
    }
}

/// A logarithmic axis over all positive values and 1.
pub fn axis(title: &str, values: impl IntoIterator<Item = f64>) -> Axis {
    let usable = values.into_iter().filter(|x| x.is_finite() && *x > 0.0);
    let (low, high) = usable.fold((1.0, 1.0), |(low, high): (f64, f64), x| (low.min(x), high.max(x)));
    let margin = (high / low).powf(0.05).max(1.1);
    Axis::new(title, AxisScale::Logarithmic, low / margin, high * margin)
}

/// Letter of panel `k`: a to z, then none.
pub fn letter(k: usize) -> char {
    u8::try_from(k).ok().filter(|k| *k < 26).map_or(' ', |k| char::from(b'a' + k))
}

/// Line of γ in a crystal that the element does not form: that of γ, dashed.
pub fn other_line() -> Stroke {
    Stroke { dashes: &[3.0, 2.0], ..line(0) }
}

/// What the dashed lines are, for legends.
pub const OTHER_CRYSTAL: &str = "crystal that the element does not form";

/// The names of the crystal with solid lines and of the one with dashed lines in a panel.
pub fn crystal_names(solid: &str, dashed: Option<&str>) -> String {
    dashed.map_or(solid.to_owned(), |dashed| format!("{solid}; dashed, {dashed}"))
}

/// Writes element and crystal above a panel, behind its letter.
pub fn panel_name(figure: &mut Figure, place: Rectangle, element: &str, prototype: &str) {
    figure.text([place.x - 8.0, place.y - 6.0], &format!("{element}, {prototype}"), Anchor::Start);
}

/// The line of score `k`, γ first. The colours are those of Okabe and Ito (2008).
pub fn line(k: usize) -> Stroke {
    const COLOURS: [Colour; 7] = [
        Colour::VERMILLION,
        Colour::BLUE,
        Colour(0x00, 0x9e, 0x73),
        Colour(0xcc, 0x79, 0xa7),
        Colour(0xe6, 0x9f, 0x00),
        Colour(0x56, 0xb4, 0xe9),
        Colour::INK,
    ];
    const DASHES: [&[f64]; 3] = [&[], &[4.0, 1.6], &[1.2, 1.2]];
    let colour = COLOURS[k % COLOURS.len()];
    Stroke { dashes: DASHES[k / COLOURS.len() % DASHES.len()], ..colour.line(if k == 0 { 1.4 } else { 1.0 }) }
}

/// Draws a legend at the top, in as many rows as it needs.
pub fn legend_rows(figure: &mut Figure, keys: &[(LegendKey, String)]) {
    for (row, keys) in rows(keys).into_iter().enumerate() {
        let keys: Vec<_> = keys.iter().map(|(key, words)| (*key, words.as_str())).collect();
        legend(figure, [WIDTH - RIGHT, 12.0 + ROW * row as f64], &keys);
    }
}

/// Height of a row of a legend, points.
const ROW: f64 = 12.0;

/// Height of the legend of [`legend_rows`], points.
pub fn legend_height(keys: &[(LegendKey, String)]) -> f64 {
    ROW * rows(keys).len() as f64
}

/// Divides the keys into rows that fit.
fn rows(keys: &[(LegendKey, String)]) -> Vec<&[(LegendKey, String)]> {
    let length = |(_, words): &(LegendKey, String)| 30.0 + FigureText::SIZE * width(words, false);
    let (mut rows, mut start, mut used) = (Vec::new(), 0, 0.0);
    for (k, key) in keys.iter().enumerate() {
        if k > start && used + length(key) > WIDTH - 16.0 {
            rows.push(&keys[start..k]);
            (start, used) = (k, 0.0);
        }
        used += length(key);
    }
    rows.push(&keys[start..]);
    rows
}

//! Figures for print: a [`Figure`] is a list of shapes and words on a sheet measured in points (1/72 inch), which becomes SVG
//! with words as words, or PNG. [`Panel`] draws data between two axes onto it. Nothing here knows what the data mean, reads a
//! file or looks for a font: the one that PNG needs is in the program.

mod axis;
mod colours;
mod figure;
mod font;
mod legend;
mod panel;
mod png;
mod rich_text;
mod svg;
mod ticks;

pub use axis::{Axis, Scale};
pub use colours::{Colour, Paint, Stroke};
pub use figure::{Figure, Item, Marker, Rectangle, Text};
pub use font::{BOLD, FAMILY, REGULAR};
pub use legend::{LegendKey, legend};
pub use panel::{Panel, Side};
pub use png::{PngError, to_png};
pub use rich_text::{Anchor, escape, plain, to_html, width};
pub use svg::to_svg;

/// A place on a sheet or among data: x, y.
pub type Point = [f64; 2];

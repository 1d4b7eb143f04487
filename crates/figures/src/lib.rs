//! Figures for print. A [`Figure`] is a list of shapes and texts on a sheet measured in points (1/72 inch); it
//! is written as SVG, where text stays text, or as PNG. [`Panel`] draws data between two axes onto it. The
//! crate reads no files: the font that PNG needs is built in.

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

pub use axis::Axis;
pub use colours::{Colour, Paint, Stroke};
pub use figure::{Figure, FigureItem, FigureText, Marker, Rectangle};
pub use font::{BOLD, FAMILY, REGULAR};
pub use legend::{LegendKey, legend};
pub use panel::{MarginalSide, Panel};
pub use png::{PngError, to_png};
pub use rich_text::{Anchor, escape, plain, to_html, width};
pub use svg::to_svg;
pub use ticks::AxisScale;

/// A point on a sheet or in data coordinates: x, y.
pub type Point = [f64; 2];

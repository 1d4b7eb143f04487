//! The items of a figure.

use crate::rich_text::Anchor;
use crate::{Colour, Paint, Point, Stroke};

/// A sheet with its items in drawing order.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure {
    /// Letters, digits and hyphens; the prefix of all identifiers in an SVG file.
    pub name: String,
    /// Alternative text for accessibility.
    pub description: String,
    /// Width, points.
    pub width: f64,
    /// Height, points.
    pub height: f64,
    /// From bottom to top.
    pub items: Vec<FigureItem>,
}

/// An item of a figure.
#[derive(Clone, Debug, PartialEq)]
pub enum FigureItem {
    /// Polylines and the area they enclose (even-odd rule).
    Shape {
        /// Several lines form one shape, with holes where they enclose each other.
        lines: Vec<Vec<Point>>,
        /// Whether each line is closed.
        closed: bool,
        /// Paint of the area.
        fill: Option<Paint>,
        /// Stroke of the lines.
        stroke: Option<Stroke>,
        /// Clips the item to this rectangle.
        clip: Option<Rectangle>,
    },
    /// One marker at many points.
    Dots {
        /// Where the markers are.
        centres: Vec<Point>,
        /// Shape of the marker.
        marker: Marker,
        /// Half its width, points.
        radius: f64,
        /// Paint of the interior.
        fill: Paint,
        /// Stroke of the edge.
        stroke: Option<Stroke>,
        /// Clips the item to this rectangle.
        clip: Option<Rectangle>,
    },
    /// Text.
    Text(FigureText),
}

/// Shape of a marker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Marker {
    /// A disc.
    Disc,
    /// A square.
    Square,
}

/// A line of text with `_{subscript}` and `^{superscript}`.
#[derive(Clone, Debug, PartialEq)]
pub struct FigureText {
    /// Position on the baseline.
    pub position: Point,
    /// The text.
    pub markup: String,
    /// Font size, points.
    pub size: f64,
    /// Which part of the text is at the position.
    pub anchor: Anchor,
    /// Bold.
    pub bold: bool,
    /// Rotated to read from bottom to top.
    pub rotated: bool,
    /// Colour.
    pub colour: Colour,
}

/// A rectangle on the sheet, points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rectangle {
    /// Left edge.
    pub x: f64,
    /// Upper edge.
    pub y: f64,
    /// Width.
    pub width: f64,
    /// Height.
    pub height: f64,
}

impl Figure {
    /// An empty sheet.
    pub fn new(name: &str, description: &str, width: f64, height: f64) -> Self {
        Self { name: name.into(), description: description.into(), width, height, items: Vec::new() }
    }

    /// Draws a polyline.
    pub fn line(&mut self, points: Vec<Point>, stroke: Stroke) {
        let lines = vec![points];
        self.items.push(FigureItem::Shape {
            lines,
            closed: false,
            fill: None,
            stroke: Some(stroke),
            clip: None,
        });
    }

    /// Draws a filled rectangle.
    pub fn rectangle(&mut self, place: Rectangle, fill: Paint) {
        let lines = vec![place.corners()];
        self.items.push(FigureItem::Shape {
            lines,
            closed: true,
            fill: Some(fill),
            stroke: None,
            clip: None,
        });
    }

    /// Draws text.
    pub fn text(&mut self, position: Point, markup: &str, anchor: Anchor) -> &mut FigureText {
        self.items.push(FigureItem::Text(FigureText {
            position,
            markup: markup.into(),
            size: FigureText::SIZE,
            anchor,
            bold: false,
            rotated: false,
            colour: Colour::INK,
        }));
        match self.items.last_mut() {
            Some(FigureItem::Text(text)) => text,
            _ => unreachable!("it was just put there"),
        }
    }
}

impl FigureText {
    /// Default font size, points.
    pub const SIZE: f64 = 8.0;
}

impl Rectangle {
    /// The corners, clockwise from the upper left.
    pub fn corners(&self) -> Vec<Point> {
        let Self { x, y, width, height } = *self;
        vec![[x, y], [x + width, y], [x + width, y + height], [x, y + height]]
    }

    /// Right edge.
    pub fn right(&self) -> f64 {
        self.x + self.width
    }

    /// Lower edge.
    pub fn bottom(&self) -> f64 {
        self.y + self.height
    }
}

//! What stands on a sheet.

use crate::rich_text::Anchor;
use crate::{Colour, Paint, Point, Stroke};

/// A sheet with what was drawn on it, in that order.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure {
    /// Its name: letters, digits and hyphens; what is named in an SVG file begins with it.
    pub name: String,
    /// Said to those who cannot see it.
    pub description: String,
    /// Points.
    pub width: f64,
    /// Points.
    pub height: f64,
    /// From the bottom up.
    pub items: Vec<Item>,
}

/// One thing on a sheet.
#[derive(Clone, Debug, PartialEq)]
pub enum Item {
    /// Lines from point to point, and what they enclose (by the even-odd rule).
    Shape {
        /// Several lines make one shape, with holes where they enclose each other.
        lines: Vec<Vec<Point>>,
        /// Whether each ends where it begins.
        closed: bool,
        /// What is inside.
        fill: Option<Paint>,
        /// The lines themselves.
        stroke: Option<Stroke>,
        /// Nothing is seen outside of it.
        clip: Option<Rectangle>,
    },
    /// The same mark at many places.
    Dots {
        /// Places.
        centres: Vec<Point>,
        /// Form.
        marker: Marker,
        /// Half of its width, points.
        radius: f64,
        /// Inside.
        fill: Paint,
        /// Edge.
        stroke: Option<Stroke>,
        /// Nothing is seen outside of it.
        clip: Option<Rectangle>,
    },
    /// Words.
    Text(Text),
}

/// Form of a mark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Marker {
    /// A disc.
    Disc,
    /// A square.
    Square,
}

/// A line of words, with `_{below}` and `^{above}`.
#[derive(Clone, Debug, PartialEq)]
pub struct Text {
    /// Where it stands: on the base line.
    pub at: Point,
    /// What it says.
    pub words: String,
    /// Height of the font, points.
    pub size: f64,
    /// Which part of it stands at that place.
    pub anchor: Anchor,
    /// Bold.
    pub bold: bool,
    /// Turned to be read from below upwards.
    pub upwards: bool,
    /// Colour.
    pub colour: Colour,
}

/// A part of a sheet, points.
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

    /// A line from point to point.
    pub fn line(&mut self, points: Vec<Point>, stroke: Stroke) {
        let lines = vec![points];
        self.items.push(Item::Shape { lines, closed: false, fill: None, stroke: Some(stroke), clip: None });
    }

    /// A filled rectangle.
    pub fn rectangle(&mut self, place: Rectangle, fill: Paint) {
        let lines = vec![place.corners()];
        self.items.push(Item::Shape { lines, closed: true, fill: Some(fill), stroke: None, clip: None });
    }

    /// Words.
    pub fn text(&mut self, at: Point, words: &str, anchor: Anchor) -> &mut Text {
        self.items.push(Item::Text(Text {
            at,
            words: words.into(),
            size: Text::SIZE,
            anchor,
            bold: false,
            upwards: false,
            colour: Colour::INK,
        }));
        match self.items.last_mut() {
            Some(Item::Text(text)) => text,
            _ => unreachable!("it was just put there"),
        }
    }
}

impl Text {
    /// Of words that do not say otherwise, points.
    pub const SIZE: f64 = 8.0;
}

impl Rectangle {
    /// From the upper left one, clockwise.
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

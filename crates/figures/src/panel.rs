//! Plots data between two axes.

use crate::axis::Axis;
use crate::{Anchor, Colour, Figure, FigureItem, FigureText, Marker, Paint, Point, Rectangle, Stroke};

/// Length of a major and of a minor tick, points.
const TICK: f64 = 3.0;
const SMALL_TICK: f64 = 1.7;
/// Width of axes and ticks, points.
const AXIS: f64 = 0.6;

/// A plotting area with a horizontal and a vertical axis. Data outside the area are clipped.
#[derive(Clone, Debug)]
pub struct Panel {
    /// The area without axis labels.
    pub area: Rectangle,
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    data: Vec<FigureItem>,
}

impl Panel {
    /// An empty panel.
    pub fn new(area: Rectangle, x: Axis, y: Axis) -> Self {
        Self { area, x, y, data: Vec::new() }
    }

    /// Converts data coordinates to sheet coordinates.
    fn to_sheet(&self, [x, y]: Point) -> Point {
        let Rectangle { x: left, width, height, .. } = self.area;
        [left + width * self.x.position(x), self.area.bottom() - height * self.y.position(y)]
    }

    /// Draws a polyline.
    pub fn line(&mut self, points: impl IntoIterator<Item = Point>, stroke: Stroke) {
        self.shape([points], false, None, Some(stroke));
    }

    /// Draws closed polygons with their interior.
    pub fn polygons<L: IntoIterator<Item = Point>>(
        &mut self,
        lines: impl IntoIterator<Item = L>,
        fill: Option<Paint>,
        stroke: Option<Stroke>,
    ) {
        self.shape(lines, true, fill, stroke);
    }

    /// Draws the band between two curves with the same x, given as (x, low, high).
    pub fn band(&mut self, points: &[(f64, f64, f64)], fill: Paint) {
        let upper = points.iter().map(|(x, _, high)| [*x, *high]);
        let lower = points.iter().rev().map(|(x, low, _)| [*x, *low]);
        self.polygons([upper.chain(lower)], Some(fill), None);
    }

    /// Draws a filled box between two corners.
    pub fn bar(&mut self, [x, y]: Point, [to_x, to_y]: Point, fill: Paint) {
        self.polygons([[[x, y], [to_x, y], [to_x, to_y], [x, to_y]]], Some(fill), None);
    }

    /// Draws markers.
    pub fn dots(
        &mut self,
        points: impl IntoIterator<Item = Point>,
        marker: Marker,
        radius: f64,
        fill: impl Into<Paint>,
        stroke: Option<Stroke>,
    ) {
        let centres: Vec<_> = points.into_iter().map(|point| self.to_sheet(point)).collect();
        if !centres.is_empty() {
            let (fill, clip) = (fill.into(), Some(self.area));
            self.data.push(FigureItem::Dots { centres, marker, radius, fill, stroke, clip });
        }
    }

    /// Draws a dashed vertical line at x.
    pub fn vertical_line(&mut self, x: f64) {
        let (low, high) = (self.y.low, self.y.high);
        self.line([[x, low], [x, high]], Colour::GREY.dashed(0.7));
    }

    /// Draws text at data coordinates with an offset in points.
    pub fn text(&mut self, at: Point, [right, down]: Point, words: &str, anchor: Anchor) -> &mut FigureText {
        let [x, y] = self.to_sheet(at);
        let mut sheet = Figure::new("", "", 0.0, 0.0);
        sheet.text([x + right, y + down], words, anchor).size = FigureText::SIZE - 1.0;
        self.data.append(&mut sheet.items);
        match self.data.last_mut() {
            Some(FigureItem::Text(text)) => text,
            _ => unreachable!("it was just put there"),
        }
    }

    /// Draws a message in the middle of a panel without data.
    pub fn placeholder(&mut self, why: &str) {
        let Rectangle { x, y, width, height } = self.area;
        let mut sheet = Figure::new("", "", 0.0, 0.0);
        sheet.text([x + 0.5 * width, y + 0.5 * height], why, Anchor::Middle).colour = Colour::GREY;
        self.data.append(&mut sheet.items);
    }

    /// Draws the panel letter above the upper left corner.
    pub fn panel_letter(&mut self, letter: char) {
        let mut sheet = Figure::new("", "", 0.0, 0.0);
        let text = sheet.text([self.area.x - 24.0, self.area.y - 6.0], &letter.to_string(), Anchor::Start);
        (text.bold, text.size) = (true, 10.0);
        self.data.append(&mut sheet.items);
    }

    /// Draws the data, then the axes with a frame.
    pub fn draw(self, figure: &mut Figure) {
        let sides = vec![self.area.corners()];
        let stroke = Some(Colour::INK.line(AXIS));
        self.draw_with(
            figure,
            FigureItem::Shape { lines: sides, closed: true, fill: None, stroke, clip: None },
        );
    }

    /// Draws the panel as a marginal plot, with one axis line only.
    pub fn draw_as_margin(self, figure: &mut Figure, side: MarginalSide) {
        let corners = self.area.corners();
        let line = match side {
            MarginalSide::Below => vec![corners[3], corners[2]],
            MarginalSide::Left => vec![corners[3], corners[0]],
        };
        let stroke = Some(Colour::INK.line(AXIS));
        let item = FigureItem::Shape { lines: vec![line], closed: false, fill: None, stroke, clip: None };
        self.draw_with(figure, item);
    }

    fn draw_with(mut self, figure: &mut Figure, sides: FigureItem) {
        figure.items.append(&mut self.data);
        figure.items.push(sides);
        self.draw_horizontal(figure);
        self.draw_vertical(figure);
    }

    fn draw_horizontal(&self, figure: &mut Figure) {
        let bottom = self.area.bottom();
        for tick in self.x.ticks() {
            let x = self.area.x + self.area.width * self.x.position(tick.position);
            let length = if tick.label.is_empty() { SMALL_TICK } else { TICK };
            figure.line(vec![[x, bottom], [x, bottom + length]], Colour::INK.line(AXIS));
            if !tick.label.is_empty() {
                figure.text([x, bottom + 11.0], &tick.label, Anchor::Middle);
            }
        }
        let middle = self.area.x + 0.5 * self.area.width;
        let below = if self.x.ticks().is_empty() { 12.0 } else { 23.0 };
        figure.text([middle, bottom + below], &self.x.title, Anchor::Middle);
    }

    fn draw_vertical(&self, figure: &mut Figure) {
        let (left, mut widest) = (self.area.x, 0.0_f64);
        for tick in self.y.ticks() {
            let y = self.area.bottom() - self.area.height * self.y.position(tick.position);
            let length = if tick.label.is_empty() { SMALL_TICK } else { TICK };
            figure.line(vec![[left, y], [left - length, y]], Colour::INK.line(AXIS));
            if !tick.label.is_empty() {
                figure.text([left - 5.0, y + 0.35 * FigureText::SIZE], &tick.label, Anchor::End);
                widest = widest.max(FigureText::SIZE * crate::width(&tick.label, false));
            }
        }
        let middle = self.area.y + 0.5 * self.area.height;
        figure.text([left - widest - 10.0, middle], &self.y.title, Anchor::Middle).rotated = true;
    }

    fn shape<L: IntoIterator<Item = Point>>(
        &mut self,
        lines: impl IntoIterator<Item = L>,
        closed: bool,
        fill: Option<Paint>,
        stroke: Option<Stroke>,
    ) {
        let line = |line: L| -> Vec<Point> { line.into_iter().map(|point| self.to_sheet(point)).collect() };
        let lines: Vec<_> = lines.into_iter().map(line).filter(|line| line.len() > 1).collect();
        if !lines.is_empty() {
            self.data.push(FigureItem::Shape { lines, closed, fill, stroke, clip: Some(self.area) });
        }
    }
}

/// The axis line of a marginal plot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MarginalSide {
    /// The lower one, for a plot above its panel.
    Below,
    /// The left one, for a plot to the right of its panel.
    Left,
}

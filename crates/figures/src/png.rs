//! Writes a figure as PNG with tiny-skia and the built-in font.

use tiny_skia::{FillRule, LineJoin, Mask, PathBuilder, Pixmap, StrokeDash, Transform};
use ttf_parser::OutlineBuilder;

use crate::rich_text::runs;
use crate::{
    Anchor, Colour, Figure, FigureItem, FigureText, Marker, Paint, Point, Rectangle, Stroke, font, width,
};

/// Points per inch.
const POINTS_PER_INCH: f64 = 72.0;
const METRES: f64 = 0.0254;

/// Why a figure cannot be rendered.
#[derive(Debug, thiserror::Error)]
pub enum PngError {
    /// The image would be empty or too large.
    #[error("a figure of {0} × {1} points cannot be rendered at {2} dots per inch")]
    Size(f64, f64, f64),
    /// The encoder reports an error.
    #[error("a figure cannot be written as PNG: {0}")]
    Encoding(#[from] png::EncodingError),
}

/// Renders a figure as PNG at this resolution.
pub fn to_png(figure: &Figure, dots_per_inch: f64) -> Result<Vec<u8>, PngError> {
    let scale = dots_per_inch / POINTS_PER_INCH;
    let size = || PngError::Size(figure.width, figure.height, dots_per_inch);
    let pixels = |length: f64| (scale * length).round() as u32;
    let pixmap = Pixmap::new(pixels(figure.width), pixels(figure.height)).ok_or_else(size)?;
    let mut sheet =
        Sheet { pixmap, transform: Transform::from_scale(scale as f32, scale as f32), clip: None };
    sheet.pixmap.fill(tiny_skia::Color::WHITE);
    figure.items.iter().for_each(|item| sheet.item(item));
    encode(&sheet.pixmap, dots_per_inch)
}

fn encode(pixmap: &Pixmap, dots_per_inch: f64) -> Result<Vec<u8>, PngError> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, pixmap.width(), pixmap.height());
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let per_metre = (dots_per_inch / METRES).round() as u32;
    let unit = png::Unit::Meter;
    encoder.set_pixel_dims(Some(png::PixelDimensions { xppu: per_metre, yppu: per_metre, unit }));
    // Red, green, blue and opacity: the white background is opaque.
    let mut colours = Vec::with_capacity(pixmap.data().len() / 4 * 3);
    pixmap.data().chunks_exact(4).for_each(|pixel| colours.extend_from_slice(&pixel[..3]));
    encoder.write_header()?.write_image_data(&colours)?;
    Ok(bytes)
}

struct Sheet {
    pixmap: Pixmap,
    transform: Transform,
    /// The last clip mask, because consecutive items often share one.
    clip: Option<(Rectangle, Mask)>,
}

impl Sheet {
    fn item(&mut self, item: &FigureItem) {
        match item {
            FigureItem::Shape { lines, closed, fill, stroke, clip } => {
                let mut builder = PathBuilder::new();
                lines.iter().for_each(|line| add(&mut builder, line, *closed));
                self.path(builder, *fill, *stroke, *clip);
            }
            FigureItem::Dots { centres, marker, radius, fill, stroke, clip } => {
                for centre in centres {
                    let mut builder = PathBuilder::new();
                    add_mark(&mut builder, *marker, *centre, *radius);
                    self.path(builder, Some(*fill), *stroke, *clip);
                }
            }
            FigureItem::Text(text) => self.text(text),
        }
    }

    fn path(
        &mut self,
        builder: PathBuilder,
        fill: Option<Paint>,
        stroke: Option<Stroke>,
        clip: Option<Rectangle>,
    ) {
        let Some(path) = builder.finish() else { return };
        self.set_clip(clip);
        let mask = self.clip.as_ref().filter(|_| clip.is_some()).map(|(_, mask)| mask);
        if let Some(paint) = fill {
            let (rule, paint) = (FillRule::EvenOdd, to_skia_paint(paint));
            self.pixmap.fill_path(&path, &paint, rule, self.transform, mask);
        }
        if let Some(Stroke { paint, width, dashes }) = stroke {
            let dashes = dashes.iter().map(|dash| *dash as f32).collect();
            let stroke = tiny_skia::Stroke {
                width: width as f32,
                line_join: LineJoin::Round,
                dash: StrokeDash::new(dashes, 0.0),
                ..tiny_skia::Stroke::default()
            };
            self.pixmap.stroke_path(&path, &to_skia_paint(paint), &stroke, self.transform, mask);
        }
    }

    fn set_clip(&mut self, clip: Option<Rectangle>) {
        let Some(place) = clip else { return };
        if self.clip.as_ref().is_some_and(|(known, _)| *known == place) {
            return;
        }
        let mut builder = PathBuilder::new();
        add(&mut builder, &place.corners(), true);
        let mask = Mask::new(self.pixmap.width(), self.pixmap.height());
        self.clip = mask.zip(builder.finish()).map(|(mut mask, path)| {
            mask.fill_path(&path, FillRule::Winding, true, self.transform);
            (place, mask)
        });
    }

    fn text(&mut self, text: &FigureText) {
        let FigureText { position: [x, y], markup, size, anchor, bold, rotated, colour } = text;
        let length = size * width(markup, *bold);
        let mut pen = match anchor {
            Anchor::Start => 0.0,
            Anchor::Middle => -0.5 * length,
            Anchor::End => -length,
        };
        let angle = if *rotated { -90.0 } else { 0.0 };
        let place = Transform::from_translate(*x as f32, *y as f32).pre_rotate(angle);
        let mut builder = Glyphs { builder: PathBuilder::new(), place, scale: 0.0, at: [0.0; 2] };
        for run in runs(markup) {
            let size = size * run.script.scale();
            builder.scale = size / font::units();
            for character in run.text.chars() {
                builder.at = [pen, run.script.baseline_shift() * text.size];
                font::outline(character, *bold, &mut builder);
                pen += size * font::advance(character, *bold);
            }
        }
        // Glyphs do not overlap and their holes have the opposite orientation, so both fill rules agree.
        self.path(builder.builder, Some((*colour).into()), None, None);
    }
}

/// Transforms glyph outlines to sheet coordinates.
struct Glyphs {
    builder: PathBuilder,
    place: Transform,
    scale: f64,
    at: Point,
}

impl Glyphs {
    fn point(&self, x: f32, y: f32) -> (f32, f32) {
        let [right, down] = self.at;
        let (x, y) = (right + self.scale * f64::from(x), down - self.scale * f64::from(y));
        let mut point = tiny_skia::Point::from_xy(x as f32, y as f32);
        self.place.map_point(&mut point);
        (point.x, point.y)
    }
}

impl OutlineBuilder for Glyphs {
    fn move_to(&mut self, x: f32, y: f32) {
        let (x, y) = self.point(x, y);
        self.builder.move_to(x, y);
    }

    fn line_to(&mut self, x: f32, y: f32) {
        let (x, y) = self.point(x, y);
        self.builder.line_to(x, y);
    }

    fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
        let ((x1, y1), (x, y)) = (self.point(x1, y1), self.point(x, y));
        self.builder.quad_to(x1, y1, x, y);
    }

    fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
        let ((x1, y1), (x2, y2), (x, y)) = (self.point(x1, y1), self.point(x2, y2), self.point(x, y));
        self.builder.cubic_to(x1, y1, x2, y2, x, y);
    }

    fn close(&mut self) {
        self.builder.close();
    }
}

fn add(builder: &mut PathBuilder, line: &[Point], closed: bool) {
    for (k, [x, y]) in line.iter().enumerate() {
        let (x, y) = (*x as f32, *y as f32);
        if k == 0 { builder.move_to(x, y) } else { builder.line_to(x, y) }
    }
    if closed {
        builder.close();
    }
}

fn add_mark(builder: &mut PathBuilder, marker: Marker, [x, y]: Point, radius: f64) {
    match marker {
        Marker::Disc => builder.push_circle(x as f32, y as f32, radius as f32),
        Marker::Square => {
            let (x, y, side) = (x - radius, y - radius, 2.0 * radius);
            add(builder, &Rectangle { x, y, width: side, height: side }.corners(), true);
        }
    }
}

fn to_skia_paint(Paint { colour: Colour(red, green, blue), opacity }: Paint) -> tiny_skia::Paint<'static> {
    let mut paint = tiny_skia::Paint { anti_alias: true, ..tiny_skia::Paint::default() };
    paint.set_color_rgba8(red, green, blue, (255.0 * opacity).round() as u8);
    paint
}

//! Writes a figure as SVG 1.1. Text stays text, and one unit is a point.

use std::fmt::Write;

use crate::font::FAMILY;
use crate::rich_text::{escape, runs};
use crate::{Anchor, Colour, Figure, FigureItem, FigureText, Marker, Paint, Point, Rectangle, Stroke};

/// The SVG element, for a file or for HTML.
pub fn to_svg(figure: &Figure) -> String {
    let Figure { name, description, width, height, items } = figure;
    let (width, height) = (short(*width), short(*height));
    let mut svg = Svg { out: String::new(), name, clips: Vec::new() };
    items.iter().for_each(|item| svg.item(item));
    let defs: String = svg.clips.iter().enumerate().map(|(k, place)| clip_path(name, k, place)).collect();
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}pt\" height=\"{height}pt\" \
         viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{}\" font-family=\"{FAMILY}\">\n\
         <title>{}</title>\n<defs>{defs}</defs>\n<rect width=\"{width}\" height=\"{height}\" fill=\"#ffffff\"/>\n{}</svg>\n",
        escape(description),
        escape(description),
        svg.out
    )
}

struct Svg<'a> {
    out: String,
    name: &'a str,
    clips: Vec<Rectangle>,
}

impl Svg<'_> {
    fn item(&mut self, item: &FigureItem) {
        match item {
            FigureItem::Shape { lines, closed, fill, stroke, clip } => {
                let data: String = lines.iter().map(|line| path(line, *closed)).collect();
                let style = format!("{}{}{}", filled(*fill), stroked(*stroke), self.clipped(*clip));
                self.push(&format!("<path d=\"{data}\"{style}/>"));
            }
            FigureItem::Dots { centres, marker, radius, fill, stroke, clip } => {
                let style = format!("{}{}{}", filled(Some(*fill)), stroked(*stroke), self.clipped(*clip));
                self.push(&format!("<g{style}>"));
                let marks: String = centres.iter().map(|centre| mark(*marker, *centre, *radius)).collect();
                self.push(&format!("{marks}</g>"));
            }
            FigureItem::Text(text) => self.text(text),
        }
    }

    fn text(&mut self, text: &FigureText) {
        let FigureText { position: [x, y], markup, size, anchor, bold, rotated, colour } = text;
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let place = match rotated {
            true => format!("transform=\"translate({} {}) rotate(-90)\"", short(*x), short(*y)),
            false => format!("x=\"{}\" y=\"{}\"", short(*x), short(*y)),
        };
        let weight = if *bold { " font-weight=\"bold\"" } else { "" };
        let (mut spans, mut shifted) = (String::new(), 0.0);
        for run in runs(markup) {
            let shift = run.script.baseline_shift() * size;
            let _ = write!(
                spans,
                "<tspan dy=\"{}\" font-size=\"{}\">{}</tspan>",
                short(shift - shifted),
                short(run.script.scale() * size),
                escape(run.text)
            );
            shifted = shift;
        }
        self.push(&format!(
            "<text {place} text-anchor=\"{anchor}\" fill=\"{}\"{weight}>{spans}</text>",
            hexadecimal(*colour)
        ));
    }

    fn clipped(&mut self, clip: Option<Rectangle>) -> String {
        let Some(clip) = clip else { return String::new() };
        let known = self.clips.iter().position(|known| *known == clip);
        let number = known.unwrap_or_else(|| {
            self.clips.push(clip);
            self.clips.len() - 1
        });
        format!(" clip-path=\"url(#{}-clip-{number})\"", self.name)
    }

    fn push(&mut self, line: &str) {
        self.out.push_str(line);
        self.out.push('\n');
    }
}

fn clip_path(name: &str, number: usize, place: &Rectangle) -> String {
    let Rectangle { x, y, width, height } = place;
    let [x, y, width, height] = [x, y, width, height].map(|number| short(*number));
    format!(
        "<clipPath id=\"{name}-clip-{number}\"><rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\"/></clipPath>"
    )
}

fn path(line: &[Point], closed: bool) -> String {
    let mut data = String::new();
    for (k, [x, y]) in line.iter().enumerate() {
        let _ = write!(data, "{}{} {}", if k == 0 { 'M' } else { 'L' }, short(*x), short(*y));
    }
    if closed {
        data.push('Z');
    }
    data
}

fn mark(marker: Marker, [x, y]: Point, radius: f64) -> String {
    match marker {
        Marker::Disc => format!("<circle cx=\"{}\" cy=\"{}\" r=\"{}\"/>", short(x), short(y), short(radius)),
        Marker::Square => {
            let [x, y, side] = [x - radius, y - radius, 2.0 * radius].map(short);
            format!("<rect x=\"{x}\" y=\"{y}\" width=\"{side}\" height=\"{side}\"/>")
        }
    }
}

fn filled(paint: Option<Paint>) -> String {
    let Some(Paint { colour, opacity }) = paint else { return " fill=\"none\"".to_owned() };
    let colour = hexadecimal(colour);
    match opacity < 1.0 {
        true => format!(" fill=\"{colour}\" fill-opacity=\"{}\" fill-rule=\"evenodd\"", short(opacity)),
        false => format!(" fill=\"{colour}\" fill-rule=\"evenodd\""),
    }
}

fn stroked(stroke: Option<Stroke>) -> String {
    let Some(Stroke { paint: Paint { colour, opacity }, width, dashes }) = stroke else {
        return String::new();
    };
    let (colour, width) = (hexadecimal(colour), short(width));
    let mut style = format!(" stroke=\"{colour}\" stroke-width=\"{width}\" stroke-linejoin=\"round\"");
    if opacity < 1.0 {
        let _ = write!(style, " stroke-opacity=\"{}\"", short(opacity));
    }
    if !dashes.is_empty() {
        let dashes: Vec<_> = dashes.iter().map(|dash| short(*dash)).collect();
        let _ = write!(style, " stroke-dasharray=\"{}\"", dashes.join(" "));
    }
    style
}

fn hexadecimal(Colour(red, green, blue): Colour) -> String {
    format!("#{red:02x}{green:02x}{blue:02x}")
}

/// At most two decimals, without trailing zeros.
fn short(number: f64) -> String {
    let text = format!("{number:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        assert_eq!([1.0, 0.126, -0.001, 12.5, 100.0].map(short), ["1", "0.13", "0", "12.5", "100"]);
    }
}

//! A figure with every kind of item, as SVG and as PNG.

use figures::{
    Anchor, Axis, AxisScale, Colour, Figure, LegendKey, MarginalSide, Marker, Panel, Rectangle, legend,
    to_png, to_svg,
};
use quick_xml::Reader;
use quick_xml::events::Event;

fn figure() -> Figure {
    let mut figure = Figure::new("test", "Errors <by> \"γ\"", 200.0, 150.0);
    let place = Rectangle { x: 50.0, y: 40.0, width: 120.0, height: 70.0 };
    let x = Axis::new("γ_{nbr}", AxisScale::Logarithmic, 0.1, 10.0);
    let y = Axis::new("error (eV Å^{−1})", AxisScale::Linear, 0.0, 2.0);
    let mut panel = Panel::new(place, x, y);
    panel.band(&[(0.1, 0.0, 1.0), (1.0, 0.5, 1.5), (10.0, 1.0, 9.0)], Colour::BLUE.faint(0.3));
    panel.line([[0.1, 0.5], [10.0, 1.5]], Colour::VERMILLION.line(1.0));
    panel.dots([[1.0, 1.0], [2.0, 1.2]], Marker::Disc, 2.0, Colour::VERMILLION, None);
    panel.dots([[3.0, 1.0]], Marker::Square, 2.0, Colour::BLUE, Some(Colour::WHITE.line(0.5)));
    panel.bar([0.2, 0.0], [0.3, 1.0], Colour::GREY.into());
    panel.vertical_line(1.0);
    panel.text([1.0, 1.0], [2.0, -2.0], "γ = 1", Anchor::Start);
    panel.panel_letter('a');
    panel.draw(&mut figure);
    let margin = Rectangle { x: 50.0, y: 20.0, width: 120.0, height: 18.0 };
    let bare = Axis::new("", AxisScale::Linear, 0.0, 1.0).without_ticks();
    Panel::new(margin, bare.clone(), bare).draw_as_margin(&mut figure, MarginalSide::Below);
    legend(&mut figure, [170.0, 12.0], &[(LegendKey::Line(Colour::BLUE.dashed(1.0)), "control & more")]);
    figure
}

#[test]
fn svg_is_xml_whose_words_are_words() {
    let svg = to_svg(&figure());
    let mut reader = Reader::from_str(&svg);
    let (mut words, mut open, mut clips) = (String::new(), 0, Vec::new());
    loop {
        match reader.read_event().expect("well-formed") {
            Event::Start(start) => {
                open += 1;
                start.attributes().for_each(|attribute| drop(attribute.expect("a well-formed attribute")));
                if start.name().0 == "clipPath" {
                    let id = start.try_get_attribute("id").unwrap().unwrap();
                    clips.push(id.value.into_owned());
                }
            }
            Event::End(_) => open -= 1,
            Event::Text(text) => words += &text,
            Event::GeneralRef(name) => words += &format!("&{};", &*name),
            Event::Eof => break,
            _ => {}
        }
    }
    assert_eq!((open, clips), (0, vec!["test-clip-0".to_owned()]));
    for expected in ["nbr", "error (eV Å", "−1", "0.1", "10", "γ = 1", "control &amp; more", "2.0"] {
        assert!(words.contains(expected), "no '{expected}' in {words}");
    }
    assert!(
        svg.contains("aria-label=\"Errors &lt;by&gt; &quot;γ&quot;\"") && svg.contains("width=\"200pt\"")
    );
}

/// The colours of a decoded image, by row.
fn decoded(bytes: &[u8]) -> (u32, u32, Vec<[u8; 3]>) {
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    let mut colours = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut colours).unwrap();
    let pixels = colours.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
    (info.width, info.height, pixels)
}

#[test]
fn png_shows_the_same_and_needs_no_font() {
    let image = to_png(&figure(), 144.0).unwrap();
    assert_eq!(image, to_png(&figure(), 144.0).unwrap(), "the same figure, the same bytes");
    let (width, height, pixels) = decoded(&image);
    assert_eq!((width, height), (400, 300));
    let at = |x: f64, y: f64| pixels[(2.0 * y) as usize * 400 + (2.0 * x) as usize];
    // γ = 1 is in the middle of the axis, and so is the first disc, halfway up.
    assert_eq!(at(110.0, 75.0), [0xd5, 0x5e, 0x00]);
    assert_eq!(at(2.0, 2.0), [0xff; 3]);
    // The band is translucent and ends at the upper edge of the panel.
    let band = at(165.0, 45.0);
    assert!(band[2] > band[0] && band[0] > 0x80 && at(165.0, 39.0) == [0xff; 3], "{band:?}");
    // Text: dark pixels left of the axis and below it, beyond the ticks.
    let dark = |x: std::ops::Range<u32>, y: std::ops::Range<u32>| {
        let dark = |x, y| pixels[(y * 400 + x) as usize].iter().all(|c| *c < 0x60);
        y.flat_map(|y| x.clone().map(move |x| (x, y))).filter(|(x, y)| dark(*x, *y)).count()
    };
    assert!(dark(0..90, 80..220) > 200 && dark(100..340, 230..300) > 100, "words at the axes");
}

#[test]
fn a_figure_without_size_is_an_error() {
    let error = to_png(&Figure::new("none", "", 0.0, 10.0), 300.0).unwrap_err();
    assert!(error.to_string().contains("0 × 10 points"), "{error}");
}

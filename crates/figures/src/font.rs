//! The font: text widths for the layout and outlines for PNG.

use std::sync::LazyLock;

use ttf_parser::{Face, GlyphId, OutlineBuilder};

/// The regular font, TrueType (fonts/README.md).
pub const REGULAR: &[u8] = include_bytes!("../fonts/report-sans-regular.ttf");
/// The bold font.
pub const BOLD: &[u8] = include_bytes!("../fonts/report-sans-bold.ttf");

/// Font families for SVG and HTML; the fallbacks have the same widths.
pub const FAMILY: &str = "'Report Sans', 'Liberation Sans', Arial, Helvetica, sans-serif";

static FACES: LazyLock<[Face<'static>; 2]> =
    LazyLock::new(|| [REGULAR, BOLD].map(|bytes| Face::parse(bytes, 0).expect("a font of the program")));

fn face(bold: bool) -> &'static Face<'static> {
    &FACES[usize::from(bold)]
}

/// The glyph of a character, or the font's placeholder box.
fn glyph(face: &Face<'_>, character: char) -> GlyphId {
    face.glyph_index(character).unwrap_or(GlyphId(0))
}

/// Width of a character at font size 1.
pub fn advance(character: char, bold: bool) -> f64 {
    let face = face(bold);
    let advance = face.glyph_hor_advance(glyph(face, character)).unwrap_or_default();
    f64::from(advance) / f64::from(face.units_per_em())
}

/// Draws the outline of a character, in font units ([`units`]).
pub fn outline(character: char, bold: bool, builder: &mut dyn OutlineBuilder) {
    let face = face(bold);
    // A space has no outline.
    let _ = face.outline_glyph(glyph(face, character), builder);
}

/// Font units per font size.
pub fn units() -> f64 {
    f64::from(face(false).units_per_em())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widths_are_those_of_arial() {
        // Widths shared by Helvetica, Arial and Liberation Sans, in thousandths of the font size.
        for (character, bold, width) in
            [('a', false, 556), ('i', false, 222), ('W', false, 944), (' ', false, 278), ('a', true, 556)]
        {
            let found = 1000.0 * advance(character, bold);
            assert!((found - f64::from(width)).abs() < 0.5, "{character}: {found}");
        }
    }

    #[test]
    fn it_has_what_figures_say() {
        for character in "γρτσΔÅ−–×≤≥₀²³·°±|≈½…αβ√ ABCxyz019%/()".chars() {
            let has = |bold| face(bold).glyph_index(character).is_some();
            assert!(has(false) && has(true), "{character}");
        }
    }
}
